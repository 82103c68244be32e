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

# Least determinant of the covariance of x and y [px^4], over the variance of G and its square: pixels in a line have 0,
# two neighbouring rows 1/4 of the variance. The mean of the pixels is the fit within a distance from their centre [px].
MIN_DETERMINANT, MAX_OFFSET = 1e-6, 1e-6

# Rows of a block of a filter.
BLOCK_ROWS = 128


def smooth_inverse_depth(inverse: Array, is_known: NDArray[np.bool_], x: Array, y: Array, deviation: float) -> Array:
    """Return e_s for e = `inverse`, shape (h, w), at undistorted coordinates x, y of the pixels, in any unit.

    G has the standard deviation `deviation` [px]; with 0, only pixels without depth change, by one of 1 px. At least
    one pixel must be known.
    """
    is_kept = is_known & (deviation == 0)
    is_open = ~is_kept
    known, x, y = is_known.astype(float), _in_pixels(x, axis=1), _in_pixels(y, axis=0)
    # Fits keep planes, so one through all pixels is left out, for less rounding.
    whole = _plane(inverse, is_known, x, y)
    values = np.where(is_known, inverse - whole, 0.0)
    smooth = values.copy()
    moments = [known, known * x, known * y, known * x * x, known * x * y, known * y * y]
    moments += [values, values * x, values * y]
    deviation = deviation or 1.0
    while is_open.any():
        # Far from few pixels no width has the weight, and where all pixels are in a line none has a plane.
        is_last = deviation > sum(is_open.shape)
        gaussian = _Gaussian(deviation, is_known, is_open)
        is_near = np.full_like(is_open, is_last)
        is_near[gaussian.at] |= gaussian.filter(known) >= MIN_WEIGHT
        is_near &= is_open
        if is_near.any():
            gaussian = _Gaussian(deviation, is_known, is_near)
            at = gaussian.at
            filtered = [gaussian.filter(each) for each in moments]
            fit, is_determined = _fit_planes(filtered, x[at], y[at], gaussian.variance)
            is_done = is_near[at] & (is_determined | is_last)
            smooth[at] = np.where(is_done, fit, smooth[at])
            is_open[at] &= ~is_done
        deviation *= 2
    return np.where(is_kept, inverse, whole + smooth)


def _plane(values: Array, is_known: NDArray[np.bool_], x: Array, y: Array) -> Array:
    """Return the plane that fits values of known pixels best; across a line of pixels it is level."""
    places = np.stack([x, y])
    offsets = places - places[:, is_known].mean(axis=1)[:, None, None]
    mean, known = values[is_known].mean(), offsets[:, is_known]
    slopes = np.linalg.lstsq(known @ known.T, known @ (values[is_known] - mean), rcond=1e-9)[0]
    return np.asarray(mean + slopes[0] * offsets[0] + slopes[1] * offsets[1])


def _in_pixels(coordinate: Array, axis: int) -> Array:
    """Return a coordinate with its zero in the middle and a mean distance of pixels of 1, for less rounding."""
    return (coordinate - (coordinate.max() + coordinate.min()) / 2) * (coordinate.shape[axis] / np.ptp(coordinate))


def _fit_planes(moments: list[Array], x: Array, y: Array, variance: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return the values at x, y [px] of the planes with filtered moments, and whether they determine it; else the mean.

    `variance` is that of the filter [px^2].
    """
    weight = np.maximum(moments[0], np.finfo(float).tiny)
    mean_x, mean_y, xx, xy, yy, mean, x_value, y_value = (each / weight for each in moments[1:])
    # Covariances, and the plane through the means.
    xx, xy, yy = xx - mean_x * mean_x, xy - mean_x * mean_y, yy - mean_y * mean_y
    x_value, y_value = x_value - mean_x * mean, y_value - mean_y * mean
    determinant = xx * yy - xy * xy
    is_plane = determinant > MIN_DETERMINANT * variance * min(variance, 1)
    d_x, d_y = x - mean_x, y - mean_y
    rise = (x_value * yy - y_value * xy) * d_x + (y_value * xx - x_value * xy) * d_y
    fit = mean + np.divide(rise, determinant, out=np.zeros_like(rise), where=is_plane)
    return fit, is_plane | (np.hypot(d_x, d_y) < MAX_OFFSET)


class _Gaussian:
    """Gaussian filter with zeros outside, of pixels `is_source` at those `is_target`, shape (h, w) each.

    In blocks of rows, products of matrices take less time than sums of shifted rows, most of all for wide filters.
    """

    def __init__(self, deviation: float, is_source: NDArray[np.bool_], is_target: NDArray[np.bool_]) -> None:
        self.at = np.ix_(is_target.any(axis=1), is_target.any(axis=0))
        radius = int(TRUNCATION * deviation + 0.5)
        weights = np.exp(-0.5 * (np.arange(radius + 1) / deviation) ** 2)
        weights /= 2 * weights.sum() - 1
        self.variance = 2 * float((weights * np.arange(radius + 1) ** 2).sum())  # [px^2]
        self._blocks = []
        for other in (1, 0):
            first, last = np.flatnonzero(is_source.any(axis=other))[[0, -1]]
            rows, blocks = np.flatnonzero(is_target.any(axis=other)), []
            for block in np.split(rows, range(BLOCK_ROWS, len(rows), BLOCK_ROWS)):
                low = max(block[0] - radius, first)
                near = slice(low, max(low, min(block[-1] + radius, last) + 1))
                distance = np.abs(block[:, None] - np.arange(near.start, near.stop))
                blocks.append((np.where(distance <= radius, weights[np.minimum(distance, radius)], 0.0), near))
            self._blocks.append(blocks)

    def filter(self, values: Array) -> Array:
        """Filter along columns, then along rows; the result has the rows and columns `at`."""
        for blocks in self._blocks:
            values = np.concatenate([matrix @ values[near] for matrix, near in blocks]).T
        return values
