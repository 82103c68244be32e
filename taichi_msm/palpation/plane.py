"""Plane of the places: x along their longest extent, y to its left, and height out of the tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from taichi_msm.arithmetic import Array

# Number of places from which the height of the tissue is interpolated.
NEIGHBOURS = 8

# Least width of places in a plane over their length.
MIN_WIDTH_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Plane:
    """Rectangle around places in their plane."""

    origin: Array  # mean of the places [m], shape (3,)
    axes: Array  # unit vectors of x, y and height, shape (3, 3)
    places: Array  # x, y and height of the places [m], shape (n, 3)
    low: Array  # corner of the least x and y [m], shape (2,)
    size: tuple[float, float]  # along x and y [m]

    def from_space(self, points: Array) -> Array:
        """Return x, y and height [m] of points in space [m], shape (k, 3)."""
        return np.asarray((points - self.origin) @ self.axes.T)

    def pixels(self, rows: int, cols: int) -> Array:
        """Return the centres of pixels over the rectangle, on the tissue in space [m], shape (rows, cols, 3).

        The first row has the greatest y.
        """
        across, down = ((np.arange(n) + 0.5) / n for n in (cols, rows))
        x, y = self.low[0] + across * self.size[0], self.low[1] + (1 - down) * self.size[1]
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        distances, nearest = cKDTree(self.places[:, :2]).query(points, min(NEIGHBOURS, len(self.places)))
        weights = 1 / (distances**2 + (1e-3 * max(self.size)) ** 2)
        heights = (weights * self.places[nearest, 2]).sum(axis=1) / weights.sum(axis=1)
        return np.asarray(self.origin + np.column_stack([points, heights]) @ self.axes).reshape(rows, cols, 3)

    def fractions(self, point: Array) -> tuple[float, float]:
        """Return across and down of a point in space [m], shape (3,)."""
        x, y, _ = self.from_space(point)
        return float((x - self.low[0]) / self.size[0]), float(1 - (y - self.low[1]) / self.size[1])


def find_plane(places: Array, normal: Array, margin: float) -> Plane:
    """Return the plane of places, with a margin around them [m]; `normal`: direction out of the tissue."""
    origin = places.mean(axis=0)
    _, extents, (x, _, z) = np.linalg.svd(places - origin)
    if extents[1] < MIN_WIDTH_SHARE * extents[0]:  # places on a line are in any plane through it
        z = normal - (normal @ x) * x
        z /= np.linalg.norm(z)
    x, z = x * _sign(x[np.abs(x).argmax()]), z * _sign(z @ normal)
    axes = np.array([x, np.cross(z, x), z])
    inside = (places - origin) @ axes.T
    low, high = inside.min(axis=0)[:2] - margin, inside.max(axis=0)[:2] + margin
    return Plane(origin, axes, inside, low, (float(high[0] - low[0]), float(high[1] - low[1])))


def _sign(value: float) -> float:
    return -1.0 if value < 0 else 1.0
