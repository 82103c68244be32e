"""Depths in the numbers of a depth map, and the pixels that have one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array


@dataclass(frozen=True, eq=False)
class Depths:
    """Depths along the viewing direction [m], shape (h, w), and the pixels that have one."""

    depth: Array  # any above 0 where there is none
    is_known: NDArray[np.bool_]

    @classmethod
    def of(cls, z: NDArray[Any], unit: float) -> Depths:
        """Return the depths of a file's numbers in `unit` [m], shape (h, w).

        Integers have no depth at 0 and at the largest value of their type, floats at NaN and infinity; neither has one
        below 0.
        """
        is_known = z > 0
        is_known &= z != np.iinfo(z.dtype).max if z.dtype.kind in "iu" else np.isfinite(z)
        return cls(np.where(is_known, z.astype(np.float64), 1.0) * unit, is_known)

    def from_distances(self, x: Array, y: Array) -> Depths:
        """Convert distances from the eye, for undistorted normalised coordinates of the pixels, shape (h, w)."""
        return Depths(self.depth / np.sqrt(1 + x * x + y * y), self.is_known)

    def within(self, is_sheet: NDArray[np.bool_]) -> Depths:
        """Return the depths without those outside a mask, shape (h, w)."""
        return Depths(self.depth, self.is_known & is_sheet)

    def filled(self, is_sheet: NDArray[np.bool_] | None = None) -> float:
        """Return the share of pixels without depth, of all or of those of a mask, shape (h, w)."""
        return float(1 - (self.is_known if is_sheet is None else self.is_known[is_sheet]).mean())
