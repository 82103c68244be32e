"""How workers share the rows of a sheet on a CPU: a band each, passes over it, and copies of the rows at its borders.

Passes. The second step can follow the first with a distance of one row, the third step the second, and so on: a pass
takes `depth` steps while the rows are in the cache. Round k of a pass takes row k from step n to n + 1, row k - 1 from
n + 1 to n + 2, and so on.

Bands. Neighbouring workers go away from their common border or toward it, so that they arrive there at the same
time. Each needs the other's row at the border as it was before the step: after every step each copies its row, into one
of two buffers by turns, and waits for the other's copy. The order in which forces are added does not depend on the
direction of a pass, so the bits of a result do not depend on the number of workers.

Bending. A moment is the Laplacian of the displacements, and the force on a row is the Laplacian of the moments. So
before a row is stepped, the moments of the row ahead are computed, which depend on one row more. A pass is then one
step, and neighbours copy two rows.

Giving up. A waiting worker spins, but not for long: another program may have taken its neighbour's core. It then
records its place and ends, which frees its own core. Further launches continue from the recorded places.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from typing import Any, NamedTuple

from taichi_msm.solver.arrays import build_point_step
from taichi_msm.solver.row import build_pass_row, build_touch_row
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, ti
from taichi_msm.terms.base import DY, KernelConfig, KernelRow, KernelSheet
from taichi_msm.terms.bending import BendingTerm
from taichi_msm.terms.contact import ContactTerm

# The sizes that a launch is given: steps taken before; steps to take; workers; steps of a pass; rows of `carried` for a
# worker; rows of the sheet; columns of a strip; the first row that moves, and the row after the last; where u has the
# moments; how many times a worker looks for its neighbour before it gives up.
FIRST, COUNT, WORKERS, DEPTH, CARRIED_ROWS, ROWS, STRIP, FIRST_ROW, END_ROW, MOMENT_ROW, PATIENCE, SIZES = range(12)

# The borders of a band: where its worker begins and where it ends.
BEGIN, END = 0, 1

# Integers of a worker in the array `progress`. For each border, in a cache line of its own, the steps taken there;
# after the first of them the place of the worker: pass, round and step of the round.
COUNTER_STRIDE = 16
WORKER_STRIDE = 2 * COUNTER_STRIDE
TURN, ROUND, STEP, PLACE_END = 1, 2, 3, 4

# Number of rows of moments that a worker needs at a time.
MOMENT_ROWS = 3


class RowBand(NamedTuple):
    """A worker's band of rows, within a kernel."""

    # worker, workers: its worker; all workers
    worker: Any
    workers: Any
    # low, high: its first row, and the row after its last
    low: Any
    high: Any
    way: Any  # 1 if its worker goes down, -1 if up
    rows: Any  # of the sheet
    patience: Any  # as in the sizes
    progress: Any  # of all workers


def build_join_strips(config: KernelConfig) -> Callable[..., None]:
    """Make the function that fills the halo of a row."""
    vector, lanes = config.vector, config.lanes

    @ti.func
    def join_strips(u: ti.template(), p, width):
        """Fill the halo of row p: before the first column of a strip comes the last one of the strip before."""
        for c in ti.static(range(3)):
            last = u[c][p * width + width - 2]
            first = u[c][p * width + 1]
            u[c][p * width + 0] = vector([last[(lane - 1) % lanes] for lane in ti.static(range(lanes))])
            u[c][p * width + width - 1] = vector([first[(lane + 1) % lanes] for lane in ti.static(range(lanes))])

    return join_strips


def build_step_row(
    config: KernelConfig, move: Callable[..., None], *, touches: bool, parallel: bool
) -> Callable[..., Any]:
    """Make the function that takes a step of a row of a band, as soon as the neighbours' rows allow it.

    Args:
        config: of the sheet.
        move: what it does with an entry, as for `build_pass_row`.
        touches: whether tools then push the points of the row out.
        parallel: whether there are neighbours.
    """
    vector, bending, copied, join_strips = (
        config.vector,
        config.get(BendingTerm),
        config.reach,
        build_join_strips(config),
    )
    pass_row, storing = build_pass_row(config, move), [bending.build_store_moment(config)] if bending else []
    contact = config.get(ContactTerm) if touches else None
    touching = [build_touch_row(config, contact)] if contact else []

    @ti.func
    def copy_row(rows, worker, border, n, behind):
        """Where u has a worker's copy of the row `behind` rows from a border after n steps."""
        return rows + copied * (4 * worker + 2 * border + ti.cast(n % 2, ti.i32)) + behind

    @ti.func
    def row_at(band: ti.template(), row, n):
        """Where u has a row of a band, or one of two beyond its ends, after n steps; any row if there is none."""
        i = ti.select(band.way > 0, band.low, band.high - 1) + row * band.way
        stored = ti.max(0, ti.min(i, band.rows - 1))
        if ti.static(parallel):
            if row < 0 and 0 <= band.worker - band.way < band.workers:
                stored = copy_row(band.rows, band.worker - band.way, BEGIN, n, -1 - row)
            if row >= band.high - band.low and 0 <= band.worker + band.way < band.workers:
                stored = copy_row(band.rows, band.worker + band.way, END, n, row - (band.high - band.low))
        return stored

    @ti.func
    def has_come(band: ti.template(), worker, border, n):
        """Wait until a worker has taken n steps at a border, but not for long; returns whether it has."""
        steps = ti.atomic_add(band.progress[WORKER_STRIDE * worker + COUNTER_STRIDE * border], 0)
        looks = 0
        while steps < n and looks < band.patience:
            steps = ti.atomic_add(band.progress[WORKER_STRIDE * worker + COUNTER_STRIDE * border], 0)
            looks += 1
        return steps >= n

    @ti.func
    def publish(sheet: ti.template(), band: ti.template(), border, i, inward, n):
        """Copy row i, and with bending also the next one inward, for the neighbour at a border, after n steps."""
        for behind in ti.static(range(copied)):
            copy = copy_row(band.rows, band.worker, border, n, behind)
            for b in range(sheet.width):
                for c in ti.static(range(3)):
                    sheet.u[c][copy * sheet.width + b] = sheet.u[c][(i + behind * inward) * sheet.width + b]
        ti.atomic_add(band.progress[WORKER_STRIDE * band.worker + COUNTER_STRIDE * border], 1)

    @ti.func
    def store_moments(sheet: ti.template(), band: ti.template(), row, moments, n):
        """Store the moments of the row ahead; at the start of a band also of row 0 and of the one before it."""
        begin = ti.select(band.way > 0, band.low, band.high - 1)
        for ahead in range(ti.select(row < 0, -1, row + 1), row + 2):
            before, here = row_at(band, ahead - 1, n), row_at(band, ahead, n)
            after, target = row_at(band, ahead + 1, n), moments + (ahead + MOMENT_ROWS) % MOMENT_ROWS
            for b in range(1, sheet.width - 1):
                for store_moment in ti.static(storing):
                    store_moment(sheet, begin + ahead * band.way, before, here, after, b, target)
            join_strips(sheet.u, target, sheet.width)

    @ti.func
    def step_row(
        sheet: ti.template(), carried: ti.template(), loads: ti.template(), band: ti.template(),
        row, n, at, carry, moments,
    ):  # fmt: skip
        """Take step n of the launch, after `at` steps in all, with a row of the band; returns whether it was taken.

        Row -1 is the one before the band: it is swept for its forces, but not stepped.
        """
        begin = ti.select(band.way > 0, band.low, band.high - 1)
        near, far, last = band.worker - band.way, band.worker + band.way, band.high - band.low - 1
        i = begin + row * band.way
        here = i
        other = i + band.way
        exists = ti.cast(0 <= other < band.rows, config.real)
        goes = True
        if ti.static(parallel):
            if row == -1 and 0 <= near < band.workers:
                goes = has_come(band, near, BEGIN, at)
                here = copy_row(band.rows, near, BEGIN, at, 0)
            # With bending, one row further ahead is needed.
            if goes and row > last - copied and 0 <= far < band.workers:
                goes = has_come(band, far, END, at)
            if row == last and 0 <= far < band.workers:
                other = copy_row(band.rows, far, END, at, 0)
        if goes:
            if ti.static(len(storing) > 0):
                store_moments(sheet, band, row, moments, at)
            other = ti.select(exists > 0, other, i)
            if 0 <= i < band.rows:
                kind = ti.select(i == band.rows - 1, 2, ti.select(i == 0, 0, 1))
                up = -band.way * sheet.constants[DY]
                before, middle = moments + (row + 2) % MOMENT_ROWS, moments + row % MOMENT_ROWS
                after = moments + (row + 1) % MOMENT_ROWS
                line = ti.static(KernelRow(i, kind, before, middle, after))
                pass_row(sheet, carried, carry, line, here, other, exists, up, loads, n, row >= 0)
                if row >= 0:
                    for touch_row in ti.static(touching):
                        touch_row(sheet, i, kind, loads, n)
            else:
                for b in range(1, sheet.width - 1):
                    for c in ti.static(range(3)):
                        carried[c][carry * sheet.width + b] = vector(0)
            if row >= 0:
                join_strips(sheet.u, i, sheet.width)
            if ti.static(parallel):
                # As soon as all rows to be copied have been stepped.
                if row == copied - 1:
                    publish(sheet, band, BEGIN, begin, band.way, at + 1)
                if row == last:
                    publish(sheet, band, END, i, -band.way, at + 1)
        return goes

    return step_row


def build_advance(config: KernelConfig, *, parallel: bool) -> Callable[..., None]:
    """Make the kernel that takes steps, with one worker or several."""
    real, vector, vectors, lanes = config.real, config.vector, config.vectors, config.lanes
    constant_count, step_row = (
        config.first_constant(None),
        build_step_row(config, build_point_step(config), touches=True, parallel=parallel),
    )

    @ti.func
    def work(
        sheet: ti.template(), carried: ti.template(), loads: ti.template(), band: ti.template(), sizes: ti.template()
    ):
        """Take the steps of a launch with a band, from the worker's place on; record its place if it gives up."""
        first, place = sizes[FIRST], WORKER_STRIDE * band.worker
        count, depth = ti.cast(sizes[COUNT], ti.i32), ti.cast(sizes[DEPTH], ti.i32)
        carried_rows = ti.cast(sizes[CARRIED_ROWS], ti.i32)
        moments = ti.cast(sizes[MOMENT_ROW], ti.i32) + MOMENT_ROWS * band.worker
        turn = ti.cast(band.progress[place + TURN], ti.i32)
        k = ti.cast(band.progress[place + ROUND], ti.i32)
        step = ti.cast(band.progress[place + STEP], ti.i32)
        # The compiler keeps a vector with a variable index on the stack, and aligns the stack for it. Then the vectors
        # that it spills are aligned too: a step takes up to 7 % less. `goes` is always True here.
        aligned = vector(0)
        aligned[band.workers % lanes] = 1
        goes = aligned[count % lanes] >= 0
        while goes and turn * depth < count:
            steps = ti.min(depth, count - turn * depth)
            while goes and k < band.high - band.low + steps - 1:
                while goes and step < ti.min(steps, k + 2):
                    n = turn * depth + step
                    carry = band.worker * carried_rows + step
                    goes = step_row(sheet, carried, loads, band, k - step, n, first + n, carry, moments)
                    if goes:
                        step += 1
                if goes:
                    k += 1
                    step = ti.max(0, k - (band.high - band.low) + 1)
            if goes:
                turn += 1
                k = -1
                step = 0
        band.progress[place + TURN] = turn
        band.progress[place + ROUND] = k
        band.progress[place + STEP] = step

    @ti.kernel
    def advance(
        sizes: ti.types.ndarray(dtype=ti.i64, ndim=1),
        progress: ti.types.ndarray(dtype=ti.i64, ndim=1),
        loads: ti.types.ndarray(dtype=real, ndim=2),
        carried_x: vectors, carried_y: vectors, carried_z: vectors,
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: vectors, stiffness: vectors, fields: vectors,
    ):  # fmt: skip
        ti.loop_config(serialize=not parallel)
        for index in range(ti.cast(sizes[WORKERS], ti.i32) * ITERATIONS_PER_THREAD):
            # One worker a thread.
            if index % ITERATIONS_PER_THREAD == 0:
                rows, width = ti.cast(sizes[ROWS], ti.i32), ti.cast(sizes[STRIP], ti.i32) + 2
                constants = [constants_of[n][0] for n in ti.static(range(constant_count))]
                sheet = ti.static(
                    KernelSheet((u_x, u_y, u_z), (d_x, d_y, d_z), by_column, stiffness, fields, constants, rows, width)
                )
                worker, workers = index // ITERATIONS_PER_THREAD, ti.cast(sizes[WORKERS], ti.i32)
                first_row, end_row = ti.cast(sizes[FIRST_ROW], ti.i32), ti.cast(sizes[END_ROW], ti.i32)
                low = first_row + (end_row - first_row) * worker // workers
                high = first_row + (end_row - first_row) * (worker + 1) // workers
                way = 2 * (worker % 2) - 1
                patience = ti.cast(sizes[PATIENCE], ti.i32)
                band = ti.static(RowBand(worker, workers, low, high, way, rows, patience, progress))
                carried = ti.static((carried_x, carried_y, carried_z))
                work(sheet, carried, loads, band, sizes)

    return advance
