"""Calibrations and trajectories of other programs: functions to read them, and the tables of readers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from taichi_msm.camera_files.c3vd_poses import C3VD
from taichi_msm.camera_files.calibration import Calibration, CalibrationReader, StereoPose
from taichi_msm.camera_files.camera_file import LENGTH_UNITS, CameraFile, listed
from taichi_msm.camera_files.camera_json import CAMERA_JSON
from taichi_msm.camera_files.colmap import COLMAP_CAMERAS, COLMAP_IMAGES
from taichi_msm.camera_files.colmap_binary import COLMAP_BINARY_CAMERAS, COLMAP_BINARY_IMAGES
from taichi_msm.camera_files.dso import DSO
from taichi_msm.camera_files.kalibr import KALIBR
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.kitti_poses import KITTI
from taichi_msm.camera_files.metashape import METASHAPE
from taichi_msm.camera_files.middlebury import MIDDLEBURY
from taichi_msm.camera_files.nerfstudio import NERFSTUDIO, NERFSTUDIO_POSES
from taichi_msm.camera_files.ocamcalib import OCAMCALIB
from taichi_msm.camera_files.opencv import OPENCV
from taichi_msm.camera_files.opencv_stereo import STEREO
from taichi_msm.camera_files.scared import SCARED, SCARED_POSES
from taichi_msm.camera_files.simcol import SIMCOL
from taichi_msm.camera_files.stereomis import STEREOMIS
from taichi_msm.camera_files.trajectory import Trajectory, TrajectoryReader, pose_fault
from taichi_msm.camera_files.tum_euroc import TABLES
from taichi_msm.camera_files.zed import ZED
from taichi_msm.errors import truncate

# The first reader that recognises a file reads it: binary files before texts, and texts before files with keys.
CALIBRATION_READERS = (
    *(COLMAP_BINARY_CAMERAS, COLMAP_CAMERAS, OCAMCALIB, DSO, MIDDLEBURY, METASHAPE),
    *(ZED, STEREOMIS, KALIBR, CAMERA_JSON, NERFSTUDIO, SCARED, STEREO, OPENCV),
)
TRAJECTORY_READERS: tuple[TrajectoryReader, ...] = (
    *(COLMAP_BINARY_IMAGES, COLMAP_IMAGES, SIMCOL, NERFSTUDIO_POSES, SCARED_POSES, KITTI, C3VD, TABLES),
)

# Files of cameras contain more than calibrations, such as the pose of every picture.
MAX_CALIBRATION_BYTES = 2**25

# Cameras of a stereo pair in their order.
EYES = ("left", "right")

# Units of time by their number in a second.
TIME_UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


def read_calibration(
    path: str,
    eye: Literal["left", "right"] = "left",
    unit: Literal["m", "mm"] | None = None,
    camera: str | int | None = None,
    picture_size: tuple[int, int] | None = None,
) -> Calibration:
    """Read a calibration, lengths in metres; that of the right camera of a stereo pair has its pose.

    `unit` is that of lengths in the file; by default that of the format, or metres if the format has none. `camera` is
    the name of one of several cameras, and `picture_size` is for files that contain only the field of view.
    """
    file = CameraFile(path, MAX_CALIBRATION_BYTES, picture_size)
    reader, cameras = _recognise(file)
    has_names = bool(cameras[0].camera)
    if has_names and len({repr(keys.data) for keys in cameras}) == 1:
        cameras = cameras[:1]
    if camera is not None or (has_names and len(cameras) > 1):
        keys, other_key = _select(file, reader, cameras, camera), "camera to the name of the right camera"
        return reader.read(keys)._replace(right=_right_pose(file, reader, keys, unit), other_key=other_key)
    if eye == EYES[0]:
        return reader.read(cameras[0])._replace(other_key="calibration_eye: right" if cameras[1:] else "")
    calibration = reader.read(cameras[min(1, len(cameras) - 1)])
    if len(cameras) < len(EYES):
        raise file.fault(f"{reader.name}: has one camera; name a file of a stereo pair, or remove calibration_eye")
    return calibration._replace(right=_right_pose(file, reader, cameras[1], unit))


def read_pair_pose(left: str, right: str, unit: Literal["m", "mm"] | None = None) -> StereoPose | None:
    """Read the pose [m] of the right camera of a pair of files; None if they are not such a pair."""
    files = [CameraFile(path, MAX_CALIBRATION_BYTES) for path in (left, right)]
    (reader, left_cameras), (right_reader, right_cameras) = map(_recognise, files)
    poses = [reader.rig_pose(cameras[0]) for cameras in (left_cameras, right_cameras)]
    if reader is not right_reader or None in poses:
        return None
    (left_rotation, left_translation), (rotation, translation) = (
        map(np.array, _require_rotation(file, pose)) for file, pose in zip(files, poses, strict=True) if pose
    )
    relative = rotation @ left_rotation.T
    shift = translation - relative @ left_translation
    if not shift.any():
        raise files[1].fault(f"is at the position of {left}, so there is no baseline; name the other camera's file")
    pose = StereoPose(tuple(map(tuple, relative.tolist())), tuple(shift.tolist()))
    return _in_metres(files[1], pose, unit, None)


def _recognise(file: CameraFile) -> tuple[CalibrationReader, Sequence[Keys]]:
    """Return the first reader that recognises a file, with the keys of its cameras."""
    return next((reader, cameras) for reader in CALIBRATION_READERS if (cameras := reader.cameras(file)))


def _select(file: CameraFile, reader: CalibrationReader, cameras: Sequence[Keys], camera: str | int | None) -> Keys:
    """Return the keys of the camera with a name."""
    names = [keys.camera for keys in cameras if keys.camera]
    if camera is None:
        raise file.fault(f"has several cameras, {listed(names)}; set camera to one of them")
    for keys in cameras:
        if keys.camera == str(camera):
            return keys
    if not names:
        raise file.fault(f"{reader.name}: its cameras have no names; remove camera")
    raise file.fault(f"camera: {truncate(str(camera))} is not one of {listed(names)}; set camera to one of them")


def _right_pose(file: CameraFile, reader: CalibrationReader, keys: Keys, unit: str | None) -> StereoPose | None:
    """Return the pose of a right camera [m]; None if the file does not contain it."""
    pose = reader.pose(keys)
    return None if pose is None else _in_metres(file, _require_rotation(file, pose), unit, reader.unit)


def _in_metres(file: CameraFile, pose: StereoPose, unit: str | None, format_unit: float | None) -> StereoPose:
    """Convert a translation to metres, from a unit, else that of the format, which must be plausible."""
    # Baselines are 0.5 mm to 0.5 m, so another number is probably in another unit.
    largest, distances = max(map(abs, pose.translation)), ", ".join(f"{number:g}" for number in pose.translation)
    if unit is None and format_unit is None and largest > 0.5:
        raise file.fault(f"T is [{distances}], hardly in metres; set calibration_unit: mm, or m if that is right")
    if unit is None and format_unit == LENGTH_UNITS["mm"] and largest < 0.5:
        raise file.fault(f"T is [{distances}], hardly in millimetres; set calibration_unit: m, or mm if that is right")
    scale = LENGTH_UNITS[unit] if unit is not None else format_unit or 1.0
    return pose._replace(translation=tuple(scale * number for number in pose.translation))


def _require_rotation(file: CameraFile, pose: StereoPose) -> StereoPose:
    """Return a pose with an orthonormal matrix; raise a CameraFileError for another one."""
    rotation = np.array(pose.rotation)
    if not ((deviation := np.abs(rotation @ rotation.T - np.eye(3)).max()) <= 1e-3):
        raise file.fault(f"R: R R^T differs from 1 by {deviation:.2g}; write the 3 x 3 numbers of a rotation")
    return pose


class PoseKeys(NamedTuple):
    """Keys of a camera that describe its trajectory file."""

    poses_unit: str | None = None  # unit of lengths, m or mm
    poses_time: str | None = None  # unit of times, s, ms, us or ns
    # Time in the file at which the scene begins [s]; a time before the first pose counts from that pose.
    poses_start: float | None = None
    poses_rate: float | None = None  # poses per second of a file without times


class CameraPath(NamedTuple):
    """Trajectory of a camera in metres and seconds."""

    rows: tuple[tuple[float, ...], ...]  # time, position x, y, z and quaternion x, y, z, w, from camera to world
    is_still: bool = False  # whether the only pose is without a time
    note: str = ""  # warning about the file


def read_poses(path: str, keys: PoseKeys = PoseKeys()) -> CameraPath:  # noqa: B008
    """Read a trajectory; of poses at one time, the first counts."""
    file = CameraFile(path, max_bytes=2**27)  # COLMAP's files contain the points of every picture
    reader, trajectory = next(
        (reader, found) for reader in TRAJECTORY_READERS if (found := reader.read(file)) is not None
    )
    if not trajectory.rows:
        raise file.fault("no poses; expected lines t tx ty tz qx qy qz qw")
    unit = _agreed_unit(file, "poses_unit", keys.poses_unit, trajectory.length_unit)
    scale = reader.unit if unit is None else LENGTH_UNITS[unit]
    is_still = len(trajectory.rows) == 1 and not trajectory.has_times
    times = [0.0] if is_still else _times(file, trajectory, keys)
    rows: list[tuple[float, ...]] = []
    repeated: list[str] = []
    for time, (n, (_, x, y, z, *quaternion)) in zip(times, trajectory.rows, strict=True):
        if rows and time == rows[-1][0]:
            repeated.append(f"{time:.15g} s" if n is None else f"{time:.15g} s (line {n})")
            continue
        row = (time, scale * x, scale * y, scale * z, *quaternion)
        if fault := pose_fault(row, rows[-1] if rows else None):
            raise file.fault(fault, n)
        rows.append(row)
    note = ""
    if repeated:
        note = f"{path}: repeated times, {listed(repeated)}; the first pose of each is taken"
    return CameraPath(tuple(rows), is_still, note)


def _times(file: CameraFile, trajectory: Trajectory, keys: PoseKeys) -> list[float]:
    """Return the time of every pose in the scene [s]."""
    numbers = [row[0] for _, row in trajectory.rows]
    if not trajectory.has_times:
        if keys.poses_rate is None or keys.poses_time is not None:
            in_place = "" if keys.poses_time is None else ", in place of poses_time"
            raise file.fault(f"has no times; set poses_rate, the poses per second{in_place}")
        spacing = math.gcd(*(int(number - numbers[0]) for number in numbers)) or 1
        times = [(number - numbers[0]) / spacing / keys.poses_rate for number in numbers]
    else:
        if keys.poses_rate is not None:
            raise file.fault("has times; remove poses_rate")
        unit = _agreed_unit(file, "poses_time", keys.poses_time, trajectory.time_unit)
        # 1e11 s is in the year 5138.
        if unit is None and max(map(abs, numbers)) > 1e11:
            raise file.fault(f"has the time {numbers[0]:.0f}, hardly in seconds; set poses_time: s, ms, us or ns")
        times = [number / TIME_UNITS[unit or "s"] for number in numbers]
    if (start := keys.poses_start) is None:
        return times
    if start > times[-1]:
        remedy = f"take a time from {times[0]:.15g} s to {times[-1]:.15g} s"
        raise file.fault(f"poses_start: {start:.15g} s is after the last pose; {remedy}")
    # A time before the first pose counts from that pose. Differences of large times are rounded to their resolution.
    is_after_first = start >= times[0] or math.isclose(start, times[0], abs_tol=1e-9)
    origin, digits = start if is_after_first else times[0] + start, int(-math.log10(math.ulp(times[-1])))
    return [round(time - origin, digits) for time in times]


def _agreed_unit(file: CameraFile, key: str, value: str | None, found: str | None) -> str | None:
    """Return the unit in a key of the camera, or in the header of the file; None if both are missing."""
    if value is not None and found is not None and value != found:
        raise file.fault(f"its header has {found}, and {key} is {value}; keep the right one")
    return value if value is not None else found
