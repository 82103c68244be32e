"""StereoCalibration.ini of the StereoMIS data set: OpenCV's coefficients kc_0 to kc_7, lengths in millimetres."""

from __future__ import annotations

import re
from collections.abc import Sequence

from taichi_msm.camera_files.calibration import CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile, Entries, listed
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import read_camera, read_pose

# Keys of a section that make up each key of OpenCV.
KEYS = {
    "intrinsics": ("fc_x", "fc_y", "cc_x", "cc_y"),
    "D": ("kc_0", "kc_1", "kc_2", "kc_3"),
    "size": ("res_x", "res_y"),
    "R": tuple(f"r_{n}" for n in range(9)),
    "T": tuple(f"t_{n}" for n in range(3)),
}
SECTIONS = ("StereoLeft", "StereoRight")
MORE_COEFFICIENTS = ("kc_4", "kc_5", "kc_6", "kc_7")


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the sections of the cameras, with OpenCV's keys."""
    if not any(name in file.data for name in SECTIONS):
        return []
    if missing := [name for name in SECTIONS if not isinstance(file.data.get(name), Entries)]:
        raise file.fault(f"has no keys in {listed(missing)}; found {listed(file.data)}; write both cameras")
    return [_camera(file, file.data[name], file.data.lines.get(name)) for name in SECTIONS]


def _camera(file: CameraFile, section: Entries, line: int | None) -> Keys:
    values = {key: [section[name] for name in names if name in section] for key, names in KEYS.items()}
    if missing := [name for key in ("intrinsics", "D", "size") for name in KEYS[key] if name not in section]:
        raise file.fault(f"has no {listed(missing)}; found {listed(section)}; add them", line)
    known = {*MORE_COEFFICIENTS, *(name for names in KEYS.values() for name in names)}
    others = [name for name in section if name not in known and re.match(r"(kc|fc|cc|res|r|t)_|skew|alpha", name)]
    if others:
        fault = f"{listed(others)}: unknown; found {listed(section)}"
        raise file.fault(f"{fault}; remove the keys that do not matter", section.lines.get(others[0]))
    values["D"] += [section.get(name, "0") for name in MORE_COEFFICIENTS]
    fx, fy, cx, cy = values["intrinsics"]
    lines = {key: section.lines[names[0]] for key, names in KEYS.items() if names[0] in section.lines}
    return Keys(file, Entries({**values, "intrinsics": [fx, "0", cx, "0", fy, cy, "0", "0", "1"]}, lines))


STEREOMIS = CalibrationReader(
    "StereoMIS",
    "an ini file with `[StereoLeft]`, `[StereoRight]`",
    ("calibration: StereoCalibration.ini",),
    _cameras,
    read_camera,
    read_pose,
    unit=1e-3,
)
