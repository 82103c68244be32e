"""Springs between neighbouring mass points: along rows, along columns and along both diagonals of a cell.

Scene: `springs.structural`, `springs.shear` and `springs.map`, or `tissue.young`, `thickness`, `pretension` and `map`.

`terms.law` contains the force of a spring. The forces on its two ends are equal and opposite.

In flat tissue each cell, with sides dx and dy and the map's factor f, adds stiffness to the springs along its edges and
diagonals:

    along x     f E t (9/8 dy/dx - 3/8 dx/dy) / 2        along y: the same with x and y exchanged
    diagonals   f 3/16 E t (dx^2 + dy^2) / (dx dy)

The lattice then approximates an isotropic sheet in plane stress. Springs imply Poisson's ratio 1/3; docs/model.md
contains the derivation, and `model.cells` the stiffness of curved tissue.

Under a pretension S a spring of rest length L0 has the tension tau L0 at rest, where tau = k1 e, k1 is its stiffness
for f = 1, and e = S / (3/2 E t).
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.laws import law_of
from taichi_msm.laws.law import Law
from taichi_msm.model.cells import CellStiffness, cell_stiffness, sum_around_points
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import Material, Springs, largest_mean, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.terms.base import BY_COLUMN, DX, DY, KernelConfig, RowPair, Term
from taichi_msm.terms.law import build_pull_of_squares, build_spring, law_places
from taichi_msm.terms.places import Places
from taichi_msm.terms.points import build_point_functions

# Families of springs. Both diagonals have the constants DIAGONAL, but fields of their own, FALLING and RISING.
ALONG_ROW, ALONG_COLUMN, DIAGONAL = range(3)
FALLING, RISING, FAMILIES = 2, 3, 4

# Measures. On a curved sheet the sums are multiplied by L0^2.
MEASURES = Places(
    min_strain=1,  # minimum of (L^2 - L0^2) / L0^2
    max_strain=1,
    stretch=3,  # sum of `SpringFunctions.energy` for each family
    tension=3,  # under tension, sum of tau |q|^2 / L0^2 for each family
)

# Row of `by_column` with the share of springs along columns, that of cells in the inner rows of mass points.
COLUMN_SHARE = BY_COLUMN.area_share[1]

# Prevents a division by 0 at L = 0, where the force becomes 0; representable in f32, the type of literals in kernels.
MIN_SQUARED_LENGTH = 1e-36


@dataclass(frozen=True)
class SpringTerm(Term):
    """Springs between neighbouring mass points."""

    has_gradient: ClassVar[bool] = True

    structural: bool  # whether the sheet has springs along rows and columns
    shear: bool  # whether the sheet has springs along diagonals
    open_edges: bool  # whether any mass point at an edge can move; only then are springs beyond the edge masked
    by_area: bool  # whether springs along an open edge are softer, because they belong to one cell
    varied: bool  # whether k - tau and tau of every spring are fields, with 0 for springs beyond an edge
    tense: bool  # whether the sheet is under tension at rest
    law: Law | None = None  # of the springs; None if they are linear

    reach: ClassVar[int] = 1
    reductions: ClassVar[tuple[str, ...]] = ("min", "max", "sum", "sum", "sum", "sum", "sum", "sum")

    @property
    def tense_edges(self) -> bool:
        """Whether the sheet is under tension at rest and has mass points at an edge that can move."""
        return self.tense and self.open_edges

    @property
    def constant_places(self) -> Places:
        # k - tau, tau and the law of each family.
        return Places(stiffness=3, tension=3, laws=[law_places(self.law)] * 3)

    @property
    def field_places(self) -> Places:
        families = FAMILIES * self.varied
        return Places(stiffness=families, tension=families * self.tense)

    @property
    def measure_places(self) -> Places:
        return MEASURES

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        tissue, springs = scene.tissue, scene.springs
        if tissue is None:
            assert springs is not None
            stiffness = {"across": springs.structural, "down": springs.structural, "shear": springs.shear}
            return {**stiffness, "tension": 0.0, "stiffening": None}
        # On a curved sheet those of a square cell; the springs of its own cells follow from `curved_springs`.
        dx, dy = (1.0, 1.0) if scene.sheet.surface else spacing(scene.sheet)
        membrane = tissue.young * tissue.thickness
        return {
            "across": membrane * (9 / 8 * dy / dx - 3 / 8 * dx / dy),
            "down": membrane * (9 / 8 * dx / dy - 3 / 8 * dy / dx),
            "shear": 3 / 16 * membrane * (dx * dx + dy * dy) / (dx * dy),
            "tension": tissue.pretension / (1.5 * membrane),
            "stiffening": law_of(tissue.stiffening),
        }

    @classmethod
    def from_plan(cls, plan: Plan) -> Self:
        material, open_edges = plan.material, plan.open_edges
        return cls(
            structural=max(material.across, material.down) > 0,
            shear=material.shear > 0,
            open_edges=open_edges,
            by_area=open_edges and material.by_area,
            varied=material.factors is not None or material.springs is not None,
            tense=material.is_tense,
            law=material.stiffening.law if material.stiffening else None,
        )

    @staticmethod
    def stiffness_bound(material: Material, sheet: Sheet) -> float:
        # While springs exceed half their rest length, a spring has at most the energy k / 2 |q|^2. The energy is a sum
        # over cells. With a quarter of the mass of a mass point at each corner, every mode of a cell, and hence every
        # mode of the sheet, satisfies
        #
        #     m w^2 <= 4 max(across + down, across + 2 shear, down + 2 shear)
        #
        # With a map, the mass of each mass point is distributed over its cells in proportion to their stiffness. The
        # bound is then multiplied by the largest mean of the factors around a mass point.
        if material.springs is not None:
            return float(material.springs.bounds.max()) * _steepest(material)
        largest = 1.0
        if material.factors is not None:
            largest = largest_mean(material.factors) if material.by_area else float(material.factors.max())
        return _unmapped_bound(material) * largest

    @classmethod
    def node_stiffness_bounds(cls, material: Material, sheet: Sheet) -> NDArray[Any] | float:
        """Bound the stiffness at each mass point [N/m], shape (rows, cols).

        Each cell contributes a quarter of its bound to each corner, so mass points at an edge of tissue have lower
        bounds. In scenes with `springs`, edges are not softer; there the largest factor around the mass point counts.
        """
        if material.springs is not None:
            return material.springs.bounds * _steepest(material)
        padded = np.pad(_factors(material, sheet), 1)
        cells = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]])
        shares = cells.mean(axis=0) if material.by_area else cells.max(axis=0)
        return _unmapped_bound(material) * shares

    def constants(self, plan: Plan) -> tuple[float, ...]:
        material, (dx, dy) = plan.material, spacing(plan.scene.sheet)
        remainder = 1 - material.tension
        stiffness = material.across * remainder, material.down * remainder, material.shear * remainder
        lengths, law = (dx, dy, math.hypot(dx, dy)), material.stiffening
        if material.springs is not None and material.springs.rest is not None:
            lengths = 1.0, 1.0, 1.0  # the kernels divide by the length of each spring
        numbers = (number for length in lengths if law for number in law.constants(length))
        return *stiffness, *material.tensions, *numbers

    def fields(self, plan: Plan) -> NDArray[Any]:
        """Return k - tau, and under tension tau, of all families [N/m], each spring at its upper left end."""
        if not self.varied:
            return super().fields(plan)
        points = plan.scene.sheet.points
        springs, places = assemble_springs(plan.material, plan.scene.sheet), self.field_places
        fields = np.zeros((places.count, *points))
        for family, (k, tau) in enumerate(zip(springs.stiffness, springs.tension, strict=True)):
            rows, cols = k.shape
            fields[places.stiffness[family], :rows, :cols] = np.maximum(k - tau, 0)
            if self.tense:
                fields[places.tension[family], :rows, :cols] = tau
        return fields

    def energy(self, sums: NDArray[Any], plan: Plan) -> float:
        total, springs = sums[MEASURES.stretch] + sums[MEASURES.tension], plan.material.springs
        if springs is not None and springs.rest is not None:
            return float(total.sum())
        dx, dy = spacing(plan.scene.sheet)
        return float(total @ (dx**2, dy**2, dx**2 + dy**2))

    def _build_numbers(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function numbers_of(sheet, family, length), the list of `LawNumbers.constants`."""
        ti, laws, of_length = config.ti, config.constants(SpringTerm).laws, config.curved and self.law is not None

        @ti.func
        def numbers_of(sheet: ti.template(), family: ti.template(), length):
            if ti.static(of_length):
                others = [sheet.constants[n] for n in ti.static(range(laws[family].first + 1, laws[family].end))]
                return [sheet.constants[laws[family].first] / length] + others  # noqa: RUF005
            else:  # noqa: RET505  # Taichi would compile the rest as well.
                return [sheet.constants[n] for n in ti.static(range(laws[family].first, laws[family].end))]

        return numbers_of

    def _build_field(self, config: KernelConfig, places: range) -> Callable[..., Any]:
        """Build the Taichi function that reads the field of a family, see `build_stiffness`, among their `places`."""
        ti = config.ti

        @ti.func
        def of_spring(sheet: ti.template(), family: ti.template(), falls, i, b):
            field = places.start + family
            if ti.static(family == DIAGONAL):
                field = places.start + ti.select(falls, FALLING, RISING)
            return sheet.fields[(field * sheet.rows + i) * sheet.width + b]

        return of_spring

    def build_stiffness(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function stiffness(sheet, family, falls, i, kind, b), k - tau of a spring [N/m].

        Entry b of row i is the left or upper end of a spring along a row or column, or the upper left corner of the
        cell of a diagonal, which falls to the right or rises.
        """
        ti, real, constants = config.ti, config.real, config.constants(SpringTerm).stiffness
        varied, by_area = self.varied, self.by_area
        read = self._build_field(config, config.fields(SpringTerm).stiffness)

        @ti.func
        def stiffness(sheet: ti.template(), family: ti.template(), falls, i, kind, b):
            if ti.static(varied):
                return read(sheet, family, falls, i, b)
            elif ti.static(by_area and family == ALONG_ROW):  # noqa: RET505
                return sheet.constants[constants[ALONG_ROW]] * ti.select(
                    kind == 1, ti.cast(1, real), ti.cast(0.5, real)
                )
            elif ti.static(by_area and family == ALONG_COLUMN):
                return sheet.constants[constants[ALONG_COLUMN]] * sheet.by_column[COLUMN_SHARE * sheet.width + b]
            else:
                return sheet.constants[constants[family]]

        return stiffness

    def _build_tension(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function tension(sheet, family, falls, i, kind, b, exists), tau of a spring [N/m].

        Along an open edge it is half, as the spring belongs to one cell instead of two.
        """
        ti, real, constants = config.ti, config.real, config.constants(SpringTerm).tension
        varied, edges = self.varied and self.tense, self.tense_edges
        read = self._build_field(config, config.fields(SpringTerm).tension)

        @ti.func
        def tension(sheet: ti.template(), family: ti.template(), falls, i, kind, b, exists):
            if ti.static(varied):
                return read(sheet, family, falls, i, b) * exists
            elif ti.static(edges and family == ALONG_ROW):  # noqa: RET505
                share = ti.select(kind == 1, ti.cast(1, real), ti.cast(0.5, real))
                return sheet.constants[constants[ALONG_ROW]] * (exists * share)
            elif ti.static(edges and family == ALONG_COLUMN):
                share = sheet.by_column[COLUMN_SHARE * sheet.width + b]
                return sheet.constants[constants[ALONG_COLUMN]] * (exists * share)
            elif ti.static(edges):
                return sheet.constants[constants[DIAGONAL]] * exists
            else:
                return sheet.constants[constants[family]]

        return tension

    def build_spring_forces(self, config: KernelConfig) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """Build two Taichi functions for the force of a mass point with displacement `u` on a neighbour [N].

        force_on_right(sheet, pair, entry, b, u, exists) is for the right neighbour, and force_on_other(sheet, pair,
        entry, right, b, u, exists) for a neighbour in the other row of a `RowPair`, `right` columns to the right.
        `entry` is that of the neighbour in u, b that of the mass point in its row, and `exists` is 1, or 0 for a spring
        beyond an edge.
        """
        ti, vector, tense, curved = config.ti, config.vector, self.tense, config.curved
        open_edges, tense_edges, linear = self.open_edges, self.tense_edges, self.law is None
        stiffness_of, tension_of = self.build_stiffness(config), self._build_tension(config)
        numbers_of, rest_position = self._build_numbers(config), build_point_functions(config).rest_position
        pull = build_spring(self.law, config.operations, tense=tense).pull
        pull_of_squares = build_pull_of_squares(config.operations)

        @ti.func
        def masked(k, exists):
            """Return the stiffness of a spring, 0 beyond an edge."""
            if ti.static(tense_edges):
                return ti.select(exists > 0, k, vector(0))
            elif ti.static(open_edges):  # noqa: RET505
                return k * exists
            else:
                return k

        @ti.func
        def force(
            sheet: ti.template(), family: ti.template(), falls, i, kind, b, exists, square_difference, square, at_rest,
            edge: ti.template(), q: ti.template(),
        ):  # fmt: skip
            """Return the force of the spring `edge`, the vector to the mass point that exerts it.

            `at_rest` is its length at rest, squared for a linear spring of a curved sheet.
            """
            k, per_length = masked(stiffness_of(sheet, family, falls, i, kind, b), exists), vector(0)
            tension = tension_of(sheet, family, falls, i, kind, b, exists)
            if ti.static(curved and linear):
                per_length = pull_of_squares(k, square_difference, square, at_rest)
            else:
                per_length = pull(k, tension, square_difference, square, at_rest, numbers_of(sheet, family, at_rest))
            total = [per_length * edge[c] for c in ti.static(range(3))]
            if ti.static(tense):
                for c in ti.static(range(3)):
                    total[c] += tension * q[c]
            return total

        @ti.func
        def curved_force(
            sheet: ti.template(), family: ti.template(), falls, i, kind, b, exists, q: ti.template(), o: ti.template()
        ):
            """Return the force of a spring with the vector o at rest to the mass point that exerts it."""
            edge = [q[c] + o[c] for c in ti.static(range(3))]
            square_difference = q[0] * (edge[0] + o[0]) + (q[1] * (edge[1] + o[1]) + q[2] * (edge[2] + o[2]))
            square = edge[0] * edge[0] + edge[1] * edge[1] + (edge[2] * edge[2] + MIN_SQUARED_LENGTH)
            square_at_rest = o[0] * o[0] + o[1] * o[1] + (o[2] * o[2] + MIN_SQUARED_LENGTH)
            at_rest = square_at_rest
            if ti.static(not linear):
                at_rest = ti.sqrt(square_at_rest)
            return force(sheet, family, falls, i, kind, b, exists, square_difference, square, at_rest, edge, q)

        @ti.func
        def force_on_right(sheet: ti.template(), pair: ti.template(), entry, b, u: ti.template(), exists):
            x, y, z = u[0] - sheet.u[0][entry], u[1] - sheet.u[1][entry], u[2] - sheet.u[2][entry]
            i, kind = pair.i, pair.kind
            if ti.static(curved):
                at, end = rest_position(sheet, i, b), rest_position(sheet, i, b + 1)
                o = [at[c] - end[c] for c in ti.static(range(3))]
                return curved_force(sheet, ALONG_ROW, True, i, kind, b, exists, [x, y, z], o)
            else:  # noqa: RET505
                dx = sheet.constants[DX]
                edge_x = x - dx
                rest = y * y + z * z
                square_difference = x * (edge_x - dx) + rest
                square = edge_x * edge_x + (rest + MIN_SQUARED_LENGTH)
                return force(
                    sheet, ALONG_ROW, True, i, kind, b, exists, square_difference, square, dx, [edge_x, y, z], [x, y, z]
                )

        @ti.func
        def force_on_other(
            sheet: ti.template(), pair: ti.template(), entry, right: ti.template(), b, u: ti.template(), exists
        ):
            x, y, z = u[0] - sheet.u[0][entry], u[1] - sheet.u[1][entry], u[2] - sheet.u[2][entry]
            family = ti.static(DIAGONAL if right else ALONG_COLUMN)
            falls = (pair.up < 0) == ti.static(right > 0)
            # The upper left corner of the spring's cell.
            i, left = pair.upper, b + ti.static(min(right, 0))
            if ti.static(curved):
                at, end = rest_position(sheet, pair.i, b), rest_position(sheet, pair.other, b + right)
                o = [at[c] - end[c] for c in ti.static(range(3))]
                return curved_force(sheet, family, falls, i, 1, left, exists, [x, y, z], o)
            else:  # noqa: RET505
                up, length = pair.up, ti.abs(pair.up)
                edge_x = x
                edge_y = y - up
                rest = z * z
                square_difference = x * x + (y * (edge_y - up) + rest)
                if ti.static(right != 0):
                    length = pair.diagonal
                    edge_x = x - right * sheet.constants[DX]
                    square_difference = x * (edge_x - right * sheet.constants[DX]) + (y * (edge_y - up) + rest)
                square = edge_x * edge_x + edge_y * edge_y + (rest + MIN_SQUARED_LENGTH)
                edge = [edge_x, edge_y, z]
                return force(
                    sheet, family, falls, i, 1, left, exists, square_difference, square, length, edge, [x, y, z]
                )

        return force_on_right, force_on_other

    def build_spring_tangent(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function that differentiates the force of a mass point P on its neighbour Q on a flat sheet.

        If q = u_P - u_Q changes by p, the force of a linear law changes by

            (k - tau) (s p + (1 - s) ((o + q) . p) (o + q) / L^2) + tau p,    s = 1 - L0 / L

        The map from p to this change is symmetric.
        """
        ti, tense = config.ti, self.tense
        derivatives = build_spring(self.law, config.operations, tense=tense).derivatives
        tensions, numbers_of = config.constants(SpringTerm).tension, self._build_numbers(config)
        # One derivative by log m, and one by each number of the shape.
        by_count = 1 + self.law.shape_count if self.law else 0

        @ti.func
        def differentiate(
            sheet: ti.template(), family: ti.template(), q: ti.template(), p: ti.template(), x0, y0, length, k
        ):
            """Return x, y and z of the change, and the derivatives of p . force by k - tau, tau, log m and shape."""
            edge = [q[0] + x0, q[1] + y0, q[2]]
            square = edge[0] * edge[0] + edge[1] * edge[1] + (edge[2] * edge[2] + MIN_SQUARED_LENGTH)
            square_difference = q[0] * (edge[0] + x0) + (q[1] * (edge[1] + y0) + q[2] * q[2])
            along = edge[0] * p[0] + edge[1] * p[1] + edge[2] * p[2]
            tension, numbers = sheet.constants[tensions[family]], numbers_of(sheet, family, length)
            of_spring = ti.static(derivatives(k, tension, square_difference, square, length, along, numbers))
            isotropic, axial, by_k = of_spring[0], of_spring[1], of_spring[2]
            if ti.static(tense):
                isotropic += tension
            change = [isotropic * p[c] + axial * edge[c] for c in ti.static(range(3))]
            by_tau = q[0] * p[0] + q[1] * p[1] + q[2] * p[2] + of_spring[3] * along
            by_numbers = [of_spring[4][n] * along for n in ti.static(range(by_count))]
            return change + [by_k * along, by_tau] + by_numbers  # noqa: RUF005  # Taichi nests an unpacked list.

        return differentiate

    def build_max_spring_force(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function max_force(sheet, entry), the largest squared force of right and lower springs."""
        ti = config.ti
        structural, shear, vector = self.structural, self.shear, config.vector
        force_on_right, force_on_other = self.build_spring_forces(config)

        @ti.func
        def larger(largest, force: ti.template(), exists):
            return ti.max(largest, (force[0] * force[0] + force[1] * force[1] + force[2] * force[2]) * exists)

        @ti.func
        def max_force(sheet: ti.template(), entry: ti.template()):
            row = ti.static(entry.row)
            u = ti.static(entry.u)
            b, largest = entry.b, vector(0)
            # Springs beyond an edge do not exist.
            has_left = sheet.by_column[BY_COLUMN.has_left * sheet.width + b]
            has_right = sheet.by_column[BY_COLUMN.has_right * sheet.width + b]
            dx, dy = sheet.constants[DX], sheet.constants[DY]
            at, below = row.i * sheet.width + b, (row.i + 1) * sheet.width + b
            pair = ti.static(RowPair(row.i, row.kind, row.i + 1, row.i, 0 - dy, ti.sqrt(dx * dx + dy * dy)))
            if ti.static(structural):
                largest = larger(largest, force_on_right(sheet, pair, at + 1, b, u, has_right), has_right)
            if row.i + 1 < sheet.rows:
                if ti.static(structural):
                    force = force_on_other(sheet, pair, below, 0, b, u, vector(1))
                    largest = larger(largest, force, vector(1))
                if ti.static(shear):
                    for right, exists in ti.static(((-1, has_left), (1, has_right))):
                        force = force_on_other(sheet, pair, below + right, right, b, u, exists)
                        largest = larger(largest, force, exists)
            return largest

        return max_force

    def build_measures(self, config: KernelConfig) -> Sequence[Callable[..., None]]:
        ti = config.ti
        tense, open_edges, vector, places = self.tense, self.open_edges, config.vector, config.measures(SpringTerm)
        varied, curved = self.varied, config.curved
        stiffness_of, tension_of = self.build_stiffness(config), self._build_tension(config)
        numbers_of, rest_position = self._build_numbers(config), build_point_functions(config).rest_position
        energy = build_spring(self.law, config.operations).energy
        # For each family its index, and the rows down and columns right from one end of a spring to the other.
        structural = ((ALONG_ROW, 0, (1,)), (ALONG_COLUMN, 1, (0,))) if self.structural else ()
        families = structural + (((DIAGONAL, 1, (-1, 1)),) if self.shear else ())

        @ti.func
        def rest_vector(sheet: ti.template(), i, b, down: ti.template(), right: ti.template()):
            """Return the vector at rest from entry b of row i to the other end of a spring."""
            if ti.static(curved):
                start, end = rest_position(sheet, i, b), rest_position(sheet, i + down, b + right)
                return [end[c] - start[c] for c in ti.static(range(3))]
            else:  # noqa: RET505
                return [right * sheet.constants[DX], -down * sheet.constants[DY]]

        @ti.func
        def strains(sheet: ti.template(), p, q, b, right: ti.template(), o: ti.template()):
            """Return (L^2 - L0^2) / L0^2, |q|^2 / L0^2 and L0^2 of the spring from entry b of row p to one of row q."""
            start, end = p * sheet.width + b, q * sheet.width + b + right
            x = sheet.u[0][end] - sheet.u[0][start]
            y = sheet.u[1][end] - sheet.u[1][start]
            z = sheet.u[2][end] - sheet.u[2][start]
            square, beyond = o[0] * o[0] + o[1] * o[1], z * z
            if ti.static(curved):
                square, beyond = square + (o[2] * o[2] + MIN_SQUARED_LENGTH), z * (z + 2 * o[2])
            square_strain = (x * (x + 2 * o[0]) + (y * (y + 2 * o[1]) + beyond)) / square
            return square_strain, (x * x + y * y + z * z) / square, square

        @ti.func
        def measure(measures: ti.template(), sheet: ti.template(), p, i, kind, b):
            for family, down, rights in ti.static(families):
                if i + down < sheet.rows:
                    stretch_sum, tension_sum = vector(0), vector(0)
                    for right in ti.static(rights):
                        exists, left, falls = vector(1), b + ti.static(min(right, 0)), ti.static(right > 0)
                        if ti.static(open_edges and right != 0):
                            # Springs beyond the edge do not exist.
                            side = ti.static(BY_COLUMN.has_left if right < 0 else BY_COLUMN.has_right)
                            exists = sheet.by_column[side * sheet.width + b]
                        k = vector(0) + stiffness_of(sheet, family, falls, i, kind, left)
                        tension = vector(0) + tension_of(sheet, family, falls, i, kind, left, exists)
                        strain, motion, square = strains(
                            sheet, p, p + down, b, right, rest_vector(sheet, i, b, down, right)
                        )
                        if ti.static(varied):
                            exists = ti.select(k + tension > 0, exists, vector(0))
                        if ti.static(varied or open_edges):
                            strain = ti.select(exists > 0, strain, vector(0))
                        measures[places.min_strain] = ti.min(measures[places.min_strain], strain)
                        measures[places.max_strain] = ti.max(measures[places.max_strain], strain)
                        stretch = energy(k, tension, strain, numbers_of(sheet, family, ti.sqrt(square)))
                        if ti.static(tense):
                            motion = ti.select(exists > 0, motion, vector(0)) * tension
                        if ti.static(curved):
                            stretch, motion = stretch * square, motion * square
                        stretch_sum += stretch
                        tension_sum += motion
                    measures[places.stretch[family]] += stretch_sum
                    if ti.static(tense):
                        measures[places.tension[family]] += tension_sum

        return (measure,)


def _steepest(material: Material) -> float:
    """Return the largest tangent of the springs, relative to that at rest."""
    return material.stiffening.largest_slope if material.stiffening else 1.0


def _unmapped_bound(material: Material) -> float:
    """Return `SpringTerm.stiffness_bound` for factors of 1 [N/m]."""
    across, down, shear = material.across, material.down, material.shear
    return _steepest(material) * 4 * max(across + down, across + 2 * shear, down + 2 * shear)


Window = tuple[slice, slice]


def spring_ends(points: tuple[int, ...]) -> Iterator[tuple[Window, Window]]:
    """Yield the slices of the mass points at the upper or left and at the other end of the springs of each family."""
    rows, cols = points
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        start = slice(0, rows - down), slice(max(0, -right), cols - max(0, right))
        yield start, (slice(down, rows), slice(max(0, right), cols - max(0, -right)))


def assemble_springs(material: Material, sheet: Sheet) -> Springs:
    """Return the springs of a sheet as arrays."""
    if material.springs is not None:
        return material.springs
    along_rows, along_columns, diagonals = spring_stiffness(material, _factors(material, sheet))
    # The tension at rest does not depend on the map.
    unmapped = rest_of(sheet).present.astype(float)
    tensions = [k * material.tension for k in spring_stiffness(material, unmapped)]
    stiffness = along_rows, along_columns, diagonals, diagonals
    bounds = np.asarray(SpringTerm.node_stiffness_bounds(material, sheet)) / _steepest(material)
    return Springs(stiffness, (*tensions, tensions[DIAGONAL]), None, bounds)


def curved_springs(material: Material, sheet: Sheet, rest: CurvedRest, membrane: float) -> Springs:
    """Return the springs of a curved sheet, for E t of tissue [N/m], 0 for the given coefficients of `springs`."""
    if membrane == 0:
        return assemble_springs(material, sheet)._replace(rest=rest.position)
    squares = [
        ((rest.position[end] - rest.position[start]) ** 2).sum(axis=-1) for start, end in spring_ends(sheet.points)
    ]

    def stiffness_of(cell: CellStiffness) -> list[NDArray[Any]]:
        families = *_sum_beside(cell.along_a, cell.along_b), cell.falling, cell.rising
        return [k * square for k, square in zip(families, squares, strict=True)]

    def cells_of(factors: NDArray[Any]) -> CellStiffness:
        # Cells without sheet may have any shape.
        with np.errstate(divide="ignore", invalid="ignore"):
            values = cell_stiffness(rest.cells, membrane * factors)
        return CellStiffness(*(np.where(rest.present, each, 0) for each in values))

    cell, ones = cells_of(_factors(material, sheet)), np.ones(rest.present.shape)
    stiffness, unmapped = stiffness_of(cell), stiffness_of(cells_of(ones))
    # Bound of each cell from its stiffness alone: k_a and k_b of its longer sides, k_m and k_n of its diagonals.
    k_a = cell.along_a * np.maximum(squares[ALONG_ROW][:-1], squares[ALONG_ROW][1:])
    k_b = cell.along_b * np.maximum(squares[ALONG_COLUMN][:, :-1], squares[ALONG_COLUMN][:, 1:])
    k_m, k_n = stiffness[FALLING:]
    bounds = np.maximum(2 * (k_a + k_b), k_a + k_b + k_m + k_n + np.hypot(k_a - k_b, k_m - k_n))
    return Springs(stiffness, [k * material.tension for k in unmapped], rest.position, sum_around_points(bounds))


def _sum_beside(along_rows: NDArray[Any], along_columns: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Sum numbers of cells over the cells next to each spring along rows, and next to each one along columns."""
    above_and_below, left_and_right = np.pad(along_rows, ((1, 1), (0, 0))), np.pad(along_columns, ((0, 0), (1, 1)))
    return above_and_below[:-1] + above_and_below[1:], left_and_right[:, :-1] + left_and_right[:, 1:]


def _factors(material: Material, sheet: Sheet) -> NDArray[Any]:
    """Return the factors of the cells of a sheet, 0 without sheet, shape (rows - 1, cols - 1)."""
    present = rest_of(sheet).present
    return present.astype(float) if material.factors is None else np.where(present, material.factors, 0)


def spring_stiffness(material: Material, factors: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the stiffness k of every spring [N/m], for factors of the cells, shape (rows - 1, cols - 1).

    The shapes are those of `Springs` for springs along rows, along columns and along both diagonals of a cell.
    """
    along_rows, along_columns = _sum_beside(factors, factors)
    across, down = material.across / 2 * along_rows, material.down / 2 * along_columns
    if not material.by_area:
        # In scenes with `springs`, springs at an edge are as stiff as all others.
        across[[0, -1]] *= 2
        down[:, [0, -1]] *= 2
    return across, down, material.shear * factors
