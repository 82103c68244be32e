"""A camera that other programs can compute with, from what a run has written of it."""

from __future__ import annotations

import json
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError
from taichi_msm.exports.formats import ANY, FORMATS
from taichi_msm.outputs.table import CAMERA
from taichi_msm.results.finished_run import FinishedRun, damaged, reading
from taichi_msm.system.files import read_regular

Array = NDArray[np.float64]

# OpenCV counts from the centre of the first pixel, this program from the picture's corner.
FIRST_CENTRE = 0.5

# The largest camera.json that is read [bytes]: of 100,000 poses.
MAX_BYTES = 1 << 25


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
    another = "choose another camera by --camera, or " if FORMATS[name].cameras == ANY else ""
    with reading(path):
        described = json.loads(read_regular(run.own(path, "tracks"), MAX_BYTES))
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
            raise damaged(path)
        focal, centre = matrix[[0, 1], [0, 1]], matrix[:2, 2]
        if not (np.isfinite(matrix).all() and (focal > 0).all()):
            raise damaged(path)
    return Pinhole(focal, centre, poses)
