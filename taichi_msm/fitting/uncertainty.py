"""How well the best values are known: their covariance from the derivatives where the search ends.

With J the derivatives of r = (predicted - seen) / sigma by x, the covariance of x is

    C = f (J^T W J)^-1 M (J^T W J)^-1,    M = J^T W^(1/2) K W^(1/2) J

where W = 1 and K = 1, and f is the mean of r^2 per degree of freedom, but at least 1. In a robust fit W is the second
derivative of half of rho, and f the mean of the squares of its first over that of W. If errors of neighbouring tracks
are alike, K = exp(-distance / correlation) for two tracks in one frame. With the singular values W^(1/2) J = U S V^T,

    C = f V S^-1 (U^T K U) S^-1 V^T

which holds however little some direction is seen: nothing is squared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.estimation import Misfit, Scales, Solution

Array = NDArray[np.float64]

# Of singular values, as a share of the largest: what is smaller, which differences hardly tell from 0, is not seen at
# all. In such a direction the smallest parts of parameters are none, and this is its standard deviation.
UNSEEN, LEAST_PART, AT_LARGE = 1e-8, 1e-3, 1e4

# A direction with a larger standard deviation than this is not seen.
NOT_SEEN = 0.5

# Of the intervals.
CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What the derivatives tell of the parameters' errors, in units of x.

    With n parameters, the columns of `directions` are combinations of x that are seen independently of each other, the
    one that is seen best first.
    """

    scales: Scales  # standard deviations of what was seen, found or given
    factor: float  # f
    freedom: int  # degrees of freedom
    left: Array  # r
    weighted: Array  # W^(1/2) J, shape (numbers, n)
    directions: Array  # shape (n, n)
    root: Array  # F with C = F F^T, shape (n, n)
    wider: Array  # how many times K makes the deviations wider, shape (n,)

    @property
    def deviations(self) -> Array:
        """Standard deviations of x, shape (n,)."""
        return np.linalg.norm(self.root, axis=1)

    @property
    def along(self) -> Array:
        """Standard deviations of the directions, shape (n,)."""
        return np.linalg.norm(self.directions.T @ self.root, axis=1)

    @property
    def correlation(self) -> Array:
        """Correlations of x, shape (n, n)."""
        each = self.root / np.maximum(self.deviations, np.finfo(float).tiny)[:, None]
        return np.clip(each @ each.T, -1.0, 1.0)

    @property
    def quantile(self) -> float:
        """So many standard deviations each side of a value are its interval, by Student's t."""
        from scipy.stats import t

        return float(t.ppf((1 + CONFIDENCE) / 2, self.freedom))

    def of_combination(self, exponents: Array) -> float:
        """Give the standard deviation of a combination of x."""
        return float(np.linalg.norm(exponents @ self.root))

    def shift(self, rows: Array) -> Array:
        """Give how far x moves, as far as that is seen, if what is predicted is off by so much, in units of r."""
        seen = self.directions[:, self.along <= NOT_SEEN]
        return seen @ np.linalg.lstsq(self.weighted @ seen, rows, rcond=None)[0]


def uncertainty(misfit: Misfit, solution: Solution, derivatives: Array, correlation: float | None) -> Uncertainty:
    """Work out the uncertainty of a solution.

    Args:
        misfit: that was minimised.
        solution: the best values.
        derivatives: of what is predicted by x, shape (numbers, parameters).
        correlation: how far apart errors of tracks are alike [px]; None: they are independent.
    """
    parameters = len(solution.x)
    freedom = max(1, sum(misfit.count) - parameters)
    scales = solution.scales
    if misfit.seen.sigma is None:
        scales = scales._replace(values=misfit.sigma(solution.predicted, parameters))
    left, slope = misfit.residuals(solution.predicted, scales), misfit.divided(derivatives, scales)
    far = misfit.far(left)
    weighted = slope * far[:, None] ** (-0.75)
    factor = max(1.0, float(np.sum(left**2 / far)) / freedom / float(np.mean(far**-1.5)))
    singular = np.linalg.svd(weighted, full_matrices=False)
    blind = UNSEEN * max(1.0, singular.S[0]) >= singular.S
    held = np.where(blind, 1 / AT_LARGE, singular.S)
    parts = np.where(blind & (np.abs(singular.Vh.T) < LEAST_PART), 0.0, singular.Vh.T)
    plain = root = np.sqrt(factor) * parts / held
    if correlation is not None:
        values, vectors = np.linalg.eigh(_with_neighbours(misfit, singular.U, correlation))
        root = plain @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    wider = np.linalg.norm(root, axis=1) / np.linalg.norm(plain, axis=1)
    return Uncertainty(scales, factor, freedom, left, weighted, singular.Vh.T, root, wider)


def _with_neighbours(misfit: Misfit, rows: Array, correlation: float) -> Array:
    """Give U^T K U, frame by frame and coordinate by coordinate; forces are independent."""
    from scipy.spatial.distance import cdist

    values, seen = misfit.count[0], misfit.seen
    # Tracks are where they were seen on the mean; those that never were have no errors.
    ever = seen.there.any(axis=1)
    pixels = np.nanmean(seen.values[ever], axis=1)
    alike = np.exp(-cdist(pixels, pixels) / correlation)
    whole = np.zeros((*seen.values.shape, rows.shape[1]))
    whole[seen.known] = rows[:values]
    whole, total = whole[ever], rows[values:].T @ rows[values:]
    for frame in range(whole.shape[1]):
        for coordinate in range(whole.shape[2]):
            one = whole[:, frame, coordinate]
            total = total + one.T @ alike @ one
    return total
