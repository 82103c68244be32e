"""Intervals by profile: how far a parameter can go until the others can no longer make up for it.

The value of a parameter is held, and the others follow, within their bounds, to where the cost is least. The interval
ends where the cost has risen by t^2 f / 2, as many standard deviations as Student's t asks for, or farther by as much
as errors that are alike widen them. With J from the solution, the others take one run a step.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.estimation import Misfit, Solution
from taichi_msm.fitting.parameters import Parameter
from taichi_msm.fitting.prediction import Predicted
from taichi_msm.fitting.runs import Runs
from taichi_msm.fitting.uncertainty import Uncertainty

Array = NDArray[np.float64]

# The most places that are tried on a side, and steps of the other parameters at each.
MOST_PLACES, MOST_STEPS = 8, 6

# How close an end is found, as a share of its distance, and where the others rest, in standard deviations.
CLOSE, AT_REST = 0.01, 0.02

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
            side[-1].x if side and abs(abs(side[-1].deviations) / quantile - 1) < 5 * CLOSE else None
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
            if abs(rise / quantile - 1) < CLOSE or (away == most and rise < quantile):
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
