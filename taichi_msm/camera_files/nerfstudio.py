"""transforms.json of nerfstudio and instant-ngp: intrinsics, shared or by frame, and poses in OpenGL's axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile, Entries, listed
from taichi_msm.camera_files.key_lookup import Keys, flat
from taichi_msm.camera_files.opencv import NO_DISTORTION, build_keys, read_camera
from taichi_msm.camera_files.trajectory import (
    Trajectory,
    TrajectoryReader,
    build_rows,
    parse_numbers,
    picture_numbers,
)
from taichi_msm.errors import truncate

FOCAL = ("fl_x", "camera_angle_x")
LENS = (*FOCAL, "fl_y", "camera_angle_y", "cx", "cy", "w", "h", "camera_model", "is_fisheye")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
# Lens models by `camera_model`, each with the coefficients in OpenCV's order.
MODELS = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE"), (NO_DISTORTION, ("k1", "k2", "p1", "p2"))),
    **dict.fromkeys(("SIMPLE_RADIAL", "RADIAL", "OPENCV"), ("opencv", ("k1", "k2", "p1", "p2", "k3"))),
    "OPENCV_FISHEYE": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the different cameras of the frames, named by a picture; an empty list for another format."""
    shared = {name: value for name, value in file.data.items() if name in (*LENS, *COEFFICIENTS)}
    frames = _frames(file)
    if not frames and not shared.keys() & {*FOCAL}:
        return []
    cameras: dict[str, tuple[str, dict[str, Any]]] = {}
    for index, frame in enumerate(frames or [Entries({}, {})]):
        lens = shared | {name: value for name, value in frame.items() if name in (*LENS, *COEFFICIENTS)}
        cameras.setdefault(repr(sorted(lens.items())), (str(frame.get("file_path", f"frames.{index}")), lens))
    return [Keys(file, Entries(lens, {}), camera=name) for name, lens in cameras.values()]


def _frames(file: CameraFile) -> list[Entries]:
    """Return the frames with a pose; an empty list for another format."""
    if file.text.lstrip()[:1] != "{":
        return []
    frames = file.data.get("frames")
    entries = [frame for frame in (frames if isinstance(frames, list) else ()) if isinstance(frame, Entries)]
    return entries if frames and all("transform_matrix" in frame for frame in entries) else []


def _read(keys: Keys) -> Calibration:
    """Read the intrinsics, shifted by half a pixel: the first pixel centre is (0.5, 0.5)."""
    names = [name for name in FOCAL if name in keys.data]
    if not names:
        raise keys.file.fault(f"has no {' or '.join(FOCAL)}; found {listed(keys.file.data)}; add one of them")
    size = (keys.number("w"), keys.number("h")) if {"w", "h"} & keys.data.keys() else None
    pictures = size or keys.file.picture_size
    if pictures is None:
        raise keys.file.fault(f"has no w and h; found {keys}; add the size of the pictures")
    angles = {"fl_x": "camera_angle_x", "fl_y": "camera_angle_y"}
    for angle in angles.values():
        if not 0 < keys.number(angle, 1.0) < math.pi:
            raise keys.file.fault(f"{angle}: {keys.number(angle):g} is not an angle; write radians, from 0 to pi")
    # The distance at which the picture fills its field of view.
    from_angle = {
        focal: side / 2 / math.tan(keys.number(angle) / 2)
        for (focal, angle), side in zip(angles.items(), pictures, strict=True)
        if angle in keys.data
    }
    fx = keys.number("fl_x", from_angle.get("fl_x"))
    fy = keys.number("fl_y", from_angle.get("fl_y", fx))
    for focal, value in (("fl_x", fx), ("fl_y", fy)):
        if not math.isclose(value, other := from_angle.get(focal, value), rel_tol=1e-3):
            fault = f"{focal} is {value:g} px, but {angles[focal]} corresponds to {other:g} px; keep the right one"
            raise keys.file.fault(fault)
    centre = [keys.number(name, side / 2) - 0.5 for name, side in zip(("cx", "cy"), pictures, strict=True)]
    default = "OPENCV_FISHEYE" if keys.data.get("is_fisheye") else "OPENCV"
    model = str(keys.data.get("camera_model", default))
    if model not in MODELS or (keys.data.get("is_fisheye") and model != default):
        fault = f"camera_model: {truncate(model)} is not supported"
        raise keys.file.fault(f"{fault}; expected one of: {', '.join(MODELS)}")
    lens, order = MODELS[model]
    if others := [name for name in COEFFICIENTS if name not in order and keys.number(name, 0.0)]:
        fault = f"{others[0]} is not 0, but {model} has {', '.join(order)}"
        raise keys.file.fault(f"{fault}; calibrate without {others[0]}")
    coefficients = [keys.number(name, 0.0) for name in order]
    return read_camera(build_keys(keys.file, (fx, fy), centre, coefficients, lens, size))


def _read_poses(file: CameraFile) -> Trajectory | None:
    """Read the poses, ordered by the names of the pictures; None for another format."""
    if not (frames := _frames(file)):
        return None
    import numpy as np

    matrices: list[list[float]] = []
    for index, frame in enumerate(frames):
        numbers = parse_numbers([str(number) for number in flat(frame["transform_matrix"])])
        if numbers is None or len(numbers) not in (12, 16) or numbers[12:] not in ([], [0, 0, 0, 1]):
            fault = f"frames.{index}.transform_matrix: not a 4 x 4 matrix with [0, 0, 0, 1] as the last row"
            raise file.fault(f"{fault}; export the file again")
        matrices.append(numbers[:12])
    # From OpenGL's axes of the camera, x right, y up, z backward, to OpenCV's.
    poses = np.array(matrices).reshape(-1, 3, 4) * (1, -1, -1, 1)
    numbers, has_times = picture_numbers([str(frame.get("file_path", "")) for frame in frames])
    order = sorted(range(len(frames)), key=numbers.__getitem__)
    rows = build_rows(file, [None] * len(order), [numbers[n] for n in order], poses[order])
    return Trajectory(rows, has_times)


NERFSTUDIO = CalibrationReader(
    "nerfstudio, instant-ngp",
    "transforms.json: `fl_x` or `camera_angle_x`, in all or each of its `frames`",
    ("calibration: transforms.json",),
    _cameras,
    _read,
)
NERFSTUDIO_POSES = TrajectoryReader(
    "nerfstudio, instant-ngp",
    "transforms.json: `frames` with a `transform_matrix`; needs `poses_rate`",
    ("poses: transforms.json, poses_rate: 25",),
    _read_poses,
)
