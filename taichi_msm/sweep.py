"""Kernel 1 on a CPU: rows are swept one after another, every spring is evaluated once, nothing is copied.

Layout. Columns are cut into as many strips as a vector register has lanes; lane l of entry b of a row is column b - 1
of strip l, so that the neighbours of an entry are the entries beside it and every operation is one vector instruction.
The first and last entry of a row are a halo: the same strips moved by one lane.

Sweep. The row after row P is called ahead, the row before it behind. The springs from P to the row ahead give their
force to P at once and keep it for the row ahead, of which P is the row behind; the spring along the row keeps it for
the next entry. Then no other row needs P where it was, and P is stepped in place.

Passes. Two rows behind the first step of a sweep can follow the second one, and so on: a pass takes `depth` steps while
the rows are in the cache. Its k-th round brings row k from step n to n + 1, row k - 1 from n + 1 to n + 2, ...

Bands. Every worker has a band of rows. Neighbours sweep away from their common border, or toward it, so that they get
there at the same time. There each needs the other's row as it was before the step: both put it, after every step, into
one of two copies, and wait for the other's. The order in which forces are added does not depend on the way of a sweep;
so the bits of a result do not depend on the number of workers.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.forces import BYTES, Readings, SheetFields, Structure, point_step, spring_forces, start_kernel, strains
from taichi_msm.runtime import ITERATIONS_PER_THREAD, ti

# Integers between the progress counters of two workers, so that each has a cache line of its own.
COUNTER_STRIDE = 16

# Bytes of a page.
PAGE = 4096

# The borders of a band: where its worker begins and where it ends.
BEGIN, END = 0, 1


class _Fields(SheetFields):
    """The fields of a sheet that is swept."""

    def __init__(self, s: Structure) -> None:
        # Below the sheet's rows, for every worker and border, the two copies.
        super().__init__(s, s.rows + 4 * s.workers)
        # For every worker and step of a pass the forces of the row behind, with the sign of the force on that row.
        self.behind = [self.vector(s.workers * _slots(s), s.strip + 2) for _ in range(3)]
        # The number of steps that each border of each worker has done.
        self.done = self.place(ti.field(ti.i64), 2 * s.workers * COUNTER_STRIDE)
        self.allocate()


def _slots(s: Structure) -> int:
    """Rows of `behind` that a worker has: its steps, then a page, over which one core's prefetcher does not reach."""
    row_bytes = (s.strip + 2) * s.lanes * BYTES[s.precision]
    return s.depth - (-PAGE // row_bytes)


def _source(s: Structure) -> NDArray[np.int32]:
    """Tell which row of the sheet every stored row holds: below the sheet's own, the copies at the bands' borders."""
    rows = list(range(s.rows))
    first, end = _stepped(s)
    for worker in range(s.workers):
        low, high = (first + (end - first) * n // s.workers for n in (worker, worker + 1))
        borders = (low, high - 1) if worker % 2 else (high - 1, low)
        rows += [row for row in borders for _ in range(2)]
    return np.array(rows, np.int32)


def _stepped(s: Structure) -> tuple[int, int]:
    """Give the first row that is stepped and the one after the last."""
    return int(s.fixed_rows[0]), s.rows - int(s.fixed_rows[1])


class Sweep:
    """The state of a sheet in the memory of a CPU, and its kernels."""

    def __init__(self, s: Structure) -> None:
        # Of this sheet, also before it was put at rest: the workers' counters go on.
        self._steps = 0
        self._fields = _Fields(s)
        self._advance, self._read = _kernels(s, self._fields)
        self._start = start_kernel(s, self._fields)
        self._source = _source(s)

    def advance(self, count: int, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Take a number of steps in one launch.

        Args:
            count: how many.
            numbers: keep, dx, dy, stiffness of structural and shear springs, y of the first row.
            table: of the loads, shape (count, columns).
        """
        self._advance(self._steps, count, *numbers, table)
        self._steps += count

    def read(self, spacing: tuple[float, float], out: Readings) -> None:
        """Copy what is asked for, and measure every row.

        Args:
            spacing: dx and dy.
            out: what is filled.
        """
        self._read(*spacing, *out)

    def start(self, by_column: NDArray[Any], decay: NDArray[Any], *state: Any) -> None:
        """Put the sheet where it begins; the arguments are those of `forces.start_kernel`, without the stored rows."""
        self._start(by_column, decay, self._source, *state)

    def close(self) -> None:
        """Free the fields."""
        self._fields.close()


def _kernels(s: Structure, fields: _Fields) -> tuple[Any, Any]:
    """Compile the step and the read-out for one structure."""
    real = getattr(ti, s.precision)
    rows, cols, lanes, strip, workers, depth = s.rows, s.cols, s.lanes, s.strip, s.workers, s.depth
    structural_springs, shear_springs, columns = s.structural, s.shear, s.load_columns
    slots = _slots(s)
    first_row, end_row = _stepped(s)
    u, d, behind, done = fields.displacement, fields.difference, fields.behind, fields.done
    along, ahead = spring_forces(s, fields)
    move = point_step(s, fields)
    strain = strains(s, fields)

    @ti.func
    def sweep_row(p, q, there, i, slot, n, moving, keep, dx, dy, structural, shear, top, up, loads: ti.template()):
        """Sweep row i of the sheet, stored in row p, with row q ahead, which is up above; it is stepped if it moves."""
        zero = ti.Vector.zero(real, lanes)
        # Force by the left neighbour, but for its sign.
        left_x, left_y, left_z = zero, zero, zero
        # Forces for the row ahead: for the entry before this one, this one and the next one.
        last_x, last_y, last_z = zero, zero, zero
        here_x, here_y, here_z = zero, zero, zero
        next_x, next_y, next_z = zero, zero, zero
        if ti.static(structural_springs):
            x, y, z = along(p, 0, dx, structural)
            left_x, left_y, left_z = x, y, z
        if ti.static(shear_springs):
            x, y, z = ahead(p, q, 0, 1, dx, up, shear, there)
            next_x, next_y, next_z = x, y, z
        # Read once: the stores to the fields could change the table, for all that the compiler knows.
        now = [loads[n, c] for c in ti.static(range(columns))]
        for b in range(1, strip + 1):
            force_x, force_y, force_z = zero, zero, zero
            last_x, last_y, last_z = here_x, here_y, here_z
            here_x, here_y, here_z = next_x, next_y, next_z
            if ti.static(shear_springs):
                x, y, z = ahead(p, q, b, -1, dx, up, shear, there)
                force_x, force_y, force_z = x, y, z
                last_x += x
                last_y += y
                last_z += z
            if ti.static(structural_springs):
                x, y, z = ahead(p, q, b, 0, dx, up, structural, there)
                force_x += x
                force_y += y
                force_z += z
                here_x += x
                here_y += y
                here_z += z
            if ti.static(shear_springs):
                x, y, z = ahead(p, q, b, 1, dx, up, shear, there)
                force_x += x
                force_y += y
                force_z += z
                next_x, next_y, next_z = x, y, z
            force_x -= behind[0][slot, b]
            force_y -= behind[1][slot, b]
            force_z -= behind[2][slot, b]
            if ti.static(structural_springs):
                x, y, z = along(p, b, dx, structural)
                force_x += x - left_x
                force_y += y - left_y
                force_z += z - left_z
                left_x, left_y, left_z = x, y, z
            # What was there has been read when b was one less.
            behind[0][slot, b - 1] = last_x
            behind[1][slot, b - 1] = last_y
            behind[2][slot, b - 1] = last_z
            if moving:
                move(p, p, i, b, force_x, force_y, force_z, keep, dy, top, now)
        if ti.static(shear_springs):
            x, y, z = ahead(p, q, strip + 1, -1, dx, up, shear, there)
            here_x += x
            here_y += y
            here_z += z
        behind[0][slot, strip] = here_x
        behind[1][slot, strip] = here_y
        behind[2][slot, strip] = here_z

    @ti.func
    def join_strips(p):
        """Fill the halo of row p: beside the first column of a strip is the last one of the strip before."""
        for c in ti.static(range(3)):
            last = u[c][p, strip]
            first = u[c][p, 1]
            for lane in ti.static(range(lanes)):
                u[c][p, 0][lane] = last[(lane - 1) % lanes]
                u[c][p, strip + 1][lane] = first[(lane + 1) % lanes]

    @ti.func
    def copy_row(worker, border, n):
        """Where a worker keeps the row at a border after n steps."""
        return rows + 4 * worker + 2 * border + ti.cast(n % 2, ti.i32)

    @ti.func
    def wait(worker, border, n):
        """Wait until a worker has taken n steps at a border; gives the row where the result is."""
        while ti.atomic_add(done[(2 * worker + border) * COUNTER_STRIDE], 0) < n:
            pass
        return copy_row(worker, border, n)

    @ti.func
    def publish(worker, border, i, n):
        """Let the neighbour at a border have row i after n steps."""
        copy = copy_row(worker, border, n)
        for b in range(strip + 2):
            for c in ti.static(range(3)):
                u[c][copy, b] = u[c][i, b]
        ti.atomic_add(done[(2 * worker + border) * COUNTER_STRIDE], 1)

    @ti.kernel
    def advance(
        first: ti.i64,
        count: ti.i32,
        keep: real,
        dx: real,
        dy: real,
        structural: real,
        shear: real,
        top: real,
        loads: ti.types.ndarray(dtype=real, ndim=2),
    ):
        ti.loop_config(serialize=workers == 1)
        for index in range(workers * ITERATIONS_PER_THREAD):
            # One worker a thread.
            if index % ITERATIONS_PER_THREAD == 0:
                worker = index // ITERATIONS_PER_THREAD
                low = first_row + (end_row - first_row) * worker // workers
                high = first_row + (end_row - first_row) * (worker + 1) // workers
                way = 2 * (worker % 2) - 1
                begin = ti.select(way > 0, low, high - 1)
                neighbour = worker - way
                far_neighbour = worker + way
                for turn in range((count + depth - 1) // depth):
                    steps = ti.min(depth, count - turn * depth)
                    # Row -1 is the one behind the band, which gives its forces and stays.
                    for k in range(-1, high - low + steps - 1):
                        for step in range(ti.max(0, k - (high - low) + 1), ti.min(steps, k + 2)):
                            row = k - step
                            n = turn * depth + step
                            slot = worker * slots + step
                            i = begin + row * way
                            p = i
                            q = i + way
                            there = ti.cast(0 <= q < rows, real)
                            if ti.static(workers > 1):
                                if row == -1 and 0 <= neighbour < workers:
                                    p = wait(neighbour, BEGIN, first + n)
                                if row == high - low - 1 and 0 <= far_neighbour < workers:
                                    q = wait(far_neighbour, END, first + n)
                            q = ti.select(there > 0, q, i)
                            if 0 <= i < rows:
                                sweep_row(
                                    p, q, there, i, slot, n, row >= 0,
                                    keep, dx, dy, structural, shear, top, -way * dy, loads,
                                )  # fmt: skip
                            else:
                                for b in range(1, strip + 1):
                                    for c in ti.static(range(3)):
                                        behind[c][slot, b] = ti.Vector.zero(real, lanes)
                            if row >= 0:
                                join_strips(i)
                            if ti.static(workers > 1):
                                if row == 0:
                                    publish(worker, BEGIN, i, first + n + 1)
                                if row == high - low - 1:
                                    publish(worker, END, i, first + n + 1)

    @ti.kernel
    def read(
        dx: real,
        dy: real,
        differences: ti.i32,
        out: ti.types.ndarray(dtype=real, ndim=3),
        measures: ti.types.ndarray(dtype=real, ndim=2),
    ):
        ti.loop_config(serialize=workers == 1)
        for index in range(rows * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                i = index // ITERATIONS_PER_THREAD
                zero = ti.Vector.zero(real, lanes)
                least, along, down, diagonal, motion = zero, zero, zero, zero, zero
                for b in range(1, strip + 1):
                    shortest, right, below, across = strain(i, i + 1, b, dx, dy, i < rows - 1)
                    least = ti.min(least, shortest)
                    along += right
                    down += below
                    diagonal += across
                    for c in ti.static(range(3)):
                        change = d[c][i, b]
                        motion += change * change
                        wanted = ti.select(differences, change, u[c][i, b])
                        for lane in ti.static(range(lanes)):
                            if lane * strip + b <= cols:
                                out[i, lane * strip + b - 1, c] = wanted[lane]
                measures[i, 0] = least.min()
                for m, part in ti.static(enumerate((along, down, diagonal, motion))):
                    measures[i, m + 1] = part.sum()

    return advance, read
