"""Sweep files: parsing, distributions of the varied keys, and values of the runs."""

from __future__ import annotations

import hashlib
import json
import keyword
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from glob import glob
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, field_validator, model_validator
from typing_extensions import Self

from taichi_msm.errors import ArgumentError, Key, Problem, SceneError, truncate
from taichi_msm.images import PICTURE_SUFFIXES, PictureError, file_sha256
from taichi_msm.load.check import parse_model
from taichi_msm.load.scene_file import (
    PICTURE_KEYS,
    SCENE_KIND,
    Draft,
    FileKind,
    ParsedFile,
    is_below,
    names_file,
    parse_key,
    parse_override,
    read_file,
)
from taichi_msm.load.yaml_reader import UnreadableError, read_yaml
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import (
    MAX_MAGNITUDE,
    MAX_PATH,
    FilePath,
    Integer,
    Section,
    format_value,
    key,
    scene_fault,
)
from taichi_msm.sweeps.expressions import CONSTANTS, FUNCTIONS, ExpressionError, evaluate, replace_expressions

# Columns of table.csv between the varied keys and the forces of the probes, which are followed by the seconds.
RESULT_COLUMNS = ("status", "error", "max_displacement", "shortest_spring", "error_estimate", "mesh_error")

MAX_RUNS = 10**7

# Limit of SciPy's Sobol sequences.
MAX_DIMENSIONS = 21201


class SweepSettings(Section):
    """Content of a sweep file."""

    scene: FilePath = key(..., "the scene file; relative to the sweep file", "the path of a scene file")
    samples: Annotated[Integer, Field(ge=1, le=MAX_RUNS)] | None = key(
        None,
        "number of runs, whose values are taken from a scrambled Sobol sequence; not with grids",
        f"a whole number, 1 to {MAX_RUNS}",
    )
    seed: Annotated[Integer, Field(ge=0)] = key(
        1, "seed of the samples and of the splits of a data set", "a whole number, 0 or more"
    )
    variables: dict[str, Distribution] = key(
        {},
        "names of numbers for the expressions in set, and how each varies",
        "a mapping, such as x: {uniform: [0, 1]}",
    )
    vary: dict[str, Distribution] = key(
        {},
        "keys of the scene by their dotted paths, and how each varies; required without variables",
        "a mapping, such as tissue.young: {uniform: [1e4, 3e4]}",
    )
    set: dict[str, Any] = key(
        {},
        "keys of the scene by their dotted paths, and their values in all runs; a text that begins with = is an "
        "expression of the variables",
        "a mapping",
    )

    @property
    def distributions(self) -> dict[str, Distribution]:
        """Distributions of the variables and the varied keys, in the order of the dimensions and of the columns."""
        return {**self.variables, **self.vary}

    @property
    def expressions(self) -> list[str]:
        """Keys of `set` whose values contain expressions."""
        found: dict[str, None] = {}
        replace_expressions(self.set, lambda path, _: found.setdefault(str(path[0])))
        return list(found)

    @field_validator("variables")
    @classmethod
    def _check_variables(cls, variables: dict[str, Distribution]) -> dict[str, Distribution]:
        for name, distribution in variables.items():
            if name in {"run", *RESULT_COLUMNS, "seconds"}:
                raise scene_fault("is the name of a column of table.csv; take another", name)
            if (
                name in {*FUNCTIONS, *CONSTANTS}
                or keyword.iskeyword(name)
                or not re.fullmatch(r"[A-Za-z_]\w*", name, re.A)
            ):
                raise scene_fault("is no name of a variable; take letters, digits and _, such as x1", name)
            for value in distribution.values:
                if isinstance(value, list) or not _numbers(value):
                    raise scene_fault(
                        f"{format_value(value)} is no number; variables are numbers", name, distribution.kind
                    )
        return variables

    @model_validator(mode="after")
    def _fits(self) -> Self:
        varied = self.distributions
        if not varied:
            raise scene_fault("no keys; name at least one, such as tissue.young: {uniform: [1e4, 3e4]}", "vary")
        if both := self.variables.keys() & self.vary.keys():
            raise scene_fault(
                "is also a key of vary, with its column in table.csv; take another name", "variables", min(both)
            )
        grids = [name for name, distribution in varied.items() if distribution.kind == "grid"]
        if self.samples is not None and grids:
            raise scene_fault(
                f"{grids[0]} is a grid, which gives every combination; take choice, or leave out samples", "samples"
            )
        if self.samples is None and len(grids) < len(varied):
            raise scene_fault("missing; expected the number of runs, as not every key is a grid", "samples")
        if (runs := count_runs(varied, self.samples)) > MAX_RUNS:
            raise scene_fault(
                f"{runs} combinations, more than the {MAX_RUNS} that can be run; take smaller grids", "vary"
            )
        if (numbers := sum(distribution.dimensions for distribution in varied.values())) > MAX_DIMENSIONS:
            raise scene_fault(f"{numbers} numbers, more than the {MAX_DIMENSIONS} that can vary; take fewer", "vary")
        keys = [_split_key(name) for name in (*self.set, *self.vary)]
        for number, later in enumerate(keys):
            if replaced := [earlier for earlier in keys[:number] if earlier[: len(later)] == later]:
                name, earlier_name = (".".join(map(str, key)) for key in (later, replaced[0]))
                remedy = "keep one" if later == replaced[0] else f"keep one, or give {name} first"
                section = "vary" if number >= len(self.set) else "set"
                raise scene_fault(f"{name} replaces {earlier_name}, which comes before it; {remedy}", section)
        return self


@dataclass(frozen=True)
class Sweep:
    """Scene file and the variation of its keys; paths in the values are relative to the scene file."""

    scene: ParsedFile
    settings: SweepSettings

    @property
    def keys(self) -> list[str]:
        """The variables, and the varied keys as dotted paths."""
        return list(self.settings.distributions)

    @property
    def runs(self) -> int:
        """The number of runs."""
        return count_runs(self.settings.distributions, self.settings.samples)

    def values(self) -> list[list[Any]]:
        """Return the values of the variables and the varied keys, for every run."""
        return run_values(self.settings.distributions, self.settings.samples, self.settings.seed)

    def sample_values(self, limit: int) -> list[list[Any]]:
        """Return the values of the variables and the varied keys for at most `limit` runs, evenly spaced."""
        return sample_run_values(self.settings.distributions, self.settings.samples, self.settings.seed, limit)

    def overrides(self, values: list[Any]) -> tuple[str, ...]:
        """Return the arguments of `run --set` for a run.

        A key whose expression has no value for these variables is set to a text with the reason, so that the run is
        refused.
        """
        settings, count = self.settings, len(self.settings.variables)
        variables = dict(zip(settings.variables, values[:count], strict=True))
        fixed = dict(settings.set)
        for name, value in fixed.items():
            try:
                fixed[name] = replace_expressions(value, lambda _, text: evaluate(text, variables))
            except ExpressionError as error:
                fixed[name] = str(error)
        pairs = [*fixed.items(), *zip(settings.vary, values[count:], strict=True)]
        return tuple(f"{name}={format_override(value)}" for name, value in pairs)

    @cached_property
    def files(self) -> dict[str, str]:
        """SHA-256 by path of every readable file that a run may use."""
        names: list[str] = []

        def collect(_: Key, text: str) -> str:
            names.append(text)
            return text

        varied = [
            (name, value)
            for name, distribution in self.settings.vary.items()
            if distribution.kind in ("choice", "grid")
            for value in distribution.values
        ]
        _map_files((), self.scene.document.data, collect)
        for name, value in [*self.settings.set.items(), *varied]:
            _map_files(_split_key(name), value, collect)
        digests = {}
        for path in dict.fromkeys(str(self.scene.folder / name) for name in names):
            with suppress(PictureError):  # The run that needs the file reports the error.
                digests[path] = file_sha256(path)
        return digests

    @cached_property
    def digests(self) -> frozenset[str]:
        """The digests of `files`."""
        return frozenset(self.files.values())

    def description(self) -> dict[str, Any]:
        """Return all settings that determine the results as JSON data; equal sweeps have equal descriptions."""
        settings = self.settings.model_dump(mode="json", exclude={"scene", "vary", "variables"})
        variables, vary = (
            {name: {distribution.kind: distribution.values} for name, distribution in section.items()}
            for section in (self.settings.variables, self.settings.vary)
        )
        scene = json.dumps(self.scene.document.data).encode()
        files = {os.path.relpath(path, self.scene.folder): digest for path, digest in self.files.items()}
        settings |= {"variables": variables} if variables else {}  # Sweeps without them keep their description.
        return {**settings, "vary": vary, "digest": hashlib.sha256(scene).hexdigest(), "files": files}


def load_sweep(path: str | Path) -> Sweep:
    """Read and check a sweep file.

    Raises:
        SceneError: with a line for each error of the file, in the order of the file.
    """
    draft = Draft(read_file(str(path), FileKind("sweep", "scene and vary")))
    if "sheet" in draft.data and not {"vary", "variables"} & draft.data.keys():
        raise SceneError([f"{path}:1:1: a scene; use `taichi-msm run`, or name it by `scene:` in a sweep file"])
    sweep, problems = _checked(draft.data, Path(path).parent)
    draft.report(problems)
    if sweep is None or draft.problems:
        raise SceneError(draft.lines())
    return sweep


def make_sweep(scene: str | Path, settings: Mapping[str, Any]) -> Sweep:
    """Build a sweep without a sweep file.

    Args:
        scene: path of the scene file, the base of relative paths in `settings`.
        settings: content of a sweep file, without `scene`.

    Raises:
        ArgumentError: when a value cannot be represented in JSON.
        SceneError: with a line for each error of the settings.
    """
    try:
        data = json.loads(json.dumps({**settings, "scene": Path(scene).name}))
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"vary, overrides: {error}; use numbers, text, lists, dicts") from None
    sweep, problems = _checked(data, Path(scene).parent)
    if sweep is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return sweep


def _checked(data: dict[str, Any], folder: Path) -> tuple[Sweep | None, list[Problem]]:
    """Check the content of a sweep file in a folder, and read its scene; return the sweep and all errors."""
    problems: list[Problem] = []
    file, name = None, data.get("scene")
    if isinstance(name, str) and name:
        path = folder / name
        problems += _relocate(data, folder, path.parent)
        try:
            # Without its folder, as errors of runs must not depend on the current directory.
            file = read_file(_normalised(path), SCENE_KIND)._replace(name=path.name)
            problems += _unknown_keys(file, data)
        except SceneError as error:
            problems.append(Problem(("scene",), error.lines[0]))
    problems += _expression_problems(data)
    settings, setting_problems = parse_model(SweepSettings, data)
    return (None if settings is None or file is None else Sweep(file, settings)), [*problems, *setting_problems]


def _expression_problems(data: dict[str, Any]) -> list[Problem]:
    """Check the expressions in `set`, with NaN for all variables, for which those of single runs have no problems."""
    variables = data.get("variables")
    names = dict.fromkeys(variables if isinstance(variables, dict) else (), math.nan)
    problems = []

    def check(path: Key, text: str) -> None:
        try:
            evaluate(text, names)
        except ExpressionError as error:
            problems.append(Problem(("set", *path), str(error)))

    replace_expressions(_mappings(data)[1], check)
    return problems


def _normalised(path: Path) -> str:
    """Remove .. from a path, unless symbolic links make the result another file."""
    short = Path(os.path.normpath(path))
    try:
        return str(short if short.samefile(path) else path)
    except (OSError, ValueError):
        return str(path)


def format_override(value: Any) -> str:
    """Format a value for `--set`."""
    if isinstance(value, str):
        with suppress(UnreadableError):
            document = read_yaml(value)
            if document.data == value and not document.faults:
                return value
    return json.dumps(value, ensure_ascii=False)


def _relocate(data: dict[str, Any], folder: Path, home: Path) -> Iterator[Problem]:
    """Expand file patterns, and convert paths from the base `folder` to the base `home`, the scene's folder."""
    vary, fixed = _mappings(data)
    for name, distribution in vary.items():
        for kind in {"choice", "grid"} & set(distribution if isinstance(distribution, dict) else ()):
            path: Key = ("vary", name, kind)
            if isinstance(pattern := distribution[kind], str) and names_file(_split_key(name)):
                noun, suffixes = _kind_of_file(_split_key(name))
                names = sorted(glob(pattern, root_dir=folder))  # noqa: PTH207  # Path.glob refuses absolute patterns
                distribution[kind] = [
                    text for text in names if text.lower().endswith(suffixes) and (folder / text).is_file()
                ]
                if not distribution[kind]:
                    message = f"{format_value(pattern)} matches no {noun}; give a pattern relative to the sweep file"
                    yield Problem(path, message)
            if isinstance(distribution[kind], list):
                for index, value in enumerate(distribution[kind]):
                    distribution[kind][index], errors = _relocated(name, value, folder, home)
                    yield from (Problem((*path, index), error) for error in errors)
    for name, value in fixed.items():
        fixed[name], errors = _relocated(name, value, folder, home)
        yield from (Problem(("set", name), error) for error in errors)


def _relocated(name: str, value: Any, folder: Path, home: Path) -> tuple[Any, list[str]]:
    """Relocate the files in the value of a key; return the value and the errors."""
    errors = []

    def relocated(key: Key, text: str) -> str:
        noun, _ = _kind_of_file(key)
        path = folder / text
        try:
            is_file = path.is_file()
        except (OSError, ValueError):
            is_file = False
        if not (is_below(path, folder) or is_below(path, home)):
            errors.append(
                f"{text} is neither below the sweep file's folder nor below the scene's; put the {noun} there"
            )
        elif not is_file:
            errors.append(f"{truncate(text)}: no such file; name a {noun} relative to the sweep file")
        # Resolved first, as .. after a symbolic link is the parent of its target.
        return Path(os.path.relpath(path.parent.resolve() / path.name, home.resolve())).as_posix()

    return _map_files(_split_key(name), value, relocated), errors


def _kind_of_file(key: Key) -> tuple[str, tuple[str, ...]]:
    """Return the noun for the file of a key, and its allowed suffixes."""
    return ("picture", PICTURE_SUFFIXES) if key in PICTURE_KEYS else ("file", ("",))


def _map_files(path: Key, value: Any, change: Callable[[Key, str], str]) -> Any:
    """Apply a function to the file paths in the value of a key."""
    if names_file(path):
        return change(path, value) if isinstance(value, str) and 0 < len(value) <= MAX_PATH else value
    if isinstance(value, dict):
        return {name: _map_files((*path, name), item, change) for name, item in value.items()}
    return value


def _split_key(name: str) -> Key:
    """Split a dotted key; empty if `--set` does not accept it."""
    return parse_key(name.strip()) if "=" not in name else ()


def _unknown_keys(scene: ParsedFile, data: dict[str, Any]) -> Iterator[Problem]:
    """Check that a scene has the keys, by trying one value of each."""
    vary, fixed = _mappings(data)
    trials: dict[Key, Any] = {("set", name): value for name, value in fixed.items()}
    for name, distribution in vary.items():
        values = next(iter(distribution.values()), None) if isinstance(distribution, dict) else None
        trials["vary", name] = values[0] if isinstance(values, list) and values else None
    draft = Draft(scene)
    for path in [path for path in trials if not _split_key(str(path[1]))]:
        yield Problem(path, "not a key; expected a dotted path such as sheet.points")
        del trials[path]
    for path, value in trials.items():
        known = len(draft.problems)
        draft.override(parse_override(f"{path[1]}={format_override(value)}"))
        yield from (Problem(path, problem.message) for _, problem in draft.problems[known:])
    for problem in parse_model(Scene, draft.data)[1]:
        if not problem.message.startswith("unknown key"):
            continue
        # The unknown key may be above a tried key, in the section that is its value, or in the scene file.
        related = [path for path in trials if _is_prefix(_split_key(str(path[1])), problem.path)]
        for path in related or [("scene",)]:
            prefix = f"{problem.key}: " if problem.path != _split_key(str(path[-1])) else ""
            yield Problem(path, f"{prefix}{problem.message}")


def _is_prefix(first: Key, second: Key) -> bool:
    """Return whether one of two keys is a prefix of the other."""
    return all(part == counterpart for part, counterpart in zip(first, second, strict=False))


def _mappings(data: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the sections `vary` and `set`; empty where not a mapping."""
    vary, fixed = (data.get(name) for name in ("vary", "set"))
    return vary if isinstance(vary, dict) else {}, fixed if isinstance(fixed, dict) else {}


def run_values(vary: Mapping[str, Distribution], samples: int | None, seed: int) -> list[list[Any]]:
    """Compute the values of the varied keys, in their order, for every run.

    Without `samples` the runs are all combinations of the grids, the last key varying fastest. Otherwise they are the
    first points of a scrambled Sobol sequence, with a dimension for every number and choice, in the order of the keys.

    Args:
        vary: distributions by key.
        samples: number of runs, or None for grids.
        seed: of the scrambling.

    Source: Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; SciPy's `qmc.Sobol`.
    """
    if samples is None:
        return [_combination(vary, run) for run in range(count_runs(vary, None))]
    import numpy as np
    from scipy.stats import qmc

    counts = [distribution.dimensions for distribution in vary.values()]
    # A generator is passed, as versions of SciPy derive different ones from an integer. Other numbers of points than
    # powers of two would cause a warning of SciPy.
    sequence = qmc.Sobol(sum(counts), scramble=True, seed=np.random.default_rng(seed))
    points = sequence.random_base2(math.ceil(math.log2(samples)))[:samples]
    columns = [
        [distribution.value(fractions) for fractions in block.tolist()]
        for distribution, block in zip(vary.values(), np.split(points, np.cumsum(counts)[:-1], axis=1), strict=True)
    ]
    return [list(values) for values in zip(*columns, strict=True)]


def sample_run_values(vary: Mapping[str, Distribution], samples: int | None, seed: int, limit: int) -> list[list[Any]]:
    """Compute the values of at most `limit` runs, spread over all runs; other arguments as for `run_values`."""
    if samples is not None:
        # The first points of a Sobol sequence cover the range.
        return run_values(vary, min(samples, limit), seed)
    total = count_runs(vary, None)
    return [_combination(vary, run) for run in sorted({(2 * n + 1) * total // (2 * limit) for n in range(limit)})]


def count_runs(vary: Mapping[str, Distribution], samples: int | None) -> int:
    """Count the runs; arguments as for `run_values`."""
    return math.prod(len(distribution.values) for distribution in vary.values()) if samples is None else samples


def _combination(vary: Mapping[str, Distribution], run: int) -> list[Any]:
    """Return the combination of grid values of a run."""
    values = []
    for distribution in reversed(list(vary.values())):
        run, index = divmod(run, len(distribution.values))
        values.append(distribution.values[index])
    return values[::-1]


RANGE = "[low, high]: numbers, or lists of one shape"
LIST = "a list of values that is not empty"


class Distribution(Section):
    """Distribution of a varied key: exactly one of its fields. Lists of numbers vary componentwise."""

    model_config = ConfigDict(validate_default=False)

    uniform: Any = key(None, "between two numbers", RANGE)
    log_uniform: Any = key(None, "between two numbers above 0, uniform in the logarithm", RANGE)
    normal: Any = key(None, "normally distributed", "[mean, standard deviation]: numbers, or lists of one shape")
    choice: Any = key(None, "one of some values, all equally likely; of a picture also a pattern of files", LIST)
    grid: Any = key(None, "every one of some values, with every combination of the other keys'", LIST)

    @model_validator(mode="before")
    @classmethod
    def _is_flat(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            raise scene_fault(
                f"{format_value(data)} is no way to vary; take one, such as {{uniform: [1, 2]}} or {{choice: [1, 2]}}"
            )
        if data.keys().isdisjoint(cls.model_fields) and any(isinstance(value, dict) for value in data.values()):
            raise scene_fault("give each key by its dotted path, such as tissue.young: {uniform: [1e4, 3e4]}")
        return data

    @field_validator("uniform", "log_uniform", "normal")
    @classmethod
    def _is_pair(cls, value: Any) -> Any:
        if not (isinstance(value, list) and len(value) == 2 and all(map(_numbers, value))):
            raise scene_fault(
                f"{format_value(value)} is not allowed; expected two numbers, or two lists of numbers of one shape"
            )
        if _shape(value[0]) != _shape(value[1]):
            raise scene_fault(
                f"{format_value(value[0])} and {format_value(value[1])} differ in shape; give both as many numbers"
            )
        return value

    @field_validator("uniform", "log_uniform")
    @classmethod
    def _is_ordered(cls, value: Any) -> Any:
        for low, high in zip(_numbers(value[0]), _numbers(value[1]), strict=True):
            if low > high:
                raise scene_fault(f"{low:g} is above {high:g}; give the lower number first")
        return value

    @field_validator("log_uniform")
    @classmethod
    def _is_positive(cls, value: Any) -> Any:
        if (low := min(_numbers(value[0]))) <= 0:
            raise scene_fault(f"{low:g} has no logarithm; take numbers above 0, or uniform")
        return value

    @field_validator("normal")
    @classmethod
    def _has_deviation(cls, value: Any) -> Any:
        if (deviation := min(_numbers(value[1]))) < 0:
            raise scene_fault(f"a standard deviation of {deviation:g} is not possible; take 0 or more")
        return value

    @field_validator("choice", "grid")
    @classmethod
    def _is_list(cls, value: Any) -> Any:
        if not isinstance(value, list) or not value:
            raise scene_fault(f"{format_value(value)} is not allowed; expected {LIST}")
        if not _is_finite(value):
            raise scene_fault(f"{format_value(value)} has a number that is not finite; take others")
        return value

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if len(self.model_fields_set) != 1:
            raise scene_fault(f"expected one of {', '.join(type(self).model_fields)}")
        return self

    @property
    def kind(self) -> str:
        """Name of the field that is set."""
        return next(iter(self.model_fields_set))

    @property
    def values(self) -> Any:
        """Parameters of the distribution, or values of a choice or grid."""
        return getattr(self, self.kind)

    @property
    def dimensions(self) -> int:
        """Number of fractions for `value`: one per number, 1 for a choice, 0 for a grid."""
        if self.kind in ("choice", "grid"):
            return int(self.kind == "choice")
        return len(_numbers(self.values[0]))

    def value(self, fractions: Sequence[float]) -> Any:
        """Apply the quantile function to fractions in [0, 1), shape (dimensions,)."""
        if self.kind == "choice":
            return self.values[int(fractions[0] * len(self.values))]
        remaining = iter(fractions)
        return _map_pairs(lambda first, second: _QUANTILES[self.kind](first, second, next(remaining)), *self.values)


def _uniform(low: float, high: float, fraction: float) -> float:
    return low + (high - low) * fraction


def _log_uniform(low: float, high: float, fraction: float) -> float:
    # Rounding could leave the interval.
    return min(max(math.exp(_uniform(math.log(low), math.log(high), fraction)), low), high)


def _normal(mean: float, deviation: float, fraction: float) -> float:
    from scipy.special import ndtri

    # Sobol points are multiples of 2^-30 and include 0, where the quantile is infinite.
    return mean + deviation * float(ndtri(max(fraction, 2.0**-31)))


_QUANTILES: dict[str, Callable[[float, float, float], float]] = {
    "uniform": _uniform,
    "log_uniform": _log_uniform,
    "normal": _normal,
}


def _map_pairs(function: Callable[[float, float], float], first: Any, second: Any) -> Any:
    """Apply a function to the pairs of numbers in two values of one shape."""
    if isinstance(first, list):
        return list(map(partial(_map_pairs, function), first, second))
    return float(function(first, second))


def _numbers(value: Any) -> list[float]:
    """Return the flattened numbers of a value; empty if it contains anything else."""
    if isinstance(value, list):
        parts = [_numbers(item) for item in value]
        return [number for part in parts for number in part] if all(parts) else []
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_MAGNITUDE
    return [value] if is_number else []


def _is_finite(value: Any) -> bool:
    if isinstance(value, (list, dict)):
        return all(map(_is_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


def _shape(value: Any) -> Any:
    """Return a value with its numbers replaced by None."""
    if isinstance(value, list):
        return [_shape(item) for item in value]
    return None if _numbers(value) else value
