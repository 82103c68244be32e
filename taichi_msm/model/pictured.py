"""A curved sheet at rest with a picture by a camera: places are fractions of that picture.

In a cell, h = P (X, 1) is interpolated bilinearly from its corners, as X is; P is the 3 x 4 projection of the camera to
undistorted pixels. The texel at (s, t) is distort(h_x / h_z, h_y / h_z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.cameras.view import View
from taichi_msm.model.geometry import CurvedRest, Origin
from taichi_msm.model.mask import EDGE_TOLERANCE, Mask

# Cells near a place that are tried before all others.
NEAR_CELLS = 32

# Largest distance of s and t from 0 to 1 in the cell of a place.
TOLERANCE = 1e-9

# Places of the picture this far from an edge of the sheet are on it, as the sheet's sides are straight, those of a
# picture by a lens are not [sides of a cell].
BORDER_TOLERANCE = 0.05

# Number of times that the outermost cell of a place beyond the picture is chosen.
CONTINUATIONS = 4

# Share of the way to a place beyond the picture over which the map of the camera is linearised.
LINEAR_STEP = 1e-3


@dataclass(frozen=True)
class Picture:
    """The picture by a camera, a region of its image."""

    view: View  # of the image, at the start
    region: tuple[int, int, int, int]  # x, y, width and height [px]

    @property
    def key(self) -> tuple[object, ...]:
        """Values that determine the map from the world to pixels."""
        return (self.view.matrix.tolist(), self.view.lens, self.view.scale.tolist(), self.view.centre.tolist())

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

    def __init__(self, position: Array, mask: Mask | None, picture: Picture, origin: Origin) -> None:
        super().__init__(position, mask, origin)
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

    def covers(self, fractions: Array, tolerance: float = EDGE_TOLERANCE) -> NDArray[np.bool_]:
        mesh = self.mesh_places(fractions)
        counts = np.array(self.position.shape[1::-1]) - 1
        covered = (np.abs(mesh - mesh.clip(0, 1)) * counts <= BORDER_TOLERANCE).all(axis=1)
        return covered if self.mask is None else covered & self.mask.covers(mesh.clip(0, 1), tolerance)

    def first_gap(self, start: Array, end: Array) -> float | None:
        if self.mask is None:
            return None
        count = 2 * max(self.position.shape[:2])
        places = self.mesh_places(start + np.linspace(0, 1, count + 1)[:, None] * (end - start))
        gaps = (self.mask.first_gap(*ends) for ends in pairwise(places))
        return next(((n + gap) / count for n, gap in enumerate(gaps) if gap is not None), None)

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
        counts = np.array(self.position.shape[1::-1]) - 1
        place = s_t + cells[:, ::-1]
        if (beyond := (inside != fractions).any(axis=1)).any():
            for _ in range(CONTINUATIONS):
                column, row = np.clip(np.floor(place[beyond]).astype(int), 0, counts - 1).T
                cell = np.stack([row, column], axis=1)
                start = place[beyond] - cell[:, ::-1]
                place[beyond] = cell[:, ::-1] + self._continue(fractions[beyond], inside[beyond], cell, start)
        return np.asarray(place / counts)

    def _nearest(self, pixels: Array, cells: NDArray[np.int_]) -> tuple[Array, NDArray[np.int_], Array]:
        """Find undistorted pixels, shape (n, 2), each in one of its cells, shape (n, k, 2).

        Return s and t, shape (n, 2), the cell, shape (n, 2), and the distance of (s, t) from the cell, shape (n,).
        """
        s_t, depth = self._solve(pixels[:, None], cells)
        miss = np.abs(s_t - np.clip(s_t, 0, 1)).max(axis=-1)
        miss = np.where((depth > 0) & np.isfinite(miss), miss, np.inf).reshape(len(pixels), 2 * cells.shape[1])
        hit, depth = miss <= TOLERANCE, depth.reshape(miss.shape)
        best = np.where(hit.any(axis=1), np.where(hit, depth, np.inf).argmin(axis=1), miss.argmin(axis=1))
        rows = np.arange(len(pixels))
        return s_t.reshape(*miss.shape, 2)[rows, best], cells[rows, best // 2], miss[rows, best]

    def _solve(self, pixels: Array, cells: NDArray[np.int_]) -> tuple[Array, Array]:
        """Return both s and t of undistorted pixels in cells, shape (..., 2, 2) from (..., 2), and h_z, (..., 2)."""
        h, (i, j) = self._projected, np.moveaxis(cells, -1, 0)
        corner = h[i, j]
        right, down = h[i, j + 1] - corner, h[i + 1, j] - corner
        twist = h[i + 1, j + 1] - corner - right - down
        # h_x - x h_z = 0 and h_y - y h_z = 0 are a + b s + c t + d s t = 0, so a + b s and c + d s are parallel.
        a, b, c, d = (each[..., :2] - pixels * each[..., 2:] for each in (corner, right, down, twist))
        square, linear, constant = _cross(b, d), _cross(a, d) + _cross(b, c), _cross(a, c)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            q = -(linear + np.copysign(np.sqrt(linear * linear - 4 * square * constant), linear)) / 2
            s = np.stack([q / square, constant / q], axis=-1)
            across, along = (
                each[..., None, :] + other[..., None, :] * s[..., None] for each, other in ((a, b), (c, d))
            )
            t = -(across * along).sum(axis=-1) / (along * along).sum(axis=-1)
            depth = corner[..., 2:] + right[..., 2:] * s + down[..., 2:] * t + twist[..., 2:] * s * t
        return np.stack([s, t], axis=-1), depth

    def _continue(self, fractions: Array, inside: Array, cells: NDArray[np.int_], start: Array) -> Array:
        """Return s and t of places beyond the picture in the cells of the nearest places, whose s and t are given."""

        def nearest_root(places: Array) -> tuple[Array, NDArray[np.bool_]]:
            s_t, depth = self._solve(self.picture.pixels(places), cells)
            change = np.abs(s_t - start[:, None]).max(axis=-1)
            change = np.where((depth > 0) & np.isfinite(change), change, np.inf)
            best, rows = change.argmin(axis=1), np.arange(len(places))
            return s_t[rows, best], np.isfinite(change[rows, best])

        s_t, is_seen = nearest_root(fractions)
        # Where the lens sees nothing, the map is continued linearly.
        back, _ = nearest_root(inside + LINEAR_STEP * (inside - fractions))
        return np.where(is_seen[:, None], s_t, start + (start - back) / LINEAR_STEP)


def _cross(a: Array, b: Array) -> Array:
    """Return the vector product of vectors in a plane, shape (...) from (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
