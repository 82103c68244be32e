"""Intervals by profile: how far a parameter can go until the others can no longer make up for it.

The value of a parameter is held, and the others follow to where the cost is least. The interval ends where the cost
has risen by t^2 f / 2, as many standard deviations as Student's t asks for. With J from the solution, the others take
one run a step.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.estimation import FAR, Misfit, Solution, soft_l1
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
    deviations: float  # the root of twice the rise of the cost over f, with the sign of the side; nan: no run there


class Profile(NamedTuple):
    """The profile of a parameter."""

    places: list[Place]  # sorted by x
    low: float | None  # the ends of the interval; None: there is none within the bounds
    high: float | None


class Profiler:
    """Draws the profiles of a solution's parameters."""

    def __init__(self, misfit: Misfit, solution: Solution, uncertain: Uncertainty, *, robust: bool) -> None:
        self._misfit, self._solution, self._uncertain, self._robust = misfit, solution, uncertain, robust
        self._least = self._cost(uncertain.left)

    def profiles(self, runs: Runs) -> list[Profile]:
        """Draw the profile of every parameter, all sides at once."""
        limits = [one.limits for one in runs.job.parameters]
        sides = {(n, sign): self._side(n, sign, limits[n][sign > 0]) for n in range(len(limits)) for sign in (-1, 1)}
        places: dict[tuple[int, int], list[Place]] = {}
        asked = {which: next(side) for which, side in sides.items()}
        while asked:
            runs.expected = max(runs.expected, runs.count + 2 * len(asked))
            predicted = runs.several(list(asked.values()))
            following = {}
            for which, one in zip(asked, predicted, strict=True):
                try:
                    following[which] = sides[which].send(one)
                except StopIteration as stop:
                    places[which] = stop.value
            asked = following
        return [self._profile(n, places[n, -1], places[n, 1]) for n in range(len(limits))]

    def _profile(self, n: int, below: list[Place], above: list[Place]) -> Profile:
        here, quantile = float(self._solution.x[n]), self._uncertain.quantile
        ends = []
        for side in (below, above):
            last = side[-1] if side else Place(here, math.nan)
            reached = abs(abs(last.deviations) / quantile - 1) < 5 * CLOSE
            ends.append(last.x if reached else None)
        good = [place for place in [*below, Place(here, 0.0), *above] if math.isfinite(place.deviations)]
        return Profile(sorted(good), ends[0], ends[1])

    def _side(self, n: int, sign: int, limit: float) -> Side:
        """Go out to one side of a parameter; asks for predictions, and returns the places."""
        x, root, quantile = self._solution.x, self._uncertain.root, self._uncertain.quantile
        variance = float(root[n] @ root[n])
        valley = root @ root[n] / variance
        places: list[Place] = []
        away = quantile * math.sqrt(variance)
        for _ in range(MOST_PLACES):
            away = min(away, abs(limit - x[n]))
            if away == 0:
                break
            place = x + sign * away * valley
            place[n] = x[n] + sign * away
            least = yield from self._least_at(n, place)
            rise = math.sqrt(max(0.0, 2 * (least - self._least) / self._uncertain.factor))
            places.append(Place(float(place[n]), sign * rise))
            if abs(rise / quantile - 1) < CLOSE or (away >= abs(limit - x[n]) and rise < quantile):
                break
            away = self._next(away, rise, places, float(x[n]))
        return places

    def _next(self, away: float, rise: float, places: list[Place], here: float) -> float:
        """Guess where the interval ends: the rise is nearly proportional to the distance."""
        if not math.isfinite(rise):
            return away / 2
        tried = sorted(
            (abs(place.deviations), abs(place.x - here)) for place in places if math.isfinite(place.deviations)
        )
        quantile = self._uncertain.quantile
        below = max(((rose, far) for rose, far in tried if rose < quantile), default=(0.0, 0.0))
        above = min(((rose, far) for rose, far in tried if rose >= quantile), default=None)
        if above is None:
            return min(3 * away, away * quantile / max(rise, 1e-3))
        return below[1] + (above[1] - below[1]) * (quantile - below[0]) / (above[0] - below[0])

    def _least_at(self, n: int, place: Array) -> Generator[Array, Predicted | None, float]:
        """Let the other parameters follow; returns the least cost, infinite where there is no run."""
        others = np.array([m for m in range(len(place)) if m != n], dtype=int)
        deviations = self._uncertain.deviations[others]
        least = math.inf
        for _ in range(MOST_STEPS):
            predicted = yield place
            if predicted is None:
                return least
            left = self._misfit.divided(self._misfit.of(predicted), self._uncertain.scales)
            cost = self._cost(left)
            if cost > least:
                return least
            least = cost
            if not len(others):
                return least
            # Of a robust cost, the pull of what is far off, over the root of its weight.
            pull = left * (1 + (left / FAR) ** 2) ** 0.25 if self._robust else left
            slope = self._uncertain.weighted[:, others]
            step = -np.linalg.lstsq(slope, pull, rcond=None)[0]
            if np.all(np.abs(step) < AT_REST * deviations):
                return least
            place = place.copy()
            place[others] += step
        return least

    def _cost(self, left: Array) -> float:
        return float(np.sum(soft_l1(left**2) if self._robust else left**2)) / 2
