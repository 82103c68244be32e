"""Inputs shared by the export formats: picture, surface normals, tracks and camera of a run.

Files are validated, as they may come from an untrusted source; all readers raise a FilesError for missing or damaged
results.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.arithmetic import Array
from taichi_msm.errors import ArgumentError
from taichi_msm.exports.formats import ANY_CAMERA, FORMATS
from taichi_msm.model.mask import Mask
from taichi_msm.model.surface import Solid, refine_surface
from taichi_msm.render.camera import view_at
from taichi_msm.render.texture import load_texture
from taichi_msm.runs.arrays import read_flo, read_rows
from taichi_msm.runs.directory import MAX_RECORD_BYTES
from taichi_msm.runs.finished import FinishedRun, damaged_result, reading
from taichi_msm.scene.outputs import CAMERA_FILE
from taichi_msm.system.files import read_regular

# Vertices are the mass points. The surface between them is bilinear: a refinement would add no information.
EXPORT_REFINE = 0

# Enough digits for any float32.
FLOAT32_FORMAT = "%.9g"

PICTURE_FILE = "picture.png"


def picture_png(run: FinishedRun) -> bytes | None:
    """Encode the picture on the sheet, cropped to the scene's region, as PNG; None without a picture.

    A picture that cannot be read or has changed since the run raises a SceneError.
    """
    if run.scene.image is None:
        return None
    return encode_picture(load_texture(run.scene, run.sha256.get("image", "")), "PNG")


def encode_picture(picture: NDArray[np.uint8] | NDArray[np.uint16], format: str, **options: int) -> bytes:  # noqa: A002
    """Return the file of grey values or colours, shape (height, width) or (height, width, 3), in a format of Pillow."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format, **options)
    return file.getvalue()


def mass_points(position: NDArray[np.floating], mask: Mask | None) -> NDArray[np.floating]:
    """Return the positions of the mass points with cells, row by row, shape (n, ...), from (rows, cols, ...)."""
    return position.reshape(-1, *position.shape[2:]) if mask is None else position[mask.points]


def unit_normals(position: NDArray[np.floating], mask: Mask | None = None) -> NDArray[np.float64]:
    """Compute the unit normals of the sheet at its `mass_points`, as used for shading, shape (n, 3).

    Tangents are central differences, one-sided at edges. The normals of the flat sheet are z; a normal that vanishes at
    a fold is replaced by z.
    """
    rows, cols = position.shape[:2]
    cells = np.ones((rows - 1, cols - 1), bool) if mask is None else mask.cells
    # Whether each mass point has a cell to its upper left, and so on; neighbours without a cell between are not used.
    upper, lower = np.pad(cells, ((1, 0), (1, 1))), np.pad(cells, ((0, 1), (1, 1)))
    upper_left, upper_right, lower_left, lower_right = upper[:, :-1], upper[:, 1:], lower[:, :-1], lower[:, 1:]
    i, j = np.indices((rows, cols))
    position = position.astype(np.float64)
    right = position[i, j + (upper_right | lower_right)] - position[i, j - (upper_left | lower_left)]
    up = position[i - (upper_left | upper_right), j] - position[i + (lower_left | lower_right), j]
    normal = mass_points(np.cross(right, up), mask)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.divide(normal, length, out=np.tile([0.0, 0.0, 1.0], (len(normal), 1)), where=length > 0)


def read_tracks(run: FinishedRun) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Read the projected positions of the tracks [px], shape (tracks, frames, 2), and whether they are occluded.

    Behind the camera, positions are NaN and the track is occluded.
    """
    path = run.result_path("tracks")
    with reading(path), zipfile.ZipFile(path) as archive:
        pixels = read_rows(archive, "points", np.float32, (run.frames, 2))
        occluded = read_rows(archive, "occluded", np.bool_, (run.frames,))
    is_finite = np.isfinite(pixels).all(axis=-1)
    if pixels.shape[:2] != occluded.shape or not (is_finite | occluded).all():
        raise damaged_result(path)
    return np.where(is_finite[..., None], pixels, np.float32(np.nan)), occluded


def read_track_positions(run: FinishedRun) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read the material points of the tracks and their positions in space [m], shape (tracks, frames, 3).

    The former are fractions of the sheet's width and height, shape (tracks, 2).
    """
    path = run.result_path("tracks")
    with reading(path), zipfile.ZipFile(path) as archive:
        coordinates = read_rows(archive, "coordinates", np.float32, (2,))
        position = read_rows(archive, "position", np.float32, (run.frames, 3))
        tracks, _ = read_rows(archive, "occluded", np.bool_, (run.frames,)).shape
    if not len(coordinates) == len(position) == tracks or not np.isfinite(position).all():
        raise damaged_result(path)
    return coordinates, position


def read_depth(run: FinishedRun, frame: int) -> NDArray[np.float32]:
    """Return the depth along the optical axis in a frame [m], shape (height, width), 0 on the background."""
    path = run.result_path("depth", frame)
    with reading(path), Image.open(path, formats=["TIFF"]) as image:
        # Checked before decoding, which could take any amount of memory.
        if image.mode != "F" or image.size != run.scene.render.size:
            raise damaged_result(path)
        depth = np.array(image)
        if not (np.isfinite(depth) & (depth >= 0)).all():
            raise damaged_result(path)
    return depth


def read_flow(run: FinishedRun, pair: int) -> NDArray[np.float32]:
    """Return the flow to the right and down [px], shape (height, width, 2), from frame `pair` to the next one."""
    path = run.result_path("flow", pair)
    with reading(path):
        return read_flo(path, run.scene.render.size)


def read_picture_file(run: FinishedRun, key: str, frame: int) -> bytes:
    """Return the content of a picture file of an entry of `output`, which is decoded once for validation."""
    run.read_picture(key, frame)
    path = run.result_path(key, frame)
    with reading(path):
        return read_regular(path, MAX_RECORD_BYTES)


# Coordinate of the first pixel's centre [px]; it is 0 in OpenCV.
FIRST_PIXEL_CENTRE = 0.5


class Pinhole(NamedTuple):
    """Pinhole camera without distortion, in OpenCV's axes: x right, y down, z forward."""

    focal: Array  # focal lengths along x and y [px], shape (2,)
    centre: Array  # principal point, counted from the picture's upper left corner [px], shape (2,)
    poses: Array  # world-to-camera transform of every frame [m], shape (frames, 3, 4)

    @property
    def matrices(self) -> Array:
        """The poses as matrices, shape (frames, 4, 4)."""
        return np.concatenate([self.poses, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(self.poses), 1, 1))], axis=1)


def read_pinhole(run: FinishedRun, name: str) -> Pinhole:
    """Read camera.json for a format that requires a pinhole camera.

    An orthographic camera or one with lens distortion raises an ArgumentError.
    """
    path = run.directory / run.camera / CAMERA_FILE
    with reading(path):
        # The limit of 32 MiB suffices for 100,000 poses.
        camera = json.loads(read_regular(run.require_regular_file(path, FORMATS[name].required_outputs[0]), 1 << 25))
        # Lens models other than pinhole distort even if all coefficients are 0.
        is_distorted = camera.get("model", "pinhole") != "pinhole" or bool(np.any(camera.get("distortion", ())))
        is_pinhole = "intrinsics" in camera
    _require_pinhole(path, name, is_pinhole=is_pinhole, is_distorted=is_distorted)
    with reading(path):
        matrix = np.array(camera["intrinsics"], float)
        poses = np.array(camera.get("poses", [camera["pose"]] * run.frames), float)[: run.frames]
        if matrix.shape != (3, 3) or poses.shape != (run.frames, 3, 4) or not np.isfinite(poses).all():
            raise damaged_result(path)
        focal, centre = matrix[[0, 1], [0, 1]], matrix[:2, 2]
        if not (np.isfinite(matrix).all() and (focal > 0).all()):
            raise damaged_result(path)
    return Pinhole(focal, centre, poses)


def scene_pinhole(run: FinishedRun, name: str) -> Pinhole:
    """Return the camera of a run's scene at its start as `read_pinhole`, for a run without the required outputs."""
    view = view_at(run.scene, 0.0, run.camera)
    _require_pinhole(run.directory / run.camera, name, is_pinhole=view.pinhole, is_distorted=view.lens is not None)
    return Pinhole(view.scale, view.centre, np.zeros((0, 3, 4)))


def _require_pinhole(path: Path, name: str, *, is_pinhole: bool, is_distorted: bool) -> None:
    alternative = "choose another camera by --camera, or " if FORMATS[name].cameras == ANY_CAMERA else ""
    if not is_pinhole:
        fault = f"{name} needs a pinhole camera, and {path} is orthographic"
        raise ArgumentError(f"{fault}; {alternative}run the scene with a pinhole camera")
    if is_distorted:
        fault = f"{path}: the camera has lens distortion, which {name} cannot describe"
        raise ArgumentError(f"{fault}; {alternative}run the scene without distortion")


def instrument_mesh(solid: Solid) -> tuple[Array, Array, NDArray[np.int32]]:
    """Triangulate the surface of an instrument whose tip is at the origin, counter-clockwise from outside.

    Return vertices [m] and unit normals, shape (vertices, 3), and triangles, shape (n, 3).
    """
    axis = solid.axis
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    around = np.linspace(0, 2 * np.pi, 32 + 1)  # 32 segments
    radial = np.cos(around)[:, None] * across + np.sin(around)[:, None] * np.cross(axis, across)
    along, outward, *normal = solid.shape.profile(solid.length, solid.radius).T[..., None, None]
    surface = refine_surface(outward * radial + along * axis, 0)
    corners = surface.vertices[surface.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    # On the axis, one triangle of each quad has no area.
    triangles: NDArray[np.int32] = surface.triangles[area > 1e-9 * area.max()]
    return surface.vertices.astype(np.float64), (normal[1] * radial + normal[0] * axis).reshape(-1, 3), triangles
