"""Parameters of a fit: their keys, scales and bounds, and the types of the arguments of `fit`.

A number of unknown magnitude, such as a stiffness or a force, is fitted as the logarithm of its magnitude: its sign is
fixed, and all such parameters change by the same share. Other numbers, and those that start at 0, are fitted linearly,
in units of their range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from taichi_msm.errors import MAX_WORKERS, ArgumentError, Key, SceneError, did_you_mean
from taichi_msm.load.scene_file import parse_key
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]

# Sections with fittable numbers, and keys in them that are choices, array sizes or without effect on the tissue.
SECTIONS = ("tissue", "springs", "damping", "sheet", "probes", "render.camera", "render.cameras")
FIXED_KEYS = ("tolerance", "grip", "shaft", "points")

# Keys of coordinates and times, which are fitted linearly, as are all numbers of a camera except focal lengths.
COORDINATE_KEYS = ("at", "path", "offset", "load")
FOCAL_LENGTH_KEYS = ("fx", "fy")

# Camera keys with a range of 1: degrees, coefficients and directions.
UNIT_RANGE_KEYS = ("fov", "distortion", "rotation", "up")

# Bound of the log of a parameter without bounds: a factor of 1000 from the start.
MAX_LOG = math.log(1000)

MAPS = ("map", "foundation_map")

Bounds = tuple[float, float]


def rounded(number: float) -> str:
    """Format a number with two digits."""
    return f"{float(f'{number:.2g}'):g}"


@dataclass(frozen=True)
class Parameter:
    """Fitted number of the scene, with the coordinate x, 0 at the start."""

    key: str  # its dotted path
    start: float
    low: float  # the smallest value allowed; -inf: any
    high: float
    scale: float  # x = (value - start) / scale; 0: x = log(value / start)

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
        return (
            math.log(shares[0]) if shares[0] > 0 else -MAX_LOG,
            math.log(shares[1]) if shares[1] < math.inf else MAX_LOG,
        )

    def error(self, x: float, deviation: float) -> float:
        """Return the standard deviation of the value for that of x."""
        return deviation * (abs(self.value(x)) if self.is_log else self.scale)

    def share(self, x: float, deviation: float) -> float:
        """Return a standard deviation of x as a share of the value, or of a coordinate's range."""
        if self.is_log:
            return deviation
        natural = self.scale if _is_place(self.path) else abs(self.value(x))
        return deviation * self.scale / natural if natural else math.inf


def make_parameters(scene: Scene, free: Sequence[str], bounds: Mapping[str, Bounds]) -> tuple[Parameter, ...]:
    """Build the parameters of the keys in `free`, with their bounds; SceneError: lists all faults."""
    data, faults, parameters = as_data(scene), [], []
    if not free:
        faults.append("--free: names no key; take one or more, such as --free tissue.young")
    for key in free:
        try:
            parameters.append(_parameter(scene, data, key, bounds.get(key)))
        except SceneError as error:
            faults += error.lines
    for key in bounds:
        if key not in free:
            faults.append(f"--bounds {key}: not among --free{did_you_mean(key, free) or '; name it there too'}")
    if faults:
        raise SceneError(faults)
    return tuple(parameters)


def _parameter(scene: Scene, data: dict[str, Any], key: str, bounds: Bounds | None) -> Parameter:
    path = parse_key(key)
    named = f"--free {key}"
    if path and path[-1] in MAPS:
        raise SceneError(
            [f"{named}: of maps only tissue.map is fitted; name numbers, such as {scene.kind}.{path[-1]}.range.1"]
        )
    value = _look_up(named, data, path)
    inside = any(key == section or key.startswith(f"{section}.") for section in SECTIONS)
    if not inside or not isinstance(value, float) or any(part in FIXED_KEYS for part in path):
        if isinstance(value, list):
            raise SceneError([f"{named}: a list; name one of its numbers by its index, such as {key}.0"])
        what = "a section" if isinstance(value, dict) else f"{value!r}"
        raise SceneError([f"{named}: {what}, which cannot be free; take a number of {', '.join(SECTIONS)}"])
    low, high = bounds or (-math.inf, math.inf)
    if not low < high:
        raise SceneError([f"--bounds {key}={low:g},{high:g}: give the smaller one first, then a larger one"])
    if not low <= value <= high:
        raise SceneError([f"--bounds {key}={low:g},{high:g}: {value:g}, where it starts, is outside; --set {key}=..."])
    scale = 0.0
    if value == 0 or _is_place(path):
        if math.isfinite(high - low):
            scale = high - low
        elif _is_place(path):
            scale = _natural(scene, path)
        else:
            raise SceneError(
                [f"{named}: starts at 0, so its size is open; add --bounds {key}=LOW,HIGH, or --set {key}=..."]
            )
    return Parameter(key, value, low, high, scale)


def _look_up(named: str, data: Any, path: Key) -> Any:
    """Return the value of a key; SceneError: it does not exist."""
    for part in path or ("",):
        known = (
            list(data) if isinstance(data, dict) else [str(n) for n in range(len(data))] if type(data) is list else []
        )
        if str(part) not in known:
            near = did_you_mean(str(part), known) or (f"; take one of {', '.join(known)}" if known else "")
            raise SceneError([f"{named}: the scene has no {str(part) or 'such key'} there{near}"])
        data = data[part if isinstance(data, list) else str(part)]
    return data


def _is_place(path: Key) -> bool:
    """Return whether a number is a coordinate, a time or a percentage, which may change sign."""
    return path[-1] not in FOCAL_LENGTH_KEYS if path[0] == "render" else any(part in COORDINATE_KEYS for part in path)


def _natural(scene: Scene, path: Key) -> float:
    """Return the range of a coordinate without bounds."""
    time, last = scene.time.duration, path[-1]
    if path[0] == "render":
        if last in ("cx", "cy"):
            return float(scene.render.size[last == "cy"])
        return 1.0 if any(part in UNIT_RANGE_KEYS for part in path[2:]) else max(scene.sheet.size)
    if "offset" in path:
        return 1.0
    if "load" in path:
        return 100.0 if last == 1 else time
    if "path" in path:
        return (time, 1.0, 1.0, 0.1 * max(scene.sheet.size))[int(last)]
    # Of `at`, which may have a time before the place.
    return time if len(path) == 5 and last == 0 else 1.0


def as_data(scene: Scene) -> dict[str, Any]:
    """Return a scene as plain data, with defaults."""
    return scene.model_dump(mode="json", exclude_none=True)


def with_values(data: dict[str, Any], parameters: Sequence[Parameter], values: Sequence[float]) -> dict[str, Any]:
    """Return the data of a scene with the values of parameters."""
    changed = deepcopy(data)
    for parameter, value in zip(parameters, values, strict=True):
        holder: Any = changed
        for part in parameter.path[:-1]:
            holder = holder[part if isinstance(holder, list) else str(part)]
        last = parameter.path[-1]
        holder[last if isinstance(holder, list) else str(last)] = value
    return changed


class Method(TypedDict, total=False):
    """Options of `fit`."""

    sigma: float | None
    robust: bool
    profile: bool
    correlation: float | None
    drift: float | None
    resolution: int | None


def require_types(observed: Any, free: Any, method: Mapping[str, Any], **others: Any) -> None:
    """Check the types of the arguments of `fit`; ArgumentError: names the first fault."""
    known = Method.__annotations__
    if unknown := sorted(set(method) - set(known)):
        raise ArgumentError(f"{unknown[0]}: unknown; take {', '.join(known)}{did_you_mean(unknown[0], known)}")
    optional = {name: value for name, value in (others | dict(method)).items() if value is not None}
    for name, value in {"observed": observed, "free": free, **optional}.items():
        fits, expected = _TYPES[name]
        if not fits(value):
            raise ArgumentError(f"{name}: {value!r}; take {expected}")


def _is_number(value: Any, kind: type = Real) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)


def _is_path(value: Any) -> bool:
    return isinstance(value, (str, Path)) and "\0" not in str(value)


def _is_pair(value: Any, first: Callable[[Any], bool]) -> bool:
    return isinstance(value, Sequence) and len(value) == 2 and first(value[0]) and _is_number(value[1])


# Check and description of each argument.
_TYPES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "observed": (
        lambda it: _is_path(it) or isinstance(it, Mapping),
        "the path of an .npz file, or a mapping of arrays",
    ),
    "free": (
        lambda it: isinstance(it, Sequence) and not isinstance(it, str) and all(isinstance(key, str) for key in it),
        "a list of keys, such as ['tissue.young']",
    ),
    "bounds": (
        lambda it: isinstance(it, Mapping) and all(_is_pair(ends, _is_number) for ends in it.values()),
        "a mapping of keys to two numbers each, such as {'tissue.young': (5e3, 1e5)}",
    ),
    "forces": (
        lambda it: _is_pair(it, _is_path),
        "a forces.csv and the standard deviation of its forces, such as ('forces.csv', 0.01)",
    ),
    "directory": (_is_path, "a path, or None"),
    "workers": (
        lambda it: _is_number(it, Integral) and 1 <= it <= MAX_WORKERS,
        f"a whole number, 1 to {MAX_WORKERS}, or None",
    ),
    "sigma": (_is_number, "a number, or None"),
    "correlation": (_is_number, "a number of pixels, or None"),
    "drift": (_is_number, "a number of seconds, or None"),
    "resolution": (lambda it: _is_number(it, Integral), "a whole number, or None"),
    **dict.fromkeys(("robust", "profile"), (lambda it: isinstance(it, bool), "True or False")),
}
