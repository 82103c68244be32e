"""What a term of the model is, and what a kernel tells a term's functions about a sheet."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Material
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet

# Rows of the array by_column. MOVES and AREA have three each, for a first, a middle and a last row of the sheet.
MOBILITY, AREA_SHARE, REST_X, HAS_LEFT, HAS_RIGHT, COLUMN_ROWS = 0, 3, 6, 7, 8, 9

# The first numbers of a sheet: dx, dy, and y of the first row. Those of its terms follow.
DX, DY, TOP_Y, GEOMETRY = range(4)

# The first column of the table of loads: what a force of 1 N adds to the last difference [m]. Those of terms follow.
GAIN, STEP_COLUMNS = 0, 1

# The first measure of a row: the sum of |d|^2 times the share of mass. Those of terms follow.
SQUARED_MOTION, STEP_MEASURES = 0, 1


class Term(ABC):
    """A term of the model as kernels are compiled for it: a frozen dataclass, without the numbers of a sheet.

    The kernels know by name the terms that act between points, springs and bending; others need only the functions
    here.
    """

    reach: ClassVar[int] = 0  # how many rows away a point may be that the force depends on
    constant_count: ClassVar[int] = 0  # how many of the sheet's numbers belong to the term
    reductions: ClassVar[tuple[str, ...]] = ()  # how each of its measures becomes one of a row: "min", "max" or "sum"

    @classmethod
    @abstractmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        """Choose what is compiled for a scene; None if it does not have the term."""

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        """Derive the attributes of `Material` that the term's keys of a scene stand for."""
        return {}

    @staticmethod
    def stiffness_bound(material: Material, sheet: Sheet) -> float:
        """Bound the part of m w^2 that the term has in any motion [N/m]."""
        return 0.0

    @classmethod
    def node_stiffness_bounds(cls, plan: Plan) -> NDArray[Any] | float:
        """Bound the stiffness that each point feels, as `bound` does; shape (rows, cols), or one for all [N/m]."""
        return cls.stiffness_bound(plan.material, plan.scene.sheet)

    def constants(self, plan: Plan) -> tuple[float, ...]:
        """Give its numbers."""
        return ()

    @property
    def column_count(self) -> int:
        """How many columns of the table of loads belong to the term."""
        return 0

    @property
    def field_count(self) -> int:
        """How many fields belong to the term."""
        return 0

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        """Give its columns of the table of loads, from step `first` on, shape (steps, column_count)."""
        return np.empty((len(loads.active), 0))

    def fields(self, plan: Plan) -> NDArray[Any]:
        """Give its fields at the start, a number for every point each, shape (field_count, rows, cols)."""
        return np.empty((0, *plan.scene.sheet.points))

    def energy(self, sums: NDArray[Any], plan: Plan) -> float:
        """Give twice its energy [J], from its measures summed up."""
        return 0.0

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Make Taichi's functions add(force, sheet, entry, now) that add to the force on a point, a list of x, y and z.

        `now` is the row of the table of loads, a list of variables.
        """
        return ()

    def build_tangents(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Make Taichi's functions add(force, sheet, entry, now) that add the change of the force on a point.

        Entry and sheet hold the change of the displacements in the place of displacements.
        """
        return ()

    def build_damping(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Make Taichi's functions reduce(d, sheet) that change the last difference of a point, a list of x, y and z."""
        return ()

    def build_measures(self, config: KernelConfig) -> Sequence[Callable[..., None]]:
        """Make Taichi's functions measure(measures, sheet, p, i, kind, b) for entry b of row i, which is row p of u."""
        return ()


AnyTerm = TypeVar("AnyTerm", bound=Term)


@dataclass(frozen=True)
class KernelConfig:
    """What the kernels of a sheet are compiled for; everything else is an argument."""

    precision: str  # f32 or f64
    lanes: int  # of a vector; columns are cut into as many strips
    by_area: bool  # whether points at an open edge have less mass than others, because they belong to fewer cells
    terms: tuple[Term, ...]  # those that the scene has, always with springs and probes; in the order of `terms.TERMS`

    @property
    def reach(self) -> int:
        """How many rows on either side of a band its steps depend on."""
        return max(term.reach for term in self.terms)

    @property
    def ti(self) -> Any:
        """Taichi; terms import it only here, because `check` needs their bounds without a compiler."""
        from taichi_msm.system.runtime import ti

        return ti

    @property
    def real(self) -> Any:
        """Taichi's type of a number."""
        return getattr(self.ti, self.precision)

    @property
    def vector(self) -> Any:
        """Taichi's type of a vector of lanes."""
        return self.ti.types.vector(self.lanes, self.real)

    @property
    def vectors(self) -> Any:
        """Taichi's type of an array of vectors."""
        return self.ti.types.ndarray(dtype=self.vector, ndim=1)

    def get(self, kind: type[AnyTerm]) -> AnyTerm | None:
        """Give the term of a kind; None if there is none."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def require(self, kind: type[AnyTerm]) -> AnyTerm:
        """Give the term of a kind that every scene has."""
        term = self.get(kind)
        assert term is not None, kind
        return term

    def first_constant(self, kind: type[Term] | None) -> int:
        """Give the index of the first number of a term; None: how many numbers there are."""
        return GEOMETRY + sum(term.constant_count for term in self._before(kind))

    def first_column(self, kind: type[Term] | None) -> int:
        """Give the first column of a term in the table of loads; None: how many columns there are."""
        return STEP_COLUMNS + sum(term.column_count for term in self._before(kind))

    def first_field(self, kind: type[Term] | None) -> int:
        """Give the index of the first field of a term; None: how many fields there are."""
        return sum(term.field_count for term in self._before(kind))

    def first_measure(self, kind: type[Term] | None) -> int:
        """Give the index of the first measure of a term; None: how many measures there are."""
        return STEP_MEASURES + sum(len(term.reductions) for term in self._before(kind))

    def _before(self, kind: type[Term] | None) -> tuple[Term, ...]:
        kinds = [type(term) for term in self.terms]
        return self.terms if kind is None else self.terms[: kinds.index(kind)]


class KernelSheet(NamedTuple):
    """A sheet within a kernel; its arrays are those of `kernel`."""

    # u, d: displacements, with bending also moments, and last differences; three arrays each, for x, y and z
    u: Any
    d: Any
    # by_column, stiffness, fields: one array each
    by_column: Any
    stiffness: Any
    fields: Any
    constants: Any  # of the sheet and of its terms, a list of variables
    rows: Any  # of points
    width: Any  # entries of a row


class KernelRow(NamedTuple):
    """A row of the sheet within a kernel."""

    i: Any  # its number
    kind: Any  # 0 for the first row of the sheet, 2 for the last, else 1
    # before, at, after: with bending, rows of u with the moments of the row before, of row i and of the row after
    before: Any
    at: Any
    after: Any


class Entry(NamedTuple):
    """An entry b of a row within a kernel, which is a point in each lane; u: its displacement, a list of x, y and z."""

    row: KernelRow
    b: Any
    u: Any
