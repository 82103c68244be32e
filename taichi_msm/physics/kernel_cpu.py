"""Kernel 1 on a CPU: rows are swept one after another, every spring is evaluated once, and rows are stepped in place.

Layout. Columns are cut into as many strips as a vector register has lanes. Lane l of entry b of a row is column b - 1
of strip l, so the neighbours of an entry are the entries beside it, and every operation is one vector instruction. The
first and the last entry of a row are a halo: the entries at the other end of the strips, shifted by one lane.

Sweep. A sweep visits the rows in turn. The force of a spring between this row and the next one is added to this row at
once and carried to the next; the force of a spring along the row is carried to the next entry. After that no other row
depends on the old displacements of this row, so it is stepped in place.

Passes. The second step can follow the first with a distance of one row, the third step the second, and so on: a pass
takes `depth` steps while the rows are in the cache. Round k of a pass takes row k from step n to n + 1, row k - 1 from
n + 1 to n + 2, and so on.

Bands. Every worker has a band of rows. Neighbouring workers sweep away from their common border or toward it, so that
they arrive there at the same time. Each needs the other's row at the border as it was before the step: after every step
each copies its row, into one of two buffers by turns, and waits for the other's copy. The order in which forces are
added does not depend on the direction of a sweep, so the bits of a result do not depend on the number of workers.

Bending. A moment is the Laplacian of the displacements, and the force on a row is the Laplacian of the moments. So
before a row is stepped, the moments of the row ahead are computed, which depend on one row more. A pass is then one
step, and neighbours copy two rows.

Giving up. A waiting worker spins, but not for long: another program may have taken its neighbour's core. It then
records its place and ends, which frees its own core. Further launches continue from the recorded places until all
workers have taken the same steps. After that a single worker takes over for some time.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import time
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.kernel import (
    AREA,
    BYTES,
    HAS_LEFT,
    HAS_RIGHT,
    LEAST,
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
from taichi_msm.system import resources
from taichi_msm.system.compiler import chosen
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, our_compilation, ti

# Integers between the counters of two workers, so that each has a cache line of its own.
COUNTER_STRIDE = 16

# Bytes of a page.
PAGE = 4096

# The borders of a band: where its worker begins and where it ends.
BEGIN, END = 0, 1

# How many times a worker looks for its neighbour before it gives up: for about 1.3 ms.
PATIENCE = round(1.32e-3 / chosen().look)

# After a worker has given up, a single worker steps for some time [s]. Where other programs want the cores, that is
# four times the last such rest, halved for every HALF_LIFE that all workers have stepped since then; else it is the
# shortest.
SHORTEST_REST, LONGEST_REST, HALF_LIFE = 0.002, 0.2, 0.02

# Other programs want the cores if threads have waited for one for this share of the time that they have had one.
CROWDED = 0.2

# Numbers that record the place of a worker: pass, round and step of the round.
PLACE = 3

# Number of rows of moments that a worker needs at a time.
MOMENTS = 3


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
        s: how the sheet is laid out in memory.
        start: what the arrays hold at the start.
    """

    def __init__(self, s: Structure, start: Start) -> None:
        self._s = s
        self._kernels = _kernels(s.code)
        self._steps = 0
        self._rest = self._rests_until = 0.0
        # Time that all workers have stepped undisturbed since the last rest [s].
        self._together = 0.0
        # At the end of the last rest: the time that this process's threads had had a core, and had waited for one [s].
        self._had, self._waited = 0.0, 0.0
        self._first_row, self._end_row = int(s.fixed_rows[0]), s.rows - int(s.fixed_rows[1])
        # Stored after the sheet's own rows: two copies for every border of every worker.
        self._borders = self._border_rows()
        stored = np.concatenate([np.arange(s.rows, dtype=np.int32), self._borders])
        self._arrays = SheetArrays(s, stored, start)
        # Rows of `carried` per worker: one for each step of a pass, and then a page, which no prefetcher crosses.
        self._carried_rows = s.depth - (-PAGE // (s.width * s.code.lanes * BYTES[s.code.precision]))
        # Forces carried to the next row, for every worker and step of a pass.
        self._carried = [self._arrays.rows(s.workers * self._carried_rows) for _ in range(3)]
        self._moment = [self._arrays.rows(MOMENTS * s.workers if s.code.bending else 1) for _ in range(3)]
        # The number of steps taken at each border of each worker.
        self._done = np.zeros(2 * s.workers * COUNTER_STRIDE, np.int64)

    def advance(self, count: int, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Take a number of steps.

        Args:
            count: how many.
            numbers: keep, dx, dy; stiffness and then tension of springs along rows, along columns and of diagonals;
                D dx dy; y of the first row.
            table: of the loads, shape (count, columns).
        """
        if self._s.workers == 1:
            self._advance_alone(0, count, numbers, table)
            return
        done = 0
        while done < count:
            if time.perf_counter() < self._rests_until:
                done = self._advance_while_resting(done, count, numbers, table)
            else:
                done = self._advance_together(done, count, numbers, table)

    def compile(self, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Compile everything that steps may need, without taking one."""
        self._advance_alone(0, 0, numbers, table)
        if self._s.workers > 1:
            self._launch_together(0, 0, numbers, table)
            self._copy_borders()

    def set_decay(self, decay: NDArray[Any]) -> None:
        """Replace the decays of the standing slots, shape (slots, rows, cols)."""
        self._arrays.set_decay(decay)

    def read(self, spacing: tuple[float, float], out: ReadArguments) -> None:
        """Copy displacements or differences, and measure every row.

        Args:
            spacing: dx and dy [m].
            out: which of them, and where to.
        """
        s, arrays = self._s, self._arrays
        read = self._kernels.read_together if s.workers > 1 else self._kernels.read_alone
        with our_compilation():
            read(
                *arrays.u, *arrays.d, arrays.by_column, *arrays.stiffness, s.rows, s.cols, s.strip, *spacing, *out
            )  # fmt: skip

    def _advance_alone(self, done: int, end: int, numbers: tuple[float, ...], table: NDArray[Any]) -> None:
        """Take the steps from `done` to `end` with a single worker."""
        self._launch(self._kernels.advance_alone, 1, done, end - done, numbers, table, np.array([0, -1, 0]))

    def _advance_while_resting(self, done: int, end: int, numbers: tuple[float, ...], table: NDArray[Any]) -> int:
        """Take steps with a single worker until it is time for all of them; returns how many are done."""
        # How long a step takes is not known, so pieces begin small and double.
        piece = self._s.depth
        while done < end and time.perf_counter() < self._rests_until:
            until = min(done + piece, end)
            self._advance_alone(done, until, numbers, table)
            done, piece = until, 2 * piece
        self._copy_borders()
        return done

    def _advance_together(self, done: int, end: int, numbers: tuple[float, ...], table: NDArray[Any]) -> int:
        """Take steps with all workers; returns how many are done, which may be fewer than `end` if a worker gave up."""
        if self._rests_until:
            # The rest itself tells nothing: a single worker waits for no core.
            self._had, self._waited = time.process_time(), resources.waited_for_cores() or 0.0
            self._rests_until = 0.0
        start = time.perf_counter()
        count, gave_up = self._launch_together(done, end, numbers, table)
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
        had, waited = time.process_time(), resources.waited_for_cores()
        return waited is None or waited - self._waited > CROWDED * (had - self._had)

    def _launch_together(
        self, done: int, end: int, numbers: tuple[float, ...], table: NDArray[Any]
    ) -> tuple[int, bool]:
        """Launch all workers; returns how many steps they have taken, and whether one gave up."""
        s, count, first = self._s, end - done, self._steps
        places = np.tile(np.array([0, -1, 0]), s.workers)
        self._launch(self._kernels.advance_together, s.workers, done, count, numbers, table, places)
        passes, rounds = places[::PLACE], places[1::PLACE]
        gave_up = not (passes * s.depth >= count).all()
        if gave_up:
            # All continue to the end of the pass that the foremost of them is in.
            count = min(count, int((passes + (rounds >= 0)).max()) * s.depth)
            while not (passes * s.depth >= count).all():
                self._steps = first
                self._launch(self._kernels.advance_together, s.workers, done, count, numbers, table, places)
            self._steps = first + count
        return count, gave_up

    def _copy_borders(self) -> None:
        """Bring the copies of the rows at the borders of bands up to date, after steps of a single worker."""
        with our_compilation():
            self._kernels.copy(*self._arrays.u, self._borders, self._s.rows, self._s.width)
        self._done[:] = self._steps

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
                *arrays.u, *arrays.d, *self._carried, *self._moment, *arrays.stiffness,
                arrays.by_column, arrays.decay, self._done, places,
            )  # fmt: skip
        self._steps += count

    def _border_rows(self) -> NDArray[np.int32]:
        """List for every copy at a border of a band the row of the sheet that it is a copy of."""
        rows: list[int] = []
        first, end, workers = self._first_row, self._end_row, self._s.workers
        for worker in range(workers):
            low, high = (first + (end - first) * n // workers for n in (worker, worker + 1))
            near, far = (low, high - 1) if worker % 2 else (high - 1, low)
            # The row at the border and, with bending, the one behind it; each after even and after odd steps.
            inward = 1 if worker % 2 else -1
            for border in ((near, near + inward), (far, far - inward)):
                rows += [*border[: self._s.code.border_rows]] * 2
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
    """Make the kernel that takes steps, with one worker or several."""
    real, vector, lanes, columns = code.real, code.vector, code.lanes, code.load_columns
    structural_springs, shear_springs, bending = code.structural, code.shear, code.bending
    # With a map, the stiffness is 0 where there is no spring.
    mapped, open_edges = code.mapped, code.open_edges and not code.mapped
    by_area, border_rows = open_edges and code.by_area, code.border_rows
    along, to_other_row = spring_forces(code)
    move, laplacian = point_step(code), five_point()

    @ti.func
    def of_springs(stiffness: ti.template(), family: ti.template(), entry, uniform):
        """Stiffness of the springs of a family at an entry of their array."""
        if ti.static(mapped):
            return stiffness[family][entry]
        else:  # noqa: RET505  # Taichi would compile the rest as well.
            return uniform

    @ti.func
    def of_column(stiffness: ti.template(), by_column: ti.template(), width, between, b, uniform):
        """Stiffness of the springs along the columns of entry b; it is less along an edge."""
        if ti.static(mapped):
            return stiffness[1][between + b]
        elif ti.static(by_area):  # noqa: RET505
            return uniform * by_column[(AREA + 1) * width + b]
        else:
            return uniform

    @ti.func
    def sweep_row(
        u: ti.template(), d: ti.template(), carried: ti.template(), by_column: ti.template(), decay: ti.template(),
        moment: ti.template(), stiffness: ti.template(), loads: ti.template(), rows, strip, p, q, exists, i, kind,
        carried_row, n, moving, moment_before, moment_here, moment_after,
        keep, dx, dy, k_across, k_down, k_shear, t_across, t_down, t_shear, top, up,
    ):  # fmt: skip
        """Sweep row i of the sheet, stored in row p, and step it if `moving`; the next row, in row q, is `up` above."""
        width = strip + 2
        diagonal = ti.sqrt(dx * dx + dy * dy)
        # Where the arrays of stiffness have the springs along the row, and those between the two rows.
        own, between = i * width, (i + ti.select(up < 0, 1, 0)) * width
        # Springs along an edge belong to one cell.
        share = ti.cast(1, real)
        if ti.static(by_area):
            share = ti.select(kind == 1, ti.cast(1, real), ti.cast(0.5, real))
        # Where u has this row and the other one, and where the forces between them are carried; all from entry 0 on.
        row, other, carry = p * width, q * width, carried_row * width
        # Force of the left neighbour.
        left_x, left_y, left_z = vector(0), vector(0), vector(0)
        # Forces carried to the other row: for the entry before this one, this one and the next one.
        last_x, last_y, last_z = vector(0), vector(0), vector(0)
        this_x, this_y, this_z = vector(0), vector(0), vector(0)
        coming_x, coming_y, coming_z = vector(0), vector(0), vector(0)
        has_left, has_right = vector(1), vector(1)
        if ti.static(open_edges):
            has_right = by_column[HAS_RIGHT * width + 0]
        here_x, here_y, here_z = u[0][row], u[1][row], u[2][row]
        if ti.static(structural_springs):
            k = of_springs(stiffness, 0, own, k_across * share)
            left_x, left_y, left_z = along(u, row + 1, here_x, here_y, here_z, dx, k, t_across, has_right)
        if ti.static(shear_springs):
            k = of_springs(stiffness, 2, between, k_shear)
            coming_x, coming_y, coming_z = to_other_row(
                u, other + 1, 1, here_x, here_y, here_z, dx, up, diagonal, k, t_shear, has_right * exists
            )
        # Read once, because the compiler must assume that stores to the arrays change the table.
        now = [loads[n, c] for c in ti.static(range(columns))]
        for b in range(1, strip + 1):
            # Neighbours are read again for every entry: there are too few registers to keep them.
            here_x, here_y, here_z = u[0][row + b], u[1][row + b], u[2][row + b]
            # Sum of the forces on the neighbours in the other row.
            force_x, force_y, force_z = vector(0), vector(0), vector(0)
            last_x, last_y, last_z = this_x, this_y, this_z
            this_x, this_y, this_z = coming_x, coming_y, coming_z
            if ti.static(open_edges):
                has_left, has_right = by_column[HAS_LEFT * width + b], by_column[HAS_RIGHT * width + b]
            if ti.static(shear_springs):
                k = of_springs(stiffness, 2, between + b - 1, k_shear)
                x, y, z = to_other_row(
                    u, other + b - 1, -1, here_x, here_y, here_z, dx, up, diagonal, k, t_shear, has_left * exists
                )
                force_x, force_y, force_z = x, y, z
                last_x += x
                last_y += y
                last_z += z
            if ti.static(structural_springs):
                k = of_column(stiffness, by_column, width, between, b, k_down)
                x, y, z = to_other_row(u, other + b, 0, here_x, here_y, here_z, dx, up, ti.abs(up), k, t_down, exists)
                force_x += x
                force_y += y
                force_z += z
                this_x += x
                this_y += y
                this_z += z
            if ti.static(shear_springs):
                k = of_springs(stiffness, 2, between + b, k_shear)
                x, y, z = to_other_row(
                    u, other + b + 1, 1, here_x, here_y, here_z, dx, up, diagonal, k, t_shear, has_right * exists
                )
                force_x += x
                force_y += y
                force_z += z
                coming_x, coming_y, coming_z = x, y, z
            force_x = carried[0][carry + b] - force_x
            force_y = carried[1][carry + b] - force_y
            force_z = carried[2][carry + b] - force_z
            if ti.static(structural_springs):
                k = of_springs(stiffness, 0, own + b, k_across * share)
                x, y, z = along(u, row + b + 1, here_x, here_y, here_z, dx, k, t_across, has_right)
                force_x += left_x - x
                force_y += left_y - y
                force_z += left_z - z
                left_x, left_y, left_z = x, y, z
            # What was stored there was read for the entry before.
            carried[0][carry + b - 1] = last_x
            carried[1][carry + b - 1] = last_y
            carried[2][carry + b - 1] = last_z
            if moving:
                move(
                    u, d, by_column, decay, moment, rows, width, p, i, b, kind,
                    moment_before, moment_here, moment_after, here_x, here_y, here_z,
                    force_x, force_y, force_z, keep, dx, dy, top, now,
                )  # fmt: skip
        if ti.static(shear_springs):
            if ti.static(open_edges):
                has_left = by_column[HAS_LEFT * width + strip + 1]
            k = of_springs(stiffness, 2, between + strip, k_shear)
            end = row + strip + 1
            x, y, z = to_other_row(
                u, other + strip, -1, u[0][end], u[1][end], u[2][end], dx, up, diagonal, k, t_shear, has_left * exists
            )
            this_x += x
            this_y += y
            this_z += z
        carried[0][carry + strip] = this_x
        carried[1][carry + strip] = this_y
        carried[2][carry + strip] = this_z

    @ti.func
    def join_strips(field: ti.template(), p, strip):
        """Fill the halo of row p: before the first column of a strip comes the last one of the strip before."""
        width = strip + 2
        for c in ti.static(range(3)):
            last = field[c][p * width + strip]
            first = field[c][p * width + 1]
            field[c][p * width + 0] = vector([last[(lane - 1) % lanes] for lane in ti.static(range(lanes))])
            field[c][p * width + strip + 1] = vector([first[(lane + 1) % lanes] for lane in ti.static(range(lanes))])

    @ti.func
    def bend(
        u: ti.template(), moment: ti.template(), by_column: ti.template(), strip, rows, i, before, here, after,
        target, bending_stiffness, dx, dy,
    ):  # fmt: skip
        """Store the moments of row i, which are 0 at edges, in row `target`; u has it in row `here`."""
        width = strip + 2
        across, down = bending_stiffness / (dx * dx), bending_stiffness / (dy * dy)
        for b in range(1, strip + 1):
            for c in ti.static(range(3)):
                moment[c][target * width + b] = vector(0)
            if 0 < i < rows - 1:
                inside = by_column[HAS_LEFT * width + b] * by_column[HAS_RIGHT * width + b]
                for c in ti.static(range(3)):
                    curved = laplacian(u, c, width, before, here, after, b, across, down)
                    moment[c][target * width + b] = inside * curved
        join_strips(moment, target, strip)

    @ti.func
    def copy_row(rows, worker, border, n, behind):
        """Where a worker's copy of the row `behind` rows from a border is stored after n steps."""
        return rows + border_rows * (4 * worker + 2 * border + ti.cast(n % 2, ti.i32)) + behind

    @ti.func
    def row_at(row, low, high, way, rows, worker, workers, n):
        """Where u has a row of a band, or one of two beyond its ends, after n steps; any row if there is none."""
        i = ti.select(way > 0, low, high - 1) + row * way
        stored = ti.max(0, ti.min(i, rows - 1))
        if ti.static(parallel):
            if row < 0 and 0 <= worker - way < workers:
                stored = copy_row(rows, worker - way, BEGIN, n, -1 - row)
            if row >= high - low and 0 <= worker + way < workers:
                stored = copy_row(rows, worker + way, END, n, row - (high - low))
        return stored

    @ti.func
    def has_come(done: ti.template(), worker, border, n, patience):
        """Wait until a worker has taken n steps at a border, but not for long; returns whether it has."""
        steps = ti.atomic_add(done[(2 * worker + border) * COUNTER_STRIDE], 0)
        looks = 0
        while steps < n and looks < patience:
            steps = ti.atomic_add(done[(2 * worker + border) * COUNTER_STRIDE], 0)
            looks += 1
        return steps >= n

    @ti.func
    def publish(u: ti.template(), done: ti.template(), rows, strip, worker, border, i, inward, n):
        """Copy row i, and with bending also the next one inward, for the neighbour at a border, after n steps."""
        width = strip + 2
        for behind in ti.static(range(border_rows)):
            copy = copy_row(rows, worker, border, n, behind)
            for b in range(width):
                for c in ti.static(range(3)):
                    u[c][copy * width + b] = u[c][(i + behind * inward) * width + b]
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
        carried_x: ti.types.ndarray(dtype=vector, ndim=1),
        carried_y: ti.types.ndarray(dtype=vector, ndim=1),
        carried_z: ti.types.ndarray(dtype=vector, ndim=1),
        moment_x: ti.types.ndarray(dtype=vector, ndim=1),
        moment_y: ti.types.ndarray(dtype=vector, ndim=1),
        moment_z: ti.types.ndarray(dtype=vector, ndim=1),
        along_rows: ti.types.ndarray(dtype=vector, ndim=1),
        along_columns: ti.types.ndarray(dtype=vector, ndim=1),
        diagonals: ti.types.ndarray(dtype=vector, ndim=1),
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
                moment = ti.static((moment_x, moment_y, moment_z))
                stiffness = ti.static((along_rows, along_columns, diagonals))
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
                # The compiler keeps a vector with a variable index on the stack, and aligns the stack for it. Then the
                # vectors that it spills are aligned too: a step takes up to 7 % less. `goes` is True in any case.
                aligned = vector(0)
                aligned[workers % lanes] = 1
                goes = aligned[count % lanes] >= 0
                while goes and turn * depth < count:
                    steps = ti.min(depth, count - turn * depth)
                    # Row -1 is the one before the band: it is swept for its forces, but not stepped.
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
                                    p = copy_row(rows, neighbour, BEGIN, first + n, 0)
                                # With bending, one row further ahead is needed.
                                if goes and row >= high - low - border_rows and 0 <= far_neighbour < workers:
                                    goes = has_come(done, far_neighbour, END, first + n, patience)
                                if row == high - low - 1 and 0 <= far_neighbour < workers:
                                    q = copy_row(rows, far_neighbour, END, first + n, 0)
                            if goes:
                                if ti.static(bending):
                                    # Moments of the row ahead; at the start also of row 0 and of the one before it.
                                    for ahead in range(ti.select(row < 0, -1, row + 1), row + 2):
                                        at = first + n
                                        before = row_at(ahead - 1, low, high, way, rows, worker, workers, at)
                                        here = row_at(ahead, low, high, way, rows, worker, workers, at)
                                        after = row_at(ahead + 1, low, high, way, rows, worker, workers, at)
                                        bend(
                                            u, moment, by_column, strip, rows, begin + ahead * way, before, here, after,
                                            MOMENTS * worker + (ahead + MOMENTS) % MOMENTS, bending_stiffness, dx, dy,
                                        )  # fmt: skip
                                q = ti.select(exists > 0, q, i)
                                if 0 <= i < rows:
                                    kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
                                    moments = MOMENTS * worker
                                    sweep_row(
                                        u, d, carried, by_column, decay, moment, stiffness, loads, rows, strip,
                                        p, q, exists, i, kind, carried_row, n, row >= 0,
                                        moments + (row + 2) % MOMENTS, moments + row % MOMENTS,
                                        moments + (row + 1) % MOMENTS,
                                        keep, dx, dy, k_across, k_down, k_shear, t_across, t_down, t_shear, top,
                                        -way * dy,
                                    )  # fmt: skip
                                else:
                                    for b in range(1, strip + 1):
                                        for c in ti.static(range(3)):
                                            carried[c][carried_row * width + b] = vector(0)
                                if row >= 0:
                                    join_strips(u, i, strip)
                                if ti.static(parallel):
                                    # As soon as all rows to be copied have been stepped.
                                    if row == border_rows - 1:
                                        publish(u, done, rows, strip, worker, BEGIN, begin, way, first + n + 1)
                                    if row == high - low - 1:
                                        publish(u, done, rows, strip, worker, END, i, -way, first + n + 1)
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
    """Make the kernel that reads and measures a sheet, with one thread or several."""
    real, vector, lanes = code.real, code.vector, code.lanes
    measure = measuring(code)

    @ti.kernel
    def read(
        u_x: ti.types.ndarray(dtype=vector, ndim=1),
        u_y: ti.types.ndarray(dtype=vector, ndim=1),
        u_z: ti.types.ndarray(dtype=vector, ndim=1),
        d_x: ti.types.ndarray(dtype=vector, ndim=1),
        d_y: ti.types.ndarray(dtype=vector, ndim=1),
        d_z: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: ti.types.ndarray(dtype=vector, ndim=1),
        along_rows: ti.types.ndarray(dtype=vector, ndim=1),
        along_columns: ti.types.ndarray(dtype=vector, ndim=1),
        diagonals: ti.types.ndarray(dtype=vector, ndim=1),
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
                stiffness = ti.static((along_rows, along_columns, diagonals))
                width = strip + 2
                i = index // ITERATIONS_PER_THREAD
                least, most, along, below, across = vector(0), vector(0), vector(0), vector(0), vector(0)
                along_apart, below_apart, across_apart = vector(0), vector(0), vector(0)
                motion, bent = vector(0), vector(0)
                for b in range(1, strip + 1):
                    found = measure(u, d, by_column, stiffness, width, rows, i, i, b, dx, dy)
                    least = ti.min(least, found[0])
                    most = ti.max(most, found[1])
                    along += found[2]
                    below += found[3]
                    across += found[4]
                    along_apart += found[5]
                    below_apart += found[6]
                    across_apart += found[7]
                    motion += found[8]
                    bent += found[9]
                    for c in ti.static(range(3)):
                        wanted = ti.select(differences, d[c][i * width + b], u[c][i * width + b])
                        for lane in ti.static(range(lanes)):
                            if lane * strip + b <= cols:
                                out[i, lane * strip + b - 1, c] = wanted[lane]
                measures[i, LEAST] = least.min()
                measures[i, MOST] = most.max()
                sums = ti.static((along, below, across, along_apart, below_apart, across_apart, motion, bent))
                for m, part in ti.static(enumerate(sums)):
                    measures[i, MOST + 1 + m] = part.sum()

    return read


def _copy(code: Code) -> Callable[..., None]:
    """Make the kernel that updates the copies of the rows at the borders of bands."""
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
