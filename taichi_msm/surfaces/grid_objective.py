"""Objective of an even grid.

It is the smallest mean, over r > 0, of a number of the four corners of all cells,

    (E / r + G r) / (2 A) + 0.01 (A / Am + Am / A)

E and G are the squares of the corner's two sides, across and down, A is the area of the parallelogram that they span,
and Am the mean area of the cells of the grid p = (u, v). The first term is 1 where all cells are rectangles of the
aspect r, larger elsewhere, and infinite where A is 0. With e and g, the means of E / A and G / A, the best r is
(e / g)^(1/2), and the mean of the first term (e g)^(1/2).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.surfaces.surface import Surface, given_grid, positions

# Weight of the areas.
AREA_WEIGHT = 0.01


class Value(NamedTuple):
    """Objective of positions X, shape (rows, cols, 3), and its gradient."""

    value: float
    aspect: float  # r
    gradient: Array  # by X [1/m], shape (rows, cols, 3)


class GridObjective:
    """The objective as a function of the fractions p across and down of (rows, cols) mass points."""

    def __init__(self, surface: Surface, points: tuple[int, int]) -> None:
        self._surface = surface
        x = positions(surface, given_grid(points))
        falling, rising = x[1:, 1:] - x[:-1, :-1], x[:-1, 1:] - x[1:, :-1]
        self.mean_area = float(np.linalg.norm(np.cross(falling, rising), axis=-1).mean()) / 2  # Am [m2]

    def __call__(self, p: Array) -> tuple[float, Array]:
        """Return value and gradient, shape (rows, cols, 2); an infinite value if a corner of p is turned over.

        The gradient is 0 across the sides of the picture, so that points stay on them.
        """
        if not is_unfolded(p):
            return np.inf, np.zeros_like(p)
        x, x_slope = self._surface(p.reshape(-1, 2))
        value, _, gradient = self.at(x.reshape(*p.shape[:2], 3))
        gradient = np.einsum("ki,kij->kj", gradient.reshape(-1, 3), x_slope).reshape(p.shape)
        gradient[:, [0, -1], 0] = 0
        gradient[[0, -1], :, 1] = 0
        return value, gradient

    def at(self, x: Array) -> Value:
        """Return the objective of positions [m], shape (rows, cols, 3)."""
        # Sides of cells; a corner [i, j] has the side across a[i] and the side down b[j].
        across, down = np.diff(x, axis=1), np.diff(x, axis=0)
        a, b = np.stack([across[:-1], across[1:]]), np.stack([down[:, :-1], down[:, 1:]])
        e, g = (a * a).sum(axis=-1)[:, None], (b * b).sum(axis=-1)[None]
        f = np.einsum("i...k,j...k->ij...", a, b)
        with np.errstate(divide="ignore", invalid="ignore"):
            area = np.sqrt(np.maximum(e * g - f * f, 0))
            e_mean, g_mean, relative = float((e / area).mean()), float((g / area).mean()), area / self.mean_area
            value = float(np.sqrt(e_mean * g_mean) + AREA_WEIGHT * (relative + 1 / relative).mean())
            r = float(np.sqrt(e_mean / g_mean))
            # As r is best, the gradient is that of a constant r. By E, by G, and by A^2 = E G - F^2:
            by_e, by_g = 1 / (2 * r * area), r / (2 * area)
            by_square = (AREA_WEIGHT * (relative - 1 / relative) - (e * by_e + g * by_g)) / (2 * area**2)
        by_a = 2 * (by_e + by_square * g).sum(axis=1)[..., None] * a
        by_b = 2 * (by_g + by_square * e).sum(axis=0)[..., None] * b
        by_a -= 2 * np.einsum("ij...,j...k->i...k", by_square * f, b)
        by_b -= 2 * np.einsum("ij...,i...k->j...k", by_square * f, a)
        gradient = np.zeros_like(x)
        for i in (0, 1):
            rows = slice(i, len(down) + i)
            gradient[rows, 1:] += by_a[i]
            gradient[rows, :-1] -= by_a[i]
            columns = slice(i, across.shape[1] + i)
            gradient[1:, columns] += by_b[i]
            gradient[:-1, columns] -= by_b[i]
        return Value(value if np.isfinite(value) else np.inf, r, gradient / area.size)


def is_unfolded(p: Array) -> bool:
    """Return whether no corner of the cells of fractions, shape (rows, cols, 2), is turned over."""
    across, down = np.diff(p, axis=1), np.diff(p, axis=0)
    return all(
        bool((a[..., 0] * b[..., 1] > a[..., 1] * b[..., 0]).all())
        for a in (across[:-1], across[1:])
        for b in (down[:, :-1], down[:, 1:])
    )
