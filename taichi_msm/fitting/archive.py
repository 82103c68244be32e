"""Reader of observed points from an .npz or a mapping of arrays.

The arrays are `time` [s], shape (T,); `coordinates`, across and down as fractions of the sheet, shape (N, 2); and
`position` [m], shape (N, T, 3), or `pixel` [px], shape (N, T, 2), NaN where not observed; optionally `sigma`, the
standard deviation of their errors. A run's trajectory.npz and tracks.npz are accepted too.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError, as_array, did_you_mean
from taichi_msm.fitting.points import Pixels, PointObservation, Positions
from taichi_msm.images import irregular_kind
from taichi_msm.scene.section import MAX_MAGNITUDE
from taichi_msm.system.process import available_memory

Arrays = dict[str, NDArray[Any]]

NEEDS = "time (T,), coordinates (N, 2) and position (N, T, 3) or pixel (N, T, 2)"
MEMBERS = ("time", "coordinates", "position", "pixel", "sigma", "points", "occluded", "visible")

# Parts of array names that suggest that the array must not be ignored.
SUGGESTIVE_PARTS = re.compile("visib|occlu|mask|valid|missing|lost|status|score|weight|confid|sigma|std|unit|scale")

KINDS: dict[str, type[PointObservation]] = {"position": Positions, "pixel": Pixels}


def read_observations(observed: str | Path | Mapping[str, Any], rate: float) -> PointObservation:
    """Return the observed points of a file or mapping; `rate`: frames per second, for the times of a tracks.npz."""
    if isinstance(observed, Mapping):
        name, names = "observed", [str(key) for key in observed]
        _require_supported(name, names)
        # Masked numbers are not observed.
        filled = (np.ma.filled(1.0 * value, np.nan) if np.ma.isMA(value) else value for value in observed.values())
        arrays = {key: as_array(value, key) for key, value in zip(names, filled, strict=True)}
    else:
        name = str(observed)
        arrays, names = _read_archive(name)
    is_mesh = "coordinates" not in arrays
    arrays = _convert_trajectory(_apply_masks(name, arrays, rate))
    kinds = [kind for kind in KINDS if kind in arrays]
    missing = [key for key in ("time", "coordinates") if key not in arrays]
    if missing := missing + ([] if kinds else ["position or pixel"]):
        listed = ", ".join(map(ascii, names[:20])) or "nothing"
        suggestion = did_you_mean(missing[0].partition(" ")[0], names).replace("; did you mean", "; is it")
        raise SceneError([f"{name}: {missing[0]}: missing; expected {NEEDS}, and it has {listed}{suggestion}"])
    if len(kinds) == 2:
        raise SceneError([f"{name}: has both position and pixel; leave one of them out"])
    observation = replace(_build_observation(name, arrays, kinds[0]), is_mesh=is_mesh)
    return observation.with_sigma(arrays.get("sigma"))


def _build_observation(name: str, arrays: Arrays, kind: str) -> PointObservation:
    """Validate arrays; return the observation without sigma."""
    for key in ("time", "coordinates", kind):
        if arrays[key].dtype.kind not in "fiu":
            raise SceneError([f"{name}: {key}: {arrays[key].dtype} is not numeric; expected {NEEDS}"])
    time, coordinates, values = (np.asarray(arrays[key], np.float64) for key in ("time", "coordinates", kind))
    size = 3 if kind == "position" else 2
    points, times = len(coordinates) if coordinates.ndim else 0, len(time) if time.ndim else 0
    expected = {"time": (times,), "coordinates": (points, 2), kind: (points, times, size)}
    for key, shape in expected.items():
        if (actual := arrays[key].shape) != shape or 0 in shape:
            remedy = f"expected {NEEDS}"
            if key == kind and actual == (times, points, size):
                remedy = f"the points come first: take {key}.swapaxes(0, 1)"
            raise SceneError([f"{name}: {key}: shape {actual}; {remedy}"])
    if not np.isfinite(time).all():
        raise SceneError([f"{name}: time: contains NaN or infinity; give all T times in seconds"])
    if not ((coordinates >= 0) & (coordinates <= 1)).all():
        message = "give across and down as fractions of the sheet, 0 to 1, from its upper left corner"
        raise SceneError([f"{name}: coordinates: {coordinates.flat[np.abs(coordinates - 0.5).argmax()]:g}; {message}"])
    # Points with a missing coordinate are not observed.
    values = np.where(np.isfinite(values).all(axis=2, keepdims=True), values, np.nan)
    if not np.isfinite(values).any():
        fault = f"all {points} points are NaN or occluded at all {times} times; observe at least one"
        raise SceneError([f"{name}: {fault}"])
    if (largest := np.nanmax(np.abs(values))) > MAX_MAGNITUDE:
        raise SceneError([f"{name}: {kind}: {largest:g}; take NaN where not observed"])
    return KINDS[kind](name, time, values, None, coordinates)


def _apply_masks(name: str, arrays: Arrays, rate: float) -> Arrays:
    """Apply the masks `visible` and `occluded`, and rename the `points` of a tracks.npz to `pixel`."""
    arrays = dict(arrays)
    flags = {key: arrays.pop(key) for key in ("visible", "occluded") if key in arrays}
    key = next((key for key in ("points", *KINDS) if key in arrays), "points")
    for flag, array in flags.items():
        shape = arrays[key].shape[:2] if key in arrays else ()
        if array.shape != shape or array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
            fault = f"{array.dtype} of shape {array.shape}; take true or false for every point and time of {key}"
            raise SceneError([f"{name}: {flag}: {fault}, shape (N, T)"])
        if arrays[key].dtype.kind in "fiu" and arrays[key].ndim == 3:
            arrays[key] = np.where((array != (flag == "visible"))[..., None], np.nan, arrays[key])
    if flags and key == "points":
        tracks = {"pixel": arrays["points"], "time": np.arange(arrays["points"].shape[1]) / rate}
        return tracks | {kept: arrays[kept] for kept in ("time", "coordinates") if kept in arrays}
    return arrays


def _convert_trajectory(arrays: Arrays) -> Arrays:
    """Convert the arrays of a trajectory.npz, with at most 64 points per side; coordinates are (u, v)."""
    position = arrays.get("position")
    if position is None or position.ndim != 4 or min(position.shape[:3]) == 0 or "coordinates" in arrays:
        return arrays
    rows, cols = (np.unique(np.linspace(0, n - 1, min(n, 64)).round().astype(int)) for n in position.shape[1:3])
    heights, widths = rows / max(position.shape[1] - 1, 1), cols / max(position.shape[2] - 1, 1)
    down, across = np.meshgrid(heights, widths, indexing="ij")
    thinned = position[:, rows[:, None], cols].reshape(len(position), len(rows) * len(cols), position.shape[3])
    coordinates = np.stack([across.ravel(), down.ravel()], axis=1)
    return {**arrays, "coordinates": coordinates, "position": thinned.swapaxes(0, 1)}


def _read_archive(name: str) -> tuple[Arrays, list[str]]:
    """Return the supported arrays of an .npz, and the names of all its arrays."""
    path, remedy = Path(name), f"name an .npz with {NEEDS}, or a run's trajectory.npz or tracks.npz"
    try:
        if kind := irregular_kind(path):
            raise SceneError([f"{name}: {'a folder' if path.is_dir() else kind}; {remedy}"])
        with path.open("rb") as file:
            signature = file.read(6)
        if signature.startswith(b"PK"):
            with zipfile.ZipFile(path) as archive:
                return _read_members(name, archive)
        reason = "a single array, as np.save writes" if signature == b"\x93NUMPY" else "not an .npz"
    except FileNotFoundError:
        reason = "no such file"
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
    except (ValueError, NotImplementedError, zipfile.BadZipFile):
        reason = "not an .npz"
    raise SceneError([f"{name}: {reason}; {remedy}"])


def _require_supported(name: str, keys: list[str]) -> None:
    """Raise a SceneError about arrays that are not supported, but whose names suggest observations."""
    ignored = [key for key in keys if key not in MEMBERS and SUGGESTIVE_PARTS.search(key.lower())]
    if ignored:
        fault = "not supported; take NaN, visible or occluded (N, T) for missing points, and sigma for errors"
        raise SceneError([f"{name}: {', '.join(map(ascii, ignored))}: {fault}"])


def _read_members(name: str, archive: zipfile.ZipFile) -> tuple[Arrays, list[str]]:
    infos = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    _require_supported(name, list(infos))
    members = {key: info for key, info in infos.items() if key in MEMBERS}
    if (size := sum(info.file_size for info in members.values())) > (limit := available_memory() // 4):
        fault = f"{size / 1e9:.1f} GB of arrays, but memory for {limit / 1e9:.1f} GB; leave some points out"
        raise SceneError([f"{name}: {fault}"])
    arrays = {}
    for key, info in members.items():
        try:
            with archive.open(info) as member:
                arrays[key] = np.lib.format.read_array(member, allow_pickle=False)
        except Exception as error:  # Errors of zipfile, its decompressors and NumPy are of any kind.
            reason = "cannot be read: " + (str(error).partition("\n")[0] or type(error).__name__)
            if "Object arrays" in reason:
                reason = "an array of Python objects"
            raise SceneError([f"{name}: {key}: {reason}; write it again by np.savez, as numbers"]) from None
    return arrays, list(infos)
