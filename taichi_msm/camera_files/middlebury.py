"""calib.txt of the Middlebury stereo data sets, of a rectified pair, with lengths in millimetres."""

from __future__ import annotations

import math
from collections.abc import Sequence

from taichi_msm.camera_files.calibration import CalibrationReader, StereoPose
from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import NO_DISTORTION, read_camera

CAMERAS = ("cam0", "cam1")
# Largest difference of doffs from the centres, which are rounded [px].
OFFSET_TOLERANCE = 0.02


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return both cameras under OpenCV's keys; an empty list for another format."""
    if not file.lines or not file.lines[0][1].replace(" ", "").startswith("cam0=["):
        return []
    pairs = [(n, line.partition("=")) for n, line in file.lines]
    data = file.entries((name.strip(), value.strip(" []").replace(";", " "), n) for n, (name, _, value) in pairs)
    keys = Keys(file, data)
    left, right = (keys.require(name, 9, name) for name in CAMERAS)
    offset, distance = keys.number("doffs"), right[2] - left[2]
    if not math.isclose(offset, distance, abs_tol=OFFSET_TOLERANCE):
        fault = f"doffs is {offset:g}, but the centres of cam0 and cam1 differ by {distance:g}"
        raise keys.fault(f"{fault}; keep the right one", "doffs")
    shared = [(name, data[name], data.lines[name]) for name in ("width", "height", "baseline") if name in data]
    none = ("distortion_model", NO_DISTORTION, None)
    return [Keys(file, file.entries([("K", data[name], data.lines[name]), none, *shared])) for name in CAMERAS]


def _pose(keys: Keys) -> StereoPose:
    return StereoPose(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (-keys.number("baseline"), 0.0, 0.0))


MIDDLEBURY = CalibrationReader(
    "Middlebury",
    "calib.txt: `cam0=[f 0 cx; 0 f cy; 0 0 1]`, `cam1`, `doffs`, `baseline`",
    ("calibration: calib.txt",),
    _cameras,
    read_camera,
    _pose,
    unit=1e-3,
)
