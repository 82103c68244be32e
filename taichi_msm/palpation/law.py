"""Force of a rigid ball whose points stick, pressed into an elastic foundation that locks.

The ball of radius R is d deep. Its surface at the height s above its lowest point presses the tissue in by d - s, in a
ring of area 2 pi (R - s) ds. With f the law of the foundation, a force per area f(w) K,

    F(d) = 2 pi K int_0^min(d, R) (R - s) f(d - s) ds = 2 pi K (R P(d) - Q(d) + Q(d - R))

P the integral of f, Q that of P, both 0 below 0. f(w) = w without a lock; else `laws.locking` of scale m, where with
x = w / m up to x0 = 1 - factor^(-1/2): P = m^2 (-x - log(1 - x)), Q = m^3 (x - x^2 / 2 + (1 - x) log(1 - x)); beyond x0
f continues with the slope `factor`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from taichi_msm.arithmetic import Array

# Largest slope of the locked foundation, relative to that at rest.
FACTOR = 10.0

END = 1 - FACTOR**-0.5

# Below it, the series of P and Q are used, which avoid cancellation; their next terms are below 1e-16.
MAX_SERIES_SHARE, SERIES_TERMS = 0.02, 10


@dataclass(frozen=True)
class BallLaw:
    """Law of the force of a ball; `lock`: depth m [m] at which the foundation locks, infinite if it is linear."""

    radius: float
    lock: float = math.inf

    def force(self, depth: Array) -> Array:
        """Return F / K [m3] at depths [m]."""
        _, first, second = self._integrals(depth)
        _, _, beyond = self._integrals(depth - self.radius)
        return np.asarray(2 * np.pi * (self.radius * first - second + beyond))

    def slope(self, depth: Array) -> Array:
        """Return the derivative of `force` by depth [m2]."""
        law, first, _ = self._integrals(depth)
        _, beyond, _ = self._integrals(depth - self.radius)
        return np.asarray(2 * np.pi * (self.radius * law - first + beyond))

    def _integrals(self, depth: Array) -> tuple[Array, Array, Array]:
        """Return f [m], P [m2] and Q [m3] at depths [m]."""
        w = np.maximum(depth, 0.0)
        if math.isinf(self.lock):
            return w, w**2 / 2, w**3 / 6
        x = np.minimum(w / self.lock, END)
        f, p, q = x / (1 - x), *_logarithmic(x)
        # Beyond END all three are polynomials; r is 0 before.
        r = w / self.lock - x
        q += r * (p + r * (f / 2 + r * (FACTOR / 6)))
        p += r * (f + r * (FACTOR / 2))
        return (f + FACTOR * r) * self.lock, p * self.lock**2, q * self.lock**3


def _logarithmic(x: Array) -> tuple[Array, Array]:
    """Return -x - log(1 - x) = sum of x^k / k, and its integral, from k = 2, for x from 0 to END."""
    p, q = (np.zeros_like(x) for _ in range(2))
    for k in range(SERIES_TERMS, 1, -1):
        p, q = p * x + 1 / k, q * x + 1 / (k * (k + 1))
    log = np.log1p(-x)
    is_small = x < MAX_SERIES_SHARE
    return np.where(is_small, p * x**2, -x - log), np.where(is_small, q * x**3, x - x**2 / 2 + (1 - x) * log)
