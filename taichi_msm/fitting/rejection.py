"""Rejection of a model by an improbable chi-square, or by correlated residuals.

The test for correlation multiplies residuals of neighbouring points, or of successive times. For independent errors
the products have a mean of 0 and are uncorrelated, even if two products share a point; Student's t tests this mean.
Clipped residuals limit the weight of jumps.

Tracks may drift: products of neighbours are first summed over time. With a given correlation of neighbours, products of
successive times are first summed over points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.observation import Array, ErrorCorrelation

# Smallest probability of a model that is not rejected.
MIN_PROBABILITY = 1e-3


def by_chi_square(chi_square: float, freedom: int, independent: float, name: str = "chi-square") -> str | None:
    """Return the reason for rejection by an improbable chi-square, or None.

    Args:
        chi_square: sum of squared residuals.
        freedom: degrees of freedom.
        independent: effective number of independent residuals, at most `freedom`.
        name: name of the sum, for the reason.
    """
    from scipy.stats import chi2

    if chi2.sf(chi_square * independent / freedom, independent) >= MIN_PROBABILITY:
        return None
    return f"{name} {chi_square:.3g} for {freedom} degrees of freedom has a probability below {MIN_PROBABILITY:g}"


def by_pattern(
    residuals: Array, time: Array, coordinates: Array, motion: float, error_correlation: ErrorCorrelation, remedy: str
) -> str | None:
    """Return the reason for rejection by correlated residuals, or None.

    Args:
        residuals: predicted minus observed values [m] or [px], shape (N, T, 3 or 2), NaN where not observed.
        time: times of the observations [s], shape (T,).
        coordinates: coordinates of the points on the sheet, shape (N, 2).
        motion: root mean square of the observed motion [m] or [px].
        error_correlation: given correlation of the errors.
        remedy: remedy for correlated errors of neighbouring points, for the reason.
    """
    # Smaller residuals are due to rounding and the tolerance of the search.
    if np.sqrt(np.nanmean(residuals**2)) < 1e-4 * motion:
        return None
    limit = 4.0 * np.nanmedian(np.abs(residuals))
    clipped = np.nan_to_num(np.clip(residuals, -limit, limit))[:, np.argsort(time)]
    if error_correlation.length is None:
        first, second = _neighbours(coordinates)
        if _is_positive((clipped[first] * clipped[second]).sum(axis=(1, 2)), 24):
            reason = "the residuals of neighbouring points are correlated, unlike independent errors"
            return f"{reason}; for correlated errors {remedy}"
    if error_correlation.drift is None:
        products = (clipped[:, 1:] * clipped[:, :-1]).sum(axis=2)
        if _is_positive(products.ravel() if error_correlation.length is None else products.sum(axis=0), 4):
            reason = "the residuals of a point are correlated in time, unlike independent errors"
            return f"{reason}; if the tracks drift, give --drift SECONDS"
    return None


def _neighbours(coordinates: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the pairs of points and their four nearest neighbours, each once."""
    from scipy.spatial import KDTree

    count = len(coordinates)
    nearest = KDTree(coordinates).query(coordinates, min(count, 4 + 1))[1].reshape(count, -1)
    pairs = np.stack([np.repeat(np.arange(count), nearest.shape[1]), nearest.ravel()], axis=1)
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _is_positive(products: Array, min_count: int) -> bool:
    """Return whether the mean of the products is significantly positive; False for fewer than `min_count`."""
    from scipy.stats import t

    products = products[products != 0]
    if (count := len(products)) < min_count:
        return False
    # The variance is taken around 0: around the mean it vanishes for equal products.
    normalised_mean = float(products.sum()) / math.sqrt(count * float(products @ products))
    statistic = normalised_mean * math.sqrt(count - 1) / math.sqrt(max(1 - normalised_mean**2, 1e-12))
    # The margin is for two tests, and for products of neighbours, which share points and are not quite normal.
    return bool(t.sf(statistic, count - 1) < MIN_PROBABILITY / 4)
