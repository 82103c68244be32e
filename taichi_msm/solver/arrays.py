"""The arrays of a sheet and the functions shared by the CPU and the GPU kernel: step, measures and read-out.

The columns of the sheet are divided into strips of equal width, one per lane of a vector; on a GPU a vector has one
lane. An entry is a vector with one mass point of each strip. A row has `width` entries: one per column of a strip, and
a halo of one entry at both ends. The rows are stored one after another in one-dimensional ndarrays of Taichi, which
take fewer instructions per index:

    u, d         displacements and last differences [m], as three arrays each, for x, y and z
    by_column    numbers per column, in the rows `terms.base.BY_COLUMN`
    fields       numbers per mass point, all rows of one field after those of another: mobility and area share unless
                 `by_column` has them, the rest position of a curved sheet, and the fields of the terms
    constants    of the sheet and its terms, each in the first lane of an entry

With bending, u also contains rows of moments. The load table has one row per step: its gain and the columns of the
terms, such as the force of a tool.

The compiler does not split these vectors into scalars (docs/decisions/0010). Some operations of Taichi then crash or
return wrong results, so the kernels avoid unary minus, `-=`, abs, any and all, and apply exp lane by lane.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.time_grid import DTYPES
from taichi_msm.solver.state import State
from taichi_msm.system.runtime import Memory, compilation_options, ti, write_vectors
from taichi_msm.terms.base import GAIN, SQUARED_MOTION, KernelConfig, KernelSheet
from taichi_msm.terms.points import build_point_functions


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
    fields: NDArray[Any]  # shape (fields, rows, cols)
    state: State | None  # state to continue from; None for the sheet at rest


def to_lanes(layout: SheetLayout, values: NDArray[Any], *, continued: bool = False) -> NDArray[Any]:
    """Arrange values by column, shape (..., cols), in lanes with halo, in the precision of the kernels.

    The result has the shape (entries, lanes), with `layout.width` entries per row, and in entries without a column 0,
    or if `continued` the value of the last column. Values too large for the precision become infinite.
    """
    column = np.arange(layout.config.lanes) * layout.strip + np.arange(-1, layout.strip + 1)[:, None]
    inside = (column >= 0) & (column < layout.cols)
    dtype = DTYPES[layout.config.precision]
    if continued:
        column, inside = np.clip(column, 0, layout.cols - 1), np.ones_like(inside)
    with np.errstate(over="ignore"):
        entries = np.take(values.astype(dtype), column * inside, axis=-1) * inside.astype(dtype)
    return entries.reshape(-1, layout.config.lanes)


def from_lanes(layout: SheetLayout, entries: NDArray[Any], rows: int) -> NDArray[Any]:
    """Return the values of entries by column, shape (rows, cols), the inverse of `to_lanes`."""
    by_row = entries[: rows * layout.width].reshape(rows, layout.width, layout.config.lanes)
    return by_row[:, 1:-1].transpose(0, 2, 1).reshape(rows, -1)[:, : layout.cols]


class SheetArrays:
    """The arrays of a sheet in the memory of a device.

    `sheet_rows` has the row of the sheet in each row of u, -1 for other content, shape (rows of u,).
    """

    def __init__(self, layout: SheetLayout, sheet_rows: NDArray[np.int32], start: InitialData) -> None:
        lanes = layout.config.lanes
        self._layout, self._sheet_rows = layout, sheet_rows
        self._memory = Memory()
        self.u = [self.allocate_rows(len(sheet_rows)) for _ in range(3)]
        self.d = [self.allocate_rows(layout.rows) for _ in range(3)]
        self.constants = self._memory.array(layout.config.precision, lanes, len(start.constants))
        self.by_column = self.allocate_rows(len(start.by_column))
        self.fields = self.allocate_rows(max(1, len(start.fields)) * layout.rows)
        with np.errstate(over="ignore"):
            write_vectors(self.constants, np.repeat(start.constants[:, None], lanes, axis=1))
        self._set(self.by_column, start.by_column)
        if start.state is None:
            for array in (*self.u, *self.d):
                self._set(array, np.zeros((0, layout.cols)))
        else:
            self.set_displacement(start.state.displacement)
            for c in range(3):
                self._set(self.d[c], start.state.difference[..., c])
        entries, rest = to_lanes(layout, start.fields), layout.config.point_fields.rest
        # Entries without a mass point must not extend the box of a row.
        at = rest.start * layout.rows * layout.width
        continued = to_lanes(layout, start.fields[rest.start : rest.stop], continued=True)
        entries[at : at + len(continued)] = continued
        write_vectors(self.fields, entries)

    @property
    def all(self) -> tuple[Any, ...]:
        """All arrays, in the order of the kernels' arguments."""
        return *self.u, *self.d, self.constants, self.by_column, self.fields

    def set_displacement(self, displacement: NDArray[Any]) -> None:
        """Set the displacements [m], shape (rows, cols, 3), and all other content of u to 0."""
        has_row = (self._sheet_rows >= 0)[:, None]
        for c in range(3):
            self._set(self.u[c], np.where(has_row, displacement[self._sheet_rows, :, c], 0))

    def get_field(self, index: int) -> NDArray[Any]:
        """Read a field of a term, shape (rows, cols)."""
        layout = self._layout
        return from_lanes(layout, self.fields.to_numpy()[index * layout.rows * layout.width :], layout.rows)

    def set_fields(self, first: int, values: NDArray[Any]) -> None:
        """Replace consecutive fields of the terms, from the index `first` on; values: shape (fields, rows, cols)."""
        entries, new = self.fields.to_numpy(), to_lanes(self._layout, values)
        at = first * self._layout.rows * self._layout.width
        entries[at : at + len(new)] = new
        self.fields.from_numpy(entries)

    def _set(self, array: Any, values: NDArray[Any]) -> None:
        """Set the first rows of an array to values of shape (..., cols), and all other rows to 0."""
        write_vectors(array, to_lanes(self._layout, values))

    def allocate_rows(self, count: int) -> Any:
        """Allocate an array of `count` rows with arbitrary content."""
        return self._memory.array(self._layout.config.precision, self._layout.config.lanes, count * self._layout.width)


class SheetKernel:
    """A sheet in the memory of a device, with the kernel that reads it."""

    arrays: SheetArrays
    _layout: SheetLayout
    _read: Callable[..., None]  # built by `build_read`
    _top_row = 0  # row of u that contains the first row of the sheet

    def read(self, differences: bool, values: NDArray[Any], measures: NDArray[Any]) -> None:
        """Read displacements [m] or `differences`, at rest forces [N], into `values`, shape (rows, cols, 3).

        `measures`, shape (rows, measures), receives the measures of every row.
        """
        layout = self._layout
        with compilation_options():
            self._read(self._top_row, layout.rows, layout.cols, differences, values, measures, *self.arrays.all)


class StepKernel(SheetKernel, ABC):
    """A sheet in the memory of a device, with the kernels that step and read it."""

    @abstractmethod
    def advance(self, count: int, table: NDArray[Any]) -> None:
        """Advance the sheet by `count` steps, with their rows of the load table, shape (count, columns)."""

    @abstractmethod
    def compile(self, table: NDArray[Any]) -> None:
        """Compile all kernels without taking a step."""


def build_point_forces(config: KernelConfig) -> list[Callable[..., Any]]:
    """Build the Taichi functions that add the forces of all terms except springs."""
    # Bending, with the largest reach, comes first: the order of summation determines the last bits.
    ordered = sorted(config.terms, key=lambda term: -term.reach)
    return [force for term in ordered for force in term.build_forces(config)]


def build_point_step(config: KernelConfig) -> Callable[..., None]:
    """Build the Taichi function that adds the forces of all other terms to those of springs, and steps an entry.

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}                                  (eq. 6 to 9)
    """
    forces, mobility = build_point_forces(config), build_point_functions(config).mobility
    damping = [reduce for term in config.terms for reduce in term.build_damping(config)]

    @ti.func
    def move(sheet: ti.template(), entry: ti.template(), target, force: ti.template(), now: ti.template()):
        """Step an entry with the force of its springs and a row of the load table, `now`, into row `target` of u."""
        for add in ti.static(forces):
            add(force, sheet, entry, now)
        gain = now[GAIN] * mobility(sheet, entry.row.i, entry.row.kind, entry.b)
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
    """Build the kernel of `SheetKernel.read`, which distributes the rows over threads if `parallel`.

    Of the `iterations` of the loop per row, the first does the work: ITERATIONS_PER_THREAD for one row per CPU thread.
    """
    real, vector, vectors, lanes = config.real, config.vector, config.vectors, config.lanes
    count, area_share = config.constants().end, build_point_functions(config).area_share
    measuring = [measure for term in config.terms for measure in term.build_measures(config)]
    reductions = ["sum", *(reduction for term in config.terms for reduction in term.reductions)]

    @ti.kernel
    def read(
        first: ti.i32, rows: ti.i32, cols: ti.i32, differences: ti.i32,
        values: ti.types.ndarray(dtype=real, ndim=3), measures: ti.types.ndarray(dtype=real, ndim=2),
        u_x: vectors, u_y: vectors, u_z: vectors,
        d_x: vectors, d_y: vectors, d_z: vectors,
        constants_of: ti.types.ndarray(dtype=vector, ndim=1), by_column: vectors, fields: vectors,
    ):  # fmt: skip
        """Read and measure a sheet, whose first row is row `first` of u, see `SheetKernel.read`."""
        ti.loop_config(serialize=not parallel)
        for index in range(rows * iterations):
            if index % iterations == 0:
                i, strip = index // iterations, (cols + lanes - 1) // lanes
                width, p = strip + 2, first + i
                constants = [constants_of[n][0] for n in ti.static(range(count))]
                u, d = ti.static((u_x, u_y, u_z), (d_x, d_y, d_z))
                sheet = ti.static(KernelSheet(u, d, by_column, fields, constants, rows, width))
                kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
                sums = [vector(0) for _ in ti.static(reductions)]
                for b in range(1, strip + 1):
                    motion = vector(0)
                    for c in ti.static(range(3)):
                        change = d[c][i * width + b]
                        motion += change * change
                    if ti.static(config.by_area):
                        motion *= area_share(sheet, i, kind, b)
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
