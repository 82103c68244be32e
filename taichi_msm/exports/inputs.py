"""What all formats for surfaces share: the picture of a run, its normals, and the names of its frames.

The tracked points of a run, read without trusting the file.

A camera that other programs can compute with, from what a run has written of it.
"""

from __future__ import annotations

import io
import json
import zipfile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import ArgumentError
from taichi_msm.exports.formats import ANY_CAMERA, FORMATS
from taichi_msm.render.texture import load_texture
from taichi_msm.runs.arrays import read_rows
from taichi_msm.runs.finished import FinishedRun, damaged_result, reading
from taichi_msm.scene.outputs import CAMERA
from taichi_msm.system.files import read_regular

# The vertices are the mass points, and cells are cut as in the picture. The surface between mass points is bilinear, so
# more vertices would add nothing about the motion.
EXPORT_REFINE = 0

PICTURE_FILE = "picture.png"


def picture_png(run: FinishedRun) -> bytes | None:
    """Encode the picture on the sheet, cut to the scene's region; None if none is named, a SceneError if unusable."""
    if run.scene.image is None:
        return None
    file = io.BytesIO()
    Image.fromarray(load_texture(run.scene, run.sha256.get("image", ""))).save(file, "PNG")
    return file.getvalue()


def unit_normals(position: NDArray[np.floating]) -> NDArray[np.float64]:
    """Give unit normals of points at `position`, shape (rows, cols, 3), the same as for the light in pictures.

    They come from central differences, at edges from one-sided ones, have shape (rows cols, 3), and are toward the
    viewer at rest, along z where a fold leaves none.
    """
    place = position.astype(np.float64)
    normal = np.cross(np.gradient(place, axis=1), -np.gradient(place, axis=0)).reshape(-1, 3)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.divide(normal, length, out=np.tile([0.0, 0.0, 1.0], (len(normal), 1)), where=length > 0)


def read_tracks(run: FinishedRun) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Read where each point is [px], shape (tracks, frames, 2), and whether it is hidden, shape (tracks, frames).

    A point behind the eye has no place in the picture's plane: it is hidden and NaN.
    """
    path = run.result_path("tracks")
    with reading(path), zipfile.ZipFile(path) as archive:
        points = read_rows(archive, "points", np.float32, (run.frames, 2))
        occluded = read_rows(archive, "occluded", np.bool_, (run.frames,))
    somewhere = np.isfinite(points).all(axis=-1)
    if points.shape[:2] != occluded.shape or not (somewhere | occluded).all():
        raise damaged_result(path)
    return np.where(somewhere[..., None], points, np.float32(np.nan)), occluded


def read_track_positions(run: FinishedRun) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read the points' coordinates on the sheet, shape (tracks, 2), and where they are [m], (tracks, frames, 3)."""
    path = run.result_path("tracks")
    with reading(path), zipfile.ZipFile(path) as archive:
        coordinates = read_rows(archive, "coordinates", np.float32, (2,))
        position = read_rows(archive, "position", np.float32, (run.frames, 3))
        tracks, _ = read_rows(archive, "occluded", np.bool_, (run.frames,)).shape
    if not len(coordinates) == len(position) == tracks or not np.isfinite(position).all():
        raise damaged_result(path)
    return coordinates, position


Array = NDArray[np.float64]

# OpenCV counts from the centre of the first pixel, this program from the picture's corner.
FIRST_PIXEL_CENTRE = 0.5

# The largest camera.json that is read [bytes]: of 100,000 poses.
MAX_CAMERA_BYTES = 1 << 25


class Pinhole(NamedTuple):
    """A pinhole camera without distortion, in OpenCV's axes: x right, y down, z forward."""

    focal: Array  # along x and y [px], shape (2,)
    centre: Array  # the principal point, from the picture's upper left corner [px], shape (2,)
    poses: Array  # from the world to the camera [m], of every frame, shape (frames, 3, 4)


def read_pinhole(run: FinishedRun, name: str) -> Pinhole:
    """Read the camera of a run for a format.

    Args:
        run: the run, as the camera has seen it.
        name: the format.

    Returns:
        The camera.

    Raises:
        FilesError: when there is none.
        ArgumentError: when the format cannot describe it.
    """
    path = run.directory / run.camera / CAMERA
    another = "choose another camera by --camera, or " if FORMATS[name].cameras == ANY_CAMERA else ""
    with reading(path):
        described = json.loads(read_regular(run.require_own_file(path, "tracks"), MAX_CAMERA_BYTES))
        # A fisheye is one with any coefficients.
        is_distorted = described.get("model") == "fisheye" or bool(np.any(described.get("distortion", ())))
        is_pinhole = "intrinsics" in described
    if not is_pinhole:
        said = f"{name} needs a pinhole, and {path} has none"
        raise ArgumentError(f"{said}; {another}run the scene with one that has perspective")
    if is_distorted:
        said = f"{path}: the camera has a distortion, which {name} cannot describe"
        raise ArgumentError(f"{said}; {another}run the scene without it")
    with reading(path):
        matrix = np.array(described["intrinsics"], float)
        poses = np.array(described.get("poses", [described["pose"]] * run.frames), float)[: run.frames]
        if matrix.shape != (3, 3) or poses.shape != (run.frames, 3, 4) or not np.isfinite(poses).all():
            raise damaged_result(path)
        focal, centre = matrix[[0, 1], [0, 1]], matrix[:2, 2]
        if not (np.isfinite(matrix).all() and (focal > 0).all()):
            raise damaged_result(path)
    return Pinhole(focal, centre, poses)
