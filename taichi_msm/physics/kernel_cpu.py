"""Kernel 1 on a CPU: rows are swept one after another, every spring is evaluated once, nothing is copied.

Layout. Columns are cut into as many strips as a vector register has lanes; lane l of entry b of a row is column b - 1
of strip l, so that the neighbours of an entry are the entries beside it and every operation is one vector instruction.
The first and last entry of a row are a halo: the same strips moved by one lane.

Sweep. The springs from a row to the other row, which is swept next, give their force to the row at once and carry it to
the other row; the spring along the row carries it to the next entry. Then no row needs this one where it was, and it is
stepped in place.

Passes. Two rows after the first step of a sweep can follow the second one, and so on: a pass takes `depth` steps while
the rows are in the cache. Its k-th round brings row k from step n to n + 1, row k - 1 from n + 1 to n + 2, ...

Bands. Every worker has a band of rows. Neighbours sweep away from their common border, or toward it, so that they get
there at the same time. There each needs the other's row as it was before the step: both put it, after every step, into
one of two copies, and wait for the other's. The order in which forces are added does not depend on the way of a sweep;
so the bits of a result do not depend on the number of workers.

Company. A worker that waits spins, for some time at most: its partner may have no core, as another program has it. Then
it writes down where it is and ends, which gives its core away, and another launch goes on from there, until all
have taken the same steps. Then a single worker takes over for some time.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import time
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.kernel import (
    BYTES,
    HAS_LEFT,
    HAS_RIGHT,
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
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, our_compilation, ti

# Integers between the counters of two workers, so that each has a cache line of its own.
COUNTER_STRIDE = 16

# Bytes of a page.
PAGE = 4096

# The borders of a band: where its worker begins and where it ends.
BEGIN, END = 0, 1

# A worker looks so often whether its partner is there: some 0.2 ms.
PATIENCE = 40_000

# After a launch in which one gave up a single worker steps for some time [s], the longer the more often it happens.
SHORTEST_REST, LONGEST_REST = 0.002, 1.0

# Where a worker is: pass, round and step of the round.
PLACE = 3


class Kernels(NamedTuple):
    """The kernels of one code."""

    advance_alone: Callable[..., None]
    advance_together: Callable[..., None]
    read_alone: Callable[..., None]
    read_together: Callable[..., None]
    copy: Callable[..., None]


class Sweep:
    """The state of a sheet in the memory of a CPU, and its kernels.

    Args:
        s: how it lies in memory.
        start: what its arrays hold at the start.
    """

    def __init__(self, s: Structure, start: Start) -> None:
        self._s = s
        self._kernels = _kernels(s.code)
        self._steps = 0
        self._rest, self._rests_until = SHORTEST_REST, 0.0
        self._first_row, self._end_row = int(s.fixed_rows[0]), s.rows - int(s.fixed_rows[1])
        # Below the sheet's rows, for every worker and border, the two copies.
        self._borders = self._border_rows()
        stored = np.concatenate([np.arange(s.rows, dtype=np.int32), self._borders])
        self._arrays = SheetArrays(s, stored, start)
        # Rows of `carried` that a worker has: its steps, then a page, over which one core's prefetcher does not reach.
        self._carried_rows = s.depth - (-PAGE // (s.width * s.code.lanes * BYTES[s.code.precision]))
        # For every worker and step of a pass the forces carried to a row, with the sign of those on the row before.
        self._carried = [self._arrays.rows(s.workers * self._carried_rows) for _ in range(3)]
        # The number of steps that each border of each worker has done.
        self._done = np.zeros(2 * s.workers * COUNTER_STRIDE, np.int64)

    def advance(self, count: int, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Take a number of steps.

        Args:
            count: how many.
            numbers: keep, dx, dy, stiffness of structural and shear springs, y of the first row.
            table: of the loads, shape (count, columns).
        """
        together = self._s.workers > 1 and time.perf_counter() >= self._rests_until
        done = self._advance_together(count, numbers, table) if together else 0
        if not together or done < count:
            self._advance_alone(done, count, numbers, table)

    def compile(self, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Compile all that steps may need, without taking one."""
        self._rests_until = 0.0
        self.advance(0, numbers, table)
        if self._s.workers > 1:
            self._advance_alone(0, 0, numbers, table)

    def set_decay(self, decay: NDArray[Any]) -> None:
        """Let standing slots act elsewhere, or otherwise; shape (slots, rows, cols)."""
        self._arrays.set_decay(decay)

    def read(self, spacing: tuple[float, float], out: ReadArguments) -> None:
        """Copy what is asked for, and measure every row.

        Args:
            spacing: dx and dy.
            out: what is filled.
        """
        s, arrays = self._s, self._arrays
        read = self._kernels.read_together if s.workers > 1 else self._kernels.read_alone
        with our_compilation():
            read(*arrays.u, *arrays.d, arrays.by_column, s.rows, s.cols, s.strip, *spacing, *out)

    def _advance_alone(self, done: int, count: int, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Take the steps after those that are done with a single worker."""
        self._launch(self._kernels.advance_alone, 1, done, count - done, numbers, table, np.array([0, -1, 0]))
        if self._s.workers > 1:
            with our_compilation():
                self._kernels.copy(*self._arrays.u, self._borders, self._s.rows, self._s.width)
            self._done[:] = self._steps

    def _advance_together(self, count: int, numbers: tuple[float, ...], table: NDArray[Any]) -> int:
        """Take steps with all workers; gives how many, which are fewer when there is company."""
        s = self._s
        places = np.tile(np.array([0, -1, 0]), s.workers)
        first = self._steps
        self._launch(self._kernels.advance_together, s.workers, 0, count, numbers, table, places)
        passes, rounds = places[::PLACE], places[1::PLACE]
        if (passes * s.depth >= count).all():
            self._rest = max(self._rest / 2, SHORTEST_REST)
            return count
        self._rests_until = time.perf_counter() + self._rest
        self._rest = min(4 * self._rest, LONGEST_REST)
        # All meet at the end of the pass that the first of them is in.
        count = min(count, int((passes + (rounds >= 0)).max()) * s.depth)
        while not (passes * s.depth >= count).all():
            self._steps = first
            self._launch(self._kernels.advance_together, s.workers, 0, count, numbers, table, places)
        self._steps = first + count
        return count

    def _launch(
        self,
        kernel: Callable[..., None],
        workers: int,
        done: int,
        count: int,
        numbers: tuple[float, ...],
        table: NDArray[Any],
        places: NDArray[np.int64],
    ) -> None:
        s, arrays = self._s, self._arrays
        with our_compilation():
            kernel(
                self._steps, count, workers, s.depth, self._carried_rows, s.rows, s.strip,
                self._first_row, self._end_row, PATIENCE, *numbers, table[done:],
                *arrays.u, *arrays.d, *self._carried, arrays.by_column, arrays.decay, self._done, places,
            )  # fmt: skip
        self._steps += count

    def _border_rows(self) -> NDArray[np.int32]:
        """Tell which row of the sheet every copy at a border of a band is of."""
        rows: list[int] = []
        first, end, workers = self._first_row, self._end_row, self._s.workers
        for worker in range(workers):
            low, high = (first + (end - first) * n // workers for n in (worker, worker + 1))
            borders = (low, high - 1) if worker % 2 else (high - 1, low)
            rows += [row for row in borders for _ in range(2)]
        return np.array(rows, np.int32)


@cache
def _kernels(code: Code) -> Kernels:
    """Make the kernels of one code; each is compiled when it is first launched."""
    return Kernels(
        _advance(code, parallel=False),
        _advance(code, parallel=True),
        _read(code, parallel=False),
        _read(code, parallel=True),
        _copy(code),
    )


def _advance(code: Code, *, parallel: bool) -> Callable[..., None]:
    """Make the kernel that takes steps, by one worker or several."""
    real, vector, lanes, columns = code.real, code.vector, code.lanes, code.load_columns
    structural_springs, shear_springs, open_edges = code.structural, code.shear, code.open_edges
    along, to_other_row = spring_forces(code)
    move = point_step(code)

    @ti.func
    def sweep_row(
        u: ti.template(), d: ti.template(), carried: ti.template(), by_column: ti.template(), decay: ti.template(),
        loads: ti.template(), rows, strip, p, q, exists, i, kind, carried_row, n, moving,
        keep, dx, dy, structural, shear, top, up,
    ):  # fmt: skip
        """Sweep row i of the sheet, stored in row p; row q is the other row, up above it; it is stepped if it moves."""
        width = strip + 2
        diagonal = ti.sqrt(dx * dx + dy * dy)
        # Displacements of the entry, in its row and in the other row, of the one before it and the one after it.
        here_x, here_y, here_z = u[0][p * width + 0], u[1][p * width + 0], u[2][p * width + 0]
        next_x, next_y, next_z = u[0][p * width + 1], u[1][p * width + 1], u[2][p * width + 1]
        before_x, before_y, before_z = u[0][q * width + 0], u[1][q * width + 0], u[2][q * width + 0]
        beside_x, beside_y, beside_z = u[0][q * width + 1], u[1][q * width + 1], u[2][q * width + 1]
        # Force by the left neighbour, but for its sign.
        left_x, left_y, left_z = vector(0), vector(0), vector(0)
        # Forces carried to the other row: for the entry before this one, this one and the next one.
        last_x, last_y, last_z = vector(0), vector(0), vector(0)
        this_x, this_y, this_z = vector(0), vector(0), vector(0)
        coming_x, coming_y, coming_z = vector(0), vector(0), vector(0)
        has_left, has_right = vector(1), vector(1)
        if ti.static(open_edges):
            has_right = by_column[HAS_RIGHT * width + 0]
        if ti.static(structural_springs):
            x, y, z = along(next_x - here_x, next_y - here_y, next_z - here_z, dx, structural, has_right)
            left_x, left_y, left_z = x, y, z
        if ti.static(shear_springs):
            x, y, z = to_other_row(
                beside_x - here_x, beside_y - here_y, beside_z - here_z, 1, dx, up, diagonal, shear, has_right * exists
            )
            coming_x, coming_y, coming_z = x, y, z
        # Read once: the stores to the arrays could change the table, for all that the compiler knows.
        now = [loads[n, c] for c in ti.static(range(columns))]
        for b in range(1, strip + 1):
            here_x, here_y, here_z = next_x, next_y, next_z
            next_x, next_y, next_z = u[0][p * width + b + 1], u[1][p * width + b + 1], u[2][p * width + b + 1]
            after_x, after_y, after_z = u[0][q * width + b + 1], u[1][q * width + b + 1], u[2][q * width + b + 1]
            force_x, force_y, force_z = vector(0), vector(0), vector(0)
            last_x, last_y, last_z = this_x, this_y, this_z
            this_x, this_y, this_z = coming_x, coming_y, coming_z
            if ti.static(open_edges):
                has_left, has_right = by_column[HAS_LEFT * width + b], by_column[HAS_RIGHT * width + b]
            if ti.static(shear_springs):
                x, y, z = to_other_row(
                    before_x - here_x, before_y - here_y, before_z - here_z,
                    -1, dx, up, diagonal, shear, has_left * exists,
                )  # fmt: skip
                force_x, force_y, force_z = x, y, z
                last_x += x
                last_y += y
                last_z += z
            if ti.static(structural_springs):
                x, y, z = to_other_row(
                    beside_x - here_x, beside_y - here_y, beside_z - here_z,
                    0, dx, up, ti.abs(up), structural, exists,
                )  # fmt: skip
                force_x += x
                force_y += y
                force_z += z
                this_x += x
                this_y += y
                this_z += z
            if ti.static(shear_springs):
                x, y, z = to_other_row(
                    after_x - here_x, after_y - here_y, after_z - here_z, 1, dx, up, diagonal, shear, has_right * exists
                )
                force_x += x
                force_y += y
                force_z += z
                coming_x, coming_y, coming_z = x, y, z
            force_x = force_x - carried[0][carried_row * width + b]
            force_y = force_y - carried[1][carried_row * width + b]
            force_z = force_z - carried[2][carried_row * width + b]
            if ti.static(structural_springs):
                x, y, z = along(next_x - here_x, next_y - here_y, next_z - here_z, dx, structural, has_right)
                force_x += x - left_x
                force_y += y - left_y
                force_z += z - left_z
                left_x, left_y, left_z = x, y, z
            # What was there has been read when b was one less.
            carried[0][carried_row * width + b - 1] = last_x
            carried[1][carried_row * width + b - 1] = last_y
            carried[2][carried_row * width + b - 1] = last_z
            if moving:
                move(
                    u, d, by_column, decay, rows, width, p, i, b, kind, here_x, here_y, here_z,
                    force_x, force_y, force_z, keep, dy, top, now,
                )  # fmt: skip
            before_x, before_y, before_z = beside_x, beside_y, beside_z
            beside_x, beside_y, beside_z = after_x, after_y, after_z
        if ti.static(shear_springs):
            if ti.static(open_edges):
                has_left = by_column[HAS_LEFT * width + strip + 1]
            x, y, z = to_other_row(
                before_x - next_x, before_y - next_y, before_z - next_z, -1, dx, up, diagonal, shear, has_left * exists
            )
            this_x += x
            this_y += y
            this_z += z
        carried[0][carried_row * width + strip] = this_x
        carried[1][carried_row * width + strip] = this_y
        carried[2][carried_row * width + strip] = this_z

    @ti.func
    def join_strips(u: ti.template(), p, strip):
        """Fill the halo of row p: beside the first column of a strip is the last one of the strip before."""
        width = strip + 2
        for c in ti.static(range(3)):
            last = u[c][p * width + strip]
            first = u[c][p * width + 1]
            u[c][p * width + 0] = vector([last[(lane - 1) % lanes] for lane in ti.static(range(lanes))])
            u[c][p * width + strip + 1] = vector([first[(lane + 1) % lanes] for lane in ti.static(range(lanes))])

    @ti.func
    def copy_row(rows, worker, border, n):
        """Where a worker keeps the row at a border after n steps."""
        return rows + 4 * worker + 2 * border + ti.cast(n % 2, ti.i32)

    @ti.func
    def has_come(done: ti.template(), worker, border, n, patience):
        """Wait until a worker has taken n steps at a border, but not for long; tells whether it has."""
        steps = ti.atomic_add(done[(2 * worker + border) * COUNTER_STRIDE], 0)
        looks = 0
        while steps < n and looks < patience:
            steps = ti.atomic_add(done[(2 * worker + border) * COUNTER_STRIDE], 0)
            looks += 1
        return steps >= n

    @ti.func
    def publish(u: ti.template(), done: ti.template(), rows, strip, worker, border, i, n):
        """Let the neighbour at a border have row i after n steps."""
        width = strip + 2
        copy = copy_row(rows, worker, border, n)
        for b in range(width):
            for c in ti.static(range(3)):
                u[c][copy * width + b] = u[c][i * width + b]
        ti.atomic_add(done[(2 * worker + border) * COUNTER_STRIDE], 1)

    @ti.kernel
    def advance(
        first: ti.i64,
        count: ti.i32,
        workers: ti.i32,
        depth: ti.i32,
        carried_rows: ti.i32,
        rows: ti.i32,
        strip: ti.i32,
        first_row: ti.i32,
        end_row: ti.i32,
        patience: ti.i32,
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
        carried_x: ti.types.ndarray(dtype=vector, ndim=1),
        carried_y: ti.types.ndarray(dtype=vector, ndim=1),
        carried_z: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: ti.types.ndarray(dtype=vector, ndim=1),
        decay: ti.types.ndarray(dtype=vector, ndim=1),
        done: ti.types.ndarray(dtype=ti.i64, ndim=1),
        places: ti.types.ndarray(dtype=ti.i64, ndim=1),
    ):
        ti.loop_config(serialize=not parallel)
        for index in range(workers * ITERATIONS_PER_THREAD):
            # One worker a thread.
            if index % ITERATIONS_PER_THREAD == 0:
                u = ti.static((u_x, u_y, u_z))
                d = ti.static((d_x, d_y, d_z))
                carried = ti.static((carried_x, carried_y, carried_z))
                width = strip + 2
                worker = index // ITERATIONS_PER_THREAD
                low = first_row + (end_row - first_row) * worker // workers
                high = first_row + (end_row - first_row) * (worker + 1) // workers
                way = 2 * (worker % 2) - 1
                begin = ti.select(way > 0, low, high - 1)
                neighbour = worker - way
                far_neighbour = worker + way
                turn = ti.cast(places[PLACE * worker], ti.i32)
                k = ti.cast(places[PLACE * worker + 1], ti.i32)
                step = ti.cast(places[PLACE * worker + 2], ti.i32)
                goes = True
                while goes and turn * depth < count:
                    steps = ti.min(depth, count - turn * depth)
                    # Row -1 is the one before the band, which gives its forces and stays.
                    while goes and k < high - low + steps - 1:
                        while goes and step < ti.min(steps, k + 2):
                            row = k - step
                            n = turn * depth + step
                            carried_row = worker * carried_rows + step
                            i = begin + row * way
                            p = i
                            q = i + way
                            exists = ti.cast(0 <= q < rows, real)
                            if ti.static(parallel):
                                if row == -1 and 0 <= neighbour < workers:
                                    goes = has_come(done, neighbour, BEGIN, first + n, patience)
                                    p = copy_row(rows, neighbour, BEGIN, first + n)
                                if row == high - low - 1 and 0 <= far_neighbour < workers:
                                    goes = has_come(done, far_neighbour, END, first + n, patience)
                                    q = copy_row(rows, far_neighbour, END, first + n)
                            if goes:
                                q = ti.select(exists > 0, q, i)
                                if 0 <= i < rows:
                                    kind = ti.select(i == rows - 1, MOVES + 2, ti.select(i == 0, MOVES, MOVES + 1))
                                    sweep_row(
                                        u, d, carried, by_column, decay, loads, rows, strip,
                                        p, q, exists, i, kind, carried_row, n, row >= 0,
                                        keep, dx, dy, structural, shear, top, -way * dy,
                                    )  # fmt: skip
                                else:
                                    for b in range(1, strip + 1):
                                        for c in ti.static(range(3)):
                                            carried[c][carried_row * width + b] = vector(0)
                                if row >= 0:
                                    join_strips(u, i, strip)
                                if ti.static(parallel):
                                    if row == 0:
                                        publish(u, done, rows, strip, worker, BEGIN, i, first + n + 1)
                                    if row == high - low - 1:
                                        publish(u, done, rows, strip, worker, END, i, first + n + 1)
                                step += 1
                        if goes:
                            k += 1
                            step = ti.max(0, k - (high - low) + 1)
                    if goes:
                        turn += 1
                        k = -1
                        step = 0
                places[PLACE * worker] = turn
                places[PLACE * worker + 1] = k
                places[PLACE * worker + 2] = step

    return advance


def _read(code: Code, *, parallel: bool) -> Callable[..., None]:
    """Make the kernel that reads a sheet out, and measures it, by one thread or several."""
    real, vector, lanes = code.real, code.vector, code.lanes
    strain = strains(code)

    @ti.kernel
    def read(
        u_x: ti.types.ndarray(dtype=vector, ndim=1),
        u_y: ti.types.ndarray(dtype=vector, ndim=1),
        u_z: ti.types.ndarray(dtype=vector, ndim=1),
        d_x: ti.types.ndarray(dtype=vector, ndim=1),
        d_y: ti.types.ndarray(dtype=vector, ndim=1),
        d_z: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: ti.types.ndarray(dtype=vector, ndim=1),
        rows: ti.i32,
        cols: ti.i32,
        strip: ti.i32,
        dx: real,
        dy: real,
        differences: ti.i32,
        out: ti.types.ndarray(dtype=real, ndim=3),
        measures: ti.types.ndarray(dtype=real, ndim=2),
    ):
        ti.loop_config(serialize=not parallel)
        for index in range(rows * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                u = ti.static((u_x, u_y, u_z))
                d = ti.static((d_x, d_y, d_z))
                width = strip + 2
                i = index // ITERATIONS_PER_THREAD
                least, along, down, diagonal, motion = vector(0), vector(0), vector(0), vector(0), vector(0)
                for b in range(1, strip + 1):
                    shortest, right, below, across = strain(u, by_column, width, i, i + 1, b, dx, dy, i < rows - 1)
                    least = ti.min(least, shortest)
                    along += right
                    down += below
                    diagonal += across
                    for c in ti.static(range(3)):
                        change = d[c][i * width + b]
                        motion += change * change
                        wanted = ti.select(differences, change, u[c][i * width + b])
                        for lane in ti.static(range(lanes)):
                            if lane * strip + b <= cols:
                                out[i, lane * strip + b - 1, c] = wanted[lane]
                measures[i, 0] = least.min()
                for m, part in ti.static(enumerate((along, down, diagonal, motion))):
                    measures[i, m + 1] = part.sum()

    return read


def _copy(code: Code) -> Callable[..., None]:
    """Make the kernel that renews the copies of the rows at the borders of bands."""
    vector = code.vector

    @ti.kernel
    def copy(
        u_x: ti.types.ndarray(dtype=vector, ndim=1),
        u_y: ti.types.ndarray(dtype=vector, ndim=1),
        u_z: ti.types.ndarray(dtype=vector, ndim=1),
        borders: ti.types.ndarray(dtype=ti.i32, ndim=1),
        rows: ti.i32,
        width: ti.i32,
    ):
        for n, b in ti.ndrange(borders.shape[0], width):
            for u in ti.static((u_x, u_y, u_z)):
                u[(rows + n) * width + b] = u[borders[n] * width + b]

    return copy
