"""Picking: the material point at a pixel (column, row), counted from (0, 0); the inverse of projection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.cameras.view import View
from taichi_msm.model.crossings import cells_on_line
from taichi_msm.model.geometry import Rest
from taichi_msm.model.mask import Mask
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.sheet import Sheet

# Number of cells that are processed at a time, to bound the memory.
CELLS_PER_BATCH = 1024

Pair = tuple[float, float]


def pick(position: NDArray[np.floating], refine: int, view: View, pixel: Pair, mask: Mask | None = None) -> Pair | None:
    """Return the material point at the centre of a pixel, on the nearest triangle there; None without a surface.

    It is in fractions (u, v) of columns and rows. `position` are the positions
    of the mass points [m], shape (rows, cols, 3); `mask` has the cells that are sheet, by default all.

    A point (X, Y, w, depth) projects to (x, y) if a = X - x w and b = Y - y w are 0. Both are linear, and need no
    division by w, which is 0 or negative behind the camera.
    """
    rows, cols = position.shape[:2]
    ray = view.centred_at(pixel)
    hits: list[tuple[float, Pair]] = []
    on_line = cells_on_line(position @ row[:3] + row[3] for row in ray.matrix[:2])
    cells = np.argwhere(on_line if mask is None else on_line & mask.cells)
    for first in range(0, len(cells), CELLS_PER_BATCH):
        i, j = cells[first : first + CELLS_PER_BATCH].T
        corners = np.stack([position[i + below, j + right] for below in (0, 1) for right in (0, 1)], axis=1)
        hits += _hits_in_cells(ray.project(corners), i, j, refine, view.near)
    if not hits:
        return None
    _, (column, row) = min(hits)
    return column / (cols - 1), row / (rows - 1)


def pick_at_rest(sheet: Sheet, refine: int, view: View, pixel: Pair) -> Pair | None:
    """Return the place (across, down) of the sheet at rest that a pixel shows; None without one.

    The plane of a flat sheet continues beyond its edges, and every sheet in cells without sheet.
    """
    rest = rest_of(sheet)
    if not rest.is_flat:
        return place_on_sheet(rest, pick(rest.position, refine, view, pixel))
    point = intersect_rest_plane(view, pixel)
    if point is None:
        return None
    across, down = rest.fractions(point.astype(np.float64)).tolist()
    return across, down


def place_on_sheet(rest: Rest, mesh: Pair | None) -> Pair | None:
    """Return the place (across, down) at (u, v), if any."""
    if mesh is None:
        return None
    across, down = rest.sheet_places(np.array([mesh]))[0].tolist()
    return across, down


def intersect_rest_plane(view: View, pixel: Pair) -> Array | None:
    """Return x and y [m] of the point of a flat sheet's plane at rest that a pixel shows; None without one."""
    matrix = view.centred_at(pixel).matrix
    planar = matrix[:2, :2]
    # Outside of a lens's image the matrix is NaN.
    is_finite = np.isfinite(planar).all()
    if not is_finite or not abs(np.linalg.det(planar)) > 1e-9 * np.linalg.norm(planar, axis=1).prod():
        return None
    point: Array = np.asarray(np.linalg.solve(planar, -matrix[:2, 3]), dtype=float)
    return point if matrix[2] @ [*point, 0, 1] > view.near else None


def _hits_in_cells(
    corners: Array, i: NDArray[np.intp], j: NDArray[np.intp], refine: int, near: float
) -> list[tuple[float, Pair]]:
    """Return the depth [m] and the position (column, row) on the sheet [cells] of each hit in some cells."""
    subdivisions = refine + 1
    fractions = np.arange(subdivisions + 1) / subdivisions
    s, t = fractions[:, None], fractions[:, None, None]
    a, right, down, opposite = (corners[:, None, None, n] for n in range(4))
    vertex = a + (right - a) * s + (down - a) * t + (opposite - right - down + a) * s * t
    quads = np.stack([vertex[:, :-1, :-1], vertex[:, :-1, 1:], vertex[:, 1:, :-1], vertex[:, 1:, 1:]], axis=-2)
    # Select the sub-quads in which a and b may both be 0.
    low, high = quads[..., :2].min(axis=-2), quads[..., :2].max(axis=-2)
    cell, quad_row, quad_column = np.nonzero(((low <= 0) & (high >= 0)).all(axis=-1))
    quad = quads[cell, quad_row, quad_column]
    hits: list[tuple[float, Pair]] = []
    for third in (1, 2):  # index of the corner off the diagonal: upper right, lower left
        triangle = quad[:, [0, third, 3]]
        p, q, r = np.moveaxis(triangle[..., :2], 1, 0)
        weights = np.stack([_cross(q, r), _cross(r, p), _cross(p, q)], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            weights /= weights.sum(axis=-1, keepdims=True)
        w, depth = np.moveaxis((weights[..., None] * triangle[..., 2:]).sum(axis=1), -1, 0)
        for n in np.flatnonzero((weights >= 0).all(axis=-1) & (w > near)):
            x = j[cell[n]] + (quad_column[n] + weights[n, 2] + (third == 1) * weights[n, 1]) / subdivisions
            y = i[cell[n]] + (quad_row[n] + weights[n, 2] + (third == 2) * weights[n, 1]) / subdivisions
            hits.append((float(depth[n]), (float(x), float(y))))
    return hits


def _cross(p: Array, q: Array) -> Array:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
