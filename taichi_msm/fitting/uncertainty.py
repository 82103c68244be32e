"""How well the best values are known: their covariance from the derivatives where the search ends.

With J the derivatives of r = (predicted - seen) / sigma by x, the covariance of x is

    C = f (J^T W J)^-1 M (J^T W J)^-1,    M = J^T W^(1/2) K W^(1/2) J

where W = 1 and K = 1, and f is the mean of r^2 per degree of freedom, but at least 1. In a robust fit W is the second
derivative of half of rho, and f the mean of the squares of its first over that of W. If errors of neighbouring tracks
are alike, K = exp(-distance / correlation) for two tracks in one frame; if tracks drift, K = exp(-apart / drift) for
one track at two times; if both, their product. With the singular values W^(1/2) J = U S V^T,

    C = f V S^-1 (U^T K U) S^-1 V^T

which holds however little some direction is seen: nothing is squared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.estimation import Misfit, Scales, Solution
from taichi_msm.fitting.observations import Observations

Array = NDArray[np.float64]

# Of singular values, as a share of the largest: what is smaller, which differences hardly tell from 0, is not seen at
# all. In such a direction the smallest parts of parameters are none, and this is its standard deviation.
UNSEEN, LEAST_PART, AT_LARGE = 1e-8, 1e-3, 1e4

# A direction with a larger standard deviation than this is not seen.
NOT_SEEN = 0.5

# Of the intervals.
CONFIDENCE = 0.95


class Alike(NamedTuple):
    """How far apart errors of tracks are alike; None: they are independent."""

    correlation: float | None  # of two tracks [px]
    drift: float | None  # of two times [s]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What the derivatives tell of the parameters' errors, in units of x.

    With n parameters, the columns of `directions` are combinations of x that are seen independently of each other, the
    one that is seen best first.
    """

    scales: Scales  # standard deviations of what was seen, found or given
    factor: float  # f
    freedom: int  # degrees of freedom
    independent: float  # so many independent numbers would tell as much of chi-square as these
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

    @property
    def dropped(self) -> NDArray[np.bool_]:
        """Which of x have a part in a direction that is not seen, so that `shift` does not tell how far they move."""
        return np.linalg.norm(self.directions[:, self.along > NOT_SEEN], axis=1) > LEAST_PART * 50

    def shift(self, rows: Array) -> Array:
        """Give how far x moves, as far as that is seen, if what is predicted is off by so much, in units of r."""
        seen = self.directions[:, self.along <= NOT_SEEN]
        return seen @ np.linalg.lstsq(self.weighted @ seen, rows, rcond=None)[0]


def uncertainty(misfit: Misfit, solution: Solution, derivatives: Array, alike: Alike) -> Uncertainty:
    """Work out the uncertainty of a solution.

    Args:
        misfit: that was minimised.
        solution: the best values.
        derivatives: of what is predicted by x, shape (numbers, parameters).
        alike: how far apart errors of tracks are alike.
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
    independent = float(freedom)
    if alike != (None, None):
        around, independent = _with_neighbours(misfit, singular.U, alike)
        independent = min(independent, freedom)
        values, vectors = np.linalg.eigh(around)
        root = plain @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    wider = np.linalg.norm(root, axis=1) / np.linalg.norm(plain, axis=1)
    return Uncertainty(scales, factor, freedom, independent, left, weighted, singular.Vh.T, root, wider)


def _with_neighbours(misfit: Misfit, rows: Array, alike: Alike) -> tuple[Array, float]:
    """Compute U^T K U, and tr(K)^2 / tr(K^2), so many independent numbers as K leaves; forces are independent."""
    values, seen = misfit.count[0], misfit.seen
    # Tracks are where they were seen on the mean; those that never were have no errors.
    ever: NDArray[np.bool_] = np.any(seen.there, axis=1)
    space, time = _likeness(seen, ever, alike)
    whole = np.zeros((*seen.values.shape, rows.shape[1]))
    whole[seen.known] = rows[:values]
    whole = whole[ever]
    beside = np.einsum("st,ntcp->nscp", time, np.tensordot(space, whole, 1))
    every = len(rows) - values
    there = seen.there[ever].astype(float)
    square = every + seen.values.shape[2] * float(np.sum(space**2 * (there @ time**2 @ there.T)))
    total = np.tensordot(whole, beside, ((0, 1, 2), (0, 1, 2))) + rows[values:].T @ rows[values:]
    return total, len(rows) ** 2 / square


def _likeness(seen: Observations, ever: NDArray[np.bool_], alike: Alike) -> tuple[Array, Array]:
    """Correlate the errors of tracks, shape (tracks, tracks), and those of times, shape (T, T)."""
    from scipy.spatial.distance import cdist

    space, time = np.eye(int(ever.sum())), np.eye(len(seen.time))
    if alike.correlation is not None:
        pixels = np.nanmean(seen.values[ever], axis=1)
        space = np.exp(-cdist(pixels, pixels) / alike.correlation)
    if alike.drift is not None:
        time = np.exp(-np.abs(seen.time[:, None] - seen.time) / alike.drift)
    return space, time
