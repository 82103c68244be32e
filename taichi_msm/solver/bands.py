"""Parallel stepping on a CPU: one band of rows per worker, passes over the bands, and copies of rows at their borders.

Passes. A step can follow the previous step at a distance of one row. A pass therefore takes `depth` steps while the
rows are in the cache: round k steps row k from n to n + 1, row k - 1 from n + 1 to n + 2, and so on.

Bands. Neighbouring workers both move away from their common border or both toward it, so that they reach it at the
same time. Each needs the neighbour's row at the border as it was before the step. After every step, a worker therefore
copies its row, alternately into one of two buffers, and waits for the neighbour's copy. The order of summation does not
depend on the direction of a pass, so results are independent of the number of workers, to the bit.

Bending. A moment is the Laplacian of the displacements, and the force on a row is the Laplacian of the moments. Before
a row is stepped, the moments of the next row are computed, which depend on one row more. With bending, a pass therefore
takes only one step, and workers copy two rows.

Timeout. A worker waits by spinning. If another program has taken the neighbour's core, spinning would waste its own, so
after a limited number of checks the worker records its progress and ends. Further launches continue from there.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from taichi_msm.solver.arrays import build_point_step
from taichi_msm.solver.row import build_correct_row, build_pass_row
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, ti
from taichi_msm.terms.base import DY, KernelConfig, KernelRow, KernelSheet
from taichi_msm.terms.bending import BendingTerm

# The borders of a band at which its worker begins and ends.
BEGIN, END = 0, 1

# The array `progress` has WORKER_STRIDE integers per worker: a cache line of COUNTER_STRIDE integers for each border,
# which begins with the number of steps taken there. The first line also contains the worker's pass, its round, and the
# step of the round.
COUNTER_STRIDE = 16
WORKER_STRIDE = 2 * COUNTER_STRIDE
PASS_INDEX, ROUND, STEP = 1, 2, 3

# Rows of moments per worker: the force on a row depends on those of the previous, this and the next row.
MOMENT_ROWS = 3


class Launch(NamedTuple):
    """Integer arguments of a launch, the array `sizes` of the kernel."""

    steps_before: Any  # number of steps taken before the launch
    count: Any  # number of steps to take
    workers: Any  # number of workers
    depth: Any  # number of steps of a pass
    carried_rows: Any  # rows of `carried` per worker
    rows: Any  # number of rows of the sheet
    strip: Any  # number of columns of a strip
    first_row: Any  # the first row that is not fixed
    end_row: Any  # the row after the last one that is not fixed
    moment_row: Any  # first row of moments in u
    max_checks: Any  # number of checks after which a waiting worker ends


# Places of the arguments. Kernels read each where they need it: as variables, they cost up to 4 % of a step.
AT = Launch(*range(len(Launch._fields)))


class RowBand(NamedTuple):
    """A worker's band of rows within a kernel."""

    worker: Any  # index of the worker
    workers: Any  # number of workers
    low: Any  # first row of the band
    high: Any  # row after the last of the band
    direction: Any  # 1 if the worker moves down, -1 if up
    rows: Any  # number of rows of the sheet
    max_checks: Any  # number of checks after which a waiting worker ends
    progress: Any  # array of all workers


def build_fill_halo(config: KernelConfig) -> Callable[..., None]:
    """Build the Taichi function that fills the halo of a row."""
    vector, lanes = config.vector, config.lanes

    @ti.func
    def fill_halo(u: ti.template(), p, width):
        """Fill the halo of row p with the last column of the previous strip and the first one of the next strip."""
        for c in ti.static(range(3)):
            last = u[c][p * width + width - 2]
            first = u[c][p * width + 1]
            u[c][p * width + 0] = vector([last[(lane - 1) % lanes] for lane in ti.static(range(lanes))])
            u[c][p * width + width - 1] = vector([first[(lane + 1) % lanes] for lane in ti.static(range(lanes))])

    return fill_halo


def build_step_row(
    config: KernelConfig, move: Callable[..., None], *, corrects: bool, parallel: bool
) -> Callable[..., Any]:
    """Build the Taichi function step_row(sheet, carried, loads, band, row, n, steps_before, carry, moments).

    It steps a row of a band as soon as the neighbours' rows are available. `move` steps an entry, see `build_pass_row`.
    With `corrects`, the corrections of terms follow. With `parallel`, the bands next to it belong to other workers.
    """
    vector, bending, copied = config.vector, config.get(BendingTerm), config.reach
    fill_halo = build_fill_halo(config)
    pass_row, storing = build_pass_row(config, move), [bending.build_store_moment(config)] if bending else []
    corrections = [term.build_correction(config) for term in config.terms if corrects]
    correcting = [build_correct_row(config, correction) for correction in corrections if correction]

    @ti.func
    def copy_at(rows, worker, border, n, behind):
        """Return the index in u of a copy of a worker's row, `behind` rows inward from a border, after n steps."""
        return rows + copied * (4 * worker + 2 * border + ti.cast(n % 2, ti.i32)) + behind

    @ti.func
    def row_at(band: ti.template(), row, n):
        """Return the index in u of a row in or next to a band, after n steps; any index for a row beyond the sheet."""
        i = ti.select(band.direction > 0, band.low, band.high - 1) + row * band.direction
        stored = ti.max(0, ti.min(i, band.rows - 1))
        if ti.static(parallel):
            if row < 0 and 0 <= band.worker - band.direction < band.workers:
                stored = copy_at(band.rows, band.worker - band.direction, BEGIN, n, -1 - row)
            if row >= band.high - band.low and 0 <= band.worker + band.direction < band.workers:
                stored = copy_at(band.rows, band.worker + band.direction, END, n, row - (band.high - band.low))
        return stored

    @ti.func
    def wait_for(band: ti.template(), worker, border, n):
        """Wait until a worker has taken n steps at a border; return False after `max_checks` checks."""
        steps = ti.atomic_add(band.progress[WORKER_STRIDE * worker + COUNTER_STRIDE * border], 0)
        checks = 0
        while steps < n and checks < band.max_checks:
            steps = ti.atomic_add(band.progress[WORKER_STRIDE * worker + COUNTER_STRIDE * border], 0)
            checks += 1
        return steps >= n

    @ti.func
    def publish(sheet: ti.template(), band: ti.template(), border, i, inward, n):
        """Copy row i after n steps, and with bending the next row inward, for the neighbour at a border."""
        for behind in ti.static(range(copied)):
            copy = copy_at(band.rows, band.worker, border, n, behind)
            for b in range(sheet.width):
                for c in ti.static(range(3)):
                    sheet.u[c][copy * sheet.width + b] = sheet.u[c][(i + behind * inward) * sheet.width + b]
        ti.atomic_add(band.progress[WORKER_STRIDE * band.worker + COUNTER_STRIDE * border], 1)

    @ti.func
    def store_moments(sheet: ti.template(), band: ti.template(), row, moments, n):
        """Store the moments of the next row; at the start of a band also those of the rows -1 and 0."""
        begin = ti.select(band.direction > 0, band.low, band.high - 1)
        for ahead in range(ti.select(row < 0, -1, row + 1), row + 2):
            before, middle = row_at(band, ahead - 1, n), row_at(band, ahead, n)
            after, target = row_at(band, ahead + 1, n), moments + (ahead + MOMENT_ROWS) % MOMENT_ROWS
            for b in range(1, sheet.width - 1):
                for store_moment in ti.static(storing):
                    store_moment(sheet, begin + ahead * band.direction, before, middle, after, b, target)
            fill_halo(sheet.u, target, sheet.width)

    @ti.func
    def step_row(
        sheet: ti.template(), carried: ti.template(), loads: ti.template(), band: ti.template(),
        row, n, steps_before, carry, moments,
    ):  # fmt: skip
        """Step a row of a band, from 0 at its beginning; return False after a timeout.

        Row -1 precedes the band, and only its forces are computed. n is the row of `loads`, `steps_before` the number
        of steps taken in the run, `carry` the row of `carried`, and `moments` the first row of the worker's moments.
        """
        begin = ti.select(band.direction > 0, band.low, band.high - 1)
        begin_worker, end_worker = band.worker - band.direction, band.worker + band.direction
        last = band.high - band.low - 1
        i = begin + row * band.direction
        source = i
        next_row = i + band.direction
        exists = ti.cast(0 <= next_row < band.rows, config.real)
        ready = True
        if ti.static(parallel):
            if row == -1 and 0 <= begin_worker < band.workers:
                ready = wait_for(band, begin_worker, BEGIN, steps_before)
                source = copy_at(band.rows, begin_worker, BEGIN, steps_before, 0)
            # With bending, the step depends on one more row.
            if ready and row > last - copied and 0 <= end_worker < band.workers:
                ready = wait_for(band, end_worker, END, steps_before)
            if row == last and 0 <= end_worker < band.workers:
                next_row = copy_at(band.rows, end_worker, END, steps_before, 0)
        if ready:
            if ti.static(len(storing) > 0):
                store_moments(sheet, band, row, moments, steps_before)
            next_row = ti.select(exists > 0, next_row, i)
            if 0 <= i < band.rows:
                kind = ti.select(i == band.rows - 1, 2, ti.select(i == 0, 0, 1))
                up = -band.direction * sheet.constants[DY]
                before, middle = moments + (row + 2) % MOMENT_ROWS, moments + row % MOMENT_ROWS
                after = moments + (row + 1) % MOMENT_ROWS
                line = ti.static(KernelRow(i, kind, before, middle, after))
                pass_row(sheet, carried, carry, line, source, next_row, exists, up, loads, n, row >= 0)
                if row >= 0:
                    for correct_row in ti.static(correcting):
                        correct_row(sheet, i, kind, loads, n)
            else:
                for b in range(1, sheet.width - 1):
                    for c in ti.static(range(3)):
                        carried[c][carry * sheet.width + b] = vector(0)
            if row >= 0:
                fill_halo(sheet.u, i, sheet.width)
            if ti.static(parallel):
                # Copy as soon as all rows to be copied are stepped.
                if row == copied - 1:
                    publish(sheet, band, BEGIN, begin, band.direction, steps_before + 1)
                if row == last:
                    publish(sheet, band, END, i, -band.direction, steps_before + 1)
        return ready

    return step_row


@cache
def build_advance(config: KernelConfig, *, parallel: bool) -> Callable[..., None]:
    """Build the kernel of `kernel_cpu.ScatterKernel` that takes steps, `parallel` with several workers."""
    real, vector, vectors, lanes = config.real, config.vector, config.vectors, config.lanes
    constant_count = config.constants().end
    step_row = build_step_row(config, build_point_step(config), corrects=True, parallel=parallel)

    @ti.func
    def step_band(
        sheet: ti.template(), carried: ti.template(), loads: ti.template(), band: ti.template(), sizes: ti.template()
    ):
        """Advance a band by the steps of a launch, from its worker's recorded progress on; record the new progress."""
        first, own = sizes[AT.steps_before], WORKER_STRIDE * band.worker
        count, depth = ti.cast(sizes[AT.count], ti.i32), ti.cast(sizes[AT.depth], ti.i32)
        carried_rows = ti.cast(sizes[AT.carried_rows], ti.i32)
        moments = ti.cast(sizes[AT.moment_row], ti.i32) + MOMENT_ROWS * band.worker
        pass_index = ti.cast(band.progress[own + PASS_INDEX], ti.i32)
        k = ti.cast(band.progress[own + ROUND], ti.i32)
        step = ti.cast(band.progress[own + STEP], ti.i32)
        # A vector with a variable index makes the compiler align the stack, and with it all spilled vectors, which
        # saves up to 7 % of a step. `ready` is always True here.
        aligned = vector(0)
        aligned[band.workers % lanes] = 1
        ready = aligned[count % lanes] >= 0
        while ready and pass_index * depth < count:
            steps = ti.min(depth, count - pass_index * depth)
            while ready and k < band.high - band.low + steps - 1:
                while ready and step < ti.min(steps, k + 2):
                    n = pass_index * depth + step
                    carry = band.worker * carried_rows + step
                    ready = step_row(sheet, carried, loads, band, k - step, n, first + n, carry, moments)
                    if ready:
                        step += 1
                if ready:
                    k += 1
                    step = ti.max(0, k - (band.high - band.low) + 1)
            if ready:
                pass_index += 1
                k = -1
                step = 0
        band.progress[own + PASS_INDEX] = pass_index
        band.progress[own + ROUND] = k
        band.progress[own + STEP] = step

    @ti.kernel
    def advance(
        sizes: ti.types.ndarray(dtype=ti.i64, ndim=1), progress: ti.types.ndarray(dtype=ti.i64, ndim=1),
        loads: ti.types.ndarray(dtype=real, ndim=2),
        carried_x: vectors, carried_y: vectors, carried_z: vectors,
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1), by_column: vectors, fields: vectors,
    ):  # fmt: skip
        """Advance by the steps of a `Launch`, the array `sizes`, from the workers' recorded progress on.

        `progress` has the shape (workers x WORKER_STRIDE,), `loads` (steps, columns). The forces carried to the next
        row [N] have rows per worker and step of a pass. `SheetArrays.all` are the other arrays.
        """
        ti.loop_config(serialize=not parallel)
        for index in range(ti.cast(sizes[AT.workers], ti.i32) * ITERATIONS_PER_THREAD):
            # One worker per thread.
            if index % ITERATIONS_PER_THREAD == 0:
                rows, width = ti.cast(sizes[AT.rows], ti.i32), ti.cast(sizes[AT.strip], ti.i32) + 2
                constants = [constants_of[n][0] for n in ti.static(range(constant_count))]
                u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                sheet = ti.static(KernelSheet(u, d, by_column, fields, constants, rows, width))
                worker, workers = index // ITERATIONS_PER_THREAD, ti.cast(sizes[AT.workers], ti.i32)
                first_row, end_row = ti.cast(sizes[AT.first_row], ti.i32), ti.cast(sizes[AT.end_row], ti.i32)
                low = first_row + (end_row - first_row) * worker // workers
                high = first_row + (end_row - first_row) * (worker + 1) // workers
                direction = 2 * (worker % 2) - 1
                max_checks = ti.cast(sizes[AT.max_checks], ti.i32)
                band = ti.static(RowBand(worker, workers, low, high, direction, rows, max_checks, progress))
                carried = ti.static((carried_x, carried_y, carried_z))
                step_band(sheet, carried, loads, band, sizes)

    return advance
