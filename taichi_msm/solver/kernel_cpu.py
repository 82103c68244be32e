"""Kernel 1 on a CPU: passes over the rows that evaluate every spring once and step the rows in place.

A launch takes several steps with one worker or with several (`bands`). After the timeout of a worker, further launches
continue until all workers have taken the same steps. A single worker then steps for a while (`backoff`).
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.time_grid import DTYPES
from taichi_msm.solver import bands
from taichi_msm.solver.arrays import InitialData, SheetArrays, SheetLayout, StepKernel, build_read
from taichi_msm.solver.backoff import Backoff
from taichi_msm.system.compiler import active_compiler
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, compilation_options, ti
from taichi_msm.terms.base import KernelConfig
from taichi_msm.terms.bending import BendingTerm

# Size of a memory page.
PAGE_BYTES = 4096

# Number of checks, in about 1.3 ms, after which a worker stops waiting for its neighbour.
MAX_CHECKS = round(1.32e-3 / active_compiler().poll_s)


class ScatterKernel(StepKernel):
    """A sheet in the memory of a CPU, with at least one worker."""

    def __init__(self, layout: SheetLayout, start: InitialData) -> None:
        self._layout = layout
        parallel = layout.workers > 1
        iterations = ITERATIONS_PER_THREAD if parallel else 1
        self._read = build_read(layout.config, parallel=parallel, iterations=iterations)
        self._parallel_kernel = bands.build_advance(layout.config, parallel=parallel)
        self._serial_kernel = bands.build_advance(layout.config, parallel=False)
        self._steps, self._backoff = 0, Backoff()
        self._first_row, self._end_row = int(layout.fixed_rows[0]), layout.rows - int(layout.fixed_rows[1])
        # After the rows of the sheet, u contains two copies for every border of every worker, and rows of moments.
        self._borders = self._border_rows()
        moments = 0 if layout.config.get(BendingTerm) is None else bands.MOMENT_ROWS * layout.workers
        sheet_rows = np.arange(layout.rows, dtype=np.int32), self._borders, np.full(moments, -1, np.int32)
        self.arrays = SheetArrays(layout, np.concatenate(sheet_rows), start)
        # Rows of carried forces per worker: one per step of a pass, and one page, which no prefetcher crosses.
        row_bytes = layout.width * layout.config.lanes * DTYPES[layout.config.precision].itemsize
        self._carried_rows = layout.depth - (-PAGE_BYTES // row_bytes)
        self._carried = [self.arrays.allocate_rows(layout.workers * self._carried_rows) for _ in range(3)]
        self._progress = np.zeros(layout.workers * bands.WORKER_STRIDE, np.int64)
        self._progress_by_worker = self._progress.reshape(-1, bands.WORKER_STRIDE)  # a view

    def advance(self, count: int, table: NDArray[Any]) -> None:
        if self._layout.workers == 1:
            self._advance_alone(0, count, table)
            return
        first = 0
        while first < count:
            if self._backoff.is_active:
                first = self._advance_in_backoff(first, count, table)
                continue
            self._backoff.start_launch()
            taken, timed_out = self._launch_together(first, count, table)
            self._backoff.end_launch(timed_out=timed_out)
            first += taken

    def compile(self, table: NDArray[Any]) -> None:
        self._advance_alone(0, 0, table)
        if self._layout.workers > 1:
            self._launch_together(0, 0, table)
            self._copy_borders()

    def _advance_alone(self, first: int, end: int, table: NDArray[Any]) -> None:
        """Advance with a single worker from step `first` to step `end`."""
        self._start_pass()
        self._launch(self._serial_kernel, 1, end - first, table[first:])

    def _advance_in_backoff(self, first: int, end: int, table: NDArray[Any]) -> int:
        """Advance with a single worker until the back-off ends; return the number of the next step."""
        # The duration of a step is unknown, so the number of steps per launch starts small and doubles.
        steps = self._layout.depth
        while first < end and self._backoff.is_active:
            until = min(first + steps, end)
            self._advance_alone(first, until, table)
            first, steps = until, 2 * steps
        self._copy_borders()
        return first

    def _launch_together(self, first: int, end: int, table: NDArray[Any]) -> tuple[int, bool]:
        """Launch all workers; return the number of steps taken, and whether a worker timed out."""
        workers, depth, count, steps_before = self._layout.workers, self._layout.depth, end - first, self._steps
        self._start_pass()
        self._launch(self._parallel_kernel, workers, count, table[first:])
        passes, rounds = (self._progress_by_worker[:, column] for column in (bands.PASS_INDEX, bands.ROUND))
        timed_out = not (passes * depth >= count).all()
        if timed_out:
            # All workers continue to the end of the pass that the foremost worker has begun.
            count = min(count, int((passes + (rounds >= 0)).max()) * depth)
            while not (passes * depth >= count).all():
                self._steps = steps_before
                self._launch(self._parallel_kernel, workers, count, table[first:])
            self._steps = steps_before + count
        return count, timed_out

    def _copy_borders(self) -> None:
        """Update the copies of the rows at the borders of bands after steps of a single worker."""
        with compilation_options():
            _build_copy(self._layout.config)(*self.arrays.u, self._borders, self._layout.rows, self._layout.width)
        self._progress[:: bands.COUNTER_STRIDE] = self._steps

    def _start_pass(self) -> None:
        self._progress_by_worker[:, [bands.PASS_INDEX, bands.ROUND, bands.STEP]] = 0, -1, 0

    def _launch(self, kernel: Callable[..., None], workers: int, count: int, table: NDArray[Any]) -> None:
        layout = self._layout
        sizes = bands.Launch(
            steps_before=self._steps,
            count=count,
            workers=workers,
            depth=layout.depth,
            carried_rows=self._carried_rows,
            rows=layout.rows,
            strip=layout.strip,
            first_row=self._first_row,
            end_row=self._end_row,
            moment_row=layout.rows + len(self._borders),
            max_checks=MAX_CHECKS,
        )
        with compilation_options():
            kernel(np.array(sizes), self._progress, table, *self._carried, *self.arrays.all)
        self._steps += count

    def _border_rows(self) -> NDArray[np.int32]:
        """Return the index of the sheet's row in each copy, shape (copies,)."""
        rows: list[int] = []
        first, end, workers = self._first_row, self._end_row, self._layout.workers
        for worker in range(workers):
            low, high = (first + (end - first) * n // workers for n in (worker, worker + 1))
            begin_row, end_row = (low, high - 1) if worker % 2 else (high - 1, low)
            # The row at the border and, with bending, the next row inward, each after even and after odd steps.
            inward = 1 if worker % 2 else -1
            for border in ((begin_row, begin_row + inward), (end_row, end_row - inward)):
                rows += [*border[: self._layout.config.reach]] * 2
        return np.array(rows, np.int32)


@cache
def _build_copy(config: KernelConfig) -> Callable[..., None]:
    """Build the kernel that updates the copies of the rows at the borders of bands."""
    vectors = config.vectors

    @ti.kernel
    def copy(
        u_x: vectors, u_y: vectors, u_z: vectors,
        borders: ti.types.ndarray(dtype=ti.i32, ndim=1), rows: ti.i32, width: ti.i32,
    ):  # fmt: skip
        """Copy the rows `borders` of the sheet, shape (copies,), into the rows of u after it."""
        for n, b in ti.ndrange(borders.shape[0], width):
            for u in ti.static((u_x, u_y, u_z)):
                u[(rows + n) * width + b] = u[borders[n] * width + b]

    return copy
