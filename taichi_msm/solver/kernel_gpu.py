"""Kernel 1 on a GPU: every point is a thread that gathers the forces of its eight springs; every step is a loop.

The layout is the simplest: vectors of one lane, one entry per column, and a halo around the sheet. Two buffers hold u_n
and u_{n+1} by turns; with bending, a third one holds the moments.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.arrays import SheetArrays, SheetLayout, Start, point_step, reading
from taichi_msm.system.runtime import compilation_options, ti
from taichi_msm.terms.base import DX, DY, HAS_LEFT, HAS_RIGHT, Entry, KernelRow, KernelSheet, StepCode
from taichi_msm.terms.bending import BendingTerm
from taichi_msm.terms.contact import ContactTerm
from taichi_msm.terms.springs import SpringTerm

# A launch is a chain of this many kernels, one for each step.
STEPS_PER_LAUNCH = 8


class Gather:
    """The state of a sheet in the memory of a GPU, and its kernels: a `StepKernel`."""

    def __init__(self, layout: SheetLayout, start: Start) -> None:
        self._layout = layout
        self._advance, self._read = _kernels(layout.code)
        # Which of the two buffers holds u_n. Each has a halo of one row above and below.
        self._now = 0
        buffer = np.pad(np.arange(layout.rows, dtype=np.int32), 1, constant_values=-1)
        moments = np.full(0 if layout.code.get(BendingTerm) is None else layout.rows + 2, -1, np.int32)
        self.arrays = SheetArrays(layout, np.concatenate([buffer, buffer, moments]), start)

    def advance(self, count: int, table: NDArray[Any]) -> None:
        """Take at most STEPS_PER_LAUNCH steps; table: of the loads, shape (count, columns)."""
        with compilation_options():
            self._advance(self._now, count, self._layout.rows, self._layout.cols, table, *self.arrays.all)
        self._now = (self._now + count) % 2

    def compile(self, table: NDArray[Any]) -> None:
        """Compile the steps without taking one."""
        self.advance(0, table)

    def read(self, differences: bool, values: NDArray[Any], measures: NDArray[Any]) -> None:
        """Copy displacements or differences into values, shape (rows, cols, 3), and the measures of every row."""
        first, layout = self._now * (self._layout.rows + 2) + 1, self._layout
        with compilation_options():
            self._read(first, layout.rows, layout.cols, differences, values, measures, *self.arrays.all)


@cache
def _kernels(code: StepCode) -> tuple[Callable[..., None], Callable[..., None]]:
    """Make the kernels of one code; each is compiled when it is first launched."""
    return _advancing(code), reading(code, parallel=True, iterations=1)


def _gathering(code: StepCode) -> Callable[..., None]:
    """Make the function that steps a point."""
    real, vector, columns, springs = code.real, code.vector, code.first_column(None), code.require(SpringTerm)
    structural, shear = springs.structural, springs.shear
    leaves_out = springs.open_edges and not springs.mapped
    along, to_other_row, of_row, of_column, of_diagonal = springs.between(code)
    move, contact = point_step(code), code.get(ContactTerm)
    resolving = [contact.resolving(code)] if contact else []

    @ti.func
    def by_row(sheet: ti.template(), p, q, lower, b, row_exists, up):
        """Force of entry b of row p on row q, which is `up` above; summed in the order of a pass on a CPU."""
        u, dx = [sheet.u[c][p * sheet.width + b] for c in ti.static(range(3))], sheet.numbers[DX]
        force = [vector(0) for _ in ti.static(range(3))]
        for right in ti.static((-1, 0, 1)):
            if ti.static(structural if right == 0 else shear):
                k, length, exists = vector(1), ti.abs(up), vector(1)
                if ti.static(right == 0):
                    k *= of_column(sheet, lower, b)
                else:
                    k *= of_diagonal(sheet, lower, b + ti.static(min(right, 0)))
                    length = ti.sqrt(dx * dx + up * up)
                if ti.static(right != 0 and leaves_out):
                    exists = sheet.by_column[ti.static(HAS_LEFT if right < 0 else HAS_RIGHT) * sheet.width + b]
                pull = to_other_row(sheet, q * sheet.width + b + right, right, u, up, length, k, exists * row_exists)
                for c in ti.static(range(3)):
                    force[c] += pull[c]
        return force

    @ti.func
    def by_right(sheet: ti.template(), p, i, kind, b):
        """Force of entry b of row p on its right neighbour."""
        exists, here = vector(1), p * sheet.width + b
        if ti.static(leaves_out):
            exists = sheet.by_column[HAS_RIGHT * sheet.width + b]
        k, u = of_row(sheet, i, kind, b) * vector(1), [sheet.u[c][here] for c in ti.static(range(3))]
        return along(sheet, here + 1, u, k, exists)

    @ti.func
    def step(sheet: ti.template(), loads: ti.template(), now, i, b, n):
        """Step point (i, b - 1), where `now` is the buffer of u_n, and n the row of the table of loads."""
        rows, width = sheet.rows, sheet.width
        p = now * (rows + 2) + i + 1
        kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
        below, above = ti.cast(i < rows - 1, real), ti.cast(i > 0, real)
        dy = sheet.numbers[DY]
        on_below = by_row(sheet, p, p + 1, i + 1, b, below, 0 - dy)
        on_above = by_row(sheet, p, p - 1, i, b, above, dy)
        force = [0 - (on_below[c] + on_above[c]) for c in ti.static(range(3))]
        if ti.static(structural):
            on_right = by_right(sheet, p, i, kind, b)
            of_left = by_right(sheet, p, i, kind, b - 1)
            for c in ti.static(range(3)):
                force[c] += of_left[c] - on_right[c]
        row = [loads[n, c] for c in ti.static(range(columns))]
        u = [sheet.u[c][p * width + b] for c in ti.static(range(3))]
        before, at, after = 2 * (rows + 2) + i, 2 * (rows + 2) + i + 1, 2 * (rows + 2) + i + 2
        line = ti.static(KernelRow(i, kind, before, at, after))
        entry = ti.static(Entry(line, b, u))
        target = (1 - now) * (rows + 2) + i + 1
        move(sheet, entry, target, force, row)
        for resolve in ti.static(resolving):
            resolve(sheet, i, kind, target, b, row)

    return step


def _advancing(code: StepCode) -> Callable[..., None]:
    """Make the kernel that takes steps."""
    real, vector, vectors, count_of_numbers = code.real, code.vector, code.vectors, code.first_number(None)
    step, bending = _gathering(code), code.get(BendingTerm)
    storing = [bending.storing(code)] if bending else []

    @ti.kernel
    def advance(
        now: ti.i32,
        count: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        loads: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        numbers_of: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: vectors, stiffness: vectors, fields: vectors,
    ):  # fmt: skip
        for n in ti.static(range(STEPS_PER_LAUNCH)):
            for store_moment in ti.static(storing):
                for i, b in ti.ndrange((-1, rows + 1), cols + 2):
                    if n < count:
                        numbers = [numbers_of[m][0] for m in ti.static(range(count_of_numbers))]
                        u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                        sheet = ti.static(KernelSheet(u, d, by_column, stiffness, fields, numbers, rows, cols + 2))
                        p = (now + n) % 2 * (rows + 2) + i + 1
                        store_moment(sheet, i, p - 1, p, p + 1, b, 2 * (rows + 2) + i + 1)
            for i, b in ti.ndrange(rows, (1, cols + 1)):
                if n < count:
                    numbers = [numbers_of[m][0] for m in ti.static(range(count_of_numbers))]
                    u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                    sheet = ti.static(KernelSheet(u, d, by_column, stiffness, fields, numbers, rows, cols + 2))
                    step(sheet, loads, (now + n) % 2, i, b, n)

    return advance
