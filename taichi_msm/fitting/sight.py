"""From where the mass points are to what is seen of them, and back: the derivative of a loss by the mass points.

The same as `prediction` does frame by frame, of all frames at once: each point that was seen is a weighted mean of four
mass points, and of two frames, and the camera sees it. The first two are linear, and going back is their transpose; how
pixels change with points is found by differences, whatever the camera is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.observations import Observations
from taichi_msm.fitting.prediction import between, seen_by_camera
from taichi_msm.physics.deformed import surface_weights
from taichi_msm.scene import Scene

Array = NDArray[np.float64]

# By how much of the larger side of the sheet points are moved for a difference.
DIFFERENCE = 1e-6


class Sight:
    """What is seen of a scene's mass points.

    Args:
        scene: whose camera sees.
        seen: which points, and when.
        frames: how many the scene has.
    """

    def __init__(self, scene: Scene, seen: Observations, frames: int) -> None:
        from scipy.sparse import csr_matrix

        self._scene, self._time, self._pixels = scene, seen.time, seen.kind == "pixel"
        corners, weights = surface_weights(seen.coordinates, scene.sheet, scene.render.refine)
        number, (rows, cols) = np.arange(len(corners)), scene.sheet.points
        self._surface = csr_matrix((weights.ravel(), (number.repeat(4), corners.ravel())), (len(corners), rows * cols))
        self._between = between(np.eye(frames), np.round(seen.time * scene.time.frames_per_second, 6))

    def points(self, position: Array) -> Array:
        """Give where the points are [m], shape (N, T, 3), for positions of shape (frames, rows, cols, 3)."""
        at_frames = np.array([self._surface @ frame.reshape(-1, 3) for frame in position])
        return np.einsum("tf,fnc->ntc", self._between, at_frames)

    def seen(self, points: Array) -> Array:
        """Give what is seen of points, as in the observations, shape (N, T, 3 or 2)."""
        return seen_by_camera(self._scene, points, self._time) if self._pixels else points

    def backward(self, points: Array, slope: Array) -> Array:
        """Turn the derivative of a loss by what is seen into that by the positions of every frame.

        Args:
            points: that were seen [m], shape (N, T, 3).
            slope: derivative of the loss by what is seen of them, shape (N, T, 3 or 2).

        Returns:
            The derivative by the positions, shape (frames, rows, cols, 3).
        """
        if self._pixels:
            by = DIFFERENCE * max(self._scene.sheet.size) * np.eye(3)
            changes = ((self.seen(points + one) - self.seen(points - one)) / (2 * one.sum()) for one in by)
            slope = np.stack([(slope * change).sum(axis=-1) for change in changes], axis=-1)
        at_frames = np.einsum("tf,ntc->fnc", self._between, slope)
        shape = *self._scene.sheet.points, 3
        return np.array([(self._surface.T @ frame).reshape(shape) for frame in at_frames])
