"""Kernel 1 on a GPU: every point is a thread that gathers the forces of its eight springs; every step is a loop.

The layout is the plain one: one lane, an entry a column, around the sheet a halo. u_n and u_{n+1} take turns.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.kernel import (
    HAS_LEFT,
    HAS_RIGHT,
    MEASURES,
    MOVES,
    Code,
    ReadArguments,
    SheetArrays,
    Start,
    Structure,
    point_step,
    spring_forces,
    strains,
)
from taichi_msm.system.runtime import our_compilation, ti

# A launch is a chain of this many kernels, one a step.
STEPS_PER_LAUNCH = 8


class Kernels(NamedTuple):
    """The kernels of one code."""

    advance: Callable[..., None]
    read: Callable[..., None]


class Gather:
    """The state of a sheet in the memory of a GPU, and its kernels; its arguments are those of `kernel_cpu.Sweep`."""

    def __init__(self, s: Structure, start: Start) -> None:
        self._s = s
        self._kernels = _kernels(s.code)
        # Which of the two buffers holds u_n, each within a halo of a row above and below.
        self._now = 0
        buffer = np.pad(np.arange(s.rows, dtype=np.int32), 1, constant_values=-1)
        self._arrays = SheetArrays(s, np.concatenate([buffer, buffer]), start)

    def advance(self, count: int, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Take at most STEPS_PER_LAUNCH steps."""
        arrays = *self._arrays.u, *self._arrays.d, self._arrays.by_column, self._arrays.decay
        with our_compilation():
            self._kernels.advance(self._now, count, self._s.rows, self._s.cols, *numbers, table, *arrays)
        self._now = (self._now + count) % 2

    def compile(self, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Compile the steps without taking one."""
        self.advance(0, numbers, table)

    def set_decay(self, decay: NDArray[Any]) -> None:
        """Let standing slots act elsewhere, or otherwise; shape (slots, rows, cols)."""
        self._arrays.set_decay(decay)

    def read(self, spacing: tuple[float, float], out: ReadArguments) -> None:
        """Copy what is asked for, and measure every row."""
        s, arrays = self._s, self._arrays
        with our_compilation():
            self._kernels.read(self._now, s.rows, s.cols, *spacing, *out, *arrays.u, *arrays.d, arrays.by_column)


@cache
def _kernels(code: Code) -> Kernels:
    """Make the kernels of one code; each is compiled when it is first launched."""
    real, vector, columns = code.real, code.vector, code.load_columns
    structural_springs, shear_springs, open_edges = code.structural, code.shear, code.open_edges
    along, to_other_row = spring_forces(code)
    move = point_step(code)
    strain = strains(code)

    @ti.func
    def apart(u: ti.template(), here, other):
        return u[0][other] - u[0][here], u[1][other] - u[1][here], u[2][other] - u[2][here]

    @ti.func
    def by_row(u: ti.template(), by_column: ti.template(), width, p, q, b, row_exists, dx, up, structural, shear):
        """Force on entry b of row p by the row q, which is up above: summed as a sweep does."""
        force_x, force_y, force_z = vector(0), vector(0), vector(0)
        for right in ti.static((-1, 0, 1)):
            if ti.static(structural_springs if right == 0 else shear_springs):
                stiffness, length, exists = structural, ti.abs(up), vector(1)
                if ti.static(right != 0):
                    stiffness, length = shear, ti.sqrt(dx * dx + up * up)
                if ti.static(right != 0 and open_edges):
                    exists = by_column[ti.static(HAS_LEFT if right < 0 else HAS_RIGHT) * width + b]
                x, y, z = apart(u, p * width + b, q * width + b + right)
                x, y, z = to_other_row(x, y, z, right, dx, up, length, stiffness, exists * row_exists)
                force_x += x
                force_y += y
                force_z += z
        return force_x, force_y, force_z

    @ti.func
    def by_right(u: ti.template(), by_column: ti.template(), width, p, b, dx, structural):
        """Force on entry b of row p by its right neighbour."""
        exists = vector(1)
        if ti.static(open_edges):
            exists = by_column[HAS_RIGHT * width + b]
        x, y, z = apart(u, p * width + b, p * width + b + 1)
        return along(x, y, z, dx, structural, exists)

    @ti.func
    def step(
        u: ti.template(), d: ti.template(), by_column: ti.template(), decay: ti.template(), loads: ti.template(),
        now, rows, width, i, b, n, keep, dx, dy, structural, shear, top,
    ):  # fmt: skip
        """Step point (i, b - 1): now is the buffer of u_n, n the row of the table."""
        p = now * (rows + 2) + i + 1
        below, above = ti.cast(i < rows - 1, real), ti.cast(i > 0, real)
        force_x, force_y, force_z = by_row(u, by_column, width, p, p + 1, b, below, dx, -dy, structural, shear)
        x, y, z = by_row(u, by_column, width, p, p - 1, b, above, dx, dy, structural, shear)
        force_x += x
        force_y += y
        force_z += z
        if ti.static(structural_springs):
            right_x, right_y, right_z = by_right(u, by_column, width, p, b, dx, structural)
            left_x, left_y, left_z = by_right(u, by_column, width, p, b - 1, dx, structural)
            force_x += right_x - left_x
            force_y += right_y - left_y
            force_z += right_z - left_z
        row = [loads[n, c] for c in ti.static(range(columns))]
        kind = ti.select(i == rows - 1, MOVES + 2, ti.select(i == 0, MOVES, MOVES + 1))
        move(
            u, d, by_column, decay, rows, width, (1 - now) * (rows + 2) + i + 1, i, b, kind,
            u[0][p * width + b], u[1][p * width + b], u[2][p * width + b],
            force_x, force_y, force_z, keep, dy, top, row,
        )  # fmt: skip

    @ti.kernel
    def advance(
        now: ti.i32,
        count: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        keep: real,
        dx: real,
        dy: real,
        structural: real,
        shear: real,
        top: real,
        loads: ti.types.ndarray(dtype=real, ndim=2),
        u_x: ti.types.ndarray(dtype=vector, ndim=1),
        u_y: ti.types.ndarray(dtype=vector, ndim=1),
        u_z: ti.types.ndarray(dtype=vector, ndim=1),
        d_x: ti.types.ndarray(dtype=vector, ndim=1),
        d_y: ti.types.ndarray(dtype=vector, ndim=1),
        d_z: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: ti.types.ndarray(dtype=vector, ndim=1),
        decay: ti.types.ndarray(dtype=vector, ndim=1),
    ):
        for n in ti.static(range(STEPS_PER_LAUNCH)):
            for i, b in ti.ndrange(rows, (1, cols + 1)):
                if n < count:
                    u = ti.static((u_x, u_y, u_z))
                    d = ti.static((d_x, d_y, d_z))
                    step(
                        u, d, by_column, decay, loads, (now + n) % 2, rows, cols + 2, i, b, n,
                        keep, dx, dy, structural, shear, top,
                    )  # fmt: skip

    @ti.kernel
    def read(
        now: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        dx: real,
        dy: real,
        differences: ti.i32,
        out: ti.types.ndarray(dtype=real, ndim=3),
        measures: ti.types.ndarray(dtype=real, ndim=2),
        u_x: ti.types.ndarray(dtype=vector, ndim=1),
        u_y: ti.types.ndarray(dtype=vector, ndim=1),
        u_z: ti.types.ndarray(dtype=vector, ndim=1),
        d_x: ti.types.ndarray(dtype=vector, ndim=1),
        d_y: ti.types.ndarray(dtype=vector, ndim=1),
        d_z: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: ti.types.ndarray(dtype=vector, ndim=1),
    ):
        for i in range(rows):
            u = ti.static((u_x, u_y, u_z))
            d = ti.static((d_x, d_y, d_z))
            width = cols + 2
            p = now * (rows + 2) + i + 1
            found = ti.Vector.zero(real, MEASURES)
            for b in range(1, cols + 1):
                least, along, down, diagonal = strain(u, by_column, width, p, p + 1, b, dx, dy, i < rows - 1)
                found[0] = ti.min(found[0], least[0])
                found[1] += along[0]
                found[2] += down[0]
                found[3] += diagonal[0]
                for c in ti.static(range(3)):
                    change = d[c][i * width + b][0]
                    found[4] += change * change
                    out[i, b - 1, c] = ti.select(differences, change, u[c][p * width + b][0])
            for m in ti.static(range(MEASURES)):
                measures[i, m] = found[m]

    return Kernels(advance, read)
