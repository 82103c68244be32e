"""Find the values with which a scene fits what was seen best: nonlinear least squares within bounds.

The trust region method of SciPy, with differences of runs as derivatives: forward ones on the way, central ones where
it ends. What is minimised is the sum of rho(r^2) over all r = (predicted - seen) / sigma, with rho(z) = z, or for
robust fits SciPy's soft_l1, under which a number that is far off counts by |r|. Beside forces and in robust fits, a
sigma that is not known is found in turn with the parameters.

How well the best values are known: their covariance from the derivatives where the search ends.

With J the derivatives of r = (predicted - seen) / sigma by x, the covariance of x is

    C = f (J^T W J)^-1 M (J^T W J)^-1,    M = J^T W^(1/2) K W^(1/2) J

where W = 1 and K = 1, and f is the mean of r^2 per degree of freedom, but at least 1. In a robust fit W is the second
derivative of half of rho, and f the mean of the squares of its first over that of W. If errors of neighbouring tracks
are alike, K = exp(-distance / correlation) for two tracks in one frame; if tracks drift, K = exp(-apart / drift) for
one track at two times; if both, their product. With the singular values W^(1/2) J = U S V^T,

    C = f V S^-1 (U^T K U) S^-1 V^T

which holds however little some direction is seen: nothing is squared.

Intervals by profile: how far a parameter can go until the others can no longer make up for it.

The value of a parameter is held, and the others follow, within their bounds, to where the cost is least. The interval
ends where the cost has risen by t^2 f / 2, as many standard deviations as Student's t asks for, or farther by as much
as errors that are alike widen them. With J from the solution, the others take one run a step.

What the data cannot tell: combinations of parameters that could change without anybody seeing it, in words.

Parameters that are not seen each for itself may be seen together: pictures tell a stiffness over a force, but neither
of them. The directions in which nothing is seen leave those combinations of the parameters known that are across them.
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
from taichi_msm.fitting.predict import Predicted, Runs, difference

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


# Of singular values, as a share of the largest: what is smaller, which differences hardly tell from 0, is not seen at
# all. In such a direction the smallest parts of parameters are none, and this is its standard deviation.
UNSEEN, LEAST_PART, AT_LARGE = 1e-8, 1e-3, 1e4

# A direction with a larger standard deviation than this is not seen.
NOT_SEEN = 0.5

# Of the intervals.
CONFIDENCE = 0.95


class Alike(NamedTuple):
    """How far apart errors of tracks are alike; None: they are independent."""

    correlation: float | None  # of two tracks [px]
    drift: float | None  # of two times [s]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What the derivatives tell of the parameters' errors, in units of x.

    With n parameters, the columns of `directions` are combinations of x that are seen independently of each other, the
    one that is seen best first.
    """

    scales: Scales  # standard deviations of what was seen, found or given
    factor: float  # f
    freedom: int  # degrees of freedom
    independent: float  # so many independent numbers would tell as much of chi-square as these
    left: Array  # r
    weighted: Array  # W^(1/2) J, shape (numbers, n)
    directions: Array  # shape (n, n)
    root: Array  # F with C = F F^T, shape (n, n)
    wider: Array  # how many times K makes the deviations wider, shape (n,)

    @property
    def deviations(self) -> Array:
        """Standard deviations of x, shape (n,)."""
        return np.linalg.norm(self.root, axis=1)

    @property
    def along(self) -> Array:
        """Standard deviations of the directions, shape (n,)."""
        return np.linalg.norm(self.directions.T @ self.root, axis=1)

    @property
    def correlation(self) -> Array:
        """Correlations of x, shape (n, n)."""
        each = self.root / np.maximum(self.deviations, np.finfo(float).tiny)[:, None]
        return np.clip(each @ each.T, -1.0, 1.0)

    @property
    def quantile(self) -> float:
        """So many standard deviations each side of a value are its interval, by Student's t."""
        from scipy.stats import t

        return float(t.ppf((1 + CONFIDENCE) / 2, self.freedom))

    def of_combination(self, exponents: Array) -> float:
        """Give the standard deviation of a combination of x."""
        return float(np.linalg.norm(exponents @ self.root))

    @property
    def dropped(self) -> NDArray[np.bool_]:
        """Which of x have a part in a direction that is not seen, so that `shift` does not tell how far they move."""
        return np.linalg.norm(self.directions[:, self.along > NOT_SEEN], axis=1) > LEAST_PART * 50

    def shift(self, rows: Array) -> Array:
        """Give how far x moves, as far as that is seen, if what is predicted is off by so much, in units of r."""
        seen = self.directions[:, self.along <= NOT_SEEN]
        return seen @ np.linalg.lstsq(self.weighted @ seen, rows, rcond=None)[0]


def uncertainty(misfit: Misfit, solution: Solution, derivatives: Array, alike: Alike) -> Uncertainty:
    """Work out the uncertainty of a solution.

    Args:
        misfit: that was minimised.
        solution: the best values.
        derivatives: of what is predicted by x, shape (numbers, parameters).
        alike: how far apart errors of tracks are alike.
    """
    parameters = len(solution.x)
    freedom = max(1, sum(misfit.count) - parameters)
    scales = solution.scales
    if misfit.seen.sigma is None:
        scales = scales._replace(values=misfit.sigma(solution.predicted, parameters))
    left, slope = misfit.residuals(solution.predicted, scales), misfit.divided(derivatives, scales)
    far = misfit.far(left)
    weighted = slope * far[:, None] ** (-0.75)
    factor = max(1.0, float(np.sum(left**2 / far)) / freedom / float(np.mean(far**-1.5)))
    singular = np.linalg.svd(weighted, full_matrices=False)
    blind = UNSEEN * max(1.0, singular.S[0]) >= singular.S
    held = np.where(blind, 1 / AT_LARGE, singular.S)
    parts = np.where(blind & (np.abs(singular.Vh.T) < LEAST_PART), 0.0, singular.Vh.T)
    plain = root = np.sqrt(factor) * parts / held
    independent = float(freedom)
    if alike != (None, None):
        around, independent = _with_neighbours(misfit, singular.U, alike)
        independent = min(independent, freedom)
        values, vectors = np.linalg.eigh(around)
        root = plain @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    wider = np.linalg.norm(root, axis=1) / np.linalg.norm(plain, axis=1)
    return Uncertainty(scales, factor, freedom, independent, left, weighted, singular.Vh.T, root, wider)


def _with_neighbours(misfit: Misfit, rows: Array, alike: Alike) -> tuple[Array, float]:
    """Compute U^T K U, and tr(K)^2 / tr(K^2), so many independent numbers as K leaves; forces are independent."""
    values, seen = misfit.count[0], misfit.seen
    # Tracks are where they were seen on the mean; those that never were have no errors.
    ever: NDArray[np.bool_] = np.any(seen.there, axis=1)
    space, time = _likeness(seen, ever, alike)
    whole = np.zeros((*seen.values.shape, rows.shape[1]))
    whole[seen.known] = rows[:values]
    whole = whole[ever]
    beside = np.einsum("st,ntcp->nscp", time, np.tensordot(space, whole, 1))
    every = len(rows) - values
    there = seen.there[ever].astype(float)
    square = every + seen.values.shape[2] * float(np.sum(space**2 * (there @ time**2 @ there.T)))
    total = np.tensordot(whole, beside, ((0, 1, 2), (0, 1, 2))) + rows[values:].T @ rows[values:]
    return total, len(rows) ** 2 / square


def _likeness(seen: Observations, ever: NDArray[np.bool_], alike: Alike) -> tuple[Array, Array]:
    """Correlate the errors of tracks, shape (tracks, tracks), and those of times, shape (T, T)."""
    from scipy.spatial.distance import cdist

    space, time = np.eye(int(ever.sum())), np.eye(len(seen.time))
    if alike.correlation is not None:
        pixels = np.nanmean(seen.values[ever], axis=1)
        space = np.exp(-cdist(pixels, pixels) / alike.correlation)
    if alike.drift is not None:
        time = np.exp(-np.abs(seen.time[:, None] - seen.time) / alike.drift)
    return space, time


# The most places that are tried on a side, and steps of the other parameters at each.
MOST_PLACES, MOST_STEPS = 8, 6

# How close an end is found, as a share of its distance, and where the others rest, in standard deviations.
PROFILE_TOLERANCE, AT_REST = 0.01, 0.02

Side = Generator[Array, "Predicted | None", "list[Place]"]


class Place(NamedTuple):
    """A place on a profile."""

    x: float  # of the parameter
    deviations: float  # the root of twice the rise of the cost over f, and its sign; infinite: no run there


class Profile(NamedTuple):
    """The profile of a parameter."""

    places: list[Place]  # sorted by x
    low: float | None  # the ends of the interval; None: there is none within the bounds
    high: float | None


class Profiler:
    """Draws the profiles of a solution's parameters."""

    def __init__(
        self, parameters: Sequence[Parameter], misfit: Misfit, solution: Solution, uncertain: Uncertainty
    ) -> None:
        self._misfit, self._solution, self._uncertain = misfit, solution, uncertain
        self._least = misfit.cost(uncertain.left)
        self._low, self._high = np.array([one.limits for one in parameters]).T

    def profiles(self, runs: Runs) -> list[Profile]:
        """Draw the profile of every parameter, all sides at once."""
        number = len(self._low)
        sides = {(n, sign): self._side(n, sign) for n in range(number) for sign in (-1, 1)}
        places: dict[tuple[int, int], list[Place]] = {which: [] for which in sides}
        asked: dict[tuple[int, int], Array | None] = {which: next(side, None) for which, side in sides.items()}
        while waiting := [(which, place) for which, place in asked.items() if place is not None]:
            runs.expected = max(runs.expected, runs.count + 2 * len(waiting))
            predicted = runs.several([place for _, place in waiting])
            for (which, _), one in zip(waiting, predicted, strict=True):
                try:
                    asked[which] = sides[which].send(one)
                except StopIteration as stop:
                    asked[which], places[which] = None, stop.value
        return [self._profile(n, places[n, -1], places[n, 1]) for n in range(number)]

    def _profile(self, n: int, below: list[Place], above: list[Place]) -> Profile:
        quantile = self._uncertain.quantile
        ends = [
            side[-1].x if side and abs(abs(side[-1].deviations) / quantile - 1) < 5 * PROFILE_TOLERANCE else None
            for side in (below, above)
        ]
        places = [*below, Place(float(self._solution.x[n]), 0.0), *above]
        return Profile(sorted(place for place in places if math.isfinite(place.deviations)), ends[0], ends[1])

    def _side(self, n: int, sign: int) -> Side:
        """Go from the best values to where the interval ends, or to a bound."""
        x, root, quantile = self._solution.x, self._uncertain.root, self._uncertain.quantile
        variance = float(root[n] @ root[n])
        valley = root @ root[n] / variance
        most = float((self._high if sign > 0 else self._low)[n] - x[n]) * sign
        places: list[Place] = []
        # The end lies between distances, with the rise at each, which is nearly proportional to the distance.
        near, far = (0.0, 0.0), (math.inf, math.inf)
        away = min(quantile * math.sqrt(variance), most)
        while away > 0 and len(places) < MOST_PLACES:
            place = np.clip(x + sign * away * valley, self._low, self._high)
            place[n] = x[n] + sign * away
            least = yield from self._least_at(n, place)
            rise = math.sqrt(max(0.0, 2 * (least - self._least) / self._uncertain.factor)) / self._uncertain.wider[n]
            places.append(Place(float(place[n]), sign * rise))
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

    def _least_at(self, n: int, place: Array) -> Generator[Array, Predicted | None, float]:
        """Let the other parameters follow; returns the least cost, infinite where there is no run."""
        from scipy.optimize import lsq_linear

        others = np.delete(np.arange(len(place)), n)
        slope, deviations = self._uncertain.weighted[:, others], self._uncertain.deviations[others]
        least = math.inf
        for _ in range(MOST_STEPS):
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
            step = lsq_linear(slope, -left * self._misfit.far(left) ** 0.25, bounds).x
            if np.all(np.abs(step) < AT_REST * deviations):
                break
            place = place.copy()
            place[others] += step
        return least


# A parameter is not identifiable if its standard error is above this share of its value, of a place of its range.
MOST_ERROR = 1.0

# Parameters whose part in a direction is above this belong to it.
PART = 0.05

# Exponents this close to a half of a whole number are written as such.
CLOSE = 0.06


class Combination(NamedTuple):
    """A product of powers of parameters that is known."""

    exponents: dict[str, float]
    standard_error: float  # as a share

    def __str__(self) -> str:
        text = ""
        for key, exponent in sorted(self.exponents.items(), key=lambda item: item[1] < 0):
            power = "" if abs(exponent) == 1 else f"^{abs(exponent):.3g}"
            sign = (" / " if exponent < 0 else " x ") if text else ("1 / " if exponent < 0 else "")
            text += f"{sign}{key}{power}"
        return text


class Unseen(NamedTuple):
    """Parameters that the data cannot tell from each other, or at all."""

    parameters: list[str]
    known: list[Combination]  # what is known of them
    text: str

    def as_json(self) -> dict[str, Any]:
        """Give it as plain data."""
        known = [{"combination": str(one), **one._asdict()} for one in self.known]
        return {"parameters": self.parameters, "known": known, "text": self.text}


def unseen(parameters: Sequence[Parameter], x: Array, uncertain: Uncertainty, *, forces: bool) -> list[Unseen]:
    """Find what the data cannot tell; forces: whether any were seen."""
    blind = uncertain.directions[:, uncertain.along > NOT_SEEN]
    pairs = zip(parameters, x.tolist(), uncertain.deviations.tolist(), strict=True)
    alone = np.array([one.share(place, deviation) for one, place, deviation in pairs])
    return [_in_words(parameters, uncertain, alone, part, blind[part], forces=forces) for part in _groups(blind)]


def _groups(blind: Array) -> Iterator[Array]:
    """Part the parameters that are not seen into groups that have no direction in common; gives their numbers."""
    # The projection onto the directions does not depend on which of them were chosen.
    together = np.abs(blind @ blind.T) > PART**2
    left = set(np.flatnonzero(np.linalg.norm(blind, axis=1) > PART).tolist())
    while left:
        group, new = set[int](), {min(left)}
        while new:
            group |= new
            new = {m for n in new for m in left if together[n, m]} - group
        left -= group
        yield np.array(sorted(group))


def _in_words(
    parameters: Sequence[Parameter], uncertain: Uncertainty, alone: Array, group: Array, blind: Array, *, forces: bool
) -> Unseen:
    """Say what is known of some parameters.

    alone: every standard error as a share; group: which parameters; blind: their parts in what is not seen.
    """
    keys = [parameters[n].key for n in group]
    known = []
    for exponents in _across(blind):
        whole = np.zeros(len(parameters))
        nice = np.round(2 * exponents) / 2
        exponents = np.where(np.abs(exponents - nice) < CLOSE, nice, exponents)
        whole[group] = exponents
        parts = {key: float(power) for key, power in zip(keys, exponents, strict=True) if power}
        known.append(Combination(parts, uncertain.of_combination(whole)))
    remedy = "" if forces else ", or give a force (--forces)"
    names = " and ".join([", ".join(keys[:-1]), keys[-1]] if len(keys) > 1 else keys)
    known = [one for one in known if one.standard_error <= MOST_ERROR]
    if known and not all(parameters[n].is_log for n in group):
        return Unseen(keys, [], f"{names} cannot be told apart by what was seen: fix one{remedy}")
    if not known:
        it = "it" if len(keys) == 1 else "them"
        if alone[group].max() <= MOST_ERROR:
            return Unseen(keys, [], f"{names}: known only to {rounded(100 * float(alone[group].max()))} %: fix {it}")
        return Unseen(keys, [], f"{names}: what was seen does not tell {it}: fix {it}")
    said = ", ".join(f"{one} is known to {rounded(100 * one.standard_error)} %" for one in known)
    most = float(alone[group].max())
    each = "is not" if most > MOST_ERROR else f"only to {rounded(100 * most)} %"
    return Unseen(keys, known, f"{said}, each alone {each}: fix one{remedy}")


def _across(blind: Array) -> Iterator[Array]:
    """Give independent combinations that are orthogonal to all directions, each with a 1 that the others lack.

    blind: parts of m parameters in the directions that are not seen, shape (m, directions).
    """
    vectors, singular, _ = np.linalg.svd(blind)
    rank = int(np.sum(singular > PART * singular[0]))
    rows = vectors[:, rank:].T.copy()
    # Reduced to echelon form from the parameters that are seen best on.
    order = list(np.argsort(np.linalg.norm(blind, axis=1), kind="stable"))
    for n in range(len(rows)):
        pivot = max(order, key=lambda column: (abs(rows[n, column]) > 0.1, -order.index(column)))
        order.remove(pivot)
        rows[n] /= rows[n, pivot]
        for other in range(len(rows)):
            if other != n:
                rows[other] -= rows[other, pivot] * rows[n]
    yield from rows
