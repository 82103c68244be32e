"""Kernel 1 on a GPU: one thread per mass point gathers the forces of its eight springs; one loop per step.

Vectors have one lane, and a row has one entry per column. Two buffers of u alternately contain u_n and u_{n+1}; with
bending, a third one contains the moments. Each buffer has a halo of one row above and below.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.arrays import InitialData, SheetArrays, SheetLayout, StepKernel, build_point_step, build_read
from taichi_msm.system.runtime import compilation_options, ti
from taichi_msm.terms.base import BY_COLUMN, DX, DY, Entry, KernelConfig, KernelRow, KernelSheet, RowPair
from taichi_msm.terms.bending import BendingTerm
from taichi_msm.terms.springs import SpringTerm

# Number of loops of a launch, one per step.
STEPS_PER_LAUNCH = 8


class GatherKernel(StepKernel):
    """A sheet in the memory of a GPU, with one lane and no workers; a launch takes at most STEPS_PER_LAUNCH steps."""

    def __init__(self, layout: SheetLayout, start: InitialData) -> None:
        self._layout = layout
        self._advance = _build_advance(layout.config)
        self._read = build_read(layout.config, parallel=True, iterations=1)
        # Index of the buffer with u_n.
        self._buffer, self._top_row = 0, 1
        buffer_rows = np.pad(np.arange(layout.rows, dtype=np.int32), 1, constant_values=-1)
        moments = np.full(0 if layout.config.get(BendingTerm) is None else layout.rows + 2, -1, np.int32)
        self.arrays = SheetArrays(layout, np.concatenate([buffer_rows, buffer_rows, moments]), start)

    def advance(self, count: int, table: NDArray[Any]) -> None:
        with compilation_options():
            self._advance(self._buffer, count, self._layout.rows, self._layout.cols, table, *self.arrays.all)
        self._buffer = (self._buffer + count) % 2
        self._top_row = self._buffer * (self._layout.rows + 2) + 1

    def compile(self, table: NDArray[Any]) -> None:
        self.advance(0, table)


def _build_step(config: KernelConfig) -> Callable[..., None]:
    """Build the Taichi function that steps a mass point."""
    real, vector, columns, springs = config.real, config.vector, config.columns().end, config.require(SpringTerm)
    structural, shear, open_edges = springs.structural, springs.shear, springs.open_edges
    force_on_right, force_on_other = springs.build_spring_forces(config)
    move, corrections = build_point_step(config), [term.build_correction(config) for term in config.terms]
    resolving = [correction.resolve for correction in corrections if correction]

    @ti.func
    def row_force(sheet: ti.template(), pair: ti.template(), p, q, b, row_exists):
        """Return the force of entry b of row p on row q of u, summed in the order of the CPU kernel."""
        u = [sheet.u[c][p * sheet.width + b] for c in ti.static(range(3))]
        force = [vector(0) for _ in ti.static(range(3))]
        for right in ti.static((-1, 0, 1)):
            if ti.static(structural if right == 0 else shear):
                exists = vector(1)
                if ti.static(right != 0 and open_edges):
                    side = ti.static(BY_COLUMN.has_left if right < 0 else BY_COLUMN.has_right)
                    exists = sheet.by_column[side * sheet.width + b]
                pull = force_on_other(sheet, pair, q * sheet.width + b + right, right, b, u, exists * row_exists)
                for c in ti.static(range(3)):
                    force[c] += pull[c]
        return force

    @ti.func
    def right_force(sheet: ti.template(), pair: ti.template(), p, b):
        """Return the force of entry b of row p of u on its right neighbour."""
        exists, entry = vector(1), p * sheet.width + b
        if ti.static(open_edges):
            exists = sheet.by_column[BY_COLUMN.has_right * sheet.width + b]
        u = [sheet.u[c][entry] for c in ti.static(range(3))]
        return force_on_right(sheet, pair, entry + 1, b, u, exists)

    @ti.func
    def step(sheet: ti.template(), loads: ti.template(), buffer, i, b, n):
        """Step mass point (i, b - 1), from a buffer into the other one, with row n of the load table."""
        rows, width = sheet.rows, sheet.width
        p = buffer * (rows + 2) + i + 1
        kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
        below, above = ti.cast(i < rows - 1, real), ti.cast(i > 0, real)
        dx, dy = sheet.constants[DX], sheet.constants[DY]
        diagonal = ti.sqrt(dx * dx + dy * dy)
        with_below = ti.static(RowPair(i, kind, ti.min(i + 1, rows - 1), i, 0 - dy, diagonal))
        with_above = ti.static(RowPair(i, kind, ti.max(i - 1, 0), i - 1, dy, diagonal))
        on_below = row_force(sheet, with_below, p, p + 1, b, below)
        on_above = row_force(sheet, with_above, p, p - 1, b, above)
        force = [0 - (on_below[c] + on_above[c]) for c in ti.static(range(3))]
        if ti.static(structural):
            on_right = right_force(sheet, with_below, p, b)
            of_left = right_force(sheet, with_below, p, b - 1)
            for c in ti.static(range(3)):
                force[c] += of_left[c] - on_right[c]
        now = [loads[n, c] for c in ti.static(range(columns))]
        u = [sheet.u[c][p * width + b] for c in ti.static(range(3))]
        before, at, after = 2 * (rows + 2) + i, 2 * (rows + 2) + i + 1, 2 * (rows + 2) + i + 2
        line = ti.static(KernelRow(i, kind, before, at, after))
        entry = ti.static(Entry(line, b, u))
        target = (1 - buffer) * (rows + 2) + i + 1
        move(sheet, entry, target, force, now)
        for resolve in ti.static(resolving):
            resolve(sheet, i, kind, target, b, now)

    return step


@cache
def _build_advance(config: KernelConfig) -> Callable[..., None]:
    """Build the kernel that takes steps."""
    real, vector, vectors, constant_count = config.real, config.vector, config.vectors, config.constants().end
    step, bending = _build_step(config), config.get(BendingTerm)
    storing = [bending.build_store_moment(config)] if bending else []

    @ti.kernel
    def advance(
        buffer: ti.i32, count: ti.i32, rows: ti.i32, cols: ti.i32, loads: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1), by_column: vectors, fields: vectors,
    ):  # fmt: skip
        """Advance by at most STEPS_PER_LAUNCH steps with a row of `loads` each, from u_n in `buffer` 0 or 1."""
        for n in ti.static(range(STEPS_PER_LAUNCH)):
            for store_moment in ti.static(storing):
                for i, b in ti.ndrange((-1, rows + 1), cols + 2):
                    if n < count:
                        constants = [constants_of[m][0] for m in ti.static(range(constant_count))]
                        u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                        sheet = ti.static(KernelSheet(u, d, by_column, fields, constants, rows, cols + 2))
                        p = (buffer + n) % 2 * (rows + 2) + i + 1
                        store_moment(sheet, i, p - 1, p, p + 1, b, 2 * (rows + 2) + i + 1)
            for i, b in ti.ndrange(rows, (1, cols + 1)):
                if n < count:
                    constants = [constants_of[m][0] for m in ti.static(range(constant_count))]
                    u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                    sheet = ti.static(KernelSheet(u, d, by_column, fields, constants, rows, cols + 2))
                    step(sheet, loads, (buffer + n) % 2, i, b, n)

    return advance
