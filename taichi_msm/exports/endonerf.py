"""EndoNeRF export: pictures, depth, masks and poses for neural reconstruction of deforming tissue.

    images/000000.png   frames, RGB
    depth/000000.png    depth along the optical axis, 16 bits; 0 on the background
    masks/000000.png    255 where an instrument is visible, else 0
    poses_bounds.npy    a row per frame, float64: the matrix [right, up, backward, eye, (height, width, focal length)],
                        shape (3, 5), row by row, from the camera to the world; least and largest depth of the frame

Depths are integers. Their unit, also that of eyes and bounds, is 0.01 mm, or if they exceed 16 bits, 0.1 mm, 1 mm and
so on. The world axes are those of the first camera, where EndoNeRF renders its videos and begins its
rays in normalised device coordinates. The loaders assume one focal length and a centred principal point.

Source: med-air/EndoNeRF, load_llff.py (`_load_data`, `load_llff_data`) and run_endonerf_helpers.py (`get_rays`) at
5201b1e; yifliu3/EndoGaussian, scene/endo_loader.py (`load_meta`, `format_infos`, `get_pts_cam`) at d7aad82.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, FilesError, ProgressCallback
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.inputs import (
    Pinhole,
    encode_picture,
    read_depth,
    read_picture_file,
    read_pinhole,
    scene_pinhole,
)
from taichi_msm.runs.directory import create_file, write_new_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.scene.outputs import zero_padded

FORMAT_NAME = "endonerf"

# Smallest unit of length [m], and largest value of a pixel of a depth.
MIN_UNIT_M, MAX_VALUE = 1e-5, 65535

# Picture size that EndoGaussian's loader assumes [px].
LOADER_SIZE = (640, 512)


def _write_run(run: FinishedRun, folder: Path, progress: ProgressCallback) -> list[str]:
    camera, size = read_pinhole(run, FORMAT_NAME), run.scene.render.size
    _require_central(camera, size, run)
    for name in ("images", "depth", "masks"):
        (folder / name).mkdir()
    png = partial(encode_picture, format="PNG", compress_level=1)
    bounds = np.array([_depth_bounds(run, frame) for frame in range(run.frames)])
    unit = MIN_UNIT_M * 10.0 ** max(0, np.ceil(np.log10(bounds.max() / MAX_VALUE / MIN_UNIT_M)))
    background = 0.0
    for frame in range(run.frames):
        progress(frame, run.frames)
        name, depth = f"{zero_padded(frame)}.png", read_depth(run, frame)
        background = max(background, float((depth == 0).mean()))
        # A depth below half a unit is not the background.
        values = np.where(depth > 0, np.maximum(np.rint(depth / unit), 1), 0).astype(np.uint16)
        write_new_file(folder / "images" / name, read_picture_file(run, "png", frame))
        write_new_file(folder / "depth" / name, png(values))
        mask = run.read_picture("instrument", frame)[..., 0]
        write_new_file(folder / "masks" / name, png(np.where(mask > 127, 255, 0).astype(np.uint8)))
    with create_file(folder / "poses_bounds.npy") as file:
        np.save(file, np.concatenate([_poses(camera, size, unit).reshape(run.frames, 15), bounds / unit], axis=1))
    notes = [f"depths, eyes and bounds are in units of {1000 * unit:g} mm"]
    if size != LOADER_SIZE:
        expected = f"{LOADER_SIZE[0]} x {LOADER_SIZE[1]}"
        notes.append(
            f"EndoGaussian's loader reads pictures of {expected} pixels only; these have {size[0]} x {size[1]}"
        )
    if background:
        share = f"up to {100 * background:.2g} % of the pixels of a frame are background, depth 0"
        notes.append(f"{share}: EndoGaussian leaves them out, EndoNeRF does not; fill the picture with the sheet")
    return notes


write = one_folder_per_run(_write_run)


def check_camera(run: FinishedRun) -> None:
    """Raise an ArgumentError if the format cannot describe the camera of the run's scene."""
    _require_central(scene_pinhole(run, FORMAT_NAME), run.scene.render.size, run)


def _require_central(camera: Pinhole, size: tuple[int, int], run: FinishedRun) -> None:
    """Raise an ArgumentError unless the focal lengths are equal and the principal point is centred."""
    focal_x, focal_y = camera.focal.tolist()
    x, y = (camera.centre - np.array(size) / 2).tolist()
    faults = []
    if abs(focal_x / focal_y - 1) > 1e-6:
        faults.append(f"the focal lengths are {focal_x:g} and {focal_y:g} px")
    # The loaders' principal point is the centre of the pixel to the lower right of the picture's centre.
    if max(abs(x), abs(y)) > 0.5 + 1e-6:
        faults.append(f"the principal point is {x:g} px to the right of and {y:g} px below the centre")
    if faults:
        fault = f"{FORMAT_NAME} needs one focal length and a centred principal point; {', '.join(faults)}"
        width, height = size[0] / 2, size[1] / 2
        remedy = f"run the scene with fx = fy, cx: {width:g} and cy: {height:g}, or with fov"
        raise ArgumentError(f"{run.directory / run.camera}: {fault}; {remedy}")


def _depth_bounds(run: FinishedRun, frame: int) -> tuple[float, float]:
    """Return the least and the largest depth in a frame [m]."""
    depth = read_depth(run, frame)
    visible = depth[depth > 0]
    if not len(visible):
        fault = f"frame {frame} shows only background, and {FORMAT_NAME} needs a range of depths"
        raise FilesError(f"{run.directory / run.camera}: {fault}; run the scene with a camera that shows the sheet")
    return float(visible.min()), float(visible.max())


def _poses(camera: Pinhole, size: tuple[int, int], unit: float) -> NDArray[np.float64]:
    """Return the matrices of poses_bounds.npy, shape (frames, 3, 5)."""
    poses = camera.matrices
    # From OpenCV's axes, right, down and forward, to right, up and backward.
    signs = np.array([1.0, -1.0, -1.0, 1.0])
    # From each camera to the first one, exactly the identity for a camera that does not move.
    to_first = signs[:, None] * (poses[0] @ np.linalg.inv(poses)) * signs
    to_first[(poses == poses[0]).all(axis=(1, 2))] = np.eye(4)
    to_first[:, :3, 3] /= unit
    optics = np.tile(np.array([[size[1]], [size[0]], [camera.focal[0]]]), (len(poses), 1, 1))
    return np.concatenate([to_first[:, :3], optics], axis=2)
