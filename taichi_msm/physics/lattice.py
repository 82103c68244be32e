"""The sheet at rest: where its points are, which of them are fixed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.scene import Sheet

SIDES = ("top", "bottom", "left", "right")


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
    """Give the rest positions of the points, X_ij = (x_j, y_i, 0) [m], shape (rows, cols, 3)."""
    position = np.zeros((*sheet.points, 3))
    position[..., 0], position[..., 1] = axes(sheet)
    return position


def fixed_points(sheet: Sheet) -> NDArray[np.bool_]:
    """Mark the points that never move, shape (rows, cols)."""
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
