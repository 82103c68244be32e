"""Sweep files: checks, and values of the runs."""

from __future__ import annotations

import hashlib
import json
import keyword
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, partial
from glob import glob
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator
from typing_extensions import Self

from taichi_msm.array_files import ARRAY_SUFFIXES
from taichi_msm.camera_files.simcol import simcol_files
from taichi_msm.errors import ArgumentError, Key, Problem, SceneError, truncate, windows_path_hint
from taichi_msm.images import PICTURE_SUFFIXES, PictureError, file_sha256
from taichi_msm.load import scene_file
from taichi_msm.load.check import parse_model
from taichi_msm.load.yaml_reader import UnreadableError, read_yaml
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PATH, FilePath, Integer, Section, format_value, key, scene_fault
from taichi_msm.sweeps.distribution import Distribution, NonEmptyList, numbers
from taichi_msm.sweeps.expressions import CONSTANTS, FUNCTIONS, ExpressionError, evaluate, replace_expressions

# Columns of table.csv between the varied keys and the forces of probes.
RESULT_COLUMNS = ("status", "error", "max_displacement", "shortest_spring", "error_estimate", "mesh_error")

MAX_RUNS = 10**7

# Limit of the folders in a pattern of files.
MAX_FOLDERS = 100

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
        "keys of the scene by their dotted paths, and how each varies; required without variables and together",
        "a mapping, such as tissue.young: {uniform: [1.0e+4, 3.0e+4]}",
    )
    together: list[dict[str, NonEmptyList]] = key(
        [],
        "groups of keys of the scene by their dotted paths, each with a list of values; the keys of a group vary row "
        "by row, and each group is a grid",
        "a list of mappings from keys to lists, such as "
        "[{tissue.young: [1.0e+4, 2.0e+4], tissue.thickness: [1.0e-3, 2.0e-3]}]",
    )
    set: dict[str, Any] = key(
        {},
        "keys of the scene by their dotted paths, and their values in all runs; a text that begins with = is an "
        "expression of the variables",
        "a mapping",
    )

    @cached_property
    def distributions(self) -> dict[str, Distribution]:
        """Distributions of variables, varied keys and grouped keys, in the order of dimensions and columns."""
        grouped = {name: Distribution(grid=values) for group in self.together for name, values in group.items()}
        return {**self.variables, **self.vary, **grouped}

    @cached_property
    def grids(self) -> list[list[tuple[Any, ...]]]:
        """Rows of the values of each grid: of one variable or key, or of the keys of a group."""
        single = ({name: item.values} for name, item in (self.variables | self.vary).items())
        return [list(zip(*group.values(), strict=True)) for group in (*single, *self.together)]

    @property
    def runs(self) -> int:
        """Number of runs."""
        if self.samples is not None:
            return self.samples
        return math.prod(map(len, self.grids))

    @field_validator("variables")
    @classmethod
    def _check_variables(cls, variables: dict[str, Distribution]) -> dict[str, Distribution]:
        for name, distribution in variables.items():
            if name in {"run", *RESULT_COLUMNS, "seconds"}:
                raise scene_fault("is the name of a column of table.csv; take another", name)
            is_identifier = name.isascii() and name.isidentifier() and not keyword.iskeyword(name)
            if name in {*FUNCTIONS, *CONSTANTS}:
                raise scene_fault("has another meaning in expressions; take another name", name)
            if not is_identifier:
                raise scene_fault("is not a valid name; take letters, digits and _, such as x1", name)
            for value in distribution.values:
                if isinstance(value, list) or not numbers(value):
                    fault = f"{format_value(value)} is not a number; variables are numbers"
                    raise scene_fault(fault, name, distribution.kind)
        return variables

    @field_validator("together")
    @classmethod
    def _check_groups(cls, together: list[dict[str, list[Any]]]) -> list[dict[str, list[Any]]]:
        for index, group in enumerate(together):
            if not group:
                raise scene_fault("no keys; name at least two, each with a list of values", index)
            first, *others = group
            for name in others:
                if len(group[name]) != len(group[first]):
                    counts = f"{len(group[name])} values, and {first} has {len(group[first])}"
                    raise scene_fault(
                        f"{counts}; the lists of a group vary row by row, so give one length", index, name
                    )
        return together

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        varied = self.distributions
        if not varied:
            raise scene_fault("no keys; name at least one, such as tissue.young: {uniform: [1.0e+4, 3.0e+4]}", "vary")
        places: list[Key] = [("set", name) for name in self.set]
        places += [("vary", name) for name in self.vary]
        places += [("together", index, name) for index, group in enumerate(self.together) for name in group]
        if both := self.variables.keys() & {str(place[-1]) for place in places[len(self.set) :]}:
            fault = "is also a varied key, with its column in table.csv; take another name"
            raise scene_fault(fault, "variables", min(both))
        grids = [name for name, distribution in varied.items() if distribution.kind == "grid"]
        if self.samples is not None and grids:
            fault = f"{grids[0]} is a grid, which gives every combination; take choice, or leave out samples"
            if grids[0] not in self.variables | self.vary:
                fault = "together is a grid, which gives every combination; leave out samples, and take grids in vary"
            raise scene_fault(fault, "samples")
        if self.samples is None and len(grids) < len(varied):
            raise scene_fault("missing; expected the number of runs, as not every key is a grid", "samples")
        if self.runs > MAX_RUNS:
            fault = f"{self.runs} combinations, more than the {MAX_RUNS} that can be run; take smaller grids"
            raise scene_fault(fault, "vary")
        if (count := sum(distribution.dimensions for distribution in varied.values())) > MAX_DIMENSIONS:
            raise scene_fault(f"{count} numbers, more than the {MAX_DIMENSIONS} that can vary; take fewer", "vary")
        keys = [_split_key(str(place[-1])) for place in places]
        for number, later in enumerate(keys):
            if replaced := [earlier for earlier in keys[:number] if earlier[: len(later)] == later]:
                name, earlier_name = (".".join(map(str, key)) for key in (later, replaced[0]))
                remedy = "keep one" if later == replaced[0] else f"keep one, or give {name} first"
                fault = f"{name} replaces {earlier_name}, which comes before it; {remedy}"
                raise scene_fault(fault, *places[number][:-1])
        return self


def spread(total: int, limit: int) -> list[int]:
    """Return the numbers of at most `limit` evenly spaced runs."""
    count = min(total, limit)
    return [(2 * n + 1) * total // (2 * count) for n in range(count)]


@dataclass(frozen=True)
class Sweep:
    """Scene file, and variation of its keys; paths in the values are relative to the scene file."""

    scene: scene_file.ParsedFile
    settings: SweepSettings

    @property
    def keys(self) -> list[str]:
        """Names of the variables, then dotted paths of the varied keys."""
        return list(self.settings.distributions)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.settings.runs

    def values(self, limit: int = MAX_RUNS) -> list[list[Any]]:
        """Compute the values of the variables and the varied keys for each run, in the order of `keys`.

        With `samples`, the runs are the first points of a scrambled Sobol sequence, which has a dimension for every
        number and choice. Without, they are all combinations of the grids, of which the last key varies fastest. A
        limit keeps the first points, or evenly spaced combinations.

        Source: Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; SciPy's `qmc.Sobol`.
        """
        distributions = self.settings.distributions.values()
        if self.settings.samples is None:
            return [self._combination(run) for run in spread(self.runs, limit)]
        import numpy as np
        from scipy.stats import qmc

        counts = [distribution.dimensions for distribution in distributions]
        # A generator as seed, as versions of SciPy derive different ones from an integer. SciPy warns unless the number
        # of points is a power of two.
        sequence = qmc.Sobol(sum(counts), scramble=True, seed=np.random.default_rng(self.settings.seed))
        count = min(self.runs, limit)
        points = sequence.random_base2(math.ceil(math.log2(count)))[:count]
        columns = [
            [distribution.value(fractions) for fractions in block.tolist()]
            for distribution, block in zip(distributions, np.split(points, np.cumsum(counts)[:-1], axis=1), strict=True)
        ]
        return [list(values) for values in zip(*columns, strict=True)]

    def _combination(self, run: int) -> list[Any]:
        values: list[Any] = []
        for rows in reversed(self.settings.grids):
            run, index = divmod(run, len(rows))
            values += reversed(rows[index])
        return values[::-1]

    def overrides(self, values: list[Any]) -> tuple[str, ...]:
        """Return the arguments of `run --set` for the values of a run; a SceneError if an expression has no value."""
        settings, count = self.settings, len(self.settings.variables)
        variables = dict(zip(settings.variables, values[:count], strict=True))
        fixed = dict(settings.set)
        for name, value in fixed.items():
            try:
                fixed[name] = replace_expressions(value, lambda _, text: evaluate(text, variables))
            except ExpressionError as error:
                raise SceneError([f"set.{name}: {error}"]) from None
        pairs = [*fixed.items(), *zip(self.keys[count:], values[count:], strict=True)]
        return tuple(f"{name}={format_override(value)}" for name, value in pairs)

    @cached_property
    def files(self) -> dict[str, str]:
        """SHA-256 of every readable file that a run may use, by path."""
        names: list[str] = []

        def collect(_: Key, text: str) -> str:
            names.extend((text, *simcol_files(text)))
            return text

        _map_files((), self.scene.document.data, collect)
        for name, value in self.settings.set.items():
            _map_files(_split_key(name), value, collect)
        for name, distribution in self.settings.distributions.items():
            for value in distribution.values:
                _map_files(_split_key(name), value, collect)
        digests = {}
        for path in dict.fromkeys(str(self.scene.folder / name) for name in names):
            with suppress(PictureError):  # The run that needs the file reports the error.
                digests[path] = file_sha256(path)
        return digests

    @cached_property
    def digests(self) -> frozenset[str]:
        """SHA-256 of all `files`."""
        return frozenset(self.files.values())

    def description(self) -> dict[str, Any]:
        """Return everything that affects the results, as JSON data; equal sweeps have equal descriptions."""
        settings = self.settings
        variables, vary = (
            {name: {distribution.kind: distribution.values} for name, distribution in section.items()}
            for section in (settings.variables, settings.vary)
        )
        return {
            **settings.model_dump(include={"samples", "seed", "set"}),
            **({"variables": variables} if variables else {}),  # Absent in records of earlier versions.
            "vary": vary,
            **({"together": settings.together} if settings.together else {}),
            "digest": hashlib.sha256(json.dumps(self.scene.document.data).encode()).hexdigest(),
            "files": {os.path.relpath(path, self.scene.folder): digest for path, digest in self.files.items()},
        }


def load_sweep(path: str | Path) -> Sweep:
    """Read and check a sweep file; raise a SceneError with a line for each error, in the order of the file."""
    draft = scene_file.Draft(scene_file.read_file(str(path), "sweep", "scene and vary"))
    if "sheet" in draft.data and not {"vary", "variables", "together"} & draft.data.keys():
        raise SceneError([f"{path}:1:1: a scene; use `taichi-msm run`, or name it by `scene:` in a sweep file"])
    sweep, problems = _check(draft.data, Path(path).parent)
    draft.report(problems)
    if sweep is None or draft.problems:
        raise SceneError(draft.lines())
    return sweep


def make_sweep(scene: str | Path, settings: Mapping[str, Any]) -> Sweep:
    """Build a sweep without a sweep file; its paths are relative to the scene file.

    `settings` are the content of a sweep file, without `scene`. A value that JSON cannot represent raises an
    ArgumentError.
    """
    try:
        data = json.loads(json.dumps({**settings, "scene": Path(scene).name}))
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"vary, variables, overrides: {error}; use numbers, text, lists, dicts") from None
    sweep, problems = _check(data, Path(scene).parent)
    if sweep is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return sweep


def _check(data: dict[str, Any], folder: Path) -> tuple[Sweep | None, list[Problem]]:
    """Check the content of a sweep file in a folder, and read its scene; return the sweep, or None, and the errors."""
    problems: list[Problem] = []
    sections = (data.get(name) for name in ("variables", "vary", "set"))
    variables, vary, fixed = (section if isinstance(section, dict) else {} for section in sections)
    groups = data.get("together")
    together = [group if isinstance(group, dict) else {} for group in (groups if isinstance(groups, list) else ())]
    file, name = None, data.get("scene")
    if isinstance(name, str) and name:
        path = folder / name
        problems += _relocate(_value_lists(vary, together), fixed, folder, path.parent)
        try:
            # A name without folder, as errors of runs must not depend on the current directory.
            file = scene_file.read_file(_normalise(path), *scene_file.SCENE)._replace(name=path.name)
            varied: dict[Key, Any] = {("vary", name): value for name, value in vary.items()}
            for index, group in enumerate(together):
                varied |= {("together", index, name): {"grid": values} for name, values in group.items()}
            problems += _unknown_keys(file, varied, fixed)
        except SceneError as error:
            problems.append(Problem(("scene",), error.lines[0]))
    problems += _expression_problems(variables, fixed)
    settings, setting_problems = parse_model(SweepSettings, data)
    return (None if settings is None or file is None else Sweep(file, settings)), [*problems, *setting_problems]


def _expression_problems(variables: dict[str, Any], fixed: dict[str, Any]) -> list[Problem]:
    """Return the errors in the expressions of `set` that do not depend on the values of variables."""
    names = dict.fromkeys(variables, math.nan)
    problems = []

    def check(path: Key, text: str) -> None:
        try:
            evaluate(text, names)
        except ExpressionError as error:
            problems.append(Problem(("set", *path), str(error)))

    replace_expressions(fixed, check)
    return problems


def _normalise(path: Path) -> str:
    """Remove .. from a path, unless symbolic links make the result another file."""
    short = Path(os.path.normpath(path))
    try:
        return str(short if short.samefile(path) else path)
    except (OSError, ValueError):
        return str(path)


def format_override(value: Any) -> str:
    """Format a value for `--set`, text without quotes where YAML reads it as text."""
    if isinstance(value, str):
        with suppress(UnreadableError):
            document = read_yaml(value)
            if document.data == value and not document.faults:
                return value
    return json.dumps(value, ensure_ascii=False)


# Place of a list of values in the sweep file, the key of the scene, and the dict that contains the list.
ValueList = tuple[Key, Key, dict[str, Any]]


def _value_lists(vary: dict[str, Any], together: list[dict[str, Any]]) -> Iterator[ValueList]:
    """Yield the choices, grids and columns of groups, each a list or a file pattern."""
    for name, distribution in vary.items():
        for kind in ("choice", "grid"):
            if isinstance(distribution, dict) and kind in distribution:
                yield ("vary", name, kind), _split_key(name), distribution
    for index, group in enumerate(together):
        for name in group:
            yield ("together", index, name), _split_key(name), group


def _relocate(lists: Iterable[ValueList], fixed: dict[str, Any], folder: Path, scene_folder: Path) -> Iterator[Problem]:
    """Expand file patterns, and make paths relative to the scene's folder; in place. Yield the errors."""
    # Place of each value, key of the scene, and the list or dict that contains the value.
    places: list[tuple[Key, Key, Any]] = []
    for place, scene_key, container in lists:
        name = str(place[-1])
        if isinstance(pattern := container[name], str) and scene_file.names_file(scene_key):
            container[name] = _matching_files(pattern, folder, scene_key)
            if not container[name]:
                noun = _file_noun(scene_key)
                message = f"{format_value(pattern)} matches no {noun}; give a pattern relative to the sweep file"
                yield Problem(place, message)
        if isinstance(values := container[name], list):
            places += [((*place, index), scene_key, values) for index in range(len(values))]
    places += [(("set", name), _split_key(name), fixed) for name in fixed]
    problems = []

    def relocate(place: Key, key: Key, text: str) -> str:
        path, noun = folder / text, _file_noun(key)
        if not (scene_file.is_below(path, folder) or scene_file.is_below(path, scene_folder)):
            message = f"{text} is neither below the sweep file's folder nor below the scene's; put the {noun} there"
            problems.append(Problem(place, message))
        elif not os.path.isfile(path):  # noqa: PTH113  # Path.is_file raises an error for a long name
            message = f"{truncate(text)}: no such file; name a {noun} relative to the sweep file"
            message += windows_path_hint(text)
            problems.append(Problem(place, message))
        # Links are resolved first, as .. after a symbolic link is the parent of its target.
        return Path(os.path.relpath(path.parent.resolve() / path.name, scene_folder.resolve())).as_posix()

    for place, scene_key, container in places:
        container[place[-1]] = _map_files(scene_key, container[place[-1]], partial(relocate, place))
    yield from problems


def _matching_files(pattern: str, folder: Path, key: Key) -> list[str]:
    """Return the files that match a pattern relative to a folder, and have a suffix for the key."""
    # `glob` calls itself for each folder, and takes quadratic time for brackets.
    if len(pattern) > MAX_PATH or pattern.count("/") > MAX_FOLDERS:
        return []
    suffixes: tuple[str, ...] = PICTURE_SUFFIXES if key in scene_file.PICTURE_KEYS else ("",)
    if key in scene_file.SURFACE_KEYS:
        suffixes = (*PICTURE_SUFFIXES, *ARRAY_SUFFIXES) if "height" in key else ARRAY_SUFFIXES
    names = sorted(glob(pattern, root_dir=folder))  # noqa: PTH207  # Path.glob refuses absolute patterns
    return [text for text in names if text.lower().endswith(suffixes) and (folder / text).is_file()]


def _file_noun(key: Key) -> str:
    return "picture" if key in scene_file.PICTURE_KEYS else "file"


def _map_files(path: Key, value: Any, change: Callable[[Key, str], str]) -> Any:
    """Return a copy of the value of a key, with a function applied to its file paths."""
    if scene_file.names_file(path):
        return change(path, value) if isinstance(value, str) and 0 < len(value) <= MAX_PATH else value
    if isinstance(value, dict):
        return {name: _map_files((*path, name), item, change) for name, item in value.items()}
    return value


def _split_key(name: str) -> Key:
    """Split a dotted key; empty if it is invalid for `--set`."""
    return scene_file.parse_key(name.strip()) if "=" not in name else ()


def _unknown_keys(scene: scene_file.ParsedFile, varied: dict[Key, Any], fixed: dict[str, Any]) -> Iterator[Problem]:
    """Yield an error for each key that a scene cannot have, by trying one value of each key."""
    trials: dict[Key, Any] = {("set", name): value for name, value in fixed.items()}
    for path, distribution in varied.items():
        values = next(iter(distribution.values()), None) if isinstance(distribution, dict) else None
        trials[path] = values[0] if isinstance(values, list) and values else None
    draft = scene_file.Draft(scene)
    keys = {}
    for path, value in trials.items():
        if not (key := _split_key(str(path[-1]))):
            yield Problem(path, "not a key; expected a dotted path such as sheet.points")
            continue
        keys[path] = key
        earlier = len(draft.problems)
        # A copy, as later overrides may change a part of the value.
        draft.override(scene_file.Override("", key, deepcopy(value)))
        yield from (Problem(path, problem.message) for _, problem in draft.problems[earlier:])
    for problem in parse_model(Scene, draft.data)[1]:
        if not problem.is_unknown_key:
            continue
        # The unknown key is the beginning of a tried key, a key within its value, or a key of the scene file.
        unknown = problem.path
        related = [path for path, key in keys.items() if key[: len(unknown)] == unknown[: len(key)]]
        for path in related or [("scene",)]:
            prefix = f"{problem.key}: " if unknown != keys.get(path) else ""
            yield Problem(path, f"{prefix}{problem.message}")
