"""The table of readers of calibrations."""

from __future__ import annotations

from typing import Literal

import numpy as np

from taichi_msm.camera_files.calibration import Calibration
from taichi_msm.camera_files.camera_json import CAMERA_JSON
from taichi_msm.camera_files.colmap import COLMAP_CAMERAS
from taichi_msm.camera_files.kalibr import KALIBR
from taichi_msm.camera_files.ocamcalib import OCAMCALIB
from taichi_msm.camera_files.opencv import OPENCV
from taichi_msm.camera_files.stereo import STEREO
from taichi_msm.camera_files.stereomis import STEREOMIS
from taichi_msm.camera_files.text import LENGTH_UNITS, CameraFile

# The first one that recognises a file reads it.
READERS = (OCAMCALIB, COLMAP_CAMERAS, STEREOMIS, KALIBR, CAMERA_JSON, STEREO, OPENCV)

# Limit of the size of a file.
MAX_BYTES = 2**22

# Cameras of a stereo pair in their order.
EYES = ("left", "right")

# Larger distances of the cameras of a pair are probably millimetres [m].
MAX_BASELINE_M = 0.5


def read_calibration(
    path: str, eye: Literal["left", "right"] = "left", unit: Literal["m", "mm"] | None = None
) -> Calibration:
    """Read a calibration.

    Args:
        path: path of the file.
        eye: camera of a stereo pair; of the right one the pose is read as well.
        unit: unit of lengths in the file; None for that of the format, or for metres where the format has none.

    Raises:
        CameraFileError: when the file is invalid or not supported; the message lists what was found.
    """
    file = CameraFile(path, MAX_BYTES)
    reader, cameras = next((reader, cameras) for reader in READERS if (cameras := reader.cameras(file)))
    if eye == EYES[0] or len(cameras) < len(EYES):
        calibration = reader.read(cameras[0])
        if eye == EYES[0]:
            return calibration
        raise file.fault(f"{reader.name}: has one camera; name a file of a stereo pair, or remove calibration_eye")
    calibration, pose = reader.read(cameras[1]), reader.pose(cameras[1])
    if pose is None:
        return calibration
    if unit is None and reader.unit is None and max(map(abs, pose.translation)) > MAX_BASELINE_M:
        listed = ", ".join(f"{number:g}" for number in pose.translation)
        raise file.fault(f"the cameras are [{listed}] m apart; set calibration_unit: mm, or m if that is right")
    rotation = np.array(pose.rotation)
    if not ((deviation := np.abs(rotation @ rotation.T - np.eye(3)).max()) <= 1e-3):
        raise file.fault(f"R: is no rotation, products of its rows are off by {deviation:.2g}; write its 3 x 3 numbers")
    scale = LENGTH_UNITS[unit] if unit is not None else reader.unit or 1.0
    translation = tuple(scale * number for number in pose.translation)
    return calibration._replace(right=pose._replace(translation=translation))
