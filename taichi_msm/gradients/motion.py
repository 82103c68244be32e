"""Adjoint of the time stepping, with checkpoints.

The forward run stores a checkpoint at the beginning of every segment. N steps have about sqrt(N / 2) segments, a small
sheet fewer. Then, from the last segment to the first, each one runs again and stores the displacements of all its
steps, and the adjoint is swept over them (`kernel_motion`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy import divergence
from taichi_msm.accuracy.divergence import DivergenceMonitor
from taichi_msm.arithmetic import Array
from taichi_msm.errors import DivergedError, Pause
from taichi_msm.gradients import kernel_motion as kernels
from taichi_msm.gradients.chain_rule import LoadGradient, SheetGradient
from taichi_msm.model.loads import average_loads
from taichi_msm.model.plan import Plan
from taichi_msm.solver.arrays import SheetLayout, from_lanes, to_lanes
from taichi_msm.solver.backoff import Backoff
from taichi_msm.solver.bands import MOMENT_ROWS
from taichi_msm.solver.dynamics import STEPS_PER_TABLE, Dynamics
from taichi_msm.solver.kernel_cpu import MAX_CHECKS, PAGE_BYTES
from taichi_msm.solver.state import largest_displacement
from taichi_msm.system.runtime import Device, Memory, compilation_options, write_vectors
from taichi_msm.terms.base import GAIN
from taichi_msm.terms.foundation import point_shares
from taichi_msm.terms.loads import ProbeTerm

# Memory of a segment's displacements up to which segments are lengthened, to save launches [bytes].
SEGMENT_BYTES = 64 * 2**20

# Number of times that a worker checks its neighbour before it gives up. It is larger than in the forward run, because
# giving up is more expensive: the kernel of the single worker that finishes the launch may not be compiled yet.
MAX_WAIT_CHECKS = 8 * MAX_CHECKS


def _segment_steps(steps: int, step_bytes: int) -> int:
    """Return the number of steps of a segment, for the displacements of a step of `step_bytes`.

    The memory of a segment and of all checkpoints, 2 `step_bytes` each, has the smallest sum where both are equal. A
    longer segment saves launches.
    """
    return min(steps, max(math.ceil(math.sqrt(2 * steps)), SEGMENT_BYTES // step_bytes))


def motion_bytes(plan: Plan) -> int:
    """Return the memory of the adjoint of a dynamic sheet, without the positions at the frames [bytes]."""
    steps, step_bytes = plan.grid.steps, 3 * 8 * math.prod(plan.scene.sheet.points)
    segment = _segment_steps(steps, step_bytes)
    return step_bytes * (segment + 2 * -(-steps // segment) + kernels.ADJOINT_PARTS + kernels.SUM_PARTS)


class MotionAdjoint:
    """Adjoint of a dynamic sheet on a CPU; its plan is in f64 with a stiffness map."""

    def __init__(self, plan: Plan, device: Device, layout: SheetLayout | None = None, cores: int | None = None) -> None:
        self._forward = Dynamics(plan, device, layout, cores)
        self._allocate()

    def restart(self, plan: Plan) -> None:
        """Restart with a plan of the same terms, in f64 with a stiffness map."""
        self._forward.restart(plan)
        if self._allocated_for != (self.layout, plan.grid.steps):
            self._allocate()

    @property
    def plan(self) -> Plan:
        """The current plan."""
        return self._forward.plan

    @property
    def layout(self) -> SheetLayout:
        """The memory layout, and the configuration of the kernels."""
        return self._forward.layout

    @property
    def _decay_parts(self) -> int:
        """Number of parts of `_derivatives` with `ProbeTerm.decay_gradients`, two per slot that does not move."""
        return 2 * self.layout.config.require(ProbeTerm).moves.count(False)

    def _allocate(self) -> None:
        plan = self.plan
        layout, memory = self.layout, Memory()
        row_bytes = layout.width * layout.config.lanes * 8
        self._segment = _segment_steps(plan.grid.steps, 3 * layout.rows * row_bytes)
        # The carried forces of two workers never share a page.
        self._carried_rows = 1 - (-PAGE_BYTES // row_bytes)
        self._worker_rows = (MOMENT_ROWS + self._carried_rows) * layout.workers
        sum_rows = -(-kernels.ROW_SUMS * layout.rows // layout.width)

        def scalar(rows: int) -> Any:
            return memory.array("f64", layout.config.lanes, rows * layout.width)

        def vector(rows: int) -> list[Any]:
            return [scalar(rows) for _ in range(3)]

        checkpoint_rows = -(-plan.grid.steps // self._segment) * layout.rows
        self._memory = memory
        # Displacements u and differences d at the beginning of every segment, three arrays each for x, y and z.
        self._checkpoints, self._checkpoint_differences = vector(checkpoint_rows), vector(checkpoint_rows)
        # Displacements at every step of a segment, and differences at its current step.
        self._history = vector(self._segment * layout.rows + self._worker_rows)
        self._differences = vector(layout.rows)
        # Adjoint state, and accumulated derivatives, see `kernel_motion`.
        self._adjoint = vector(kernels.ADJOINT_PARTS * layout.rows + self._worker_rows)
        self._derivatives = scalar((kernels.SUM_PARTS + self._decay_parts) * layout.rows + sum_rows)
        # Derivative of the loss with respect to the displacements of a frame.
        self._loss = vector(layout.rows)
        self._allocated_for, self._backoff = (layout, plan.grid.steps), Backoff()

    def run(self, pause: Pause = lambda: None) -> Array:
        """Run all steps and store the checkpoints.

        Return the displacements at every frame [m], shape (F + 1, rows, cols, 3).
        """
        plan, grid = self.plan, self.plan.grid
        monitor, frames = DivergenceMonitor(plan), np.zeros((grid.frames + 1, *plan.scene.sheet.points, 3))
        stops = {*range(0, grid.steps + 1, grid.steps_per_frame), *range(0, grid.steps, self._segment)}
        for n in sorted(stops):
            self._forward.advance(n - self._forward.steps_done, pause)
            if n % self._segment == 0 and n < grid.steps:
                sheet, first = self._forward.kernel.arrays, n // self._segment * self._step_entries
                self._copy_step(0, first, sheet.u, self._checkpoints)
                self._copy_step(0, first, sheet.d, self._checkpoint_differences)
            if n and n % grid.steps_per_frame == 0:
                reading = self._forward.read()
                fault = monitor.check_frame(reading)
                if fault:
                    message = divergence.format_message(grid.time(n), n, fault, exact=False)
                    raise DivergedError(message, n, grid.time(n), largest_displacement(reading.displacement)[:2])
                frames[n // grid.steps_per_frame] = reading.displacement
        return frames

    def backward(self, by_frame: Array, pause: Pause = lambda: None) -> tuple[SheetGradient, LoadGradient]:
        """Sweep the adjoint of the last `run` backward in time; `pause` is called after every launch.

        `by_frame` is the derivative of the loss with respect to the displacements at every frame, as `run` returns
        them.
        """
        grid, layout = self.plan.grid, self.layout
        gain = self.plan.step_coefficients.gain
        start = gain * self.plan.mobility[..., None] * by_frame[-1]
        for c in range(3):
            # p, an empty buffer, and q.
            parts = start[..., c], 0 * start[..., c], start[..., c]
            write_vectors(self._adjoint[c], to_lanes(layout, np.concatenate(parts)))
        zeros = np.zeros((kernels.SUM_PARTS * layout.rows, layout.cols))
        decay_gradients = layout.config.require(ProbeTerm).decay_gradients(self.plan).reshape(-1, layout.cols)
        write_vectors(self._derivatives, to_lanes(layout, np.concatenate([zeros, decay_gradients])))
        loads, self._buffer, work = LoadGradient(self.plan), kernels.BUFFERS, np.zeros(2)
        block = max(1, STEPS_PER_TABLE // self._segment) * self._segment
        for first in reversed(range(0, grid.steps, block)):
            work += self._sweep_block(first, min(first + block, grid.steps), by_frame, loads, pause)
        return self._sheet_gradient(gain, work), loads

    def _sweep_block(self, first: int, end: int, by_frame: Array, loads: LoadGradient, pause: Pause) -> Array:
        """Sweep backward over a block of segments.

        Return the work of the loads, the sum of p . force, over all steps but step 0, and in step 0, shape (2,).
        """
        table, h = self._forward.step_table(first, end - first), self.plan.grid.step
        by_slot = np.zeros((end - first, len(self.plan.slots), kernels.LOAD_DERIVATIVES))
        stop = end
        for begin in reversed(range(first, end, self._segment)):
            self._store_history(begin, table[begin - first : stop - first], pause)
            while stop > begin:
                # A launch is within a segment and a frame.
                frame = (stop - 1) // self.plan.grid.steps_per_frame * self.plan.grid.steps_per_frame
                start = max(begin, frame, stop - self._max_launch_steps)
                rows = slice(start - first, stop - first)
                by_slot[rows] = self._sweep(begin, stop, by_frame, table[rows])
                stop = start
                pause()
        if first == 0:
            # The first step has another gain.
            by_slot[0] *= table[0, GAIN] / self.plan.step_coefficients.gain
        if not self.plan.slots:
            return np.zeros(2)
        loads.add(lambda plan: average_loads(plan, first, end - first), by_slot, (first * h - h, end * h))
        work = (by_slot[..., :3] * average_loads(self.plan, first, end - first).strength).sum(axis=(1, 2))
        first_steps = 1 if first == 0 else 0
        return np.array([work[first_steps:].sum(), work[:first_steps].sum()])

    @property
    def _step_entries(self) -> int:
        """Number of entries of an array per step."""
        return self.layout.rows * self.layout.width

    def _copy_step(self, from_entry: int, to_entry: int, source: list[Any], target: list[Any]) -> None:
        with compilation_options():
            kernels.build_copy(self.layout.config)(self._step_entries, from_entry, to_entry, *source, *target)

    def _store_history(self, first: int, table: Array, pause: Pause) -> None:
        """Repeat a segment from its checkpoint with a table of loads, and store the displacements of all steps."""
        layout, count = self.layout, len(table) - 1
        checkpoint = first // self._segment * self._step_entries
        self._copy_step(checkpoint, 0, self._checkpoints, self._history)
        self._copy_step(checkpoint, 0, self._checkpoint_differences, self._differences)
        arrays = *self._history, *self._differences, *self._sheet_arrays
        for done in range(0, count, self._max_launch_steps):
            steps = min(self._max_launch_steps, count - done)
            sizes = self._sizes(steps, done, self._segment * layout.rows)
            self._launch(kernels.build_store, sizes, table[done : done + steps], *arrays)
            pause()

    def _sweep(self, first: int, end: int, by_frame: Array, table: Array) -> Array:
        """Sweep backward from step `end` over the steps of a table of loads, within the segment that begins at `first`.

        Return the derivatives with respect to the loads, shape (steps, slots, 5).
        """
        layout, grid, count = self.layout, self.plan.grid, len(table)
        frame, steps_after_frame = divmod(end - count, grid.steps_per_frame)
        with_loss = steps_after_frame == 0
        if with_loss:
            for c in range(3):
                write_vectors(self._loss[c], to_lanes(layout, by_frame[frame][..., c]))
            self._copy_step(0, kernels.LOSS * self._step_entries, self._loss, self._adjoint)
        moment_row = kernels.ADJOINT_PARTS * layout.rows
        sizes = self._sizes(count, end - first - 1, moment_row, buffer=self._buffer, with_loss=with_loss)
        columns = kernels.LOAD_DERIVATIVES * len(self.plan.slots)
        by_row = np.zeros((count, layout.rows, max(1, columns)))
        arrays = *self._adjoint, *self._history, *self._sheet_arrays, self._derivatives
        self._launch(kernels.build_sweep, sizes, table, by_row, *arrays)
        self._buffer = (self._buffer + count) % 2
        return by_row[..., :columns].sum(axis=1).reshape(count, -1, kernels.LOAD_DERIVATIVES)

    def _sheet_gradient(self, gain: float, work: Array) -> SheetGradient:
        """Collect the accumulated derivatives; `work` is the sum of `_sweep_block` over all blocks."""
        layout = self.layout
        rows, cols, derivatives = layout.rows, layout.cols, self._derivatives.to_numpy()
        parts = from_lanes(layout, derivatives, kernels.SUM_PARTS * rows).reshape(kernels.SUM_PARTS, rows, cols)
        first = (kernels.SUM_PARTS + self._decay_parts) * rows * layout.width
        # The sums are added over the lanes of a row, and then over the rows.
        row_sums = derivatives[first : first + kernels.ROW_SUMS * rows].reshape(rows, kernels.ROW_SUMS, -1)
        sums = row_sums.sum(axis=2).sum(axis=0)
        # In the order of `SPRING_PARTS` and `KEEP_SUM` in `kernel_motion`.
        along_rows, along_columns, diagonals, foundation = parts
        springs = along_rows[:, :-1], along_columns[:-1], diagonals[:-1, :-1]
        ends = kernels.TENSION_SUMS, kernels.BENDING_SUM, kernels.LAW_SUMS, kernels.FOUNDATION_LAW_SUMS
        keep, tensions, bending, stiffening, foundation_stiffening = np.split(sums, ends)
        foundation = foundation * point_shares(self.plan)
        gradient = SheetGradient(springs, tensions, foundation, float(bending[0]), stiffening, foundation_stiffening)
        gradient.keep = float(keep[0]) / gain
        gradient.gain = gradient.work(self.plan) + float(work[0])
        gradient.first_gain = float(work[1])
        return gradient

    @property
    def _sheet_arrays(self) -> tuple[Any, ...]:
        arrays = self._forward.kernel.arrays
        return arrays.constants, arrays.by_column, arrays.fields

    @property
    def _max_launch_steps(self) -> int:
        # 10 million steps of a mass point take about 0.1 s on one core.
        return max(1, 10_000_000 // (self.layout.rows * self.layout.cols))

    def _sizes(
        self, count: int, u_step: int, moment_row: int, *, buffer: int = 0, with_loss: bool = False
    ) -> NDArray[np.int64]:
        """Return the sizes of a launch in the order of `kernel_motion`, from COUNT on."""
        layout = self.layout
        carry = moment_row + MOMENT_ROWS * layout.workers
        return np.array([
            count, layout.workers, layout.rows, layout.strip, u_step, moment_row, carry, self._carried_rows,
            MAX_WAIT_CHECKS, buffer, with_loss,
        ])  # fmt: skip

    def _launch(self, build: Callable[..., Callable[..., None]], sizes: NDArray[np.int64], *arguments: Any) -> None:
        """Launch a kernel; if a worker times out, a single worker finishes the launch."""
        config, workers = self.layout.config, self.layout.workers
        progress = np.zeros(kernels.STRIDE * workers, np.int64)
        with compilation_options():
            if workers > 1 and not self._backoff.is_active:
                self._backoff.start_launch()
                build(config, parallel=True)(sizes, progress, *arguments)
                self._backoff.end_launch(timed_out=bool((progress[:: kernels.STRIDE] < sizes[0]).any()))
            if (progress[:: kernels.STRIDE] < sizes[0]).any():
                build(config, parallel=False)(sizes, progress, *arguments)
