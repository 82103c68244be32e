"""NumPy reference of sheets from depth maps: direct least squares, SciPy's splines, and the objective of even grids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole or fisheye camera."""

    focal: tuple[float, float]  # fx, fy [px]
    centre: tuple[float, float]  # from the corner of the picture: OpenCV's cx, cy + 1/2 [px]
    fisheye: tuple[float, ...] = ()  # k1 to k4
    rotation: Array = field(default_factory=lambda: np.diag([1.0, -1.0, -1.0]))  # from the world to the camera
    translation: Array = field(default_factory=lambda: np.zeros(3))  # [m]

    def sights(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return x / z and y / z of the lines of sight of pixels."""
        x, y = (x - self.centre[0]) / self.focal[0], (y - self.centre[1]) / self.focal[1]
        return x * (scale := np.vectorize(self._undistort)(np.hypot(x, y))), y * scale

    def _undistort(self, radius: float) -> float:
        """Return r / r_d, r = tan(t), r_d = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)."""
        if not self.fisheye or radius == 0:
            return 1.0

        def excess(t: float) -> float:
            return t * (1 + sum(k * t ** (2 * n + 2) for n, k in enumerate(self.fisheye))) - radius

        return float(np.tan(brentq(excess, 0, 1.5, xtol=1e-15, rtol=1e-15)) / radius)

    def to_world(self, points: Array) -> Array:
        """Return points [m], shape (..., 3), from the camera's axes."""
        return np.asarray((points - self.translation) @ self.rotation)


@dataclass(frozen=True)
class Map:
    """Depth map of a region of a picture."""

    numbers: NDArray[Any]  # of the whole picture, shape (h, w)
    unit: float  # [m]
    camera: Camera
    smooth: float  # [px]
    along: str = "axis"
    region: Sequence[int] | None = None
    is_sheet: NDArray[np.bool_] | None = None  # of the pixels of the region

    @property
    def box(self) -> tuple[int, int, int, int]:
        height, width = self.numbers.shape
        left, top, across, down = self.region or (0, 0, width, height)
        return left, top, across, down

    def inverse_depth(self) -> Array:
        """Return e_s [1/m] of the pixels of the region."""
        left, top, width, height = self.box
        z = self.numbers[top : top + height, left : left + width]
        known = np.isfinite(z) & (z > 0)
        if z.dtype.kind in "iu":
            known &= z != np.iinfo(z.dtype).max
        if self.is_sheet is not None:
            known &= self.is_sheet
        column, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        x, y = self.camera.sights(left + column + 0.5, top + row + 0.5)
        depth = np.where(known, z, 1.0) * self.unit
        if self.along == "ray":
            depth = depth / np.sqrt(x**2 + y**2 + 1)
        e, result = 1 / depth, np.empty(z.shape)
        for i in range(height):
            for j in range(width):
                if self.smooth == 0 and known[i, j]:
                    result[i, j] = e[i, j]
                    continue
                weight, used = gaussian(row - i, column - j, known, self.smooth or 1.0), known
                root = np.sqrt(weight[used])
                design = np.stack([root, root * (x[used] - x[i, j]), root * (y[used] - y[i, j])], axis=1)
                result[i, j] = np.linalg.lstsq(design, root * e[used], rcond=None)[0][0]
        return result

    def surface(self, places: Array) -> Array:
        """Return X at fractions of the region, shape (..., 3) from (..., 2)."""
        (left, top, width, height), e = self.box, self.inverse_depth()
        x, y = places[..., 0].ravel() * width, places[..., 1].ravel() * height
        down = CubicSpline(np.arange(height) + 0.5, e)(y)
        at = np.array([CubicSpline(np.arange(width) + 0.5, line)(at) for line, at in zip(down, x, strict=True)])
        a, b = self.camera.sights(left + x, top + y)
        points = np.stack([a, b, np.ones_like(a)], axis=1) / at[:, None]
        return self.camera.to_world(points).reshape(*places.shape[:-1], 3)


def gaussian(down: NDArray[Any], across: NDArray[Any], known: NDArray[np.bool_], deviation: float) -> Array:
    """Return G at offsets [px], twice as wide until its sum over known pixels is 0.001."""
    while True:
        end = int(8 * deviation + 0.5)
        total = np.exp(-0.5 * (np.arange(-end, end + 1) / deviation) ** 2).sum() ** 2
        weight = np.exp(-0.5 * (down**2 + across**2) / deviation**2) / total
        weight[(np.abs(down) > end) | (np.abs(across) > end)] = 0
        if weight[known].sum() >= 1e-3:
            return np.asarray(weight)
        deviation *= 2


def given(points: tuple[int, int]) -> Array:
    """Return the grid `given`, shape (rows, cols, 2)."""
    rows, cols = points
    return np.array([[(j / (cols - 1), i / (rows - 1)) for j in range(cols)] for i in range(rows)])


def objective(position: Array, mean_area: float) -> float:
    """Return the least objective of an even grid over r > 0, of positions, shape (rows, cols, 3)."""
    e, g, area = corners(position)
    r = np.sqrt((e / area).mean() / (g / area).mean())
    return float(((e / r + g * r) / (2 * area) + 0.01 * (area / mean_area + mean_area / area)).mean())


def corners(position: Array) -> tuple[Array, Array, Array]:
    """Return E, G and A of the four corners of all cells."""
    rows, cols = position.shape[:2]
    sides = []
    for i in range(rows - 1):
        for j in range(cols - 1):
            top, bottom = position[i, j + 1] - position[i, j], position[i + 1, j + 1] - position[i + 1, j]
            left, right = position[i + 1, j] - position[i, j], position[i + 1, j + 1] - position[i, j + 1]
            sides += [(a, b) for a in (top, bottom) for b in (left, right)]
    a, b = (np.array(each) for each in zip(*sides, strict=True))
    return (a**2).sum(axis=1), (b**2).sum(axis=1), np.linalg.norm(np.cross(a, b), axis=1)


def mean_cell_area(position: Array) -> float:
    """Return the mean area of cells, whose sides are the means of opposite ones."""
    a = position[:-1, 1:] - position[:-1, :-1] + position[1:, 1:] - position[1:, :-1]
    b = position[1:, :-1] - position[:-1, :-1] + position[1:, 1:] - position[:-1, 1:]
    return float(np.linalg.norm(np.cross(a / 2, b / 2), axis=-1).mean())
