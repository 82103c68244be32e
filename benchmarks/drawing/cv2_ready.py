"""cv2.remap alone: its maps are made once, so that it draws this one position and no other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.drawing import cv2_
from benchmarks.drawing.problem import Artist, Picture, Problem


class Resampling:
    """A picture and its maps."""

    def __init__(self, problem: Problem, remap: cv2_.Remap) -> None:
        self._remap = remap
        self._texels = remap.texels(problem.position)

    def draw(self, position: NDArray[np.float32]) -> Picture:
        """Resample the picture."""
        del position
        return self._remap.resample(self._texels)


def prepare(problem: Problem, threads: int | None) -> Artist:
    """Make the maps."""
    return Resampling(problem, cv2_.prepare(problem, threads))
