"""The sheet in motion: Verlet steps by kernel 1, with few launches per frame, and the forces of probes at frames.

The state of a mass point is its displacement u_n = x_n - X and the last difference d_n = u_n - u_{n-1}; `terms.damping`
contains their update. This is the position form (eq. 6 to 9), rearranged to avoid cancellation: in f32 it resolves
small displacements of a large sheet.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, DeviceError, MsmError, Pause
from taichi_msm.model.loads import FrameLoad, Schedule, average_loads, decay
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import area_shares, axes, rest_positions, spacing
from taichi_msm.model.surface import surface_point
from taichi_msm.model.tool_force import probe_force
from taichi_msm.solver.arrays import NUMBER_BYTES, InitialData, SheetLayout, StepKernel
from taichi_msm.solver.contact_corrections import sum_corrections
from taichi_msm.solver.kernel_cpu import ScatterKernel
from taichi_msm.solver.kernel_gpu import STEPS_PER_LAUNCH, GatherKernel
from taichi_msm.solver.state import PeakForce, ProbeForces, Reading, State, TipForce
from taichi_msm.system.process import available_threads
from taichi_msm.system.runtime import Device, lanes
from taichi_msm.terms import build_terms
from taichi_msm.terms.base import (
    AREA_SHARE,
    COLUMN_ROWS,
    GAIN,
    HAS_LEFT,
    HAS_RIGHT,
    MOBILITY,
    REST_X,
    SQUARED_MOTION,
    KernelConfig,
)
from taichi_msm.terms.damping import coefficients
from taichi_msm.terms.loads import ProbeTerm, decay_parameters
from taichi_msm.terms.springs import MAX_STRAIN, MIN_STRAIN, SpringTerm

# With fewer mass points per worker, an additional worker costs more waiting time than it saves.
POINTS_PER_WORKER = 450

# A pass over a larger band takes several steps, so that the rows stay in the cache.
CACHE_BYTES = 3 << 17

# Largest numbers of steps times mass points, about 0.1 s of one core, and of steps in a launch. Ctrl-C is handled only
# between launches.
POINT_STEPS_PER_LAUNCH = 40_000_000
MAX_STEPS_PER_LAUNCH = 8192

# Number of rows of a load table; fewer rows hardly take less time to compute.
STEPS_PER_TABLE = 4096


def choose_layout(plan: Plan, device: Device, cores: int | None = None) -> SheetLayout:
    """Choose the memory layout of a sheet, its division among workers, and the configuration of its kernels.

    Args:
        plan: the plan.
        device: the device.
        cores: largest number of CPU cores; by default all available cores.

    Raises:
        DeviceError: when the device does not support the scene.
    """
    (rows, cols), fixed, precision = plan.scene.sheet.points, plan.fixed, plan.grid.precision
    fixed_rows = bool(fixed[0].all()), bool(fixed[-1].all())
    if plan.scene.time.at_rest:
        if device.arch != "cpu":
            raise DeviceError(f"--arch {device.arch}: time.motion: quasistatic runs on a CPU only; take --arch cpu")
        workers = 1
    elif device.arch == "cpu":
        # Workers wait by spinning, so more workers than cores would delay each other.
        cores = min(device.threads, available_threads() if cores is None else cores)
        workers = max(1, min(cores, rows * cols // POINTS_PER_WORKER, (rows - sum(fixed_rows)) // 2))
    else:
        workers = 0
    config = KernelConfig(precision, lanes(precision), plan.open_edges and plan.material.by_area, build_terms(plan))
    if device.arch == "vulkan" and precision == "f64" and any(slot.moves for slot in plan.slots):
        raise DeviceError(
            "--arch vulkan: has no exp in f64, which control points that move need; take time.precision: f32 without a "
            "tolerance or an estimate of the error, or --arch cpu"
        )
    # Per mass point a pass reads displacement, last difference and carried force, with three components each.
    fits = workers == 0 or rows // workers * cols * 9 * NUMBER_BYTES[precision] <= CACHE_BYTES
    depth = 1 if fits or config.reach > 1 else 8
    return SheetLayout(rows, cols, workers, depth, fixed_rows, config)


class Dynamics:
    """The sheet in motion.

    Args:
        plan: the plan.
        device: the device.
        layout: replaces the layout chosen by `choose_layout`, for tests.
        cores: largest number of CPU cores; by default all available cores.

    Attributes:
        plan: the current plan.
        layout: the memory layout, and the configuration of the kernels.
        steps_done: number of steps taken.
        launches: number of launches, each followed by a call of `pause`.
        inconsistent: whether an exception such as KeyboardInterrupt interrupted a launch. The number of steps taken is
            then unknown, and `advance`, `state` and `read` raise MsmError until `restart` is called.
    """

    def __init__(self, plan: Plan, device: Device, layout: SheetLayout | None = None, cores: int | None = None) -> None:
        self._device, self._given_layout, self._cores = device, layout, cores
        self.launches = 0
        self._sheet: StepKernel | None = None
        self.restart(plan)

    def restart(self, plan: Plan, state: State | None = None) -> None:
        """Restart with the same or another plan, without compilation if only coefficients differ.

        Args:
            plan: the plan.
            state: state to continue from, of a sheet with the same mass points and steps; by default the sheet at rest.
        """
        self.plan = plan
        self.layout = self._given_layout or choose_layout(plan, self._device, self._cores)
        self._real = np.dtype(np.float32 if self.layout.config.precision == "f32" else np.float64)
        self.steps_done, self.inconsistent = 0 if state is None else state.steps, True
        self._tabulate(STEPS_PER_TABLE)
        self._place(state)
        self.inconsistent = False

    def steer(self, plan: Plan) -> None:
        """Continue with other probes, with the same kernels and the same steps.

        Args:
            plan: a plan that differs in its probes only.

        Raises:
            ArgumentError: when the new probes require other kernels.
        """
        config, terms = self.layout.config, build_terms(plan)
        probes = next(term for term in terms if isinstance(term, ProbeTerm))
        if [tool.probe for tool in plan.tools] != [tool.probe for tool in self.plan.tools]:
            raise ArgumentError("probes: which of them have a path cannot change; restart with the new scene")
        for term in terms:
            compiled = config.get(type(term))
            if compiled and (reason := term.supports(compiled)):
                raise ArgumentError(f"probes: {reason}")
        if decay_parameters(plan) != decay_parameters(self.plan):
            self._moving.arrays.set_fields(self.layout.config.first_field(ProbeTerm), probes.fields(plan))
        self.plan = plan
        # A caller that steers usually steers again at the next frame, so the table has only the steps of one frame.
        self._tabulate(plan.grid.steps_per_frame)

    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        """Advance the sheet by a number of steps. A call at a frame resets the sums of contact corrections.

        Args:
            steps: number of steps.
            pause: function called after every launch. If it raises, another call of `advance` continues.

        Raises:
            MsmError: when the sheet is inconsistent.
        """
        points = self.layout.rows * self.layout.cols
        max_steps, depth = max(1, min(MAX_STEPS_PER_LAUNCH, POINT_STEPS_PER_LAUNCH // points)), self.layout.depth
        # A launch takes whole passes; a single pass may exceed the limit up to four times.
        max_steps = max_steps // depth * depth or min(depth, 4 * max_steps)
        if self.layout.workers == 0:
            max_steps = STEPS_PER_LAUNCH
        self._require_consistent()
        if steps and self.steps_done % self.plan.grid.steps_per_frame == 0:
            sum_corrections(self.layout, self._moving.arrays, clear=True)
        end = self.steps_done + steps
        while self.steps_done < end:
            count = min(max_steps, end - self.steps_done)
            self.inconsistent = True
            self._moving.advance(count, self._next_loads(count))
            self.steps_done += count
            self.inconsistent = False
            self.launches += 1
            pause()

    def compile(self) -> None:
        """Compile all kernels without taking a step."""
        self._moving.compile(self._loads)
        self.displacement()
        self.tool_forces()

    def displacement(self) -> NDArray[Any]:
        """Read the displacements x - X [m], shape (rows, cols, 3), in the scene's precision."""
        return self.read().displacement

    def state(self) -> State:
        """Read the state on which the next steps depend."""
        self._require_consistent()
        u, d = self._read_arrays(differences=False)[0], self._read_arrays(differences=True)[0]
        return State(self.steps_done, u, d, self._read_memory())

    def read(self) -> Reading:
        """Read the displacements and measure the sheet, in the scene's precision."""
        self._require_consistent()
        displacement, measures = self._read_arrays(differences=False)
        config, plan = self.layout.config, self.plan
        springs = measures[:, config.first_measure(SpringTerm) :]
        # The measures are (L^2 - L0^2) / L0^2.
        extremes = springs[:, MIN_STRAIN].min(), springs[:, MAX_STRAIN].max()
        shortest, longest = (math.sqrt(max(0.0, 1.0 + float(extreme))) for extreme in extremes)
        sums = measures.sum(axis=0, dtype=np.float64)
        energy = self._kinetic_energy(sums)
        for term in config.terms:
            first = config.first_measure(type(term))
            energy += term.energy(sums[first : first + len(term.reductions)], plan)
        return Reading(self.steps_done, displacement, shortest, longest, energy / 2)

    def _kinetic_energy(self, sums: NDArray[Any]) -> float:
        """Compute twice the kinetic energy [J] from the reduced measures."""
        return self.plan.material.mass * float(sums[SQUARED_MOTION]) / self.plan.grid.step**2

    def _read_arrays(self, *, differences: bool) -> tuple[NDArray[Any], NDArray[Any]]:
        """Read displacements or last differences [m], shape (rows, cols, 3), and the measures of every row."""
        rows, cols, config = self.layout.rows, self.layout.cols, self.layout.config
        values, measures = (
            np.empty((rows, cols, 3), self._real),
            np.empty((rows, config.first_measure(None)), self._real),
        )
        self._moving.read(differences, values, measures)
        return values, measures

    def tool_forces(self) -> NDArray[np.float64]:
        """Compute at a frame the mean force of each position-controlled tool since the previous frame.

        It is the sum over mass points, and the mean over steps, of m (1 + g h / 2) / h^2 times the contact correction,
        or of m / h^2 times the correction with backward differences of the damping; m is the mass of a mass point.

        Returns:
            Forces on the sheet [N], shape (tools, 3).
        """
        _, gain, _ = coefficients(self.plan)
        sums = sum_corrections(self.layout, self._moving.arrays, clear=False)
        return sums / (gain * self.plan.grid.steps_per_frame)

    def _read_memory(self) -> NDArray[Any]:
        """Read the numbers that terms remember, shape (numbers, rows, cols)."""
        fields = [self._moving.arrays.get_fields(n, 1) for n in self.layout.config.memory_fields]
        # Only some kernels step fixed mass points, whose memory has no effect.
        fields = [np.where(self.plan.fixed, 0, field).astype(self._real) for field in fields]
        return np.concatenate([np.empty((0, self.layout.rows, self.layout.cols), self._real), *fields])

    def _require_consistent(self) -> None:
        if self.inconsistent:
            raise MsmError("interrupted while steps were taken; restore a saved state, or restart the scene")

    def close(self) -> None:
        """Release the memory of the device."""
        self._sheet = None

    @property
    def _moving(self) -> StepKernel:
        assert self._sheet is not None, "it is closed"
        return self._sheet

    def _next_loads(self, count: int) -> NDArray[Any]:
        """Return the rows of the load table for the next steps, shape (count, columns)."""
        done = self.steps_done - self._first_tabled
        if done + count > len(self._loads):
            done = 0
            self._tabulate(max(count, STEPS_PER_TABLE))
        return self._loads[done : done + count]

    def _tabulate(self, count: int) -> None:
        """Compute the load table of the next steps."""
        self._first_tabled, self._loads = self.steps_done, self._table(self.steps_done, count)

    def _table(self, first: int, count: int) -> NDArray[Any]:
        """Compute the load table of steps first, ..., first + count - 1, shape (count, columns)."""
        _, gain, first_gain = coefficients(self.plan)
        table = self._columns(average_loads(self.plan, first, count), first)
        table[:, GAIN] = gain
        if first == 0:
            table[0, GAIN] = first_gain
        return table

    def _columns(self, loads: Schedule, first: int) -> NDArray[Any]:
        """Compute the load table from step `first` on, with a gain of 0, shape (steps, columns)."""
        config = self.layout.config
        table = np.zeros((len(loads.active), config.first_column(None)))
        for term in config.terms:
            first_column = config.first_column(type(term))
            table[:, first_column : first_column + term.column_count] = term.columns(self.plan, loads, first)
        # Loads too large for f32 become infinite; the next reading of the sheet detects it.
        with np.errstate(over="ignore"):
            return table.astype(self._real)

    def _place(self, state: State | None) -> None:
        """Allocate and fill the arrays of the sheet."""
        layout, plan, sheet = self.layout, self.plan, self.plan.scene.sheet
        moves, column, areas = ~plan.fixed, np.arange(layout.cols), area_shares(sheet)
        # One row of each kind: first, middle, last.
        kinds = [0, layout.rows // 2, -1]
        shares = areas[kinds] if layout.config.by_area else np.ones((3, layout.cols))
        by_column = np.empty((COLUMN_ROWS, layout.cols))
        by_column[MOBILITY : MOBILITY + 3] = moves[kinds] / shares
        # Springs along columns read the shares of a middle row even in a sheet of two rows.
        by_column[AREA_SHARE : AREA_SHARE + 3] = areas[0], 2 * areas[0], areas[-1]
        by_column[REST_X] = axes(sheet)[0]
        by_column[HAS_LEFT] = column > 0
        by_column[HAS_RIGHT] = column < layout.cols - 1
        constants = (
            *spacing(sheet),
            sheet.size[0] / 2,
            *(n for term in layout.config.terms for n in term.constants(plan)),
        )
        fields = np.concatenate([term.fields(plan) for term in layout.config.terms])
        if state is not None and len(state.memory):
            fields[layout.config.memory_fields] = state.memory
        stiffness = layout.config.require(SpringTerm).stiffness_array(plan)
        self._sheet = None  # Frees its memory before the new sheet is allocated.
        self._sheet = self._build_kernel(InitialData(np.array(constants), by_column, fields, stiffness, state))

    def _build_kernel(self, start: InitialData) -> StepKernel:
        """Build the kernel for the device."""
        kind: type[StepKernel] = ScatterKernel if self.layout.workers else GatherKernel
        return kind(self.layout, start)


Array = NDArray[np.float64]


class ForceRecorder:
    """Computes the forces of all probes on the sheet at the frames of a run, and their maxima.

    The force of a force-controlled probe at a frame is (percent(t) / 100) force times the sum of its decay factors over
    the mass points that are not fixed. `Dynamics.tool_forces` computes the force of a position-controlled tool.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        sheet = plan.scene.sheet
        self._loads = {n: FrameLoad(probe, sheet) for n, probe in enumerate(plan.scene.probes) if not probe.moved}
        # Sums of the decay factors of stationary control points, by probe.
        self._stationary: dict[int, float] = {}

    def at_rest(self) -> ProbeForces:
        """Compute the forces at the first frame."""
        plan, real = self._plan, np.float32 if self._plan.grid.precision == "f32" else np.float64
        forces = self._forces(0, rest_positions(plan.scene.sheet).astype(real), np.zeros((len(plan.tools), 3)))
        return ProbeForces(forces, tuple(PeakForce(0.0, tip.force) for tip in forces))

    def follow(self, before: ProbeForces, frame: int, position: NDArray[Any], tools: Array) -> ProbeForces:
        """Compute the forces at a frame and their maxima up to it.

        Args:
            before: forces at the previous frame.
            frame: number of the frame.
            position: positions of the mass points [m], shape (rows, cols, 3).
            tools: forces of the position-controlled tools [N], shape (tools, 3).
        """
        forces, time = self._forces(frame, position, tools), frame / self._plan.grid.frames_per_second
        peaks = zip(before.greatest, (PeakForce(time, tip.force) for tip in forces), strict=True)
        return ProbeForces(forces, tuple(max(pair, key=lambda peak: math.hypot(*peak.force)) for pair in peaks))

    def _forces(self, frame: int, position: NDArray[Any], tools: Array) -> tuple[TipForce, ...]:
        plan, moved = self._plan, iter(zip(self._plan.tools, tools.tolist(), strict=True))
        rate, sheet, forces = plan.grid.frames_per_second, plan.scene.sheet, []
        for index, probe in enumerate(plan.scene.probes):
            if probe.moved:
                tool, (x, y, z) = next(moved)
                forces.append(TipForce(index, tool.lowest_point(frame / rate), (x, y, z)))
                continue
            percent, at = self._loads[index].at(frame, rate)
            share = percent / 100 * self._decay_sum(index, at) if percent else 0.0
            x, y, z = probe_force(probe, sheet).force
            tip, _ = surface_point(position, plan.scene.render.refine, sheet, at)
            # Adding 0 turns -0 into 0.
            forces.append(TipForce(index, tuple(tip.tolist()), (share * x + 0.0, share * y + 0.0, share * z + 0.0)))
        return tuple(forces)

    def _decay_sum(self, index: int, at: Array) -> float:
        """Sum the decay factors of a probe over the mass points that are not fixed."""
        probe, sheet = self._plan.scene.probes[index], self._plan.scene.sheet
        if self._loads[index].moves:
            return float(decay(probe, sheet, at)[~self._plan.fixed].sum())
        if index not in self._stationary:
            self._stationary[index] = float(decay(probe, sheet)[~self._plan.fixed].sum())
        return self._stationary[index]
