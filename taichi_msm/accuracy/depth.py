"""Steps in the numbers of a depth map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from taichi_msm.model.geometry import CurvedRest
from taichi_msm.scene.surface import RestSurface
from taichi_msm.surfaces.depths import Depths

# Numbers are in steps with at most this many values, and with this share of equal neighbours in rows or columns.
MAX_VALUES, EQUAL_NEIGHBOURS = 4096, (0.05, 0.95)

# Largest slope that a smooth step may add.
MAX_SLOPE = 0.1


class DepthSteps(NamedTuple):
    """Steps of a depth map."""

    size: float  # [m]
    smooth: float  # standard deviation at which a step is no steeper than MAX_SLOPE [px]


def depth_steps(surface: RestSurface, rest: CurvedRest) -> DepthSteps | None:
    """Return the steps of a depth map in the region of its picture; None without steps, and for other kinds."""
    if surface.depth is None or surface.frame is None:
        return None
    x, y, width, height = surface.frame.region
    numbers = surface.depth.numbers.values[y : y + height, x : x + width]
    is_known = Depths.of(numbers, 1.0).is_known
    values = np.unique(numbers[is_known]).astype(float)
    if not 1 < len(values) <= MAX_VALUES or not _has_plateaus(np.where(is_known, numbers, np.nan)):
        return None
    size = float(np.median(np.diff(values))) * surface.depth.metres
    pixel = (rest.sides[0] / height + rest.sides[1] / width) / 2
    # A step s between two planes becomes s times the integral of a Gaussian, of the slope s / (deviation (2 pi)^(1/2)).
    return DepthSteps(size, size / (MAX_SLOPE * pixel * np.sqrt(2 * np.pi)))


def _has_plateaus(numbers: np.ndarray) -> bool:
    """Return whether some but not all neighbours in rows or in columns are equal; NaN is not a neighbour."""
    low, high = EQUAL_NEIGHBOURS
    for axis in (0, 1):
        change = np.diff(numbers, axis=axis)
        if (is_pair := np.isfinite(change)).any() and low < (change[is_pair] == 0).mean() < high:
            return True
    return False
