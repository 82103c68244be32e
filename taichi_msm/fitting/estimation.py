"""Find the values with which a scene fits what was seen best: nonlinear least squares within bounds.

The trust region method of SciPy, with differences of runs as derivatives: forward ones on the way, central ones where
it ends. What is minimised is the sum of rho(r^2) over all r = (predicted - seen) / sigma, with rho(z) = z, or for
robust fits SciPy's soft_l1, under which a number that is far off counts by |r|. Beside forces and in robust fits, a
sigma that is not known is found in turn with the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.fitting.observations import Observations
from taichi_msm.fitting.prediction import Predicted, difference
from taichi_msm.fitting.runs import Runs

Array = NDArray[np.float64]

# Where the fit ends: the cost, or all parameters, change by less than these shares.
ENOUGH_COST, ENOUGH = 1e-6, 1e-8

# Or the slope of the cost is no more than this.
FLAT = 1e-12

# The most trials of one search, and the most times that sigma and the parameters are found in turn.
MOST_TRIALS, MOST_ROUNDS = 40, 6

# Sigma is known once it changes by less than this share; it is at least this share of the motion.
SIGMA_KNOWN, LEAST_SIGMA = 0.02, 1e-9

# In a robust fit, what is farther off than so many sigma counts less.
FAR = 2.0

# Of normal errors, sigma over the median of their sizes.
PER_MEDIAN = 1.4826

# A fit is tried from other starts where what is left is more than this share of the motion, or so many sigma.
POOR_SHARE, POOR_SIGMAS = 0.1, 2.0

# So many other starts are looked at for each parameter, within a factor of 10, or the bounds; the best are followed.
LOOKED_AT, SPREAD, FOLLOWED = 8, np.log(10.0), 2


class Scales(NamedTuple):
    """Standard deviations by which differences are divided."""

    values: float  # [m] or [px]
    forces: float  # [N]


@dataclass(frozen=True, eq=False)
class Solution:
    """The best values."""

    x: Array  # of the parameters
    predicted: Predicted
    scales: Scales
    cost: float  # half the sum of rho
    converged: bool


class Misfit:
    """The differences between what is predicted and what was seen, as one row of numbers: the values, then the forces.

    Args:
        seen: what was seen.
        motion: of that, the root mean square [m] or [px].
        robust: whether what is far off counts less.

    Attributes:
        count: how many of the numbers are values, and how many are forces.
    """

    def __init__(self, seen: Observations, motion: float, *, robust: bool) -> None:
        self.seen, self.motion, self.robust = seen, motion, robust
        self._known = seen.known
        self._values = seen.values[self._known]
        forces = np.empty((0, 3)) if seen.forces is None else seen.forces.force
        self._known_forces = np.isfinite(forces)
        self._forces = forces[self._known_forces]
        self.count = self._values.size, self._forces.size

    def row(self, predicted: Predicted) -> Array:
        """Lay out what was predicted."""
        return np.concatenate([predicted.values[self._known], predicted.forces[self._known_forces]])

    def of(self, predicted: Predicted) -> Array:
        """Give predicted minus seen, in metres, pixels and newtons."""
        return self.row(predicted) - np.concatenate([self._values, self._forces])

    def divided(self, rows: Array, scales: Scales) -> Array:
        """Divide such rows, shape (numbers, ...), by the standard deviations."""
        by = np.repeat(scales, self.count)
        return rows / by.reshape(-1, *(1,) * (rows.ndim - 1))

    def residuals(self, predicted: Predicted, scales: Scales) -> Array:
        """Give r."""
        return self.divided(self.of(predicted), scales)

    def far(self, residuals: Array) -> Array:
        """Give d with which the derivatives of rho / 2 are r / d^(1/2) and d^(-3/2)."""
        return 1 + (residuals / FAR) ** 2 if self.robust else np.ones_like(residuals)

    def cost(self, residuals: Array) -> float:
        """Give half the sum of rho, as SciPy does."""
        rho = 2 * FAR**2 * (np.sqrt(self.far(residuals)) - 1) if self.robust else residuals**2
        return float(np.sum(rho)) / 2

    def sigma(self, predicted: Predicted, parameters: int) -> float:
        """Estimate the standard deviation of the values' errors from what is left of them, at least LEAST_SIGMA."""
        left = self.of(predicted)[: self.count[0]]
        mean_square = np.sum(left**2) / max(1, len(left) - parameters)
        found = PER_MEDIAN * np.median(np.abs(left)) if self.robust else np.sqrt(mean_square)
        return max(float(found), LEAST_SIGMA * self.motion)


class Search:
    """The search for the best values of a job's parameters.

    Args:
        runs: that predict.
        misfit: what is minimised; if sigma is not known, its motion stands for it at first.
    """

    def __init__(self, runs: Runs, misfit: Misfit) -> None:
        self._runs, self._misfit = runs, misfit
        self._delta = difference(runs.job.scene)
        limits = np.array([one.limits for one in runs.job.parameters])
        self._limits = limits[:, 0], limits[:, 1]
        self._known: dict[bytes, Predicted | None] = {}
        self._beside: dict[bytes, Predicted | None] = {}

    def best(self, start: Array) -> Solution:
        """Find the best values from a start, and from others if that does not fit."""
        solution = self._settled(start)
        if self.fits(solution):
            return solution
        others = self._other_starts()
        self._runs.expected += len(others)
        tried = [
            (self._cost(predicted, solution.scales), n)
            for n, predicted in enumerate(self._runs.several(others))
            if predicted is not None
        ]
        for _, n in sorted(tried)[:FOLLOWED]:
            other = self._settled(others[n])
            # Costs compare only for one sigma.
            if self._cost(other.predicted, solution.scales) < self._cost(solution.predicted, solution.scales):
                solution = other
            if self.fits(solution):
                break
        return solution

    def fits(self, solution: Solution) -> bool:
        """Tell whether what is left is small."""
        seen = self._misfit.seen
        if seen.forces is not None:
            left, most = solution.predicted.forces - seen.forces.force, POOR_SHARE**2 * np.nanmean(seen.forces.force**2)
            if np.nanmean(left**2) > max(most, (POOR_SIGMAS * seen.forces.sigma) ** 2):
                return False
        of_values = self._misfit.sigma(solution.predicted, len(solution.x))
        return of_values <= (POOR_SHARE * self._misfit.motion if seen.sigma is None else POOR_SIGMAS * seen.sigma)

    def derivatives(self, solution: Solution) -> Array:
        """Give the derivatives of what is predicted by x, by central differences, shape (numbers, parameters)."""
        return self._derivatives(solution.x, solution.predicted, signs=(1, -1))

    def _predict(self, x: Array) -> Predicted | None:
        """Predict, unless that was done already."""
        key = x.tobytes()
        if key not in self._known:
            self._known[key] = self._runs.one(x)
        return self._known[key]

    def _settled(self, start: Array) -> Solution:
        """Find the best values from a start, and sigma where it is not known."""
        seen, robust = self._misfit.seen, self._misfit.robust
        scales = Scales(seen.sigma or self._misfit.motion, seen.forces.sigma if seen.forces else 1.0)
        if robust and seen.sigma is None and (predicted := self._predict(start)) is not None:
            scales = scales._replace(values=self._misfit.sigma(predicted, len(start)))
        solution = self._from(start, scales)
        for _ in range(MOST_ROUNDS if seen.sigma is None and (seen.forces is not None or robust) else 0):
            sigma = self._misfit.sigma(solution.predicted, len(start))
            if abs(sigma / solution.scales.values - 1) < SIGMA_KNOWN:
                break
            solution = self._from(solution.x, scales._replace(values=sigma))
        return solution

    def _from(self, start: Array, scales: Scales) -> Solution:
        """Find the best values from a start."""
        from scipy.optimize import least_squares

        def residuals(x: Array) -> Array:
            predicted = self._predict(x)
            # SciPy comes nearer to the last place where it finds no number.
            if predicted is None:
                return np.full(sum(self._misfit.count), np.nan)
            return self._misfit.residuals(predicted, scales)

        def jacobian(x: Array) -> Array:
            predicted = self._predict(x)
            assert predicted is not None
            return self._misfit.divided(self._derivatives(x, predicted, signs=(1,)), scales)

        with np.errstate(all="ignore"):  # SciPy divides by slopes that are 0.
            found = least_squares(
                residuals,
                start,
                jacobian,
                self._limits,
                ftol=ENOUGH_COST,
                xtol=ENOUGH,
                gtol=FLAT,
                loss="soft_l1" if self._misfit.robust else "linear",
                f_scale=FAR,
                max_nfev=MOST_TRIALS,
            )
        predicted = self._predict(found.x)
        assert predicted is not None
        return Solution(found.x, predicted, scales, float(found.cost), bool(found.status > 0))

    def _derivatives(self, x: Array, predicted: Predicted, *, signs: tuple[int, ...]) -> Array:
        places = [
            [self._changed(x, n, sign) for sign in signs if sign == 1 or self._inside(x, n)] for n in range(len(x))
        ]
        self._runs.expected = max(self._runs.expected, self._runs.count + 3 * len(x))
        # Where the search ends, half of them were predicted by its last derivatives.
        new = [place for several in places for place in several if place.tobytes() not in self._beside]
        after = zip(new, self._runs.several(new, predicted.steps), strict=True)
        self._beside = {**self._beside, **{place.tobytes(): one for place, one in after}}
        self._beside = {place.tobytes(): self._beside[place.tobytes()] for several in places for place in several}
        columns = []
        for n, parameter in enumerate(self._runs.job.parameters):
            known = [(place[n], one) for place in places[n] if (one := self._beside[place.tobytes()]) is not None]
            if not known and len(signs) == 1:
                # Perhaps downward.
                return self._derivatives(x, predicted, signs=(1, -1))
            if not known:
                remedy = "give --bounds or another start by --set"
                raise SceneError([f"{parameter.key}: no run close to its value succeeds; {remedy}"])
            (one, first), (other, second) = [*known, (x[n], predicted)][:2]
            columns.append((self._misfit.row(first) - self._misfit.row(second)) / (one - other))
        return np.stack(columns, axis=1)

    def _inside(self, x: Array, n: int) -> bool:
        """Tell whether a parameter can be changed to both sides."""
        return bool(self._limits[0][n] <= x[n] - self._delta and x[n] + self._delta <= self._limits[1][n])

    def _changed(self, x: Array, n: int, sign: int) -> Array:
        """Change a parameter, upward where that is within the bounds, else downward."""
        place = x.copy()
        place[n] += self._delta if sign == 1 and x[n] + self._delta <= self._limits[1][n] else -self._delta
        return place

    def _cost(self, predicted: Predicted, scales: Scales) -> float:
        return self._misfit.cost(self._misfit.residuals(predicted, scales))

    def _other_starts(self) -> list[Array]:
        """Choose other starts, spread evenly over the bounds, at most a factor of 10 from the first."""
        from scipy.stats import qmc

        low, high = (np.clip(limit, -SPREAD, SPREAD) for limit in self._limits)
        shares = qmc.Sobol(len(low), seed=1).random_base2((LOOKED_AT * len(low) - 1).bit_length())
        return list(qmc.scale(shares, low, high))
