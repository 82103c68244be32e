"""Profile likelihood of the parameters of a least-squares solution.

A parameter is fixed, and the others are optimised within their bounds by Gauss-Newton steps, a run each. The Jacobian
is that of the solution, updated along every step (Broyden 1965), in the metric of the covariance. The interval ends
where sqrt(2 rise of the cost / f) is Student's t times the widening by correlated errors; f is that of `uncertainty`.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable
from typing import NamedTuple

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.fitting.least_squares import Misfit, Solution
from taichi_msm.fitting.predict import Prediction, Runs
from taichi_msm.fitting.uncertainty import Uncertainty

# Relative tolerance of the end of an interval.
PROFILE_TOLERANCE = 0.01

# Smallest significant change of the cost [f], and largest number of runs of a conditional minimum.
COST_TOLERANCE, MAX_STEPS = 0.01, 8

Side = Generator[Array, "Prediction | None", "list[ProfilePoint]"]
Minimum = Generator[Array, "Prediction | None", "tuple[float, Array, bool]"]


class ProfilePoint(NamedTuple):
    """Point of a profile."""

    x: float
    deviations: float  # signed sqrt(2 rise of the cost / f) / widening; infinite where runs fail


class Profile(NamedTuple):
    """Profile of a parameter."""

    points: list[ProfilePoint]  # sorted by x
    low: float | None  # lower end of the 95 % interval, or None beyond the bounds
    high: float | None  # upper end, likewise


def quadratic_profile(x: float, deviation: float, quantile: float) -> Profile:
    """Return the quadratic approximation of a profile at x; `quantile`: half width of its interval [deviations]."""
    # The limit bounds the plotted range of unidentified parameters.
    step = min(deviation, 3.0)
    points = [ProfilePoint(x + offset * step, offset) for offset in np.linspace(-3, 3, 25).tolist()]
    return Profile(points, x - quantile * deviation, x + quantile * deviation)


class Profiler:
    """Profile likelihood of a solution's parameters."""

    def __init__(self, runs: Runs, misfit: Misfit, solution: Solution, uncertainties: Uncertainty) -> None:
        self._runs, self._misfit, self._solution, self._uncertainties = runs, misfit, solution, uncertainties
        self._min_cost = misfit.cost(uncertainties.residuals)
        self._low, self._high = runs.problem.limits

    def profiles(self, parameters: Iterable[int]) -> dict[int, Profile]:
        """Return the profiles of parameters by index, with both sides of each computed in parallel."""
        runs = self._runs
        sides = {(n, sign): self._side(n, sign) for n in parameters for sign in (-1, 1)}
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
        return {n: self._profile(n, points[n, -1], points[n, 1]) for n, sign in sides if sign > 0}

    def _profile(self, n: int, below: list[ProfilePoint], above: list[ProfilePoint]) -> Profile:
        quantile = self._uncertainties.quantile
        ends = [
            side[-1].x if side and abs(abs(side[-1].deviations) / quantile - 1) < 5 * PROFILE_TOLERANCE else None
            for side in (below, above)
        ]
        points = [*below, ProfilePoint(float(self._solution.x[n]), 0.0), *above]
        return Profile(sorted(point for point in points if math.isfinite(point.deviations)), ends[0], ends[1])

    def _side(self, n: int, sign: int) -> Side:
        """Find the end of the interval on one side; yield x to predict, and return the points."""
        x, root, quantile = self._solution.x, self._uncertainties.root, self._uncertainties.quantile
        variance = float(root[n] @ root[n])
        limit = float((self._high if sign > 0 else self._low)[n] - x[n]) * sign
        points: list[ProfilePoint] = []
        # Bracket of the end: pairs of distance and rise, which are nearly proportional, and conditional minima.
        inner, outer = (0.0, 0.0), (math.inf, math.inf)
        minima = {0.0: x}
        slope = root @ root[n] / variance * sign  # of the conditional minimum, over the distance
        jacobian = self._uncertainties.weighted.copy()
        distance = min(quantile * math.sqrt(variance), limit)
        while distance > 0 and len(points) < 8:
            trial = np.clip(minima[inner[0]] + (distance - inner[0]) * slope, self._low, self._high)
            trial[n] = x[n] + sign * distance
            cost, minimum, is_converged = yield from self._conditional_minimum(n, trial, jacobian)
            rise = math.sqrt(max(0.0, 2 * (cost - self._min_cost) / self._uncertainties.factor))
            rise /= self._uncertainties.widening[n]
            if is_converged or rise < quantile:
                minima[distance] = minimum
                slope = (minimum - minima[inner[0]]) / (distance - inner[0])
            else:
                rise, jacobian = math.inf, self._uncertainties.weighted.copy()
            points.append(ProfilePoint(float(trial[n]), sign * rise))
            if abs(rise / quantile - 1) < PROFILE_TOLERANCE or (distance == limit and rise < quantile):
                break
            inner, outer = ((distance, rise), outer) if rise < quantile else (inner, (distance, rise))
            if outer[1] < math.inf:
                distance = inner[0] + (outer[0] - inner[0]) * (quantile - inner[1]) / (outer[1] - inner[1])
            elif outer[0] < math.inf:  # The run there has failed, or the search of its minimum.
                distance = (inner[0] + outer[0]) / 2
            else:
                distance = min(distance * min(3.0, quantile / max(rise, 1e-3)), limit)
        return points

    def _conditional_minimum(self, n: int, x: Array, jacobian: Array) -> Minimum:
        """Minimise over the other parameters, and update the Jacobian.

        Return the cost, infinite if the run at x fails, its coordinates, and whether the search has converged.
        """
        from scipy.optimize import lsq_linear

        misfit, factor = self._misfit, self._uncertainties.factor
        others = np.delete(np.arange(len(x)), n)
        metric = np.linalg.pinv(self._uncertainties.root @ self._uncertainties.root.T)
        place, residuals = self._solution.x, self._uncertainties.residuals
        best: tuple[float, Array, Array] = (math.inf, x, residuals)
        share, is_converged = 1.0, False
        for _ in range(MAX_STEPS):
            if (predicted := (yield x)) is None:
                break
            step, change = x - place, -residuals
            residuals, place = misfit.residuals(predicted, self._uncertainties.scales), x
            change = change + residuals
            if not misfit.robust and (length := float(step @ metric @ step)):
                jacobian += np.outer(change - jacobian @ step, metric @ step / length)
            cost = misfit.cost(residuals)
            # A step that fails is shortened, with the Jacobian updated along it.
            is_better = cost < best[0]
            share = 1.0 if is_better else share / 2
            best = (cost, x, residuals) if is_better else best
            if is_converged := not len(others):
                break
            # Gauss-Newton step: first derivatives of rho / 2 over the roots of the second ones.
            gradient = best[2] * misfit.robust_factor(best[2]) ** 0.25
            bounds = (self._low - best[1])[others], (self._high - best[1])[others]
            shift = lsq_linear(jacobian[:, others], -gradient, bounds).x
            expected = float(gradient @ gradient - np.sum((gradient + jacobian[:, others] @ shift) ** 2)) / 2
            if is_converged := expected < COST_TOLERANCE * factor:
                break
            x = best[1].copy()
            x[others] += share * shift
        return best[0], best[1], is_converged
