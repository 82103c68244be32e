"""The deformed sheet: its points, and any place on the surface that is drawn between them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.lattice import axes
from taichi_msm.scene import Sheet

Array = NDArray[np.float64]


def to_positions(displacement: NDArray[Any], sheet: Sheet) -> NDArray[Any]:
    """Turn displacements [m], shape (rows, cols, 3), into positions, which are not to be written to."""
    position, (x, y) = displacement, axes(sheet)
    # The sum is computed in float64 and rounded once, without a float64 copy of the sheet.
    np.add(position[..., 0], x, out=position[..., 0], casting="same_kind")
    np.add(position[..., 1], y, out=position[..., 1], casting="same_kind")
    position.flags.writeable = False
    return position


def touched(position: NDArray[np.floating], refine: int, sheet: Sheet, rest: Array) -> tuple[Array, Array]:
    """Find the point of the refined surface whose rest position, x and y [m], is `rest`.

    A point outside the sheet moves with the nearest point of its edge. The mass points are at `position` [m], shape
    (rows, cols, 3), and `refine` vertices are inserted between neighbours.

    Returns:
        The point [m], and the unit normal of its cell there, upward at rest; both of shape (3,).
    """
    height, width = sheet.size
    across = min(1.0, max(0.0, rest[0] / width + 0.5))
    down = min(1.0, max(0.0, 0.5 - rest[1] / height))
    point, normal = (each[0] for each in _on_cells(position, refine, np.array([[across, down]])))
    beside = np.array([rest[0] - (across - 0.5) * width, rest[1] - (0.5 - down) * height, 0.0])
    return point + beside, normal / max(float(np.linalg.norm(normal)), 1e-300)


def on_surface(position: NDArray[np.floating], refine: int, coordinates: NDArray[np.floating]) -> Array:
    """Place material points on the refined surface [m], shape (n, 3).

    `coordinates` are fractions of the sheet's width from its left and of its height from its top, shape (n, 2);
    `position` and `refine` as for `touched`.
    """
    return _on_cells(position, refine, coordinates.astype(np.float64))[0]


def surface_weights(coordinates: Array, sheet: Sheet, refine: int) -> tuple[NDArray[np.intp], Array]:
    """Give the four mass points around each point of the surface that is drawn, and their weights, shapes (N, 4).

    coordinates: across and down, shape (N, 2). The points are numbered row after row; the same place on the surface as
    that of `on_surface`.
    """
    cols = sheet.points[1]
    i, j, s, t, twist = _in_cells(coordinates, sheet.points, refine)
    first = i * cols + j
    corners = np.stack([first, first + 1, first + cols, first + cols + 1], axis=1)
    return corners, np.stack([1 - s - t + twist, s - twist, t - twist, twist], axis=1)


def _on_cells(position: NDArray[np.floating], refine: int, coordinates: Array) -> tuple[Array, Array]:
    """Give the points at some coordinates, and normals of their cells there, of any length; both of shape (n, 3)."""
    rows, cols = position.shape[:2]
    i, j, *shares = _in_cells(coordinates, (rows, cols), refine)
    s, t, twist = (share[:, None] for share in shares)
    a, right, below, far = (position[i + n // 2, j + n % 2].astype(np.float64) for n in range(4))
    b, c, d = right - a, below - a, far - right - below + a
    return a + b * s + c * t + d * twist, np.cross(b + d * t, -(c + d * s))


def _in_cells(coordinates: Array, points: tuple[int, int], refine: int) -> tuple[NDArray[Any], ...]:
    """Give the row i and the column j of each coordinate's cell, s and t across and down in it, and a twist.

    That takes the place of s t: in a small quad of the refined surface it is linear on either side of the diagonal.
    """
    (rows, cols), parts = points, refine + 1
    s, t = (coordinates * (cols - 1, rows - 1)).T
    j, i = np.minimum(s.astype(int), cols - 2), np.minimum(t.astype(int), rows - 2)
    s, t = s - j, t - i
    s0, t0 = (np.minimum((each * parts).astype(int), parts - 1) / parts for each in (s, t))
    s1, t1 = s - s0, t - t0
    return i, j, s, t, s0 * t0 + s1 * t0 + s0 * t1 + np.minimum(s1, t1) / parts
