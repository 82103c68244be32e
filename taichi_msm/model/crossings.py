"""Cells of the sheet that a line may cross."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray


def cells_on_line(distances: Iterable[NDArray[np.floating]]) -> NDArray[np.bool_]:
    """Mark the cells with corners on both sides of all planes, of which two define a line, shape (rows - 1, cols - 1).

    The distances are those of the mass points from each plane, with a sign and in any unit, shape (rows, cols). They
    are evaluated one after another, because only those from one plane fit into the cache for a large sheet.
    """
    marked: Any = np.True_
    for distance in distances:
        for side in (distance <= 0, distance >= 0):
            pairs = side[:-1] | side[1:]
            marked = marked & (pairs[:, :-1] | pairs[:, 1:])
    return marked
