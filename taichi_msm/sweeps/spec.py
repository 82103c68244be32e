"""Sweep file -> Sweep, with file, line and column in every error.

The values of every run of a sweep.

How a key of a scene is varied.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from glob import glob
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, field_validator, model_validator
from typing_extensions import Self

from taichi_msm.errors import ArgumentError, Key, Problem, SceneError
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
    truncate,
)

pass  # REMOVED
pass  # REMOVED

MAX_RUNS = 10**7

# SciPy has no Sobol sequence of more dimensions.
MAX_NUMBERS = 21201

SWEEP = FileKind("sweep", "scene and vary")


class SweepSettings(Section):
    """The content of a sweep file."""

    scene: FilePath = key(..., "the scene file; relative to the sweep file", "the path of a scene file")
    samples: Annotated[Integer, Field(ge=1, le=MAX_RUNS)] | None = key(
        None,
        "number of runs, whose values are taken from a scrambled Sobol sequence; not with grids",
        f"a whole number, 1 to {MAX_RUNS}",
    )
    seed: Annotated[Integer, Field(ge=0)] = key(
        1, "what the samples, and the parts of a data set, are chosen by", "a whole number, 0 or more"
    )
    vary: dict[str, Distribution] = key(
        ...,
        "keys of the scene by their dotted paths, and how each varies",
        "a mapping, such as tissue.young: {uniform: [1e4, 3e4]}",
    )
    set: dict[str, Any] = key({}, "keys of the scene by their dotted paths, and their values in all runs", "a mapping")

    @field_validator("vary")
    @classmethod
    def _has_keys(cls, vary: dict[str, Distribution]) -> dict[str, Distribution]:
        if not vary:
            raise scene_fault("no keys; name at least one, such as tissue.young: {uniform: [1e4, 3e4]}")
        return vary

    @model_validator(mode="after")
    def _fits(self) -> Self:
        grids = [name for name, one in self.vary.items() if one.kind == "grid"]
        if self.samples is not None and grids:
            raise scene_fault(
                f"{grids[0]} is a grid, which gives every combination; take choice, or leave out samples", "samples"
            )
        if self.samples is None and len(grids) < len(self.vary):
            raise scene_fault("missing; expected the number of runs, as not every key is a grid", "samples")
        if (runs := count_runs(self.vary, self.samples)) > MAX_RUNS:
            raise scene_fault(
                f"{runs} combinations, more than the {MAX_RUNS} that can be run; take smaller grids", "vary"
            )
        if (numbers := sum(one.dimensions for one in self.vary.values())) > MAX_NUMBERS:
            raise scene_fault(f"{numbers} numbers, more than the {MAX_NUMBERS} that can vary; take fewer", "vary")
        keys = [_as_key(name) for name in (*self.set, *self.vary)]
        for number, later in enumerate(keys):
            if hidden := [earlier for earlier in keys[:number] if earlier[: len(later)] == later]:
                name, other = (".".join(map(str, one)) for one in (later, hidden[0]))
                remedy = "keep one" if later == hidden[0] else f"keep one, or give {name} first"
                where = "vary" if number >= len(self.set) else "set"
                raise scene_fault(f"{name} replaces {other}, which comes before it; {remedy}", where)
        return self


@dataclass(frozen=True)
class Sweep:
    """A scene file and how it is varied. Paths of pictures in its values are relative to the scene file."""

    scene: ParsedFile
    settings: SweepSettings

    @property
    def keys(self) -> list[str]:
        """The keys that vary."""
        return list(self.settings.vary)

    @property
    def runs(self) -> int:
        """The number of runs."""
        return count_runs(self.settings.vary, self.settings.samples)

    def values(self) -> list[list[Any]]:
        """Give the values of the keys that vary, for every run."""
        return values_of_runs(self.settings.vary, self.settings.samples, self.settings.seed)

    def some_values(self, most: int) -> list[list[Any]]:
        """Give those of at most so many runs, spread over all."""
        return values_of_some(self.settings.vary, self.settings.samples, self.settings.seed, most)

    def overrides(self, values: list[Any]) -> tuple[str, ...]:
        """Give what `run --set` takes for the run with these values."""
        pairs = [*self.settings.set.items(), *zip(self.keys, values, strict=True)]
        return tuple(f"{name}={cell(value)}" for name, value in pairs)

    @cached_property
    def files(self) -> dict[str, str]:
        """The SHA-256 of every file that the runs may need, by its path; without those that cannot be read."""
        names: list[str] = []

        def noted(_: Key, text: str) -> str:
            names.append(text)
            return text

        listed = [(name, one.values) for name, one in self.settings.vary.items() if one.kind in ("choice", "grid")]
        pairs = [(name, value) for name, values in listed for value in values]
        _with_files((), self.scene.document.data, noted)
        for name, value in [*self.settings.set.items(), *pairs]:
            _with_files(_as_key(name), value, noted)
        digests = {}
        for path in dict.fromkeys(str(self.scene.folder / name) for name in names):
            with suppress(PictureError):  # The run that needs it says why.
                digests[path] = file_sha256(path)
        return digests

    @cached_property
    def digests(self) -> frozenset[str]:
        """The digests of these files."""
        return frozenset(self.files.values())

    def description(self) -> dict[str, Any]:
        """Give all that its results follow from, for JSON; two sweeps that are described equally are one."""
        settings = self.settings.model_dump(mode="json", exclude={"scene", "vary"})
        vary = {name: {one.kind: one.values} for name, one in self.settings.vary.items()}
        scene = json.dumps(self.scene.document.data).encode()
        files = {os.path.relpath(path, self.scene.folder): digest for path, digest in self.files.items()}
        return {**settings, "vary": vary, "digest": hashlib.sha256(scene).hexdigest(), "files": files}


def load_sweep(path: str | Path) -> Sweep:
    """Read a sweep file and check it; SceneError: with all its faults, one line each, in their order."""
    draft = Draft(read_file(str(path), SWEEP))
    if "sheet" in draft.data and "vary" not in draft.data:
        raise SceneError([f"{path}:1:1: a scene; use `taichi-msm run`, or name it by `scene:` in a sweep file"])
    sweep, problems = _checked(draft.data, Path(path).parent)
    draft.report(problems)
    if sweep is None or draft.problems:
        raise SceneError(draft.lines())
    return sweep


def make_sweep(scene: str | Path, settings: Mapping[str, Any]) -> Sweep:
    """Build a sweep without a file; its paths are relative to the scene file. SceneError: with all its faults."""
    try:
        data = json.loads(json.dumps({**settings, "scene": Path(scene).name}))
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"vary, overrides: {error}; use numbers, text, lists, dicts") from None
    sweep, problems = _checked(data, Path(scene).parent)
    if sweep is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return sweep


def _checked(data: dict[str, Any], folder: Path) -> tuple[Sweep | None, list[Problem]]:
    """Check the content of a sweep file in a folder, and read its scene; gives all that is wrong."""
    problems: list[Problem] = []
    file, name = None, data.get("scene")
    if isinstance(name, str) and name:
        path = folder / name
        problems += _relocate(data, folder, path.parent)
        try:
            # In the errors of runs it is named without its folder, wherever the sweep is started.
            file = read_file(_short(path), SCENE_KIND)._replace(name=path.name)
            problems += _unknown_keys(file, data)
        except SceneError as error:
            problems.append(Problem(("scene",), error.lines[0]))
    settings, wrong = parse_model(SweepSettings, data)
    return (None if settings is None or file is None else Sweep(file, settings)), [*problems, *wrong]


def _short(path: Path) -> str:
    """Leave .. out of a path, if that leads to the same file, as it may not where folders are links."""
    short = Path(os.path.normpath(path))
    try:
        return str(short if short.samefile(path) else path)
    except (OSError, ValueError):
        return str(path)


def cell(value: Any) -> str:
    """Write a value as `--set` takes it."""
    if isinstance(value, str):
        with suppress(UnreadableError):
            document = read_yaml(value)
            if document.data == value and not document.faults:
                return value
    return json.dumps(value, ensure_ascii=False)


def _relocate(data: dict[str, Any], folder: Path, home: Path) -> Iterator[Problem]:
    """Make paths of files, given relative to a folder, relative to the scene's, its home; expand patterns."""
    vary, fixed = _mappings(data)
    for name, ways in vary.items():
        for way in {"choice", "grid"} & set(ways if isinstance(ways, dict) else ()):
            path: Key = ("vary", name, way)
            if isinstance(pattern := ways[way], str) and names_file(_as_key(name)):
                noun, suffixes = _kind_of_file(_as_key(name))
                names = sorted(glob(pattern, root_dir=folder))  # noqa: PTH207  # Path.glob refuses absolute patterns
                ways[way] = [text for text in names if text.lower().endswith(suffixes) and (folder / text).is_file()]
                if not ways[way]:
                    said = f"{format_value(pattern)} matches no {noun}; give a pattern relative to the sweep file"
                    yield Problem(path, said)
            if isinstance(ways[way], list):
                for index, value in enumerate(ways[way]):
                    ways[way][index], faults = _relocated(name, value, folder, home)
                    yield from (Problem((*path, index), fault) for fault in faults)
    for name, value in fixed.items():
        fixed[name], faults = _relocated(name, value, folder, home)
        yield from (Problem(("set", name), fault) for fault in faults)


def _relocated(name: str, value: Any, folder: Path, home: Path) -> tuple[Any, list[str]]:
    """Relocate the files in the value of a key; returns it, and what is wrong with them."""
    faults = []

    def relocated(key: Key, text: str) -> str:
        noun, _ = _kind_of_file(key)
        path = folder / text
        try:
            is_file = path.is_file()
        except (OSError, ValueError):
            is_file = False
        if not (is_below(path, folder) or is_below(path, home)):
            faults.append(
                f"{text} is neither below the sweep file's folder nor below the scene's; put the {noun} there"
            )
        elif not is_file:
            faults.append(f"{truncate(text)}: no such file; name a {noun} relative to the sweep file")
        # A folder may be a link, from which .. leads elsewhere.
        return Path(os.path.relpath(path.parent.resolve() / path.name, home.resolve())).as_posix()

    return _with_files(_as_key(name), value, relocated), faults


def _kind_of_file(key: Key) -> tuple[str, tuple[str, ...]]:
    """Return the noun for the file that a key names, and the ends that its name may have."""
    return ("picture", PICTURE_SUFFIXES) if key in PICTURE_KEYS else ("file", ("",))


def _with_files(path: Key, value: Any, change: Callable[[Key, str], str]) -> Any:
    """Change the paths of files in the value of a key."""
    if names_file(path):
        return change(path, value) if isinstance(value, str) and 0 < len(value) <= MAX_PATH else value
    if isinstance(value, dict):
        return {name: _with_files((*path, name), one, change) for name, one in value.items()}
    return value


def _as_key(name: str) -> Key:
    """Split a dotted key; empty: it is none that `--set` takes."""
    return parse_key(name.strip()) if "=" not in name else ()


def _unknown_keys(scene: ParsedFile, data: dict[str, Any]) -> Iterator[Problem]:
    """Find the keys that no scene has, by trying one value of each."""
    vary, fixed = _mappings(data)
    tried: dict[Key, Any] = {("set", name): value for name, value in fixed.items()}
    for name, ways in vary.items():
        values = next(iter(ways.values()), None) if isinstance(ways, dict) else None
        tried["vary", name] = values[0] if isinstance(values, list) and values else None
    draft = Draft(scene)
    for place in [place for place in tried if not _as_key(str(place[1]))]:
        yield Problem(place, "not a key; expected a dotted path such as sheet.points")
        del tried[place]
    for place, value in tried.items():
        known = len(draft.problems)
        draft.override(parse_override(f"{place[1]}={cell(value)}"))
        yield from (Problem(place, problem.message) for _, problem in draft.problems[known:])
    for problem in parse_model(Scene, draft.data)[1]:
        if not problem.message.startswith("unknown key"):
            continue
        # The fault may be above a key or, in a section that is given as a whole, below it; or in the scene itself.
        around = [place for place in tried if _on_one_way(_as_key(str(place[1])), problem.path)]
        for place in around or [("scene",)]:
            told = f"{problem.key}: " if problem.path != _as_key(str(place[-1])) else ""
            yield Problem(place, f"{told}{problem.message}")


def _on_one_way(key: Key, other: Key) -> bool:
    """Tell whether one of two keys leads to the other."""
    return all(part == also for part, also in zip(key, other, strict=False))


def _mappings(data: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Give what varies and what is set, each empty where it is no mapping."""
    vary, fixed = (data.get(name) for name in ("vary", "set"))
    return vary if isinstance(vary, dict) else {}, fixed if isinstance(fixed, dict) else {}


pass  # REMOVED


def values_of_runs(vary: Mapping[str, Distribution], samples: int | None, seed: int) -> list[list[Any]]:
    """Give the values of the varied keys, in their order, for every run.

    Every combination of the grids, the last key varying fastest; or, with a number of samples, the first points of a
    scrambled Sobol sequence, of which every number and every choice takes a dimension, in the order of the keys.

    Source: Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; SciPy's `qmc.Sobol`.
    """
    if samples is None:
        return [_combination(vary, run) for run in range(count_runs(vary, None))]
    import numpy as np
    from scipy.stats import qmc

    counts = [one.dimensions for one in vary.values()]
    # A generator, as SciPy turns a number into different ones from version to version; a power of two, as it warns of
    # any other number, whose first points are the same.
    sequence = qmc.Sobol(sum(counts), scramble=True, seed=np.random.default_rng(seed))
    points = sequence.random_base2(math.ceil(math.log2(samples)))[:samples]
    parts = np.split(points, np.cumsum(counts)[:-1], axis=1)
    columns = [[one.value(shares) for shares in part.tolist()] for one, part in zip(vary.values(), parts, strict=True)]
    return [list(values) for values in zip(*columns, strict=True)]


def values_of_some(vary: Mapping[str, Distribution], samples: int | None, seed: int, most: int) -> list[list[Any]]:
    """Give the values of at most so many runs, spread over all, without making those of the others."""
    if samples is not None:
        # The first points of the sequence are spread over all.
        return values_of_runs(vary, min(samples, most), seed)
    total = count_runs(vary, None)
    return [_combination(vary, run) for run in sorted({(2 * n + 1) * total // (2 * most) for n in range(most)})]


def count_runs(vary: Mapping[str, Distribution], samples: int | None) -> int:
    """Count the runs without making their values."""
    return math.prod(len(one.values) for one in vary.values()) if samples is None else samples


def _combination(vary: Mapping[str, Distribution], run: int) -> list[Any]:
    """Give the combination of the grids with a number."""
    values = []
    for one in reversed(list(vary.values())):
        run, index = divmod(run, len(one.values))
        values.append(one.values[index])
    return values[::-1]


# Sobol points are multiples of 2^-30, 0 among them, where a normal distribution has no value.
SMALLEST_SHARE = 2.0**-31

RANGE = "[low, high]: numbers, or lists of one shape"
LIST = "a list of values that is not empty"


class Distribution(Section):
    """Exactly one way in which a key varies. Lists of numbers vary componentwise."""

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
        """Which of the ways it is."""
        return next(iter(self.model_fields_set))

    @property
    def values(self) -> Any:
        """The numbers or values that it is made from."""
        return getattr(self, self.kind)

    @property
    def dimensions(self) -> int:
        """How many shares a value is made from: one for each number, one for a choice, none for a grid."""
        if self.kind in ("choice", "grid"):
            return int(self.kind == "choice")
        return len(_numbers(self.values[0]))

    def value(self, shares: Sequence[float]) -> Any:
        """Turn shares, 0 <= share < 1, one for each dimension, into a value."""
        if self.kind == "choice":
            return self.values[int(shares[0] * len(self.values))]
        rest = iter(shares)
        return _each(lambda first, second: _NUMBERS[self.kind](first, second, next(rest)), *self.values)


def _uniform(low: float, high: float, share: float) -> float:
    return low + (high - low) * share


def _log_uniform(low: float, high: float, share: float) -> float:
    # Rounding must not lead outside.
    return min(max(math.exp(_uniform(math.log(low), math.log(high), share)), low), high)


def _normal(mean: float, deviation: float, share: float) -> float:
    from scipy.special import ndtri

    return mean + deviation * float(ndtri(max(share, SMALLEST_SHARE)))


_NUMBERS: dict[str, Callable[[float, float, float], float]] = {
    "uniform": _uniform,
    "log_uniform": _log_uniform,
    "normal": _normal,
}


def _each(make: Callable[[float, float], float], first: Any, second: Any) -> Any:
    """Make a value from two of one shape, number by number."""
    if isinstance(first, list):
        return list(map(partial(_each, make), first, second))
    return float(make(first, second))


def _numbers(value: Any) -> list[float]:
    """List the numbers in a value; empty: it holds something else."""
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
    """Tell values of different nesting apart; a number is None, anything else itself."""
    if isinstance(value, list):
        return [_shape(item) for item in value]
    return None if _numbers(value) else value
