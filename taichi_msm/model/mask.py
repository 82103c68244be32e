"""Cells and mass points of a masked sheet, and its connected parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.model.cells import sum_around_points

# Places this close to an edge of a cell, in sides of a cell, are on it.
EDGE_TOLERANCE = 1e-9

# A middle of a cell between two pixels, up to rounding, takes the right or lower one [px].
TIE = 1e-6


@dataclass(frozen=True, eq=False)
class Mask:
    """Cells that are sheet, shape (rows - 1, cols - 1), and their mass points, shape (rows, cols)."""

    cells: NDArray[np.bool_]

    @classmethod
    def at_cells(cls, is_sheet: NDArray[np.bool_], points: tuple[int, int]) -> Mask:
        """Sample pixels at the middle of the cells of an even grid of (rows, cols) mass points."""
        rows, cols = points[0] - 1, points[1] - 1
        return cls(sample_nearest(is_sheet, (np.arange(cols) + 0.5) / cols, ((np.arange(rows) + 0.5) / rows)[:, None]))

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

    @cached_property
    def topology(self) -> tuple[int, int, bool]:
        """Number of parts and of holes, and whether two parts meet in a point."""
        from scipy.ndimage import label

        outside = np.pad(~self.cells, 1, constant_values=True)
        return int(self.parts.max()), label(outside, np.ones((3, 3)))[1] - 1, any(self.pinched_points())

    def parts_with(self, points: NDArray[np.bool_]) -> set[int]:
        """Return the parts with any of the mass points, a mask of shape (rows, cols)."""
        corners = points[:-1, :-1] | points[:-1, 1:] | points[1:, :-1] | points[1:, 1:]
        return set(np.unique(self.parts[corners & self.cells]).tolist())

    def covers(self, places: Array, tolerance: float = EDGE_TOLERANCE) -> NDArray[np.bool_]:
        """Return whether places are on the sheet or its outline, from fractions across and down of shape (n, 2)."""
        rows, cols = self.cells.shape
        at, covered = np.asarray(places, float) * (cols, rows), np.zeros(len(places), bool)
        # A place on an edge belongs to the cells on both sides.
        for shift in product((-tolerance, tolerance), repeat=2):
            j, i = np.floor(at + shift).astype(int).T
            inside = (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
            covered |= inside & self.cells[i.clip(0, rows - 1), j.clip(0, cols - 1)]
        return covered

    def nearest_cells(self, i: NDArray[Any], j: NDArray[Any], places: Array) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return rows and columns of the cells (i, j) of places, or of the nearest cells where there is no sheet."""
        from scipy.ndimage import distance_transform_edt

        covered = self.covers(places)
        rows, cols = distance_transform_edt(~self.cells, return_distances=False, return_indices=True)
        return np.where(covered, i, rows[i, j]), np.where(covered, j, cols[i, j])

    def first_gap(self, start: Array, end: Array) -> float | None:
        """Return the fraction of a line between two places, as for `covers`, at which it leaves the sheet, or None."""
        (rows, cols), offset = self.cells.shape, end - start
        crossings = [np.array([0.0, 1.0])]
        for axis, count in enumerate((cols, rows)):
            if offset[axis]:
                crossings.append((np.arange(count + 1) / count - start[axis]) / offset[axis])
        # Between two crossings the line is in one cell.
        cuts = np.unique(np.concatenate(crossings).clip(0, 1))
        middles = np.concatenate([[0.0], (cuts[1:] + cuts[:-1]) / 2, [1.0]])
        gaps = np.flatnonzero(~self.covers(start + middles[:, None] * offset))
        return float(middles[gaps[0]]) if gaps.size else None

    def pinched_points(self) -> Iterator[tuple[int, int]]:
        """Yield row and column of the mass points at which two parts meet."""
        parts = self.parts
        for a, b in (
            (parts[:-1, :-1], parts[1:, 1:]),
            (parts[:-1, 1:], parts[1:, :-1]),
        ):
            for row, column in np.argwhere((a > 0) & (b > 0) & (a != b)) + 1:
                yield int(row), int(column)


def sample_nearest(is_sheet: NDArray[np.bool_], across: Array, down: Array) -> NDArray[np.bool_]:
    """Return the nearest pixels at fractions from left and top, which broadcast; False where they are NaN."""
    height, width = is_sheet.shape
    column = np.clip(np.nan_to_num(across * width + TIE).astype(int), 0, width - 1)
    row = np.clip(np.nan_to_num(down * height + TIE).astype(int), 0, height - 1)
    return np.asarray(is_sheet[row, column] & np.isfinite(across) & np.isfinite(down))
