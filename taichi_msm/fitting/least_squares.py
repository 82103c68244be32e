"""Parameter estimation by nonlinear least squares, with confidence intervals and identifiability.

The sum of rho(r^2) over all residuals r = (predicted - observed) / sigma is minimised within bounds by SciPy's trust
region method, with rho(z) = z, or soft_l1 in robust fits. The Jacobian consists of finite differences: forward ones
during the search, central ones at the solution. With forces, and in robust fits, an unknown sigma is estimated
alternately with the parameters.

Covariance. With J the Jacobian of r by x, the covariance of x is

    C = f (J^T W J)^-1 M (J^T W J)^-1,    M = J^T W^(1/2) K W^(1/2) J

with W = 1 and K = 1, and f the mean of r^2 per degree of freedom, at least 1. In a robust fit W is the second
derivative of rho / 2, and f the mean square of its first derivative over the mean of W. K is the correlation of the
errors: exp(-distance / correlation) for two tracks at a time, exp(-interval / drift) for a track at two times, or the
product of both. With the singular value decomposition W^(1/2) J = U S V^T,

    C = f V S^-1 (U^T K U) S^-1 V^T

which avoids the squared condition number of J^T W J.

Profile intervals. A parameter is fixed, and the others are optimised within their bounds by Gauss-Newton steps with J
from the solution, a run per step. The interval ends where the cost has risen by t^2 f / 2, with Student's t, times the
widening by correlated errors.

Identifiability. Parameters can be identifiable in combinations only: images determine the ratio of a stiffness and a
force, but neither of them. The singular vectors with large standard deviations span the unidentifiable directions;
the combinations orthogonal to them are reported.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.fitting.observation import Array, ErrorCorrelation, Observation
from taichi_msm.fitting.parameters import Parameter, rounded
from taichi_msm.fitting.predict import Prediction, Runs, difference_step

# Larger residuals are downweighted in robust fits.
OUTLIER_SIGMAS = 2.0

# Largest log of the factor between alternative starts and the first one.
MAX_START_LOG = np.log(10.0)

# Standard deviations of the residuals of every observation, in its unit: of all, or of each.
Scales = tuple["float | Array", ...]


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of the least-squares problem."""

    x: Array  # parameters, shape (n,)
    predicted: Prediction
    scales: Scales
    cost: float  # half the sum of rho
    converged: bool


class Misfit:
    """Residuals of predictions, flattened to one axis, one observation after the other.

    Args:
        observations: the observations.
        signals: root mean square of what a fit explains of each, in its unit.
        robust: whether outliers are downweighted.
    """

    def __init__(self, observations: Sequence[Observation], signals: Sequence[float], *, robust: bool) -> None:
        self.observations, self.signals, self.robust = observations, signals, robust
        self._known = [observed.known for observed in observations]
        self.count = [int(known.sum()) for known in self._known]  # of each observation
        self._observed = self._flatten([observed.values for observed in observations])

    def row(self, predicted: Prediction) -> Array:
        """Return the predictions of all observed values, shape (numbers,)."""
        return self._flatten(predicted.values)

    def of(self, predicted: Prediction) -> Array:
        """Return predicted minus observed, in the units of the observations, shape (numbers,)."""
        return self.row(predicted) - self._observed

    def split(self, rows: Array) -> list[Array]:
        """Split rows, shape (numbers, ...), by observation."""
        return np.split(rows, np.cumsum(self.count)[:-1])

    def scaled(self, rows: Array, scales: Scales) -> Array:
        """Divide rows, shape (numbers, ...), by their standard deviations."""
        deviations = np.concatenate([np.broadcast_to(scale, n) for scale, n in zip(scales, self.count, strict=True)])
        return rows / deviations.reshape(-1, *(1,) * (rows.ndim - 1))

    def residuals(self, predicted: Prediction, scales: Scales) -> Array:
        """Return the residuals r, shape (numbers,)."""
        return self.scaled(self.of(predicted), scales)

    def robust_factor(self, residuals: Array) -> Array:
        """Return d, where rho / 2 has the derivatives r d^(-1/2) and d^(-3/2) by r."""
        return 1 + (residuals / OUTLIER_SIGMAS) ** 2 if self.robust else np.ones_like(residuals)

    def cost(self, residuals: Array) -> float:
        """Return half the sum of rho, as SciPy does."""
        rho = 2 * OUTLIER_SIGMAS**2 * (np.sqrt(self.robust_factor(residuals)) - 1) if self.robust else residuals**2
        return float(np.sum(rho)) / 2

    def deviations(self, predicted: Prediction, parameters: int) -> list[float]:
        """Estimate the standard deviation of every observation from its residuals, in its unit."""
        found = []
        for residuals, signal in zip(self.split(self.of(predicted)), self.signals, strict=True):
            mean_square = np.sum(residuals**2) / max(1, len(residuals) - parameters)
            # 1.4826 is the ratio of sigma to the median of the magnitudes, of normal errors.
            sigma = 1.4826 * np.median(np.abs(residuals)) if self.robust else np.sqrt(mean_square)
            found.append(max(float(sigma), 1e-9 * signal))
        return found

    def scales(self, unknown: Sequence[float]) -> Scales:
        """Return the standard deviations of all observations; `unknown`: those where they are not given."""
        given = zip(self.observations, unknown, strict=True)
        return tuple(sigma if observed.sigma is None else observed.sigma for observed, sigma in given)

    def _flatten(self, values: Sequence[Array]) -> Array:
        return np.concatenate([each[known] for each, known in zip(values, self._known, strict=True)])


class Search:
    """Nonlinear least squares with restarts.

    Args:
        runs: computes predictions.
        misfit: the residuals; the initial value of an unknown sigma is the observed motion.
        limits: smallest and largest coordinates, each of shape (n,); by default those of the parameters.
    """

    def __init__(self, runs: Runs, misfit: Misfit, limits: tuple[Array, Array] | None = None) -> None:
        self._runs, self._misfit = runs, misfit
        self._delta = difference_step(runs.job.scene)
        self._limits = limits or runs.job.limits
        self._known: dict[bytes, Prediction | None] = {}
        self._neighbours: dict[bytes, Prediction | None] = {}

    def best(self, start: Array) -> Solution:
        """Minimise from a start, and from two alternative starts if the fit is poor."""
        solution = self.refine(start)
        if self.fits_well(solution):
            return solution
        starts = self.alternative_starts()
        self._runs.expected += len(starts)
        predictions = enumerate(self._runs.predict_many(starts))
        costs = [(self._cost(predicted, solution.scales), n) for n, predicted in predictions if predicted is not None]
        for _, n in sorted(costs)[:2]:
            candidate = self.refine(starts[n])
            # Costs are comparable only with the same sigma.
            if self._cost(candidate.predicted, solution.scales) < self._cost(solution.predicted, solution.scales):
                solution = candidate
            if self.fits_well(solution):
                break
        return solution

    def fits_well(self, solution: Solution) -> bool:
        """Return whether the residuals of all observations are small."""
        misfit = self._misfit
        residuals = misfit.split(misfit.of(solution.predicted))
        deviations = misfit.deviations(solution.predicted, len(solution.x))
        each = zip(misfit.observations, residuals, deviations, misfit.signals, strict=True)
        return all(observed.fits_well(part, deviation, signal) for observed, part, deviation, signal in each)

    def jacobian(self, solution: Solution) -> Array:
        """Return the Jacobian of the predictions by x, shape (numbers, parameters)."""
        return self._differences(solution.x, solution.predicted, signs=self._runs.job.signs)

    def remember(self, x: Array, predicted: Prediction) -> None:
        """Store a prediction that is known."""
        self._known[x.tobytes()] = predicted

    def _predict(self, x: Array) -> Prediction | None:
        """Predict at x, with a cache."""
        if x.tobytes() not in self._known:
            self._known[x.tobytes()] = self._runs.predict_one(x)
        return self._known[x.tobytes()]

    def refine(self, start: Array) -> Solution:
        """Minimise from a start, alternating with an unknown sigma."""
        misfit = self._misfit
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
        """Minimise from a start with given standard deviations."""
        from scipy.optimize import least_squares

        def residuals(x: Array) -> Array:
            predicted = self._predict(x)
            # SciPy reduces its step after a NaN.
            if predicted is None:
                return np.full(sum(self._misfit.count), np.nan)
            return self._misfit.residuals(predicted, scales)

        def jacobian(x: Array) -> Array:
            predicted = self._predict(x)
            assert predicted is not None
            return self._misfit.scaled(self._differences(x, predicted, signs=(1,)), scales)

        with np.errstate(all="ignore"):  # SciPy divides by gradients that are 0.
            result = least_squares(
                residuals,
                start,
                jacobian,
                self._limits,
                ftol=1e-6,
                xtol=1e-8,
                gtol=1e-12,
                loss="soft_l1" if self._misfit.robust else "linear",
                f_scale=OUTLIER_SIGMAS,
                max_nfev=40,
            )
        predicted = self._predict(result.x)
        assert predicted is not None
        return Solution(result.x, predicted, scales, float(result.cost), bool(result.status > 0))

    def _differences(self, x: Array, predicted: Prediction, *, signs: tuple[int, ...]) -> Array:
        """Return the Jacobian by differences upward, or downward at a bound; on both sides if `signs` has both."""
        neighbours = []
        for low, value, high, unit in zip(self._limits[0], x, self._limits[1], np.eye(len(x), dtype=bool), strict=True):
            sides = [value + self._delta] if value + self._delta <= high else []
            if not sides or (-1 in signs and low <= value - self._delta):
                sides.append(value - self._delta)
            neighbours.append([np.where(unit, side, x) for side in sides])
        self._runs.expected = max(self._runs.expected, self._runs.count + 3 * len(x))
        # At the end of the search, half of them are known from its last Jacobian.
        each = [neighbour for pair in neighbours for neighbour in pair]
        missing = [neighbour for neighbour in each if neighbour.tobytes() not in self._neighbours]
        computed = zip(missing, self._runs.predict_many(missing, predicted.steps), strict=True)
        known = self._neighbours | {neighbour.tobytes(): prediction for neighbour, prediction in computed}
        self._neighbours = {neighbour.tobytes(): known[neighbour.tobytes()] for neighbour in each}
        columns = []
        for n, parameter in enumerate(self._runs.job.parameters):
            pairs = [(neighbour[n], known[neighbour.tobytes()]) for neighbour in neighbours[n]]
            points = [(side, prediction) for side, prediction in pairs if prediction is not None]
            if not points and len(signs) == 1:
                # A downward step may succeed.
                return self._differences(x, predicted, signs=(1, -1))
            if not points:
                remedy = "give --bounds or another start by --set"
                raise SceneError([f"{parameter.key}: no run close to its value succeeds; {remedy}"])
            (x_first, first), (x_second, second) = [*points, (x[n], predicted)][:2]
            columns.append((self._misfit.row(first) - self._misfit.row(second)) / (x_first - x_second))
        return np.stack(columns, axis=1)

    def _cost(self, predicted: Prediction, scales: Scales) -> float:
        return self._misfit.cost(self._misfit.residuals(predicted, scales))

    def alternative_starts(self) -> list[Array]:
        """Return a Sobol sequence of starts within the bounds, at least 8 per parameter, or 8 for machine tests."""
        from scipy.stats import qmc

        low, high = (np.clip(limit, -MAX_START_LOG, MAX_START_LOG) for limit in self._limits)
        count = 8 * len(low) if len(self._runs.job.signs) > 1 else 8
        shares = qmc.Sobol(len(low), seed=1).random_base2((count - 1).bit_length())
        return list(qmc.scale(shares, low, high))


# Smaller components of unidentified directions are 0.
MIN_COMPONENT = 1e-3

# Largest standard deviation of an identified direction.
MAX_DIRECTION_DEVIATION = 0.5


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of n parameters, in units of x."""

    scales: Scales  # standard deviations of the observations, given or estimated
    factor: float  # f
    freedom: int  # degrees of freedom
    independent: float  # effective number of independent observations
    residuals: Array  # r
    weighted: Array  # W^(1/2) J, shape (numbers, n)
    directions: Array  # V, with uncorrelated combinations of x as columns, the most certain one first, shape (n, n)
    root: Array  # F with C = F F^T, shape (n, n)
    widening: Array  # factor of the deviations by K, shape (n,)

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
        """Mask of the parameters with a component in an unidentified direction, without a valid `shift`, shape (n,)."""
        directions = self.directions[:, self.direction_deviations > MAX_DIRECTION_DEVIATION]
        return np.linalg.norm(directions, axis=1) > MIN_COMPONENT * 50

    def shift(self, rows: Array) -> Array:
        """Return the shift of x due to an error of the predictions, in units of r, shape (numbers,)."""
        identified = self.directions[:, self.direction_deviations <= MAX_DIRECTION_DEVIATION]
        return identified @ np.linalg.lstsq(self.weighted @ identified, rows, rcond=None)[0]


def uncertainty(
    misfit: Misfit, solution: Solution, derivatives: Array, error_correlation: ErrorCorrelation
) -> Uncertainty:
    """Compute the uncertainty of a solution.

    Args:
        misfit: the residuals.
        solution: their minimum.
        derivatives: Jacobian of the predictions by x, shape (numbers, parameters).
        error_correlation: correlation lengths of the errors.
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


# Relative tolerance of the end of an interval.
PROFILE_TOLERANCE = 0.01

Side = Generator[Array, "Prediction | None", "list[ProfilePoint]"]


class ProfilePoint(NamedTuple):
    """Point of a profile."""

    x: float  # of the parameter
    deviations: float  # signed root of twice the rise of the cost over f; infinite where runs fail


class Profile(NamedTuple):
    """Profile of a parameter."""

    points: list[ProfilePoint]  # sorted by x
    low: float | None  # end of the interval; None: beyond the bounds
    high: float | None


class Profiler:
    """Profile likelihood of a solution's parameters."""

    def __init__(self, runs: Runs, misfit: Misfit, solution: Solution, uncertainties: Uncertainty) -> None:
        self._runs, self._misfit, self._solution, self._uncertainties = runs, misfit, solution, uncertainties
        self._min_cost = misfit.cost(uncertainties.residuals)
        self._low, self._high = runs.job.limits

    def profiles(self) -> list[Profile]:
        """Compute the profiles of all parameters, with both sides of each in parallel."""
        count, runs = len(self._low), self._runs
        sides = {(n, sign): self._side(n, sign) for n in range(count) for sign in (-1, 1)}
        points: dict[tuple[int, int], list[ProfilePoint]] = {side_key: [] for side_key in sides}
        requests = {side_key: x for side_key, side in sides.items() if (x := next(side, None)) is not None}
        while requests:
            runs.expected = max(runs.expected, runs.count + 2 * len(requests))
            predictions = runs.predict_many(list(requests.values()))
            for side_key, prediction in zip(list(requests), predictions, strict=True):
                try:
                    requests[side_key] = sides[side_key].send(prediction)
                except StopIteration as stop:
                    del requests[side_key]
                    points[side_key] = stop.value
        return [self._profile(n, points[n, -1], points[n, 1]) for n in range(count)]

    def _profile(self, n: int, below: list[ProfilePoint], above: list[ProfilePoint]) -> Profile:
        quantile = self._uncertainties.quantile
        ends = [
            side[-1].x if side and abs(abs(side[-1].deviations) / quantile - 1) < 5 * PROFILE_TOLERANCE else None
            for side in (below, above)
        ]
        points = [*below, ProfilePoint(float(self._solution.x[n]), 0.0), *above]
        return Profile(sorted(point for point in points if math.isfinite(point.deviations)), ends[0], ends[1])

    def _side(self, n: int, sign: int) -> Side:
        """Search for the end of the interval on one side; yields x to be predicted, and returns the points."""
        x, root, quantile = self._solution.x, self._uncertainties.root, self._uncertainties.quantile
        variance = float(root[n] @ root[n])
        direction = root @ root[n] / variance
        limit = float((self._high if sign > 0 else self._low)[n] - x[n]) * sign
        points: list[ProfilePoint] = []
        # Bracket of the end: distances, and the rises there, which are nearly proportional.
        inner, outer = (0.0, 0.0), (math.inf, math.inf)
        distance = min(quantile * math.sqrt(variance), limit)
        while distance > 0 and len(points) < 8:
            trial = np.clip(x + sign * distance * direction, self._low, self._high)
            trial[n] = x[n] + sign * distance
            cost = yield from self._conditional_minimum(n, trial)
            rise = math.sqrt(max(0.0, 2 * (cost - self._min_cost) / self._uncertainties.factor))
            rise /= self._uncertainties.widening[n]
            points.append(ProfilePoint(float(trial[n]), sign * rise))
            if abs(rise / quantile - 1) < PROFILE_TOLERANCE or (distance == limit and rise < quantile):
                break
            inner, outer = ((distance, rise), outer) if rise < quantile else (inner, (distance, rise))
            if outer[1] < math.inf:
                distance = inner[0] + (outer[0] - inner[0]) * (quantile - inner[1]) / (outer[1] - inner[1])
            elif outer[0] < math.inf:  # The run there has failed.
                distance = (inner[0] + outer[0]) / 2
            else:
                distance = min(distance * min(3.0, quantile / max(rise, 1e-3)), limit)
        return points

    def _conditional_minimum(self, n: int, x: Array) -> Generator[Array, Prediction | None, float]:
        """Minimise over the other parameters; returns the cost, infinite if a run fails."""
        from scipy.optimize import lsq_linear

        others = np.delete(np.arange(len(x)), n)
        jacobian, deviations = self._uncertainties.weighted[:, others], self._uncertainties.deviations[others]
        min_cost = math.inf
        for _ in range(6):
            predicted = yield x
            if predicted is None:
                break
            residuals = self._misfit.residuals(predicted, self._uncertainties.scales)
            cost = self._misfit.cost(residuals)
            if cost > min_cost:
                break
            min_cost = cost
            # Gauss-Newton step: first derivatives of rho / 2 over the roots of the second ones.
            bounds = (self._low - x)[others], (self._high - x)[others]
            step = lsq_linear(jacobian, -residuals * self._misfit.robust_factor(residuals) ** 0.25, bounds).x
            if np.all(np.abs(step) < 0.02 * deviations):
                break
            x = x.copy()
            x[others] += step
        return min_cost


# Largest standard error of an identifiable parameter, as a share of its value or of a coordinate's range.
MAX_RELATIVE_ERROR = 1.0

# Smallest component of the parameters of a direction.
MIN_GROUP_COMPONENT = 0.05


class Combination(NamedTuple):
    """Identifiable product of powers of parameters."""

    exponents: dict[str, float]
    standard_error: float  # relative

    def __str__(self) -> str:
        text = ""
        for key, exponent in sorted(self.exponents.items(), key=lambda item: item[1] < 0):
            power = "" if abs(exponent) == 1 else f"^{abs(exponent):.3g}"
            sign = (" / " if exponent < 0 else " x ") if text else ("1 / " if exponent < 0 else "")
            text += f"{sign}{key}{power}"
        return text


class UnidentifiedGroup(NamedTuple):
    """Parameters that are not identifiable one by one."""

    parameters: list[str]
    known: list[Combination]  # identifiable combinations
    text: str

    def as_json(self) -> dict[str, Any]:
        """Return JSON data."""
        known = [{"combination": str(combination), **combination._asdict()} for combination in self.known]
        return {"parameters": self.parameters, "known": known, "text": self.text}


def unseen(
    parameters: Sequence[Parameter], x: Array, uncertainties: Uncertainty, *, forces: bool
) -> list[UnidentifiedGroup]:
    """Return the groups of unidentifiable parameters; `forces`: whether forces were measured."""
    from scipy.sparse.csgraph import connected_components

    directions = uncertainties.directions[:, uncertainties.direction_deviations > MAX_DIRECTION_DEVIATION]
    members = np.flatnonzero(np.linalg.norm(directions, axis=1) > MIN_GROUP_COMPONENT)
    # Parameters that share directions; the projection does not depend on the choice of their basis.
    is_coupled = np.abs(directions @ directions.T) > MIN_GROUP_COMPONENT**2
    count, labels = connected_components(is_coupled[np.ix_(members, members)], directed=False)
    groups = [members[labels == label] for label in range(count)]
    pairs = zip(parameters, x.tolist(), uncertainties.deviations.tolist(), strict=True)
    errors = np.array([parameter.share(coordinate, deviation) for parameter, coordinate, deviation in pairs])
    return [
        _describe_group(
            [parameters[n] for n in group],
            float(errors[group].max()),
            list(_known_combinations(parameters, uncertainties, group, directions[group])),
            "" if forces else ", or give a force (--forces)",
        )
        for group in groups
    ]


def _known_combinations(
    parameters: Sequence[Parameter], uncertainties: Uncertainty, group: Array, directions: Array
) -> Iterator[Combination]:
    """Yield the identifiable combinations of a group of parameters, with their components in `directions`."""
    for exponents in _complement(directions):
        # Exponents close to a multiple of 1/2 are rounded.
        half = np.round(2 * exponents) / 2
        all_exponents = np.zeros(len(parameters))
        all_exponents[group] = np.where(np.abs(exponents - half) < 0.06, half, exponents)
        powers = {parameters[n].key: float(all_exponents[n]) for n in group if all_exponents[n]}
        error = float(np.linalg.norm(all_exponents @ uncertainties.root))
        if error <= MAX_RELATIVE_ERROR:
            yield Combination(powers, error)


def _describe_group(
    group: Sequence[Parameter], largest: float, known: list[Combination], remedy: str
) -> UnidentifiedGroup:
    """Describe a group of parameters by their largest relative error, and by the combinations that are known."""
    keys = [parameter.key for parameter in group]
    names = " and ".join([", ".join(keys[:-1]), keys[-1]] if len(keys) > 1 else keys)
    fix = f"fix {'it' if len(keys) == 1 else 'them'}"
    share = f"only to {rounded(100 * largest)} %" if largest <= MAX_RELATIVE_ERROR else ""
    if known and not all(parameter.is_log for parameter in group):
        return UnidentifiedGroup(keys, [], f"{names} are not identifiable one by one: fix one{remedy}")
    if not known:
        found = f"known {share}" if share else "not identifiable"
        return UnidentifiedGroup(keys, [], f"{names}: {found}: {fix}")
    combinations = ", ".join(f"{each} is known to {rounded(100 * each.standard_error)} %" for each in known)
    return UnidentifiedGroup(keys, known, f"{combinations}, each alone {share or 'is not'}: fix one{remedy}")


def _complement(directions: Array) -> Iterator[Array]:
    """Yield a basis of the orthogonal complement of directions, shape (m, directions), in reduced echelon form."""
    vectors, singular, _ = np.linalg.svd(directions)
    rank = int(np.sum(singular > MIN_GROUP_COMPONENT * singular[0]))
    rows = vectors[:, rank:].T.copy()
    # Pivots are the best identified parameters.
    order = list(np.argsort(np.linalg.norm(directions, axis=1), kind="stable"))
    for n in range(len(rows)):
        pivot = max(order, key=lambda column: (abs(rows[n, column]) > 0.1, -order.index(column)))
        order.remove(pivot)
        rows[n] /= rows[n, pivot]
        for row in range(len(rows)):
            if row != n:
                rows[row] -= rows[row, pivot] * rows[n]
    yield from rows
