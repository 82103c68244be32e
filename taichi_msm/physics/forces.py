"""The forces that the probes exert on the sheet at the frames of a run, and the greatest of them.

Of a probe with a force it is that at the frame, (percent(t) / 100) force times the sum of its decay over the points
that are not fixed. Of a tool that is moved it is the mean over the steps since the frame before (`Dynamics`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.deformed import touched
from taichi_msm.physics.lattice import rest_positions
from taichi_msm.physics.loads import FrameLoad, decay
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.probe_force import probe_force
from taichi_msm.physics.state import Felt, PeakForce, TipForce

Array = NDArray[np.float64]


class Gauge:
    """Tells the forces of a plan's probes at its frames."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        sheet = plan.scene.sheet
        self._loads = {n: FrameLoad(probe, sheet) for n, probe in enumerate(plan.scene.probes) if not probe.moved}
        # The sums of decays that stay the same, by probe.
        self._standing: dict[int, float] = {}

    def at_rest(self) -> Felt:
        """Give the forces at the first frame."""
        plan, real = self._plan, np.float32 if self._plan.grid.precision == "f32" else np.float64
        forces = self._forces(0, rest_positions(plan.scene.sheet).astype(real), np.zeros((len(plan.tools), 3)))
        return Felt(forces, tuple(PeakForce(0.0, one.force) for one in forces))

    def follow(self, before: Felt, frame: int, position: NDArray[Any], tools: Array) -> Felt:
        """Give the forces at a frame, and the greatest up to it.

        Args:
            before: those at the frame before.
            frame: its number.
            position: of the points [m], shape (rows, cols, 3).
            tools: the forces of the tools that are moved [N], shape (tools, 3).
        """
        forces, time = self._forces(frame, position, tools), frame / self._plan.grid.frames_per_second
        peaks = zip(before.greatest, (PeakForce(time, one.force) for one in forces), strict=True)
        return Felt(forces, tuple(max(pair, key=lambda peak: math.hypot(*peak.force)) for pair in peaks))

    def _forces(self, frame: int, position: NDArray[Any], tools: Array) -> tuple[TipForce, ...]:
        plan, moved = self._plan, iter(zip(self._plan.tools, tools.tolist(), strict=True))
        rate, sheet, forces = plan.grid.frames_per_second, plan.scene.sheet, []
        for index, probe in enumerate(plan.scene.probes):
            if probe.moved:
                tool, (x, y, z) = next(moved)
                forces.append(TipForce(index, tool.lowest(frame / rate), (x, y, z)))
                continue
            percent, at = self._loads[index].at(frame, rate)
            share = percent / 100 * self._decays(index, at) if percent else 0.0
            x, y, z = probe_force(probe, sheet).force
            tip, _ = touched(position, plan.scene.render.refine, sheet, at)
            # Not -0.
            forces.append(TipForce(index, tuple(tip.tolist()), (share * x + 0.0, share * y + 0.0, share * z + 0.0)))
        return tuple(forces)

    def _decays(self, index: int, at: Array) -> float:
        """Add up the decay of a probe over the points that are not fixed."""
        probe, sheet = self._plan.scene.probes[index], self._plan.scene.sheet
        if self._loads[index].moves:
            return float(decay(probe, sheet, at)[~self._plan.fixed].sum())
        if index not in self._standing:
            self._standing[index] = float(decay(probe, sheet)[~self._plan.fixed].sum())
        return self._standing[index]
