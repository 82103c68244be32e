"""Parameter estimation by nonlinear least squares, with confidence intervals and identifiability.

The sum of rho(r^2) over all residuals r = (predicted - observed) / sigma is minimised within bounds by SciPy's trust
region method, with rho(z) = z, or soft_l1 in robust fits. The Jacobian is made of differences of runs: forward
differences during the search, central ones at the solution. With forces, and in robust fits, an unknown sigma is
estimated alternately with the parameters.

Covariance. With J the Jacobian of r by x, the covariance of x is

    C = f (J^T W J)^-1 M (J^T W J)^-1,    M = J^T W^(1/2) K W^(1/2) J

with W = 1 and K = 1, and f the mean of r^2 per degree of freedom, at least 1. In a robust fit W is the second
derivative of rho / 2, and f the mean square of its first derivative over the mean of W. With correlated errors of
tracks K = exp(-distance / correlation) for two tracks in a frame, with drifting tracks K = exp(-interval / drift) for
one track at two times; with both, K is their product. With the singular values W^(1/2) J = U S V^T,

    C = f V S^-1 (U^T K U) S^-1 V^T

which squares nothing, so that poorly observed directions keep their digits.

Profile intervals. A parameter is held, and the others are optimised within their bounds. The interval ends where the
cost has risen by t^2 f / 2, with Student's t, times the widening by correlated errors. With J from the solution, the
others need one run per step.

Identifiability. Parameters can be identifiable in combinations only: images determine the ratio of a stiffness and a
force, and neither of them. The singular vectors with large standard deviations span the unidentifiable directions; the
combinations orthogonal to them are reported.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.fitting.observations import Observations
from taichi_msm.fitting.parameters import Parameter, rounded
from taichi_msm.fitting.predict import Prediction, Runs, difference_step

Array = NDArray[np.float64]

# Relative changes of the cost and of the parameters at which the search ends.
COST_TOLERANCE, STEP_TOLERANCE = 1e-6, 1e-8
GRADIENT_TOLERANCE = 1e-12

# Limits of one search, and of the alternation between sigma and the parameters.
MAX_EVALUATIONS, MAX_SIGMA_ROUNDS = 40, 6

# Relative change of sigma at which the alternation ends, and the smallest sigma as a share of the motion.
SIGMA_TOLERANCE, MIN_SIGMA_SHARE = 0.02, 1e-9

# Residuals above this many sigma are weighted down in robust fits.
OUTLIER_SIGMAS = 2.0

# Sigma of normal errors over the median of their magnitudes.
SIGMA_PER_MEDIAN = 1.4826

# Larger residuals, as a share of the motion or in sigma, are a poor fit, which starts again elsewhere.
MAX_RESIDUAL_SHARE, MAX_RESIDUAL_SIGMAS = 0.1, 2.0

# Alternative starts: number per parameter, largest log of their factor, and number of those that are minimised.
STARTS_PER_PARAMETER, MAX_START_LOG, STARTS_FOLLOWED = 8, np.log(10.0), 2


class Scales(NamedTuple):
    """Standard deviations of the residuals."""

    values: float  # [m] or [px]
    forces: float  # [N]


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of the least-squares problem."""

    x: Array  # parameters, shape (n,)
    predicted: Prediction
    scales: Scales
    cost: float  # half the sum of rho
    converged: bool


class Misfit:
    """Residuals of predictions, flattened to one axis: values first, forces last.

    Args:
        observations: the observations.
        motion: root mean square of the observed motion [m] or [px].
        robust: whether outliers are weighted down.

    Attributes:
        count: numbers of values and of force components.
    """

    def __init__(self, observations: Observations, motion: float, *, robust: bool) -> None:
        self.observations, self.motion, self.robust = observations, motion, robust
        self._known = observations.known
        self._values = observations.values[self._known]
        forces = np.empty((0, 3)) if observations.forces is None else observations.forces.force
        self._known_forces = np.isfinite(forces)
        self._forces = forces[self._known_forces]
        self.count = self._values.size, self._forces.size

    def row(self, predicted: Prediction) -> Array:
        """Return the predictions of all observed numbers, shape (numbers,)."""
        return np.concatenate([predicted.values[self._known], predicted.forces[self._known_forces]])

    def of(self, predicted: Prediction) -> Array:
        """Return predicted minus observed [m] or [px], and [N], shape (numbers,)."""
        return self.row(predicted) - np.concatenate([self._values, self._forces])

    def scaled(self, rows: Array, scales: Scales) -> Array:
        """Divide rows, shape (numbers, ...), by the standard deviations `scales`."""
        by = np.repeat(scales, self.count)
        return rows / by.reshape(-1, *(1,) * (rows.ndim - 1))

    def residuals(self, predicted: Prediction, scales: Scales) -> Array:
        """Return the residuals r, shape (numbers,)."""
        return self.scaled(self.of(predicted), scales)

    def robust_factor(self, residuals: Array) -> Array:
        """Return d, with the derivatives r / d^(1/2) and d^(-3/2) of rho / 2."""
        return 1 + (residuals / OUTLIER_SIGMAS) ** 2 if self.robust else np.ones_like(residuals)

    def cost(self, residuals: Array) -> float:
        """Return half the sum of rho, as SciPy."""
        rho = 2 * OUTLIER_SIGMAS**2 * (np.sqrt(self.robust_factor(residuals)) - 1) if self.robust else residuals**2
        return float(np.sum(rho)) / 2

    def sigma(self, predicted: Prediction, parameters: int) -> float:
        """Estimate the standard deviation of the values' errors [m] or [px] from their residuals."""
        left = self.of(predicted)[: self.count[0]]
        mean_square = np.sum(left**2) / max(1, len(left) - parameters)
        found = SIGMA_PER_MEDIAN * np.median(np.abs(left)) if self.robust else np.sqrt(mean_square)
        return max(float(found), MIN_SIGMA_SHARE * self.motion)


class Search:
    """Nonlinear least squares with restarts.

    Args:
        runs: predictions.
        misfit: residuals; an unknown sigma starts as the observed motion.
    """

    def __init__(self, runs: Runs, misfit: Misfit) -> None:
        self._runs, self._misfit = runs, misfit
        self._delta = difference_step(runs.job.scene)
        limits = np.array([one.limits for one in runs.job.parameters])
        self._limits = limits[:, 0], limits[:, 1]
        self._known: dict[bytes, Prediction | None] = {}
        self._beside: dict[bytes, Prediction | None] = {}

    def best(self, start: Array) -> Solution:
        """Minimise from a start, and from alternative ones if the fit is poor."""
        solution = self._solve(start)
        if self.fits_well(solution):
            return solution
        others = self._alternative_starts()
        self._runs.expected += len(others)
        tried = [
            (self._cost(predicted, solution.scales), n)
            for n, predicted in enumerate(self._runs.predict_many(others))
            if predicted is not None
        ]
        for _, n in sorted(tried)[:STARTS_FOLLOWED]:
            other = self._solve(others[n])
            # Costs compare only for one sigma.
            if self._cost(other.predicted, solution.scales) < self._cost(solution.predicted, solution.scales):
                solution = other
            if self.fits_well(solution):
                break
        return solution

    def fits_well(self, solution: Solution) -> bool:
        """Return whether the residuals are small."""
        observations = self._misfit.observations
        if observations.forces is not None:
            left, most = (
                solution.predicted.forces - observations.forces.force,
                MAX_RESIDUAL_SHARE**2 * np.nanmean(observations.forces.force**2),
            )
            if np.nanmean(left**2) > max(most, (MAX_RESIDUAL_SIGMAS * observations.forces.sigma) ** 2):
                return False
        of_values = self._misfit.sigma(solution.predicted, len(solution.x))
        return of_values <= (
            MAX_RESIDUAL_SHARE * self._misfit.motion
            if observations.sigma is None
            else MAX_RESIDUAL_SIGMAS * observations.sigma
        )

    def jacobian(self, solution: Solution) -> Array:
        """Return the Jacobian of the predictions by x, by central differences, shape (numbers, parameters)."""
        return self._differences(solution.x, solution.predicted, signs=(1, -1))

    def _predict(self, x: Array) -> Prediction | None:
        """Predict, with a cache."""
        key = x.tobytes()
        if key not in self._known:
            self._known[key] = self._runs.one(x)
        return self._known[key]

    def _solve(self, start: Array) -> Solution:
        """Minimise from a start, alternating with an unknown sigma."""
        observations, robust = self._misfit.observations, self._misfit.robust
        scales = Scales(
            observations.sigma or self._misfit.motion, observations.forces.sigma if observations.forces else 1.0
        )
        if robust and observations.sigma is None and (predicted := self._predict(start)) is not None:
            scales = scales._replace(values=self._misfit.sigma(predicted, len(start)))
        solution = self._from(start, scales)
        for _ in range(
            MAX_SIGMA_ROUNDS if observations.sigma is None and (observations.forces is not None or robust) else 0
        ):
            sigma = self._misfit.sigma(solution.predicted, len(start))
            if abs(sigma / solution.scales.values - 1) < SIGMA_TOLERANCE:
                break
            solution = self._from(solution.x, scales._replace(values=sigma))
        return solution

    def _from(self, start: Array, scales: Scales) -> Solution:
        """Minimise from a start with given standard deviations."""
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
            return self._misfit.scaled(self._differences(x, predicted, signs=(1,)), scales)

        with np.errstate(all="ignore"):  # SciPy divides by slopes that are 0.
            found = least_squares(
                residuals,
                start,
                jacobian,
                self._limits,
                ftol=COST_TOLERANCE,
                xtol=STEP_TOLERANCE,
                gtol=GRADIENT_TOLERANCE,
                loss="soft_l1" if self._misfit.robust else "linear",
                f_scale=OUTLIER_SIGMAS,
                max_nfev=MAX_EVALUATIONS,
            )
        predicted = self._predict(found.x)
        assert predicted is not None
        return Solution(found.x, predicted, scales, float(found.cost), bool(found.status > 0))

    def _differences(self, x: Array, predicted: Prediction, *, signs: tuple[int, ...]) -> Array:
        places = [
            [self._shifted(x, n, sign) for sign in signs if sign == 1 or self._has_both_sides(x, n)]
            for n in range(len(x))
        ]
        self._runs.expected = max(self._runs.expected, self._runs.count + 3 * len(x))
        # Where the search ends, half of them were predicted by its last derivatives.
        new = [place for several in places for place in several if place.tobytes() not in self._beside]
        after = zip(new, self._runs.predict_many(new, predicted.steps), strict=True)
        self._beside = {**self._beside, **{place.tobytes(): one for place, one in after}}
        self._beside = {place.tobytes(): self._beside[place.tobytes()] for several in places for place in several}
        columns = []
        for n, parameter in enumerate(self._runs.job.parameters):
            known = [(place[n], one) for place in places[n] if (one := self._beside[place.tobytes()]) is not None]
            if not known and len(signs) == 1:
                # Perhaps downward.
                return self._differences(x, predicted, signs=(1, -1))
            if not known:
                remedy = "give --bounds or another start by --set"
                raise SceneError([f"{parameter.key}: no run close to its value succeeds; {remedy}"])
            (one, first), (other, second) = [*known, (x[n], predicted)][:2]
            columns.append((self._misfit.row(first) - self._misfit.row(second)) / (one - other))
        return np.stack(columns, axis=1)

    def _has_both_sides(self, x: Array, n: int) -> bool:
        """Return whether both differences of parameter n are within its bounds."""
        return bool(self._limits[0][n] <= x[n] - self._delta and x[n] + self._delta <= self._limits[1][n])

    def _shifted(self, x: Array, n: int, sign: int) -> Array:
        """Return x with parameter n stepped, upward if that is within the bounds and `sign` is 1."""
        place = x.copy()
        place[n] += self._delta if sign == 1 and x[n] + self._delta <= self._limits[1][n] else -self._delta
        return place

    def _cost(self, predicted: Prediction, scales: Scales) -> float:
        return self._misfit.cost(self._misfit.residuals(predicted, scales))

    def _alternative_starts(self) -> list[Array]:
        """Return a Sobol sequence of starts within the bounds, and within a factor of 10 of the first."""
        from scipy.stats import qmc

        low, high = (np.clip(limit, -MAX_START_LOG, MAX_START_LOG) for limit in self._limits)
        shares = qmc.Sobol(len(low), seed=1).random_base2((STARTS_PER_PARAMETER * len(low) - 1).bit_length())
        return list(qmc.scale(shares, low, high))


# Singular values below this share of the largest are differences of rounding: their direction is unidentified, has this
# standard deviation, and components below MIN_COMPONENT are 0.
MIN_SINGULAR_SHARE, MIN_COMPONENT, UNIDENTIFIED_DEVIATION = 1e-8, 1e-3, 1e4

# Largest standard deviation of an identified direction.
MAX_DIRECTION_DEVIATION = 0.5

# Level of the confidence intervals.
CONFIDENCE = 0.95


class ErrorCorrelation(NamedTuple):
    """Correlation lengths of the errors of tracks; None: independent."""

    correlation: float | None  # of two tracks [px]
    drift: float | None  # of two times [s]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of n parameters, in units of x.

    The columns of `directions` are uncorrelated combinations of x, the most certain one first.
    """

    scales: Scales  # standard deviations of the observations, given or estimated
    factor: float  # f
    freedom: int  # degrees of freedom
    independent: float  # effective number of independent observations
    left: Array  # r
    weighted: Array  # W^(1/2) J, shape (numbers, n)
    directions: Array  # shape (n, n)
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
        """Half width of the confidence interval in standard deviations, by Student's t."""
        from scipy.stats import t

        return float(t.ppf((1 + CONFIDENCE) / 2, self.freedom))

    def combination_deviation(self, exponents: Array) -> float:
        """Return the standard deviation of a combination of x, shape (n,)."""
        return float(np.linalg.norm(exponents @ self.root))

    @property
    def unidentified(self) -> NDArray[np.bool_]:
        """Mask of the x with a part in an unidentified direction, for which `shift` is not valid, shape (n,)."""
        return (
            np.linalg.norm(self.directions[:, self.direction_deviations > MAX_DIRECTION_DEVIATION], axis=1)
            > MIN_COMPONENT * 50
        )

    def shift(self, rows: Array) -> Array:
        """Return the shift of x by an error of the predictions, in units of r, shape (numbers,)."""
        observations = self.directions[:, self.direction_deviations <= MAX_DIRECTION_DEVIATION]
        return observations @ np.linalg.lstsq(self.weighted @ observations, rows, rcond=None)[0]


def uncertainty(
    misfit: Misfit, solution: Solution, derivatives: Array, error_correlation: ErrorCorrelation
) -> Uncertainty:
    """Compute the uncertainty of a solution.

    Args:
        misfit: the residuals.
        solution: their minimum.
        derivatives: Jacobian of the predictions by x, shape (numbers, parameters).
        error_correlation: correlation lengths of the observation errors.
    """
    parameters = len(solution.x)
    freedom = max(1, sum(misfit.count) - parameters)
    scales = solution.scales
    if misfit.observations.sigma is None:
        scales = scales._replace(values=misfit.sigma(solution.predicted, parameters))
    left, slope = misfit.residuals(solution.predicted, scales), misfit.scaled(derivatives, scales)
    far = misfit.robust_factor(left)
    weighted = slope * far[:, None] ** (-0.75)
    factor = max(1.0, float(np.sum(left**2 / far)) / freedom / float(np.mean(far**-1.5)))
    singular = np.linalg.svd(weighted, full_matrices=False)
    blind = MIN_SINGULAR_SHARE * max(1.0, singular.S[0]) >= singular.S
    held = np.where(blind, 1 / UNIDENTIFIED_DEVIATION, singular.S)
    parts = np.where(blind & (np.abs(singular.Vh.T) < MIN_COMPONENT), 0.0, singular.Vh.T)
    plain = root = np.sqrt(factor) * parts / held
    independent = float(freedom)
    if error_correlation != (None, None):
        around, independent = _correlated(misfit, singular.U, error_correlation)
        independent = min(independent, freedom)
        values, vectors = np.linalg.eigh(around)
        root = plain @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    widening = np.linalg.norm(root, axis=1) / np.linalg.norm(plain, axis=1)
    return Uncertainty(scales, factor, freedom, independent, left, weighted, singular.Vh.T, root, widening)


def _correlated(misfit: Misfit, rows: Array, error_correlation: ErrorCorrelation) -> tuple[Array, float]:
    """Compute U^T K U, and the effective number of observations tr(K)^2 / tr(K^2); forces are independent."""
    values, observations = misfit.count[0], misfit.observations
    # A track is at its mean observed position; tracks without observations are left out.
    ever: NDArray[np.bool_] = np.any(observations.there, axis=1)
    space, time = _correlations(observations, ever, error_correlation)
    whole = np.zeros((*observations.values.shape, rows.shape[1]))
    whole[observations.known] = rows[:values]
    whole = whole[ever]
    correlated = np.einsum("st,ntcp->nscp", time, np.tensordot(space, whole, 1))
    every = len(rows) - values
    there = observations.there[ever].astype(float)
    square = every + observations.values.shape[2] * float(np.sum(space**2 * (there @ time**2 @ there.T)))
    total = np.tensordot(whole, correlated, ((0, 1, 2), (0, 1, 2))) + rows[values:].T @ rows[values:]
    return total, len(rows) ** 2 / square


def _correlations(
    observations: Observations, ever: NDArray[np.bool_], error_correlation: ErrorCorrelation
) -> tuple[Array, Array]:
    """Correlate the errors of tracks, shape (tracks, tracks), and those of times, shape (T, T)."""
    from scipy.spatial.distance import cdist

    space, time = np.eye(int(ever.sum())), np.eye(len(observations.time))
    if error_correlation.correlation is not None:
        pixels = np.nanmean(observations.values[ever], axis=1)
        space = np.exp(-cdist(pixels, pixels) / error_correlation.correlation)
    if error_correlation.drift is not None:
        time = np.exp(-np.abs(observations.time[:, None] - observations.time) / error_correlation.drift)
    return space, time


# Limits of a profile: points per side, and steps of the other parameters at each.
MAX_PROFILE_POINTS, MAX_PROFILE_STEPS = 8, 6

# Relative tolerance of an end, and the tolerance of the other parameters in standard deviations.
PROFILE_TOLERANCE, PROFILE_STEP_TOLERANCE = 0.01, 0.02

Side = Generator[Array, "Prediction | None", "list[ProfilePoint]"]


class ProfilePoint(NamedTuple):
    """Point of a profile."""

    x: float  # of the parameter
    deviations: float  # the root of twice the rise of the cost over f, and its sign; infinite: no run there


class Profile(NamedTuple):
    """Profile of a parameter."""

    places: list[ProfilePoint]  # sorted by x
    low: float | None  # ends of the interval; None: beyond the bounds
    high: float | None


class Profiler:
    """Profile likelihood of a solution's parameters."""

    def __init__(
        self, parameters: Sequence[Parameter], misfit: Misfit, solution: Solution, uncertainties: Uncertainty
    ) -> None:
        self._misfit, self._solution, self._uncertain = misfit, solution, uncertainties
        self._least = misfit.cost(uncertainties.left)
        self._low, self._high = np.array([one.limits for one in parameters]).T

    def profiles(self, runs: Runs) -> list[Profile]:
        """Compute the profiles of all parameters, both sides in parallel."""
        number = len(self._low)
        sides = {(n, sign): self._side(n, sign) for n in range(number) for sign in (-1, 1)}
        places: dict[tuple[int, int], list[ProfilePoint]] = {which: [] for which in sides}
        asked: dict[tuple[int, int], Array | None] = {which: next(side, None) for which, side in sides.items()}
        while waiting := [(which, place) for which, place in asked.items() if place is not None]:
            runs.expected = max(runs.expected, runs.count + 2 * len(waiting))
            predicted = runs.predict_many([place for _, place in waiting])
            for (which, _), one in zip(waiting, predicted, strict=True):
                try:
                    asked[which] = sides[which].send(one)
                except StopIteration as stop:
                    asked[which], places[which] = None, stop.value
        return [self._profile(n, places[n, -1], places[n, 1]) for n in range(number)]

    def _profile(self, n: int, below: list[ProfilePoint], above: list[ProfilePoint]) -> Profile:
        quantile = self._uncertain.quantile
        ends = [
            side[-1].x if side and abs(abs(side[-1].deviations) / quantile - 1) < 5 * PROFILE_TOLERANCE else None
            for side in (below, above)
        ]
        places = [*below, ProfilePoint(float(self._solution.x[n]), 0.0), *above]
        return Profile(sorted(place for place in places if math.isfinite(place.deviations)), ends[0], ends[1])

    def _side(self, n: int, sign: int) -> Side:
        """Search for the end of the interval on a side, or the bound."""
        x, root, quantile = self._solution.x, self._uncertain.root, self._uncertain.quantile
        variance = float(root[n] @ root[n])
        valley = root @ root[n] / variance
        most = float((self._high if sign > 0 else self._low)[n] - x[n]) * sign
        places: list[ProfilePoint] = []
        # The end lies between distances, with the rise at each, which is nearly proportional to the distance.
        near, far = (0.0, 0.0), (math.inf, math.inf)
        away = min(quantile * math.sqrt(variance), most)
        while away > 0 and len(places) < MAX_PROFILE_POINTS:
            place = np.clip(x + sign * away * valley, self._low, self._high)
            place[n] = x[n] + sign * away
            least = yield from self._least_at(n, place)
            rise = math.sqrt(max(0.0, 2 * (least - self._least) / self._uncertain.factor)) / self._uncertain.widening[n]
            places.append(ProfilePoint(float(place[n]), sign * rise))
            if abs(rise / quantile - 1) < PROFILE_TOLERANCE or (away == most and rise < quantile):
                break
            near, far = ((away, rise), far) if rise < quantile else (near, (away, rise))
            if far[1] < math.inf:
                away = near[0] + (far[0] - near[0]) * (quantile - near[1]) / (far[1] - near[1])
            elif far[0] < math.inf:  # Where there is no run.
                away = (near[0] + far[0]) / 2
            else:
                away = min(away * min(3.0, quantile / max(rise, 1e-3)), most)
        return places

    def _least_at(self, n: int, place: Array) -> Generator[Array, Prediction | None, float]:
        """Minimise over the other parameters; returns the cost, infinite if the runs fail."""
        from scipy.optimize import lsq_linear

        others = np.delete(np.arange(len(place)), n)
        slope, deviations = self._uncertain.weighted[:, others], self._uncertain.deviations[others]
        least = math.inf
        for _ in range(MAX_PROFILE_STEPS):
            predicted = yield place
            if predicted is None:
                break
            left = self._misfit.residuals(predicted, self._uncertain.scales)
            cost = self._misfit.cost(left)
            if cost > least:
                break
            least = cost
            # The first derivatives over the roots of the second.
            bounds = (self._low - place)[others], (self._high - place)[others]
            step = lsq_linear(slope, -left * self._misfit.robust_factor(left) ** 0.25, bounds).x
            if np.all(np.abs(step) < PROFILE_STEP_TOLERANCE * deviations):
                break
            place = place.copy()
            place[others] += step
        return least


# Largest standard error of an identifiable parameter, as a share of its value, or of a coordinate's range.
MAX_RELATIVE_ERROR = 1.0

# Smallest component of a parameter that belongs to a direction.
MIN_GROUP_COMPONENT = 0.05

# Exponents this close to a multiple of 1/2 are rounded.
EXPONENT_TOLERANCE = 0.06


class Combination(NamedTuple):
    """Identifiable product of powers of parameters."""

    exponents: dict[str, float]
    standard_error: float  # as a share

    def __str__(self) -> str:
        text = ""
        for key, exponent in sorted(self.exponents.items(), key=lambda item: item[1] < 0):
            power = "" if abs(exponent) == 1 else f"^{abs(exponent):.3g}"
            sign = (" / " if exponent < 0 else " x ") if text else ("1 / " if exponent < 0 else "")
            text += f"{sign}{key}{power}"
        return text


class UnidentifiedGroup(NamedTuple):
    """Parameters that the data do not determine one by one."""

    parameters: list[str]
    known: list[Combination]  # identifiable combinations
    text: str

    def as_json(self) -> dict[str, Any]:
        """Return JSON data."""
        known = [{"combination": str(one), **one._asdict()} for one in self.known]
        return {"parameters": self.parameters, "known": known, "text": self.text}


def unseen(
    parameters: Sequence[Parameter], x: Array, uncertainties: Uncertainty, *, forces: bool
) -> list[UnidentifiedGroup]:
    """Return the groups of parameters that are not identifiable; `forces`: whether any were measured."""
    blind = uncertainties.directions[:, uncertainties.direction_deviations > MAX_DIRECTION_DEVIATION]
    pairs = zip(parameters, x.tolist(), uncertainties.deviations.tolist(), strict=True)
    alone = np.array([one.share(place, deviation) for one, place, deviation in pairs])
    return [
        _in_words(parameters, uncertainties, alone, part, blind[part], forces=forces)
        for part in _unidentified_groups(blind)
    ]


def _unidentified_groups(blind: Array) -> Iterator[Array]:
    """Yield the indices of parameters that share unidentified directions."""
    # The projection onto the directions does not depend on which of them were chosen.
    together = np.abs(blind @ blind.T) > MIN_GROUP_COMPONENT**2
    left = set(np.flatnonzero(np.linalg.norm(blind, axis=1) > MIN_GROUP_COMPONENT).tolist())
    while left:
        group, new = set[int](), {min(left)}
        while new:
            group |= new
            new = {m for n in new for m in left if together[n, m]} - group
        left -= group
        yield np.array(sorted(group))


def _in_words(
    parameters: Sequence[Parameter],
    uncertainties: Uncertainty,
    alone: Array,
    group: Array,
    blind: Array,
    *,
    forces: bool,
) -> UnidentifiedGroup:
    """Describe a group of parameters, and its identifiable combinations.

    Args:
        parameters: of the fit.
        uncertainties: of the fit.
        alone: standard error of each parameter as a share.
        group: indices of the group.
        blind: components of the group in the unidentified directions, shape (m, directions).
        forces: whether forces were measured.
    """
    keys = [parameters[n].key for n in group]
    known = []
    for exponents in _complement(blind):
        whole = np.zeros(len(parameters))
        nice = np.round(2 * exponents) / 2
        exponents = np.where(np.abs(exponents - nice) < EXPONENT_TOLERANCE, nice, exponents)
        whole[group] = exponents
        parts = {key: float(power) for key, power in zip(keys, exponents, strict=True) if power}
        known.append(Combination(parts, uncertainties.combination_deviation(whole)))
    remedy = "" if forces else ", or give a force (--forces)"
    names = " and ".join([", ".join(keys[:-1]), keys[-1]] if len(keys) > 1 else keys)
    known = [one for one in known if one.standard_error <= MAX_RELATIVE_ERROR]
    if known and not all(parameters[n].is_log for n in group):
        return UnidentifiedGroup(keys, [], f"{names} are not identifiable one by one: fix one{remedy}")
    if not known:
        it = "it" if len(keys) == 1 else "them"
        if alone[group].max() <= MAX_RELATIVE_ERROR:
            return UnidentifiedGroup(
                keys, [], f"{names}: known only to {rounded(100 * float(alone[group].max()))} %: fix {it}"
            )
        return UnidentifiedGroup(keys, [], f"{names}: not identifiable: fix {it}")
    said = ", ".join(f"{one} is known to {rounded(100 * one.standard_error)} %" for one in known)
    most = float(alone[group].max())
    each = "is not" if most > MAX_RELATIVE_ERROR else f"only to {rounded(100 * most)} %"
    return UnidentifiedGroup(keys, known, f"{said}, each alone {each}: fix one{remedy}")


def _complement(blind: Array) -> Iterator[Array]:
    """Yield a basis of the orthogonal complement of `blind`, shape (m, directions), in reduced echelon form."""
    vectors, singular, _ = np.linalg.svd(blind)
    rank = int(np.sum(singular > MIN_GROUP_COMPONENT * singular[0]))
    rows = vectors[:, rank:].T.copy()
    # Reduce to echelon form, starting with the best identified parameters.
    order = list(np.argsort(np.linalg.norm(blind, axis=1), kind="stable"))
    for n in range(len(rows)):
        pivot = max(order, key=lambda column: (abs(rows[n, column]) > 0.1, -order.index(column)))
        order.remove(pivot)
        rows[n] /= rows[n, pivot]
        for other in range(len(rows)):
            if other != n:
                rows[other] -= rows[other, pivot] * rows[n]
    yield from rows
