"""Gaussian process over places: values with a constant mean, the covariance of Matern 3/2, and noise.

With r the distance of two places, their covariance is a^2 (1 + z) exp(-z), z = sqrt(3) r / length. Amplitude a, length,
the standard deviation of the noise and the mean have the largest likelihood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from taichi_msm.arithmetic import Array

# Number of places that the likelihood is computed from, a random part of more.
MAX_PLACES = 700

# Lengths, in units of the extent of the places, and shares of the noise in the variance: first ones, and bounds.
FIRST_LENGTHS, FIRST_SHARES = (0.05, 0.15, 0.5), (0.1, 0.5, 0.9)
LENGTHS, SHARES = (0.005, 5.0), (1e-4, 0.9999)

MIN_VARIANCE = 1e-12

# Number of places that are predicted at once.
CHUNK = 2000


@dataclass(frozen=True, eq=False)
class Process:
    """Gaussian process of values at places, given for a variance of 1, which is `variance` with the noise."""

    places: Array  # [m], shape (n, 3)
    length: float  # [m]
    share: float  # of the noise in the variance
    mean: float
    variance: float
    loss: float  # -log likelihood
    factor: Array  # lower Cholesky factor of the covariance, with noise
    weights: Array  # covariance^-1 (values - mean)
    unit_weights: Array  # covariance^-1 1

    @property
    def noise(self) -> float:
        """Standard deviation of the noise."""
        return math.sqrt(self.share * self.variance)

    def predict(self, places: Array) -> tuple[Array, Array]:
        """Return mean and standard deviation at places [m], without noise, shapes (k,)."""
        parts = [self._predict(places[n : n + CHUNK]) for n in range(0, len(places), CHUNK)]
        mean, deviation = (np.concatenate(part) for part in zip(*parts, strict=True))
        return mean, deviation

    def regress(self, variable: Array) -> float:
        """Return the slope of the values with another variable, shape (n,), by generalised least squares."""
        return float(variable @ self.weights / (variable @ cho_solve((self.factor, True), variable)))

    def _predict(self, places: Array) -> tuple[Array, Array]:
        covariance = (1 - self.share) * correlation(places, self.places, self.length)
        known = (solve_triangular(self.factor, covariance.T, lower=True, check_finite=False) ** 2).sum(axis=0)
        # The last term is the error of the mean.
        of_mean = (1 - covariance @ self.unit_weights) ** 2 / self.unit_weights.sum()
        variance = self.variance * np.maximum(1 - self.share - known + of_mean, 0.0)
        return self.mean + covariance @ self.weights, np.sqrt(variance)


def correlation(a: Array, b: Array, length: float) -> Array:
    """Return the correlations between places [m], shapes (n, 3) and (k, 3), as an array (n, k)."""
    z = math.sqrt(3) / length * cdist(a, b)
    return np.asarray((1 + z) * np.exp(-z))


def fit_process(places: Array, values: Array) -> Process:
    """Return the most likely process of values, shape (n,), at places [m], shape (n, 3)."""
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    some = np.random.default_rng(0).permutation(len(values))[:MAX_PLACES]

    def from_logs(x: Array) -> tuple[float, float]:
        return extent * math.exp(x[0]), 1 / (1 + math.exp(-x[1]))

    def loss(x: Array) -> float:
        try:
            return _condition(places[some], values[some], *from_logs(x)).loss
        except LinAlgError:
            return math.inf

    def to_logs(length: float, share: float) -> tuple[float, float]:
        return math.log(length), math.log(share / (1 - share))

    start = min((np.array(to_logs(length, share)) for length in FIRST_LENGTHS for share in FIRST_SHARES), key=loss)
    bounds = list(zip(*(to_logs(*ends) for ends in zip(LENGTHS, SHARES, strict=True)), strict=True))
    found = minimize(loss, start, method="Nelder-Mead", bounds=bounds, options={"xatol": 0.01, "fatol": 0.01})
    return _condition(places, values, *from_logs(found.x))


def _condition(places: Array, values: Array, length: float, share: float) -> Process:
    """Return the process of values for a length [m] and a share of the noise, with the best mean and variance."""
    covariance, count = (1 - share) * correlation(places, places, length), len(values)
    covariance[np.diag_indices(count)] += share
    factor, _ = cho_factor(covariance, lower=True, overwrite_a=True)
    solved, units = cho_solve((factor, True), np.column_stack([values, np.ones(count)])).T
    mean = float(solved.sum() / units.sum())
    weights = solved - mean * units
    variance = max(float((values - mean) @ weights) / count, MIN_VARIANCE)
    loss = float(np.log(np.diag(factor)).sum()) + count / 2 * math.log(variance)
    return Process(places, length, share, mean, variance, loss, factor, weights, units)
