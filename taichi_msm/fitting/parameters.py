"""Parameters of a fit: keys, scales and bounds; and the types of the arguments of `fit`.

Numbers of unknown magnitude, such as a stiffness or a force, are fitted as the logarithm of their magnitude, with a
fixed sign. Other numbers, and those with an initial value of 0, are fitted linearly, in units of their range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

from typing_extensions import TypedDict

from taichi_msm.errors import MAX_WORKERS, ArgumentError, Key, SceneError, did_you_mean
from taichi_msm.load.scene_file import parse_key
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.scene import Scene

# Sections with fittable numbers, and keys that are not fittable: options, array sizes, and keys without effect.
SECTIONS = ("tissue", "springs", "damping", "sheet", "probes", "render.camera", "render.cameras")
FIXED_KEYS = ("tolerance", "grip", "shaft", "points")

# Keys of coordinates and times, which are fitted linearly.
COORDINATE_KEYS = ("at", "path", "offset", "load", "contact")

# Default bound of a logarithmic parameter: a factor of 1000 from the initial value.
MAX_LOG = math.log(1000)

Bounds = tuple[float, float]


def rounded(number: float) -> str:
    """Format a number with two digits."""
    return f"{float(f'{number:.2g}'):g}"


@dataclass(frozen=True)
class Parameter:
    """Fitted number of a scene, as a function of a coordinate x, which is initially 0."""

    key: str  # dotted path
    start: float  # initial value
    low: float  # smallest value, may be infinite
    high: float  # largest value, may be infinite
    scale: float  # x = (value - start) / scale; with a scale of 0 x = log(value / start)

    @property
    def path(self) -> Key:
        """Path in the data of a scene."""
        return parse_key(self.key)

    @property
    def is_log(self) -> bool:
        """Whether x is the logarithm of value / start."""
        return self.scale == 0

    def value(self, x: float) -> float:
        """Return the value at x; infinite on overflow."""
        if not self.is_log:
            return self.start + x * self.scale
        return self.start * (math.exp(x) if x < 700 else math.inf)

    @property
    def limits(self) -> Bounds:
        """Bounds of x."""
        if not self.is_log:
            return (self.low - self.start) / self.scale, (self.high - self.start) / self.scale
        shares = sorted((self.low / self.start, self.high / self.start))
        low = math.log(shares[0]) if shares[0] > 0 else -MAX_LOG
        return low, math.log(shares[1]) if shares[1] < math.inf else MAX_LOG

    def error(self, x: float, deviation: float) -> float:
        """Return the standard deviation of the value from that of x."""
        return deviation * (abs(self.value(x)) if self.is_log else self.scale)

    def relative_error(self, x: float, deviation: float) -> float:
        """Return the standard deviation as a share of the value, of a coordinate or time as a share of its range."""
        if self.is_log:
            return deviation
        unit = self.scale if _is_coordinate(self.path) else abs(self.value(x))
        return deviation * self.scale / unit if unit else math.inf

    def format_error(self, x: float, deviation: float) -> str:
        """Format the relative error in percent, that of a depth of contact in mm."""
        if self.path[0] == "contact":
            return f"{rounded(1000 * self.error(x, deviation))} mm"
        return f"{rounded(100 * self.relative_error(x, deviation))} %"


def make_parameters(scene: Scene, free: Sequence[str], bounds: Mapping[str, Bounds]) -> tuple[Parameter, ...]:
    """Return the parameters of a fit; raise a SceneError with all faults of keys and bounds."""
    data, faults, parameters = as_data(scene), [], []
    if not free:
        faults.append("--free: names no key; take one or more, such as --free tissue.young")
    for key in free:
        try:
            parameters.append(_parameter(scene, data, key, *bounds.get(key, (-math.inf, math.inf))))
        except SceneError as error:
            faults += error.lines
    for key in bounds:
        if key not in free:
            faults.append(f"--bounds {key}: not among --free{did_you_mean(key, free) or '; name it there too'}")
    if faults:
        raise SceneError(faults)
    return tuple(parameters)


def _parameter(scene: Scene, data: dict[str, Any], key: str, low: float, high: float) -> Parameter:
    path, option = parse_key(key), f"--free {key}"
    if path and path[-1] in ("map", "foundation_map"):
        example = f"{scene.kind}.{path[-1]}.range.1"
        raise SceneError([f"{option}: the only fitted map is tissue.map; name numbers, such as {example}"])
    value = _look_up(option, data, path)
    if not _is_fittable(path, value):
        description = f"{value!r}"
        if isinstance(value, (dict, list)):
            description = "a list" if isinstance(value, list) else "a section"
            if first := next(_numbers_below(path, value), None):
                raise SceneError([f"{option}: {description}; name one of its numbers, such as {first}"])
        raise SceneError([f"{option}: {description}, which cannot be free; take a number of {', '.join(SECTIONS)}"])
    interval = f"--bounds {key}={low:g},{high:g}"
    if not low < high:
        raise SceneError([f"{interval}: give the smaller one first, then a larger one"])
    if not low <= value <= high:
        raise SceneError([f"{interval}: the initial value {value:g} is outside; --set {key}=..."])
    is_bounded, is_coordinate = math.isfinite(high - low), _is_coordinate(path)
    if value and not is_coordinate:
        scale = 0.0
    elif is_bounded or is_coordinate:
        scale = high - low if is_bounded else _default_range(scene, path)
    else:
        remedy = f"add --bounds {key}=LOW,HIGH, or --set {key}=..."
        raise SceneError([f"{option}: starts at 0, so its magnitude is unknown; {remedy}"])
    return Parameter(key, value, low, high, scale)


def _look_up(option: str, data: Any, path: Key) -> Any:
    """Return the value of a key; raise a SceneError if it does not exist."""
    for part in path or ("",):
        indices = range(len(data)) if isinstance(data, list) else ()
        known = list(data) if isinstance(data, dict) else [str(n) for n in indices]
        if str(part) not in known:
            suggestion = did_you_mean(str(part), known) or (f"; take one of {', '.join(known)}" if known else "")
            raise SceneError([f"{option}: the scene has no {str(part) or 'such key'} there{suggestion}"])
        data = data[part if isinstance(data, list) else str(part)]
    return data


def _is_fittable(path: Key, value: Any) -> bool:
    """Return whether a value of a scene is a number that can be free."""
    key = ".".join(map(str, path))
    is_in_section = any(f"{key}.".startswith(f"{section}.") for section in SECTIONS)
    return is_in_section and isinstance(value, float) and not any(part in FIXED_KEYS for part in path)


def _numbers_below(path: Key, value: Any) -> Iterator[str]:
    """Yield the keys of the numbers of a section or list that can be free."""
    if _is_fittable(path, value):
        yield ".".join(map(str, path))
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for part, item in items:
        yield from _numbers_below((*path, part), item)


def _is_coordinate(path: Key) -> bool:
    """Return whether a number is a coordinate, a time or a percentage, which is fitted linearly."""
    return path[-1] not in ("fx", "fy") if path[0] == "render" else any(part in COORDINATE_KEYS for part in path)


def _default_range(scene: Scene, path: Key) -> float:
    time, last = scene.time.duration, path[-1]
    if path[0] == "render":
        if last in ("cx", "cy"):
            return float(scene.render.size[last == "cy"])
        # Degrees, coefficients and directions have a range of 1.
        has_unit_range = any(part in ("fov", "distortion", "rotation", "up") for part in path[2:])
        return 1.0 if has_unit_range else rest_of(scene.sheet).extent
    if "offset" in path:
        return 1.0
    if "load" in path:
        return 100.0 if last == 1 else time
    if "path" in path:
        # A keyframe is [t, across, down, height].
        return (time, 1.0, 1.0, 0.1 * rest_of(scene.sheet).extent)[int(last)]
    # `at` is a position, or a list of keyframes [t, across, down].
    return time if len(path) == 5 and last == 0 else 1.0


def as_data(scene: Scene) -> dict[str, Any]:
    """Convert a scene to data, with defaults."""
    return scene.model_dump(mode="json", exclude_none=True)


def with_values(data: dict[str, Any], values: Mapping[str, float]) -> dict[str, Any]:
    """Return a copy of a scene's data, from `as_data`, with other values by key, except depths of contact."""
    changed = deepcopy(data)
    for key, value in values.items():
        *parts, last = parse_key(key)
        if key.partition(".")[0] != "contact":
            container: Any = changed
            for part in parts:
                container = container[part if isinstance(container, list) else str(part)]
            container[last if isinstance(container, list) else str(last)] = value
    return changed


class Method(TypedDict, total=False):
    """Options of `fit`."""

    sigma: float | None
    robust: bool
    profile: bool
    correlation: float | None
    drift: float | None
    resolution: int | None
    columns: Sequence[str] | None
    sheet: str | None
    block: int | None
    window: tuple[float, float] | None
    rate: float | None
    contact: Sequence[float] | None
    force_offset: Sequence[float] | None


class Request(NamedTuple):
    """Arguments of `fit` but the observed data, as documented there."""

    scene: Scene
    free: Sequence[str]
    bounds: Mapping[str, Bounds]
    forces: tuple[str | Path, float] | None
    method: Method


def require_types(observed: Any, free: Any, method: Mapping[str, Any], **others: Any) -> None:
    """Raise an ArgumentError for the first argument of `fit` of a wrong type, or for an unknown option."""
    known = Method.__annotations__
    if unknown := sorted(set(method) - set(known)):
        raise ArgumentError(f"{unknown[0]}: unknown; take {', '.join(known)}{did_you_mean(unknown[0], known)}")
    optional = {name: value for name, value in (others | dict(method)).items() if value is not None}
    for name, value in {"observed": observed, "free": free, **optional}.items():
        fits, expected = _TYPES[name]
        if not fits(value):
            raise ArgumentError(f"{name}: {value!r}; take {expected}")


Check = Callable[[Any], bool]


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_path(value: Any) -> bool:
    return isinstance(value, (str, Path)) and "\0" not in str(value)


def _is_list(item: Check) -> Check:
    return lambda value: isinstance(value, Sequence) and not isinstance(value, str) and all(map(item, value))


def _is_pair(first: Check) -> Check:
    return lambda value: isinstance(value, Sequence) and len(value) == 2 and first(value[0]) and _is_number(value[1])


def _is_observed(value: Any) -> bool:
    return _is_path(value) or isinstance(value, Mapping) or _is_list(_is_path)(value)


def _is_bounds(value: Any) -> bool:
    return isinstance(value, Mapping) and all(map(_is_pair(_is_number), value.values()))


# Check and description of each argument.
_TYPES: dict[str, tuple[Check, str]] = {
    "observed": (_is_observed, "the path of an .npz file or of a table, a list of tables, or a mapping of arrays"),
    "free": (_is_list(_is_text), "a list of keys, such as ['tissue.young']"),
    "bounds": (_is_bounds, "a mapping of keys to two numbers each, such as {'tissue.young': (5e3, 1e5)}"),
    "forces": (
        _is_pair(_is_path),
        "a forces.csv and the standard deviation of its forces, such as ('forces.csv', 0.01)",
    ),
    "directory": (_is_path, "a path, or None"),
    "workers": (
        lambda value: _is_whole(value) and 1 <= value <= MAX_WORKERS,
        f"a whole number, 1 to {MAX_WORKERS}, or None",
    ),
    "sigma": (_is_number, "a number, or None"),
    "robust": (lambda value: isinstance(value, bool), "True or False"),
    "profile": (lambda value: isinstance(value, bool), "True or False"),
    "correlation": (_is_number, "a number of pixels, or None"),
    "drift": (_is_number, "a number of seconds, or None"),
    "resolution": (_is_whole, "a whole number, or None"),
    "columns": (_is_list(_is_text), "a list such as ['depth=Traverse, mm']"),
    "sheet": (_is_text, "the name of a sheet, or None"),
    "block": (_is_whole, "a whole number from 1, or None"),
    "window": (_is_pair(_is_number), "the first and the last time in seconds, such as (0.5, 12)"),
    "rate": (_is_number, "a number of frames per second, or None"),
    "contact": (_is_list(_is_number), "a list of depths in metres, such as [0.002]"),
    "force_offset": (_is_list(_is_number), "a list of forces in newtons, such as [0.05]"),
}
