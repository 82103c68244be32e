"""The outline of a sheet: cells and mass points that a mask leaves, and the parts that hang together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.model.cells import sum_around_points

# A middle of a cell between two pixels, up to rounding, takes the right or lower one [px].
TIE = 1e-6


@dataclass(frozen=True, eq=False)
class Mask:
    """Cells that are sheet, shape (rows - 1, cols - 1), and their mass points, shape (rows, cols)."""

    cells: NDArray[np.bool_]

    @classmethod
    def sample(cls, is_sheet: NDArray[np.bool_], across: Array, down: Array) -> Mask:
        """Sample pixels at the middle of cells, fractions of the picture from left and top, by the nearest pixel."""
        height, width = is_sheet.shape
        column = np.clip((across * width + TIE).astype(int), 0, width - 1)
        row = np.clip((down * height + TIE).astype(int), 0, height - 1)
        return cls(is_sheet[row, column])

    @classmethod
    def at_cells(cls, is_sheet: NDArray[np.bool_], points: tuple[int, int]) -> Mask:
        """Sample pixels at the middle of the cells of an even grid of (rows, cols) mass points."""
        rows, cols = points[0] - 1, points[1] - 1
        return cls.sample(is_sheet, (np.arange(cols) + 0.5) / cols, ((np.arange(rows) + 0.5) / rows)[:, None])

    @cached_property
    def cell_counts(self) -> NDArray[np.int_]:
        """Number of cells of each mass point, 0 to 4."""
        return sum_around_points(self.cells).astype(int)

    @property
    def points(self) -> NDArray[np.bool_]:
        """Whether each mass point belongs to a cell."""
        return self.cell_counts > 0

    @property
    def inner_points(self) -> NDArray[np.bool_]:
        """Whether each mass point belongs to four cells."""
        return self.cell_counts == 4

    @cached_property
    def parts(self) -> NDArray[np.int_]:
        """Part of each cell, from 1; cells with a common side belong to one part. 0 without sheet."""
        from scipy.ndimage import label

        return np.asarray(label(self.cells)[0])

    def points_of(self, part: int) -> NDArray[np.bool_]:
        """Return whether each mass point belongs to a part."""
        return sum_around_points(self.parts == part) > 0

    def pinched_points(self) -> Iterator[tuple[int, int]]:
        """Yield row and column of the mass points at which two parts meet."""
        parts = self.parts
        for a, b in (
            (parts[:-1, :-1], parts[1:, 1:]),
            (parts[:-1, 1:], parts[1:, :-1]),
        ):
            for row, column in np.argwhere((a > 0) & (b > 0) & (a != b)) + 1:
                yield int(row), int(column)
