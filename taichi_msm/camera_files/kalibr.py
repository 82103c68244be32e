"""Kalibr's camchain: a section per camera, with its pose relative to the previous camera.

EuRoC's sensor.yaml has the keys of one section.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, TypeGuard

from taichi_msm.camera_files.calibration import CalibrationReader, StereoPose
from taichi_msm.camera_files.camera_file import CameraFile, Entries, listed
from taichi_msm.camera_files.key_lookup import Keys, flat
from taichi_msm.camera_files.opencv import read_camera
from taichi_msm.errors import truncate

# Camera models, each with the number of its intrinsics.
INTRINSICS = {"pinhole": 4, "omni": 5}


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the keys of the cameras in the order of their numbers; an empty list for another format."""
    if _is_camera(file.data):
        return [_camera(file, "", file.data)]
    names = [name for name, section in file.data.items() if _is_camera(section)]
    return [_camera(file, f"{name}: ", file.data[name]) for name in sorted(names, key=_sort_key)]


def _pose(keys: Keys) -> StereoPose | None:
    """Read T_cn_cnm1, the matrix [R, t] from the previous camera to this one, shape (4, 4)."""
    if "T_cn_cnm1" not in keys.data:
        return None
    rows = keys.require("tcncnm1", 16, "T_cn_cnm1")
    return StereoPose(tuple(tuple(rows[n : n + 3]) for n in (0, 4, 8)), tuple(rows[3:12:4]))


def _rig_pose(keys: Keys) -> StereoPose | None:
    """Invert T_BS of EuRoC, the matrix [R, t] from the camera to the body, shape (4, 4)."""
    if "T_BS" not in keys.data:
        return None
    import numpy as np

    matrix = np.array(keys.require("tbs", 16, "T_BS")).reshape(4, 4)[:3]
    rotation = matrix[:, :3].T
    return StereoPose(tuple(map(tuple, rotation.tolist())), tuple((-rotation @ matrix[:, 3]).tolist()))


def _is_camera(section: Any) -> TypeGuard[Entries]:
    """Return whether a section has a model and a list of intrinsics; nine numbers are a matrix of another format."""
    has_model = isinstance(section, Entries) and "camera_model" in section
    return has_model and len(flat(section.get("intrinsics"))) not in (1, 9)


def _camera(file: CameraFile, prefix: str, section: Entries) -> Keys:
    """Return the keys of a section, with intrinsics (xi of `omni`, fx, fy, cx, cy) converted to a camera matrix."""
    numbers, model = flat(section["intrinsics"]), str(section["camera_model"]).lower()
    if model not in INTRINSICS:
        fault = f"{prefix}camera_model: {truncate(model)} is not supported; found {listed(section)}"
        raise file.fault(f"{fault}; expected one of: {', '.join(INTRINSICS)}", section.lines.get("camera_model"))
    if len(numbers) != INTRINSICS[model]:
        fault = f"{prefix}intrinsics: {len(numbers)} numbers, but {model} has {INTRINSICS[model]}"
        raise file.fault(f"{fault}; write {INTRINSICS[model]} numbers", section.lines.get("intrinsics"))
    *xi, fx, fy, cx, cy = numbers
    data = {**section, "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1], **({"xi": xi} if xi else {})}
    return Keys(file, Entries(data, section.lines))


def _sort_key(name: object) -> tuple[int, str]:
    match = re.search(r"\d{1,18}", str(name))
    return int(match[0]) if match else 0, str(name)


KALIBR = CalibrationReader(
    "Kalibr's camchain, EuRoC's sensor.yaml",
    "`camera_model`, `intrinsics: [fx, fy, cx, cy]`, in `cam0` and `cam1`, whose pose is `T_cn_cnm1`",
    ("calibration: camchain.yaml", "calibration: sensor.yaml"),
    _cameras,
    read_camera,
    _pose,
    _rig_pose,
)
