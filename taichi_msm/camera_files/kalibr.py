"""Kalibr's camchain: a section per camera, each but the first with the pose after the one before it.

The sensor.yaml of EuRoC has the keys of a section.
"""

from __future__ import annotations

from collections.abc import Sequence

from taichi_msm.camera_files.calibration import StereoPose
from taichi_msm.camera_files.keys import Keys, flat
from taichi_msm.camera_files.opencv import OpenCV
from taichi_msm.camera_files.text import CameraFile


class Kalibr(OpenCV):
    """Reader of a camchain."""

    name = "Kalibr's camchain, EuRoC's sensor.yaml"
    recognised_by = "`camera_model`, `intrinsics: [fx, fy, cx, cy]`, in `cam0` and `cam1`, whose pose is `T_cn_cnm1`"

    def cameras(self, file: CameraFile) -> Sequence[Keys]:
        """Return the sections of the cameras, with a camera matrix; intrinsics of `omni` begin with xi."""
        cameras = []
        for section in (file.data, *(file.data[name] for name in sorted(file.data, key=str))):
            numbers = flat(section.get("intrinsics")) if isinstance(section, dict) and "camera_model" in section else []
            if len(numbers) in (4, 5):
                *xi, fx, fy, cx, cy = numbers
                matrix = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
                cameras.append(Keys(file, {**section, "intrinsics": matrix, **({"xi": xi} if xi else {})}))
        return cameras

    def pose(self, keys: Keys) -> StereoPose | None:
        """Read T_cn_cnm1, four rows [R, t]."""
        if "T_cn_cnm1" not in keys.data:
            return None
        rows = keys.require("tcncnm1", 16, "T_cn_cnm1")
        return StereoPose(tuple(tuple(rows[n : n + 3]) for n in (0, 4, 8)), tuple(rows[3:12:4]))
