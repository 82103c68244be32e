"""Whether a scene can move as was seen at all, whatever its numbers are: chi-square, and whether what is left is noise.

Errors that are independent from one time to the next change their signs as a coin does. So the products of the signs of
what is left at neighbouring times are 1 as often as -1. Of every two times their sum over all points is one number:
those sums have no mean, and are uncorrelated, even where errors of neighbouring points are alike. Student's t tells
whether they have one. Signs take no notice of tracks that jump.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.observations import Observations

Array = NDArray[np.float64]

# A model is rejected where what is left has a smaller probability than this.
REJECTED = 1e-3

# What is left below this share of the motion is that of rounding and of the search, and tells of no model.
ROUNDING = 1e-4

# Fewer pairs of times tell nothing of noise.
FEWEST_PAIRS = 4


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


def by_signs(seen: Observations, left: Array, motion: float) -> str | None:
    """Return in words that what is left of points is no noise; None: it may be.

    Args:
        seen: what was seen.
        left: predicted minus seen, shape (N, T, numbers) [m] or [px].
        motion: root mean square of the motion, of the same unit.
    """
    from scipy.stats import t

    if np.sqrt(np.nanmean(left**2)) < ROUNDING * motion:
        return None
    signs = np.nan_to_num(np.sign(left[:, np.argsort(seen.time)]))
    products = signs[:, 1:] * signs[:, :-1]
    counts = np.abs(products).sum(axis=(0, 2))
    sums = products.sum(axis=(0, 2))[counts > 0]
    if len(sums) < FEWEST_PAIRS:
        return None
    error = math.sqrt(max(float(sums @ sums), 1.0) / len(sums))
    # Of the mean, with the variance around 0: it cannot be small by chance where all sums are alike.
    share = float(sums.mean()) / error
    statistic = share * math.sqrt(len(sums) - 1) / math.sqrt(max(1 - share**2, 1e-12))
    if t.sf(statistic, len(sums) - 1) >= REJECTED:
        return None
    agree = (1 + sums.sum() / counts.sum()) / 2
    said = f"what is left of a point keeps its sign from one time to the next in {100 * agree:.0f} % of all cases"
    return f"{said}, which noise does in 50 %; if it is the tracks that drift, give --drift SECONDS"
