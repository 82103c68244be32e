"""A map of stiffness from what was seen: many fields at once, kept smooth as far as what was seen allows.

Minimises, over the logs x of the factors of all fields, within bounds, by L-BFGS-B with the gradient of the adjoint

    1/2 sum ((predicted - seen) / sigma)^2 + w/2 sum (x_p - x_q)^2        over all neighbouring fields p, q

(Tikhonov, with the gradient of the log of the map). The weight w follows from the discrepancy principle: it is the
largest with which what is left is what sigma lets expect, a chi-square of the count of the numbers that were seen.
It is found from large weights down, so that each search begins near its end.

The errors are those of Laplace's approximation, the inverse of J^T J / sigma^2 + w L at the best map: J has differences
of one run for each field as columns, L is the matrix of the second sum. That sum is only as true as the tissue is
smooth. So a field is called unknown if what was seen tells it to no better than UNKNOWN even when all others are given.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.observations import Observations
from taichi_msm.fitting.sight import Sight
from taichi_msm.physics.adjoint import Adjoint
from taichi_msm.physics.plan import Plan

Array = NDArray[np.float64]

# A field whose relative error is larger, if all other fields are known, is unknown.
UNKNOWN = 0.5

# At the first weight a step of so much in the log between all neighbours costs as much as what is left at the start.
ROUGHNESS = 0.1

# The weight is divided by LESS at most MOST times; chi-square is wanted within SHARE, by so many searches in between.
LESS, MOST, SHARE, BETWEEN = 10.0, 8, 0.05, 3

# Where no weight gives the chi-square that is expected, one is taken that comes this close to the least.
NEARLY = 1.05

# A search ends where the cost changes by less than this share; memory of L-BFGS; the most iterations.
ENOUGH, MEMORY, ITERATIONS = 1e-5, 30, 200

# By how much a field's log is changed for a difference.
DIFFERENCE = 1e-2


class Fields:
    """R x R fields of a map, and the cells of a sheet: the factors of the cells, as of the picture of such a map."""

    def __init__(self, resolution: int, cells: tuple[int, int]) -> None:
        self.resolution = resolution
        centres = (np.arange(resolution) + 0.5) / resolution
        # Like `material.map_factors`: linear between the centres of fields, constant beyond.
        self._down, self._across = (
            np.stack([np.interp((np.arange(n) + 0.5) / n, centres, unit) for unit in np.eye(resolution)], axis=1)
            for n in cells
        )

    def factors(self, x: Array) -> Array:
        """Give the factors of the cells for logs of those of the fields, shape (R^2,)."""
        return self._down @ np.exp(x).reshape(self.resolution, -1) @ self._across.T

    def backward(self, x: Array, by_cell: Array) -> Array:
        """Turn the derivative of a loss by the factors of the cells into that by x."""
        return np.exp(x) * (self._down.T @ by_cell @ self._across).ravel()

    def roughness(self) -> Array:
        """Give L: x L x is the sum of the squared differences of neighbouring fields, shape (R^2, R^2)."""
        line, one = np.diff(np.eye(self.resolution), axis=0), np.eye(self.resolution)
        return np.kron(line.T @ line, one) + np.kron(one, line.T @ line)


@dataclass(frozen=True, eq=False)
class Found:
    """A map at the end of a search."""

    x: Array  # logs of the factors
    chi_square: float
    weight: float


class Search:
    """The search for a map."""

    def __init__(
        self,
        adjoint: Adjoint,
        plan: Plan,
        seen: Observations,
        sigma: float,
        fields: Fields,
        limits: tuple[float, float],
        tell: Callable[[], None],
    ) -> None:
        self._adjoint, self._fields, self._limits, self._tell = adjoint, fields, limits, tell
        self._seen, self._sigma = seen, sigma
        self._sight = Sight(plan.scene, seen, plan.grid.frames + 1)
        self._rough = fields.roughness()
        self.count = 0

    def predict(self, x):
        self._tell()
        self.count += 1
        points = self._sight.points(self._adjoint.run(self._fields.factors(x)))
        return points, self._sight.seen(points)

    def left(self, predicted):
        return np.where(self._seen.known, predicted - self._seen.values, 0.0) / self._sigma

    def misfit(self, x):
        points, predicted = self.predict(x)
        left = self.left(predicted)
        slope = self._sight.backward(points, left / self._sigma)
        by_cell = self._adjoint.backward(slope).maps["tissue.map"]
        return float((left**2).sum()), self._fields.backward(x, by_cell)

    def at_weight(self, x, weight):
        from scipy.optimize import minimize
        last = {}
        def cost(x):
            chi, slope = self.misfit(x)
            last[x.tobytes()] = chi
            rough = self._rough @ x
            return chi / 2 + weight / 2 * float(x @ rough), slope + weight * rough
        n0 = self.count
        found = minimize(cost, x, jac=True, method="L-BFGS-B", bounds=[self._limits] * len(x),
            options={"maxcor": MEMORY, "ftol": ENOUGH, "gtol": 0.0, "maxiter": ITERATIONS})
        print("w %.3g chi/N %.4g evals %d %s" % (weight, last[found.x.tobytes()]/self._seen.known.sum(), self.count-n0, found.message), flush=True)
        return Found(found.x, last[found.x.tobytes()], weight)

    def best(self, x):
        wanted = float(self._seen.known.sum())
        chi, _ = self.misfit(x)
        weight = chi / (len(x) * 2 * ROUGHNESS**2)
        all_ = [self.at_weight(x, weight)]
        while all_[-1].chi_square > wanted and len(all_) <= MOST:
            o = all_[-1]
            if o.weight * float(o.x @ self._rough @ o.x) < 0.01 * o.chi_square: break
            all_.append(self.at_weight(all_[-1].x, all_[-1].weight / LESS))
        if all_[-1].chi_square > wanted:
            return next(one for one in all_ if one.chi_square <= NEARLY * all_[-1].chi_square)
        if len(all_) == 1: return all_[0]
        above, below = all_[-2:]
        for _ in range(BETWEEN):
            if below.chi_square > (1 - SHARE) * wanted:
                break
            share = math.log(wanted * (1 - SHARE/2) / below.chi_square) / math.log(above.chi_square / below.chi_square)
            share = min(max(share, .1), .9)
            w = below.weight * (above.weight / below.weight) ** share
            one = self.at_weight(below.x, w)
            if one.chi_square > wanted: above = one
            else: below = one
        return below

    def jacobian(self, x):
        base = self.predict(x)[1]
        known = self._seen.known
        cols = []
        for n in range(len(x)):
            y = x.copy(); y[n] += DIFFERENCE
            cols.append((self.predict(y)[1] - base)[known] / (DIFFERENCE * self._sigma))
        return np.stack(cols, 1)
