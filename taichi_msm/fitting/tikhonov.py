"""Tikhonov-regularised estimation of a stiffness map on a grid of R x R cells.

The logs x of the factors of the map cells minimise, within bounds, chi-square plus a penalty on roughness,

    1/2 sum ((predicted - observed) / sigma)^2 + w/2 sum (x_p - x_q)^2        over all neighbouring map cells p, q

The minimiser is L-BFGS-B with the adjoint gradient. J is the Jacobian of predicted / sigma by x, L the matrix of the
second sum.

The weight w follows from the discrepancy principle: it is the largest with residuals that sigma explains. The map
changes only R^2 degrees of freedom of the residuals. Therefore the excess of chi-square above its minimum is compared
with its expectation, R^2 minus the effective number of parameters, tr(J^T J (J^T J + w L)^-1). As J depends on x,
search and choice of w alternate until w is stable.

Standard errors are those of Laplace's approximation, from the inverse of J^T J + w L; they hold for smooth tissue only.
A map cell is unknown if its error exceeds `MAX_KNOWN_ERROR` even for known other cells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError
from taichi_msm.fitting.parameters import Bounds
from taichi_msm.fitting.points import PointModel, PointObservation
from taichi_msm.gradients.gradient import Adjoint
from taichi_msm.scene.scene import Scene

# Largest relative error of a known map cell, with all other cells given.
MAX_KNOWN_ERROR = 0.5

# Largest change of a stable weight, as a factor.
MAX_WEIGHT_CHANGE = 2.0

# Largest change of the log of a map cell by the linearised solution, at which a search starts.
MAX_INITIAL_STEP = 1.0

# Smallest step of finite differences of the log of a map cell, as a single cell changes the observations little.
MIN_DIFFERENCE_STEP = 1e-2


class SmoothnessWeight(NamedTuple):
    """Weight w of the smoothness, chosen by the discrepancy principle."""

    weight: float  # w
    step: Array  # linearised change of x to the minimum with w, shape (R^2,)
    weights: Array  # candidates, from the largest to w, shape (candidates,)
    excess: Array  # of chi-square above its minimum, shape (candidates,)
    expected: Array  # its expectation, shape (candidates,)


def with_scaled_forces(scene: Scene, logs: Array) -> Scene:
    """Return a scene with scaled forces of all tools; `logs`: log of their common factor, shape (1,), or empty."""
    factor = float(np.exp(logs).prod())
    probes = [probe.with_force(factor) for probe in scene.probes]
    return scene.model_copy(update={"probes": tuple(probes)})


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Predictions linearised at a map."""

    x: Array  # logs of the factors of the map cells, shape (R^2,)
    information: Array  # J^T J / variance, shape (R^2, R^2)
    slope: Array  # gradient of chi-square / (2 variance) by x, shape (R^2,)
    variance: float  # variance of the residuals [sigma^2], chi-square of the best map per degree of freedom; at least 1

    def choose_weight(self, roughness: Array) -> SmoothnessWeight:
        """Choose the weight of L, `roughness`, shape (R^2, R^2), by the discrepancy principle."""
        candidates: list[tuple[float, float, float]] = []
        excess_at_x = float(self.slope @ np.linalg.pinv(self.information, hermitian=True) @ self.slope)
        # Candidates are in units of the largest diagonal entry of J^T J.
        for weight in 10.0 ** np.arange(2, -9, -0.1) * np.diag(self.information).max():
            inverse = np.linalg.inv(self.information + weight * roughness)
            step = -inverse @ (self.slope + weight * (roughness @ self.x))
            excess = excess_at_x + float(2 * self.slope @ step + step @ self.information @ step)
            candidates.append((float(weight), excess, len(step) - float(np.sum(inverse * self.information))))
            if excess <= candidates[-1][2]:
                break
        return SmoothnessWeight(candidates[-1][0], step, *np.array(candidates).T)

    def errors(self, weight: float, roughness: Array) -> Array:
        """Return the standard errors of x, shape (R^2,), NaN if unknown; `roughness`: L, shape (R^2, R^2)."""
        deviations = np.sqrt(np.diag(np.linalg.inv(self.information + weight * roughness)))
        return np.where(np.diag(self.information) * MAX_KNOWN_ERROR**2 >= 1, deviations, np.nan)


@dataclass(frozen=True, eq=False)
class MapSolution:
    """Estimated map."""

    x: Array  # logs of the factors, and of the factor of the forces if free, shape (R^2,) or (R^2 + 1,)
    errors: Array  # standard errors of x, NaN if unknown
    variance: float  # variance of the residuals [sigma^2], as in `Linearisation`
    choice: SmoothnessWeight


@dataclass(eq=False)
class MapSearch:
    """Estimation of a map.

    `sigma` [m] or [px] includes the mesh error; `limits` are bounds of the logs of the factors. With `force_limits`,
    the last entry of x is the log of a common factor of all forces. An exception from `pause` ends the search.
    """

    adjoint: Adjoint
    model: PointModel
    observations: PointObservation
    sigma: float
    grid: MapGrid
    limits: Bounds
    pause: Callable[[], None]
    force_limits: Bounds | None = None
    runs: int = 0

    def __post_init__(self) -> None:
        self._cells = self.grid.resolution**2
        extra_limits = [] if self.force_limits is None else [self.force_limits]
        self._roughness = np.pad(self.grid.roughness(), (0, len(extra_limits)))
        self._limits = np.array([self.limits] * self._cells + extra_limits).T

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return predicted points [m], shape (N, T, 3), and values, shape (N, T, 3 or 2)."""
        self.pause()
        self.runs += 1
        cells, scene = x[: self._cells], with_scaled_forces(self.model.scene, x[self._cells :])
        points = self.model.points(self.adjoint.run(self.grid.factors(cells), self.pause, scene))
        predicted = self.observations.observe(self.model.scene, points)
        if not np.isfinite(predicted[self.observations.known]).all():
            fault = "an observed point is behind the eye of the camera for some maps"
            remedy = "give NaN in its place, or narrower --bounds"
            raise SceneError([f"{self.observations.name}: pixel: {fault}; {remedy}"])
        return points, predicted

    def misfit(self, x: Array) -> tuple[float, Array]:
        """Return chi-square and its gradient by x."""
        points, predicted = self.predict(x)
        residuals = np.where(self.observations.known, predicted - self.observations.values, 0.0) / self.sigma
        gradient = self.adjoint.backward(self.model.backward(points, 2 * residuals / self.sigma), self.pause)
        by_cells = self.grid.backward(x[: self._cells], gradient.maps["tissue.map"])
        # The derivative of a force by the log of its factor is the force.
        scene = with_scaled_forces(self.model.scene, x[self._cells :])
        totals = {f"probes.{n}.total": np.array(probe.total, np.float64) for n, probe in enumerate(scene.probes)}
        by_forces = sum(float(np.sum(gradient.numbers[key] * total)) for key, total in totals.items())
        return float((residuals**2).sum()), np.append(by_cells, [by_forces] * (len(x) - self._cells))

    def best(self, start: Array) -> MapSolution:
        """Return the smoothest map that explains the observations, from initial logs."""
        linearisation = self._linearise(start)
        choice = linearisation.choose_weight(self._roughness)
        # Weight and map alternate.
        for _ in range(4):
            weight, step = choice.weight, np.clip(choice.step, -MAX_INITIAL_STEP, MAX_INITIAL_STEP)
            x = self._minimise(np.clip(linearisation.x + step, *self._limits), weight, linearisation.variance)
            linearisation = self._linearise(x)
            choice = linearisation.choose_weight(self._roughness)
            if 1 / MAX_WEIGHT_CHANGE < choice.weight / weight < MAX_WEIGHT_CHANGE:
                break
        errors = linearisation.errors(weight, self._roughness)
        return MapSolution(x, errors, linearisation.variance, choice._replace(weight=weight))

    def _linearise(self, x: Array) -> Linearisation:
        """Linearise at x by finite differences, a run per map cell."""
        known, predicted = self.observations.known, self.predict(x)[1]
        residuals = (predicted - self.observations.values)[known] / self.sigma
        jacobian = np.empty((residuals.size, len(x)))
        step = max(MIN_DIFFERENCE_STEP, self.observations.difference_step(self.model.scene))
        for n, change in enumerate(step * np.eye(len(x))):
            jacobian[:, n] = (self.predict(x + change)[1] - predicted)[known] / (step * self.sigma)
        information, slope = jacobian.T @ jacobian, jacobian.T @ residuals
        min_chi_square = float(residuals @ residuals - slope @ np.linalg.pinv(information, hermitian=True) @ slope)
        variance = max(1.0, min_chi_square / max(1, residuals.size - len(x)))
        return Linearisation(x, information / variance, slope / variance, variance)

    def _minimise(self, start: Array, weight: float, variance: float) -> Array:
        """Minimise for a weight, with chi-square divided by the variance."""
        from scipy.optimize import minimize

        def cost(x: Array) -> tuple[float, Array]:
            (chi_square, gradient), smoothness_gradient = self.misfit(x), self._roughness @ x
            value = chi_square / variance + weight * float(x @ smoothness_gradient)
            return value / 2, gradient / variance / 2 + weight * smoothness_gradient

        options = {"maxcor": 50, "ftol": 1e-6, "gtol": 0.0, "maxiter": 300}
        bounds = list(zip(*self._limits, strict=True))
        result = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return np.asarray(result.x, np.float64)


class MapGrid:
    """Interpolation from the R x R cells of a map to the cells of a sheet, that of `model.sheet.map_factors`."""

    def __init__(self, resolution: int, cells: tuple[int, int]) -> None:
        self.resolution = resolution
        # Linear between the centres of the map cells, constant beyond.
        self._down, self._across = (
            np.stack([np.interp(centres(n), centres(resolution), unit) for unit in np.eye(resolution)], axis=1)
            for n in cells
        )

    def factors(self, x: Array) -> Array:
        """Return the factors of the sheet's cells from the logs x of the map cells, shape (R^2,)."""
        return np.asarray(self._down @ np.exp(x).reshape(self.resolution, -1) @ self._across.T)

    def backward(self, x: Array, gradient: Array) -> Array:
        """Return the gradient of a loss by the logs x, shape (R^2,), from that by the factors of the sheet's cells."""
        return np.asarray(np.exp(x) * (self._down.T @ gradient @ self._across).ravel())

    def roughness(self) -> Array:
        """Return L, shape (R^2, R^2): x L x is the sum of squared differences of neighbouring map cells."""
        steps, identity = np.diff(np.eye(self.resolution), axis=0), np.eye(self.resolution)
        line = steps.T @ steps
        return np.kron(line, identity) + np.kron(identity, line)


def centres(count: int) -> Array:
    """Return the centres of `count` equal intervals of [0, 1]."""
    return (np.arange(count) + 0.5) / count
