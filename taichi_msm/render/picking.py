"""Which material point is seen at a pixel: the inverse of projection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.camera import View

# How many cells are examined at a time.
CELLS_PER_BATCH = 1024

Array = NDArray[np.float64]
Pixel = tuple[float, float]
SheetCoordinates = tuple[float, float]
Hit = tuple[float, SheetCoordinates]


def pick(position: NDArray[np.floating], refine: int, view: View, pixel: Pixel) -> SheetCoordinates | None:
    """Find the material point that is drawn at the centre of a pixel, on the nearest of the triangles there.

    The camera maps a point to (X, Y, w, depth). Then a = X - x w and b = Y - y w are linear in the point, and both are
    0 if it is seen at (x, y). This needs no division by w, which is 0 or negative behind the camera. Arguments are as
    for `surface` and `View.centred_at`.

    Returns:
        Fractions of the sheet's width from its left and of its height from its top; None if no surface is there.
    """
    rows, cols = position.shape[:2]
    centred_at = view.centred_at(pixel)
    seen: list[Hit] = []
    cells = np.argwhere(_cells_on_ray(position, centred_at))
    for first in range(0, len(cells), CELLS_PER_BATCH):
        i, j = cells[first : first + CELLS_PER_BATCH].T
        corners = np.stack([position[i + down, j + right] for down in (0, 1) for right in (0, 1)], axis=1)
        seen += _hits_in_cells(centred_at.project(corners), i, j, refine, view.near)
    if not seen:
        return None
    _, (across, down) = min(seen)
    return across / (cols - 1), down / (rows - 1)


def intersect_rest_plane(view: View, pixel: Pixel) -> NDArray[np.floating] | None:
    """Find x and y [m] where the line of sight through a pixel's centre meets the plane of the sheet at rest.

    None if they do not meet in front of the camera.
    """
    matrix = view.centred_at(pixel).matrix
    planar = matrix[:2, :2]
    size = np.linalg.norm(planar, axis=1).prod()
    if not abs(np.linalg.det(planar)) > 1e-9 * size:
        return None
    point = np.linalg.solve(planar, -matrix[:2, 3])
    return point if matrix[2] @ [*point, 0, 1] > view.near else None


def _cells_on_ray(position: NDArray[np.floating], centred_at: View) -> NDArray[np.bool_]:
    """Mark the cells in which a and b can both be 0."""
    rows, cols = position.shape[:2]
    marked = np.ones((rows - 1, cols - 1), dtype=bool)
    for row in centred_at.matrix[:2]:
        # One number per point at a time: for a large sheet, all of them together do not fit into the cache.
        value = position @ row[:3] + row[3]
        for side in (value <= 0, value >= 0):
            pairs = side[:-1] | side[1:]
            marked &= pairs[:, :-1] | pairs[:, 1:]
    return marked


def _hits_in_cells(corners: Array, i: NDArray[np.intp], j: NDArray[np.intp], refine: int, near: float) -> list[Hit]:
    """List what is seen of some cells at the pixel: each time the depth, and the place in cells from the top left."""
    parts = refine + 1
    share = np.arange(parts + 1) / parts
    s, t = share[:, None], share[:, None, None]
    a, right, down, far = (corners[:, None, None, n] for n in range(4))
    vertex = a + (right - a) * s + (down - a) * t + (far - right - down + a) * s * t
    quads = np.stack([vertex[:, :-1, :-1], vertex[:, :-1, 1:], vertex[:, 1:, :-1], vertex[:, 1:, 1:]], axis=-2)
    # Only where a and b can both be 0.
    least, most = quads[..., :2].min(axis=-2), quads[..., :2].max(axis=-2)
    cell, line, column = np.nonzero(((least <= 0) & (most >= 0)).all(axis=-1))
    quad = quads[cell, line, column]
    seen: list[Hit] = []
    for third in (1, 2):  # the third corner, beside the two ends of the diagonal: upper right, lower left
        triangle = quad[:, [0, third, 3]]
        p, q, r = np.moveaxis(triangle[..., :2], 1, 0)
        share = np.stack([_cross(q, r), _cross(r, p), _cross(p, q)], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            share /= share.sum(axis=-1, keepdims=True)
        w, depth = np.moveaxis((share[..., None] * triangle[..., 2:]).sum(axis=1), -1, 0)
        for n in np.flatnonzero((share >= 0).all(axis=-1) & (w > near)):
            across = j[cell[n]] + (column[n] + share[n, 2] + (third == 1) * share[n, 1]) / parts
            along = i[cell[n]] + (line[n] + share[n, 2] + (third == 2) * share[n, 1]) / parts
            seen.append((float(depth[n]), (float(across), float(along))))
    return seen


def _cross(p: Array, q: Array) -> Array:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
