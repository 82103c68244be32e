"""Grid that is even on a surface: its cells are nearly rectangles of one aspect, and none degenerates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import ProgressCallback
from taichi_msm.surfaces.grid_objective import GridObjective
from taichi_msm.surfaces.minimise import minimise
from taichi_msm.surfaces.surface import Surface, given_grid, positions

# Rows and columns of the grid that the minimisation begins with.
START_POINTS = (17, 17)

# Largest share of the objective that is left to gain, which is about 0.001 cells, and largest number of iterations.
TOLERANCE, MAX_ITERATIONS = 1e-10, 1000


class FoldedGridError(Exception):
    """The grid has no minimum to find: on the surface, a cell of the first grid has a corner without area.

    Attributes:
        place: fractions across and down of that corner.
    """

    def __init__(self, place: tuple[float, float]) -> None:
        super().__init__(f"no area at {place}")
        self.place = place


def even_grid(surface: Surface, points: tuple[int, int], progress: ProgressCallback | None = None) -> Array:
    """Return p, across and down, shape (rows, cols, 2), of an even grid; a FoldedGridError where it cannot begin.

    Points on a side of the picture stay on it. `progress` has the completed and the largest number of iterations; its
    last call is complete.
    """
    total = 2 * MAX_ITERATIONS

    def report(done: int) -> None:
        if progress is not None:
            progress(done, total)

    coarse = _minimise(surface, given_grid(START_POINTS), report)
    even = _minimise(surface, _spread(coarse, points), lambda done: report(MAX_ITERATIONS + done))
    report(total)
    return even


def _spread(grid: Array, points: tuple[int, int]) -> Array:
    """Interpolate a grid, shape (m, n, 2), linearly to (rows, cols) mass points."""
    for axis, count in enumerate(points):
        grid = np.moveaxis(grid, axis, 0)
        at = np.linspace(0, len(grid) - 1, count)
        lower = np.minimum(at.astype(int), len(grid) - 2)
        share = (at - lower)[:, None, None]
        grid = np.moveaxis((1 - share) * grid[lower] + share * grid[lower + 1], 0, axis)
    return grid


def _minimise(surface: Surface, start: Array, progress: Callable[[int], None]) -> Array:
    objective = GridObjective(surface, start.shape[:2])
    if not np.isfinite(objective(start)[0]):
        raise FoldedGridError(_smallest_corner(positions(surface, start), start))
    return minimise(objective, start, _inverse_hessian(surface, objective, start), TOLERANCE, MAX_ITERATIONS, progress)


def _smallest_corner(x: Array, p: Array) -> tuple[float, float]:
    """Return the fractions p of the corner of the smallest area, or of one that is not a number."""
    across, down = np.diff(x, axis=1), np.diff(x, axis=0)
    corners = [(i, j) for i in (0, 1) for j in (0, 1)]
    rows, cols = len(down), across.shape[1]
    areas = [np.linalg.norm(np.cross(across[i : rows + i], down[:, j : cols + j]), axis=-1) for i, j in corners]
    corner, row, column = np.unravel_index(int(np.argmin(areas)), (4, rows, cols))
    i, j = corners[int(corner)]
    at_across, at_down = p[row + i, column + j]
    return float(at_across), float(at_down)


def _inverse_hessian(surface: Surface, objective: GridObjective, p: Array) -> Callable[[Array], Array]:
    """Return an approximate inverse Hessian of the objective near a grid p, shape (rows, cols, 2).

    The objective is about a sum of squares of differences of X over areas, so its Hessian is about a Laplacian, between
    lengths on the surface in place of p. Sines and cosines invert it, as p does not move across two sides of the
    picture, and is free along the others.
    """
    from scipy.fft import dct, dst

    rows, cols = p.shape[:2]
    x, x_slope = surface(p.reshape(-1, 2))
    r = objective.at(x.reshape(rows, cols, 3)).aspect
    lengths = np.linalg.norm(x_slope, axis=1).reshape(rows, cols, 2)
    scale = objective.mean_area * (rows - 1) * (cols - 1)

    def solve(values: Array, weight: float, other_weight: float) -> Array:
        """Solve for one component, which is 0 at both ends of axis 0, for the weights of differences along the axes."""
        n, m = (count - 1 for count in values.shape)
        if n == 1:  # All points are at an end.
            return np.zeros_like(values)
        end_weights = np.ones(m + 1)
        end_weights[[0, -1]] = 0.5
        along, other = np.pi * np.arange(1, n) / n, np.pi * np.arange(m + 1) / m
        eigenvalues = weight * (2 - 2 * np.cos(along))[:, None] + other_weight * (2 - 2 * np.cos(other))
        spectrum = dct(dst(values[1:-1], 1, axis=0, norm="ortho") / end_weights, 1) / eigenvalues
        result = np.zeros_like(values)
        result[1:-1] = dst(dct(spectrum, 1), 1, axis=0, norm="ortho") / (2 * m)
        return result

    def apply(gradient: Array) -> Array:
        across, down = np.moveaxis(gradient / lengths, -1, 0)
        return scale * np.stack([solve(across.T, 1 / r, r).T, solve(down, r, 1 / r)], axis=-1) / lengths

    return apply
