"""Trajectory of a camera, and the interface of its readers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from taichi_msm.camera_files.camera_file import CameraFile

# Largest error of the norm of a quaternion, and of the entries of R R^T.
NORM_TOLERANCE = 1e-3

# Largest number in a trajectory.
MAX_NUMBER = 1e30

COLUMNS = ("t", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


class Trajectory(NamedTuple):
    """Poses of a camera, in the units of the file."""

    # Number of the line, for messages; time (or the number of the picture, without times), position x, y, z and
    # quaternion x, y, z, w, from the camera to the world.
    rows: Sequence[tuple[int, Sequence[float]]]
    has_times: bool  # whether the file contains times
    time_unit: str | None = None  # unit of times in the header; None without one
    length_unit: str | None = None  # unit of lengths in the header; None without one


class TrajectoryReader(NamedTuple):
    """Reader of a format of trajectories."""

    name: str  # name of the format, for users
    recognised_by: str  # content by which a file is recognised, for users
    # Function that returns the trajectory, or None for another format; a CameraFileError has the line of a fault.
    read: Callable[[CameraFile], Trajectory | None]


def parse_numbers(words: Sequence[str]) -> list[float] | None:
    """Convert words to numbers, or return None if one of them is not a number or out of range."""
    try:
        numbers = [math.nan if "_" in word else float(word) for word in words]
    except ValueError:
        return None
    return numbers if all(abs(number) <= MAX_NUMBER for number in numbers) else None


def pose_fault(row: Sequence[float], previous: Sequence[float] | None) -> str:
    """Return fault and remedy of a row of time [s], position [m] and quaternion x, y, z, w; "" for a valid one.

    The previous row is for the order of times; None for the first.
    """
    if previous is not None and row[0] <= previous[0]:
        times = f"is at {row[0]:.15g} s, not after the previous pose at {previous[0]:.15g} s"
        return f"{times}; sort the poses by time, without equal times"
    if abs(math.hypot(*row[4:]) - 1) > NORM_TOLERANCE:
        return f"its quaternion has norm {math.hypot(*row[4:]):g} and is no rotation; normalise it to 1"
    return ""
