"""Energy that grows although nothing presses any more, as steps that are too long for compressed springs add it.

The energy is measured at x_n and at the velocity half a step before. For a mode of frequency w this differs from what
Verlet's method keeps by a factor between 1 - w h / 2 and 1 + w h / 2, and w h / 2 is at most r = h / h_stable. So an
energy that is more than (1 + r) / (1 - r) times as large as an earlier one has grown (Hairer, Lubich and Wanner 2003,
Acta Numerica 12, 399-450, on the energy that is kept).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from taichi_msm.model.plan import Plan
from taichi_msm.solver.state import Reading, RunProgress
from taichi_msm.terms.foundation import point_shares

# Less than this share of the largest energy so far is not worth a warning, nor what rounding adds to it.
NEGLIGIBLE = 1e-3


class EnergyGrowth:
    """Follows the energy of a plan's sheet, with that of a foundation, from the end of the last load and path on."""

    def __init__(self, plan: Plan) -> None:
        self._released = release_time(plan) + plan.grid.step
        self._rate, self._stiffness = plan.grid.frames_per_second, np.zeros(())
        if plan.material.always_active and plan.material.virtual > 0:
            self._stiffness = plan.material.virtual * point_shares(plan)

    def follow(self, before: RunProgress, reading: Reading, frame: int) -> tuple[float, float]:
        """Compare the energy of a frame with that of earlier ones.

        Args:
            before: progress at the frame before.
            reading: of this frame.
            frame: its number.

        Returns:
            The least energy at a frame since the release [J], 0 before it; the largest growth since, a factor.
        """
        least, growth = before.least_energy, before.energy_growth
        if frame / self._rate < self._released:
            return least, growth
        square = np.einsum("ijk,ijk->ij", reading.displacement, reading.displacement, dtype=np.float64)
        energy = reading.energy + float((self._stiffness * square).sum()) / 2
        if least > 0 and energy > max(least, NEGLIGIBLE * before.peak):
            growth = max(growth, energy / least)
        return min(least or energy, energy), growth


def release_time(plan: Plan) -> float:
    """Return the time when the last load and the last path end [s]; infinite if a load never does."""
    ends = [tool.times[-1] for tool in plan.tools]
    for probe in plan.scene.probes:
        if not probe.moved and any(percent for _, percent in probe.load):
            ends.append(probe.load[-1][0] if probe.load[-1][1] == 0 else math.inf)
    return float(max(ends, default=0.0))


def growth_notes(plan: Plan, progress: RunProgress) -> Iterator[str]:
    """Warn of energy that has grown without a load by more than steps of this length let it oscillate."""
    ratio = plan.grid.step / plan.stable_step
    if progress.energy_growth * (1 - ratio) > 1 + ratio:
        yield (
            f"the energy grew {progress.energy_growth:.3g} times after {release_time(plan):.6g} s, when no probe was "
            "active any more: the steps are too long for springs that were pressed together, and the motion from "
            f"there on means nothing; try time.step: {plan.grid.step / 2:.6g}, press less, or take more damping"
        )
