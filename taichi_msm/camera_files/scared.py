"""SCARED: endoscope_calibration.yaml, and frame_data JSON with a calibration and a pose, in millimetres."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from taichi_msm.camera_files.calibration import CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile, Entries
from taichi_msm.camera_files.key_lookup import Keys, flat
from taichi_msm.camera_files.opencv import read_camera
from taichi_msm.camera_files.opencv_stereo import build_cameras, read_stereo_pose
from taichi_msm.camera_files.trajectory import Trajectory, TrajectoryReader, build_rows, parse_numbers

CALIBRATION, POSE = "camera-calibration", "camera-pose"


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the keys of both cameras; an empty list for another format."""
    section = file.data.get(CALIBRATION)
    if isinstance(section, Entries):
        return build_cameras(file, section)
    return build_cameras(file, file.data) if Path(file.path).name.startswith("endoscope_calibration") else []


def _read_poses(file: CameraFile) -> Trajectory | None:
    """Read the pose of the frame, from the axes of the keyframe to those of the camera; None for another format."""
    if not file.text.lstrip().startswith("{") or POSE not in file.data:
        return None
    import numpy as np

    numbers = parse_numbers([str(number) for number in flat(file.data[POSE])])
    if numbers is None or len(numbers) != 16 or numbers[12:] != [0, 0, 0, 1]:
        raise file.fault(f"{POSE}: not a 4 x 4 matrix with [0, 0, 0, 1] as the last row; extract the file again")
    matrix = np.array(numbers).reshape(4, 4)
    inverse = np.column_stack([matrix[:3, :3].T, -matrix[:3, :3].T @ matrix[:3, 3]])
    return Trajectory(build_rows(file, [None], [0], inverse[np.newaxis]), has_times=False)


SCARED = CalibrationReader(
    "SCARED",
    "endoscope_calibration.yaml, or frame_data JSON: `camera-calibration` with `KL`, `DL`, `KR`, `DR`, `R`, `T`",
    ("calibration: frame_data000000.json", "calibration: endoscope_calibration.yaml"),
    _cameras,
    read_camera,
    read_stereo_pose,
    unit=1e-3,
)
SCARED_POSES = TrajectoryReader(
    "SCARED",
    "frame_data JSON: `camera-pose`, of one frame",
    ("poses: frame_data000000.json",),
    _read_poses,
    unit=1e-3,
)
