"""The arrays of a sheet and the functions shared by the CPU and the GPU kernel: step, measures and read-out.

The values of a sheet are vectors of lanes. The columns are divided into strips, one per lane; on a GPU a vector has one
lane. The values are stored row by row in ndarrays of Taichi. A row has `width` entries: one for every column of a
strip, and a halo of one entry at both ends. One-dimensional arrays save a few instructions per index:

    u, d         displacements and last differences [m], as three arrays each, for x, y and z
    by_column    for the first, a middle and the last row: the inverse of the mass points' share of a cell's mass, 0 if
                 fixed; and their share of a cell's area. For all rows: x at rest [m]; 1 with a left neighbour, else 0;
                 1 with a right neighbour, else 0
    fields       one number per mass point, for every field of every term in turn
    stiffness    with a map, k - tau of every spring, see `SpringTerm.stiffness_array`
    constants    of the sheet and its terms, each in the first lane of an entry

With bending, u also contains rows of moments. The load table contains the variables of the steps, one row per step.

The kernels use vectors down to the machine code (docs/decisions/0010). Some operations of Taichi crash or return wrong
results for such vectors. Unary minus, `-=`, abs, any and all are therefore not used, and exp is applied lane by lane.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.state import State
from taichi_msm.system.runtime import Memory, compilation_options, ti, write_vectors
from taichi_msm.terms.base import AREA_SHARE, GAIN, MOBILITY, SQUARED_MOTION, KernelConfig, KernelSheet

NUMBER_BYTES = {"f32": 4, "f64": 8}


@dataclass(frozen=True)
class SheetLayout:
    """The memory layout of a sheet, its division among workers, and the configuration of its kernels."""

    rows: int  # number of rows of mass points
    cols: int  # number of columns of mass points
    workers: int  # number of bands of rows, which are stepped in parallel; 0 on a GPU
    depth: int  # number of steps that a band takes in one pass
    fixed_rows: tuple[bool, bool]  # whether all mass points of the first and of the last row are fixed
    config: KernelConfig

    @property
    def strip(self) -> int:
        """Number of columns of a strip."""
        return -(-self.cols // self.config.lanes)

    @property
    def width(self) -> int:
        """Number of entries in a row, including the halo of its strips."""
        return self.strip + 2


class InitialData(NamedTuple):
    """Initial values of the arrays of a sheet."""

    constants: NDArray[Any]  # of the sheet and its terms, shape (constants,)
    by_column: NDArray[Any]  # shape (COLUMN_ROWS, cols)
    fields: NDArray[Any]  # of the terms, shape (fields, rows, cols)
    stiffness: NDArray[Any] | None  # of all springs, shape (3 rows + 2, cols); None without a map
    state: State | None  # state to continue from; None for the sheet at rest


def to_lanes(layout: SheetLayout, values: NDArray[Any]) -> NDArray[Any]:
    """Arrange values in lanes with halo, in the precision of the kernels.

    Args:
        layout: layout of the sheet.
        values: values by column, shape (..., cols); those too large for the precision become infinite.

    Returns:
        Entries, shape (entries, lanes), with `layout.width` entries per row; 0 in entries without a column.
    """
    column = np.arange(layout.config.lanes) * layout.strip + np.arange(-1, layout.strip + 1)[:, None]
    inside = (column >= 0) & (column < layout.cols)
    real = np.float32 if layout.config.precision == "f32" else np.float64
    with np.errstate(over="ignore"):
        laid = np.take(values.astype(real), column * inside, axis=-1) * inside.astype(real)
    return laid.reshape(-1, layout.config.lanes)


def from_lanes(layout: SheetLayout, entries: NDArray[Any], rows: int) -> NDArray[Any]:
    """Arrange entries by column, the inverse of `to_lanes`.

    Args:
        layout: layout of the sheet.
        entries: entries with halo, shape (entries, lanes), at least `rows` rows of them.
        rows: number of rows.

    Returns:
        Values, shape (rows, cols).
    """
    laid = entries[: rows * layout.width].reshape(rows, layout.width, layout.config.lanes)
    return laid[:, 1:-1].transpose(0, 2, 1).reshape(rows, -1)[:, : layout.cols]


class SheetArrays:
    """The arrays of a sheet in the memory of a device.

    Args:
        layout: layout of the sheet.
        stored: row of the sheet in each row of the array u, or -1 for other content, shape (rows of u,).
        start: initial values.
    """

    def __init__(self, layout: SheetLayout, stored: NDArray[np.int32], start: InitialData) -> None:
        lanes, no_values = layout.config.lanes, np.zeros((0, layout.cols))
        self._layout = layout
        self._memory = Memory()
        self.u = [self.rows(len(stored)) for _ in range(3)]
        self.d = [self.rows(layout.rows) for _ in range(3)]
        self.constants = self._memory.array(layout.config.precision, lanes, len(start.constants))
        self.by_column = self.rows(len(start.by_column))
        self.fields = self.rows(max(1, len(start.fields)) * layout.rows)
        self.stiffness = self.rows(1 if start.stiffness is None else len(start.stiffness))
        real = np.float32 if layout.config.precision == "f32" else np.float64
        with np.errstate(over="ignore"):
            write_vectors(self.constants, np.repeat(start.constants[:, None].astype(real), lanes, axis=1))
        self._set(self.by_column, start.by_column)
        if start.stiffness is not None:
            self._set(self.stiffness, start.stiffness)
        state, held = start.state, (stored >= 0)[:, None]
        for c in range(3):
            self._set(self.u[c], no_values if state is None else np.where(held, state.displacement[stored, :, c], 0))
            self._set(self.d[c], no_values if state is None else state.difference[..., c])
        self._set(self.fields, start.fields)

    @property
    def all(self) -> tuple[Any, ...]:
        """All arrays, in the order of the kernels' arguments."""
        return *self.u, *self.d, self.constants, self.by_column, self.stiffness, self.fields

    def get_fields(self, first: int, count: int) -> NDArray[Any]:
        """Read consecutive fields of the terms.

        Args:
            first: index of the first field.
            count: number of fields.

        Returns:
            Fields, shape (count, rows, cols).
        """
        layout = self._layout
        entries = self.fields.to_numpy()[first * layout.rows * layout.width :]
        values = from_lanes(layout, entries, count * layout.rows)
        return np.ascontiguousarray(values.reshape(count, layout.rows, layout.cols))

    def set_fields(self, first: int, values: NDArray[Any]) -> None:
        """Replace consecutive fields of the terms.

        Args:
            first: index of the first field.
            values: new values, shape (fields, rows, cols).
        """
        entries, laid = self.fields.to_numpy(), to_lanes(self._layout, values)
        at = first * self._layout.rows * self._layout.width
        entries[at : at + len(laid)] = laid
        self.fields.from_numpy(entries)

    def _set(self, array: Any, values: NDArray[Any]) -> None:
        """Set the first rows of an array to values of shape (..., cols), and all other rows to 0."""
        write_vectors(array, to_lanes(self._layout, values))

    def rows(self, count: int) -> Any:
        """Allocate an array of `count` rows with arbitrary content."""
        return self._memory.array(self._layout.config.precision, self._layout.config.lanes, count * self._layout.width)


class SheetKernel:
    """A sheet in the memory of a device, with the kernel that reads it."""

    arrays: SheetArrays
    _layout: SheetLayout
    _read: Callable[..., None]  # built by `build_read`
    _top_row = 0  # row of u that contains the first row of the sheet

    def read(self, differences: bool, values: NDArray[Any], measures: NDArray[Any]) -> None:
        """Read displacements or last differences (at rest, forces), and measure every row.

        Args:
            differences: whether to read last differences instead of displacements.
            values: output [m], at rest of forces [N], shape (rows, cols, 3).
            measures: output, shape (rows, measures).
        """
        layout = self._layout
        with compilation_options():
            self._read(self._top_row, layout.rows, layout.cols, differences, values, measures, *self.arrays.all)


class StepKernel(SheetKernel, ABC):
    """A sheet in the memory of a device, with the kernels that step and read it."""

    @abstractmethod
    def advance(self, count: int, table: NDArray[Any]) -> None:
        """Advance the sheet.

        Args:
            count: number of steps.
            table: rows of the load table for these steps, shape (count, columns).
        """

    @abstractmethod
    def compile(self, table: NDArray[Any]) -> None:
        """Compile all kernels without taking a step."""


def point_forces(config: KernelConfig) -> list[Callable[..., Any]]:
    """Build the Taichi functions that add the forces of all terms except springs."""
    # The order of summation determines the last bits.
    ordered = sorted(config.terms, key=lambda term: -term.reach)
    return [force for term in ordered for force in term.build_forces(config)]


def build_point_step(config: KernelConfig) -> Callable[..., None]:
    """Build the Taichi function that adds the forces of all other terms to those of springs, and steps an entry.

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}                                  (eq. 6 to 9)
    """
    forces = point_forces(config)
    damping = [reduce for term in config.terms for reduce in term.build_damping(config)]

    @ti.func
    def move(sheet: ti.template(), entry: ti.template(), target, force: ti.template(), now: ti.template()):
        """Step an entry and store it in row `target` of u; `force` is that of its springs, `now` a row of loads."""
        for add in ti.static(forces):
            add(force, sheet, entry, now)
        gain = now[GAIN] * sheet.by_column[(MOBILITY + entry.row.kind) * sheet.width + entry.b]
        at = entry.row.i * sheet.width + entry.b
        d = [sheet.d[c][at] for c in ti.static(range(3))]
        for reduce in ti.static(damping):
            reduce(d, sheet)
        for c in ti.static(range(3)):
            d[c] += gain * force[c]
        for c in ti.static(range(3)):
            sheet.d[c][at] = d[c]
            sheet.u[c][target * sheet.width + entry.b] = entry.u[c] + d[c]

    return move


@cache
def build_read(config: KernelConfig, *, parallel: bool, iterations: int) -> Callable[..., None]:
    """Build the kernel that reads and measures a sheet.

    Args:
        config: compile-time configuration.
        parallel: whether to distribute the rows over threads.
        iterations: number of loop iterations per row; only the first of them does work.

    Returns:
        The kernel `read`, see `SheetKernel.read`.
    """
    real, vector, vectors, lanes = config.real, config.vector, config.vectors, config.lanes
    count = config.first_constant(None)
    measuring = [measure for term in config.terms for measure in term.build_measures(config)]
    reductions = ["sum", *(reduction for term in config.terms for reduction in term.reductions)]

    @ti.kernel
    def read(
        first: ti.i32, rows: ti.i32, cols: ti.i32, differences: ti.i32,
        values: ti.types.ndarray(dtype=real, ndim=3), measures: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1), by_column: vectors, stiffness: vectors, fields: vectors,
    ):  # fmt: skip
        """Read and measure a sheet.

        Args:
            first: row of u that contains the first row of the sheet.
            rows: number of rows of the sheet.
            cols: number of columns of the sheet.
            differences: whether to read d instead of u.
            values: output [m], shape (rows, cols, 3).
            measures: output, shape (rows, measures).
            u_x, u_y, u_z, d_x, d_y, d_z, constants_of, by_column, stiffness, fields: `SheetArrays.all`.
        """
        ti.loop_config(serialize=not parallel)
        for index in range(rows * iterations):
            if index % iterations == 0:
                i, strip = index // iterations, (cols + lanes - 1) // lanes
                width, p = strip + 2, first + i
                constants = [constants_of[n][0] for n in ti.static(range(count))]
                u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                sheet = ti.static(KernelSheet(u, d, by_column, stiffness, fields, constants, rows, width))
                kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
                sums = [vector(0) for _ in ti.static(reductions)]
                for b in range(1, strip + 1):
                    motion = vector(0)
                    for c in ti.static(range(3)):
                        change = d[c][i * width + b]
                        motion += change * change
                    if ti.static(config.by_area):
                        motion *= sheet.by_column[(AREA_SHARE + kind) * width + b]
                    sums[SQUARED_MOTION] += motion
                    for measure in ti.static(measuring):
                        measure(sums, sheet, p, i, kind, b)
                    for c in ti.static(range(3)):
                        value = ti.select(differences, d[c][i * width + b], u[c][p * width + b])
                        for lane in ti.static(range(lanes)):
                            if lane * strip + b <= cols:
                                values[i, lane * strip + b - 1, c] = value[lane]
                for m, reduction in ti.static(enumerate(reductions)):
                    if ti.static(reduction == "min"):
                        measures[i, m] = sums[m].min()
                    elif ti.static(reduction == "max"):
                        measures[i, m] = sums[m].max()
                    else:
                        measures[i, m] = sums[m].sum()

    return read
