"""Kernel 1 on a GPU: every point is a thread that gathers the forces of its eight springs; every step is a loop.

The layout is the simplest: vectors of one lane, one entry per column, and a halo around the sheet. Two buffers hold u_n
and u_{n+1} by turns.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.kernel import (
    AREA,
    HAS_LEFT,
    HAS_RIGHT,
    LEAST,
    MEASURES,
    MOST,
    Code,
    ReadArguments,
    SheetArrays,
    Start,
    Structure,
    five_point,
    measuring,
    point_step,
    spring_forces,
)
from taichi_msm.system.runtime import our_compilation, ti

# A launch is a chain of this many kernels, one for each step.
STEPS_PER_LAUNCH = 8


class Kernels(NamedTuple):
    """The kernels of one code."""

    advance: Callable[..., None]
    read: Callable[..., None]


class Gather:
    """The state of a sheet in the memory of a GPU, and its kernels; arguments as for `kernel_cpu.Sweep`."""

    def __init__(self, s: Structure, start: Start) -> None:
        self._s = s
        self._kernels = _kernels(s.code)
        # Which of the two buffers holds u_n. Each has a halo of one row above and below.
        self._now = 0
        buffer = np.pad(np.arange(s.rows, dtype=np.int32), 1, constant_values=-1)
        self._arrays = SheetArrays(s, np.concatenate([buffer, buffer]), start)
        self._moment = [self._arrays.rows(s.rows + 2 if s.code.bending else 1) for _ in range(3)]

    def advance(self, count: int, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Take at most STEPS_PER_LAUNCH steps."""
        arrays = self._arrays
        with our_compilation():
            self._kernels.advance(
                self._now, count, self._s.rows, self._s.cols, *numbers, table,
                *arrays.u, *arrays.d, *self._moment, *arrays.stiffness, arrays.by_column, arrays.decay,
            )  # fmt: skip
        self._now = (self._now + count) % 2

    def compile(self, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Compile the steps without taking one."""
        self.advance(0, numbers, table)

    def set_decay(self, decay: NDArray[Any]) -> None:
        """Replace the decays of the standing slots, shape (slots, rows, cols)."""
        self._arrays.set_decay(decay)

    def read(self, spacing: tuple[float, float], out: ReadArguments) -> None:
        """Copy displacements or differences, and measure every row."""
        s, arrays = self._s, self._arrays
        with our_compilation():
            self._kernels.read(
                self._now, s.rows, s.cols, *spacing, *out, *arrays.u, *arrays.d, *arrays.stiffness, arrays.by_column
            )


@cache
def _kernels(code: Code) -> Kernels:
    """Make the kernels of one code; each is compiled when it is first launched."""
    real, vector, columns = code.real, code.vector, code.load_columns
    structural_springs, shear_springs, bending = code.structural, code.shear, code.bending
    # With a map, the stiffness is 0 where there is no spring.
    mapped, open_edges = code.mapped, code.open_edges and not code.mapped
    by_area = open_edges and code.by_area
    along, to_other_row = spring_forces(code)
    move, measure, laplacian = point_step(code), measuring(code), five_point()

    @ti.func
    def by_row(
        u: ti.template(), by_column: ti.template(), stiffness: ti.template(), width, p, q, between, b, row_exists,
        dx, up, k_down, k_shear, t_down, t_shear,
    ):  # fmt: skip
        """Force of entry b of row p on row q, which is `up` above; summed in the order of a sweep."""
        here_x, here_y, here_z = u[0][p * width + b], u[1][p * width + b], u[2][p * width + b]
        force_x, force_y, force_z = vector(0), vector(0), vector(0)
        for right in ti.static((-1, 0, 1)):
            if ti.static(structural_springs if right == 0 else shear_springs):
                k, tension, length, exists = k_down * vector(1), t_down, ti.abs(up), vector(1)
                if ti.static(right != 0):
                    k, tension, length = k_shear * vector(1), t_shear, ti.sqrt(dx * dx + up * up)
                if ti.static(right != 0 and open_edges):
                    exists = by_column[ti.static(HAS_LEFT if right < 0 else HAS_RIGHT) * width + b]
                if ti.static(right == 0 and by_area):
                    k *= by_column[(AREA + 1) * width + b]
                if ti.static(mapped):
                    k = stiffness[ti.static(2 if right else 1)][between * width + b + ti.static(min(right, 0))]
                x, y, z = to_other_row(
                    u, q * width + b + right, right, here_x, here_y, here_z, dx, up, length, k, tension,
                    exists * row_exists,
                )  # fmt: skip
                force_x += x
                force_y += y
                force_z += z
        return force_x, force_y, force_z

    @ti.func
    def by_right(
        u: ti.template(), by_column: ti.template(), stiffness: ti.template(), width, p, i, kind, b,
        dx, k_across, t_across,
    ):  # fmt: skip
        """Force of entry b of row p on its right neighbour."""
        exists, k = vector(1), k_across * vector(1)
        if ti.static(open_edges):
            exists = by_column[HAS_RIGHT * width + b]
        if ti.static(by_area):
            k *= ti.select(kind == 1, ti.cast(1, real), ti.cast(0.5, real))
        if ti.static(mapped):
            k = stiffness[0][i * width + b]
        here = p * width + b
        return along(u, here + 1, u[0][here], u[1][here], u[2][here], dx, k, t_across, exists)

    @ti.func
    def step(
        u: ti.template(), d: ti.template(), moment: ti.template(), stiffness: ti.template(), by_column: ti.template(),
        decay: ti.template(), loads: ti.template(), now, rows, width, i, b, n,
        keep, dx, dy, k_across, k_down, k_shear, t_across, t_down, t_shear, top,
    ):  # fmt: skip
        """Step point (i, b - 1), where `now` is the buffer of u_n, and n the row of the table of loads."""
        p = now * (rows + 2) + i + 1
        kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
        below, above = ti.cast(i < rows - 1, real), ti.cast(i > 0, real)
        below_x, below_y, below_z = by_row(
            u, by_column, stiffness, width, p, p + 1, i + 1, b, below, dx, -dy, k_down, k_shear, t_down, t_shear
        )
        above_x, above_y, above_z = by_row(
            u, by_column, stiffness, width, p, p - 1, i, b, above, dx, dy, k_down, k_shear, t_down, t_shear
        )
        force_x, force_y, force_z = 0 - (below_x + above_x), 0 - (below_y + above_y), 0 - (below_z + above_z)
        if ti.static(structural_springs):
            right_x, right_y, right_z = by_right(u, by_column, stiffness, width, p, i, kind, b, dx, k_across, t_across)
            left_x, left_y, left_z = by_right(u, by_column, stiffness, width, p, i, kind, b - 1, dx, k_across, t_across)
            force_x += left_x - right_x
            force_y += left_y - right_y
            force_z += left_z - right_z
        row = [loads[n, c] for c in ti.static(range(columns))]
        move(
            u, d, by_column, decay, moment, rows, width, (1 - now) * (rows + 2) + i + 1, i, b, kind, i, i + 1, i + 2,
            u[0][p * width + b], u[1][p * width + b], u[2][p * width + b],
            force_x, force_y, force_z, keep, dx, dy, top, row,
        )  # fmt: skip

    @ti.func
    def bend(
        u: ti.template(), moment: ti.template(), by_column: ti.template(), now, rows, width, i, b,
        bending_stiffness, dx, dy,
    ):  # fmt: skip
        """Store the moment of entry b of row i, which is 0 at edges, in row i + 1 of the moments."""
        across, down = bending_stiffness / (dx * dx), bending_stiffness / (dy * dy)
        p = now * (rows + 2) + i + 1
        inside = by_column[HAS_LEFT * width + b] * by_column[HAS_RIGHT * width + b]
        for c in ti.static(range(3)):
            moment[c][(i + 1) * width + b] = vector(0)
            if 0 < i < rows - 1:
                moment[c][(i + 1) * width + b] = inside * laplacian(u, c, width, p - 1, p, p + 1, b, across, down)

    @ti.kernel
    def advance(
        now: ti.i32,
        count: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        keep: real,
        dx: real,
        dy: real,
        k_across: real,
        k_down: real,
        k_shear: real,
        t_across: real,
        t_down: real,
        t_shear: real,
        bending_stiffness: real,
        top: real,
        loads: ti.types.ndarray(dtype=real, ndim=2),
        u_x: ti.types.ndarray(dtype=vector, ndim=1),
        u_y: ti.types.ndarray(dtype=vector, ndim=1),
        u_z: ti.types.ndarray(dtype=vector, ndim=1),
        d_x: ti.types.ndarray(dtype=vector, ndim=1),
        d_y: ti.types.ndarray(dtype=vector, ndim=1),
        d_z: ti.types.ndarray(dtype=vector, ndim=1),
        moment_x: ti.types.ndarray(dtype=vector, ndim=1),
        moment_y: ti.types.ndarray(dtype=vector, ndim=1),
        moment_z: ti.types.ndarray(dtype=vector, ndim=1),
        along_rows: ti.types.ndarray(dtype=vector, ndim=1),
        along_columns: ti.types.ndarray(dtype=vector, ndim=1),
        diagonals: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: ti.types.ndarray(dtype=vector, ndim=1),
        decay: ti.types.ndarray(dtype=vector, ndim=1),
    ):
        for n in ti.static(range(STEPS_PER_LAUNCH)):
            if ti.static(bending):
                for i, b in ti.ndrange((-1, rows + 1), cols + 2):
                    if n < count:
                        u = ti.static((u_x, u_y, u_z))
                        moment = ti.static((moment_x, moment_y, moment_z))
                        bend(u, moment, by_column, (now + n) % 2, rows, cols + 2, i, b, bending_stiffness, dx, dy)
            for i, b in ti.ndrange(rows, (1, cols + 1)):
                if n < count:
                    u = ti.static((u_x, u_y, u_z))
                    d = ti.static((d_x, d_y, d_z))
                    moment = ti.static((moment_x, moment_y, moment_z))
                    stiffness = ti.static((along_rows, along_columns, diagonals))
                    step(
                        u, d, moment, stiffness, by_column, decay, loads, (now + n) % 2, rows, cols + 2, i, b, n,
                        keep, dx, dy, k_across, k_down, k_shear, t_across, t_down, t_shear, top,
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
        along_rows: ti.types.ndarray(dtype=vector, ndim=1),
        along_columns: ti.types.ndarray(dtype=vector, ndim=1),
        diagonals: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: ti.types.ndarray(dtype=vector, ndim=1),
    ):
        for i in range(rows):
            u = ti.static((u_x, u_y, u_z))
            d = ti.static((d_x, d_y, d_z))
            stiffness = ti.static((along_rows, along_columns, diagonals))
            width = cols + 2
            p = now * (rows + 2) + i + 1
            found = ti.Vector.zero(real, MEASURES)
            for b in range(1, cols + 1):
                measured = measure(u, d, by_column, stiffness, width, rows, p, i, b, dx, dy)
                found[LEAST] = ti.min(found[LEAST], measured[LEAST][0])
                found[MOST] = ti.max(found[MOST], measured[MOST][0])
                for m in ti.static(range(MOST + 1, MEASURES)):
                    found[m] += measured[m][0]
                for c in ti.static(range(3)):
                    wanted = ti.select(differences, d[c][i * width + b][0], u[c][p * width + b][0])
                    out[i, b - 1, c] = wanted
            for m in ti.static(range(MEASURES)):
                measures[i, m] = found[m]

    return Kernels(advance, read)
