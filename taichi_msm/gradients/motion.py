"""The derivatives of a loss by what the steps of a moving sheet are made of.

A forward run keeps the state every so many steps, about the root of their number, or more if the sheet is small.
Backward, each segment between two such states is run again, all of its shapes are kept, and the adjoint is swept over
them (`kernel_adjoint`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy import divergence
from taichi_msm.accuracy.divergence import DivergenceMonitor
from taichi_msm.errors import DivergedError, Pause
from taichi_msm.gradients.chain_rule import LoadGradient, SheetGradient
from taichi_msm.gradients.kernel_motion import (
    ADJOINT_PARTS,
    BENDING_SUM,
    BUFFERS,
    FOUNDATION_PART,
    KEEP_SUM,
    LOAD_DERIVATIVES,
    LOSS,
    ROW_SUMS,
    SPRING_PARTS,
    STRIDE,
    SUM_PARTS,
    TENSION_SUMS,
    adjoint_kernels,
    copy_kernel,
)
from taichi_msm.model.loads import schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import area_shares
from taichi_msm.solver.arrays import in_lanes, out_of_lanes
from taichi_msm.solver.bands import MOMENTS
from taichi_msm.solver.dynamics import STEPS_PER_TABLE, Dynamics
from taichi_msm.solver.kernel_cpu import PAGE, PATIENCE
from taichi_msm.solver.state import State, farthest
from taichi_msm.system.runtime import Memory, our_compilation, write
from taichi_msm.terms.base import GAIN
from taichi_msm.terms.damping import coefficients
from taichi_msm.terms.foundation import point_shares
from taichi_msm.terms.loads import ProbeTerm

# A segment may take so much, as each costs some launches.
SEGMENT_BYTES = 64 * 2**20

# How many times a worker looks for its neighbour before it gives up: longer than forward, as one alone takes all the
# rest of the launch, and its kernel may have to be compiled.
MAX_WAIT_LOOKS = 8 * PATIENCE

# A launch of the adjoint takes no more steps times points than this, about 0.1 s of one core.
POINT_STEPS_PER_LAUNCH = 10_000_000

Array = NDArray[np.float64]


def segment_steps(steps: int, shape_bytes: int) -> int:
    """Return the number of steps of a segment; all beginnings, two shapes each, then take about as much memory."""
    return min(steps, max(math.ceil(math.sqrt(2 * steps)), SEGMENT_BYTES // shape_bytes))


def motion_bytes(plan: Plan) -> int:
    """Estimate the memory of the adjoint of a sheet in motion, without that of the frames [bytes]."""
    steps, shape_bytes = plan.grid.steps, 3 * 8 * math.prod(plan.scene.sheet.points)
    segment = segment_steps(steps, shape_bytes)
    return shape_bytes * (segment + 2 * -(-steps // segment) + ADJOINT_PARTS + SUM_PARTS)


class _Arrays(NamedTuple):
    """The arrays of the adjoint; those of three, for x, y and z."""

    # kept, last: displacements and last differences at the beginning of every segment
    kept: list[Any]
    last: list[Any]
    # shapes, moving: displacements in a segment, one shape after the other, and the last difference
    shapes: list[Any]
    moving: list[Any]
    adjoint: list[Any]  # see `kernel_adjoint`
    loss: list[Any]  # the derivative by the shape of a frame
    found: Any  # what is added up


class MotionAdjoint(Dynamics):
    """A sheet in motion, and its adjoint; its plan has a map of the stiffness, in f64."""

    # What memory was taken for.
    _allocated: tuple[Any, ...] = ()

    def restart(self, plan: Plan, state: State | None = None) -> None:
        """Begin again with the same scene or another, as `Dynamics` does."""
        super().restart(plan, state)
        self._slopes = self.structure.code.require(ProbeTerm).slopes(plan)
        key = self.structure, plan.grid.steps, len(self._slopes)
        if key != self._allocated:
            self._allocate()
            self._allocated = key

    def _allocate(self) -> None:
        """Take memory for a layout, a number of steps and of standing slots."""
        plan = self.plan
        layout, memory = self.structure, Memory()
        row_bytes = layout.width * layout.code.lanes * 8
        self._segment = segment_steps(plan.grid.steps, 3 * layout.rows * row_bytes)
        # No two workers write to one page of what they carry.
        self._carried_rows = 1 - (-PAGE // row_bytes)
        self._extra = (MOMENTS + self._carried_rows) * layout.workers
        sums = -(-ROW_SUMS * layout.rows // layout.width)

        def rows(count: int) -> Any:
            return memory.array("f64", layout.code.lanes, count * layout.width)

        def three(count: int) -> list[Any]:
            return [rows(count) for _ in range(3)]

        kept = -(-plan.grid.steps // self._segment) * layout.rows
        self._memory = memory
        self._arrays = _Arrays(
            three(kept), three(kept),
            three(self._segment * layout.rows + self._extra), three(layout.rows),
            three(ADJOINT_PARTS * layout.rows + self._extra), three(layout.rows),
            rows((SUM_PARTS + 2 * len(self._slopes)) * layout.rows + sums),
        )  # fmt: skip

    def run(self, pause: Pause = lambda: None) -> Array:
        """Take all steps anew, with pauses; returns the displacements of every frame [m], shape (F + 1, rows, cols, 3).

        Raises:
            DivergedError: when the sheet diverges.
        """
        plan, grid = self.plan, self.plan.grid
        monitor, frames = DivergenceMonitor(plan), np.zeros((grid.frames + 1, *plan.scene.sheet.points, 3))
        marks = {*range(0, grid.steps + 1, grid.steps_per_frame), *range(0, grid.steps, self._segment)}
        for n in sorted(marks):
            self.advance(n - self.steps_done, pause)
            if n % self._segment == 0 and n < grid.steps:
                self._keep(n // self._segment)
            if n and n % grid.steps_per_frame == 0:
                reading = self.read()
                fault = monitor.check_frame(reading)
                if fault:
                    said = divergence.format_message(grid.time(n), n, fault, exact=False)
                    raise DivergedError(said, n, grid.time(n), farthest(reading.displacement)[:2])
                frames[n // grid.steps_per_frame] = reading.displacement
        return frames

    def backward(self, by_frame: Array, pause: Pause = lambda: None) -> tuple[SheetGradient, LoadGradient]:
        """Sweep the adjoint of the last `run`; by_frame: derivative of the loss by what that returned."""
        grid, layout, arrays = self.plan.grid, self.structure, self._arrays
        _, gain, _ = coefficients(self.plan)
        shares = area_shares(self.plan.scene.sheet) if layout.code.by_area else np.ones((layout.rows, layout.cols))
        start = gain * (~self.plan.fixed / shares)[..., None] * by_frame[-1]
        for c in range(3):
            # p, an empty buffer, and q.
            parts = start[..., c], 0 * start[..., c], start[..., c]
            write(arrays.adjoint[c], in_lanes(layout, np.concatenate(parts)))
        none = np.zeros((SUM_PARTS * layout.rows, layout.cols))
        slopes = self._slopes.reshape(-1, layout.cols)
        write(arrays.found, in_lanes(layout, np.concatenate([none, slopes])))
        loads, self._buffer, totals = LoadGradient(self.plan), BUFFERS, np.zeros(2)
        block = max(1, STEPS_PER_TABLE // self._segment) * self._segment
        for first in reversed(range(0, grid.steps, block)):
            totals += self._sweep_block(first, min(first + block, grid.steps), by_frame, loads, pause)
        return self._collect(gain, totals), loads

    def _sweep_block(self, first: int, end: int, by_frame: Array, loads: LoadGradient, pause: Pause) -> Array:
        """Sweep back over some segments; returns the work of the loads on the adjoint after step 0, and in step 0."""
        table, h = self._table(first, end - first), self.plan.grid.step
        by_slot = np.zeros((end - first, len(self.plan.slots), LOAD_DERIVATIVES))
        at = end
        for begin in reversed(range(first, end, self._segment)):
            self._record(begin, table[begin - first : at - first], pause)
            while at > begin:
                to = self._last_frame(begin, at)
                rows = slice(to - first, at - first)
                by_slot[rows] = self._sweep(begin, at, by_frame, table[rows])
                at = to
                pause()
        if first == 0:
            # The first step has another gain.
            by_slot[0] *= table[0, GAIN] / coefficients(self.plan)[1]
        if not self.plan.slots:
            return np.zeros(2)
        loads.add(lambda plan: schedule(plan, first, end - first), by_slot, (first * h - h, end * h))
        work = (by_slot[..., :3] * schedule(self.plan, first, end - first).strength).sum(axis=(1, 2))
        return np.array([work[int(first == 0) :].sum(), work[: int(first == 0)].sum()])

    def _keep(self, segment: int) -> None:
        """Keep the state at the beginning of a segment."""
        arrays, first = self._arrays, segment * self._entries
        self._copy_entries(0, first, self._moving.arrays.u, arrays.kept)
        self._copy_entries(0, first, self._moving.arrays.d, arrays.last)

    @property
    def _entries(self) -> int:
        """Entries of a shape."""
        return self.structure.rows * self.structure.width

    def _copy_entries(self, source: int, target: int, of: list[Any], to: list[Any]) -> None:
        """Copy a shape from one entry of three arrays to one of others."""
        with our_compilation():
            copy_kernel(self.structure.code)(self._entries, source, target, *of, *to)

    def _record(self, first: int, table: Array, pause: Pause) -> None:
        """Take the steps of a segment, from its first one on, and keep every shape; table: of its loads."""
        layout, arrays, count = self.structure, self._arrays, len(table) - 1
        begins = first // self._segment * self._entries
        self._copy_entries(begins, 0, arrays.kept, arrays.shapes)
        self._copy_entries(begins, 0, arrays.last, arrays.moving)
        most = self._most_steps()
        for done in range(0, count, most):
            steps = min(most, count - done)
            sizes = self._sizes(steps, done, self._segment * layout.rows)
            self._launch(0, sizes, table[done : done + steps], *arrays.shapes, *arrays.moving, *self._sheet_arrays)
            pause()

    def _last_frame(self, first: int, end: int) -> int:
        """Tell how far back a launch goes from step `end` of a segment: to the last frame before it at most."""
        frame = (end - 1) // self.plan.grid.steps_per_frame * self.plan.grid.steps_per_frame
        return max(first, frame, end - self._most_steps())

    def _sweep(self, first: int, end: int, by_frame: Array, table: Array) -> Array:
        """Sweep back from step `end` of the segment that begins with step `first`, over the steps of a table.

        Returns:
            Derivatives by the force and the control point of every slot in every step, shape (steps, slots, 5).
        """
        layout, arrays, grid, count = self.structure, self._arrays, self.plan.grid, len(table)
        frame, beyond = divmod(end - count, grid.steps_per_frame)
        if not beyond:
            self._put(by_frame[frame])
        sizes = self._sizes(count, end - first - 1, ADJOINT_PARTS * layout.rows, not beyond)
        pushes = np.zeros((count, layout.rows, max(1, LOAD_DERIVATIVES * len(self.plan.slots))))
        self._launch(1, sizes, table, pushes, *arrays.adjoint, *arrays.shapes, *self._sheet_arrays, arrays.found)
        self._buffer = (self._buffer + count) % 2
        return pushes[..., : LOAD_DERIVATIVES * len(self.plan.slots)].sum(axis=1).reshape(count, -1, LOAD_DERIVATIVES)

    def _put(self, slopes: Array) -> None:
        """Put the derivative by the shape of a frame where the kernel adds it."""
        for c in range(3):
            write(self._arrays.loss[c], in_lanes(self.structure, slopes[..., c]))
        self._copy_entries(0, LOSS * self._entries, self._arrays.loss, self._arrays.adjoint)

    def _collect(self, gain: float, totals: Array) -> SheetGradient:
        """Add up what was found."""
        layout = self.structure
        rows, cols, found = layout.rows, layout.cols, self._arrays.found.to_numpy()
        every = out_of_lanes(layout, found, SUM_PARTS * rows).reshape(SUM_PARTS, rows, cols)
        first = (SUM_PARTS + 2 * len(self._slopes)) * rows * layout.width
        # Row by row, each in the order of its lanes.
        sums = found[first : first + ROW_SUMS * rows].reshape(rows, ROW_SUMS, -1).sum(axis=2).sum(axis=0)
        springs = every[SPRING_PARTS][:, :-1], every[SPRING_PARTS + 1][:-1], every[SPRING_PARTS + 2][:-1, :-1]
        held = every[FOUNDATION_PART] * point_shares(self.plan)
        slopes = SheetGradient(
            springs, sums[TENSION_SUMS:BENDING_SUM], held, float(sums[BENDING_SUM]), keep=float(sums[KEEP_SUM]) / gain
        )
        slopes.gain = slopes.work(self.plan) + float(totals[0])
        slopes.first_gain = float(totals[1])
        return slopes

    @property
    def _sheet_arrays(self) -> tuple[Any, ...]:
        """The arrays of the sheet that the kernels only read."""
        arrays = self._moving.arrays
        return arrays.numbers, arrays.by_column, arrays.stiffness, arrays.fields

    def _most_steps(self) -> int:
        return max(1, POINT_STEPS_PER_LAUNCH // (self.structure.rows * self.structure.cols))

    def _sizes(self, count: int, shape: int, extra: int, with_loss: bool = False) -> NDArray[np.int64]:
        """List the sizes of a launch, in the order that `kernel_adjoint` gives; extra: rows before moments."""
        layout = self.structure
        carry = extra + MOMENTS * layout.workers
        return np.array([
            count, layout.workers, layout.rows, layout.strip, shape, extra, carry, self._carried_rows, MAX_WAIT_LOOKS,
            self._buffer if extra == ADJOINT_PARTS * layout.rows else 0, with_loss,
        ])  # fmt: skip

    def _launch(self, which: int, sizes: NDArray[np.int64], *arguments: Any) -> None:
        """Launch the kernel that records, or the one that sweeps; if a worker gives up, one goes on alone."""
        code, workers = self.structure.code, self.structure.workers
        progress = np.zeros(STRIDE * workers, np.int64)
        for parallel in (True, False) if workers > 1 else (False,):
            if (progress[::STRIDE] < sizes[0]).any():
                with our_compilation():
                    adjoint_kernels(code, parallel=parallel)[which](sizes, progress, *arguments)
