"""Which material point is seen at a pixel: the way back from the picture to the sheet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.camera import View

# So many cells are looked into at a time.
CELLS = 1024

Array = NDArray[np.float64]
Pixel = tuple[float, float]
Place = tuple[float, float]
Seen = tuple[float, Place]


def pick(position: NDArray[np.floating], refine: int, view: View, pixel: Pixel) -> Place | None:
    """Find the material point that is drawn at the centre of a pixel: of the surface's triangles there the nearest.

    With (X, Y, w, depth) what the camera makes of a point, a = X - x w and b = Y - y w are linear in the point and
    both 0 where it is seen at (x, y). So nothing has to be divided by w, which is no positive number behind the camera.

    Args:
        position: positions of the mass points [m], shape (rows, cols, 3).
        refine: vertices inserted between two neighbours, as drawn.
        view: the camera.
        pixel: x to the right and y down from the picture's top-left pixel, which is (0, 0).

    Returns:
        Fractions of the sheet's width from its left and of its height from its top; None where no surface is.
    """
    rows, cols = position.shape[:2]
    corner = _seen(position, view, pixel)
    corners = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]], axis=-2)
    found: list[Seen] = []
    cells = np.argwhere(_around_zero(corners))
    for first in range(0, len(cells), CELLS):
        i, j = cells[first : first + CELLS].T
        found += _in_cells(corners[i, j], i, j, refine, view.near)
    if not found:
        return None
    _, (across, down) = min(found)
    return across / (cols - 1), down / (rows - 1)


def on_rest_plane(view: View, pixel: Pixel) -> Array | None:
    """Find where the line of sight through the centre of a pixel meets the plane of the sheet at rest.

    Returns:
        x and y [m]; None where it does not meet it in front of the camera.
    """
    a, b = (view.matrix[row] - (pixel[row] + 0.5) * view.matrix[2] for row in (0, 1))
    planar = np.array([a[:2], b[:2]])
    size = np.linalg.norm(planar, axis=1).prod()
    if not abs(np.linalg.det(planar)) > 1e-9 * size:
        return None
    point = np.linalg.solve(planar, [-a[3], -b[3]])
    ahead = view.matrix[2] @ [*point, 0, 1] > view.near
    return point if ahead else None


def _seen(position: NDArray[np.floating], view: View, pixel: Pixel) -> Array:
    """Give (a, b, w, depth) of every mass point, shape (rows, cols, 4)."""
    seen = position @ view.matrix[:, :3].T + view.matrix[:, 3]
    for row in (0, 1):
        seen[..., row] -= (pixel[row] + 0.5) * seen[..., 2]
    return seen


def _around_zero(corners: Array) -> NDArray[np.bool_]:
    """Mark the figures, given by their corners of shape (..., corners, 4), in which a and b can both be 0."""
    least, most = corners[..., :2].min(axis=-2), corners[..., :2].max(axis=-2)
    return ((least <= 0) & (most >= 0)).all(axis=-1)


def _in_cells(corners: Array, i: NDArray[np.intp], j: NDArray[np.intp], refine: int, near: float) -> list[Seen]:
    """List the depth and the place, in cells from the top left, of all that is seen in some cells at the pixel."""
    parts = refine + 1
    share = np.arange(parts + 1) / parts
    s, t = share[:, None], share[:, None, None]
    a, right, down, far = (corners[:, None, None, n] for n in range(4))
    vertex = a + (right - a) * s + (down - a) * t + (far - right - down + a) * s * t
    quads = np.stack([vertex[:, :-1, :-1], vertex[:, :-1, 1:], vertex[:, 1:, :-1], vertex[:, 1:, 1:]], axis=-2)
    cell, line, column = np.nonzero(_around_zero(quads))
    quad = quads[cell, line, column]
    found = []
    for third in (1, 2):  # the corner besides the ends of the diagonal: upper right, lower left
        triangle = quad[:, [0, third, 3]]
        p, q, r = np.moveaxis(triangle[..., :2], 1, 0)
        share = np.stack([_cross(q, r), _cross(r, p), _cross(p, q)], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            share /= share.sum(axis=-1, keepdims=True)
        w, depth = np.moveaxis((share[..., None] * triangle[..., 2:]).sum(axis=1), -1, 0)
        for n in np.flatnonzero((share >= 0).all(axis=-1) & (w > near)):
            across = j[cell[n]] + (column[n] + share[n, 2] + (third == 1) * share[n, 1]) / parts
            along = i[cell[n]] + (line[n] + share[n, 2] + (third == 2) * share[n, 1]) / parts
            found.append((float(depth[n]), (float(across), float(along))))
    return found


def _cross(p: Array, q: Array) -> Array:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
