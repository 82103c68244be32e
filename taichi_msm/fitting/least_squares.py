"""Parameter estimation by nonlinear least squares.

The sum of rho(r^2) over all residuals r = (predicted - observed) / sigma is minimised within bounds by SciPy's trust
region method, with rho(z) = z, or soft_l1 in robust fits. The Jacobian consists of finite differences: forward ones
during the search, central ones at the solution. With forces, and in robust fits, an unknown sigma is estimated
alternately with the parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError
from taichi_msm.fitting.observation import Observation
from taichi_msm.fitting.predict import Prediction, Runs

# Largest residual with almost full weight in robust fits, in sigma.
OUTLIER_SIGMAS = 2.0

# Relative changes of the cost and of x, and the gradient, at which a search ends.
TOLERANCES = {"ftol": 1e-6, "xtol": 1e-8, "gtol": 1e-12}

# Largest coordinate of an alternative start, a factor of 10 from the initial value.
MAX_START_LOG = np.log(10.0)

# Standard deviations of the values of every observation, in its unit: one number, or an array of shape (known,).
Scales = tuple["float | Array", ...]


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of the least-squares problem."""

    x: Array  # coordinates of the parameters, shape (n,)
    predicted: Prediction  # at x
    scales: Scales  # of the cost
    cost: float  # half the sum of rho
    converged: bool


class Misfit:
    """Residuals of predictions, flattened to one axis of all known values, one observation after the other.

    `signals` are from `Observation.signal`; with `robust`, outliers are downweighted.
    """

    def __init__(self, observations: Sequence[Observation], signals: Sequence[float], *, robust: bool) -> None:
        self.observations, self.signals, self.robust = observations, signals, robust
        self._known = [observed.known for observed in observations]
        self.count = [int(known.sum()) for known in self._known]  # of each observation
        self._observed = self._flatten([observed.values for observed in observations])

    def vector(self, predicted: Prediction) -> Array:
        """Return the predictions of all known values as a vector, shape (known,)."""
        return self._flatten(predicted.values)

    def difference(self, predicted: Prediction) -> Array:
        """Return predicted minus observed values, in the units of the observations, shape (known,)."""
        return self.vector(predicted) - self._observed

    def split(self, rows: Array) -> list[Array]:
        """Split rows, shape (known, ...), by observation."""
        return np.split(rows, np.cumsum(self.count)[:-1])

    @property
    def freedom(self) -> int:
        """Number of independent values, less that of offsets."""
        return sum(observed.freedom for observed in self.observations)

    def scaled(self, rows: Array, scales: Scales, robust_factor: Callable[[Array], Array] | None = None) -> Array:
        """Return rows in the units of the observations / scales, without unknown offsets, shape (known, ...).

        `robust_factor` is as for `Observation.without_offset`.
        """
        deviations = np.concatenate([np.broadcast_to(scale, n) for scale, n in zip(scales, self.count, strict=True)])
        parts = self.split(rows / deviations.reshape(-1, *(1,) * (rows.ndim - 1)))
        pairs = zip(self.observations, parts, strict=True)
        return np.concatenate([observed.without_offset(part, robust_factor) for observed, part in pairs])

    def residuals(self, predicted: Prediction, scales: Scales) -> Array:
        """Return the residuals r, shape (known,)."""
        return self.scaled(self.difference(predicted), scales, self.robust_factor if self.robust else None)

    def robust_factor(self, residuals: Array) -> Array:
        """Return d(r), 1 unless robust; the derivatives of rho / 2 by r are r d^(-1/2) and d^(-3/2)."""
        return 1 + (residuals / OUTLIER_SIGMAS) ** 2 if self.robust else np.ones_like(residuals)

    def cost(self, residuals: Array) -> float:
        """Return half the sum of rho, the cost of SciPy."""
        rho = 2 * OUTLIER_SIGMAS**2 * (np.sqrt(self.robust_factor(residuals)) - 1) if self.robust else residuals**2
        return float(np.sum(rho)) / 2

    def total(self, predicted: Prediction, scales: Scales) -> float:
        """Return the cost of a prediction."""
        return self.cost(self.residuals(predicted, scales))

    def two_best(self, predictions: Iterable[tuple[Array, Prediction | None]], scales: Scales) -> list[Array]:
        """Return the two coordinates of lowest cost; None is the prediction of a failed run."""
        costs = [(self.total(predicted, scales), x.tolist()) for x, predicted in predictions if predicted is not None]
        return [np.array(x) for _, x in sorted(costs)[:2]]

    def deviations(self, predicted: Prediction, parameter_count: int) -> list[float]:
        """Return the standard deviation of every observation, in its unit, estimated from its residuals."""
        deviations = []
        for residuals, signal in zip(self.split(self.difference(predicted)), self.signals, strict=True):
            mean_square = np.sum(residuals**2) / max(1, len(residuals) - parameter_count)
            # 1.4826 converts the median magnitude of normal errors to sigma.
            sigma = 1.4826 * np.median(np.abs(residuals)) if self.robust else np.sqrt(mean_square)
            deviations.append(max(float(sigma), 1e-9 * signal))
        return deviations

    def scales(self, unknown: Sequence[float]) -> Scales:
        """Return the standard deviations of all observations, from `unknown` where they are not given."""
        given = zip(self.observations, unknown, strict=True)
        return tuple(sigma if observed.sigma is None else observed.sigma for observed, sigma in given)

    def _flatten(self, values: Sequence[Array]) -> Array:
        return np.concatenate([each[known] for each, known in zip(values, self._known, strict=True)])


class Search:
    """Nonlinear least squares with restarts; an unknown sigma starts at the signal.

    The limits of x, shape (n,) each, are by default those of the parameters.
    """

    def __init__(self, runs: Runs, misfit: Misfit, limits: tuple[Array, Array] | None = None) -> None:
        self._runs, self.misfit = runs, misfit
        self._delta = runs.problem.difference_step
        self._limits = limits or runs.problem.limits
        self._known: dict[bytes, Prediction | None] = {}
        self._neighbours: dict[bytes, Prediction | None] = {}

    def best(self, start: Array) -> Solution:
        """Return the best solution from a start, shape (n,), and from two alternative starts if it fits poorly."""
        solution = self.refine(start)
        if self.fits_well(solution):
            return solution
        starts = self.alternative_starts()
        self._runs.expected += len(starts)
        predictions = zip(starts, self._runs.predict_many(starts), strict=True)
        for x in self.misfit.two_best(predictions, solution.scales):
            candidate, scales = self.refine(x), solution.scales
            # Costs are comparable only with the same sigma.
            if self.misfit.total(candidate.predicted, scales) < self.misfit.total(solution.predicted, scales):
                solution = candidate
            if self.fits_well(solution):
                break
        return solution

    def fits_well(self, solution: Solution) -> bool:
        """Return whether the residuals of all observations are small."""
        misfit = self.misfit
        residuals = misfit.split(misfit.difference(solution.predicted))
        deviations = misfit.deviations(solution.predicted, len(solution.x))
        rows = zip(misfit.observations, residuals, deviations, misfit.signals, strict=True)
        return all(observed.fits_well(part, deviation, signal) for observed, part, deviation, signal in rows)

    def jacobian(self, solution: Solution) -> Array:
        """Return the Jacobian of the predictions by x, shape (known, n)."""
        return self._differences(solution.x, solution.predicted, signs=self._runs.problem.signs)

    def remember(self, x: Array, predicted: Prediction) -> None:
        """Cache the prediction at x, shape (n,)."""
        self._known[x.tobytes()] = predicted

    def _predict(self, x: Array) -> Prediction | None:
        """Predict at x, with a cache."""
        if x.tobytes() not in self._known:
            self._known[x.tobytes()] = self._runs.predict_one(x)
        return self._known[x.tobytes()]

    def refine(self, start: Array) -> Solution:
        """Return the minimum from a start, shape (n,); alternate with the estimation of an unknown sigma."""
        misfit = self.misfit
        is_unknown = any(observed.sigma is None for observed in misfit.observations)
        scales = misfit.scales(misfit.signals)
        if misfit.robust and is_unknown and (predicted := self._predict(start)) is not None:
            scales = misfit.scales(misfit.deviations(predicted, len(start)))
        solution = self._minimise(start, scales)
        alternates = is_unknown and (len(misfit.observations) > 1 or misfit.robust)
        for _ in range(6 if alternates else 0):
            scales = misfit.scales(misfit.deviations(solution.predicted, len(start)))
            pairs = zip(scales, solution.scales, strict=True)
            if all(np.abs(np.divide(new, old) - 1).max() < 0.02 for new, old in pairs):
                break
            solution = self._minimise(solution.x, scales)
        return solution

    def _minimise(self, start: Array, scales: Scales) -> Solution:
        from scipy.optimize import least_squares

        def residuals(x: Array) -> Array:
            predicted = self._predict(x)
            # SciPy reduces its step after a NaN.
            if predicted is None:
                return np.full(sum(self.misfit.count), np.nan)
            return self.misfit.residuals(predicted, scales)

        def jacobian(x: Array) -> Array:
            predicted = self._predict(x)
            assert predicted is not None
            return self.misfit.scaled(self._differences(x, predicted, signs=(1,)), scales)

        loss = {"loss": "soft_l1" if self.misfit.robust else "linear", "f_scale": OUTLIER_SIGMAS}
        with np.errstate(all="ignore"):  # SciPy divides by gradients that are 0.
            result = least_squares(residuals, start, jacobian, self._limits, max_nfev=40, **TOLERANCES, **loss)
        predicted = self._predict(result.x)
        assert predicted is not None
        return Solution(result.x, predicted, scales, float(result.cost), bool(result.status > 0))

    def _differences(self, x: Array, predicted: Prediction, *, signs: tuple[int, ...]) -> Array:
        """Return the Jacobian by forward differences, backward at a bound, or central ones if `signs` has both."""
        neighbours = []
        for low, value, high, unit in zip(self._limits[0], x, self._limits[1], np.eye(len(x), dtype=bool), strict=True):
            sides = [value + self._delta] if value + self._delta <= high else []
            if not sides or (-1 in signs and low <= value - self._delta):
                sides.append(value - self._delta)
            neighbours.append([np.where(unit, side, x) for side in sides])
        self._runs.expected = max(self._runs.expected, self._runs.count + 3 * len(x))
        # Central differences reuse the forward ones of the last Jacobian of the search.
        points = [neighbour for pair in neighbours for neighbour in pair]
        missing = [point for point in points if point.tobytes() not in self._neighbours]
        computed = zip(missing, self._runs.predict_many(missing, predicted.steps), strict=True)
        known = self._neighbours | {point.tobytes(): prediction for point, prediction in computed}
        self._neighbours = {point.tobytes(): known[point.tobytes()] for point in points}
        columns = []
        for n, parameter in enumerate(self._runs.problem.parameters):
            pairs = [(neighbour[n], known[neighbour.tobytes()]) for neighbour in neighbours[n]]
            sides = [(side, prediction) for side, prediction in pairs if prediction is not None]
            if not sides and len(signs) == 1:
                # A backward difference may succeed.
                return self._differences(x, predicted, signs=(1, -1))
            if not sides:
                remedy = "give --bounds or another start by --set"
                raise SceneError([f"{parameter.key}: no run close to its value succeeds; {remedy}"])
            (x_first, first), (x_second, second) = [*sides, (x[n], predicted)][:2]
            columns.append((self.misfit.vector(first) - self.misfit.vector(second)) / (x_first - x_second))
        return np.stack(columns, axis=1)

    def alternative_starts(self) -> list[Array]:
        """Return a Sobol sequence of starts within the bounds, at least 8 per parameter, or 8 for machine tests."""
        from scipy.stats import qmc

        low, high = (np.clip(limit, -MAX_START_LOG, MAX_START_LOG) for limit in self._limits)
        count = 8 * len(low) if len(self._runs.problem.signs) > 1 else 8
        shares = qmc.Sobol(len(low), seed=1).random_base2((count - 1).bit_length())
        return list(qmc.scale(shares, low, high))
