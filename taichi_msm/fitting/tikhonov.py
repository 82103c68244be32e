"""Find a map of stiffness from what was seen: many fields at once, as smooth as what was seen allows.

Minimised over the logs x of the factors of all fields, within bounds, by L-BFGS-B with the gradient of the adjoint, is

    1/2 sum ((predicted - seen) / sigma)^2 + w/2 sum (x_p - x_q)^2        over all neighbouring fields p, q

(Tikhonov, with the gradient of the log of the map). The weight w follows from the discrepancy principle: it is the
largest with which no more is left than sigma lets expect. Of all numbers that were seen, only as many as there are
fields could be met by some map; the errors of the others are the same with any, and chance makes them more or less. So
what is compared is how far chi-square is above the least that a map can reach: as many as there are fields, less those
that the map is free to follow, tr(J^T J (J^T J + w L)^-1), with sigma = 1. A column of J is the difference that a field
makes; L is the matrix of the second sum. J is found anew where a search ends, until the weight stays.

The errors are those of Laplace's approximation there, from the inverse of J^T J + w L. They are only as true as the
tissue is smooth. So a field is unknown where it would be told no better than UNKNOWN if all others were given.

The fields of a map of stiffness, and how they share out to the cells of a sheet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.fitting.observations import Observations, Sight
from taichi_msm.gradients.gradient import Adjoint

Array = NDArray[np.float64]

# A field that has a larger relative error even if all others are known is unknown.
UNKNOWN = 0.5

# The weights that are looked at, of the largest number in J^T J.
WEIGHTS = 10.0 ** np.arange(2, -9, -0.1)

# The weight stays if it changes by less than this factor; it and the map are found in turn at most so many times.
STAYS, ROUNDS = 2.0, 4

# By how much the log of a field is changed at most from where J was found to where a search starts.
FAR = 1.0

# A search ends where an iteration lowers the cost by less than this share; how many steps it remembers; its iterations.
ENOUGH, MEMORY, ITERATIONS = 1e-6, 50, 300

# By how much the log of a field is changed for a difference.
DIFFERENCE = 1e-2


class Choice(NamedTuple):
    """A weight, and why it was chosen."""

    weight: float
    step: Array  # to the map with that weight, where what is seen is linear in it
    weights: Array  # that were looked at, up to this one
    left: Array  # by how much chi-square is above the least, with each
    expected: Array  # and how much is expected


@dataclass(frozen=True, eq=False)
class Linear:
    """What is seen near a map.

    Attributes:
        x: logs of the factors of the fields, shape (R^2,).
        told: J^T J, shape (R^2, R^2).
        slope: half of the derivative of chi-square by x.
        excess: how many times more is left with any map than sigma lets expect, at least 1; all here is divided by it.
    """

    x: Array
    told: Array
    slope: Array
    excess: float

    def choice(self, rough: Array) -> Choice:
        """Choose the weight of L."""
        tried: list[tuple[float, float, float]] = []
        to_least = float(self.slope @ np.linalg.pinv(self.told, hermitian=True) @ self.slope)
        for weight in WEIGHTS * np.diag(self.told).max():
            inverse = np.linalg.inv(self.told + weight * rough)
            step = -inverse @ (self.slope + weight * (rough @ self.x))
            left = to_least + float(2 * self.slope @ step + step @ self.told @ step)
            tried.append((float(weight), left, len(step) - float(np.sum(inverse * self.told))))
            if left <= tried[-1][2]:
                break
        return Choice(tried[-1][0], step, *np.array(tried).T)

    def errors(self, weight: float, rough: Array) -> Array:
        """Give the standard errors of x, shape (R^2,); NaN: unknown."""
        deviations = np.sqrt(np.diag(np.linalg.inv(self.told + weight * rough)))
        return np.where(np.diag(self.told) * UNKNOWN**2 >= 1, deviations, np.nan)


@dataclass(frozen=True, eq=False)
class Solution:
    """The map that was found: logs of its factors, their errors (NaN: unknown), and how its smoothness was chosen."""

    x: Array
    errors: Array
    excess: float
    choice: Choice


class Search:
    """The search for a map.

    Args:
        adjoint: of the scene.
        sight: of the same.
        seen: what was seen.
        sigma: the standard deviation of its errors, with those of the model [m] or [px].
        fields: of the map.
        limits: of the logs of the factors.
        tell: called some times a second; what it raises stops the search.

    Attributes:
        runs: how many there were.
    """

    def __init__(
        self,
        adjoint: Adjoint,
        sight: Sight,
        seen: Observations,
        sigma: float,
        fields: Fields,
        limits: tuple[float, float],
        tell: Callable[[], None],
    ) -> None:
        self._adjoint, self._sight, self._seen, self._sigma = adjoint, sight, seen, sigma
        self._fields, self._limits, self._tell = fields, limits, tell
        self._rough = fields.roughness()
        self.runs = 0

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Give where the points are with a map [m], shape (N, T, 3), and what is seen of them."""
        self._tell()
        self.runs += 1
        points = self._sight.points(self._adjoint.run(self._fields.factors(x), self._tell))
        predicted = self._sight.seen(points)
        if not np.isfinite(predicted[self._seen.known]).all():
            said = "a point that was seen gets behind the eye of the camera with some maps"
            raise SceneError([f"{self._seen.name}: pixel: {said}; give NaN in its place, or narrower --bounds"])
        return points, predicted

    def misfit(self, x: Array) -> tuple[float, Array]:
        """Give chi-square and its derivative by x."""
        points, predicted = self.predict(x)
        left = np.where(self._seen.known, predicted - self._seen.values, 0.0) / self._sigma
        slope = self._adjoint.backward(self._sight.backward(points, 2 * left / self._sigma), self._tell)
        return float((left**2).sum()), self._fields.backward(x, slope.maps["tissue.map"])

    def best(self, start: Array) -> Solution:
        """Find the smoothest map that explains what was seen."""
        near = self._linear(start)
        choice = near.choice(self._rough)
        for _ in range(ROUNDS):
            before = choice.weight
            x = self._at(np.clip(near.x + np.clip(choice.step, -FAR, FAR), *self._limits), before, near.excess)
            near = self._linear(x)
            choice = near.choice(self._rough)
            if 1 / STAYS < choice.weight / before < STAYS:
                break
        return Solution(x, near.errors(before, self._rough), near.excess, choice._replace(weight=before))

    def _linear(self, x: Array) -> Linear:
        """Find the differences that the fields make: J, which takes 8 bytes for each field and number that was seen."""
        known, before = self._seen.known, self.predict(x)[1]
        left = (before - self._seen.values)[known] / self._sigma
        jacobian = np.empty((left.size, len(x)))
        for n, change in enumerate(DIFFERENCE * np.eye(len(x))):
            jacobian[:, n] = (self.predict(x + change)[1] - before)[known] / (DIFFERENCE * self._sigma)
        told, slope = jacobian.T @ jacobian, jacobian.T @ left
        least = float(left @ left - slope @ np.linalg.pinv(told, hermitian=True) @ slope)
        excess = max(1.0, least / max(1, left.size - len(x)))
        return Linear(x, told / excess, slope / excess, excess)

    def _at(self, start: Array, weight: float, excess: float) -> Array:
        """Minimise for one weight; excess: by which chi-square is divided."""
        from scipy.optimize import minimize

        def cost(x: Array) -> tuple[float, Array]:
            (chi_square, slope), rough = self.misfit(x), self._rough @ x
            chi_square, slope = chi_square / excess, slope / excess
            return (chi_square + weight * float(x @ rough)) / 2, slope / 2 + weight * rough

        options = {"maxcor": MEMORY, "ftol": ENOUGH, "gtol": 0.0, "maxiter": ITERATIONS}
        bounds = [self._limits] * len(start)
        found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return np.asarray(found.x, np.float64)


class Fields:
    """R x R fields of a map, and the cells of a sheet, which get what `sheet.map_factors` gives of such a picture.

    Args:
        resolution: R.
        cells: of the sheet, rows and cols.
    """

    def __init__(self, resolution: int, cells: tuple[int, int]) -> None:
        self.resolution = resolution
        # Linear between the centres of the fields, constant beyond.
        self._down, self._across = (
            np.stack([np.interp(centres(n), centres(resolution), unit) for unit in np.eye(resolution)], axis=1)
            for n in cells
        )

    def factors(self, x: Array) -> Array:
        """Give the factors of the cells for the logs of those of the fields, shape (R^2,)."""
        return np.asarray(self._down @ np.exp(x).reshape(self.resolution, -1) @ self._across.T)

    def backward(self, x: Array, by_cell: Array) -> Array:
        """Turn the derivative of a loss by the factors of the cells into that by the logs x."""
        return np.asarray(np.exp(x) * (self._down.T @ by_cell @ self._across).ravel())

    def roughness(self) -> Array:
        """Give L, shape (R^2, R^2): x L x is the sum of the squared differences of neighbouring fields."""
        steps, one = np.diff(np.eye(self.resolution), axis=0), np.eye(self.resolution)
        line = steps.T @ steps
        return np.kron(line, one) + np.kron(one, line)


def centres(count: int) -> Array:
    """Give the centres of equal parts of a side, as fractions of it."""
    return (np.arange(count) + 0.5) / count
