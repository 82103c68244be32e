"""What both forms of kernel 1 share: the layout of a sheet, the step of a point, the measures of an entry.

The values of the sheet are vectors of lanes, each lane of another column; on a GPU a vector has one lane. They lie in
Taichi's ndarrays row after row. A row has `width` entries: one for every column of a strip, and a halo of one entry at
both ends. The arrays are one-dimensional, which saves a few instructions for every index:

    u, d         displacements and last differences; three arrays each, for x, y and z
    by_column    for a first, a middle and a last row: 1 over the points' share of a cell's mass, 0 if they are fixed;
                 and their share of a cell's area. For all rows: x at rest [m]; whether there is a left neighbour;
                 whether there is a right one
    fields       a number for every point each, as many rows as the sheet has; those of its terms follow each other
    stiffness    with a map, of every spring: see `SpringTerm.laid_out`
    numbers      of the sheet and its terms, in the first lane of an entry each

With bending, u also has rows of moments. The numbers of a step are in the table of loads, a row for every step.

Vectors stay vectors down to the machine code (docs/decisions/0010). There, some of Taichi's operations crash or give
wrong results; so unary minus, `-=`, abs, any and all are not used on vectors, and exp is applied lane by lane.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.state import State
from taichi_msm.system.runtime import Memory, ti, write_vectors
from taichi_msm.terms.base import AREA, GAIN, MOTION, MOVES, KernelSheet, StepCode

# Bytes of a number.
BYTES = {"f32": 4, "f64": 8}


@dataclass(frozen=True)
class SheetLayout:
    """How a sheet is laid out in memory and shared out among workers, and the code that steps it."""

    # rows, cols: points of the sheet
    rows: int
    cols: int
    workers: int  # number of bands of rows that are stepped in parallel; 0 on a GPU, where all points are
    depth: int  # number of steps that a band takes in one pass
    fixed_rows: tuple[bool, bool]  # whether all points of the first row are fixed, and all of the last
    code: StepCode  # what the kernels are compiled for

    @property
    def strip(self) -> int:
        """Number of columns of a strip."""
        return -(-self.cols // self.code.lanes)

    @property
    def width(self) -> int:
        """Number of entries in a row, including the halo of its strips."""
        return self.strip + 2


class Start(NamedTuple):
    """What the arrays of a sheet hold at the start."""

    numbers: NDArray[Any]  # of the sheet and its terms
    by_column: NDArray[Any]  # shape (COLUMN_ROWS, cols)
    fields: NDArray[Any]  # of the terms, shape (fields, rows, cols)
    stiffness: NDArray[Any] | None  # as many rows as it takes; None without a map
    state: State | None  # to continue from; None: at rest


def in_lanes(layout: SheetLayout, values: NDArray[Any]) -> NDArray[Any]:
    """Lay columns of values, shape (..., cols), out in strips with their halo, shape (entries, lanes).

    In the precision of the code: values too large for it become infinite. Entries without a column are 0.
    """
    column = np.arange(layout.code.lanes) * layout.strip + np.arange(-1, layout.strip + 1)[:, None]
    inside = (column >= 0) & (column < layout.cols)
    real = np.float32 if layout.code.precision == "f32" else np.float64
    with np.errstate(over="ignore"):
        laid = np.take(values.astype(real), column * inside, axis=-1) * inside.astype(real)
    return laid.reshape(-1, layout.code.lanes)


def out_of_lanes(layout: SheetLayout, entries: NDArray[Any], rows: int) -> NDArray[Any]:
    """Give the columns of the first rows of what `in_lanes` has laid out, shape (rows, cols)."""
    laid = entries[: rows * layout.width].reshape(rows, layout.width, layout.code.lanes)
    return laid[:, 1:-1].transpose(0, 2, 1).reshape(rows, -1)[:, : layout.cols]


class SheetArrays:
    """The arrays that both forms of kernel 1 have.

    Args:
        layout: of the sheet.
        stored: for every stored row of u, the row of the sheet that it holds, or -1 for none.
        start: what the arrays hold at the start.
    """

    def __init__(self, layout: SheetLayout, stored: NDArray[np.int32], start: Start) -> None:
        lanes, none = layout.code.lanes, np.zeros((0, layout.cols))
        self._layout = layout
        self._memory = Memory()
        self.u = [self.rows(len(stored)) for _ in range(3)]
        self.d = [self.rows(layout.rows) for _ in range(3)]
        self.numbers = self._memory.array(layout.code.precision, lanes, len(start.numbers))
        self.by_column = self.rows(len(start.by_column))
        self.fields = self.rows(max(1, len(start.fields)) * layout.rows)
        self.stiffness = self.rows(1 if start.stiffness is None else len(start.stiffness))
        real = np.float32 if layout.code.precision == "f32" else np.float64
        with np.errstate(over="ignore"):
            write_vectors(self.numbers, np.repeat(start.numbers[:, None].astype(real), lanes, axis=1))
        self._set(self.by_column, start.by_column)
        if start.stiffness is not None:
            self._set(self.stiffness, start.stiffness)
        state, held = start.state, (stored >= 0)[:, None]
        for c in range(3):
            self._set(self.u[c], none if state is None else np.where(held, state.displacement[stored, :, c], 0))
            self._set(self.d[c], none if state is None else state.difference[..., c])
        self._set(self.fields, start.fields)

    @property
    def all(self) -> tuple[Any, ...]:
        """All arrays, in the order in which kernels take them."""
        return *self.u, *self.d, self.numbers, self.by_column, self.stiffness, self.fields

    def get_fields(self, first: int, count: int) -> NDArray[Any]:
        """Read so many fields from the first one on, shape (count, rows, cols)."""
        layout = self._layout
        entries = self.fields.to_numpy()[first * layout.rows * layout.width :]
        values = out_of_lanes(layout, entries, count * layout.rows)
        return np.ascontiguousarray(values.reshape(count, layout.rows, layout.cols))

    def set_fields(self, first: int, values: NDArray[Any]) -> None:
        """Replace fields from the first one on, shape (fields, rows, cols); the others stay."""
        entries, laid = self.fields.to_numpy(), in_lanes(self._layout, values)
        at = first * self._layout.rows * self._layout.width
        entries[at : at + len(laid)] = laid
        self.fields.from_numpy(entries)

    def _set(self, array: Any, values: NDArray[Any]) -> None:
        """Set the first rows of an array to values, shape (..., cols), and the others to zero."""
        write_vectors(array, in_lanes(self._layout, values))

    def rows(self, count: int) -> Any:
        """Allocate an array of `count` rows; its content is arbitrary."""
        return self._memory.array(self._layout.code.precision, self._layout.code.lanes, count * self._layout.width)


class StepKernel(Protocol):
    """A form of kernel 1: the state of a sheet in the memory of a device."""

    arrays: SheetArrays

    def __init__(self, layout: SheetLayout, start: Start) -> None: ...

    def advance(self, count: int, table: NDArray[Any]) -> None:
        """Take a number of steps; table: of the loads, shape (count, columns)."""

    def compile(self, table: NDArray[Any]) -> None:
        """Compile everything that steps may need, without taking one."""

    def read(self, differences: bool, values: NDArray[Any], measures: NDArray[Any]) -> None:
        """Copy displacements or differences into values, shape (rows, cols, 3), and the measures of every row."""


def point_forces(code: StepCode) -> list[Callable[..., Any]]:
    """List the functions that add the forces of terms on points to those of springs."""
    # Terms that reach far come first. The last bits depend on the order.
    ordered = sorted(code.terms, key=lambda term: -term.reach)
    return [force for term in ordered for force in term.forces(code)]


def point_step(code: StepCode) -> Callable[..., None]:
    """Make the function that adds the forces of terms on points to those of springs, and steps.

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}                                  (eq. 6 to 9)
    """
    forces = point_forces(code)
    reducing = [reduce for term in code.terms for reduce in term.reducing(code)]

    @ti.func
    def move(sheet: ti.template(), entry: ti.template(), target, force: ti.template(), now: ti.template()):
        """Step an entry, and store it in row `target` of u; force: of springs; now: its row of the table of loads."""
        for add in ti.static(forces):
            add(force, sheet, entry, now)
        gain = now[GAIN] * sheet.by_column[(MOVES + entry.row.kind) * sheet.width + entry.b]
        at = entry.row.i * sheet.width + entry.b
        d = [sheet.d[c][at] for c in ti.static(range(3))]
        for reduce in ti.static(reducing):
            reduce(d, sheet)
        for c in ti.static(range(3)):
            d[c] += gain * force[c]
        for c in ti.static(range(3)):
            sheet.d[c][at] = d[c]
            sheet.u[c][target * sheet.width + entry.b] = entry.u[c] + d[c]

    return move


def measuring(code: StepCode) -> Callable[..., Any]:
    """Make the function that measures an entry: it adds motion, and what the terms measure, to a list of vectors."""
    vector, measuring_terms = code.vector, [measure for term in code.terms for measure in term.measuring(code)]

    @ti.func
    def measure(measures: ti.template(), sheet: ti.template(), p, i, b):
        """Measure entry b of row i of the sheet, stored in row p of u, and the row below it, the next one."""
        kind = ti.select(i == sheet.rows - 1, 2, ti.select(i == 0, 0, 1))
        motion = vector(0)
        for c in ti.static(range(3)):
            change = sheet.d[c][i * sheet.width + b]
            motion += change * change
        if ti.static(code.by_area):
            motion *= sheet.by_column[(AREA + kind) * sheet.width + b]
        measures[MOTION] += motion
        for measure_term in ti.static(measuring_terms):
            measure_term(measures, sheet, p, i, kind, b)

    return measure


def reading(code: StepCode, *, parallel: bool, iterations: int) -> Callable[..., None]:
    """Make the kernel that reads and measures a sheet, in a loop with so many iterations for each row."""
    real, vector, vectors, lanes, count = code.real, code.vector, code.vectors, code.lanes, code.first_number(None)
    measure, reductions = measuring(code), ["sum", *(how for term in code.terms for how in term.reductions)]

    @ti.kernel
    def read(
        first: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        differences: ti.i32,
        values: ti.types.ndarray(dtype=real, ndim=3),
        measures: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        numbers_of: ti.types.ndarray(dtype=vector, ndim=1),
        by_column: vectors, stiffness: vectors, fields: vectors,
    ):  # fmt: skip
        ti.loop_config(serialize=not parallel)
        for index in range(rows * iterations):
            if index % iterations == 0:
                i, strip = index // iterations, (cols + lanes - 1) // lanes
                # Entries of a row, and where u has it.
                width, p = strip + 2, first + i
                numbers = [numbers_of[n][0] for n in ti.static(range(count))]
                u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                sheet = ti.static(KernelSheet(u, d, by_column, stiffness, fields, numbers, rows, width))
                sums = [vector(0) for _ in ti.static(reductions)]
                for b in range(1, strip + 1):
                    measure(sums, sheet, p, i, b)
                    for c in ti.static(range(3)):
                        wanted = ti.select(differences, d[c][i * width + b], u[c][p * width + b])
                        for lane in ti.static(range(lanes)):
                            if lane * strip + b <= cols:
                                values[i, lane * strip + b - 1, c] = wanted[lane]
                for m, how in ti.static(enumerate(reductions)):
                    if ti.static(how == "min"):
                        measures[i, m] = sums[m].min()
                    elif ti.static(how == "max"):
                        measures[i, m] = sums[m].max()
                    else:
                        measures[i, m] = sums[m].sum()

    return read
