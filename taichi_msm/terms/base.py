"""Interface of a term of the model; compile-time configuration of kernels; sheet, row and entry within a kernel."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.arithmetic import Operations
from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Material
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.terms.places import Places

# Rows of the array `by_column`. The first two have three rows, for the first, inner and last rows of the sheet. With
# `KernelConfig.by_point` they are fields instead.
BY_COLUMN = Places(
    mobility=3,  # inverse share of a cell's mass, 0 if fixed
    area_share=3,  # share of a cell's area
    rest_x=1,  # x at rest [m]
    has_left=1,  # 1 with a neighbour on this side, else 0
    has_right=1,
)

# First constants, followed by those of the terms: dx, dy and y of the first row [m].
DX, DY, TOP_Y, GEOMETRY_COUNT = range(4)

# First column of the load table, followed by those of the terms: displacement per force [m/N].
GAIN, STEP_COLUMNS = range(2)

# First measure of a row, followed by those of the terms: sum of m |d|^2, with m relative to the mass of a cell.
SQUARED_MOTION, STEP_MEASURES = range(2)


class Term(ABC):
    """Term of the model: a frozen dataclass with its compile-time configuration, without coefficients.

    Kernels call springs and bending, which act between mass points, by name, and all other terms by this interface.
    """

    reach: ClassVar[int] = 0  # rows on either side that affect the force on a row
    reductions: ClassVar[tuple[str, ...]] = ()  # reduction of each measure over a row: "min", "max" or "sum"
    has_gradient: ClassVar[bool] = False  # whether `build_tangents` linearises its whole force
    key: ClassVar[str] = ""  # key of the scene, for messages of a term without a gradient

    @classmethod
    @abstractmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        """Return the configuration of the term for a plan; None if the scene does not have the term."""

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        """Derive attributes of `Material`, by name, from the term's keys of a scene."""
        return {}

    @staticmethod
    def stiffness_bound(material: Material, sheet: Sheet) -> float:
        """Return an upper bound of the term's part of m w^2 [N/m], where w is the angular frequency of any mode.

        Args:
            material: coefficients of the sheet.
            sheet: section `sheet` of the scene.
        """
        return 0.0

    @classmethod
    def node_stiffness_bounds(cls, material: Material, sheet: Sheet) -> NDArray[Any] | float:
        """Return an upper bound of the term's stiffness at each mass point [N/m], shape (rows, cols) or ().

        Args:
            material: coefficients of the sheet.
            sheet: section `sheet` of the scene.
        """
        return cls.stiffness_bound(material, sheet)

    def constants(self, plan: Plan) -> tuple[float, ...]:
        """Return the term's constants, in the order of `constant_places`."""
        return ()

    @property
    def constant_places(self) -> Places:
        """Names of the term's constants."""
        return Places()

    @property
    def column_places(self) -> Places:
        """Names of the term's columns of the load table."""
        return Places()

    @property
    def field_places(self) -> Places:
        """Names of the term's fields, arrays with a number per mass point; those in `memory` come last."""
        return Places()

    @property
    def measure_places(self) -> Places:
        """Names of the term's measures of a row."""
        return Places()

    @property
    def memory(self) -> tuple[str, ...]:
        """Names of the term's state variables at every mass point, in checkpoints."""
        return ()

    def has_history(self, plan: Plan) -> bool:
        """Return whether the term makes equilibria depend on earlier loads."""
        return bool(self.memory)

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        """Return the term's columns of the load table, shape (steps, columns).

        Args:
            plan: plan of the run.
            loads: loads at consecutive steps; at rest, at a frame.
            first: number of the first of these steps or frames.
        """
        return np.empty((len(loads.active), 0))

    def fields(self, plan: Plan) -> NDArray[Any]:
        """Return the initial values of the term's fields, shape (fields, rows, cols)."""
        return np.zeros((self.field_places.count, *plan.scene.sheet.points))

    def energy(self, sums: NDArray[Any], plan: Plan) -> float:
        """Return twice the term's energy [J].

        Args:
            sums: the term's measures, reduced over the sheet, shape (measures,).
            plan: plan of the run.
        """
        return 0.0

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Build Taichi functions add(force, sheet, entry, now), which add the term's force on an entry.

        Here `force` is a list of x, y and z, `sheet` a `KernelSheet`, `entry` an `Entry` and `now` a row of the load
        table as a list of variables.
        """
        return ()

    def build_tangents(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Build Taichi functions add(force, sheet, entry, now), which add the linearised change of the force.

        Here `entry.u` and `sheet.u` are changes of displacements, and `entry.displacement` is the displacement.
        """
        return ()

    def build_damping(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Build Taichi functions reduce(d, sheet), which damp the last difference d of an entry, a list of 3."""
        return ()

    def build_correction(self, config: KernelConfig) -> Correction | None:
        """Build the functions that correct displacements after a step; None if the term corrects nothing."""
        return None

    def build_rest_correction(self, config: KernelConfig) -> RestCorrection | None:
        """Build the functions that correct forces and displacements at rest; None if the term corrects nothing."""
        return None

    def supports(self, compiled: Self) -> str:
        """Return why kernels compiled for another configuration of the term cannot run this one; empty if they can."""
        return ""

    def mark_update(self, columns: NDArray[Any]) -> bool:
        """Request the update of the memory in the next evaluation of the forces, after a frame reached equilibrium.

        Args:
            columns: the term's columns of a row of the load table, in and out.

        Returns:
            Whether the term has such an update.
        """
        return False

    def build_measures(self, config: KernelConfig) -> Sequence[Callable[..., None]]:
        """Build Taichi functions measure(measures, sheet, p, i, kind, b) of entry b of row i, which is row p of u."""
        return ()


class Correction(NamedTuple):
    """Taichi functions that correct the displacements of a row after its step; `now` is a row of the load table.

    Attributes:
        reaches: reaches(sheet, i, low, high, now) returns whether row i may need a correction; `low` and `high` bound
            its displacements along y and z, on a curved sheet its positions, two numbers each.
        resolve: resolve(sheet, i, kind, at, b, now) corrects entry b of row i, row `at` of u.
    """

    reaches: Callable[..., Any]
    resolve: Callable[..., None]


class RestCorrection(NamedTuple):
    """Taichi functions that correct a sheet in quasi-static equilibrium.

    Attributes:
        remove: remove(force, sheet, at) subtracts the part that the term carries from the force on entry `at`.
        project: project(sheet, i, kind, b, now) corrects entry b of row i after it moved.
    """

    remove: Callable[..., None]
    project: Callable[..., None]


AnyTerm = TypeVar("AnyTerm", bound=Term)


@dataclass(frozen=True)
class KernelConfig:
    """Compile-time configuration of the kernels of a sheet; everything else is an argument of a kernel."""

    precision: str  # f32 or f64
    lanes: int  # number of lanes of a vector, one for each strip of columns
    by_area: bool  # whether the masses of mass points are proportional to their areas, which vary
    by_point: bool  # whether mobility and area are fields, one number per mass point, instead of numbers per column
    curved: bool  # whether the rest positions are fields
    terms: tuple[Term, ...]  # terms of the scene in the order of `terms.TERMS`, always with springs and probes

    @property
    def reach(self) -> int:
        """Number of rows on either side of a band on which its steps depend."""
        return max(term.reach for term in self.terms)

    @property
    def ti(self) -> Any:
        """The module of Taichi, imported lazily, because `check` needs the terms without a compiler."""
        from taichi_msm.system.runtime import ti

        return ti

    @property
    def real(self) -> Any:
        """Taichi type of a number."""
        return getattr(self.ti, self.precision)

    @property
    def vector(self) -> Any:
        """Taichi type of a vector of lanes."""
        return self.ti.types.vector(self.lanes, self.real)

    @property
    def vectors(self) -> Any:
        """Taichi type of an array of vectors."""
        return self.ti.types.ndarray(dtype=self.vector, ndim=1)

    @property
    def operations(self) -> Operations:
        """The operations of kernels, imported lazily as `ti`."""
        from taichi_msm.system.kernel_operations import KERNEL

        return KERNEL

    def get(self, kind: type[AnyTerm]) -> AnyTerm | None:
        """Return the term of a class; None if the scene does not have it."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def require(self, kind: type[AnyTerm]) -> AnyTerm:
        """Return the term of a class; every scene has it."""
        term = self.get(kind)
        assert term is not None, kind
        return term

    def constants(self, kind: type[Term] | None = None) -> Places:
        """Return the constants of a term; by default of no term, after all others."""
        return self._places(kind, GEOMETRY_COUNT, lambda term: term.constant_places)

    def columns(self, kind: type[Term] | None = None) -> Places:
        """Return the columns of a term in the load table; by default of no term, after all others."""
        return self._places(kind, STEP_COLUMNS, lambda term: term.column_places)

    def fields(self, kind: type[Term] | None = None) -> Places:
        """Return the fields of a term; by default of no term, after all others."""
        return self._places(kind, self.point_fields.count, lambda term: term.field_places)

    def measures(self, kind: type[Term] | None = None) -> Places:
        """Return the measures of a term; by default of no term, after all others."""
        return self._places(kind, STEP_MEASURES, lambda term: term.measure_places)

    def memory(self, kind: type[Term]) -> Places:
        """Return the part of `State.memory` that belongs to a term."""
        return self._places(kind, 0, lambda term: Places(names=len(term.memory)))

    @property
    def point_fields(self) -> Places:
        """The first fields, followed by those of the terms; x, y and z at rest [m] of a curved sheet.

        The area of a point follows from its mobility where masses are proportional to areas.
        """
        return Places(
            mobility=int(self.by_point), area_share=int(self.by_point and not self.by_area), rest=3 * self.curved
        )

    @property
    def memory_fields(self) -> list[int]:
        """Indices of the fields that steps change, in the order of `State.memory`."""
        ends = [self.fields(type(term)).end for term in self.terms]
        return [n for term, end in zip(self.terms, ends, strict=True) for n in range(end - len(term.memory), end)]

    def _places(self, kind: type[Term] | None, first: int, places_of: Callable[[Term], Places]) -> Places:
        """Return the places of a term, from `first` on after those of the terms before it; none without the term."""
        for term in self.terms:
            places = places_of(term).at(first)
            if type(term) is kind:
                return places
            first = places.end
        return Places(first)


def build_max_lane(config: KernelConfig) -> Callable[..., Any]:
    """Build the Taichi function max_lane(values), the maximum over lanes, with shuffles instead of Taichi's `max()`."""
    ti, vector, lanes = config.ti, config.vector, config.lanes
    halves = [lanes >> n for n in range(1, lanes.bit_length())]

    @ti.func
    def max_lane(values):
        largest = values + vector(0)
        for half in ti.static(halves):
            largest = ti.max(largest, vector([largest[(lane + half) % lanes] for lane in ti.static(range(lanes))]))
        return largest[0]

    return max_lane


class KernelSheet(NamedTuple):
    """A sheet within a kernel; `solver.arrays` describes the arrays."""

    u: Any  # displacements [m], with bending also moments, as three arrays for x, y and z
    d: Any  # last differences [m], as three arrays
    by_column: Any
    fields: Any
    constants: Any  # of the sheet and its terms, as a list of variables
    rows: Any  # number of rows
    width: Any  # number of entries of a row


class KernelRow(NamedTuple):
    """A row of the sheet within a kernel."""

    i: Any  # index of the row
    kind: Any  # 0 for the first row of the sheet, 2 for the last, 1 for all others
    before: Any  # with bending, row of u with the moments of the previous row
    at: Any  # with bending, row of u with the moments of row i
    after: Any  # with bending, row of u with the moments of the next row


class RowPair(NamedTuple):
    """A row and the next row of a pass within a kernel."""

    i: Any  # index of the row
    kind: Any  # as in `KernelRow`
    other: Any  # index of the next row
    upper: Any  # index of the upper of the two
    up: Any  # y of the next row minus y of the row, on a flat sheet at rest [m]
    diagonal: Any  # length of the diagonals of a cell, on a flat sheet at rest [m]


class Entry(NamedTuple):
    """An entry of a row within a kernel: one mass point in each lane."""

    row: KernelRow
    b: Any  # index of the entry in its row
    u: Any  # displacement, a list of x, y and z; for tangents its change
    displacement: Any = None  # for tangents only
