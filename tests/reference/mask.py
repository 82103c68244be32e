"""NumPy reference of the outline of a sheet: cells that a mask leaves, and points that they hold."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Bools = NDArray[np.bool_]


def present_cells(sheet: Any) -> Bools:
    """Return whether each cell is sheet, shape (rows - 1, cols - 1): white at its middle, from half the range on."""
    rows, cols = (count - 1 for count in sheet.points)
    mask = getattr(sheet, "mask", None)
    if mask is None:
        return np.ones((rows, cols), dtype=bool)
    grey = np.array(Image.open(mask.image))
    white = grey >= (128 if grey.dtype == np.uint8 else 32768)
    height, width = white.shape
    row, column = (np.arange(rows) * 2 + 1) * height // (2 * rows), (np.arange(cols) * 2 + 1) * width // (2 * cols)
    return np.asarray(white[np.ix_(row, column)] != mask.invert)


def cell_counts(present: Bools) -> NDArray[np.int_]:
    """Return the number of cells of each point, shape (rows, cols)."""
    count = np.zeros((present.shape[0] + 1, present.shape[1] + 1), dtype=int)
    for i, j in np.argwhere(present):
        count[i : i + 2, j : j + 2] += 1
    return count


def held_points(sheet: Any) -> Bools:
    """Return whether each point stays at rest: fixed, or without a cell; shape (rows, cols)."""
    count, words = cell_counts(present_cells(sheet)), sheet.fixed
    held = count == 0
    rows, cols = held.shape
    for i, j in np.ndindex(rows, cols):
        sides = {"top": i == 0, "bottom": i == rows - 1, "left": j == 0, "right": j == cols - 1}
        if words == "corners":
            held[i, j] |= sum(sides.values()) == 2
        elif words == "border":
            held[i, j] |= any(sides.values())
        elif words != "none":
            held[i, j] |= any(sides.get(word, False) for word in words)
            held[i, j] |= "outline" in words and count[i, j] < 4
    return held
