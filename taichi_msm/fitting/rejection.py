"""Whether a scene can move as was seen at all, whatever its numbers are: chi-square, and whether what is left is noise.

Errors that are independent have products without a mean, from one time to the next, and from one point to its
neighbours. Such products are uncorrelated, also where they share a point. Student's t tests whether they have a mean.
What is far off is cut, so that tracks that jump do not count more than others. Tracks may drift while neighbours are
compared: the products of two points are added up over time. Where neighbours are alike by what the user says, those of
two times are added up over the points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.least_squares import Alike
from taichi_msm.fitting.observations import Observations

Array = NDArray[np.float64]

# A model is rejected where what is left has a smaller probability than this.
REJECTED = 1e-3

# What is left below this share of the motion is that of rounding and of the search, and tells of no model.
ROUNDING = 1e-4

# Fewer products tell nothing of noise: of times, and of neighbours, which share points.
FEWEST_TIMES, FEWEST_NEIGHBOURS = 4, 24

# Points are compared with so many neighbours.
NEIGHBOURS = 4

# What is left is cut at so many of its medians.
CUT = 4.0


def by_chi_square(chi_square: float, freedom: int, independent: float, what: str = "chi-square") -> str | None:
    """Return in words that a chi-square is improbable; None: it is not.

    Args:
        chi_square: the sum of squares, each by its sigma.
        freedom: its degrees of freedom.
        independent: as many independent errors as those tell as much; at most freedom.
        what: its name.
    """
    from scipy.stats import chi2

    if chi2.sf(chi_square * independent / freedom, independent) >= REJECTED:
        return None
    return f"{what} {chi_square:.3g} for {freedom} degrees of freedom has a probability below {REJECTED:g}"


def by_pattern(seen: Observations, left: Array, motion: float, alike: Alike) -> str | None:
    """Return in words that what is left of points is no noise; None: it may be.

    Args:
        seen: what was seen.
        left: predicted minus seen, shape (N, T, numbers) [m] or [px].
        motion: root mean square of the motion, of the same unit.
        alike: which errors are alike.
    """
    if np.sqrt(np.nanmean(left**2)) < ROUNDING * motion:
        return None
    most = CUT * np.nanmedian(np.abs(left))
    cut = np.nan_to_num(np.clip(left, -most, most))[:, np.argsort(seen.time)]
    if alike.correlation is None:
        one, other = _neighbours(seen)
        if _has_mean((cut[one] * cut[other]).sum(axis=(1, 2)), FEWEST_NEIGHBOURS):
            remedy = "give --correlation PX" if seen.kind == "pixel" else "give --sigma"
            return f"what is left of neighbouring points is alike, which noise is not; if it is their errors, {remedy}"
    if alike.drift is None:
        products = (cut[:, 1:] * cut[:, :-1]).sum(axis=2)
        if _has_mean(products.ravel() if alike.correlation is None else products.sum(axis=0), FEWEST_TIMES):
            said = "what is left of a point is alike from one time to the next, which noise is not"
            return f"{said}; if it is the tracks that drift, give --drift SECONDS"
    return None


def _neighbours(seen: Observations) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """List the pairs of neighbouring points, each once."""
    from scipy.spatial import KDTree

    count = len(seen.coordinates)
    near = KDTree(seen.coordinates).query(seen.coordinates, min(count, NEIGHBOURS + 1))[1].reshape(count, -1)
    pairs = np.stack([np.repeat(np.arange(count), near.shape[1]), near.ravel()], axis=1)
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _has_mean(products: Array, fewest: int) -> bool:
    """Return whether products have a mean above 0 that chance does not make."""
    from scipy.stats import t

    products = products[products != 0]
    if (count := len(products)) < fewest:
        return False
    # With the variance around 0, the mean cannot be small by chance where all products are alike.
    share = float(products.sum()) / math.sqrt(count * float(products @ products))
    statistic = share * math.sqrt(count - 1) / math.sqrt(max(1 - share**2, 1e-12))
    # There are two such tests, and products of neighbours, which share points, are not quite normal.
    return bool(t.sf(statistic, count - 1) < REJECTED / 4)
