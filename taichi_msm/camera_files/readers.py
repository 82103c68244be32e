"""Calibrations and trajectories of other programs: functions to read them, and the tables of readers."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from taichi_msm.camera_files.calibration import Calibration
from taichi_msm.camera_files.camera_file import LENGTH_UNITS, CameraFile
from taichi_msm.camera_files.camera_json import CAMERA_JSON
from taichi_msm.camera_files.colmap import COLMAP_CAMERAS, COLMAP_IMAGES
from taichi_msm.camera_files.kalibr import KALIBR
from taichi_msm.camera_files.kitti_poses import KITTI
from taichi_msm.camera_files.ocamcalib import OCAMCALIB
from taichi_msm.camera_files.opencv import OPENCV
from taichi_msm.camera_files.opencv_stereo import STEREO
from taichi_msm.camera_files.stereomis import STEREOMIS
from taichi_msm.camera_files.trajectory import Trajectory, TrajectoryReader, pose_fault
from taichi_msm.camera_files.tum_euroc import TABLES

# The first reader that recognises a file reads it.
CALIBRATION_READERS = (OCAMCALIB, COLMAP_CAMERAS, STEREOMIS, KALIBR, CAMERA_JSON, STEREO, OPENCV)
TRAJECTORY_READERS: tuple[TrajectoryReader, ...] = (COLMAP_IMAGES, KITTI, TABLES)

# Cameras of a stereo pair in their order.
EYES = ("left", "right")

# Units of time by their number in a second.
TIME_UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


def read_calibration(
    path: str, eye: Literal["left", "right"] = "left", unit: Literal["m", "mm"] | None = None
) -> Calibration:
    """Read a calibration, lengths in metres; that of the right camera of a stereo pair has its pose.

    `unit` is that of lengths in the file; by default that of the format, or metres if the format has none.
    """
    file = CameraFile(path, max_bytes=2**22)
    reader, cameras = next((reader, cameras) for reader in CALIBRATION_READERS if (cameras := reader.cameras(file)))
    if eye == EYES[0] or len(cameras) < len(EYES):
        calibration = reader.read(cameras[0])
        if eye == EYES[0]:
            return calibration
        raise file.fault(f"{reader.name}: has one camera; name a file of a stereo pair, or remove calibration_eye")
    calibration, pose = reader.read(cameras[1]), reader.pose(cameras[1])
    if pose is None:
        return calibration
    # Baselines are 0.5 mm to 0.5 m, so a larger number than 0.5 is probably in millimetres.
    if unit is None and reader.unit is None and max(map(abs, pose.translation)) > 0.5:
        distances = ", ".join(f"{number:g}" for number in pose.translation)
        raise file.fault(f"T is [{distances}], hardly in metres; set calibration_unit: mm, or m if that is right")
    rotation = np.array(pose.rotation)
    if not ((deviation := np.abs(rotation @ rotation.T - np.eye(3)).max()) <= 1e-3):
        raise file.fault(f"R: R R^T differs from 1 by {deviation:.2g}; write the 3 x 3 numbers of a rotation")
    scale = LENGTH_UNITS[unit] if unit is not None else reader.unit or 1.0
    translation = tuple(scale * number for number in pose.translation)
    return calibration._replace(right=pose._replace(translation=translation))


class PoseKeys(NamedTuple):
    """Keys of a camera that describe its trajectory file."""

    poses_unit: str | None = None  # unit of lengths, m or mm
    poses_time: str | None = None  # unit of times, s, ms, us or ns
    # Time in the file at which the scene begins [s]; a time before the first pose counts from that pose.
    poses_start: float | None = None
    poses_rate: float | None = None  # poses per second of a file without times


def read_poses(path: str, keys: PoseKeys = PoseKeys()) -> tuple[tuple[float, ...], ...]:  # noqa: B008
    """Read a trajectory: rows of time [s], position x, y, z [m] and quaternion x, y, z, w, from camera to world."""
    file = CameraFile(path, max_bytes=2**27)  # COLMAP's files contain the points of every picture
    trajectory = next(found for reader in TRAJECTORY_READERS if (found := reader.read(file)) is not None)
    if not trajectory.rows:
        raise file.fault("no poses; expected lines t tx ty tz qx qy qz qw")
    scale = LENGTH_UNITS[_agreed_unit(file, "poses_unit", keys.poses_unit, trajectory.length_unit) or "m"]
    times = _times(file, trajectory, keys)
    rows: list[tuple[float, ...]] = []
    for time, (n, (_, x, y, z, *quaternion)) in zip(times, trajectory.rows, strict=True):
        row = (time, scale * x, scale * y, scale * z, *quaternion)
        if fault := pose_fault(row, rows[-1] if rows else None):
            raise file.fault(fault, n)
        rows.append(row)
    return tuple(rows)


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
