"""Kernel 1 backward in time: the steps of a segment once more, with every shape kept, and then their adjoint.

A step is d' = keep d + G F(u), u' = u + d', where G is the gain over a point's share of mass, 0 where it is fixed. Let
e be the derivative of the loss by d'. Then p = G e follows, from the last step to the first,

    p_n = p_{n+1} + q_n,    q_n = keep q_{n+1} + G (F'(u_n) p_{n+1} + l_n)

where F' is the tangent, which is symmetric, and l_n the derivative of the loss by u_n itself: the steps of a sheet with
the tangents of the springs for springs. So the adjoint is swept like the sheet. What enters the force of step n changes
the loss by the product of p_{n+1} with the change of the force; these products are added up on the way.

Every worker has a band of rows, and steps it from one buffer into another as soon as its neighbours have come as far. A
row is swept from left to right, cell by cell. Each spring is evaluated once, except those between two bands, which both
workers evaluate alike; sums are kept row by row. So the bits do not depend on the number of workers. Where a worker
waits in vain it gives up, and one worker goes on for all (`bands`).
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from taichi_msm.solver.arrays import point_step
from taichi_msm.solver.bands import MOMENTS, joining
from taichi_msm.solver.row import row_passing
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, ti
from taichi_msm.terms.base import AREA, DX, DY, GAIN, MOVES, Entry, KernelRow, KernelSheet, StepCode
from taichi_msm.terms.bending import BendingTerm, five_point
from taichi_msm.terms.foundation import FoundationTerm
from taichi_msm.terms.loads import ProbeTerm
from taichi_msm.terms.springs import ALONG_COLUMN, ALONG_ROW, DIAGONAL, SpringTerm

# The sizes that a launch is given: steps to take; workers; rows of the sheet; columns of a strip; the first of the
# shapes, or at the adjoint the last; where the arrays have moments, and where the forces carried to the next row, of
# which a worker has so many rows; how many times a worker looks for its neighbour before it gives up; which of two
# buffers holds p; whether the last step adds the derivative of the loss.
COUNT, WORKERS, ROWS, STRIP, SHAPE, MOMENT_ROW, CARRY, CARRIED_ROWS, PATIENCE, BUFFER, WITH_LOSS, SIZES = range(12)

# Integers of a worker in the array `progress`: the first is how many steps it has taken.
STRIDE = 16

# What the adjoint's arrays hold, by multiples of the sheet's rows: p in two buffers, q, and the derivative of the loss.
BUFFERS, ADJOINT_CHANGE, LOSS, ADJOINT_PARTS = 0, 2, 3, 4

# What is added up, by multiples of the sheet's rows: the derivatives by k - tau of springs along rows, along columns
# and of diagonals, and by the logarithm of K, for a share of 1; after them the slopes of the decays of standing slots;
# and then sums of a row each: of q u, for the derivative by keep; by tau of each family; by the logarithm of D.
SPRING_PARTS, FOUNDATION_PART, SUM_PARTS = 0, 3, 4
KEEP_SUM, TENSION_SUMS, BENDING_SUM, ROW_SUMS = 0, 1, 4, 5

# The derivatives by the force and by the control point of a slot, in every step and row.
LOAD_DERIVATIVES = 5


class AdjointSheet(NamedTuple):
    """A `KernelSheet` with what the adjoint needs besides."""

    u: Any  # here p, q and the derivative of the loss, with bending also moments of p
    by_column: Any
    stiffness: Any
    fields: Any
    numbers: Any
    rows: Any
    width: Any
    shapes: Any  # displacements of the steps of a segment, three arrays
    found: Any  # what is added up


class AdjointBand(NamedTuple):
    """A worker's band of rows at a step, within a kernel."""

    # low, high: its first row, and the row after its last
    low: Any
    high: Any
    before: Any  # the row where the buffer begins that is read
    after: Any  # where the one begins that is written
    shape: Any  # where the displacements begin
    carry: Any  # where the forces carried to the next row are
    moments: Any  # where moments are
    n: Any  # of the step, in the table of loads
    with_loss: Any  # whether the derivative of the loss is added


class Tables(NamedTuple):
    """The loads of every step, and where the derivatives by them go."""

    loads: Any
    pushes: Any


@cache
def adjoint_kernels(code: StepCode, *, parallel: bool) -> tuple[Callable[..., None], Callable[..., None]]:
    """Make the kernels that step forward and keep every shape, and that sweep backward."""
    return _recording(code, parallel=parallel), _sweeping(code, parallel=parallel)


def _banded(take: Callable[..., None], *, parallel: bool) -> Callable[..., None]:
    """Make the function that takes the steps of a launch with a worker, or alone for all workers.

    take(sheet, loads, sizes, worker, k) takes step k with the worker's band.
    """

    @ti.func
    def has_come(progress: ti.template(), sizes: ti.template(), worker, k):
        """Wait until a worker, if there is such, has taken k steps, but not for long; returns whether it has."""
        come = True
        if 0 <= worker < sizes[WORKERS]:
            steps, looks = ti.atomic_add(progress[STRIDE * worker], 0), 0
            while steps < k and looks < sizes[PATIENCE]:
                steps = ti.atomic_add(progress[STRIDE * worker], 0)
                looks += 1
            come = steps >= k
        return come

    @ti.func
    def work(sheet: ti.template(), loads: ti.template(), sizes: ti.template(), progress: ti.template(), worker):
        if ti.static(parallel):
            k, goes = ti.cast(progress[STRIDE * worker], ti.i32), True
            while goes and k < sizes[COUNT]:
                goes = has_come(progress, sizes, worker - 1, k) and has_come(progress, sizes, worker + 1, k)
                if goes:
                    take(sheet, loads, sizes, worker, k)
                    ti.atomic_add(progress[STRIDE * worker], 1)
                    k += 1
        else:
            for k in range(ti.cast(sizes[COUNT], ti.i32)):
                for other in range(ti.cast(sizes[WORKERS], ti.i32)):
                    if progress[STRIDE * other] <= k:
                        take(sheet, loads, sizes, other, k)
                        progress[STRIDE * other] = k + 1

    return work


def _storing(code: StepCode) -> list[Callable[..., None]]:
    """Make the function that stores the moments that row i of a band needs, if any: at first of three, then of one."""
    bending, join_strips = code.get(BendingTerm), joining(code)
    if bending is None:
        return []
    store_moment = bending.storing(code)

    @ti.func
    def store_moments(sheet: ti.template(), band: ti.template(), i):
        for ahead in range(ti.select(i == band.low, i - 1, i + 1), i + 2):
            last = sheet.rows - 1
            before = band.before + ti.max(0, ti.min(ahead - 1, last))
            here, after = band.before + ti.max(0, ti.min(ahead, last)), band.before + ti.min(ahead + 1, last)
            target = band.moments + (ahead + MOMENTS) % MOMENTS
            for b in range(1, sheet.width - 1):
                store_moment(sheet, ahead, before, here, after, b, target)
            join_strips(sheet.u, target, sheet.width)

    return [store_moments]


def _clearing(code: StepCode) -> Callable[..., None]:
    """Make Taichi's function clear(sheet, row), for a row of u."""
    vector = code.vector

    @ti.func
    def clear(sheet: ti.template(), row):
        for b in range(1, sheet.width - 1):
            for c in ti.static(range(3)):
                sheet.u[c][row * sheet.width + b] = vector(0)

    return clear


def _recording(code: StepCode, *, parallel: bool) -> Callable[..., None]:
    """Make the kernel that takes steps, each from one shape to the next."""
    real, vector, vectors = code.real, code.vector, code.vectors
    count_of_numbers, join_strips, step = code.first_number(None), joining(code), point_step(code)
    clear, storing = _clearing(code), _storing(code)

    @ti.func
    def move(sheet: ti.template(), entry: ti.template(), target, force: ti.template(), now: ti.template()):
        step(sheet, entry, target + sheet.rows, force, now)

    pass_row = row_passing(code, move)

    @ti.func
    def take(sheet: ti.template(), loads: ti.template(), sizes: ti.template(), worker, k):
        """Take step k of the launch with a band."""
        workers = ti.cast(sizes[WORKERS], ti.i32)
        low, high = sheet.rows * worker // workers, sheet.rows * (worker + 1) // workers
        shape = (ti.cast(sizes[SHAPE], ti.i32) + k) * sheet.rows
        carry = ti.cast(sizes[CARRY] + sizes[CARRIED_ROWS] * worker, ti.i32)
        moments = ti.cast(sizes[MOMENT_ROW], ti.i32) + MOMENTS * worker
        band = ti.static(AdjointBand(low, high, shape, shape, shape, carry, moments, k, 0))
        if low == 0:
            clear(sheet, carry)
        for i in range(ti.max(low - 1, 0), high):
            for store_moments in ti.static(storing):
                if i >= low:
                    store_moments(sheet, band, i)
            kind = ti.select(i == sheet.rows - 1, 2, ti.select(i == 0, 0, 1))
            exists = ti.cast(i + 1 < sheet.rows, real)
            below = shape + ti.min(i + 1, sheet.rows - 1)
            before, at = moments + (i + 2) % MOMENTS, moments + i % MOMENTS
            line = ti.static(KernelRow(i, kind, before, at, moments + (i + 1) % MOMENTS))
            up = 0 - sheet.numbers[DY]
            pass_row(sheet, sheet.u, carry, line, shape + i, below, exists, up, loads, k, i >= low)
            if i >= low:
                join_strips(sheet.u, shape + sheet.rows + i, sheet.width)

    work = _banded(take, parallel=parallel)

    @ti.kernel
    def record(
        sizes: ti.types.ndarray(dtype=ti.i64, ndim=1),
        progress: ti.types.ndarray(dtype=ti.i64, ndim=1),
        loads: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        numbers_of: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: vectors, stiffness: vectors, fields: vectors,
    ):  # fmt: skip
        ti.loop_config(serialize=not parallel)
        for index in range(ti.cast(sizes[WORKERS], ti.i32) * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                rows, width = ti.cast(sizes[ROWS], ti.i32), ti.cast(sizes[STRIP], ti.i32) + 2
                numbers = [numbers_of[n][0] for n in ti.static(range(count_of_numbers))]
                u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                sheet = ti.static(KernelSheet(u, d, by_column, stiffness, fields, numbers, rows, width))
                work(sheet, loads, sizes, progress, index // ITERATIONS_PER_THREAD)

    return record


def _row_sweeping(code: StepCode) -> Callable[..., None]:
    """Make the function that takes a row of the adjoint a step backward."""
    vector, columns, springs = code.vector, code.first_column(None), code.require(SpringTerm)
    structural, shear, tense = springs.structural, springs.shear, springs.tense
    differentiate, (*_, of_row, of_column, of_diagonal) = springs.tangent(code), springs.between(code)
    tangents = [add for term in code.terms for add in term.tangents(code)]
    reducing = [reduce for term in code.terms for reduce in term.reducing(code)]
    probes, holds = code.require(ProbeTerm), code.get(FoundationTerm) is not None
    curving = [] if code.get(BendingTerm) is None else [five_point(code)]
    sense, slots, standing = probes.sensing(code, SUM_PARTS), len(probes.moves), probes.moves.count(False)
    first_tension, held = code.first_number(SpringTerm) + 3, code.first_column(FoundationTerm) if holds else 0

    @ti.func
    def of_spring(sheet: ti.template(), ahead, p, q, x0, y0, length, k, family: ti.template()):
        """Differentiate the force of entry p on entry q; entries of p and q, of which shapes are `ahead`."""
        change = [sheet.u[c][p] - sheet.u[c][q] for c in ti.static(range(3))]
        apart = [sheet.shapes[c][p + ahead] - sheet.shapes[c][q + ahead] for c in ti.static(range(3))]
        tension = sheet.numbers[first_tension + family]
        return differentiate(apart, change, x0, y0, length, k, tension)

    @ti.func
    def add(array: ti.template(), at, value):
        # To an array, += would be atomic.
        array[at] = array[at] + value

    @ti.func
    def sweep_row(sheet: ti.template(), band: ti.template(), i, loads: ti.template(), pushes: ti.template()):
        """Sweep row i of a band; row low - 1 only for what it carries to the next."""
        width, dx, dy, owned = sheet.width, sheet.numbers[DX], sheet.numbers[DY], i >= band.low
        diagonal, kind = ti.sqrt(dx * dx + dy * dy), ti.select(i == sheet.rows - 1, 2, ti.select(i == 0, 0, 1))
        here, below = (band.before + i) * width, (band.before + ti.min(i + 1, sheet.rows - 1)) * width
        ahead, carry = (band.shape - band.before) * width, band.carry * width
        sums = [vector(0) for _ in ti.static(range(ROW_SUMS))]
        pushed = [vector(0) for _ in ti.static(range(LOAD_DERIVATIVES * slots))]
        now = [loads[band.n, c] for c in ti.static(range(columns))]
        # What the cell before an entry adds to it, and to the entry below it.
        beside, under = [vector(0) for _ in ti.static(range(3))], [vector(0) for _ in ti.static(range(3))]
        before, at = band.moments + (i + 2) % MOMENTS, band.moments + i % MOMENTS
        line = ti.static(KernelRow(i, kind, before, at, band.moments + (i + 1) % MOMENTS))
        for b in range(width - 1):
            # The cell to the right of the entry: the spring along its upper edge, and its diagonals.
            right = [vector(0) for _ in ti.static(range(5))]
            to_right, to_left = [vector(0) for _ in ti.static(range(5))], [vector(0) for _ in ti.static(range(5))]
            if ti.static(structural):
                k = of_row(sheet, i, kind, b)
                found = of_spring(sheet, ahead, here + b, here + b + 1, 0 - dx, 0 * dy, dx, k, ALONG_ROW)
                for c in ti.static(range(5)):
                    right[c] = found[c]
            if ti.static(shear):
                k = of_diagonal(sheet, i + 1, b)
                falling = of_spring(sheet, ahead, here + b, below + b + 1, 0 - dx, dy, diagonal, k, DIAGONAL)
                rising = of_spring(sheet, ahead, here + b + 1, below + b, dx, dy, diagonal, k, DIAGONAL)
                for c in ti.static(range(5)):
                    to_right[c], to_left[c] = falling[c], rising[c]
            if b > 0:
                down = [vector(0) for _ in ti.static(range(5))]
                if ti.static(structural):
                    k = of_column(sheet, i + 1, b)
                    found = of_spring(sheet, ahead, here + b, below + b, 0 * dx, dy, dy, k, ALONG_COLUMN)
                    for c in ti.static(range(5)):
                        down[c] = found[c]
                force = [vector(0) for _ in ti.static(range(3))]
                for c in ti.static(range(3)):
                    carried = sheet.u[c][carry + b]
                    force[c] = carried + (beside[c] - right[c]) - (to_right[c] + down[c])
                    sheet.u[c][carry + b] = (under[c] + to_left[c]) + down[c]
                if owned:
                    p = [sheet.u[c][here + b] for c in ti.static(range(3))]
                    u = [sheet.shapes[c][here + ahead + b] for c in ti.static(range(3))]
                    entry = ti.static(Entry(line, b, p))
                    for add_change in ti.static(tangents):
                        add_change(force, sheet, entry, now)
                    gain = now[GAIN] * sheet.by_column[(MOVES + kind) * width + b]
                    q = [sheet.u[c][(ADJOINT_CHANGE * sheet.rows + i) * width + b] for c in ti.static(range(3))]
                    # The sum of p_{n+1} (u_n - u_{n-1}) over all n, added up in another order: of u_n q_{n+1}.
                    kept = q[0] * u[0] + q[1] * u[1] + q[2] * u[2]
                    for reduce in ti.static(reducing):
                        reduce(q, sheet)
                    if band.with_loss:
                        for c in ti.static(range(3)):
                            force[c] += sheet.u[c][(LOSS * sheet.rows + i) * width + b]
                    for c in ti.static(range(3)):
                        q[c] += gain * force[c]
                        sheet.u[c][(ADJOINT_CHANGE * sheet.rows + i) * width + b] = q[c]
                        sheet.u[c][(band.after + i) * width + b] = p[c] + q[c]
                    # The derivatives. A spring pulls its ends in opposite directions.
                    if ti.static(structural):
                        add(sheet.found, (ALONG_ROW * sheet.rows + i) * width + b, right[3] * (-1.0))
                        add(sheet.found, (ALONG_COLUMN * sheet.rows + i) * width + b, down[3] * (-1.0))
                    if ti.static(shear):
                        both = to_right[3] + to_left[3]
                        add(sheet.found, (DIAGONAL * sheet.rows + i) * width + b, both * (-1.0))
                    if ti.static(holds):
                        product = p[0] * u[0] + p[1] * u[1] + p[2] * u[2]
                        add(sheet.found, (FOUNDATION_PART * sheet.rows + i) * width + b, product * (0 - now[held]))
                    if ti.static(tense):
                        sums[TENSION_SUMS + ALONG_ROW] = sums[TENSION_SUMS + ALONG_ROW] - right[4]
                        sums[TENSION_SUMS + ALONG_COLUMN] = sums[TENSION_SUMS + ALONG_COLUMN] - down[4]
                        sums[TENSION_SUMS + DIAGONAL] = sums[TENSION_SUMS + DIAGONAL] - (to_right[4] + to_left[4])
                    if ti.static(code.by_area):
                        kept *= sheet.by_column[(AREA + kind) * width + b]
                    sums[KEEP_SUM] += kept
                    sense(pushed, sheet, entry, now)
                    for laplacian in ti.static(curving):
                        if kind == 1:
                            # Between the shapes of rows; and moments of p are D times its Laplacian, 0 at edges.
                            shape = band.shape + i
                            for c in ti.static(range(3)):
                                curved = laplacian(
                                    sheet.shapes[c], width, shape - 1, shape, shape + 1, b,
                                    1 / (dx * dx), 1 / (dy * dy),
                                )  # fmt: skip
                                sums[BENDING_SUM] = sums[BENDING_SUM] - curved * sheet.u[c][at * width + b]
            for c in ti.static(range(3)):
                beside[c] = right[c] - to_left[c]
                under[c] = to_right[c]
        if owned:
            first = (SUM_PARTS + 2 * standing) * sheet.rows * width + ROW_SUMS * i
            for n in ti.static(range(ROW_SUMS)):
                add(sheet.found, first + n, sums[n])
            for n in ti.static(range(LOAD_DERIVATIVES * slots)):
                pushes[band.n, i, n] = pushed[n].sum()

    return sweep_row


def _sweeping(code: StepCode, *, parallel: bool) -> Callable[..., None]:
    """Make the kernel that takes steps of the adjoint, from the last to the first."""
    real, vector, vectors = code.real, code.vector, code.vectors
    count_of_numbers, join_strips, storing = code.first_number(None), joining(code), _storing(code)
    clear, sweep_row = _clearing(code), _row_sweeping(code)

    @ti.func
    def take(sheet: ti.template(), tables: ti.template(), sizes: ti.template(), worker, k):
        """Take the k-th step of the launch with a band."""
        workers = ti.cast(sizes[WORKERS], ti.i32)
        low, high = sheet.rows * worker // workers, sheet.rows * (worker + 1) // workers
        n = ti.cast(sizes[COUNT], ti.i32) - 1 - k
        shape = (ti.cast(sizes[SHAPE], ti.i32) - k) * sheet.rows
        buffer = (ti.cast(sizes[BUFFER], ti.i32) + k) % 2
        carry = ti.cast(sizes[CARRY] + sizes[CARRIED_ROWS] * worker, ti.i32)
        moments = ti.cast(sizes[MOMENT_ROW], ti.i32) + MOMENTS * worker
        with_loss = n == 0 and sizes[WITH_LOSS] != 0
        before, after = buffer * sheet.rows, (1 - buffer) * sheet.rows
        band = ti.static(AdjointBand(low, high, before, after, shape, carry, moments, n, with_loss))
        if low == 0:
            clear(sheet, carry)
        for i in range(ti.max(low - 1, 0), high):
            for store_moments in ti.static(storing):
                if i >= low:
                    store_moments(sheet, band, i)
            sweep_row(sheet, band, i, tables.loads, tables.pushes)
            if i >= low:
                join_strips(sheet.u, after + i, sheet.width)

    work = _banded(take, parallel=parallel)

    @ti.kernel
    def sweep(
        sizes: ti.types.ndarray(dtype=ti.i64, ndim=1),
        progress: ti.types.ndarray(dtype=ti.i64, ndim=1),
        loads: ti.types.ndarray(dtype=real, ndim=2),
        pushes: ti.types.ndarray(dtype=real, ndim=3),
        p_x: vectors, p_y: vectors, p_z: vectors,
        u_x: vectors, u_y: vectors, u_z: vectors,
        numbers_of: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: vectors, stiffness: vectors, fields: vectors, found: vectors,
    ):  # fmt: skip
        ti.loop_config(serialize=not parallel)
        for index in range(ti.cast(sizes[WORKERS], ti.i32) * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                rows, width = ti.cast(sizes[ROWS], ti.i32), ti.cast(sizes[STRIP], ti.i32) + 2
                numbers = [numbers_of[n][0] for n in ti.static(range(count_of_numbers))]
                p, u = ti.static((p_x, p_y, p_z), (u_x, u_y, u_z))
                sheet = ti.static(AdjointSheet(p, by_column, stiffness, fields, numbers, rows, width, u, found))
                tables = ti.static(Tables(loads, pushes))
                work(sheet, tables, sizes, progress, index // ITERATIONS_PER_THREAD)

    return sweep


@cache
def copy_kernel(code: StepCode) -> Callable[..., None]:
    """Make the kernel that copies so many entries, from one entry of some arrays to one of others."""
    vectors = code.vectors

    @ti.kernel
    def copy(
        entries: ti.i32,
        source: ti.i32,
        target: ti.i32,
        from_x: vectors, from_y: vectors, from_z: vectors,
        to_x: vectors, to_y: vectors, to_z: vectors,
    ):  # fmt: skip
        ti.loop_config(serialize=True)
        for n in range(entries):
            for a, b in ti.static(((from_x, to_x), (from_y, to_y), (from_z, to_z))):
                b[target + n] = a[source + n]

    return copy
