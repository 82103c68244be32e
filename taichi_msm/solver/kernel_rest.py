"""Kernel 1 for quasi-static equilibrium, on a CPU: minimisation of the energy by FIRE, with the forces of `row`.

FIRE (Bitzek et al. 2006, Physical Review Letters 97, 170201; with the half step back of Guénolé et al. 2020,
Computational Materials Science 175, 109584) moves mass points under their forces F with fictitious masses M. It turns
the velocities v toward the forces, and resets them if the power F v is not positive:

    F v > 0:  v += dt F / M,  v = (1 - a) v + a (F / M) |v| / |F / M|,  x += dt v;  a decreases, dt increases
    else:     x -= dt v / 2,  v = dt F / M,                             x += dt v;  a is reset, dt decreases

The norms are taken over all mass points and weighted with M. M bounds the stiffness at each mass point, so no angular
frequency exceeds 1, and the largest step dt = 1 is stable. The kernel stores the momentum q = M v.

Contact forces of position-controlled tools are removed from the forces, and mass points are projected out of the tools
(`terms.contact`). Before the projection a mass point that presses on a tool moves by F / M into it, so that it
stays in contact.

An evaluation of the forces passes over the rows like a step; a second loop moves the mass points. Sums over mass points
run down the columns first and then over the columns in their order, so their bits do not depend on the lanes.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.arrays import (
    InitialData,
    SheetArrays,
    SheetKernel,
    SheetLayout,
    build_point_forces,
    build_read,
    to_lanes,
)
from taichi_msm.solver.bands import MOMENT_ROWS, RowBand, build_fill_halo, build_step_row
from taichi_msm.system.runtime import compilation_options, ti, write_vectors
from taichi_msm.terms.base import Entry, KernelConfig, KernelRow, KernelSheet, RestCorrection
from taichi_msm.terms.bending import BendingTerm
from taichi_msm.terms.points import build_point_functions
from taichi_msm.terms.springs import SpringTerm

# Arguments of a launch
#   ROWS, STRIP         rows of the sheet; columns of a strip
#   FIRST_ROW, END_ROW  the first row that is not fixed; the row after the last one
#   COUNT               largest number of evaluations
#   SQUARED_TOLERANCE   square of the force tolerance [N^2]
#   PLACED              1 if tools or mass points were placed since the last launch, else 0
# State of FIRE
#   STEP, MIXING        the step dt; the mixing factor a
#   POSITIVE_COUNT      number of consecutive evaluations with positive power
# Results
#   EVALUATIONS         number of evaluations
#   LARGEST             square of the largest force at the last evaluation [N^2]
#   FORCE_SUM           sum of F^2 / M at the last evaluation, not finite if any force is NaN
ROWS, STRIP, FIRST_ROW, END_ROW, COUNT, SQUARED_TOLERANCE, PLACED, STEP, MIXING, POSITIVE_COUNT = range(10)
EVALUATIONS, LARGEST, FORCE_SUM, NUMBERS = range(10, 14)

# Reductions of an evaluation: the sums of F q / M, F^2 / M and q^2 / M; the square of the largest force.
POWER, SQUARED_FORCE, MOTION, MAX_SQUARE, SUMS = range(5)

# Initial mixing factor and its decay; factors of the step; evaluations with positive power before the step grows.
FIRST_MIXING, MIXING_DECAY, SHRINK, GROW, DELAY = 0.25, 0.99, 0.9, 1.1, 10

INFINITE = float("inf")

# Bounds of the step.
LARGEST_STEP, SMALLEST_STEP = 1.0, 0.02


class RestSheet(NamedTuple):
    """A `KernelSheet` with the additional arrays of FIRE; d contains the forces without those of contact."""

    u: Any
    d: Any
    by_column: Any
    fields: Any
    constants: Any
    rows: Any
    width: Any
    q: Any  # momenta, as three arrays
    work: Any  # 1 / M of every mass point [m/N], followed by SUMS rows of reductions


class Relaxation(SheetKernel):
    """A sheet in the memory of a CPU, and the kernels that find its equilibrium.

    Its fictitious masses M [N/m] have the shape (rows, cols).
    """

    def __init__(self, layout: SheetLayout, start: InitialData, masses: NDArray[Any]) -> None:
        self._layout, self.masses = layout, masses
        self._relax, self._scale_kernel = _build_relax(layout.config), _build_scale(layout.config)
        self._read = build_read(layout.config, parallel=False, iterations=1)
        moments = 0 if layout.config.get(BendingTerm) is None else MOMENT_ROWS
        # After the rows of the sheet, u contains rows of moments and a row of the forces carried to the next row.
        sheet_rows = np.concatenate([np.arange(layout.rows, dtype=np.int32), np.full(moments + 1, -1, np.int32)])
        self.arrays = SheetArrays(layout, sheet_rows, start)
        self._q = [self.arrays.allocate_rows(layout.rows) for _ in range(3)]
        self._work = self.arrays.allocate_rows(layout.rows + SUMS)
        write_vectors(self._work, to_lanes(layout, 1 / masses))
        first_fixed, last_fixed = layout.fixed_rows
        self._fire = np.zeros(NUMBERS)
        self._fire[:COUNT] = layout.rows, layout.strip, int(first_fixed), layout.rows - int(last_fixed)
        self.stop()

    def stop(self) -> None:
        """Stop all mass points and reset the state of FIRE."""
        for q in self._q:
            write_vectors(q, np.zeros((0, self._layout.config.lanes)))
        self._fire[[STEP, MIXING, POSITIVE_COUNT, PLACED]] = LARGEST_STEP, FIRST_MIXING, 0, 1

    def place(self, displacement: NDArray[Any]) -> None:
        """Set the displacements [m], shape (rows, cols, 3)."""
        self._fire[PLACED] = 1
        self.arrays.set_displacement(displacement)

    def relax(self, count: int, tolerance: float, row: NDArray[Any]) -> tuple[int, float]:
        """Evaluate the forces and move the mass points, at most `count` times, until no force exceeds a tolerance [N].

        Return the number of evaluations, and the largest force of the last one [N], infinite if any force is NaN.
        """
        fire = self._fire
        fire[[COUNT, SQUARED_TOLERANCE]] = count, tolerance * tolerance
        with compilation_options():
            self._relax(fire, row, *self._q, self._work, *self.arrays.all)
        largest = float(np.sqrt(fire[LARGEST])) if fire[FORCE_SUM] < np.inf else np.inf
        return int(fire[EVALUATIONS]), largest

    def scale(self, row: NDArray[Any]) -> float:
        """Return the largest force of a spring, a load or the foundation on a mass point [N], the unit of residuals."""
        largest = np.zeros(1)
        with compilation_options():
            self._scale_kernel(self._layout.rows, self._layout.width, largest, row, *self.arrays.all)
        return float(np.sqrt(largest[0]))


def _corrections(config: KernelConfig) -> list[RestCorrection]:
    return [correction for term in config.terms if (correction := term.build_rest_correction(config)) is not None]


def _build_store(config: KernelConfig) -> Callable[..., None]:
    """Build the Taichi function that stores the force on an entry and adds to the reductions of FIRE."""
    vector, forces = config.vector, build_point_forces(config)
    removals, mobility = [each.remove for each in _corrections(config)], build_point_functions(config).mobility

    @ti.func
    def store(sheet: ti.template(), entry: ti.template(), _target, force: ti.template(), now: ti.template()):
        """Store `force`, that of springs, plus those of all other terms, and reduce the part that no tool carries."""
        for add in ti.static(forces):
            add(force, sheet, entry, now)
        width, at = sheet.width, entry.row.i * sheet.width + entry.b
        moves = mobility(sheet, entry.row.i, entry.row.kind, entry.b) > 0
        inverse = sheet.work[at]
        power, square, motion = vector(0), vector(0), vector(0)
        for c in ti.static(range(3)):
            force[c] = ti.select(moves, force[c], vector(0))
            sheet.d[c][at] = force[c]
        for remove in ti.static(removals):
            remove(force, sheet, at)
        for c in ti.static(range(3)):
            q = sheet.q[c][at]
            power += force[c] * q
            square += force[c] * force[c]
            motion += q * q
        for n, term in ti.static(((POWER, power), (SQUARED_FORCE, square), (MOTION, motion))):
            # `+=` on an array would be atomic.
            place = (sheet.rows + n) * width + entry.b
            sheet.work[place] = sheet.work[place] + term * inverse
        place = (sheet.rows + MAX_SQUARE) * width + entry.b
        sheet.work[place] = ti.max(sheet.work[place], square)

    return store


@cache
def _build_relax(config: KernelConfig) -> Callable[..., None]:
    """Build the kernel that evaluates forces and moves mass points."""
    real, vector, vectors, lanes = config.real, config.vector, config.vectors, config.lanes
    constant_count, fill_halo = config.constants().end, build_fill_halo(config)
    step_row = build_step_row(config, _build_store(config), corrects=False, parallel=False)
    moments = 0 if config.get(BendingTerm) is None else MOMENT_ROWS
    columns, corrections = config.columns().end, _corrections(config)
    removals, projections = [each.remove for each in corrections], [each.project for each in corrections]

    @ti.func
    def add_up(sheet: ti.template(), n: ti.template()):
        """Return the sum of reduction n over all columns."""
        total = ti.cast(0, real)
        for lane in ti.static(range(lanes)):
            for b in range(1, sheet.width - 1):
                total += sheet.work[(sheet.rows + n) * sheet.width + b][lane]
        return total

    @ti.func
    def evaluate(sheet: ti.template(), row: ti.template(), band: ti.template()):
        """Evaluate the forces on all mass points and their reductions."""
        for n in range(sheet.rows * sheet.width, (sheet.rows + SUMS) * sheet.width):
            sheet.work[n] = vector(0)
        for line in range(-1, band.high - band.low):
            step_row(sheet, sheet.u, row, band, line, 0, 0, sheet.rows + moments, sheet.rows)

    @ti.func
    def move_points(sheet: ti.template(), row: ti.template(), band: ti.template(), keep, gain, dt, back):
        """Update q = keep q + gain F, and move the mass points by (dt q - back q_before) / M."""
        for i in range(band.low, band.high):
            for b in range(1, sheet.width - 1):
                at = i * sheet.width + b
                full_force = [sheet.d[c][at] for c in ti.static(range(3))]
                force = [full_force[c] for c in ti.static(range(3))]
                for remove in ti.static(removals):
                    remove(force, sheet, at)
                for c in ti.static(range(3)):
                    old_q = sheet.q[c][at]
                    q = keep * old_q + gain * force[c]
                    sheet.q[c][at] = q
                    shift = dt * q - back * old_q
                    if ti.static(len(removals) > 0):
                        shift += full_force[c] - force[c]
                    sheet.u[c][at] = sheet.u[c][at] + shift * sheet.work[at]
            settle_row(sheet, row, i)

    @ti.func
    def settle_row(sheet: ti.template(), row: ti.template(), i):
        """Project the mass points of row i out of the tools, and fill its halo."""
        kind = ti.select(i == sheet.rows - 1, 2, ti.select(i == 0, 0, 1))
        if ti.static(len(projections) > 0):
            now = [row[0, c] for c in ti.static(range(columns))]
            for b in range(1, sheet.width - 1):
                for project_out in ti.static(projections):
                    project_out(sheet, i, kind, b, now)
        fill_halo(sheet.u, i, sheet.width)

    @ti.kernel
    def relax(
        fire: ti.types.ndarray(dtype=real, ndim=1), row: ti.types.ndarray(dtype=real, ndim=2),
        q_x: vectors, q_y: vectors, q_z: vectors, work: vectors,
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1), by_column: vectors, fields: vectors,
    ):  # fmt: skip
        """Evaluate the forces and move the mass points, see `Relaxation.relax`.

        `fire` has arguments, state of FIRE and results, in the order of ROWS, ..., FORCE_SUM, and `row` is a row of the
        load table. `work` has 1 / M of every mass point [m/N], followed by SUMS rows of reductions; q are momenta [N].
        """
        ti.loop_config(serialize=True)
        for _ in range(1):
            rows, width = ti.cast(fire[ROWS], ti.i32), ti.cast(fire[STRIP], ti.i32) + 2
            low, high = ti.cast(fire[FIRST_ROW], ti.i32), ti.cast(fire[END_ROW], ti.i32)
            count = ti.cast(fire[COUNT], ti.i32)
            constants = [constants_of[n][0] for n in ti.static(range(constant_count))]
            u, forces, q = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z), (q_x, q_y, q_z))
            sheet = ti.static(RestSheet(u, forces, by_column, fields, constants, rows, width, q, work))
            band = ti.static(RowBand(0, 1, low, high, 1, rows, 0, fire))
            if fire[PLACED] > 0:
                for i in range(low, high):
                    settle_row(sheet, row, i)
                fire[PLACED] = 0
            evaluations = 0
            active = True
            while active and evaluations < count:
                evaluate(sheet, row, band)
                evaluations += 1
                power, force_sum, motion = add_up(sheet, POWER), add_up(sheet, SQUARED_FORCE), add_up(sheet, MOTION)
                largest = ti.cast(0, real)
                for b in range(1, width - 1):
                    largest = ti.max(largest, sheet.work[(rows + MAX_SQUARE) * width + b].max())
                fire[LARGEST] = largest
                fire[FORCE_SUM] = force_sum
                # With NaN the comparison is False and ends the loop.
                active = largest > fire[SQUARED_TOLERANCE] and force_sum < INFINITE
                if active:
                    keep, back = ti.cast(0, real), ti.cast(0, real)
                    if power > 0:
                        fire[POSITIVE_COUNT] = fire[POSITIVE_COUNT] + 1
                        if fire[POSITIVE_COUNT] > DELAY:
                            fire[STEP] = ti.min(fire[STEP] * GROW, LARGEST_STEP)
                            fire[MIXING] = fire[MIXING] * MIXING_DECAY
                        keep = 1 - fire[MIXING]
                    else:
                        if motion > 0:
                            fire[STEP] = ti.max(fire[STEP] * SHRINK, SMALLEST_STEP)
                        fire[POSITIVE_COUNT] = 0
                        fire[MIXING] = FIRST_MIXING
                        back = fire[STEP] / 2
                    dt = fire[STEP]
                    gain = dt
                    if power > 0:
                        # |q + dt F| / |F|, with norms weighted with 1 / M.
                        norm_ratio = ti.sqrt((motion + 2 * dt * power + dt * dt * force_sum) / force_sum)
                        gain = keep * dt + fire[MIXING] * norm_ratio
                    move_points(sheet, row, band, keep, gain, dt, back)
            fire[EVALUATIONS] = evaluations

    return relax


@cache
def _build_scale(config: KernelConfig) -> Callable[..., None]:
    """Build the kernel of `Relaxation.scale`."""
    real, vector, vectors, columns = config.real, config.vector, config.vectors, config.columns().end
    constant_count, mobility = config.constants().end, build_point_functions(config).mobility
    max_spring_force = config.require(SpringTerm).build_max_spring_force(config)
    forces = [
        force for term in config.terms if not isinstance(term, BendingTerm) for force in term.build_forces(config)
    ]

    @ti.kernel
    def compute_scale(
        rows: ti.i32, width: ti.i32,
        result: ti.types.ndarray(dtype=real, ndim=1), row: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1), by_column: vectors, fields: vectors,
    ):  # fmt: skip
        """Compute the square of the largest force of a spring, a load or the foundation on a mass point [N^2]."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            constants = [constants_of[n][0] for n in ti.static(range(constant_count))]
            u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
            sheet = ti.static(KernelSheet(u, d, by_column, fields, constants, rows, width))
            now = [row[0, c] for c in ti.static(range(columns))]
            largest = vector(0)
            for i in range(rows):
                kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
                line = ti.static(KernelRow(i, kind, 0, 0, 0))
                for b in range(1, width - 1):
                    displacement = [u[c][i * width + b] for c in ti.static(range(3))]
                    entry = ti.static(Entry(line, b, displacement))
                    largest = ti.max(largest, max_spring_force(sheet, entry))
                    moves = mobility(sheet, i, kind, b) > 0
                    for add in ti.static(forces):
                        force = [vector(0) for _ in ti.static(range(3))]
                        add(force, sheet, entry, now)
                        square = force[0] * force[0] + force[1] * force[1] + force[2] * force[2]
                        largest = ti.max(largest, ti.select(moves, square, vector(0)))
            result[0] = largest.max()

    return compute_scale
