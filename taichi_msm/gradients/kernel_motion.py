"""Kernels of the adjoint of the time stepping: `store` steps forward and stores all displacements, `sweep` steps back.

A step is d' = keep d + G F(u), u' = u + d', where G is the gain divided by the area share of a mass point, or 0 if it
is fixed. Let e be the derivative of the loss with respect to d'. From the last step to the first, p = G e follows

    p_n = p_{n+1} + q_n,    q_n = keep q_{n+1} + G (F'(u_n) p_{n+1} + l_n)

where F' is the Jacobian of the forces, which is symmetric, and l_n the partial derivative of the loss with respect to
u_n. These are the steps of a sheet with linearised springs, so the adjoint is swept like the sheet. A change f of the
force in step n changes the loss by p_{n+1} . f; the sweep adds up this product for every coefficient.

Every worker has a band of rows, and steps it from one buffer into another as soon as its neighbours have reached the
same step. A row is swept from left to right, cell by cell. Each spring is evaluated once; one between two bands twice,
by both workers. Sums are stored by row, so the bits do not depend on the number of workers. A worker that waits too
long gives up, and a single worker finishes for all (`bands`).
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from taichi_msm.solver.arrays import build_point_step
from taichi_msm.solver.bands import MOMENT_ROWS, build_fill_halo
from taichi_msm.solver.row import build_pass_row
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, ti
from taichi_msm.terms.base import DX, DY, GAIN, Entry, KernelConfig, KernelRow, KernelSheet
from taichi_msm.terms.bending import BendingTerm, build_laplacian
from taichi_msm.terms.foundation import FoundationTerm
from taichi_msm.terms.loads import ProbeTerm
from taichi_msm.terms.points import build_point_functions
from taichi_msm.terms.springs import ALONG_COLUMN, ALONG_ROW, DIAGONAL, SpringTerm

# Indices into the sizes of a launch:
# COUNT         steps
# WORKERS       workers
# ROWS          rows of the sheet
# STRIP         columns of a strip
# U_STEP        index of the displacements of the first step; in a sweep, of the last one
# MOMENT_ROW    first row of the moments in the arrays
# CARRY         first row of the carried forces, those of a row on the next row
# CARRIED_ROWS  rows of carried forces per worker
# MAX_CHECKS    number of times that a worker checks its neighbour before it gives up
# BUFFER        buffer that contains p, 0 or 1
# WITH_LOSS     1 if the last step adds the derivative of the loss, else 0
COUNT, WORKERS, ROWS, STRIP, U_STEP, MOMENT_ROW, CARRY, CARRIED_ROWS, MAX_CHECKS, BUFFER, WITH_LOSS = range(11)

# Integers per worker in the array `progress`: the number of its finished steps, and padding against false sharing.
STRIDE = 16

# Parts of the adjoint's arrays, in multiples of the sheet's rows: p in two buffers, q, and the derivative of the loss.
BUFFERS, ADJOINT_CHANGE, LOSS, ADJOINT_PARTS = 0, 2, 3, 4

# Parts of the accumulated derivatives, in multiples of the sheet's rows, with respect to
# SPRING_PARTS     k - tau of springs along rows, along columns and along diagonals, 3 parts
# FOUNDATION_PART  log K, for an area share of 1
# SUM_PARTS        number of these parts; after them come `ProbeTerm.decay_gradients`
SPRING_PARTS, FOUNDATION_PART, SUM_PARTS = 0, 3, 4

# Indices of the sums of a row, which follow the parts:
# KEEP_SUM              q . u, for the derivative with respect to keep
# TENSION_SUMS          derivatives with respect to tau of each family of springs, 3 sums
# BENDING_SUM           derivative with respect to log D
# LAW_SUMS              derivatives with respect to log m and the shape of the law of springs, LAW_NUMBERS sums at most
# FOUNDATION_LAW_SUMS   the same for the foundation
# ROW_SUMS              number of sums
LAW_NUMBERS = 4
KEEP_SUM, TENSION_SUMS, BENDING_SUM, LAW_SUMS = 0, 1, 4, 5
FOUNDATION_LAW_SUMS, ROW_SUMS = LAW_SUMS + LAW_NUMBERS, LAW_SUMS + 2 * LAW_NUMBERS

# Indices of the results of `SpringTerm.build_spring_tangent`. After the change of the force, 3, the derivatives with
# respect to
# BY_STIFFNESS  k - tau
# BY_TENSION    tau
# BY_LAW        log m and the shape of their law
BY_STIFFNESS, BY_TENSION, BY_LAW = 3, 4, 5

# Derivatives per slot, step and row: with respect to the force, 3, and the control point, 2.
LOAD_DERIVATIVES = 5


class AdjointSheet(NamedTuple):
    """Arrays of a `KernelSheet`, extended for the adjoint."""

    u: Any  # p, q and the derivative of the loss; with bending also the moments of p
    # by_column, fields, constants, rows, width: as in `KernelSheet`
    by_column: Any
    fields: Any
    constants: Any
    rows: Any
    width: Any
    history: Any  # displacements u at all steps of a segment, three arrays
    derivatives: Any  # accumulated derivatives, see `SPRING_PARTS`


class AdjointBand(NamedTuple):
    """A worker's band of rows at a step, within a kernel."""

    low: Any  # first row
    high: Any  # row after the last
    # source, target: first rows of the buffer to read and of the buffer to write
    source: Any
    target: Any
    u_row: Any  # first row of the displacements of this step
    carry: Any  # row of the forces carried to the next row
    moments: Any  # first row of the moments
    n: Any  # index of the step in the table of loads
    with_loss: Any  # whether the derivative of the loss is added


class LoadTables(NamedTuple):
    """Loads of every step, and the derivatives with respect to them."""

    loads: Any  # shape (steps, columns)
    by_load: Any  # shape (steps, rows, slots x 5)


def _build_run_worker(step_band: Callable[..., None], *, parallel: bool) -> Callable[..., None]:
    """Build the function that runs the steps of a launch: of one worker if parallel, otherwise of all in turn."""

    @ti.func
    def wait_for(progress: ti.template(), sizes: ti.template(), worker, k):
        """Wait until a worker has finished k steps; return whether it did so in time. A missing worker did."""
        finished = True
        if 0 <= worker < sizes[WORKERS]:
            steps, checks = ti.atomic_add(progress[STRIDE * worker], 0), 0
            while steps < k and checks < sizes[MAX_CHECKS]:
                steps = ti.atomic_add(progress[STRIDE * worker], 0)
                checks += 1
            finished = steps >= k
        return finished

    @ti.func
    def run_worker(sheet: ti.template(), loads: ti.template(), sizes: ti.template(), progress: ti.template(), worker):
        if ti.static(parallel):
            k, ready = ti.cast(progress[STRIDE * worker], ti.i32), True
            while ready and k < sizes[COUNT]:
                ready = wait_for(progress, sizes, worker - 1, k) and wait_for(progress, sizes, worker + 1, k)
                if ready:
                    step_band(sheet, loads, sizes, worker, k)
                    ti.atomic_add(progress[STRIDE * worker], 1)
                    k += 1
        else:
            for k in range(ti.cast(sizes[COUNT], ti.i32)):
                for each in range(ti.cast(sizes[WORKERS], ti.i32)):
                    if progress[STRIDE * each] <= k:
                        step_band(sheet, loads, sizes, each, k)
                        progress[STRIDE * each] = k + 1

    return run_worker


def _build_store_moments(code: KernelConfig) -> list[Callable[..., None]]:
    """Return a list with the function that stores the moments for row i of a band; empty without bending.

    The first row of a band needs the moments of three rows; each further row adds one.
    """
    bending, fill_halo = code.get(BendingTerm), build_fill_halo(code)
    if bending is None:
        return []
    store_moment = bending.build_store_moment(code)

    @ti.func
    def store_moments(sheet: ti.template(), band: ti.template(), i):
        for ahead in range(ti.select(i == band.low, i - 1, i + 1), i + 2):
            last = sheet.rows - 1
            above = band.source + ti.max(0, ti.min(ahead - 1, last))
            row, below = band.source + ti.max(0, ti.min(ahead, last)), band.source + ti.min(ahead + 1, last)
            target = band.moments + (ahead + MOMENT_ROWS) % MOMENT_ROWS
            for b in range(1, sheet.width - 1):
                store_moment(sheet, ahead, above, row, below, b, target)
            fill_halo(sheet.u, target, sheet.width)

    return [store_moments]


@cache
def build_store(code: KernelConfig, *, parallel: bool) -> Callable[..., None]:
    """Build the kernel that steps forward and stores all displacements.

    Unless `parallel`, a single thread runs the steps of all workers in turn.
    """
    real, vector, vectors = code.real, code.vector, code.vectors
    count_of_numbers, fill_halo, step = code.constants().end, build_fill_halo(code), build_point_step(code)
    storing = _build_store_moments(code)

    @ti.func
    def move(sheet: ti.template(), entry: ti.template(), target, force: ti.template(), now: ti.template()):
        step(sheet, entry, target + sheet.rows, force, now)

    pass_row = build_pass_row(code, move)

    @ti.func
    def step_band(sheet: ti.template(), loads: ti.template(), sizes: ti.template(), worker, k):
        workers = ti.cast(sizes[WORKERS], ti.i32)
        low, high = sheet.rows * worker // workers, sheet.rows * (worker + 1) // workers
        u_row = (ti.cast(sizes[U_STEP], ti.i32) + k) * sheet.rows
        carry = ti.cast(sizes[CARRY] + sizes[CARRIED_ROWS] * worker, ti.i32)
        moments = ti.cast(sizes[MOMENT_ROW], ti.i32) + MOMENT_ROWS * worker
        band = ti.static(AdjointBand(low, high, u_row, u_row, u_row, carry, moments, k, 0))
        if low == 0:
            for b in range(1, sheet.width - 1):
                for c in ti.static(range(3)):
                    sheet.u[c][carry * sheet.width + b] = vector(0)
        for i in range(ti.max(low - 1, 0), high):
            for store_moments in ti.static(storing):
                if i >= low:
                    store_moments(sheet, band, i)
            kind = ti.select(i == sheet.rows - 1, 2, ti.select(i == 0, 0, 1))
            exists = ti.cast(i + 1 < sheet.rows, real)
            below = u_row + ti.min(i + 1, sheet.rows - 1)
            above, at = moments + (i + 2) % MOMENT_ROWS, moments + i % MOMENT_ROWS
            line = ti.static(KernelRow(i, kind, above, at, moments + (i + 1) % MOMENT_ROWS))
            up = 0 - sheet.constants[DY]
            pass_row(sheet, sheet.u, carry, line, u_row + i, below, exists, up, loads, k, i >= low)
            if i >= low:
                fill_halo(sheet.u, u_row + sheet.rows + i, sheet.width)

    run_worker = _build_run_worker(step_band, parallel=parallel)

    @ti.kernel
    def store(
        sizes: ti.types.ndarray(dtype=ti.i64, ndim=1), progress: ti.types.ndarray(dtype=ti.i64, ndim=1),
        loads: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1), by_column: vectors, fields: vectors,
    ):  # fmt: skip
        """Step forward from the first of the displacements `u` of all steps [m].

        After them, `u` has the workers' moments and carried forces. `d` are the last differences [m]. The elements of
        `sizes` have the indices from `COUNT` on; `progress` is the number of steps that each worker has finished, at
        multiples of `STRIDE`; `loads` is a `Dynamics.step_table`.
        """
        ti.loop_config(serialize=not parallel)
        for index in range(ti.cast(sizes[WORKERS], ti.i32) * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                rows, width = ti.cast(sizes[ROWS], ti.i32), ti.cast(sizes[STRIP], ti.i32) + 2
                constants = [constants_of[n][0] for n in ti.static(range(count_of_numbers))]
                u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                sheet = ti.static(KernelSheet(u, d, by_column, fields, constants, rows, width))
                run_worker(sheet, loads, sizes, progress, index // ITERATIONS_PER_THREAD)

    return store


def _build_sweep_row(code: KernelConfig) -> Callable[..., None]:
    """Build the function that sweeps a row of a band."""
    vector, columns, springs = code.vector, code.columns().end, code.require(SpringTerm)
    structural, shear, tension = springs.structural, springs.shear, springs.tense
    differentiate = springs.build_spring_tangent(code)
    mobility, area_share, _ = build_point_functions(code)
    stiffness = springs.build_stiffness(code)
    tangents = [add for term in code.terms for add in term.build_tangents(code)]
    dampings = [damp for term in code.terms for damp in term.build_damping(code)]
    probes, foundation_term = code.require(ProbeTerm), code.get(FoundationTerm)
    laplacians = [] if code.get(BendingTerm) is None else [build_laplacian(code)]
    add_load_derivatives = probes.build_load_adjoint(code, SUM_PARTS)
    slots, stationary = len(probes.moves), probes.moves.count(False)
    foundation = code.columns(FoundationTerm).stiffness if foundation_term else 0
    foundation_derivatives = [foundation_term.build_derivatives(code)] if foundation_term else []
    stiffness_functions = [foundation_term.build_stiffness(code)] if foundation_term and foundation_term.law else []
    law, foundation_law = springs.law, foundation_term.law if foundation_term else None
    numbers, foundation_numbers = (1 + each.shape_count if each else 0 for each in (law, foundation_law))
    results = BY_LAW + numbers

    @ti.func
    def spring_tangent(sheet: ti.template(), offset, p, q, x0, y0, length, k, family: ti.template()):
        """Differentiate the force of the spring between entries p and q, at `offset` entries further in `history`."""
        p_difference = [sheet.u[c][p] - sheet.u[c][q] for c in ti.static(range(3))]
        u_difference = [sheet.history[c][p + offset] - sheet.history[c][q + offset] for c in ti.static(range(3))]
        return differentiate(sheet, family, u_difference, p_difference, x0, y0, length, k)

    @ti.func
    def add(array: ti.template(), at, value):
        # On an array, += would be atomic.
        array[at] = array[at] + value

    @ti.func
    def sweep_row(sheet: ti.template(), band: ti.template(), i, loads: ti.template(), by_load: ti.template()):
        """Sweep row i of a band; of the row above the band, compute only the forces carried to its first row."""
        width, dx, dy, owned = sheet.width, sheet.constants[DX], sheet.constants[DY], i >= band.low
        diagonal, kind = ti.sqrt(dx * dx + dy * dy), ti.select(i == sheet.rows - 1, 2, ti.select(i == 0, 0, 1))
        entry_row, below = (band.source + i) * width, (band.source + ti.min(i + 1, sheet.rows - 1)) * width
        offset, carry = (band.u_row - band.source) * width, band.carry * width
        sums = [vector(0) for _ in ti.static(range(ROW_SUMS))]
        load_sums = [vector(0) for _ in ti.static(range(LOAD_DERIVATIVES * slots))]
        now = [loads[band.n, c] for c in ti.static(range(columns))]
        # Forces of the previous cell on the current entry, and on the entry below it.
        to_next, to_below = [vector(0) for _ in ti.static(range(3))], [vector(0) for _ in ti.static(range(3))]
        above, at = band.moments + (i + 2) % MOMENT_ROWS, band.moments + i % MOMENT_ROWS
        line = ti.static(KernelRow(i, kind, above, at, band.moments + (i + 1) % MOMENT_ROWS))
        for b in range(width - 1):
            # The cell to the right of the entry: the spring along its upper edge, and its diagonals.
            right = [vector(0) for _ in ti.static(range(results))]
            falling = [vector(0) for _ in ti.static(range(results))]
            rising = [vector(0) for _ in ti.static(range(results))]
            if ti.static(structural):
                k = stiffness(sheet, ALONG_ROW, True, i, kind, b)
                spring = spring_tangent(
                    sheet, offset, entry_row + b, entry_row + b + 1, 0 - dx, 0 * dy, dx, k, ALONG_ROW
                )
                for c in ti.static(range(results)):
                    right[c] = spring[c]
            if ti.static(shear):
                k = stiffness(sheet, DIAGONAL, True, i, kind, b)
                down_right = spring_tangent(
                    sheet, offset, entry_row + b, below + b + 1, 0 - dx, dy, diagonal, k, DIAGONAL
                )
                k = stiffness(sheet, DIAGONAL, False, i, kind, b)
                down_left = spring_tangent(sheet, offset, entry_row + b + 1, below + b, dx, dy, diagonal, k, DIAGONAL)
                for c in ti.static(range(results)):
                    falling[c], rising[c] = down_right[c], down_left[c]
            if b > 0:
                down = [vector(0) for _ in ti.static(range(results))]
                if ti.static(structural):
                    k = stiffness(sheet, ALONG_COLUMN, True, i, kind, b)
                    spring = spring_tangent(sheet, offset, entry_row + b, below + b, 0 * dx, dy, dy, k, ALONG_COLUMN)
                    for c in ti.static(range(results)):
                        down[c] = spring[c]
                force = [vector(0) for _ in ti.static(range(3))]
                for c in ti.static(range(3)):
                    carried = sheet.u[c][carry + b]
                    force[c] = carried + (to_next[c] - right[c]) - (falling[c] + down[c])
                    sheet.u[c][carry + b] = (to_below[c] + rising[c]) + down[c]
                if owned:
                    p = [sheet.u[c][entry_row + b] for c in ti.static(range(3))]
                    u = [sheet.history[c][entry_row + offset + b] for c in ti.static(range(3))]
                    entry = ti.static(Entry(line, b, p, u))
                    for add_change in ti.static(tangents):
                        add_change(force, sheet, entry, now)
                    gain = now[GAIN] * mobility(sheet, i, kind, b)
                    q = [sheet.u[c][(ADJOINT_CHANGE * sheet.rows + i) * width + b] for c in ti.static(range(3))]
                    # By summation by parts over all n, p_{n+1} (u_n - u_{n-1}) equals q_{n+1} u_n but for rounding.
                    keep_sum = q[0] * u[0] + q[1] * u[1] + q[2] * u[2]
                    for damp in ti.static(dampings):
                        damp(q, sheet)
                    if band.with_loss:
                        for c in ti.static(range(3)):
                            force[c] += sheet.u[c][(LOSS * sheet.rows + i) * width + b]
                    for c in ti.static(range(3)):
                        q[c] += gain * force[c]
                        sheet.u[c][(ADJOINT_CHANGE * sheet.rows + i) * width + b] = q[c]
                        sheet.u[c][(band.target + i) * width + b] = p[c] + q[c]
                    # A spring pulls its ends in opposite directions.
                    if ti.static(structural):
                        add(sheet.derivatives, (ALONG_ROW * sheet.rows + i) * width + b, right[BY_STIFFNESS] * (-1.0))
                        add(sheet.derivatives, (ALONG_COLUMN * sheet.rows + i) * width + b, down[BY_STIFFNESS] * (-1.0))
                    if ti.static(shear):
                        diagonals = falling[BY_STIFFNESS] + rising[BY_STIFFNESS]
                        add(sheet.derivatives, (DIAGONAL * sheet.rows + i) * width + b, diagonals * (-1.0))
                    for derive in ti.static(foundation_derivatives):
                        index, by_foundation = (FOUNDATION_PART * sheet.rows + i) * width + b, derive(sheet, p, u)
                        add(sheet.derivatives, index, by_foundation[0] * (0 - now[foundation]))
                        for stiffness_at in ti.static(stiffness_functions):
                            k = stiffness_at(sheet, entry, now[foundation])
                            for n in ti.static(range(foundation_numbers)):
                                at_sum = ti.static(FOUNDATION_LAW_SUMS + n)
                                sums[at_sum] = sums[at_sum] - k * by_foundation[1 + n]
                    for n in ti.static(range(numbers)):
                        by_law = ti.static(BY_LAW + n)
                        of_springs = (right[by_law] + down[by_law]) + (falling[by_law] + rising[by_law])
                        sums[LAW_SUMS + n] = sums[LAW_SUMS + n] - of_springs
                    if ti.static(tension):
                        sums[TENSION_SUMS + ALONG_ROW] = sums[TENSION_SUMS + ALONG_ROW] - right[BY_TENSION]
                        sums[TENSION_SUMS + ALONG_COLUMN] = sums[TENSION_SUMS + ALONG_COLUMN] - down[BY_TENSION]
                        of_diagonals = falling[BY_TENSION] + rising[BY_TENSION]
                        sums[TENSION_SUMS + DIAGONAL] = sums[TENSION_SUMS + DIAGONAL] - of_diagonals
                    if ti.static(code.by_area):
                        keep_sum *= area_share(sheet, i, kind, b)
                    sums[KEEP_SUM] += keep_sum
                    add_load_derivatives(load_sums, sheet, entry, now)
                    for laplacian in ti.static(laplacians):
                        if kind == 1:
                            # The moments of p are D times its Laplacian, and 0 at the border.
                            u_row = band.u_row + i
                            for c in ti.static(range(3)):
                                curvature = laplacian(
                                    sheet.history[c], width, u_row - 1, u_row, u_row + 1, b,
                                    1 / (dx * dx), 1 / (dy * dy),
                                )  # fmt: skip
                                sums[BENDING_SUM] = sums[BENDING_SUM] - curvature * sheet.u[c][at * width + b]
            for c in ti.static(range(3)):
                to_next[c] = right[c] - rising[c]
                to_below[c] = falling[c]
        if owned:
            first = (SUM_PARTS + 2 * stationary) * sheet.rows * width + ROW_SUMS * i
            for n in ti.static(range(ROW_SUMS)):
                add(sheet.derivatives, first + n, sums[n])
            for n in ti.static(range(LOAD_DERIVATIVES * slots)):
                by_load[band.n, i, n] = load_sums[n].sum()

    return sweep_row


@cache
def build_sweep(code: KernelConfig, *, parallel: bool) -> Callable[..., None]:
    """Build the kernel that sweeps the adjoint, from the last step to the first; `parallel` as in `build_store`."""
    real, vector, vectors, count_of_numbers = code.real, code.vector, code.vectors, code.constants().end
    fill_halo, storing = build_fill_halo(code), _build_store_moments(code)
    sweep_row = _build_sweep_row(code)

    @ti.func
    def step_band(sheet: ti.template(), tables: ti.template(), sizes: ti.template(), worker, k):
        workers = ti.cast(sizes[WORKERS], ti.i32)
        low, high = sheet.rows * worker // workers, sheet.rows * (worker + 1) // workers
        n = ti.cast(sizes[COUNT], ti.i32) - 1 - k
        u_row = (ti.cast(sizes[U_STEP], ti.i32) - k) * sheet.rows
        buffer = (ti.cast(sizes[BUFFER], ti.i32) + k) % 2
        carry = ti.cast(sizes[CARRY] + sizes[CARRIED_ROWS] * worker, ti.i32)
        moments = ti.cast(sizes[MOMENT_ROW], ti.i32) + MOMENT_ROWS * worker
        with_loss = n == 0 and sizes[WITH_LOSS] != 0
        source, target = buffer * sheet.rows, (1 - buffer) * sheet.rows
        band = ti.static(AdjointBand(low, high, source, target, u_row, carry, moments, n, with_loss))
        if low == 0:
            for b in range(1, sheet.width - 1):
                for c in ti.static(range(3)):
                    sheet.u[c][carry * sheet.width + b] = vector(0)
        for i in range(ti.max(low - 1, 0), high):
            for store_moments in ti.static(storing):
                if i >= low:
                    store_moments(sheet, band, i)
            sweep_row(sheet, band, i, tables.loads, tables.by_load)
            if i >= low:
                fill_halo(sheet.u, target + i, sheet.width)

    run_worker = _build_run_worker(step_band, parallel=parallel)

    @ti.kernel
    def sweep(
        sizes: ti.types.ndarray(dtype=ti.i64, ndim=1), progress: ti.types.ndarray(dtype=ti.i64, ndim=1),
        loads: ti.types.ndarray(dtype=real, ndim=2), by_load: ti.types.ndarray(dtype=real, ndim=3),
        p_x: vectors, p_y: vectors, p_z: vectors,
        u_x: vectors, u_y: vectors, u_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: vectors, fields: vectors, derivatives: vectors,
    ):  # fmt: skip
        """Sweep backward over the displacements `u` of all steps of a segment [m].

        `sizes`, `progress` and `loads`, of the swept steps, are as in `store`. `by_load` receives the derivatives with
        respect to the loads, added up over a row, shape (steps, rows, slots x 5). `p` is the adjoint state, see
        `BUFFERS`, then the workers' moments and carried forces. For `derivatives`, see `SPRING_PARTS`.
        """
        ti.loop_config(serialize=not parallel)
        for index in range(ti.cast(sizes[WORKERS], ti.i32) * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                rows, width = ti.cast(sizes[ROWS], ti.i32), ti.cast(sizes[STRIP], ti.i32) + 2
                constants = [constants_of[n][0] for n in ti.static(range(count_of_numbers))]
                p, u = ti.static((p_x, p_y, p_z), (u_x, u_y, u_z))
                sheet = ti.static(AdjointSheet(p, by_column, fields, constants, rows, width, u, derivatives))
                tables = ti.static(LoadTables(loads, by_load))
                run_worker(sheet, tables, sizes, progress, index // ITERATIONS_PER_THREAD)

    return sweep


@cache
def build_copy(code: KernelConfig) -> Callable[..., None]:
    """Build the kernel that copies three arrays."""
    vectors = code.vectors

    @ti.kernel
    def copy(
        entries: ti.i32, source: ti.i32, target: ti.i32,
        from_x: vectors, from_y: vectors, from_z: vectors,
        to_x: vectors, to_y: vectors, to_z: vectors,
    ):  # fmt: skip
        """Copy entries of three arrays, from `source` on, to three others, from `target` on."""
        ti.loop_config(serialize=True)
        for n in range(entries):
            for a, b in ti.static(((from_x, to_x), (from_y, to_y), (from_z, to_z))):
                b[target + n] = a[source + n]

    return copy
