"""Smoothing of a depth map, which also fills it: weighted fits of planes.

With e = 1 / depth, which is linear on a plane in undistorted image coordinates x and y, e_s at a pixel is the value
there of the plane that fits e best with the weights ok G about it: ok is 1 where there is a depth and 0 elsewhere, G a
Gaussian. Its moments are nine Gaussian filters, of ok times 1, x, y, x^2, x y, y^2, e, e x and e y. So planes stay
planes, also across holes and up to the border.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array

# Standard deviations at which filters end.
TRUNCATION = 8.0

# Least sum of the weights ok G; with less, G becomes twice as wide.
MIN_WEIGHT = 1e-3

# Least determinant of the covariance of the coordinates [px^4], in squares of G's standard deviation [px^2]: pixels in a
# line have 0, a row and the next one 1/4.
MIN_DETERMINANT = 1e-6

# Rows of a block of a filter.
BLOCK_ROWS = 64


def smooth_inverse_depth(inverse: Array, is_known: NDArray[np.bool_], x: Array, y: Array, deviation: float) -> Array:
    """Return e_s for e = `inverse`, shape (h, w), at undistorted coordinates x, y of the pixels, in any unit.

    G has the standard deviation `deviation` [px]; with 0, only pixels without depth change, with 1 px. NaN without any
    depth.
    """
    smooth = np.where(is_known, inverse, np.nan)
    is_open = ~is_known if deviation == 0 else np.ones_like(is_known)
    known, x, y = is_known.astype(float), _in_pixels(x, axis=1), _in_pixels(y, axis=0)
    values = np.where(is_known, inverse, 0.0)
    deviation = deviation or 1.0
    while is_open.any():
        at = np.flatnonzero(is_open.any(axis=1)), np.flatnonzero(is_open.any(axis=0))
        fit, weight, determinant = _fit_planes(values, known, x, y, deviation, at)
        # No weight suffices far from few pixels, and no width where all of them are in a line.
        is_last = deviation > sum(is_open.shape)
        is_done = (weight >= MIN_WEIGHT) & (determinant > MIN_DETERMINANT * deviation**2) | is_last
        is_done &= is_open[np.ix_(*at)]
        rows, cols = at[0][:, None], at[1]
        smooth[rows, cols] = np.where(is_done, fit, smooth[rows, cols])
        is_open[rows, cols] &= ~is_done
        deviation *= 2
    return smooth


def _in_pixels(coordinate: Array, axis: int) -> Array:
    """Return a coordinate with its zero in the middle and a mean distance of pixels of 1, for less rounding."""
    return (coordinate - (coordinate.max() + coordinate.min()) / 2) * (coordinate.shape[axis] / np.ptp(coordinate))


def _fit_planes(
    values: Array, known: Array, x: Array, y: Array, deviation: float, at: tuple[NDArray[np.int_], NDArray[np.int_]]
) -> tuple[Array, Array, Array]:
    """Return value, weight and determinant of the covariance of the fits at rows and columns, shape (m, n) each."""
    down, across = (_Gaussian(deviation, index, size) for index, size in zip(at, known.shape, strict=True))

    def filtered(values: Array) -> Array:
        return across.filter(down.filter(values).T).T

    def mean(values: Array) -> Array:
        return filtered(known * values) / np.maximum(weight, np.finfo(float).tiny)

    weight = filtered(known)
    mean_x, mean_y, mean_value = mean(x), mean(y), mean(values)
    xx, xy, yy = mean(x * x) - mean_x**2, mean(x * y) - mean_x * mean_y, mean(y * y) - mean_y**2
    determinant = xx * yy - xy * xy
    x_value, y_value = mean(x * values) - mean_x * mean_value, mean(y * values) - mean_y * mean_value
    d_x, d_y = x[np.ix_(*at)] - mean_x, y[np.ix_(*at)] - mean_y
    slope = (x_value * yy - y_value * xy) * d_x + (y_value * xx - x_value * xy) * d_y
    is_plane = determinant > MIN_DETERMINANT * deviation**2
    fit = mean_value + np.divide(slope, determinant, out=np.zeros_like(slope), where=is_plane)
    return np.where(weight > 0, fit, np.nan), weight, determinant


class _Gaussian:
    """Gaussian filter along axis 0, with zeros outside, at some rows.

    In blocks of rows, products of matrices take less time than sums of shifted rows, most of all for wide filters.
    """

    def __init__(self, deviation: float, rows: NDArray[np.int_], size: int) -> None:
        radius = int(TRUNCATION * deviation + 0.5)
        weights = np.exp(-0.5 * (np.arange(radius + 1) / deviation) ** 2)
        weights /= 2 * weights.sum() - 1
        self._blocks = []
        for start in range(0, len(rows), BLOCK_ROWS):
            block = rows[start : start + BLOCK_ROWS]
            near = np.arange(max(block[0] - radius, 0), min(block[-1] + radius + 1, size))
            distance = np.abs(block[:, None] - near)
            matrix = np.where(distance <= radius, weights[np.minimum(distance, radius)], 0.0)
            self._blocks.append((matrix, slice(near[0], near[-1] + 1)))

    def filter(self, values: Array) -> Array:
        return np.concatenate([matrix @ values[near] for matrix, near in self._blocks])
