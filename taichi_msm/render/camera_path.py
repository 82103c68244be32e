"""Where a pinhole camera is over time: its eye and its axes."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.scene import Camera

Array = NDArray[np.float64]

# From the axes right, up, toward the camera to OpenCV's right, down, forward, and back.
OPENCV = np.array([[1.0], [-1.0], [-1.0]])


class Placed(NamedTuple):
    """A camera at one time."""

    eye: Array  # [m], shape (3,)
    axes: Array  # unit vectors right, up and toward the camera, as rows, shape (3, 3)
    distance: float  # from the eye to the point that it looks at, for a pose to the middle of the sheet at rest [m]


def placed(camera: Camera, time: float) -> Placed:
    """Place a camera at a time [s]."""
    if camera.pose is not None:
        turn = nearest_rotation(np.array(camera.pose.rotation))
        eye = -turn.T @ np.array(camera.pose.translation)
        return Placed(eye, turn * OPENCV, float(np.linalg.norm(eye)))
    if camera.poses is not None:
        assert not isinstance(camera.poses, str)
        eye, turn = _interpolate(camera.poses, time)
        return Placed(eye, turn.T * OPENCV, float(np.linalg.norm(eye)))
    assert camera.eye is not None
    eye, target, up = (at_time(value, time) for value in (camera.eye, camera.target, camera.up))
    return Placed(np.array(eye), axes(eye, target, up), math.dist(eye, target))


def axes(eye: Sequence[float], target: Sequence[float], up: Sequence[float]) -> Array:
    """Give the unit vectors right, up and toward the eye of a camera, as rows, shape (3, 3)."""
    toward = unit(np.subtract(eye, target))
    right = unit(np.cross(scaled(np.array(up)), toward))
    return np.stack([right, np.cross(toward, right), toward])


def unit(vector: Array) -> Array:
    """Give a vector the length 1; a vector of zeros stays."""
    smaller = scaled(vector)
    return smaller / (float(np.linalg.norm(smaller)) or 1.0)


def scaled(vector: Array) -> Array:
    """Multiply a vector by a power of 2, which is exact, so that squares of it neither overflow nor vanish."""
    return np.ldexp(vector, -math.frexp(float(np.abs(vector).max()))[1])


def nearest_rotation(matrix: Array) -> Array:
    """Give the orthonormal matrix that is nearest to a matrix."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def at_time(value: Sequence[float] | Sequence[Sequence[float]], time: float) -> Sequence[float]:
    """Give a vector, or keys of one, at a time: linear between them, held outside."""
    keys = np.array(value)
    if keys.ndim == 1:
        return value  # type: ignore[return-value]
    return [float(np.interp(time, keys[:, 0], keys[:, n])) for n in (1, 2, 3)]


def _interpolate(poses: Sequence[Sequence[float]], time: float) -> tuple[Array, Array]:
    """Give the eye and the rotation from the camera to the world at a time; places linear, rotations by slerp."""
    from scipy.spatial.transform import Rotation, Slerp

    times = [row[0] for row in poses]
    n = min(max(bisect_right(times, time), 1), max(1, len(poses) - 1))
    rows = np.array(poses[n - 1 : n + 1])
    if len(rows) == 1:
        return rows[0, 1:4], Rotation.from_quat(rows[0, 4:]).as_matrix()
    here = min(max(time, rows[0, 0]), rows[1, 0])
    share = (here - rows[0, 0]) / (rows[1, 0] - rows[0, 0])
    turn = Slerp(rows[:, 0], Rotation.from_quat(rows[:, 4:]))(here).as_matrix()
    return rows[0, 1:4] * (1 - share) + rows[1, 1:4] * share, turn
