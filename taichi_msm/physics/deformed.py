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
    (rows, cols), parts = sheet.points, refine + 1
    place = coordinates * (cols - 1, rows - 1)
    j, i = np.minimum(place.astype(int), (cols - 2, rows - 2)).T
    s, t = place[:, 0] - j, place[:, 1] - i
    column, line = (np.minimum((share * parts).astype(int), parts - 1) / parts for share in (s, t))
    s1, t1 = s - column, t - line
    # In the small quad, s t is replaced by a function that is linear on either side of the diagonal.
    twist = column * line + s1 * line + column * t1 + np.minimum(s1, t1) / parts
    first = i * cols + j
    corners = np.stack([first, first + 1, first + cols, first + cols + 1], axis=1)
    return corners, np.stack([1 - s - t + twist, s - twist, t - twist, twist], axis=1)


def _on_cells(position: NDArray[np.floating], refine: int, coordinates: Array) -> tuple[Array, Array]:
    """Give the points at some coordinates, and normals of their cells there, of any length; both of shape (n, 3)."""
    (rows, cols), parts = position.shape[:2], refine + 1
    s, t = (coordinates * (cols - 1, rows - 1)).T[..., None]
    j, i = np.minimum(s.astype(int), cols - 2), np.minimum(t.astype(int), rows - 2)
    a, right, below, far = (position[i[:, 0] + n // 2, j[:, 0] + n % 2].astype(np.float64) for n in range(4))
    b, c, d = right - a, below - a, far - right - below + a
    s, t = s - j, t - i
    normal = np.cross(b + d * t, -(c + d * s))
    s0, t0 = (np.minimum((each * parts).astype(int), parts - 1) / parts for each in (s, t))
    s1, t1 = s - s0, t - t0
    # In the small quad, D s t is replaced by a function that is linear on either side of the diagonal.
    return a + b * s + c * t + d * (s0 * t0 + s1 * t0 + s0 * t1 + np.minimum(s1, t1) / parts), normal
