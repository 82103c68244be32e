"""Fit of the law of a ball to many presses: a shared lock m, and the stiffness K and the offset o of each press.

The force of a press at depth d is K g(d + o), with g of `law.BallLaw`; its residual r is relative to the largest force
of the press, with the standard deviation s. The offsets have a normal prior of mean c and width t. With the residuals
r at the best K and o of each press, and the information i = sum of (dr / do)^2 with K profiled,

    -2 log L = (N - n) log s^2 + sum of r^2 / s^2 + sum of (o - c)^2 / t^2 + sum of log(1 + i t^2 / s^2)

is the likelihood of N rows of n presses, the offsets integrated out (Laplace's method). It is maximised in s, c, t
and m. The foundation is linear unless a lock gains `MIN_GAIN`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from taichi_msm.arithmetic import Array
from taichi_msm.errors import ProgressCallback
from taichi_msm.palpation.law import BallLaw
from taichi_msm.palpation.presses import Presses

# Ends of a 95 % interval: gain of log likelihood, and distance in standard deviations.
MIN_GAIN, DEVIATIONS = 1.92, 1.96

# Locks that are compared, in units of the greatest depth: with a greater one the tangent grows by less than 5 %, with a
# smaller one the foundation is locked, and linear again, over most of the depth.
LOCKS = np.geomspace(40, 0.7, 18)

# First offsets that are compared, in units of the greatest depth of a press.
FIRST_OFFSETS = np.linspace(-0.5, 1.0, 16)

# The estimates of s, c and t alternate with those of the offsets until log L changes by less than `TOLERANCE`.
TOLERANCE, MAX_ROUNDS, STEPS, HALVINGS = 0.01, 40, 2, 4

# Largest change of the lock when presses are left out, as a factor.
MAX_CHANGE = 1.3

# Least standard deviations: s relative to the peak, and t [m].
MIN_NOISE, MIN_WIDTH = 1e-9, 1e-7


class Prior(NamedTuple):
    """Normal prior of the offsets [m], and standard deviation s of the relative residuals."""

    mean: float
    width: float
    noise: float


@dataclass(frozen=True, eq=False)
class PressFit:
    """Stiffness and offset of each press, for a law, shape (n,)."""

    law: BallLaw
    prior: Prior
    offset: Array  # o [m]
    stiffness: Array  # K [N/m3]
    error: Array  # standard error of log K
    mean_stiffness: Array  # K at the mean offset [N/m3]
    residual: Array  # root mean square of the relative residuals
    log_likelihood: float


def fit_presses(presses: Presses, radius: float, progress: ProgressCallback = lambda done, total: None) -> PressFit:
    """Fit the lock, and stiffness and offset of each press, of a ball of a radius [m]."""
    linear = best = fit_offsets(presses, BallLaw(radius))
    locks, fits = LOCKS * float(presses.greatest_depth.max()), list[PressFit]()
    for lock in locks:
        progress(len(fits), len(locks))
        fits.append(fit_offsets(presses, BallLaw(radius, lock), (fits or [linear])[-1]))
    n = max(range(len(fits)), key=lambda k: fits[k].log_likelihood)
    if fits[n].log_likelihood > linear.log_likelihood:
        best = refine_lock(presses, fits[n], locks[min(n + 1, len(locks) - 1)], locks[max(n - 1, 0)])
    return best if best.log_likelihood - linear.log_likelihood > MIN_GAIN else linear


def refine_lock(presses: Presses, start: PressFit, low: float, high: float) -> PressFit:
    """Return the fit with the best lock between two [m]."""
    lock = _minimise(lambda lock: -at_lock(presses, start, lock).log_likelihood, low, high)
    return max(start, at_lock(presses, start, lock), key=lambda fit: fit.log_likelihood)


def refit(presses: Presses, start: PressFit) -> PressFit:
    """Return the fit to other presses, with a lock near that of `start`, whose offsets are of these presses."""
    lock = start.law.lock
    if math.isinf(lock):
        return at_lock(presses, start, lock)
    return refine_lock(presses, at_lock(presses, start, lock), lock / MAX_CHANGE, lock * MAX_CHANGE)


def lock_interval(presses: Presses, best: PressFit) -> tuple[float, float | None]:
    """Return the 95 % interval of the lock [m]; None for an end beyond all locks that are compared."""
    lock, limit = best.law.lock, best.log_likelihood - MIN_GAIN

    def gain(log_lock: float) -> float:
        return at_lock(presses, best, math.exp(log_lock)).log_likelihood - limit

    def end(ratio: float) -> float | None:
        outer = lock * ratio
        while gain(math.log(outer)) > 0:
            outer *= ratio
            if outer > LOCKS[0] * float(presses.greatest_depth.max()):
                return None
        inner = outer / ratio
        return math.exp(brentq(gain, *sorted((math.log(inner), math.log(outer))), xtol=1e-3))

    low = end(1 / 1.1)
    assert low is not None
    return low, end(1.1)


def with_lock_error(presses: Presses, fit: PressFit, interval: tuple[float, float | None]) -> PressFit:
    """Return a fit whose errors of log K include that of the lock, by the fits at the ends of its 95 % interval."""
    ends = [at_lock(presses, fit, lock).stiffness for lock in interval if lock is not None]
    sides = np.abs(np.log(np.array(ends) / fit.stiffness)) / DEVIATIONS
    return replace(fit, error=np.hypot(fit.error, sides.mean(axis=0)))


def at_lock(presses: Presses, start: PressFit, lock: float) -> PressFit:
    """Return the fit for a lock [m], from another one."""
    return fit_offsets(presses, BallLaw(start.law.radius, lock), start)


def fit_offsets(presses: Presses, law: BallLaw, start: PressFit | None = None) -> PressFit:
    """Fit stiffness and offset of each press for a law, from those of another law."""
    model = _Model(presses, law)
    offset, prior = (start.offset, start.prior) if start else model.first_offsets()
    last, likelihood = -math.inf, -math.inf
    for _ in range(MAX_ROUNDS):
        for _ in range(STEPS):
            offset = model.improve(offset, prior)
        prior, likelihood = model.estimate_prior(offset, prior)
        if abs(likelihood - last) < TOLERANCE:
            break
        last = likelihood
    scale, residual, information, _, ratio = model.linearise(offset)
    at_mean, _ = model.profile(np.full(presses.count, prior.mean))
    # At the mean offset, a shallow press may not touch.
    at_mean = np.where(at_mean > 0, at_mean, scale)
    # The errors of log K are those of the rows, of its offset, and of the mean offset, which all presses share.
    weight = (prior.noise / prior.width) ** 2
    of_rows = prior.noise**2 / presses.sum((presses.target - residual) ** 2)
    of_offset = prior.noise**2 / (information + weight)
    of_mean = 1 / float((1 / (prior.width**2 + prior.noise**2 / np.maximum(information, 1e-300))).sum())
    share = weight / (information + weight)
    error = np.sqrt(of_rows + ratio**2 * (of_offset + share**2 * of_mean))
    rms, peak = presses.root_mean_square(residual), presses.peak
    return PressFit(law, prior, offset, scale * peak, error, at_mean * peak, rms, likelihood)


class _Model:
    """Relative residuals of all presses for a law, as functions of the offsets [m], shape (n,)."""

    def __init__(self, presses: Presses, law: BallLaw) -> None:
        self._presses, self._law = presses, law

    def profile(self, offset: Array) -> tuple[Array, Array]:
        """Return K / peak of each press, and the residuals of all rows."""
        presses = self._presses
        shape = self._law.force(presses.depth + offset[presses.index])
        scale = presses.sum(shape * presses.target) / np.maximum(presses.sum(shape**2), 1e-300)
        return scale, presses.target - scale[presses.index] * shape

    def linearise(self, offset: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return K / peak, residuals, information i [1/m2], gradient [1/m], and -d log K / do [1/m]."""
        presses, (scale, residual) = self._presses, self.profile(offset)
        fitted = presses.target - residual
        slope = scale[presses.index] * self._law.slope(presses.depth + offset[presses.index])
        ratio = presses.sum(fitted * slope) / np.maximum(presses.sum(fitted**2), 1e-300)
        slope -= ratio[presses.index] * fitted
        return scale, residual, presses.sum(slope**2), presses.sum(slope * residual), ratio

    def first_offsets(self) -> tuple[Array, Prior]:
        """Return the best of `FIRST_OFFSETS` of each press, and a prior from them."""
        presses, tried = self._presses, FIRST_OFFSETS[:, None] * self._presses.greatest_depth
        squares = np.array([presses.sum(self.profile(offset)[1] ** 2) for offset in tried])
        offset = tried[squares.argmin(axis=0), np.arange(presses.count)]
        noise = math.sqrt(float(squares.min(axis=0).sum()) / len(presses.depth))
        return offset, Prior(float(np.median(offset)), float(np.std(offset)) + MIN_WIDTH, noise + MIN_NOISE)

    def improve(self, offset: Array, prior: Prior) -> Array:
        """Return the offsets after a step of Gauss and Newton, halved where the residuals grow."""
        presses, weight = self._presses, (prior.noise / prior.width) ** 2

        def loss(offset: Array, residual: Array) -> Array:
            return presses.sum(residual**2) + weight * (offset - prior.mean) ** 2

        _, residual, information, gradient, _ = self.linearise(offset)
        step = (gradient - weight * (offset - prior.mean)) / (information + weight)
        before = loss(offset, residual) * (1 + 1e-12)
        for _ in range(HALVINGS):
            grows = loss(offset + step, self.profile(offset + step)[1]) > before
            if not grows.any():
                break
            step = np.where(grows, step / 4, step)
        return offset + np.where(grows, 0.0, step)

    def estimate_prior(self, offset: Array, prior: Prior) -> tuple[Prior, float]:
        """Return the most likely prior around offsets, and log L.

        With free offsets p = o + gradient / i of variance v = s^2 / i, p has the variance t^2 + v. The width t has a
        prior proportional to t, with which it is not 0 by chance (Chung et al., Psychometrika 78, 2013).
        """
        presses, (_, residual, information, gradient, _) = self._presses, self.linearise(offset)
        information = np.maximum(information, 1e-300)
        free, squares = offset + gradient / information, presses.sum(residual**2)
        least = float((squares - gradient**2 / information).clip(min=0).sum())
        rows = len(presses.depth) - presses.count

        def loss(width: float, noise: float) -> tuple[float, float]:
            variance = width**2 + noise**2 / information
            mean = float((free / variance).sum() / (1 / variance).sum())
            spread = (free - mean) ** 2 / variance
            value = (rows - presses.count) * math.log(noise**2) + least / noise**2 - 2 * math.log(width)
            return value + float((spread + np.log(variance * information)).sum()), mean

        depth = float(presses.greatest_depth.max())
        width = _minimise(lambda width: loss(width, prior.noise)[0], MIN_WIDTH, 10 * depth)
        low, high = max(prior.noise / 5, MIN_NOISE), 5 * prior.noise + MIN_NOISE
        noise = _minimise(lambda noise: loss(width, noise)[0], low, high)
        value, mean = loss(width, noise)
        return Prior(mean, width, noise), -value / 2


def _minimise(loss: Callable[[float], float], low: float, high: float) -> float:
    """Return the minimum of a function of a positive number."""
    ends = math.log(low), math.log(high)
    found = minimize_scalar(lambda x: loss(math.exp(x)), bounds=ends, method="bounded", options={"xatol": 1e-3})
    return math.exp(found.x)
