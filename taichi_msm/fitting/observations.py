"""Observations of a tissue: positions or pixels of points over time, and tool forces.

An .npz file has `time` (T,) [s], `coordinates` (N, 2), across and down, and `position` (N, T, 3) [m] or `pixel`
(N, T, 2) [px], NaN where not observed; optionally `sigma`, the standard deviation of their errors. A run's
trajectory.npz and tracks.npz are accepted too.

`ObservationModel` maps the mass points of a scene to observations: a point on the drawn surface is a weighted mean of
four mass points, moves in a straight line between frames, and is projected by the camera. The first two maps are
linear, with their transposes as adjoints; the derivative of the projection is a central difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError, as_array, did_you_mean
from taichi_msm.fitting.archive import NEEDS, read_archive, require_understood
from taichi_msm.model.surface import surface_weights
from taichi_msm.render.camera import view
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_MAGNITUDE, MIN_MAGNITUDE

Array = NDArray[np.float64]


class ObservationModel:
    """Map from the mass points of a scene to observations, and its adjoint.

    Args:
        scene: the scene, with its camera.
        observations: the observed points and times.
        frames: number of frames, from the first one.
    """

    def __init__(self, scene: Scene, observations: Observations, frames: int) -> None:
        from scipy.sparse import csr_matrix

        self.scene, self._observations = scene, observations
        corners, weights = surface_weights(observations.coordinates, scene.sheet, scene.render.refine)
        number, (rows, cols) = np.arange(len(corners)), scene.sheet.points
        self._surface = csr_matrix((weights.ravel(), (number.repeat(4), corners.ravel())), (len(corners), rows * cols))
        self._time_weights = time_weights(scene, observations.time, frames)

    def points_on_sheet(self, position: Array) -> Array:
        """Interpolate the positions of a frame, shape (rows, cols, 3), at the observed points [m], shape (N, 3)."""
        return np.asarray(self._surface @ position.reshape(-1, 3))

    def interpolate(self, at_frames: Array) -> Array:
        """Interpolate points, shape (frames, N, 3), at the observed times, shape (N, T, 3)."""
        at_times = self._time_weights @ at_frames.reshape(len(at_frames), -1)
        return np.asarray(at_times.reshape(-1, *at_frames.shape[1:]).swapaxes(0, 1))

    def motion(self, at_frames: Array) -> Array:
        """Return the largest displacement of points, shape (frames, N, 3), at each frame [m], shape (frames,)."""
        return np.asarray(
            np.linalg.norm(at_frames - positions_at_rest(self.scene, self._observations), axis=2).max(axis=1)
        )

    def points(self, position: Array) -> Array:
        """Interpolate positions [m], shape (frames, rows, cols, 3), in space and time; returns shape (N, T, 3)."""
        return self.interpolate(np.array([self.points_on_sheet(frame) for frame in position]))

    def observe(self, points: Array) -> Array:
        """Convert points [m], shape (N, T, 3), to observations, shape (N, T, 3 or 2); NaN behind the camera."""
        if self._observations.kind == "position":
            return points
        return project_points(self.scene, points, self._observations.time)

    def backward(self, points: Array, gradient: Array) -> Array:
        """Return the gradient of a loss by the positions of every frame.

        Args:
            points: observed points [m], shape (N, T, 3).
            gradient: by the observations, shape (N, T, 3 or 2).

        Returns:
            Gradient by the positions, shape (frames, rows, cols, 3).
        """
        if self._observations.kind == "pixel":
            steps = 1e-6 * max(self.scene.sheet.size) * np.eye(3)
            changes = ((self.observe(points + step) - self.observe(points - step)) / (2 * step.sum()) for step in steps)
            gradient = np.stack([(gradient * change).sum(axis=-1) for change in changes], axis=-1)
        at_frames = self._time_weights.T @ gradient.swapaxes(0, 1).reshape(gradient.shape[1], -1)
        shape = *self.scene.sheet.points, 3
        return np.array([(self._surface.T @ frame.reshape(-1, 3)).reshape(shape) for frame in at_frames])


def time_in_frames(scene: Scene, time: Array) -> Array:
    """Convert times [s] to frame numbers, rounded to six decimals, so that frames are integers."""
    return np.round(time * scene.time.frames_per_second, 6)


def time_weights(scene: Scene, time: Array, frames: int) -> Any:
    """Return the weights of linear interpolation at times [s] between frames, sparse, shape (T, frames)."""
    from scipy.sparse import csr_matrix

    position, row = time_in_frames(scene, time), np.arange(len(time))
    before = np.clip(np.floor(position), 0, frames - 2).astype(int)
    shares, frame = np.stack([1 - position + before, position - before]), np.stack([before, before + 1])
    return csr_matrix((shares.ravel(), (np.tile(row, 2), frame.ravel())), (len(time), frames))


def positions_at_rest(scene: Scene, observations: Observations) -> Array:
    """Return the rest positions of the observed points [m], shape (N, 3)."""
    height, width = scene.sheet.size
    across, down = observations.coordinates.T
    return np.stack([(across - 0.5) * width, (0.5 - down) * height, np.zeros_like(across)], axis=1)


def project_points(scene: Scene, points: Array, time: Array) -> Array:
    """Project points by the scene's main camera.

    Args:
        scene: has the camera.
        points: positions [m], shape (N, T, 3).
        time: times of the points [s], shape (T,).

    Returns:
        Pixels from the picture's upper left corner, shape (N, T, 2); NaN behind the eye, or beyond the lens.
    """
    return np.stack([view(scene, each).pixels(points[:, n]) for n, each in enumerate(time.tolist())], axis=1)


def observe_at_rest(scene: Scene, observations: Observations) -> Array:
    """Return the observations of a sheet at rest, shape (N, T, 3 or 2)."""
    rest = np.repeat(positions_at_rest(scene, observations)[:, None], len(observations.time), axis=1)
    return rest if observations.kind == "position" else project_points(scene, rest, observations.time)


@dataclass(frozen=True, eq=False)
class Forces:
    """Forces of tools on the sheet, as in a forces.csv, or along the tool's direction, as in machine tests."""

    name: str  # of the file, in messages
    time: Array  # of every row [s], shape (rows,)
    probe: NDArray[np.intp]  # index of the tool, or of the machine test, shape (rows,)
    force: Array  # [N], shape (rows, 3), or (rows, 1) along the tool's direction; NaN: not measured
    sigma: float | Array  # standard deviation of each component's error [N], of all or of each measured one


@dataclass(frozen=True, eq=False)
class Observations:
    """Positions or pixels of points over time, NaN where not observed."""

    name: str  # of the file, in messages
    kind: Literal["position", "pixel"]
    time: Array  # [s], shape (T,)
    coordinates: Array  # across and down as fractions of the sheet, shape (N, 2)
    values: Array  # [m] or [px], shape (N, T, 3 or 2)
    sigma: float | None  # standard deviation of each number's error [m] or [px]; None: not known
    forces: Forces | None = None

    @property
    def unit(self) -> str:
        """Unit of the values and of sigma."""
        return "m" if self.kind == "position" else "px"

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask of the observed values, with their shape."""
        return np.isfinite(self.values)

    @property
    def is_observed(self) -> NDArray[np.bool_]:
        """Mask of the observed points over time, shape (N, T)."""
        return self.known[..., 0]


def read_observations(observed: str | Path | Mapping[str, Any], rate: float) -> Observations:
    """Read observations from a file, or from a mapping of the same arrays.

    Args:
        observed: path of an .npz, or a mapping.
        rate: frames per second of the scene, for a tracks.npz.

    Raises:
        SceneError: when arrays are missing, unknown, or have other shapes.
    """
    if isinstance(observed, Mapping):
        filled = {
            key: np.ma.filled(1.0 * value, np.nan) if np.ma.isMA(value) else value for key, value in observed.items()
        }
        require_understood("observed", names := [str(key) for key in filled])
        arrays = {str(key): as_array(value, str(key)) for key, value in filled.items()}
        return _checked("observed", arrays, names, rate)
    return _checked(str(observed), *read_archive(str(observed)), rate)


def with_sigma(observations: Observations, sigma: Any) -> Observations:
    """Replace sigma [m] or [px] unless it is None; SceneError: not a positive number."""
    if sigma is None:
        return observations
    array = np.asarray(sigma)
    is_number = array.dtype.kind in "fiu" and array.size == 1
    if not (is_number and MIN_MAGNITUDE <= (value := float(array.ravel()[0])) <= MAX_MAGNITUDE):
        shown = f"{value:g}" if is_number else f"{array.dtype} of shape {array.shape}"
        remedy = f"take one number above 0, the standard deviation of the errors [{observations.unit}], or leave it out"
        raise SceneError([f"{observations.name}: sigma: {shown}; {remedy}"])
    return replace(observations, sigma=value)


def _checked(name: str, arrays: dict[str, NDArray[Any]], names: list[str], rate: float) -> Observations:
    """Validate arrays, and build observations; `names`: of all arrays in the source."""
    arrays = _thinned(_masked(name, arrays, rate))
    kinds = [kind for kind in ("position", "pixel") if kind in arrays]
    missing = [key for key in ("time", "coordinates") if key not in arrays]
    if missing := missing + ([] if kinds else ["position or pixel"]):
        found = ", ".join(map(ascii, names[:20])) or "nothing"
        suggestion = did_you_mean(missing[0].partition(" ")[0], names).replace("; did you mean", "; is it")
        raise SceneError([f"{name}: {missing[0]}: missing; expected {NEEDS}, and it has {found}{suggestion}"])
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
            message = f"{name}: {key}: shape {array.shape}; expected {NEEDS}"
            if key == kind and array.shape == (times, points, size):
                message = f"{name}: {key}: shape {array.shape}; the points come first: take {key}.swapaxes(0, 1)"
            raise SceneError([message])
    if not np.isfinite(time).all():
        raise SceneError([f"{name}: time: holds NaN or infinity; give the time of every column in seconds"])
    if not ((coordinates >= 0) & (coordinates <= 1)).all():
        message = "give across and down as fractions of the sheet, 0 to 1, from its upper left corner"
        raise SceneError([f"{name}: coordinates: {coordinates.flat[np.abs(coordinates - 0.5).argmax()]:g}; {message}"])
    # Points with a missing coordinate are not observed.
    values = np.where(np.isfinite(values).all(axis=2, keepdims=True), values, np.nan)
    if not np.isfinite(values).any():
        fault = f"every one of the {points} points is NaN or occluded at all {times} times; there are no observations"
        raise SceneError([f"{name}: {fault}"])
    if (largest := np.nanmax(np.abs(values))) > MAX_MAGNITUDE:
        raise SceneError([f"{name}: {kind}: {largest:g}; take NaN where not observed"])
    return with_sigma(Observations(name, kind, time, coordinates, values, None), arrays.get("sigma"))


def _masked(name: str, arrays: dict[str, NDArray[Any]], rate: float) -> dict[str, NDArray[Any]]:
    """Apply the masks `visible` and `occluded`, and rename the `points` of a tracks.npz to `pixel`."""
    arrays = dict(arrays)
    flags = {key: arrays.pop(key) for key in ("visible", "occluded") if key in arrays}
    key = next((key for key in ("points", "pixel", "position") if key in arrays), "points")
    for flag, array in flags.items():
        shape = arrays[key].shape[:2] if key in arrays else ()
        if array.shape != shape or array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
            fault = f"{array.dtype} of shape {array.shape}; take true or false for every point and time (N, T)"
            raise SceneError([f"{name}: {flag}: {fault}, as {key} has them"])
        if arrays[key].dtype.kind in "fiu" and arrays[key].ndim == 3:
            arrays[key] = np.where((array != (flag == "visible"))[..., None], np.nan, arrays[key])
    if flags and key == "points":
        arrays = {
            array_name: array for array_name, array in arrays.items() if array_name in ("time", "coordinates", "points")
        }
        arrays["pixel"] = arrays.pop("points")
        arrays.setdefault("time", np.arange(arrays["pixel"].shape[1]) / rate)
    return arrays


def _thinned(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Convert the arrays of a trajectory.npz, thinned to at most 64 points per side."""
    position = arrays.get("position")
    if position is not None and position.ndim == 4 and min(position.shape[:3]) > 0 and "coordinates" not in arrays:
        rows, cols = (np.unique(np.linspace(0, n - 1, min(n, 64)).round().astype(int)) for n in position.shape[1:3])
        down, across = np.meshgrid(
            rows / max(position.shape[1] - 1, 1), cols / max(position.shape[2] - 1, 1), indexing="ij"
        )
        thinned = position[:, rows[:, None], cols].reshape(len(position), len(rows) * len(cols), position.shape[3])
        coordinates = np.stack([across.ravel(), down.ravel()], axis=1)
        return {**arrays, "coordinates": coordinates, "position": thinned.swapaxes(0, 1)}
    return arrays
