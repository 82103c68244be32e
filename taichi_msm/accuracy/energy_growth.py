"""Growth of the energy after the last load, a sign of time steps that are too long for compressed springs.

The energy is measured with the position x_n and the velocity half a step before. For a mode of frequency w it differs
from the energy that Verlet's method conserves by a factor between 1 - w h / 2 and 1 + w h / 2, where w h / 2 is at most
r = h / h_stable. Hence an energy more than (1 + r) / (1 - r) times an earlier one has grown (Hairer, Lubich and Wanner
2003, Acta Numerica 12, 399-450, on the conserved energy).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from taichi_msm.model.plan import Plan
from taichi_msm.solver.state import Reading, RunProgress
from taichi_msm.terms.foundation import foundation_energy, point_shares


class EnergyGrowth:
    """Monitor of the energy of a sheet and its foundation, from the end of the last load and path on."""

    def __init__(self, plan: Plan) -> None:
        self._released = release_time(plan) + plan.grid.step
        if plan.material.relaxation:
            self._released = math.inf  # what relaxed returns some of its energy
        self._rate, self._material, self._stiffness = plan.grid.frames_per_second, plan.material, np.zeros((1, 1))
        if plan.material.always_active and plan.material.virtual > 0:
            self._stiffness = plan.material.virtual * point_shares(plan)

    def update(self, before: RunProgress, reading: Reading, frame: int) -> tuple[float, float]:
        """Compare the energy of a frame with that of earlier frames; `before` is the progress at the previous frame.

        Returns:
            The smallest energy of a frame since the release [J], 0 before it, and the largest growth factor since then.
        """
        least, growth = before.least_energy, before.energy_growth
        if frame / self._rate < self._released:
            return least, growth
        foundation = foundation_energy(self._material, self._stiffness, reading.displacement.astype(np.float64))
        energy = reading.energy + foundation
        # Rounding may add energy; below 1e-3 of the largest energy it does not affect the result.
        if least > 0 and energy > max(least, 1e-3 * before.peak):
            growth = max(growth, energy / least)
        return min(least or energy, energy), growth


def release_time(plan: Plan) -> float:
    """Return the time at which all loads and paths have ended [s], infinite for a load without end."""
    ends = [tool.times[-1] for tool in plan.tools]
    for probe in plan.scene.probes:
        if not probe.moved and any(percent for _, percent in probe.load):
            ends.append(probe.load[-1][0] if probe.load[-1][1] == 0 else math.inf)
    return float(max(ends, default=0.0))


def energy_growth_warnings(plan: Plan, progress: RunProgress) -> Iterator[str]:
    """Warn if the energy grew without a load by more than it oscillates with this time step."""
    ratio = plan.grid.step / plan.stable_step
    if progress.energy_growth * (1 - ratio) > 1 + ratio:
        yield (
            f"the energy grew {progress.energy_growth:.3g} times after {release_time(plan):.6g} s, when no probe was "
            "active any more: the steps are too long for springs that were pressed together, and the motion from "
            f"there on is invalid; try time.step: {plan.grid.step / 2:.6g}, press less, or take more damping"
        )
