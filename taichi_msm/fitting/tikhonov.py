"""Tikhonov-regularised estimation of a stiffness map on a grid of R x R cells.

    1/2 sum ((predicted - observed) / sigma)^2 + w/2 sum (x_p - x_q)^2        over all neighbouring map cells p, q

is minimised over the logs x of the factors of all map cells, within bounds, by L-BFGS-B with the adjoint gradient. The
weight w follows from the discrepancy principle: it is the largest weight with a residual that sigma explains. A map
with R^2 cells can reproduce at most R^2 of all numbers; the errors of the others do not depend on the map. So the
excess of chi-square above its minimum is compared with its expectation: R^2 less the effective number of parameters,
tr(J^T J (J^T J + w L)^-1), with sigma = 1. A column of J is the change of the predictions by a map cell; L is the
matrix of the second sum. J is evaluated again where a search ends, until the weight is stable.

Standard errors are those of Laplace's approximation, from the inverse of J^T J + w L, and hold for smooth tissue only.
A map cell is unknown if its error were above MAX_KNOWN_ERROR even with all other cells given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.fitting.observations import ObservationModel, Observations
from taichi_msm.fitting.parameters import Bounds
from taichi_msm.gradients.gradient import Adjoint
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]

# Largest relative error of a known map cell, with all other cells given.
MAX_KNOWN_ERROR = 0.5

# Candidate weights, in units of the largest diagonal entry of J^T J.
WEIGHTS = 10.0 ** np.arange(2, -9, -0.1)

# Factor within which the weight is stable, and the limit of the alternation between weight and map.
WEIGHT_STABILITY, MAX_WEIGHT_ROUNDS = 2.0, 4

# Largest change of the log of a map cell from the linearisation to the start of a search.
MAX_INITIAL_STEP = 1.0

# Settings of L-BFGS-B.
COST_TOLERANCE, LBFGS_MEMORY, MAX_ITERATIONS = 1e-6, 50, 300

# Step of finite differences of the log of a map cell.
DIFFERENCE_STEP = 1e-2


class SmoothnessWeight(NamedTuple):
    """Weight of the smoothness, and the curve of the discrepancy principle."""

    weight: float
    step: Array  # to the map with this weight, by the linearised predictions
    weights: Array  # that were looked at, up to this one
    left: Array  # excess of chi-square above its minimum, for each weight
    expected: Array  # expected excess, for each weight


def with_scaled_forces(scene: Scene, factor: float = 1.0) -> Scene:
    """Return the scene with the forces of all tools scaled."""
    totals = [None if probe.total is None else tuple(factor * part for part in probe.total) for probe in scene.probes]
    probes = [probe.model_copy(update={"total": total}) for probe, total in zip(scene.probes, totals, strict=True)]
    return scene.model_copy(update={"probes": tuple(probes)})


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Predictions linearised at a map.

    Attributes:
        x: logs of the factors of the fields, shape (R^2,).
        information: J^T J, shape (R^2, R^2).
        slope: half of the derivative of chi-square by x.
        excess: chi-square of the best map per degree of freedom, at least 1; information and slope are divided by it.
    """

    x: Array
    information: Array
    slope: Array
    excess: float

    def choice(self, rough: Array) -> SmoothnessWeight:
        """Choose the weight of L by the discrepancy principle."""
        tried: list[tuple[float, float, float]] = []
        to_least = float(self.slope @ np.linalg.pinv(self.information, hermitian=True) @ self.slope)
        for weight in WEIGHTS * np.diag(self.information).max():
            inverse = np.linalg.inv(self.information + weight * rough)
            step = -inverse @ (self.slope + weight * (rough @ self.x))
            left = to_least + float(2 * self.slope @ step + step @ self.information @ step)
            tried.append((float(weight), left, len(step) - float(np.sum(inverse * self.information))))
            if left <= tried[-1][2]:
                break
        return SmoothnessWeight(tried[-1][0], step, *np.array(tried).T)

    def errors(self, weight: float, rough: Array) -> Array:
        """Return the standard errors of x, shape (R^2,); NaN: unknown."""
        deviations = np.sqrt(np.diag(np.linalg.inv(self.information + weight * rough)))
        return np.where(np.diag(self.information) * MAX_KNOWN_ERROR**2 >= 1, deviations, np.nan)


@dataclass(frozen=True, eq=False)
class MapSolution:
    """Estimated map: logs of its factors, their errors (NaN: unknown), and the smoothness."""

    x: Array
    errors: Array
    excess: float
    choice: SmoothnessWeight


class MapSearch:
    """Search for a map.

    Args:
        adjoint: of the scene.
        sight: observation model of the scene.
        observations: the observations.
        sigma: standard deviation of their errors, with the mesh error [m] or [px].
        fields: cells of the map.
        limits: bounds of the logs of the factors.
        tell: called several times a second; its exceptions end the search.
        force_limits: bounds of the log of a common factor of all forces, the last entry of x; None: there is none.

    Attributes:
        runs: number of runs.
    """

    def __init__(
        self,
        adjoint: Adjoint,
        sight: ObservationModel,
        observations: Observations,
        sigma: float,
        fields: MapGrid,
        limits: tuple[float, float],
        tell: Callable[[], None],
        *,
        force_limits: Bounds | None = None,
    ) -> None:
        self._adjoint, self._sight, self._observations, self._sigma = adjoint, sight, observations, sigma
        self._fields, self._tell, self._cells = fields, tell, fields.resolution**2
        more = [] if force_limits is None else [force_limits]
        self._rough = np.pad(fields.roughness(), (0, len(more)))
        self._limits = np.array([limits] * self._cells + more).T
        self.runs = 0

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return the points [m], shape (N, T, 3), and the predicted observations of a map."""
        self._tell()
        self.runs += 1
        cells, scene = x[: self._cells], with_scaled_forces(self._sight.scene, *np.exp(x[self._cells :]))
        points = self._sight.points(self._adjoint.run(self._fields.factors(cells), self._tell, scene))
        predicted = self._sight.observe(points)
        if not np.isfinite(predicted[self._observations.known]).all():
            said = "an observed point gets behind the eye of the camera with some maps"
            raise SceneError([f"{self._observations.name}: pixel: {said}; give NaN in its place, or narrower --bounds"])
        return points, predicted

    def misfit(self, x: Array) -> tuple[float, Array]:
        """Return chi-square and its gradient by x."""
        points, predicted = self.predict(x)
        left = np.where(self._observations.known, predicted - self._observations.values, 0.0) / self._sigma
        slope = self._adjoint.backward(self._sight.backward(points, 2 * left / self._sigma), self._tell)
        by_cells = self._fields.backward(x[: self._cells], slope.maps["tissue.map"])
        # A factor of 1 + e changes each force by e times itself.
        scene = with_scaled_forces(self._sight.scene, *np.exp(x[self._cells :]))
        totals = {f"probes.{n}.total": np.array(probe.total, np.float64) for n, probe in enumerate(scene.probes)}
        by_forces = sum(float(np.sum(slope.numbers[key] * total)) for key, total in totals.items())
        return float((left**2).sum()), np.append(by_cells, [by_forces] * (len(x) - self._cells))

    def best(self, start: Array) -> MapSolution:
        """Return the smoothest map that explains the observations."""
        near = self._linear(start)
        choice = near.choice(self._rough)
        for _ in range(MAX_WEIGHT_ROUNDS):
            before = choice.weight
            x = self._at(
                np.clip(near.x + np.clip(choice.step, -MAX_INITIAL_STEP, MAX_INITIAL_STEP), *self._limits),
                before,
                near.excess,
            )
            near = self._linear(x)
            choice = near.choice(self._rough)
            if 1 / WEIGHT_STABILITY < choice.weight / before < WEIGHT_STABILITY:
                break
        return MapSolution(x, near.errors(before, self._rough), near.excess, choice._replace(weight=before))

    def _linear(self, x: Array) -> Linearisation:
        """Linearise at x by differences of runs, one for each map cell."""
        known, before = self._observations.known, self.predict(x)[1]
        left = (before - self._observations.values)[known] / self._sigma
        jacobian = np.empty((left.size, len(x)))
        for n, change in enumerate(DIFFERENCE_STEP * np.eye(len(x))):
            jacobian[:, n] = (self.predict(x + change)[1] - before)[known] / (DIFFERENCE_STEP * self._sigma)
        information, slope = jacobian.T @ jacobian, jacobian.T @ left
        least = float(left @ left - slope @ np.linalg.pinv(information, hermitian=True) @ slope)
        excess = max(1.0, least / max(1, left.size - len(x)))
        return Linearisation(x, information / excess, slope / excess, excess)

    def _at(self, start: Array, weight: float, excess: float) -> Array:
        """Minimise for one weight, with chi-square divided by `excess`."""
        from scipy.optimize import minimize

        def cost(x: Array) -> tuple[float, Array]:
            (chi_square, slope), rough = self.misfit(x), self._rough @ x
            chi_square, slope = chi_square / excess, slope / excess
            return (chi_square + weight * float(x @ rough)) / 2, slope / 2 + weight * rough

        options = {"maxcor": LBFGS_MEMORY, "ftol": COST_TOLERANCE, "gtol": 0.0, "maxiter": MAX_ITERATIONS}
        bounds = list(zip(*self._limits, strict=True))
        found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return np.asarray(found.x, np.float64)


class MapGrid:
    """R x R cells of a map, and the cells of a sheet, interpolated as `sheet.map_factors` does.

    Args:
        resolution: R.
        cells: of the sheet, rows and cols.
    """

    def __init__(self, resolution: int, cells: tuple[int, int]) -> None:
        self.resolution = resolution
        # Linear between the centres of the fields, constant beyond.
        self._down, self._complement = (
            np.stack([np.interp(centres(n), centres(resolution), unit) for unit in np.eye(resolution)], axis=1)
            for n in cells
        )

    def factors(self, x: Array) -> Array:
        """Return the factors of the sheet's cells for the logs x of the map cells, shape (R^2,)."""
        return np.asarray(self._down @ np.exp(x).reshape(self.resolution, -1) @ self._complement.T)

    def backward(self, x: Array, by_cell: Array) -> Array:
        """Return the gradient of a loss by the logs x from that by the factors of the sheet's cells."""
        return np.asarray(np.exp(x) * (self._down.T @ by_cell @ self._complement).ravel())

    def roughness(self) -> Array:
        """Return L, shape (R^2, R^2): x L x is the sum of squared differences of neighbouring map cells."""
        steps, one = np.diff(np.eye(self.resolution), axis=0), np.eye(self.resolution)
        line = steps.T @ steps
        return np.kron(line, one) + np.kron(one, line)


def centres(count: int) -> Array:
    """Return the centres of `count` equal parts of a side, as fractions of it."""
    return (np.arange(count) + 0.5) / count
