"""Rejection of a model: improbable chi-square, and residuals with structure.

Independent errors have products of mean 0, from one time to the next and from a point to its neighbours, and these
products are uncorrelated, also those that share a point; Student's t tests their mean. Large residuals are clipped, so
that tracks with jumps count as much as others. As tracks may drift, products of neighbours are summed over time; with a
given correlation of neighbours, products of successive times are summed over the points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.least_squares import ErrorCorrelation
from taichi_msm.fitting.observations import Observations

Array = NDArray[np.float64]

# A model with a smaller probability is rejected.
MIN_PROBABILITY = 1e-3

# Residuals below this share of the motion are rounding and the tolerance of the search.
ROUNDING_SHARE = 1e-4

# Smallest numbers of products for a test; those of neighbours share points.
MIN_TIME_PRODUCTS, MIN_NEIGHBOUR_PRODUCTS = 4, 24

NEIGHBOUR_COUNT = 4

# Residuals are clipped at this many medians.
CLIP_MEDIANS = 4.0


def by_chi_square(chi_square: float, freedom: int, independent: float, what: str = "chi-square") -> str | None:
    """Return the reason for rejection by an improbable chi-square, or None.

    Args:
        chi_square: sum of squared residuals.
        freedom: degrees of freedom.
        independent: effective number of independent residuals, at most `freedom`.
        what: name of the sum in the text.
    """
    from scipy.stats import chi2

    if chi2.sf(chi_square * independent / freedom, independent) >= MIN_PROBABILITY:
        return None
    return f"{what} {chi_square:.3g} for {freedom} degrees of freedom has a probability below {MIN_PROBABILITY:g}"


def by_pattern(
    observations: Observations, left: Array, motion: float, error_correlation: ErrorCorrelation
) -> str | None:
    """Return the reason for rejection by correlated residuals, or None.

    Args:
        observations: the observations.
        left: residuals, shape (N, T, numbers) [m] or [px].
        motion: root mean square of the motion, in the same unit.
        error_correlation: given correlation lengths of the errors.
    """
    if np.sqrt(np.nanmean(left**2)) < ROUNDING_SHARE * motion:
        return None
    most = CLIP_MEDIANS * np.nanmedian(np.abs(left))
    cut = np.nan_to_num(np.clip(left, -most, most))[:, np.argsort(observations.time)]
    if error_correlation.correlation is None:
        one, other = _neighbours(observations)
        if _has_mean((cut[one] * cut[other]).sum(axis=(1, 2)), MIN_NEIGHBOUR_PRODUCTS):
            remedy = "give --correlation PX" if observations.kind == "pixel" else "give --sigma"
            fault = "the residuals of neighbouring points are correlated, unlike independent errors"
            return f"{fault}; if the errors are, {remedy}"
    if error_correlation.drift is None:
        products = (cut[:, 1:] * cut[:, :-1]).sum(axis=2)
        if _has_mean(
            products.ravel() if error_correlation.correlation is None else products.sum(axis=0), MIN_TIME_PRODUCTS
        ):
            said = "the residuals of a point are correlated in time, unlike independent errors"
            return f"{said}; if the tracks drift, give --drift SECONDS"
    return None


def _neighbours(observations: Observations) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the pairs of neighbouring points, each once."""
    from scipy.spatial import KDTree

    count = len(observations.coordinates)
    near = (
        KDTree(observations.coordinates)
        .query(observations.coordinates, min(count, NEIGHBOUR_COUNT + 1))[1]
        .reshape(count, -1)
    )
    pairs = np.stack([np.repeat(np.arange(count), near.shape[1]), near.ravel()], axis=1)
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _has_mean(products: Array, fewest: int) -> bool:
    """Return whether the products have a significantly positive mean."""
    from scipy.stats import t

    products = products[products != 0]
    if (count := len(products)) < fewest:
        return False
    # With the variance around 0, the mean cannot be small by chance where all products are alike.
    share = float(products.sum()) / math.sqrt(count * float(products @ products))
    statistic = share * math.sqrt(count - 1) / math.sqrt(max(1 - share**2, 1e-12))
    # There are two such tests, and products of neighbours, which share points, are not quite normal.
    return bool(t.sf(statistic, count - 1) < MIN_PROBABILITY / 4)
