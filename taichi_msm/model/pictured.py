"""A curved sheet at rest with a picture by a camera: places are fractions of that picture.

In a cell, h = P (X, 1) is interpolated bilinearly from its corners, as X is; P is the 3 x 4 projection of the camera to
undistorted pixels. The texel at (s, t) is distort(h_x / h_z, h_y / h_z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.cameras.view import View
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.mask import Mask

# Cells near a place that are tried before all others.
NEAR_CELLS = 32

# Newton's steps to the coordinates of a place in a cell, which are within [0, 1] up to TOLERANCE.
NEWTON_STEPS, TOLERANCE = 20, 1e-9

# Share of the way to a place beyond the picture over which the map of the camera is linearised.
LINEAR_STEP = 1e-3


@dataclass(frozen=True)
class Picture:
    """The picture by a camera, a region of its image."""

    view: View  # of the image, at the start
    region: tuple[int, int, int, int]  # x, y, width and height [px]

    def pixels(self, fractions: Array) -> Array:
        """Return the undistorted pixels at fractions of the picture, shape (..., 2) each; NaN beyond the lens."""
        x, y, *size = self.region
        return self.view.undistort((x, y) + np.array(size) * fractions)

    def fractions(self, projected: Array) -> Array:
        """Return the fractions of the picture, shape (..., 2), for h, shape (..., 3); NaN behind the camera."""
        x, y, *size = self.region
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.where(projected[..., 2:] > 0, projected[..., :2] / projected[..., 2:], np.nan)
        return (self.view.distort(pixels) - (x, y)) / np.array(size)

    def project(self, points: Array) -> Array:
        """Return h of points [m], shape (..., 3) each."""
        return self.view.project(points)[..., :3]

    def at_cells(self, position: Array) -> Array:
        """Return the fractions that cells show at their middle, shape (rows - 1, cols - 1, 2)."""
        h = self.project(position)
        return self.fractions(h[:-1, :-1] + h[:-1, 1:] + h[1:, :-1] + h[1:, 1:])


class PicturedRest(CurvedRest):
    """Mass points in space with the picture of a camera; coordinates are fractions of the picture across and down."""

    def __init__(self, position: Array, mask: Mask | None, picture: Picture) -> None:
        super().__init__(position, mask)
        self.picture = picture
        self._projected = picture.project(position)
        # The last argument and result of `mesh_places`.
        self._kept: tuple[bytes, Array] = b"", np.empty((0, 2))

    @cached_property
    def texture(self) -> Array:
        """Fractions of the picture across and down at the mass points, shape (rows, cols, 2)."""
        return self.picture.fractions(self._projected)

    @property
    def cell_places(self) -> tuple[Array, Array]:
        across, down = np.moveaxis(self.picture.at_cells(self.position), -1, 0)
        return across, down

    @property
    def point_places(self) -> tuple[Array, Array]:
        return self.texture[..., 0], self.texture[..., 1]

    def sheet_places(self, mesh: Array) -> Array:
        return self.picture.fractions(self._interpolate(self._projected, mesh))

    def mesh_places(self, fractions: Array) -> Array:
        key = np.ascontiguousarray(fractions, float).tobytes()
        if self._kept[0] != key:
            self._kept = key, self._invert(fractions)
        return self._kept[1]

    def _invert(self, fractions: Array) -> Array:
        """Return (u, v) of places, shape (n, 2) each; of several, that nearest to the eye."""
        from scipy.spatial import cKDTree

        inside = np.clip(fractions, 0, 1)
        pixels, present, h = self.picture.pixels(inside), np.argwhere(self.present), self._projected
        i, j = present.T
        middle = h[i, j] + h[i, j + 1] + h[i + 1, j] + h[i + 1, j + 1]
        count = min(NEAR_CELLS, len(present))
        _, near = cKDTree(middle[:, :2] / middle[:, 2:]).query(np.nan_to_num(pixels), count)
        s_t, cells, misses = self._nearest(pixels, present[near.reshape(-1, count)])
        for n in np.flatnonzero(misses > TOLERANCE):
            # Of slender cells, whose middles are far; and without sheet, where the nearest cell is continued.
            s_t[n], cells[n], _ = (each[0] for each in self._nearest(pixels[n : n + 1], present[None]))
        if (beyond := (inside != fractions).any(axis=1)).any():
            s_t[beyond] = self._continue(fractions[beyond], inside[beyond], cells[beyond], s_t[beyond])
        rows, cols = self.position.shape[:2]
        return np.asarray((s_t + cells[:, ::-1]) / (cols - 1, rows - 1))

    def _nearest(self, pixels: Array, cells: NDArray[np.int_]) -> tuple[Array, NDArray[np.int_], Array]:
        """Find undistorted pixels, shape (n, 2), each in one of its cells, shape (n, k, 2).

        Return s and t, shape (n, 2), the cell, shape (n, 2), and the distance of (s, t) from the cell, shape (n,).
        """
        s_t, depth = self._solve(pixels[:, None], cells, np.full((*cells.shape[:2], 2), 0.5))
        miss = np.abs(s_t - np.clip(s_t, 0, 1)).max(axis=-1)
        miss = np.where((depth > 0) & np.isfinite(miss), miss, np.inf)
        hit = miss <= TOLERANCE
        best = np.where(hit.any(axis=1), np.where(hit, depth, np.inf).argmin(axis=1), miss.argmin(axis=1))
        rows = np.arange(len(pixels))
        return s_t[rows, best], cells[rows, best], miss[rows, best]

    def _solve(self, pixels: Array, cells: NDArray[np.int_], start: Array) -> tuple[Array, Array]:
        """Return s and t of undistorted pixels in cells, shape (..., 2) each, and h_z there, by Newton's method."""
        h, (i, j) = self._projected, np.moveaxis(cells, -1, 0)
        a = h[i, j]
        b, c = h[i, j + 1] - a, h[i + 1, j] - a
        d = h[i + 1, j + 1] - a - b - c
        s, t = np.moveaxis(start, -1, 0)
        # The equations h_x - x h_z = 0 and h_y - y h_z = 0.
        (a_x, b_x, c_x, d_x), (a_y, b_y, c_y, d_y) = (
            [k[..., n] - pixels[..., n] * k[..., 2] for k in (a, b, c, d)] for n in (0, 1)
        )
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(NEWTON_STEPS):
                f, g = a_x + b_x * s + c_x * t + d_x * s * t, a_y + b_y * s + c_y * t + d_y * s * t
                f_s, f_t, g_s, g_t = b_x + d_x * t, c_x + d_x * s, b_y + d_y * t, c_y + d_y * s
                determinant = f_s * g_t - f_t * g_s
                s, t = s - (f * g_t - g * f_t) / determinant, t - (f_s * g - g_s * f) / determinant
            return np.stack([s, t], axis=-1), a[..., 2] + b[..., 2] * s + c[..., 2] * t + d[..., 2] * s * t

    def _continue(self, fractions: Array, inside: Array, cells: NDArray[np.int_], start: Array) -> Array:
        """Return s and t of places beyond the picture in the cells of the nearest places, whose s and t are given."""
        s_t, depth = self._solve(self.picture.pixels(fractions), cells, start)
        # Where the lens sees nothing, the map is continued linearly.
        back, _ = self._solve(self.picture.pixels(inside + LINEAR_STEP * (inside - fractions)), cells, start)
        is_seen = np.isfinite(s_t).all(axis=1) & (depth > 0)
        return np.where(is_seen[:, None], s_t, start + (start - back) / LINEAR_STEP)
