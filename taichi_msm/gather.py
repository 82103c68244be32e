"""Kernel 1 on a GPU: every point is a thread that gathers the forces of its eight springs; every step is a loop.

The layout is the plain one: one lane, an entry a column, around the sheet a halo. u_n and u_{n+1} take turns.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.forces import (
    MEASURES,
    Readings,
    SheetFields,
    Structure,
    point_step,
    spring_forces,
    start_kernel,
    strains,
)
from taichi_msm.runtime import ti

# A launch is a chain of this many kernels, one a step.
STEPS_PER_LAUNCH = 8


class _Fields(SheetFields):
    """The fields of a sheet whose points gather."""

    def __init__(self, s: Structure) -> None:
        super().__init__(s, 2 * (s.rows + 2))
        self.allocate()


class Gather:
    """The state of a sheet in the memory of a GPU, and its kernels. Methods are those of `sweep.Sweep`."""

    def __init__(self, s: Structure) -> None:
        # Which of the two buffers holds u_n.
        self._now = 0
        self._fields = _Fields(s)
        self._advance, self._read = _kernels(s, self._fields)
        self._start = start_kernel(s, self._fields)
        # Both buffers hold the sheet, each within its halo.
        halved = np.pad(np.arange(s.rows, dtype=np.int32), 1, constant_values=-1)
        self._source = np.concatenate([halved, halved])

    def advance(self, count: int, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Take at most STEPS_PER_LAUNCH steps."""
        self._advance(self._now, count, *numbers, table)
        self._now = (self._now + count) % 2

    def read(self, spacing: tuple[float, float], out: Readings) -> None:
        """Copy what is asked for, and measure every row."""
        self._read(self._now, *spacing, *out)

    def start(self, by_column: NDArray[Any], decay: NDArray[Any], *state: Any) -> None:
        """Put the sheet where it begins."""
        self._start(by_column, decay, self._source, *state)

    def close(self) -> None:
        """Free the fields."""
        self._fields.close()


def _kernels(s: Structure, fields: _Fields) -> tuple[Any, Any]:
    """Compile the step and the read-out for one structure."""
    real = getattr(ti, s.precision)
    rows, cols = s.rows, s.cols
    structural_springs, shear_springs, columns = s.structural, s.shear, s.load_columns
    u, d = fields.displacement, fields.difference
    along, ahead = spring_forces(s, fields)
    move = point_step(s, fields)
    strain = strains(s, fields)

    @ti.func
    def by_row(p, q, b, there, dx, up, structural, shear):
        """Force on entry b of row p by the row q, which is up above: summed as a sweep does."""
        force_x, force_y, force_z = ti.Vector.zero(real, 1), ti.Vector.zero(real, 1), ti.Vector.zero(real, 1)
        for right in ti.static((-1, 0, 1)):
            if ti.static(structural_springs if right == 0 else shear_springs):
                stiffness = shear
                if ti.static(right == 0):
                    stiffness = structural
                x, y, z = ahead(p, q, b, right, dx, up, stiffness, there)
                force_x += x
                force_y += y
                force_z += z
        return force_x, force_y, force_z

    @ti.func
    def step(now, i, b, n, keep, dx, dy, structural, shear, top, loads: ti.template()):
        """Step point (i, b - 1): now is the buffer of u_n, n the row of the table."""
        p = now * (rows + 2) + i + 1
        force_x, force_y, force_z = by_row(p, p + 1, b, ti.cast(i < rows - 1, real), dx, -dy, structural, shear)
        x, y, z = by_row(p, p - 1, b, ti.cast(i > 0, real), dx, dy, structural, shear)
        force_x += x
        force_y += y
        force_z += z
        if ti.static(structural_springs):
            right_x, right_y, right_z = along(p, b, dx, structural)
            left_x, left_y, left_z = along(p, b - 1, dx, structural)
            force_x += right_x - left_x
            force_y += right_y - left_y
            force_z += right_z - left_z
        row = [loads[n, c] for c in ti.static(range(columns))]
        move(p, (1 - now) * (rows + 2) + i + 1, i, b, force_x, force_y, force_z, keep, dy, top, row)

    @ti.kernel
    def advance(
        now: ti.i32,
        count: ti.i32,
        keep: real,
        dx: real,
        dy: real,
        structural: real,
        shear: real,
        top: real,
        loads: ti.types.ndarray(dtype=real, ndim=2),
    ):
        for n in ti.static(range(STEPS_PER_LAUNCH)):
            for i, b in ti.ndrange(rows, (1, cols + 1)):
                if n < count:
                    step((now + n) % 2, i, b, n, keep, dx, dy, structural, shear, top, loads)

    @ti.kernel
    def read(
        now: ti.i32,
        dx: real,
        dy: real,
        differences: ti.i32,
        out: ti.types.ndarray(dtype=real, ndim=3),
        measures: ti.types.ndarray(dtype=real, ndim=2),
    ):
        for i in range(rows):
            p = now * (rows + 2) + i + 1
            found = ti.Vector.zero(real, MEASURES)
            for b in range(1, cols + 1):
                least, along, down, diagonal = strain(p, p + 1, b, dx, dy, i < rows - 1)
                found[0] = ti.min(found[0], least[0])
                found[1] += along[0]
                found[2] += down[0]
                found[3] += diagonal[0]
                for c in ti.static(range(3)):
                    change = d[c][i, b][0]
                    found[4] += change * change
                    out[i, b - 1, c] = ti.select(differences, change, u[c][p, b][0])
            for m in ti.static(range(MEASURES)):
                measures[i, m] = found[m]

    return advance, read
