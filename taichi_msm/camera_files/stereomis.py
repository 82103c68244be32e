"""StereoCalibration.ini of the StereoMIS data set: OpenCV's coefficients kc_0 to kc_7, lengths in millimetres."""

from __future__ import annotations

from collections.abc import Sequence

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader, build
from taichi_msm.camera_files.keys import Keys
from taichi_msm.camera_files.text import CameraFile

SECTIONS = ("StereoLeft", "StereoRight")
COEFFICIENTS = [f"kc_{n}" for n in range(8)]


class StereoMIS(CalibrationReader):
    """Reader of the ini file."""

    name = "StereoMIS"
    recognised_by = "an ini file with `[StereoLeft]`, `[StereoRight]`"
    unit = 1e-3

    def recognises(self, file: CameraFile) -> bool:
        """Return whether there is a section of a camera."""
        return SECTIONS[0] in file.data

    def cameras(self, file: CameraFile) -> Sequence[Keys]:
        """Return the sections of the cameras."""
        return [Keys(file, file.data[name]) for name in SECTIONS if name in file.data]

    def read(self, keys: Keys) -> Calibration:
        """Read a section."""
        if not {"kc_0", "kc_1", "kc_2", "kc_3"} <= {*keys.data}:
            raise keys.file.fault(f"no distortion that is known; found {keys}; write kc_0 to kc_4")
        values = [*_numbers(keys, [name for name in COEFFICIENTS if name in keys.data]), *(0.0, 0.0, 0.0, 0.0)]
        intrinsics = _numbers(keys, ("fc_x", "fc_y", "cc_x", "cc_y"))
        return build(keys.file, intrinsics, _numbers(keys, ("res_x", "res_y")), "pinhole", values[:8])

    def pose(self, keys: Keys) -> tuple[Sequence[float], Sequence[float]]:
        """Read R_0 to R_8, T_0 to T_2."""
        rotation = _numbers(keys, [f"r_{n}" for n in range(9)])
        return rotation, _numbers(keys, [f"t_{n}" for n in range(3)])


def _numbers(keys: Keys, names: Sequence[str]) -> list[float]:
    return [keys.require(name.replace("_", ""), 1, name)[0] for name in names]
