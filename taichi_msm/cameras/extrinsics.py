"""Position and orientation of a camera over time."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.scene.camera import Camera

# Signs that convert the axes right, up, toward the camera to OpenCV's right, down, forward.
OPENCV_SIGNS = np.array([[1.0], [-1.0], [-1.0]])


class Extrinsics(NamedTuple):
    """Position and orientation of a camera at a time."""

    eye: Array  # position [m], shape (3,)
    axes: Array  # unit vectors right, up and toward the camera, as rows, shape (3, 3)
    distance: float  # from the eye to the target; for a pose, to the centre of the sheet at rest [m]


def extrinsics(camera: Camera, time: float) -> Extrinsics:
    """Return the extrinsics of a camera without a reference camera, at a time [s]."""
    if camera.pose is not None:
        rotation = nearest_rotation(np.array(camera.pose.rotation))
        eye = -rotation.T @ np.array(camera.pose.translation)
        return Extrinsics(eye, rotation * OPENCV_SIGNS, float(np.linalg.norm(eye)))
    if camera.poses is not None:
        assert not isinstance(camera.poses, str)
        eye, rotation = interpolate_poses(camera.poses, time)
        return Extrinsics(eye, rotation.T * OPENCV_SIGNS, float(np.linalg.norm(eye)))
    assert camera.eye is not None
    eye, target, up = (interpolate_keyframes(value, time) for value in (camera.eye, camera.target, camera.up))
    return Extrinsics(np.array(eye), look_at_axes(eye, target, up), math.dist(eye, target))


def look_at_axes(eye: Sequence[float], target: Sequence[float], up: Sequence[float]) -> Array:
    """Return the axes of a camera, as in `Extrinsics`; `up`, of any length, is vertical in the picture."""
    toward = normalised(np.subtract(eye, target))
    right = normalised(np.cross(rescaled(np.array(up)), toward))
    return np.stack([right, np.cross(toward, right), toward])


def normalised(vector: Array) -> Array:
    """Return the unit vector; a zero vector is unchanged."""
    smaller = rescaled(vector)
    return smaller / (float(np.linalg.norm(smaller)) or 1.0)


def rescaled(vector: Array) -> Array:
    """Scale a vector by a power of 2, which is exact, so that its squares neither overflow nor underflow."""
    return np.ldexp(vector, -math.frexp(float(np.abs(vector).max()))[1])


def nearest_rotation(matrix: Array) -> Array:
    """Return the nearest orthonormal matrix."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def interpolate_keyframes(value: Sequence[float] | Sequence[Sequence[float]], time: float) -> Sequence[float]:
    """Return a constant vector as it is; interpolate keyframes (time [s], x, y, z) linearly, constant beyond them."""
    keys = np.array(value)
    if keys.ndim == 1:
        return value  # type: ignore[return-value]
    return [float(np.interp(time, keys[:, 0], keys[:, n])) for n in (1, 2, 3)]


def interpolate_poses(poses: Sequence[Sequence[float]], time: float) -> tuple[Array, Array]:
    """Return the eye, interpolated linearly, and the rotation from the camera to the world, by slerp."""
    from scipy.spatial.transform import Rotation, Slerp

    times = [row[0] for row in poses]
    n = min(max(bisect_right(times, time), 1), max(1, len(poses) - 1))
    rows = np.array(poses[n - 1 : n + 1])
    if len(rows) == 1:
        return rows[0, 1:4], Rotation.from_quat(rows[0, 4:]).as_matrix()
    clamped_time = min(max(time, rows[0, 0]), rows[1, 0])
    fraction = (clamped_time - rows[0, 0]) / (rows[1, 0] - rows[0, 0])
    rotation = Slerp(rows[:, 0], Rotation.from_quat(rows[:, 4:]))(clamped_time).as_matrix()
    return rows[0, 1:4] * (1 - fraction) + rows[1, 1:4] * fraction, rotation
