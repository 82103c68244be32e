"""Calibrations of stereo pairs, with keys or a section per camera: OpenCV's stereoCalibrate, SCARED, STIR."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

from taichi_msm.camera_files.calibration import CalibrationReader, StereoPose
from taichi_msm.camera_files.camera_file import CameraFile, Entries, listed
from taichi_msm.camera_files.key_lookup import Keys, flat, fold
from taichi_msm.camera_files.opencv import MATRIX, read_camera, read_pose

# Marks of the left and the right camera, before or after the name of a key; or names of their sections.
MARKS = (
    (r"(.+?)_?1|cam(?:era)?_?1_(.+)", r"(.+?)_?2|cam(?:era)?_?2_(.+)"),
    (r"(?i:left)_?(.+)|(.+?)_?(?i:left)", r"(?i:right)_?(.+)|(.+?)_?(?i:right)"),
    (r"[lL]_(.+)|(.+?)(?:_l|_?L)", r"[rR]_(.+)|(.+?)(?:_r|_?R)"),
    (r"(.+?)_?0|cam(?:era)?_?0_(.+)", r"(.+?)_?1|cam(?:era)?_?1_(.+)"),
)

# Names of the section of a camera, without numbers.
SECTION = re.compile(
    r"(?:camera|cam)?_?(left|right)_?(?:camera|cam)?(?:_?(?:intrinsics|calibration|calib|params|parameters))?", re.I
)

# Names of results for both cameras: the fundamental matrix F, and the free parameter of stereoRectify. Others of its
# results have names of coefficients and of ROS, but other numbers of values: projections and regions.
SHARED = {"f", "alpha"}
RECTIFICATION = {"p1": 12, "p2": 12, "roi": 4}


def build_cameras(file: CameraFile, data: Entries) -> Sequence[Keys]:
    """Return the keys of each camera, with those without a mark; an empty list if a camera has no matrix."""
    data = _flatten_sections(data)
    for marks in MARKS:
        sides = [_strip_mark(data, mark) for mark in marks]
        matrices = [[key for key, name in side.items() if re.fullmatch(MATRIX, name)] for side in sides]
        if all(any(len(flat(data[key])) in (9, 16) for key in keys) for keys in matrices):
            unmarked = {key: fold(key) for key in data if not any(key in side for side in sides)}
            unmarked = {key: name for key, name in unmarked.items() if name not in SHARED}
            return [_camera(file, data, {**unmarked, **side}) for side in sides]
    return ()


def _camera(file: CameraFile, data: Entries, names: dict[str, str]) -> Keys:
    """Return the keys of a camera with folded names, without results of stereoRectify."""
    names = {key: name for key, name in names.items() if RECTIFICATION.get(name) != len(flat(data[key]))}
    return Keys(file, Entries({key: data[key] for key in names}, data.lines), names)


def read_stereo_pose(keys: Keys) -> StereoPose | None:
    """Read R and T; unknown keys that may define another unit or pose are an error."""
    if names := keys.unread(r"units?|[rt]c?m+|rt|extrinsics?"):
        remedy = "write R (3 x 3) and T (3 numbers) in metres, or set calibration_unit: mm, and remove the unknown keys"
        raise keys.fault(f"{listed(names)}: unknown; {remedy}", names[0])
    return read_pose(keys)


def _flatten_sections(data: Entries) -> Entries:
    """Rename the keys of sections: K of the section left becomes left_K."""
    flattened: dict[str, Any] = {}
    lines: dict[str, int] = {}
    for key, value in data.items():
        if isinstance(value, Entries) and "data" not in value:
            key = match[1] if (match := SECTION.fullmatch(str(key))) else key
            flattened |= {f"{key}_{name}": inner for name, inner in value.items()}
            lines |= {f"{key}_{name}": line for name, line in value.lines.items()}
        else:
            flattened[key] = value
            lines |= {key: data.lines[key]} if key in data.lines else {}
    return Entries(flattened, lines)


def _strip_mark(keys: Iterable[str], mark: str) -> dict[str, str]:
    """Return the folded names without the mark, by key, of the keys that have it."""
    matches = {key: re.fullmatch(mark, str(key)) for key in keys}
    return {key: fold("".join(filter(None, match.groups()))) for key, match in matches.items() if match}


STEREO = CalibrationReader(
    "OpenCV stereo, STIR",
    "`K1`, `D1`, `K2`, `D2` (or `M1`, `cameraMatrix1`, `leftcameramat`, `K_l`, ...), with `R`, `T`",
    ("calibration: stereo.yaml",),
    lambda file: build_cameras(file, file.data),
    read_camera,
    read_stereo_pose,
    unit=None,
)
