"""Rejection of a model by an improbable chi-square, or by residuals that are correlated or depend on the displacement.

The test for correlation multiplies residuals of neighbouring points, or of successive times. For independent errors
the products have a mean of 0 and are uncorrelated, even if two products share a point; Student's t tests this mean.
Clipped residuals limit the weight of jumps.

Tracks may drift: products of neighbours are first summed over time. With a given correlation of neighbours, products of
successive times are first summed over points.

A wrong law of the tissue causes residuals that are functions of the displacement, often far below the noise. Their
projections on such functions are compared with those of residuals with random signs. With a given correlation the sign
is that of a track or of a time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.fitting.observation import ErrorCorrelation

# Smallest probability of a model that is not rejected.
MIN_PROBABILITY = 1e-3

# Smaller residuals, as a share of the motion, are due to rounding and the tolerance of the search.
MIN_SHARE = 1e-4

# Smallest number of products of neighbours, or of random signs.
MIN_PRODUCTS = 24


def by_chi_square(chi_square: float, freedom: int, independent: float, name: str = "chi-square") -> str | None:
    """Return the reason for rejection by an improbable chi-square, or None.

    `independent`: effective number of independent residuals, at most the degrees of freedom.
    """
    from scipy.stats import chi2

    if chi2.sf(chi_square * independent / freedom, independent) >= MIN_PROBABILITY:
        return None
    return f"{name} {chi_square:.3g} for {freedom} degrees of freedom has a probability below {MIN_PROBABILITY:g}"


def by_pattern(
    residuals: Array,
    displacement: Array,
    time: Array,
    coordinates: Array,
    motion: float,
    error_correlation: ErrorCorrelation,
    remedy: str,
) -> str | None:
    """Return the reason for rejection by the pattern of the residuals, predicted minus observed values, or None.

    Residuals, NaN where not observed, and predicted displacements from rest have shape (N, T, 3 or 2); they are in m or
    px, as is `motion`, the root mean square of the observed motion. Times [s] have shape (T,), coordinates on the sheet
    (N, 2). The remedy is for correlated errors of neighbouring points.
    """
    if np.sqrt(np.nanmean(residuals**2)) < MIN_SHARE * motion:
        return None
    limit = 4.0 * np.nanmedian(np.abs(residuals))
    order = np.argsort(time)
    clipped = np.nan_to_num(np.clip(residuals, -limit, limit))[:, order]
    if error_correlation.length is None:
        first, second = _neighbours(coordinates)
        if _is_positive((clipped[first] * clipped[second]).sum(axis=(1, 2)), MIN_PRODUCTS):
            reason = "the residuals of neighbouring points are correlated, unlike independent errors"
            return f"{reason}; for correlated errors {remedy}"
    if error_correlation.drift is None:
        products = (clipped[:, 1:] * clipped[:, :-1]).sum(axis=2)
        if _is_positive(products.ravel() if error_correlation.length is None else products.sum(axis=0), 4):
            reason = "the residuals of a point are correlated in time, unlike independent errors"
            return f"{reason}; if the tracks drift, give --drift SECONDS"
    if None in error_correlation:
        # Depths may have larger errors than the other components.
        limits = 4.0 * np.maximum(np.nanmedian(np.abs(residuals), axis=(0, 1)), MIN_SHARE * motion)
        weights = _displacement_products(np.clip(residuals / limits, -1.0, 1.0), displacement)
        weights = weights if error_correlation.length is None else weights.sum(axis=0, keepdims=True)
        weights = weights if error_correlation.drift is None else weights.sum(axis=1, keepdims=True)
        if _is_aligned(weights.reshape(-1, weights.shape[2])):
            reason = "the residuals depend on the displacement, unlike independent errors"
            return f"{reason}: the tissue stiffens, or a load acts, otherwise than in the scene"
    return None


def _neighbours(coordinates: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the pairs of points and their four nearest neighbours, each once."""
    from scipy.spatial import KDTree

    count = len(coordinates)
    nearest = KDTree(coordinates).query(coordinates, min(count, 4 + 1))[1].reshape(count, -1)
    pairs = np.stack([np.repeat(np.arange(count), nearest.shape[1]), nearest.ravel()], axis=1)
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _displacement_products(residuals: Array, displacement: Array) -> Array:
    """Return the contribution of every point and time to the projections of residuals, shape (N, T, projections).

    Every component of the displacement u is multiplied by 1, |u| and |u|^2; these functions are orthonormalised.
    """
    field = np.where(np.isfinite(residuals), np.nan_to_num(displacement), 0.0)
    length = np.linalg.norm(field, axis=2, keepdims=True)
    length /= max(float(length.max()), 1e-300)
    columns = [field[..., [n]] * length**power for n in range(field.shape[2]) for power in range(3)]
    functions = np.zeros((*field.shape, len(columns)))
    for n, column in enumerate(columns):
        functions[..., n // 3, n] = column[..., 0] / max(float(np.linalg.norm(column)), 1e-300)
    left, singular, _ = np.linalg.svd(functions.reshape(-1, len(columns)), full_matrices=False)
    rank = int(np.sum(singular > 1e-3 * singular[0]))
    orthonormal = left[:, :rank].reshape(*field.shape, rank)
    return np.asarray(np.einsum("ntc,ntcp->ntp", np.nan_to_num(residuals), orthonormal))


def _is_aligned(rows: Array) -> bool:
    """Return whether the sum of all rows, shape (count, n), is significantly longer than with random signs of rows.

    With random signs s, the sum of M_ij s_i s_j over all pairs of different rows, M_ij their scalar product, has the
    mean 0, the variance 2 tr(M^2), and the third moment 8 tr(M^3). A shifted gamma distribution has these moments.
    """
    from scipy.stats import gamma

    rows = rows[rows.any(axis=1)]
    if len(rows) < MIN_PRODUCTS:
        return False
    gram, squares = rows.T @ rows, np.sum(rows**2, axis=1)
    statistic = float(np.sum(rows.sum(axis=0) ** 2) - squares.sum())
    variance = 2 * float(np.sum(gram**2) - squares @ squares)
    third_moment = np.trace(gram @ gram @ gram) - 3 * squares @ np.sum(rows @ gram * rows, axis=1)
    skewness = max(8 * float(third_moment + 2 * np.sum(squares**3)) / variance**1.5, 1e-2)
    shape = 4 / skewness**2
    return bool(gamma.sf(shape + statistic * math.sqrt(shape / variance), shape) < MIN_PROBABILITY / 4)


def _is_positive(products: Array, min_count: int) -> bool:
    """Return whether the mean of the products is significantly positive; False for fewer than `min_count`."""
    from scipy.stats import t

    products = products[products != 0]
    if (count := len(products)) < min_count:
        return False
    # The variance is taken around 0: around the mean it vanishes for equal products.
    normalised_mean = float(products.sum()) / math.sqrt(count * float(products @ products))
    statistic = normalised_mean * math.sqrt(count - 1) / math.sqrt(max(1 - normalised_mean**2, 1e-12))
    # The margin is for three tests, and for products of neighbours, which share points and are not quite normal.
    return bool(t.sf(statistic, count - 1) < MIN_PROBABILITY / 4)
