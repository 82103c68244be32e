"""cv2.remap: the picture warped by the displacement of the mass points, without light, depth or folds.

The map of remap has for every pixel x the source X with X + u(X) = x, by three fixed-point iterations of X = x - u(X).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.drawing.problem import POINTS, SIDE, Picture, Problem

ITERATIONS = 3


class Remap:
    """The maps, allocated once and filled for every picture."""

    def __init__(self, problem: Problem) -> None:
        pixels = problem.pixels
        self._rest, self._texture = problem.rest, problem.texture
        self._pixel = np.stack(np.meshgrid(*[np.arange(pixels, dtype=np.float32)] * 2), axis=-1)
        # From pixels to mass points and to texels, whose centres are at halves.
        self._to_points = (POINTS - 1) / pixels
        self._to_texels = self._texture.shape[0] / pixels

    def texels(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the source texel of each pixel, shape (pixels, pixels, 2)."""
        moved = (position - self._rest)[..., :2] * (np.array([1, -1], np.float32) * (self._pixel.shape[0] / SIDE))
        centre = (self._pixel + 0.5) * self._to_points
        source = centre
        for _ in range(ITERATIONS):
            back = cv2.remap(moved, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            source = centre - back * self._to_points
        return source * (self._to_texels / self._to_points) - 0.5

    def resample(self, texels: NDArray[Any], fractions: NDArray[np.uint16] | None = None) -> Picture:
        """Resample at texels, in float32 or in OpenCV's fixed point with separate fractions."""
        return cv2.remap(self._texture, texels, fractions, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def draw(self, position: NDArray[np.float32]) -> Picture:
        """Warp the picture."""
        return self.resample(self.texels(position))


def prepare(problem: Problem, threads: int | None) -> Remap:
    """Set up the maps."""
    if threads is not None:
        cv2.setNumThreads(threads)
    return Remap(problem)
