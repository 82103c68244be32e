"""Kernel 1 on a CPU: rows are swept one after another, every spring is evaluated once, and rows are stepped in place.

A launch takes several steps with several workers (`bands`), or with one. If a worker gives up waiting, further launches
continue until all workers have taken the same steps; after that a single worker takes over for some time.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.arrays import BYTES, SheetArrays, SheetLayout, Start, reading
from taichi_msm.solver.bands import COUNTER_STRIDE, MOMENTS, PLACE_END, ROUND, STEP, TURN, WORKER_STRIDE, advancing
from taichi_msm.system import process
from taichi_msm.system.compiler import active_compiler
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, compilation_options, ti
from taichi_msm.terms.base import StepCode
from taichi_msm.terms.bending import BendingTerm

# Bytes of a page.
PAGE = 4096

# How many times a worker looks for its neighbour before it gives up: for about 1.3 ms.
PATIENCE = round(1.32e-3 / active_compiler().poll_s)

# After a worker has given up, a single worker steps for some time [s]. Where other programs want the cores, that is
# four times the last such rest, halved for every HALF_LIFE that all workers have stepped since then; else it is the
# shortest.
SHORTEST_REST, LONGEST_REST, HALF_LIFE = 0.002, 0.2, 0.02

# Other programs want the cores if threads have waited for one for this share of the time that they have had one.
CROWDED = 0.2


class Scatter:
    """The state of a sheet in the memory of a CPU, and its kernels: a `StepKernel`."""

    def __init__(self, layout: SheetLayout, start: Start) -> None:
        self._layout = layout
        self._advance, self._read = _kernels(layout.code, parallel=layout.workers > 1)
        self._alone, _ = _kernels(layout.code, parallel=False)
        self._steps = 0
        self._rest = self._rests_until = 0.0
        # Time that all workers have stepped undisturbed since the last rest [s].
        self._together = 0.0
        # At the end of the last rest: the time that this process's threads had had a core, and had waited for one [s].
        self._had, self._waited = 0.0, 0.0
        self._first_row, self._end_row = int(layout.fixed_rows[0]), layout.rows - int(layout.fixed_rows[1])
        # Stored after the sheet's own rows: two copies for every border of every worker; then moments.
        self._borders = self._border_rows()
        moments = 0 if layout.code.get(BendingTerm) is None else MOMENTS * layout.workers
        sheet_rows = np.arange(layout.rows, dtype=np.int32), self._borders, np.full(moments, -1, np.int32)
        self.arrays = SheetArrays(layout, np.concatenate(sheet_rows), start)
        # Rows of `carried` per worker: one for each step of a pass, and then a page, which no prefetcher crosses.
        row_bytes = layout.width * layout.code.lanes * BYTES[layout.code.precision]
        self._carried_rows = layout.depth - (-PAGE // row_bytes)
        # Forces carried to the next row, for every worker and step of a pass.
        self._carried = [self.arrays.rows(layout.workers * self._carried_rows) for _ in range(3)]
        self._progress = np.zeros(layout.workers * WORKER_STRIDE, np.int64)

    def advance(self, count: int, table: NDArray[Any]) -> None:
        """Take a number of steps; table: of the loads, shape (count, columns)."""
        if self._layout.workers == 1:
            self._advance_alone(0, count, table)
            return
        done = 0
        while done < count:
            if time.perf_counter() < self._rests_until:
                done = self._advance_while_resting(done, count, table)
            else:
                done = self._advance_together(done, count, table)

    def compile(self, table: NDArray[Any]) -> None:
        """Compile everything that steps may need, without taking one."""
        self._advance_alone(0, 0, table)
        if self._layout.workers > 1:
            self._launch_together(0, 0, table)
            self._copy_borders()

    def read(self, differences: bool, values: NDArray[Any], measures: NDArray[Any]) -> None:
        """Copy displacements or differences into values, shape (rows, cols, 3), and the measures of every row."""
        with compilation_options():
            self._read(0, self._layout.rows, self._layout.cols, differences, values, measures, *self.arrays.all)

    def _advance_alone(self, done: int, end: int, table: NDArray[Any]) -> None:
        """Take the steps from `done` to `end` with a single worker."""
        self._start_pass()
        self._launch(self._alone, 1, end - done, table[done:])

    def _advance_while_resting(self, done: int, end: int, table: NDArray[Any]) -> int:
        """Take steps with a single worker until it is time for all of them; returns how many are done."""
        # How long a step takes is not known, so pieces begin small and double.
        piece = self._layout.depth
        while done < end and time.perf_counter() < self._rests_until:
            until = min(done + piece, end)
            self._advance_alone(done, until, table)
            done, piece = until, 2 * piece
        self._copy_borders()
        return done

    def _advance_together(self, done: int, end: int, table: NDArray[Any]) -> int:
        """Take steps with all workers; returns how many are done, which may be fewer than `end` if a worker gave up."""
        if self._rests_until:
            # The rest itself tells nothing: a single worker waits for no core.
            self._had, self._waited = time.process_time(), process.core_wait_s() or 0.0
            self._rests_until = 0.0
        start = time.perf_counter()
        count, gave_up = self._launch_together(done, end, table)
        now = time.perf_counter()
        if gave_up:
            rest = 4 * self._rest * 0.5 ** (self._together / HALF_LIFE) if self._is_crowded() else 0.0
            self._rest = min(max(rest, SHORTEST_REST), LONGEST_REST)
            self._together, self._rests_until = 0.0, now + self._rest
        else:
            self._together += now - start
        return done + count

    def _is_crowded(self) -> bool:
        """Tell whether other programs have wanted the cores since the last rest; True if it is not known."""
        had, waited = time.process_time(), process.core_wait_s()
        return waited is None or waited - self._waited > CROWDED * (had - self._had)

    def _launch_together(self, done: int, end: int, table: NDArray[Any]) -> tuple[int, bool]:
        """Launch all workers; returns how many steps they have taken, and whether one gave up."""
        workers, depth, count, first = self._layout.workers, self._layout.depth, end - done, self._steps
        self._start_pass()
        self._launch(self._advance, workers, count, table[done:])
        passes, rounds = self._progress[TURN::WORKER_STRIDE], self._progress[ROUND::WORKER_STRIDE]
        gave_up = not (passes * depth >= count).all()
        if gave_up:
            # All continue to the end of the pass that the foremost of them is in.
            count = min(count, int((passes + (rounds >= 0)).max()) * depth)
            while not (passes * depth >= count).all():
                self._steps = first
                self._launch(self._advance, workers, count, table[done:])
            self._steps = first + count
        return count, gave_up

    def _copy_borders(self) -> None:
        """Bring the copies of the rows at the borders of bands up to date, after steps of a single worker."""
        with compilation_options():
            _copying(self._layout.code)(*self.arrays.u, self._borders, self._layout.rows, self._layout.width)
        self._progress[::COUNTER_STRIDE] = self._steps

    def _start_pass(self) -> None:
        """Send all workers to the first row of the first pass."""
        places = self._progress.reshape(-1, WORKER_STRIDE)[:, TURN:PLACE_END]
        places[:, [TURN - 1, ROUND - 1, STEP - 1]] = 0, -1, 0

    def _launch(self, kernel: Callable[..., None], workers: int, count: int, table: NDArray[Any]) -> None:
        layout = self._layout
        # In the order of the sizes in `bands`.
        sizes = np.array([
            self._steps, count, workers, layout.depth, self._carried_rows, layout.rows, layout.strip,
            self._first_row, self._end_row, layout.rows + len(self._borders), PATIENCE,
        ])  # fmt: skip
        with compilation_options():
            kernel(sizes, self._progress, table, *self._carried, *self.arrays.all)
        self._steps += count

    def _border_rows(self) -> NDArray[np.int32]:
        """List for every copy at a border of a band the row of the sheet that it is a copy of."""
        rows: list[int] = []
        first, end, workers = self._first_row, self._end_row, self._layout.workers
        for worker in range(workers):
            low, high = (first + (end - first) * n // workers for n in (worker, worker + 1))
            near, far = (low, high - 1) if worker % 2 else (high - 1, low)
            # The row at the border and, with bending, the one behind it; each after even and after odd steps.
            inward = 1 if worker % 2 else -1
            for border in ((near, near + inward), (far, far - inward)):
                rows += [*border[: self._layout.code.reach]] * 2
        return np.array(rows, np.int32)


@cache
def _kernels(code: StepCode, *, parallel: bool) -> tuple[Callable[..., None], Callable[..., None]]:
    """Make the kernels of one code that step and read; each is compiled when it is first launched."""
    iterations = ITERATIONS_PER_THREAD if parallel else 1
    return advancing(code, parallel=parallel), reading(code, parallel=parallel, iterations=iterations)


@cache
def _copying(code: StepCode) -> Callable[..., None]:
    """Make the kernel that updates the copies of the rows at the borders of bands."""
    vectors = code.vectors

    @ti.kernel
    def copy(
        u_x: vectors, u_y: vectors, u_z: vectors,
        borders: ti.types.ndarray(dtype=ti.i32, ndim=1),
        rows: ti.i32,
        width: ti.i32,
    ):  # fmt: skip
        for n, b in ti.ndrange(borders.shape[0], width):
            for u in ti.static((u_x, u_y, u_z)):
                u[(rows + n) * width + b] = u[borders[n] * width + b]

    return copy
