"""Measured forces of tools on the sheet, as in a forces.csv."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting import observation
from taichi_msm.fitting.observation import Array, Observation, ObservationModel
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene

# Units of force per newton, and the largest deviation of a ratio from them, as a factor.
UNITS_PER_NEWTON, MAX_UNIT_FACTOR = {"mN": 1000.0, "gf": 101.97, "kN": 0.001}, 3.0


@dataclass(frozen=True, eq=False)
class Forces(Observation):
    """Forces [N] with independent errors of known sigma; values of shape (rows, components), times of shape (rows,)."""

    noun: ClassVar[str] = "forces"
    unit: ClassVar[str] = "N"
    is_independent: ClassVar[bool] = True

    sigma: float | Array

    def signal(self, scene: Scene) -> float:
        """Return the root mean square of the forces."""
        return float(np.sqrt(np.nanmean(self.values**2)))

    def fits_well(self, residuals: Array, deviation: float, signal: float) -> bool:
        """Return whether the residuals are small, in sigma or as a share of the forces."""
        limit = (observation.MAX_RESIDUAL_SHARE * signal) ** 2
        limit = max(limit, observation.MAX_RESIDUAL_SIGMAS**2 * np.mean(np.square(self.sigma)))
        return float(np.mean(residuals**2)) <= limit

    def summary(self, residuals: Array, sigma: float | Array) -> dict[str, Any]:
        """Return residual and sigma of the forces."""
        return {"residual_force": float(np.sqrt(np.mean(residuals**2))), "sigma_force": float(np.mean(sigma))}

    def factor_note(self, predicted: Array) -> str:
        """Describe a common factor of measured and predicted forces, or return an empty string."""
        square = float(np.nansum(predicted**2 * self.known))
        factor = float(np.nansum(predicted * self.values)) / square if square else 1.0
        return f", which are {factor:.3g} times the predicted ones" if abs(factor - 1) > 0.02 else ""


class ForceModel(ObservationModel):
    """Map from a run to the forces of its tools at the measured times."""

    def __init__(self, scene: Scene, observed: ToolForces, frames: int) -> None:
        self._probe, self._shares = observed.probe, observation.time_weights(scene, observed.time, frames)

    def record(self, simulation: Simulation) -> Array:
        """Return the force of every probe in the current frame [N], shape (probes, 3)."""
        return np.array([tool.force for tool in simulation.forces()])

    def predict(self, recorded: Array) -> Array:
        """Return the forces of all rows [N], shape (rows, 3), from those of all frames."""
        rows, at_times = len(self._probe), self._shares @ recorded.reshape(len(recorded), -1)
        return np.asarray(at_times.reshape(rows, -1, 3)[np.arange(rows), self._probe])


@dataclass(frozen=True, eq=False)
class ToolForces(Forces):
    """Forces of tools on the sheet, of shape (rows, 3)."""

    probe: NDArray[np.intp]  # index of the tool, shape (rows,)

    def build_model(self, scene: Scene, frames: int) -> ForceModel:
        """Build the map from a run of a scene; `frames`: their number, from the first one."""
        return ForceModel(scene, self, frames)

    def opposed(self, scene: Scene, *predictions: Array) -> Iterator[str]:
        """Yield components that all predictions have with the other sign."""
        for axis in observation.opposed_axes(self.values, predictions, self.sigma):
            fault = "is it the force on the tool? give the force on the sheet, of the other sign"
            yield f"{self.name}: force_{'xyz'[axis]}: acts against the scene's; {fault}"

    def unit_faults(self, *predictions: Array) -> Iterator[str]:
        """Yield the unit of force that explains the ratio of measured to predicted forces, for all predictions."""
        ratios = [self._ratio(predicted) for predicted in predictions]
        for unit, per_newton in UNITS_PER_NEWTON.items():
            if all(1 / MAX_UNIT_FACTOR < ratio / per_newton < MAX_UNIT_FACTOR for ratio in ratios):
                fault = f"{ratios[0]:.3g} times those of the scene where the search begins; are they in {unit}?"
                remedy = f"divide them by {per_newton:g}" if per_newton > 1 else f"multiply them by {1 / per_newton:g}"
                yield f"{self.name}: forces: {fault} {remedy}, or start nearer by --set"
                return

    def _ratio(self, predictions: Array) -> float:
        """Return the ratio of measured to predicted forces; 0: insignificant, or not parallel."""
        measured, predicted = self.values[self.known], predictions[self.known]
        lengths = float(np.linalg.norm(measured)), float(np.linalg.norm(predicted))
        is_small = max(lengths) < observation.MIN_SIGMAS * self.sigma * np.sqrt(len(measured))
        if len(measured) < observation.MIN_COUNT or is_small:
            return 0.0
        is_parallel = measured @ predicted > -observation.MAX_COSINE * lengths[0] * lengths[1] > 0
        return lengths[0] / lengths[1] if is_parallel else 0.0
