"""The sheet at rest: where its points are, which of them are fixed, which springs connect them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.scene import Scene, Sheet

SIDES = ("top", "bottom", "left", "right")

Window = tuple[slice, slice]


class Spring(NamedTuple):
    """A spring from a point to one of its neighbours.

    Attributes:
        down: rows from the point to its neighbour, i counted down.
        right: columns from the point to its neighbour.
        offset: rest vector from the point to its neighbour [m], x right, y up.
        length: rest length L0 [m].
        stiffness: k [N/m].
    """

    down: int
    right: int
    offset: tuple[float, float]
    length: float
    stiffness: float

    def ends(self, points: tuple[int, int]) -> tuple[Window, Window]:
        """Select the points of a sheet (rows, cols) that have this spring, and the neighbours it connects them to."""
        i, i_q = _ends(self.down, points[0])
        j, j_q = _ends(self.right, points[1])
        return (i, j), (i_q, j_q)


def _ends(ahead: int, count: int) -> tuple[slice, slice]:
    """Select, of `count` in a line, those with a neighbour `ahead` places further on, and these neighbours."""
    return slice(max(0, -ahead), count - max(0, ahead)), slice(max(0, ahead), count - max(0, -ahead))


def spacing(sheet: Sheet) -> tuple[float, float]:
    """Give the distance between neighbouring columns and between neighbouring rows [m]."""
    (rows, cols), (height, width) = sheet.points, sheet.size
    return width / (cols - 1), height / (rows - 1)


def axes(sheet: Sheet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Give x of the columns, shape (cols,), and y of the rows, shape (rows, 1), at rest [m].

    x_j = (j / (cols - 1) - 1/2) width, y_i = (1/2 - i / (rows - 1)) height.
    """
    (rows, cols), (height, width) = sheet.points, sheet.size
    return (np.arange(cols) / (cols - 1) - 0.5) * width, (0.5 - np.arange(rows)[:, None] / (rows - 1)) * height


def rest_positions(sheet: Sheet) -> NDArray[np.float64]:
    """Give the rest positions of the points, X_ij = (x_j, y_i, 0).

    Returns:
        Rest positions [m], shape (rows, cols, 3).
    """
    position = np.zeros((*sheet.points, 3))
    position[..., 0], position[..., 1] = axes(sheet)
    return position


def fixed_points(sheet: Sheet) -> NDArray[np.bool_]:
    """Mark the points that never move.

    Returns:
        True where fixed, shape (rows, cols).
    """
    fixed = np.zeros(sheet.points, dtype=bool)
    if sheet.fixed == "corners":
        fixed[np.ix_((0, -1), (0, -1))] = True
        return fixed
    sides = {"border": SIDES, "none": ()}.get(sheet.fixed, sheet.fixed) if isinstance(sheet.fixed, str) else sheet.fixed
    fixed[0] |= "top" in sides
    fixed[-1] |= "bottom" in sides
    fixed[:, 0] |= "left" in sides
    fixed[:, -1] |= "right" in sides
    return fixed


def springs(scene: Scene) -> tuple[Spring, ...]:
    """List the springs from a point to its neighbours, up to 8, in a scene with `springs` and without a map.

    Families of stiffness 0 are left out.
    """
    assert scene.springs is not None
    dx, dy = spacing(scene.sheet)
    around = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if (down, right) != (0, 0)]
    stencil = (
        Spring(
            down,
            right,
            (right * dx, -down * dy),
            math.hypot(right * dx, down * dy),
            scene.springs.shear if down and right else scene.springs.structural,
        )
        for down, right in around
    )
    return tuple(spring for spring in stencil if spring.stiffness > 0)
