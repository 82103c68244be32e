"""Kernel 1 at rest, on a CPU: it moves a sheet to where its forces balance, by FIRE, with the forces of `row`.

FIRE (Bitzek et al. 2006, Physical Review Letters 97, 170201; with the half step back of Guénolé et al. 2020,
Computational Materials Science 175, 109584) lets the points move under their forces F with masses M of its own, and
turns their velocities v toward the forces; where these no longer do work, it stops them:

    F v > 0:  v += dt F / M,  v = (1 - a) v + a (F / M) |v| / |F / M|,  x += dt v;  a falls, and dt grows
    else:     x -= dt v / 2,  v = dt F / M,                             x += dt v;  a is as at first, and dt falls

with norms over all points, weighted with M. M bounds the stiffness that a point feels, so that no frequency is above 1,
and dt = 1 is stable and the largest step (`rest`). Stored is the momentum q = M v.

Tools that are moved take their part of the forces off, and points that have moved are pushed out of them
(`terms.contact_rest`): each point that presses on a tool also goes by F / M into it, so that it stays in touch.

One evaluation of the forces goes through the rows as a step does; a second loop moves the points. Sums over points are
taken along columns first, and then over the columns in their order, so that their bits do not depend on lanes.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.arrays import SheetArrays, SheetLayout, Start, in_lanes, point_forces, reading
from taichi_msm.solver.bands import MOMENTS, RowBand, joining, stepping_row
from taichi_msm.system.runtime import compilation_options, ti, write_vectors
from taichi_msm.terms.base import MOVES, Entry, KernelRow, KernelSheet, StepCode
from taichi_msm.terms.bending import BendingTerm
from taichi_msm.terms.contact import ContactTerm
from taichi_msm.terms.contact_rest import bearing, keeping_out
from taichi_msm.terms.springs import SpringTerm

# The numbers of a launch. It is given: rows of the sheet; columns of a strip; the first row that moves, and the row
# after the last; how many evaluations it may take, the square of the largest force with which it ends [N^2], and
# whether tools or points have been put elsewhere since the last launch. FIRE
# keeps: the step, the share a, how many times in turn the forces have done work. It gives: the number of evaluations;
# and of the last one the square of the largest force on a point [N^2], and the sum of F^2 / M, which tells NaN.
ROWS, STRIP, FIRST_ROW, END_ROW, COUNT, ENOUGH, PLACED, STEP, SHARE, WORKED = range(10)
EVALUATIONS, LARGEST, SLOPE, NUMBERS = range(10, 14)

# Sums over points of an evaluation: of F q / M, of F^2 / M and of q^2 / M; and the square of the largest force.
POWER, STEEP, MOTION, SQUARE, SUMS = range(5)

# The share a at first and its decay, the factors of the step, and how often the forces do work before it grows.
FIRST_SHARE, SHARE_DECAY, SHRINK, GROW, DELAY = 0.25, 0.99, 0.9, 1.1, 10

INFINITE = float("inf")

# The largest step and the smallest.
LARGEST_STEP, SMALLEST_STEP = 1.0, 0.02


class RestSheet(NamedTuple):
    """A `KernelSheet` with what FIRE needs besides."""

    u: Any
    d: Any  # here the forces, of all but the tools that are moved
    by_column: Any
    stiffness: Any
    fields: Any
    numbers: Any
    rows: Any
    width: Any
    q: Any  # momenta, three arrays
    work: Any  # 1 / M of every point [m/N], and after it SUMS rows of sums


class Relaxation:
    """The state of a sheet in the memory of a CPU, and the kernels that bring it to rest.

    Args:
        masses: M of every point [N/m], shape (rows, cols).
    """

    def __init__(self, layout: SheetLayout, start: Start, masses: NDArray[Any]) -> None:
        self._layout = layout
        self._relax, self._compare, self._read = _kernels(layout.code)
        moments = 0 if layout.code.get(BendingTerm) is None else MOMENTS
        # Stored after the sheet's own rows: moments, and then the forces carried to the next row.
        self._stored = np.concatenate([np.arange(layout.rows, dtype=np.int32), np.full(moments + 1, -1, np.int32)])
        self.arrays = arrays = SheetArrays(layout, self._stored, start)
        self._q, self._work = [arrays.rows(layout.rows) for _ in range(3)], arrays.rows(layout.rows + SUMS)
        write_vectors(self._work, in_lanes(layout, 1 / masses))
        first_fixed, last_fixed = layout.fixed_rows
        self._fire = np.zeros(NUMBERS)
        self._fire[:COUNT] = layout.rows, layout.strip, int(first_fixed), layout.rows - int(last_fixed)
        self.stop()

    def stop(self) -> None:
        """Let the points stand still, and begin again with FIRE's first step."""
        for q in self._q:
            write_vectors(q, np.zeros((0, self._layout.code.lanes)))
        self._fire[[STEP, SHARE, WORKED, PLACED]] = LARGEST_STEP, FIRST_SHARE, 0, 1

    def place(self, displacement: NDArray[Any]) -> None:
        """Put the points where they have these displacements [m], shape (rows, cols, 3)."""
        held = (self._stored >= 0)[:, None]
        self._fire[PLACED] = 1
        for c in range(3):
            write_vectors(self.arrays.u[c], in_lanes(self._layout, np.where(held, displacement[self._stored, :, c], 0)))

    def relax(self, count: int, enough: float, row: NDArray[Any]) -> tuple[int, float]:
        """Evaluate the forces up to `count` times, and move the points after each; until all forces are small.

        Args:
            count: how many times at most.
            enough: the largest force on a point that ends it, at once and without a move [N].
            row: of the table of loads, shape (1, columns).

        Returns:
            How often the forces were evaluated, and the largest of the last time [N], which is infinite where any force
            is not a number.
        """
        fire = self._fire
        fire[[COUNT, ENOUGH]] = count, enough * enough
        with compilation_options():
            self._relax(fire, row, *self._q, self._work, *self.arrays.all)
        largest = float(np.sqrt(fire[LARGEST])) if fire[SLOPE] < np.inf else np.inf
        return int(fire[EVALUATIONS]), largest

    def scale(self, row: NDArray[Any]) -> float:
        """Give the largest force of a spring, a load or the foundation on a point [N]."""
        largest = np.zeros(1)
        with compilation_options():
            self._compare(self._layout.rows, self._layout.width, largest, row, *self.arrays.all)
        return float(np.sqrt(largest[0]))

    def read(self, differences: bool, values: NDArray[Any], measures: NDArray[Any]) -> None:
        """Copy displacements or forces into values, shape (rows, cols, 3), and the measures of every row."""
        with compilation_options():
            self._read(0, self._layout.rows, self._layout.cols, differences, values, measures, *self.arrays.all)


@cache
def _kernels(code: StepCode) -> tuple[Callable[..., None], Callable[..., None], Callable[..., None]]:
    """Make the kernels of one code; each is compiled when it is first launched."""
    return _relaxing(code), _comparing(code), reading(code, parallel=False, iterations=1)


def _storing(code: StepCode) -> Callable[..., None]:
    """Make the function that stores the force on an entry, and adds what FIRE needs of it to the sums."""
    vector, forces, contact = code.vector, point_forces(code), code.get(ContactTerm)
    bearings = [bearing(code, contact)] if contact else []

    @ti.func
    def store(sheet: ti.template(), entry: ti.template(), _target, force: ti.template(), now: ti.template()):
        for add in ti.static(forces):
            add(force, sheet, entry, now)
        width, at = sheet.width, entry.row.i * sheet.width + entry.b
        moves = sheet.by_column[(MOVES + entry.row.kind) * width + entry.b] > 0
        inverse = sheet.work[at]
        power, square, motion = vector(0), vector(0), vector(0)
        for c in ti.static(range(3)):
            force[c] = ti.select(moves, force[c], vector(0))
            sheet.d[c][at] = force[c]
        for bear in ti.static(bearings):
            bear(force, sheet, at)
        for c in ti.static(range(3)):
            q = sheet.q[c][at]
            power += force[c] * q
            square += force[c] * force[c]
            motion += q * q
        for n, term in ti.static(((POWER, power), (STEEP, square), (MOTION, motion))):
            # To an array, += would be atomic.
            place = (sheet.rows + n) * width + entry.b
            sheet.work[place] = sheet.work[place] + term * inverse
        place = (sheet.rows + SQUARE) * width + entry.b
        sheet.work[place] = ti.max(sheet.work[place], square)

    return store


def _relaxing(code: StepCode) -> Callable[..., None]:
    """Make the kernel that moves the points."""
    real, vector, vectors, lanes = code.real, code.vector, code.vectors, code.lanes
    count_of_numbers, join_strips = code.first_number(None), joining(code)
    pass_row = stepping_row(code, _storing(code), touches=False, parallel=False)
    moments = 0 if code.get(BendingTerm) is None else MOMENTS
    columns, contact = code.first_column(None), code.get(ContactTerm)
    bearings, keepings = ([bearing(code, contact)], [keeping_out(code, contact)]) if contact else ([], [])

    @ti.func
    def add_up(sheet: ti.template(), n: ti.template()):
        """Add up row n of the sums, column by column."""
        total = ti.cast(0, real)
        for lane in ti.static(range(lanes)):
            for b in range(1, sheet.width - 1):
                total += sheet.work[(sheet.rows + n) * sheet.width + b][lane]
        return total

    @ti.func
    def evaluate(sheet: ti.template(), row: ti.template(), band: ti.template()):
        """Find the forces, which leaves the displacements as they are."""
        for n in range(sheet.rows * sheet.width, (sheet.rows + SUMS) * sheet.width):
            sheet.work[n] = vector(0)
        for line in range(-1, band.high - band.low):
            pass_row(sheet, sheet.u, row, band, line, 0, 0, sheet.rows + moments, sheet.rows)

    @ti.func
    def move_points(sheet: ti.template(), row: ti.template(), band: ti.template(), keep, gain, dt, back):
        """Turn the momenta, q = keep q + gain F, and move the points by dt q / M, less `back` times their old q / M."""
        for i in range(band.low, band.high):
            for b in range(1, sheet.width - 1):
                at = i * sheet.width + b
                every = [sheet.d[c][at] for c in ti.static(range(3))]
                force = [every[c] for c in ti.static(range(3))]
                for bear in ti.static(bearings):
                    bear(force, sheet, at)
                for c in ti.static(range(3)):
                    before = sheet.q[c][at]
                    q = keep * before + gain * force[c]
                    sheet.q[c][at] = q
                    moved = dt * q - back * before
                    if ti.static(len(bearings) > 0):
                        moved += every[c] - force[c]
                    sheet.u[c][at] = sheet.u[c][at] + moved * sheet.work[at]
            settle_row(sheet, row, i)

    @ti.func
    def settle_row(sheet: ti.template(), row: ti.template(), i):
        """Keep a row that has moved out of the tools, and fill its halo."""
        kind = ti.select(i == sheet.rows - 1, 2, ti.select(i == 0, 0, 1))
        if ti.static(len(keepings) > 0):
            now = [row[0, c] for c in ti.static(range(columns))]
            for b in range(1, sheet.width - 1):
                for keep_out in ti.static(keepings):
                    keep_out(sheet, i, kind, b, now)
        join_strips(sheet.u, i, sheet.width)

    @ti.kernel
    def relax(
        fire: ti.types.ndarray(dtype=real, ndim=1),
        row: ti.types.ndarray(dtype=real, ndim=2),
        q_x: vectors, q_y: vectors, q_z: vectors,
        work: vectors,
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        numbers_of: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: vectors, stiffness: vectors, fields: vectors,
    ):  # fmt: skip
        ti.loop_config(serialize=True)
        for _ in range(1):
            rows, width = ti.cast(fire[ROWS], ti.i32), ti.cast(fire[STRIP], ti.i32) + 2
            low, high = ti.cast(fire[FIRST_ROW], ti.i32), ti.cast(fire[END_ROW], ti.i32)
            count = ti.cast(fire[COUNT], ti.i32)
            numbers = [numbers_of[n][0] for n in ti.static(range(count_of_numbers))]
            u, forces, q = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z), (q_x, q_y, q_z))
            sheet = ti.static(RestSheet(u, forces, by_column, stiffness, fields, numbers, rows, width, q, work))
            band = ti.static(RowBand(0, 1, low, high, 1, rows, 0, fire))
            if fire[PLACED] > 0:
                for i in range(low, high):
                    settle_row(sheet, row, i)
                fire[PLACED] = 0
            evaluations = 0
            goes = True
            while goes and evaluations < count:
                evaluate(sheet, row, band)
                evaluations += 1
                power, slope, motion = add_up(sheet, POWER), add_up(sheet, STEEP), add_up(sheet, MOTION)
                largest = ti.cast(0, real)
                for b in range(1, width - 1):
                    largest = ti.max(largest, sheet.work[(rows + SQUARE) * width + b].max())
                fire[LARGEST] = largest
                fire[SLOPE] = slope
                # Written so that NaN ends it, too.
                goes = largest > fire[ENOUGH] and slope < INFINITE
                if goes:
                    keep, back = ti.cast(0, real), ti.cast(0, real)
                    if power > 0:
                        fire[WORKED] = fire[WORKED] + 1
                        if fire[WORKED] > DELAY:
                            fire[STEP] = ti.min(fire[STEP] * GROW, LARGEST_STEP)
                            fire[SHARE] = fire[SHARE] * SHARE_DECAY
                        keep = 1 - fire[SHARE]
                    else:
                        if motion > 0:
                            fire[STEP] = ti.max(fire[STEP] * SHRINK, SMALLEST_STEP)
                        fire[WORKED] = 0
                        fire[SHARE] = FIRST_SHARE
                        back = fire[STEP] / 2
                    dt = fire[STEP]
                    gain = dt
                    if power > 0:
                        # |q + dt F| and |F|, weighted with 1 / M.
                        turned = ti.sqrt((motion + 2 * dt * power + dt * dt * slope) / slope)
                        gain = keep * dt + fire[SHARE] * turned
                    move_points(sheet, row, band, keep, gain, dt, back)
            fire[EVALUATIONS] = evaluations

    return relax


def _comparing(code: StepCode) -> Callable[..., None]:
    """Make the kernel that finds the square of the largest force of a spring, a load or the foundation."""
    real, vector, vectors, columns = code.real, code.vector, code.vectors, code.first_column(None)
    count_of_numbers, pull = code.first_number(None), code.require(SpringTerm).pulling(code)
    forces = [force for term in code.terms if not isinstance(term, BendingTerm) for force in term.forces(code)]

    @ti.kernel
    def compare(
        rows: ti.i32,
        width: ti.i32,
        result: ti.types.ndarray(dtype=real, ndim=1),
        row: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        numbers_of: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: vectors, stiffness: vectors, fields: vectors,
    ):  # fmt: skip
        ti.loop_config(serialize=True)
        for _ in range(1):
            numbers = [numbers_of[n][0] for n in ti.static(range(count_of_numbers))]
            u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
            sheet = ti.static(KernelSheet(u, d, by_column, stiffness, fields, numbers, rows, width))
            now = [row[0, c] for c in ti.static(range(columns))]
            largest = vector(0)
            for i in range(rows):
                kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
                line = ti.static(KernelRow(i, kind, 0, 0, 0))
                for b in range(1, width - 1):
                    here = [u[c][i * width + b] for c in ti.static(range(3))]
                    entry = ti.static(Entry(line, b, here))
                    largest = ti.max(largest, pull(sheet, entry))
                    moves = sheet.by_column[(MOVES + kind) * width + b] > 0
                    for add in ti.static(forces):
                        force = [vector(0) for _ in ti.static(range(3))]
                        add(force, sheet, entry, now)
                        square = force[0] * force[0] + force[1] * force[1] + force[2] * force[2]
                        largest = ti.max(largest, ti.select(moves, square, vector(0)))
            result[0] = largest.max()

    return compare
