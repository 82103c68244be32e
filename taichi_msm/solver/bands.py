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

# Rows of moments per worker.
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


WORKERS, LAUNCH_SIZES = Launch._fields.index("workers"), len(Launch._fields)


class RowBand(NamedTuple):
    """A worker's band of rows within a kernel. Row 0 is the first one that the worker steps, at its border BEGIN."""

    worker: Any  # index of the worker
    workers: Any  # number of workers
    low: Any  # first row of the sheet in the band
    high: Any  # row of the sheet after the last of the band
    direction: Any  # 1 if the worker moves down, -1 if up
    rows: Any  # number of rows of the sheet


class BandStep(NamedTuple):
    """A step of a band within a kernel."""

    n: Any  # row of the load table
    before: Any  # number of steps taken before this one in the run
    carry: Any  # row of `carried`
    moments: Any  # first row of the worker's moments in u


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


@ti.func
def _row_of(band: ti.template(), row):
    """Return the row of the sheet that is row `row` of a band."""
    return ti.select(band.direction > 0, band.low, band.high - 1) + row * band.direction


@ti.func
def _copy_at(band: ti.template(), reach: ti.template(), worker, border, n, behind):
    """Return the index in u of a copy of a worker's row, `behind` rows inward from a border, after n steps."""
    return band.rows + reach * (4 * worker + 2 * border + ti.cast(n % 2, ti.i32)) + behind


def build_step_row(
    config: KernelConfig, move: Callable[..., None], *, corrects: bool, parallel: bool
) -> Callable[..., None]:
    """Build the Taichi function step_row(sheet, carried, loads, band, step, row), which steps a row of a `RowBand`.

    `move` steps an entry, see `build_pass_row`; the corrections of terms follow if it `corrects`. With `parallel`, the
    rows beyond the borders are the neighbours' copies, which must be available.
    """
    vector, real, bending, reach = config.vector, config.real, config.get(BendingTerm), config.reach
    fill_halo = build_fill_halo(config)
    pass_row, storing = build_pass_row(config, move), [bending.build_store_moment(config)] if bending else []
    corrections = [term.build_correction(config) for term in config.terms if corrects]
    correcting = [build_correct_row(config, correction) for correction in corrections if correction]

    @ti.func
    def stored_at(band: ti.template(), row, i, n):
        """Return the index in u of a row in or next to a band after n steps: i, or that of a neighbour's copy."""
        stored = i
        if ti.static(parallel):
            before, after = band.worker - band.direction, band.worker + band.direction
            if row < 0 and 0 <= before < band.workers:
                stored = _copy_at(band, reach, before, BEGIN, n, -1 - row)
            if row >= band.high - band.low and 0 <= after < band.workers:
                stored = _copy_at(band, reach, after, END, n, row - (band.high - band.low))
        return stored

    @ti.func
    def row_at(band: ti.template(), row, n):
        """Return the index in u of a row in or next to a band, after n steps; any index for a row beyond the sheet."""
        return stored_at(band, row, ti.max(0, ti.min(_row_of(band, row), band.rows - 1)), n)

    @ti.func
    def store_moments(sheet: ti.template(), band: ti.template(), step: ti.template(), row):
        """Store the moments of the next row; at the start of a band also those of the rows -1 and 0."""
        for ahead in range(ti.select(row < 0, -1, row + 1), row + 2):
            before, middle = row_at(band, ahead - 1, step.before), row_at(band, ahead, step.before)
            after, target = row_at(band, ahead + 1, step.before), step.moments + (ahead + MOMENT_ROWS) % MOMENT_ROWS
            for b in range(1, sheet.width - 1):
                for store_moment in ti.static(storing):
                    store_moment(sheet, _row_of(band, ahead), before, middle, after, b, target)
            fill_halo(sheet.u, target, sheet.width)

    @ti.func
    def step_row(
        sheet: ti.template(), carried: ti.template(), loads: ti.template(), band: ti.template(), step: ti.template(),
        row,
    ):  # fmt: skip
        """Step a row of a band; only compute the forces of row -1, which precedes the first one."""
        if ti.static(len(storing) > 0):
            store_moments(sheet, band, step, row)
        i = _row_of(band, row)
        if 0 <= i < band.rows:
            kind = ti.select(i == band.rows - 1, 2, ti.select(i == 0, 0, 1))
            before, middle = step.moments + (row + 2) % MOMENT_ROWS, step.moments + row % MOMENT_ROWS
            after = step.moments + (row + 1) % MOMENT_ROWS
            line = ti.static(KernelRow(i, kind, before, middle, after))
            exists = ti.cast(0 <= i + band.direction < band.rows, real)
            source = i
            next_row = ti.select(exists > 0, i + band.direction, i)
            if ti.static(parallel):
                source = stored_at(band, row, i, step.before)
                next_row = stored_at(band, row + 1, next_row, step.before)
            up = -band.direction * sheet.constants[DY]
            pass_row(sheet, carried, step.carry, line, source, next_row, exists, up, loads, step.n, row >= 0)
            if row >= 0:
                for correct_row in ti.static(correcting):
                    correct_row(sheet, i, kind, loads, step.n)
        else:
            for b in range(1, sheet.width - 1):
                for c in ti.static(range(3)):
                    carried[c][step.carry * sheet.width + b] = vector(0)
        if row >= 0:
            fill_halo(sheet.u, i, sheet.width)

    return step_row


def _build_meeting(reach: int) -> tuple[Callable[..., Any], Callable[..., None]]:
    """Build the Taichi functions with which workers meet at their borders.

    await_row(progress, band, row, n, max_checks) waits until the neighbours have taken the n steps on which the next
    step of a row depends; it returns False after a timeout. publish_row(sheet, progress, band, row, n) copies the rows
    at a border for the neighbour there, when a row has been stepped for the n-th time.
    """

    @ti.func
    def await_worker(progress: ti.template(), band: ti.template(), worker, border, n, max_checks):
        """Wait until a worker, if it exists, has taken n steps at a border."""
        ready = True
        if 0 <= worker < band.workers:
            at = WORKER_STRIDE * worker + COUNTER_STRIDE * border
            steps = ti.atomic_add(progress[at], 0)
            checks = 0
            while steps < n and checks < max_checks:
                steps = ti.atomic_add(progress[at], 0)
                checks += 1
            ready = steps >= n
        return ready

    @ti.func
    def await_row(progress: ti.template(), band: ti.template(), row, n, max_checks):
        ready = True
        if row == -1:
            ready = await_worker(progress, band, band.worker - band.direction, BEGIN, n, max_checks)
        # With bending, a step depends on one more row.
        if ready and row > band.high - band.low - 1 - reach:
            ready = await_worker(progress, band, band.worker + band.direction, END, n, max_checks)
        return ready

    @ti.func
    def publish(sheet: ti.template(), progress: ti.template(), band: ti.template(), border, row, inward, n):
        for behind in ti.static(range(reach)):
            copy, i = _copy_at(band, reach, band.worker, border, n, behind), _row_of(band, row + behind * inward)
            for b in range(sheet.width):
                for c in ti.static(range(3)):
                    sheet.u[c][copy * sheet.width + b] = sheet.u[c][i * sheet.width + b]
        ti.atomic_add(progress[WORKER_STRIDE * band.worker + COUNTER_STRIDE * border], 1)

    @ti.func
    def publish_row(sheet: ti.template(), progress: ti.template(), band: ti.template(), row, n):
        # As soon as all rows to be copied are stepped.
        if row == reach - 1:
            publish(sheet, progress, band, BEGIN, 0, 1, n)
        if row == band.high - band.low - 1:
            publish(sheet, progress, band, END, row, -1, n)

    return await_row, publish_row


def _build_align_stack(config: KernelConfig) -> Callable[..., Any]:
    """Build the Taichi function align_stack(m, n), which returns True.

    Its vector with a variable index makes the compiler align the stack, and with it all spilled vectors, which saves up
    to 7 % of a step.
    """
    vector, lanes = config.vector, config.lanes

    @ti.func
    def align_stack(m, n):
        aligned = vector(0)
        aligned[m % lanes] = 1
        return aligned[n % lanes] >= 0

    return align_stack


@cache
def build_advance(config: KernelConfig, *, parallel: bool) -> Callable[..., None]:
    """Build the kernel of `kernel_cpu.ScatterKernel` that takes steps, `parallel` with several workers."""
    real, vector, vectors, constant_count = config.real, config.vector, config.vectors, config.constants().end
    step_row = build_step_row(config, build_point_step(config), corrects=True, parallel=parallel)
    (await_row, publish_row), align_stack = _build_meeting(config.reach), _build_align_stack(config)

    @ti.func
    def step_band(
        sheet: ti.template(), carried: ti.template(), loads: ti.template(), launch: ti.template(),
        progress: ti.template(), band: ti.template(),
    ):  # fmt: skip
        """Advance a band by the steps of a launch, from its worker's recorded progress on; record the new progress."""
        own, count, depth, band_rows = WORKER_STRIDE * band.worker, launch.count, launch.depth, band.high - band.low
        moments = launch.moment_row + MOMENT_ROWS * band.worker
        pass_index = ti.cast(progress[own + PASS_INDEX], ti.i32)
        k = ti.cast(progress[own + ROUND], ti.i32)
        j = ti.cast(progress[own + STEP], ti.i32)
        ready = align_stack(band.workers, count)
        while ready and pass_index * depth < count:
            steps = ti.min(depth, count - pass_index * depth)
            while ready and k < band_rows + steps - 1:
                while ready and j < ti.min(steps, k + 2):
                    n = pass_index * depth + j
                    before, carry, row = launch.steps_before + n, band.worker * launch.carried_rows + j, k - j
                    if ti.static(parallel):
                        ready = await_row(progress, band, row, before, launch.max_checks)
                    if ready:
                        step = ti.static(BandStep(n, before, carry, moments))
                        step_row(sheet, carried, loads, band, step, row)
                        if ti.static(parallel):
                            publish_row(sheet, progress, band, row, before + 1)
                        j += 1
                if ready:
                    k += 1
                    j = ti.max(0, k - band_rows + 1)
            if ready:
                pass_index += 1
                k = -1
                j = 0
        progress[own + PASS_INDEX] = pass_index
        progress[own + ROUND] = k
        progress[own + STEP] = j

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
        for index in range(ti.cast(sizes[WORKERS], ti.i32) * ITERATIONS_PER_THREAD):
            # One worker per thread.
            if index % ITERATIONS_PER_THREAD == 0:
                steps_before = sizes[0]
                others = [ti.cast(sizes[n], ti.i32) for n in ti.static(range(1, LAUNCH_SIZES))]
                launch = ti.static(Launch(steps_before, *others))
                constants = [constants_of[n][0] for n in ti.static(range(constant_count))]
                u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                width = launch.strip + 2
                sheet = ti.static(KernelSheet(u, d, by_column, fields, constants, launch.rows, width))
                worker, workers = index // ITERATIONS_PER_THREAD, launch.workers
                first_row, end_row = launch.first_row, launch.end_row
                low = first_row + (end_row - first_row) * worker // workers
                high = first_row + (end_row - first_row) * (worker + 1) // workers
                direction = 2 * (worker % 2) - 1
                band = ti.static(RowBand(worker, workers, low, high, direction, launch.rows))
                carried = ti.static((carried_x, carried_y, carried_z))
                step_band(sheet, carried, loads, launch, progress, band)

    return advance
