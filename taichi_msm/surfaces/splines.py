"""Not-a-knot cubic splines through values on an even grid, in two variables.

Such a spline is a sum of uniform B-splines: with values s and second derivatives s'' at the knots, their coefficients
are c = s - s'' / 6, and c[-1] = s''[0] + 2 c[0] - c[1] beyond the end. Its outermost pieces continue it.
"""

from __future__ import annotations

import numpy as np

from taichi_msm.arithmetic import Array


class GridSpline:
    """Spline through values, shape (n, m, ...), at the rows 0 to n - 1 and the columns 0 to m - 1."""

    def __init__(self, values: Array) -> None:
        self.shape = values.shape[:2]
        self._coefficients = _coefficients(_coefficients(values, 0), 1)

    def __call__(self, row: Array, column: Array) -> tuple[Array, Array, Array]:
        """Return values and their derivatives by row and by column, shape (k, ...) each, at k places."""
        i, j = (
            np.clip(np.floor(at).astype(int), 0, count - 2) for at, count in zip((row, column), self.shape, strict=True)
        )
        four = np.arange(4)
        near = self._coefficients[(i[:, None] + four)[:, :, None], (j[:, None] + four)[:, None, :]]
        (down, d_down), (across, d_across) = _basis(row - i), _basis(column - j)
        along_column = np.einsum("kab...,ka->kb...", near, down)
        return (
            np.einsum("kb...,kb->k...", along_column, across),
            np.einsum("kab...,ka,kb->k...", near, d_down, across),
            np.einsum("kb...,kb->k...", along_column, d_across),
        )


def _coefficients(values: Array, axis: int) -> Array:
    """Return the coefficients of the B-splines along an axis, two more than values."""
    from scipy.interpolate import CubicSpline

    count = values.shape[axis]
    second = np.moveaxis(CubicSpline(np.arange(count), values, axis)(np.arange(count), 2), axis, 0)
    inner = np.moveaxis(values, axis, 0) - second / 6
    first, last = second[0] + 2 * inner[0] - inner[1], second[-1] + 2 * inner[-1] - inner[-2]
    return np.moveaxis(np.concatenate([first[None], inner, last[None]]), 0, axis)


def _basis(t: Array) -> tuple[Array, Array]:
    """Return the four B-splines of a piece and their derivatives at t, 0 to 1 within it, shape (k, 4) each."""
    s = 1 - t
    values = s**3, 4 - 3 * t * t * (1 + s), 4 - 3 * s * s * (1 + t), t**3
    slopes = -3 * s * s, 9 * t * t - 12 * t, 12 * s - 9 * s * s, 3 * t * t
    return np.stack(values, axis=-1) / 6, np.stack(slopes, axis=-1) / 6
