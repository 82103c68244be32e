"""scikit-image's PiecewiseAffineTransform: the picture warped by the triangles of the mass points, without light.

Without refinement: each triangle costs a pass over the picture, and 331 x 331 vertices would take minutes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.transform import PiecewiseAffineTransform, warp

from benchmarks.drawing.problem import SIDE, Picture, Problem
from benchmarks.process import UnavailableError


class Warp:
    """The mass points in texels."""

    def __init__(self, problem: Problem) -> None:
        self._pixels, self._texture = problem.pixels, problem.texture
        self._texels = self._on(problem.rest, self._texture.shape[0])

    def draw(self, position: NDArray[np.float32]) -> Picture:
        """Estimate the transform and warp the picture."""
        transform = PiecewiseAffineTransform.from_estimate(self._on(position, self._pixels), self._texels)
        shape = (self._pixels, self._pixels)
        warped = warp(self._texture, transform, output_shape=shape, mode="edge", preserve_range=True)
        return (warped + 0.5).astype(np.uint8)

    @staticmethod
    def _on(position: NDArray[np.float32], size: int) -> NDArray[np.float64]:
        """Return points in a picture of `size` pixels; the centres of pixels are at integers."""
        points = (position[..., :2].astype(float) * [1, -1] / SIDE + 0.5) * size - 0.5
        return points.reshape(-1, 2)


def prepare(problem: Problem, threads: int | None) -> Warp:
    """Set up the warp; scikit-image has one thread."""
    del threads
    if not hasattr(PiecewiseAffineTransform, "from_estimate"):
        raise UnavailableError("needs scikit-image 0.26")
    return Warp(problem)
