"""The sheet in motion: Verlet steps by kernel 1, with few launches per frame, and the forces of probes at frames.

`integrators` contains the update rule.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import MsmError, Pause
from taichi_msm.model.loads import FrameLoad, average_loads, decay
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import surface_point
from taichi_msm.model.time_grid import DTYPES
from taichi_msm.model.tool_force import probe_directions
from taichi_msm.solver.arrays import InitialData, SheetLayout, StepKernel
from taichi_msm.solver.contact_corrections import sum_corrections
from taichi_msm.solver.kernel_cpu import ScatterKernel
from taichi_msm.solver.kernel_gpu import STEPS_PER_LAUNCH, GatherKernel
from taichi_msm.solver.sheet_solver import SheetSolver
from taichi_msm.solver.state import PeakForce, ProbeForces, Reading, State, TipForce
from taichi_msm.terms.base import GAIN

# Limits of a launch, because Ctrl-C is handled only between launches: the number of steps times mass points, about
# 0.1 s of one core, and the number of steps.
POINT_STEPS_PER_LAUNCH = 40_000_000
MAX_STEPS_PER_LAUNCH = 8192

# Number of steps in a load table; a shorter one takes hardly less time to compute.
STEPS_PER_TABLE = 4096


class Dynamics(SheetSolver[StepKernel]):
    """The sheet in motion.

    An exception such as KeyboardInterrupt during a launch leaves the sheet inconsistent, because the number of steps
    taken is then unknown.
    """

    @staticmethod
    def _build_kernel(plan: Plan, layout: SheetLayout, start: InitialData) -> StepKernel:  # noqa: ARG004
        return (ScatterKernel if layout.workers else GatherKernel)(layout, start)

    def _begin(self, state: State | None) -> None:
        super()._begin(state)
        self._first_tabled, self._loads = 0, np.empty((0, 0))

    def steer(self, plan: Plan) -> None:
        super().steer(plan)
        # The next frame is usually steered again, so the table has the steps of one frame only.
        self._tabulate(plan.grid.steps_per_frame)

    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        points = self.layout.rows * self.layout.cols
        max_steps, depth = max(1, min(MAX_STEPS_PER_LAUNCH, POINT_STEPS_PER_LAUNCH // points)), self.layout.depth
        # A launch takes whole passes; a single pass may exceed the limit up to four times.
        max_steps = max_steps // depth * depth or min(depth, 4 * max_steps)
        if self.layout.workers == 0:
            max_steps = STEPS_PER_LAUNCH
        self._require_consistent()
        # The forces of tools at a frame are means over the steps since the previous frame.
        if steps and self.steps_done % self.plan.grid.steps_per_frame == 0:
            sum_corrections(self.layout, self.kernel.arrays, clear=True)
        end = self.steps_done + steps
        while self.steps_done < end:
            count = min(max_steps, end - self.steps_done)
            self.inconsistent = True
            self.kernel.advance(count, self._next_loads(count))
            self.steps_done += count
            self.inconsistent = False
            pause()

    def compile(self) -> None:
        self.kernel.compile(self._next_loads(1))
        self.displacement()
        self.tool_forces()

    def state(self) -> State:
        self._require_consistent()
        u, d = (self._read_arrays(differences=differences)[0] for differences in (False, True))
        return State(self.steps_done, u, d, self._read_memory())

    def read(self) -> Reading:
        self._require_consistent()
        return self._measure(moving=True)

    def tool_forces(self) -> NDArray[np.float64]:
        """Compute the mean force of each position-controlled tool since the previous frame [N], shape (tools, 3).

        A force displaces a mass point by the gain of the steps times the force; contact displaced them by corrections.
        """
        sums = sum_corrections(self.layout, self.kernel.arrays, clear=False)
        return sums / (self.plan.step_coefficients.gain * self.plan.grid.steps_per_frame)

    def step_table(self, first: int, count: int) -> NDArray[Any]:
        """Return the load table of `count` consecutive steps from the step `first` on, shape (count, columns)."""
        table = self._load_table(average_loads(self.plan, first, count), first)
        _, table[:, GAIN], first_gain = self.plan.step_coefficients
        if first == 0:
            table[0, GAIN] = first_gain
        return table

    def _require_consistent(self) -> None:
        if self.inconsistent:
            raise MsmError("interrupted while steps were taken; restore a saved state, or restart the scene")

    def _next_loads(self, count: int) -> NDArray[Any]:
        """Return the rows of the load table for the next steps, shape (count, columns)."""
        done = self.steps_done - self._first_tabled
        if done + count > len(self._loads):
            done = 0
            self._tabulate(max(count, STEPS_PER_TABLE))
        return self._loads[done : done + count]

    def _tabulate(self, count: int) -> None:
        self._first_tabled, self._loads = self.steps_done, self.step_table(self.steps_done, count)


class ForceRecorder:
    """Computes the forces of all probes on the sheet at the frames of a run, and their maxima.

    The force of a force-controlled probe is percent(t) / 100 times its `force` times the sum of its decay factors over
    the mass points that are not fixed. The solver computes the forces of position-controlled tools.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        sheet = plan.scene.sheet
        self._loads = {n: FrameLoad(probe, sheet) for n, probe in enumerate(plan.scene.probes) if not probe.moved}
        # Sums of the decay factors of stationary control points, by probe.
        self._stationary: dict[int, float] = {}

    def at_start(self) -> ProbeForces:
        """Compute the forces at the first frame."""
        plan = self._plan
        position = rest_positions(plan.scene.sheet).astype(DTYPES[plan.grid.precision])
        forces = self._forces(0, position, np.zeros((len(plan.tools), 3)))
        return ProbeForces(forces, tuple(PeakForce(0.0, tip.force) for tip in forces))

    def at_frame(self, before: ProbeForces, frame: int, position: NDArray[Any], tool_forces: Array) -> ProbeForces:
        """Return the forces at a frame and their maxima up to it, from those at the previous frame.

        The positions [m] have the shape (rows, cols, 3), the forces of `SheetSolver.tool_forces` [N] (tools, 3).
        """
        forces, time = self._forces(frame, position, tool_forces), frame / self._plan.grid.frames_per_second
        peaks = zip(before.greatest, (PeakForce(time, tip.force) for tip in forces), strict=True)
        return ProbeForces(forces, tuple(max(pair, key=lambda peak: math.hypot(*peak.force)) for pair in peaks))

    def _forces(self, frame: int, position: NDArray[Any], tool_forces: Array) -> tuple[TipForce, ...]:
        plan, moved = self._plan, iter(zip(self._plan.tools, tool_forces.tolist(), strict=True))
        rate, sheet, forces = plan.grid.frames_per_second, plan.scene.sheet, []
        for index, probe in enumerate(plan.scene.probes):
            if probe.moved:
                tool, (x, y, z) = next(moved)
                forces.append(TipForce(index, tool.lowest_point(frame / rate), (x, y, z)))
                continue
            percent, at = self._loads[index].at(frame, rate)
            factor = percent / 100 * self._decay_sum(index, at) if percent else 0.0
            x, y, z = probe_directions(probe, sheet, at[None])[0].tolist()
            tip, _ = surface_point(position, plan.scene.render.refine, sheet, at)
            # Adding 0 turns -0 into 0.
            forces.append(TipForce(index, tuple(tip.tolist()), (factor * x + 0.0, factor * y + 0.0, factor * z + 0.0)))
        return tuple(forces)

    def _decay_sum(self, index: int, at: Array) -> float:
        probe = self._plan.scene.probes[index]
        if self._loads[index].moves:
            return float(decay(probe, self._plan, at)[~self._plan.fixed].sum())
        if index not in self._stationary:
            self._stationary[index] = float(decay(probe, self._plan)[~self._plan.fixed].sum())
        return self._stationary[index]
