"""From where the mass points are to what is seen of them, and back: the derivative of a loss by the mass points.

Each point that was seen lies on the surface that is drawn, so it is a weighted mean of four mass points; between two
frames it goes in a straight line; and the camera sees it. The first two are linear, and going back is their transpose;
how pixels change with points is found by differences, whatever the camera is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.observations import Observations
from taichi_msm.physics.deformed import surface_weights
from taichi_msm.render.camera import view
from taichi_msm.scene import Scene

Array = NDArray[np.float64]

# By how much of the larger side of the sheet points are moved for a difference.
DIFFERENCE = 1e-6


class Sight:
    """What is seen of a scene's mass points.

    Args:
        scene: whose camera sees.
        seen: which points, and when.
        frames: how many are looked at, from the first one.
    """

    def __init__(self, scene: Scene, seen: Observations, frames: int) -> None:
        from scipy.sparse import csr_matrix

        self._scene, self._observations = scene, seen
        corners, weights = surface_weights(seen.coordinates, scene.sheet, scene.render.refine)
        number, (rows, cols) = np.arange(len(corners)), scene.sheet.points
        self._surface = csr_matrix((weights.ravel(), (number.repeat(4), corners.ravel())), (len(corners), rows * cols))
        self._between = between(scene, seen.time, frames)

    def on_sheet(self, position: Array) -> Array:
        """Give where the points are [m], shape (N, 3), for positions of one frame, shape (rows, cols, 3)."""
        return np.asarray(self._surface @ position.reshape(-1, 3))

    def at_times(self, at_frames: Array) -> Array:
        """Give where points are at the times, shape (N, T, 3), by where they are at frames, shape (frames, N, 3)."""
        at_times = self._between @ at_frames.reshape(len(at_frames), -1)
        return np.asarray(at_times.reshape(-1, *at_frames.shape[1:]).swapaxes(0, 1))

    def motion(self, at_frames: Array) -> Array:
        """Give the farthest that any of the points is from rest at each frame [m], by where they are there."""
        return np.asarray(
            np.linalg.norm(at_frames - places_at_rest(self._scene, self._observations), axis=2).max(axis=1)
        )

    def points(self, position: Array) -> Array:
        """Give where the points are [m], shape (N, T, 3), for positions of shape (frames, rows, cols, 3)."""
        return self.at_times(np.array([self.on_sheet(frame) for frame in position]))

    def seen(self, points: Array) -> Array:
        """Give what is seen of points, as in the observations, shape (N, T, 3 or 2); NaN: not seen by the camera."""
        if self._observations.kind == "position":
            return points
        return seen_by_camera(self._scene, points, self._observations.time)

    def backward(self, points: Array, slope: Array) -> Array:
        """Turn the derivative of a loss by what is seen into that by the positions of every frame.

        Args:
            points: that were seen [m], shape (N, T, 3).
            slope: derivative of the loss by what is seen of them, shape (N, T, 3 or 2).

        Returns:
            The derivative by the positions, shape (frames, rows, cols, 3).
        """
        if self._observations.kind == "pixel":
            by = DIFFERENCE * max(self._scene.sheet.size) * np.eye(3)
            changes = ((self.seen(points + one) - self.seen(points - one)) / (2 * one.sum()) for one in by)
            slope = np.stack([(slope * change).sum(axis=-1) for change in changes], axis=-1)
        at_frames = self._between.T @ slope.swapaxes(0, 1).reshape(slope.shape[1], -1)
        shape = *self._scene.sheet.points, 3
        return np.array([(self._surface.T @ frame.reshape(-1, 3)).reshape(shape) for frame in at_frames])


def in_frames(scene: Scene, time: Array) -> Array:
    """Count times in frames, without the rounding of their product."""
    return np.round(time * scene.time.frames_per_second, 6)


def between(scene: Scene, time: Array, frames: int) -> Any:
    """Give the shares of frames in what is seen at times, linear between them: a sparse matrix, shape (T, frames)."""
    from scipy.sparse import csr_matrix

    place, row = in_frames(scene, time), np.arange(len(time))
    before = np.clip(np.floor(place), 0, frames - 2).astype(int)
    shares, frame = np.stack([1 - place + before, place - before]), np.stack([before, before + 1])
    return csr_matrix((shares.ravel(), (np.tile(row, 2), frame.ravel())), (len(time), frames))


def places_at_rest(scene: Scene, seen: Observations) -> Array:
    """Give where points are at rest [m], shape (N, 3)."""
    height, width = scene.sheet.size
    across, down = seen.coordinates.T
    return np.stack([(across - 0.5) * width, (0.5 - down) * height, np.zeros_like(across)], axis=1)


def seen_by_camera(scene: Scene, points: Array, time: Array) -> Array:
    """Find where the scene's main camera sees points [m], shape (N, T, 3), at T times [s].

    Returns pixels from the picture's upper left corner, shape (N, T, 2); NaN: behind the eye, or beyond the lens.
    """
    return np.stack([view(scene, each).pixels(points[:, n]) for n, each in enumerate(time.tolist())], axis=1)


def seen_at_rest(scene: Scene, seen: Observations) -> Array:
    """Give what would be seen if the sheet stayed at rest, shape (N, T, 3 or 2)."""
    rest = np.repeat(places_at_rest(scene, seen)[:, None], len(seen.time), axis=1)
    return rest if seen.kind == "position" else seen_by_camera(scene, rest, seen.time)
