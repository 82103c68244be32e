"""Grid that is even on a surface: its cells are nearly rectangles of one aspect r.

The fractions p across and down of its mass points minimise, with r > 0, the mean over the four corners of all cells of

    (E / r + G r) / (2 A) + 0.01 (A / Am + Am / A)

E and G are the squares of the corner's two sides, across and down, A is the area of the parallelogram that they span,
Am the mean area of the cells of the grid p = (u, v). The first term is 1 where all cells are rectangles of the aspect r,
and larger elsewhere; infinite where A is 0. Points on a side of the picture stay on it. With e and g, the means of E / A
and G / A, r = (e / g)^(1/2) is best, and the mean of the first term (e g)^(1/2).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import ProgressCallback
from taichi_msm.surfaces.minimise import minimise
from taichi_msm.surfaces.surface import Surface, given_grid, positions

# Weight of the areas.
AREA_WEIGHT = 0.01

# Rows and columns of the grid that the minimisation begins with.
START_POINTS = 17

# Share of the objective by which the result may exceed the minimum, and largest number of iterations for a grid.
TOLERANCE, MAX_ITERATIONS = 1e-9, 400


class FoldedGridError(Exception):
    """No even grid was found, as a cell of the first one has no area."""


class EvenGrid(NamedTuple):
    """Grid that is even on a surface."""

    fractions: Array  # p, across and down, shape (rows, cols, 2)
    aspect: float  # r, of the sides of cells across and down


def even_grid(surface: Surface, points: tuple[int, int], progress: ProgressCallback | None = None) -> EvenGrid:
    """Return the even grid of (rows, cols) mass points; a FoldedGridError where cells have no area.

    `progress` counts iterations; the last call is complete.
    """
    total = 2 * MAX_ITERATIONS

    def report(done: int) -> None:
        if progress:
            progress(done, total)

    start = (START_POINTS, START_POINTS)
    coarse = _minimise(surface, given_grid(start), report)
    even = _minimise(surface, spread(coarse, points), lambda done: report(MAX_ITERATIONS + done))
    report(total)
    return EvenGrid(even, GridObjective(surface, points).corners(positions(surface, even)).aspect)


def spread(grid: Array, points: tuple[int, int]) -> Array:
    """Interpolate a grid, shape (m, n, 2), linearly to (rows, cols) mass points."""
    for axis, count in enumerate(points):
        at = np.linspace(0, grid.shape[axis] - 1, count)
        lower = np.minimum(at.astype(int), grid.shape[axis] - 2)
        share = (at - lower).reshape((-1, 1, 1) if axis == 0 else (-1, 1))
        grid = (1 - share) * grid.take(lower, axis) + share * grid.take(lower + 1, axis)
    return grid


def _minimise(surface: Surface, start: Array, progress: Callable[[int], None]) -> Array:
    objective = GridObjective(surface, start.shape[:2])
    if not np.isfinite(objective(start)[0]):
        raise FoldedGridError
    return minimise(objective, start, inverse_hessian(surface, start), TOLERANCE, MAX_ITERATIONS, progress)


class Corners(NamedTuple):
    """Objective of the corners of all cells, and its derivatives."""

    value: float
    aspect: float  # r
    by_across: Array  # by the vectors along rows [1/m], shape (rows, cols - 1, 3)
    by_down: Array  # by the vectors along columns, shape (rows - 1, cols, 3)


class GridObjective:
    """The objective as a function of p, shape (rows, cols, 2), for `minimise`."""

    def __init__(self, surface: Surface, points: tuple[int, int]) -> None:
        self._surface = surface
        x = positions(surface, given_grid(points))
        falling, rising = x[1:, 1:] - x[:-1, :-1], x[:-1, 1:] - x[1:, :-1]
        self._mean_area = float(np.linalg.norm(np.cross(falling, rising), axis=-1).mean()) / 2

    def __call__(self, p: Array) -> tuple[float, Array]:
        """Return value and gradient; an infinite value if a corner is turned over."""
        if not is_unfolded(p):
            return np.inf, np.zeros_like(p)
        x, x_slope = self._surface(p.reshape(-1, 2))
        corners = self.corners(x.reshape(*p.shape[:2], 3))
        by_position = np.zeros((*p.shape[:2], 3))
        by_position[:, 1:] += corners.by_across
        by_position[:, :-1] -= corners.by_across
        by_position[1:] += corners.by_down
        by_position[:-1] -= corners.by_down
        slope = np.einsum("ki,kij->kj", by_position.reshape(-1, 3), x_slope).reshape(p.shape)
        slope[:, [0, -1], 0] = 0
        slope[[0, -1], :, 1] = 0
        return corners.value, slope

    def corners(self, x: Array) -> Corners:
        """Return the objective of positions [m], shape (rows, cols, 3)."""
        across, down = np.diff(x, axis=1), np.diff(x, axis=0)
        e_side, g_side = (across * across).sum(axis=-1), (down * down).sum(axis=-1)
        count = 4 * (x.shape[0] - 1) * (x.shape[1] - 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Sides of the four corners: rows [i:], columns [j:] of the lower and right-hand ones.
            terms = []
            for i in (0, 1):
                for j in (0, 1):
                    a, b = across[i : len(down) + i], down[:, j : across.shape[1] + j]
                    e, g, f = e_side[i : len(down) + i], g_side[:, j : across.shape[1] + j], (a * b).sum(axis=-1)
                    terms.append((i, j, a, b, e, g, f, np.sqrt(np.maximum(e * g - f * f, 0))))
            e_mean = sum(float((e / area).sum()) for *_, e, _, _, area in terms) / count
            g_mean = sum(float((g / area).sum()) for *_, g, _, area in terms) / count
            r = float(np.sqrt(e_mean / g_mean))
            value = float(np.sqrt(e_mean * g_mean))
            by_across, by_down = np.zeros_like(across), np.zeros_like(down)
            for i, j, a, b, e, g, f, area in terms:
                relative = area / self._mean_area
                value += AREA_WEIGHT * float((relative + 1 / relative).sum()) / count
                # r is best, so the value changes as with a constant one. By A^2 = E G - F^2:
                by_square = (AREA_WEIGHT * (relative - 1 / relative) / area - (e / r + g * r) / (2 * area**2)) / area
                by_square /= count
                by_e, by_g = by_square * g + 1 / (r * area * count), by_square * e + r / (area * count)
                by_across[i : len(down) + i] += by_e[..., None] * a - (by_square * f)[..., None] * b
                by_down[:, j : across.shape[1] + j] += by_g[..., None] * b - (by_square * f)[..., None] * a
        return Corners(value if np.isfinite(value) else np.inf, r, by_across, by_down)


def is_unfolded(p: Array) -> bool:
    """Return whether no corner of the cells of fractions, shape (rows, cols, 2), is turned over."""
    across, down = np.diff(p, axis=1), np.diff(p, axis=0)
    return all(
        bool((a[..., 0] * b[..., 1] > a[..., 1] * b[..., 0]).all())
        for a in (across[:-1], across[1:])
        for b in (down[:, :-1], down[:, 1:])
    )


def inverse_hessian(surface: Surface, p: Array) -> Callable[[Array], Array]:
    """Return an approximate inverse Hessian of the objective, near a grid p, shape (rows, cols, 2).

    The objective is about the sum of squares of differences of x over the areas, so its Hessian is about a Laplacian,
    between lengths of the surface in place of p. Sines and cosines invert it: p is 0 on the sides it stays on, and free
    on the others.
    """
    from scipy.fft import dct, dst

    rows, cols = p.shape[:2]
    x_slope = surface(p.reshape(-1, 2))[1].reshape(rows, cols, 3, 2)
    lengths = np.linalg.norm(x_slope, axis=2)
    corners = GridObjective(surface, (rows, cols))
    r = corners.corners(positions(surface, p)).aspect
    scale = corners._mean_area * (rows - 1) * (cols - 1) / 2

    def solve(values: Array, weights: tuple[float, float]) -> Array:
        """Solve for a component that is 0 at both ends of axis 0."""
        n, m = values.shape
        half = np.ones(m)
        half[[0, -1]] = 0.5
        one, two = np.pi * np.arange(1, n - 1) / (n - 1), np.pi * np.arange(m) / (m - 1)
        eigenvalues = (2 - 2 * np.cos(one))[:, None] * weights[0] + (2 - 2 * np.cos(two)) * weights[1]
        spectrum = dct(dst(values[1:-1], 1, axis=0, norm="ortho") / half, 1) / eigenvalues
        solution = np.zeros_like(values)
        solution[1:-1] = dst(dct(spectrum, 1), 1, axis=0, norm="ortho") / (2 * (m - 1))
        return solution

    def apply(slope: Array) -> Array:
        scaled = slope / lengths
        across = solve(scaled[..., 0].T, (1 / r, r)).T
        down = solve(scaled[..., 1], (r, 1 / r))
        return scale * np.stack([across, down], axis=-1) / lengths

    return apply
