"""Gaussian process over the places of presses: log stiffness, with the covariance of Matern 3/2 and noise.

With r the distance of two places, their covariance is a^2 (1 + z) exp(-z), z = sqrt(3) r / length. Amplitude a, length,
the standard deviation of the noise and the constant mean have the largest likelihood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from taichi_msm.arithmetic import Array

# Places that the likelihood is computed from: a random part of more.
MAX_PLACES = 1000

# Lengths that the search begins from, in units of the places' extent, and shares of the noise in the variance.
FIRST_LENGTHS, FIRST_SHARES = (0.05, 0.15, 0.5), (0.1, 0.5, 0.9)

# Bounds of the length, in units of the extent, and of the share of the noise.
LENGTHS, SHARES = (0.005, 5.0), (1e-4, 0.9999)


@dataclass(frozen=True, eq=False)
class Process:
    """Gaussian process of given values at places, shapes (n,) and (n, 3)."""

    places: Array  # [m]
    mean: float
    amplitude: float
    length: float  # [m]
    noise: float  # standard deviation
    _factor: Any  # Cholesky factor of the covariance of the values, with noise
    _weights: Array  # covariance^-1 (values - mean)

    def predict(self, places: Array) -> tuple[Array, Array]:
        """Return mean and standard deviation, without noise, at places [m], shapes (k,)."""
        covariance = self.amplitude**2 * correlation(places, self.places, self.length)
        variance = self.amplitude**2 - (covariance * cho_solve(self._factor, covariance.T).T).sum(axis=1)
        return self.mean + covariance @ self._weights, np.sqrt(np.maximum(variance, 0.0))


def correlation(a: Array, b: Array, length: float) -> Array:
    """Return the correlations between places [m], shapes (n, 3) and (k, 3), as an array (n, k)."""
    z = math.sqrt(3) / length * cdist(a, b)
    return np.asarray((1 + z) * np.exp(-z))


def fit_process(places: Array, values: Array) -> Process:
    """Return the most likely process of values at places [m]."""
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    chosen = np.random.default_rng(0).permutation(len(values))[:MAX_PLACES]
    some, of_some = places[chosen], values[chosen]

    def loss(x: Array) -> float:
        try:
            return _decompose(some, of_some, extent * math.exp(x[0]), 1 / (1 + math.exp(-x[1])))[0]
        except LinAlgError:
            return math.inf

    bounds = [tuple(map(math.log, LENGTHS)), tuple(math.log(share / (1 - share)) for share in SHARES)]
    starts = [
        np.array([math.log(length), math.log(share / (1 - share))])
        for length in FIRST_LENGTHS
        for share in FIRST_SHARES
    ]
    start = min(starts, key=loss)
    found = minimize(loss, start, method="Nelder-Mead", bounds=bounds, options={"xatol": 0.01, "fatol": 0.01})
    length, share = extent * math.exp(found.x[0]), 1 / (1 + math.exp(-found.x[1]))
    _, factor, weights, mean, variance = _decompose(places, values, length, share)
    amplitude, noise = math.sqrt(variance * (1 - share)), math.sqrt(variance * share)
    return Process(places, mean, amplitude, length, noise, (factor[0] * math.sqrt(variance), True), weights / variance)


def _decompose(
    places: Array, values: Array, length: float, share: float
) -> tuple[float, tuple[Array, bool], Array, float, float]:
    """Return -log likelihood, factor and weights of the covariance of variance 1, mean and variance.

    `share`: that of the noise in the variance.
    """
    covariance = (1 - share) * correlation(places, places, length)
    covariance[np.diag_indices(len(places))] += share
    factor = cho_factor(covariance, lower=True, overwrite_a=True)
    solved = cho_solve(factor, np.column_stack([values, np.ones(len(values))]))
    mean = float(solved[:, 0].sum() / solved[:, 1].sum())
    weights = solved[:, 0] - mean * solved[:, 1]
    variance = max(float((values - mean) @ weights) / len(values), 1e-12)
    return (
        float(np.log(np.diag(factor[0])).sum()) + len(values) / 2 * math.log(variance),
        factor,
        weights,
        mean,
        variance,
    )
