"""Trajectory of a camera, and the interface of its readers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from taichi_msm.camera_files.camera_file import CameraFile

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Largest error of the norm of a quaternion, and of the entries of R R^T.
NORM_TOLERANCE = 1e-3

# Largest number in a trajectory.
MAX_NUMBER = 1e30

COLUMNS = ("t", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


# Number of the line, for messages, None in files without lines; time (or the number of the picture, without times),
# position x, y, z and quaternion x, y, z, w, from the camera to the world.
Row = tuple[int | None, Sequence[float]]

# Numbers in the names of pictures: a time, and the last number, which is matched in the reversed name. Longer numbers
# are neither times nor counts.
TIME = re.compile(r"(?:.*\D)?(\d{1,30}\.\d{1,30})")
REVERSED_END = re.compile(r"\D*(\d{1,30})")


class Trajectory(NamedTuple):
    """Poses of a camera, in the units of the file."""

    rows: Sequence[Row]
    has_times: bool  # whether the file contains times
    time_unit: str | None = None  # unit of times in the header; None without one
    length_unit: str | None = None  # unit of lengths in the header; None without one


class TrajectoryReader(NamedTuple):
    """Reader of a format of trajectories."""

    name: str  # name of the format, for users
    recognised_by: str  # content by which a file is recognised, for users
    examples: tuple[str, ...]  # keys of a camera that read such files, for users
    # Function that returns the trajectory, or None for another format; a CameraFileError has the line of a fault.
    read: Callable[[CameraFile], Trajectory | None]
    unit: float = 1.0  # unit of lengths in files that do not state one [m]


def parse_numbers(words: Sequence[str]) -> list[float] | None:
    """Convert words to numbers, or return None if one of them is not a number or out of range."""
    try:
        numbers = [math.nan if "_" in word else float(word) for word in words]
    except ValueError:
        return None
    return numbers if all(abs(number) <= MAX_NUMBER for number in numbers) else None


def picture_numbers(names: Sequence[str]) -> tuple[list[float], bool]:
    """Return times in the names of pictures [s], else their last numbers, else their ranks; and whether it is times."""
    stems = [name.rpartition(".")[0] or name for name in names]
    # Times as names, such as 1305031102.975304.png.
    times = [float(match[1]) for stem in stems if (match := TIME.fullmatch(stem))]
    if len({*times}) == len(names):
        return times, True
    ends = [REVERSED_END.match(stem[::-1]) for stem in stems]
    numbers: list[float] = [int(end[1][::-1]) for end in ends if end]
    if len({*numbers}) < len(names):
        ranks = {index: rank for rank, index in enumerate(sorted(range(len(names)), key=names.__getitem__))}
        numbers = [ranks[index] for index in range(len(names))]
    return numbers, False


def build_rows(
    file: CameraFile, lines: Sequence[int | None], numbers: Sequence[float], matrices: NDArray[np.float64]
) -> list[Row]:
    """Return the rows of matrices [R, t] from the camera to the world, shape (N, 3, 4), with lines and numbers."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    rotations = matrices[:, :, :3]
    deviations = abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    if (faults := ~(deviations <= NORM_TOLERANCE) | (np.linalg.det(rotations) < 0)).any():
        fault = "its first three columns are not a rotation; write an orthonormal matrix"
        raise file.fault(fault, lines[int(faults.argmax())])
    quaternions = Rotation.from_matrix(rotations).as_quat()
    rows = np.column_stack([numbers, matrices[:, :, 3], quaternions]).tolist()
    return list(zip(lines, rows, strict=True))


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
