"""What was seen of a tissue: where some of its points were at some times, and the forces of tools.

An .npz file has `time` (T,) [s], `coordinates` (N, 2), across and down, and `position` (N, T, 3) [m] or `pixel`
(N, T, 2) [px], NaN where not seen, and may have `sigma`, the standard deviation of each number's error. A
trajectory.npz and a tracks.npz of a run are taken as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arguments import as_array
from taichi_msm.errors import SceneError
from taichi_msm.faults import LARGEST, SMALLEST
from taichi_msm.fitting.archive import NEEDS, read_archive, require_understood

Array = NDArray[np.float64]

# A trajectory is thinned out to so many points a side.
MOST_A_SIDE = 64


@dataclass(frozen=True, eq=False)
class Forces:
    """Forces of tools on the sheet, as in a forces.csv."""

    name: str  # of the file, in messages
    time: Array  # of every row [s], shape (rows,)
    probe: NDArray[np.intp]  # whose it is, shape (rows,)
    force: Array  # [N], shape (rows, 3); NaN: not measured
    sigma: float  # standard deviation of each component's error [N]


@dataclass(frozen=True, eq=False)
class Observations:
    """Where points were at some times, with NaN where that is not known."""

    name: str  # of the file, in messages
    kind: Literal["position", "pixel"]
    time: Array  # [s], shape (T,)
    coordinates: Array  # across and down as fractions of the sheet, shape (N, 2)
    values: Array  # [m] or [px], shape (N, T, 3 or 2)
    sigma: float | None  # standard deviation of each number's error [m] or [px]; None: not known
    forces: Forces | None = None

    @property
    def unit(self) -> str:
        """Of the values and of sigma."""
        return "m" if self.kind == "position" else "px"

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which values are known, of the shape of the values."""
        return np.isfinite(self.values)

    @property
    def there(self) -> NDArray[np.bool_]:
        """Which points were seen at which times, shape (N, T)."""
        return self.known[..., 0]


def read_observations(observed: str | Path | Mapping[str, Any], rate: float) -> Observations:
    """Read what was seen from a file, or take it from a mapping of such arrays.

    rate: the scene's frames per second, which tell the times of a tracks.npz.

    Raises a SceneError when it cannot be used by itself, whatever the scene is.
    """
    if isinstance(observed, Mapping):
        filled = {
            key: np.ma.filled(1.0 * value, np.nan) if np.ma.isMA(value) else value for key, value in observed.items()
        }
        require_understood("observed", [str(key) for key in filled])
        return _checked("observed", {str(key): as_array(value, str(key)) for key, value in filled.items()}, rate)
    return _checked(str(observed), read_archive(str(observed)), rate)


def with_sigma(seen: Observations, sigma: Any) -> Observations:
    """Give the errors another standard deviation, unless that is None; SceneError: it is none."""
    if sigma is None:
        return seen
    array = np.asarray(sigma)
    is_number = array.dtype.kind in "fiu" and array.size == 1
    if not (is_number and SMALLEST <= (value := float(array.ravel()[0])) <= LARGEST):
        shown = f"{value:g}" if is_number else f"{array.dtype} of shape {array.shape}"
        said = f"take one number above 0, the standard deviation of the errors [{seen.unit}], or leave it out"
        raise SceneError([f"{seen.name}: sigma: {shown}; {said}"])
    return replace(seen, sigma=value)


def _checked(name: str, arrays: dict[str, NDArray[Any]], rate: float) -> Observations:
    """Make observations of arrays; SceneError: they are none."""
    found, arrays = ", ".join(arrays) or "nothing", _thinned(_hidden(name, arrays, rate))
    kinds = [kind for kind in ("position", "pixel") if kind in arrays]
    missing = [key for key in ("time", "coordinates") if key not in arrays]
    if missing := missing + ([] if kinds else ["position or pixel"]):
        raise SceneError([f"{name}: {missing[0]}: missing; expected {NEEDS}, and it has {found}"])
    if len(kinds) == 2:
        raise SceneError([f"{name}: has both position and pixel; leave one of them out"])
    kind: Literal["position", "pixel"] = "position" if kinds[0] == "position" else "pixel"
    for key in ("time", "coordinates", kind):
        if arrays[key].dtype.kind not in "fiu":
            raise SceneError([f"{name}: {key}: {arrays[key].dtype} is no number; expected {NEEDS}"])
    time, coordinates, values = (np.asarray(arrays[key], np.float64) for key in ("time", "coordinates", kind))
    size = 3 if kind == "position" else 2
    points, times = len(coordinates) if coordinates.ndim else 0, len(time) if time.ndim else 0
    expected = {"time": (times,), "coordinates": (points, 2), kind: (points, times, size)}
    for key, array in (("time", time), ("coordinates", coordinates), (kind, values)):
        if array.shape != expected[key] or array.size == 0:
            said = f"{name}: {key}: shape {array.shape}; expected {NEEDS}"
            if key == kind and array.shape == (times, points, size):
                said = f"{name}: {key}: shape {array.shape}; the points come first: take {key}.swapaxes(0, 1)"
            raise SceneError([said])
    if not np.isfinite(time).all():
        raise SceneError([f"{name}: time: holds NaN or infinity; give the time of every column in seconds"])
    if not ((coordinates >= 0) & (coordinates <= 1)).all():
        said = "give across and down as fractions of the sheet, 0 to 1, from its upper left corner"
        raise SceneError([f"{name}: coordinates: {coordinates.flat[np.abs(coordinates - 0.5).argmax()]:g}; {said}"])
    # A point is seen in all its numbers or not at all.
    values = np.where(np.isfinite(values).all(axis=2, keepdims=True), values, np.nan)
    if not np.isfinite(values).any():
        why = "is NaN or occluded"
        raise SceneError([f"{name}: every one of the {points} points {why} at all {times} times; nothing was seen"])
    if (most := np.nanmax(np.abs(values))) > LARGEST:
        raise SceneError([f"{name}: {kind}: {most:g}; take NaN for what was not seen"])
    return with_sigma(Observations(name, kind, time, coordinates, values, None), arrays.get("sigma"))


def _hidden(name: str, arrays: dict[str, NDArray[Any]], rate: float) -> dict[str, NDArray[Any]]:
    """Put NaN where `visible` or `occluded` says that a point was not seen; `points` of a tracks.npz become pixels."""
    arrays = dict(arrays)
    flags = {key: arrays.pop(key) for key in ("visible", "occluded") if key in arrays}
    key = next((key for key in ("points", "pixel", "position") if key in arrays), "points")
    for flag, array in flags.items():
        shape = arrays[key].shape[:2] if key in arrays else ()
        if array.shape != shape or array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
            said = f"{array.dtype} of shape {array.shape}; take true or false for every point and time (N, T)"
            raise SceneError([f"{name}: {flag}: {said}, as {key} has them"])
        if arrays[key].dtype.kind in "fiu" and arrays[key].ndim == 3:
            arrays[key] = np.where((array != (flag == "visible"))[..., None], np.nan, arrays[key])
    if flags and key == "points":
        arrays = {one: array for one, array in arrays.items() if one in ("time", "coordinates", "points")}
        arrays["pixel"] = arrays.pop("points")
        arrays.setdefault("time", np.arange(arrays["pixel"].shape[1]) / rate)
    return arrays


def _thinned(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Turn the arrays of a trajectory.npz into those of our own files."""
    position = arrays.get("position")
    if position is not None and position.ndim == 4 and min(position.shape[:3]) > 0 and "coordinates" not in arrays:
        rows, cols = (
            np.unique(np.linspace(0, n - 1, min(n, MOST_A_SIDE)).round().astype(int)) for n in position.shape[1:3]
        )
        down, across = np.meshgrid(
            rows / max(position.shape[1] - 1, 1), cols / max(position.shape[2] - 1, 1), indexing="ij"
        )
        thinned = position[:, rows[:, None], cols].reshape(len(position), len(rows) * len(cols), position.shape[3])
        coordinates = np.stack([across.ravel(), down.ravel()], axis=1)
        return {**arrays, "coordinates": coordinates, "position": thinned.swapaxes(0, 1)}
    return arrays
