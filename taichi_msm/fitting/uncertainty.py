"""Uncertainty of a least-squares solution.

With J the Jacobian of the residuals r by x, the covariance of x is

    C = f (J^T W J)^-1 M (J^T W J)^-1,    M = J^T W^(1/2) K W^(1/2) J

with W = 1 and K = 1, and f the mean of r^2 per degree of freedom, at least 1. In a robust fit W is the second
derivative of rho / 2, and f the mean square of its first derivative over the mean of W. K is the correlation of the
errors: exp(-distance / correlation) for two tracks at a time, exp(-interval / drift) for a track at two times, or the
product of both. With the singular value decomposition W^(1/2) J = U S V^T,

    C = f V S^-1 (U^T K U) S^-1 V^T

which avoids the squared condition number of J^T W J.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.least_squares import Misfit, Scales, Solution
from taichi_msm.fitting.observation import Array, ErrorCorrelation

# Smaller components of unidentified directions are 0.
MIN_COMPONENT = 1e-3

# Largest standard deviation of an identified direction.
MAX_DIRECTION_DEVIATION = 0.5


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of n parameters, in units of x.

    Attributes:
        scales: standard deviations of the observations, given or estimated.
        factor: f, at least 1.
        freedom: degrees of freedom.
        independent: effective number of independent observations.
        residuals: r, shape (known,).
        weighted: W^(1/2) J, shape (known, n).
        directions: V, shape (n, n); columns are uncorrelated combinations of x, the most certain first.
        root: F, shape (n, n), with C = F F^T.
        widening: ratio of the deviations with K to those with K = 1, shape (n,).
    """

    scales: Scales
    factor: float
    freedom: int
    independent: float
    residuals: Array
    weighted: Array
    directions: Array
    root: Array
    widening: Array

    @property
    def deviations(self) -> Array:
        """Standard deviations of x, shape (n,)."""
        return np.linalg.norm(self.root, axis=1)

    @property
    def direction_deviations(self) -> Array:
        """Standard deviations of the directions, shape (n,)."""
        return np.linalg.norm(self.directions.T @ self.root, axis=1)

    @property
    def correlation(self) -> Array:
        """Correlations of x, shape (n, n)."""
        each = self.root / np.maximum(self.deviations, np.finfo(float).tiny)[:, None]
        return np.clip(each @ each.T, -1.0, 1.0)

    @property
    def quantile(self) -> float:
        """Half width of the 95 % interval in standard deviations, by Student's t."""
        from scipy.stats import t

        return float(t.ppf((1 + 0.95) / 2, self.freedom))

    @property
    def unidentified(self) -> NDArray[np.bool_]:
        """Mask of the parameters in unidentified directions, where `shift` is invalid, shape (n,)."""
        directions = self.directions[:, self.direction_deviations > MAX_DIRECTION_DEVIATION]
        return np.linalg.norm(directions, axis=1) > MIN_COMPONENT * 50

    def shift(self, rows: Array) -> Array:
        """Return the shift of x, shape (n,), by errors `rows` of the predictions, shape (known,), in units of r."""
        identified = self.directions[:, self.direction_deviations <= MAX_DIRECTION_DEVIATION]
        return identified @ np.linalg.lstsq(self.weighted @ identified, rows, rcond=None)[0]


def uncertainty(
    misfit: Misfit, solution: Solution, derivatives: Array, error_correlation: ErrorCorrelation
) -> Uncertainty:
    """Return the uncertainty of a solution.

    Args:
        misfit: residuals.
        solution: minimum of their cost.
        derivatives: Jacobian of the predictions by x, shape (known, n).
        error_correlation: correlation lengths of the errors, which define K.
    """
    parameters = len(solution.x)
    freedom = max(1, sum(misfit.count) - parameters)
    scales = misfit.scales(misfit.deviations(solution.predicted, parameters))
    residuals, jacobian = misfit.residuals(solution.predicted, scales), misfit.scaled(derivatives, scales)
    robust_factor = misfit.robust_factor(residuals)
    weighted = jacobian * robust_factor[:, None] ** (-0.75)
    factor = max(1.0, float(np.sum(residuals**2 / robust_factor)) / freedom / float(np.mean(robust_factor**-1.5)))
    singular = np.linalg.svd(weighted, full_matrices=False)
    # Small singular values are rounding errors: their directions are unidentified, with a standard deviation of 1e4.
    is_unidentified = 1e-8 * max(1.0, singular.S[0]) >= singular.S
    singular_values = np.where(is_unidentified, 1 / 1e4, singular.S)
    directions = np.where(is_unidentified & (np.abs(singular.Vh.T) < MIN_COMPONENT), 0.0, singular.Vh.T)
    independent_root = root = np.sqrt(factor) * directions / singular_values
    independent = float(freedom)
    if error_correlation != (None, None):
        # U^T K U, and the effective number of observations tr(K)^2 / tr(K^2).
        pairs = zip(misfit.observations, misfit.split(singular.U), strict=True)
        matrices, squares = zip(
            *(observed.correlated(part, error_correlation) for observed, part in pairs), strict=True
        )
        independent = min(len(singular.U) ** 2 / sum(squares), freedom)
        values, vectors = np.linalg.eigh(np.sum(matrices, axis=0))
        root = independent_root @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    widening = np.linalg.norm(root, axis=1) / np.linalg.norm(independent_root, axis=1)
    return Uncertainty(scales, factor, freedom, independent, residuals, weighted, singular.Vh.T, root, widening)
