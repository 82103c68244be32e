"""Springs between neighbouring mass points: along rows, along columns and along both diagonals of a cell.

Scene: `springs.structural`, `springs.shear` and `springs.map`, or `tissue.young`, `thickness`, `pretension` and `map`.

`terms.law` contains the force of a spring. The forces on its two ends are equal and opposite.

In tissue each cell, with sides dx and dy and the map's factor f, adds stiffness to the springs along its edges and
diagonals:

    along x     f E t (9/8 dy/dx - 3/8 dx/dy) / 2        along y: the same with x and y exchanged
    diagonals   f 3/16 E t (dx^2 + dy^2) / (dx dy)

The lattice then approximates an isotropic sheet in plane stress. Springs imply Poisson's ratio 1/3; docs/model.md
contains the derivation.

Under a pretension S a spring of rest length L0 has the tension tau L0 at rest, where tau = k1 e, k1 is its stiffness
for f = 1, and e = S / (3/2 E t).
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Material, largest_mean, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.terms.base import AREA_SHARE, DX, DY, HAS_LEFT, HAS_RIGHT, KernelConfig, Term
from taichi_msm.terms.law import LINEAR, Law, law_parameters, make_stiffening, spring_law

# Families of springs.
ALONG_ROW, ALONG_COLUMN, DIAGONAL = range(3)

# Measures: minimum and maximum of (L^2 - L0^2) / L0^2; sum of `LawFunctions.energy` for each family; under tension, sum
# of |q|^2 / L0^2 for each family.
MIN_STRAIN, MAX_STRAIN, STRETCH_SUMS, TENSION_SUMS = 0, 1, 2, 5

# Constants, each for all families in turn: k - tau, tau, parameters of the law.
FIRST_TENSION, FIRST_PARAMETER = 3, 6

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
    mapped: bool  # whether each stiffness is read from an array, with 0 for springs beyond an edge
    tense: bool  # whether the sheet is under tension at rest
    law: Law = LINEAR  # of the springs

    reach: ClassVar[int] = 1
    reductions: ClassVar[tuple[str, ...]] = ("min", "max", "sum", "sum", "sum", "sum", "sum", "sum")

    @property
    def tense_edges(self) -> bool:
        """Whether the sheet is under tension at rest and has clamped edges, which can move."""
        return self.tense and self.open_edges

    @property
    def constant_count(self) -> int:  # type: ignore[override]
        return FIRST_PARAMETER + 3 * self.law.parameter_count

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        tissue, springs = scene.tissue, scene.springs
        if tissue is None:
            assert springs is not None
            stiffness = {"across": springs.structural, "down": springs.structural, "shear": springs.shear}
            return {**stiffness, "tension": 0.0, "stiffening": None}
        dx, dy = spacing(scene.sheet)
        membrane, stiffening = tissue.young * tissue.thickness, tissue.stiffening
        return {
            "across": membrane * (9 / 8 * dy / dx - 3 / 8 * dx / dy),
            "down": membrane * (9 / 8 * dx / dy - 3 / 8 * dy / dx),
            "shear": 3 / 16 * membrane * (dx * dx + dy * dy) / (dx * dy),
            "tension": tissue.pretension / (1.5 * membrane),
            "stiffening": None if stiffening is None else make_stiffening(stiffening.lock, stiffening.factor),
        }

    @classmethod
    def from_plan(cls, plan: Plan) -> Self:
        material, open_edges = plan.material, plan.open_edges
        return cls(
            structural=max(material.across, material.down) > 0,
            shear=material.shear > 0,
            open_edges=open_edges,
            by_area=open_edges and material.by_area,
            mapped=material.factors is not None,
            tense=material.tension > 0,
            law=spring_law(material.stiffening),
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
        largest = 1.0
        if material.factors is not None:
            largest = largest_mean(material.factors) if material.by_area else float(material.factors.max())
        return _unmapped_bound(material) * largest

    @classmethod
    def node_stiffness_bounds(cls, plan: Plan) -> NDArray[Any] | float:
        """Bound the stiffness at each mass point [N/m], shape (rows, cols).

        Each cell contributes a quarter of its bound to each corner, so mass points at an edge of tissue have lower
        bounds. In scenes with `springs`, edges are not softer; there the largest factor around the mass point counts.
        """
        material, factors = plan.material, plan.material.factors
        if factors is None:
            factors = np.ones([count - 1 for count in plan.scene.sheet.points])
        padded = np.pad(factors, 1)
        cells = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]])
        shares = cells.mean(axis=0) if material.by_area else cells.max(axis=0)
        return _unmapped_bound(material) * shares

    def constants(self, plan: Plan) -> tuple[float, ...]:
        material, (dx, dy) = plan.material, spacing(plan.scene.sheet)
        remainder = 1 - material.tension
        stiffness = material.across * remainder, material.down * remainder, material.shear * remainder
        lengths = dx, dy, math.hypot(dx, dy)
        parameters = (value for length in lengths for value in law_parameters(material.stiffening, length))
        return *stiffness, *material.tensions, *parameters

    def energy(self, sums: NDArray[Any], plan: Plan) -> float:
        dx, dy = spacing(plan.scene.sheet)
        squares = np.array([dx**2, dy**2, dx**2 + dy**2])
        return float((sums[STRETCH_SUMS:TENSION_SUMS] + plan.material.tensions * sums[TENSION_SUMS:]) @ squares)

    def _build_parameters(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function parameters_of(sheet, family), the list of the parameters of the law."""
        ti, count, first = config.ti, self.law.parameter_count, config.first_constant(SpringTerm) + FIRST_PARAMETER

        @ti.func
        def parameters_of(sheet: ti.template(), family: ti.template()):
            return [sheet.constants[first + count * family + n] for n in ti.static(range(count))]

        return parameters_of

    def build_cell_shares(self, config: KernelConfig) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """Build the Taichi functions row_share(exists, kind) and column_share(sheet, exists, b).

        They return the share of the tension of a spring along a row or a column: `exists`, and with `tense_edges` half
        of it along an edge, where the spring belongs to one cell instead of two.
        """
        ti, real, tense_edges = config.ti, config.real, self.tense_edges

        @ti.func
        def row_share(exists, kind):
            if ti.static(tense_edges):
                return exists * ti.select(kind == 1, ti.cast(1, real), ti.cast(0.5, real))
            else:  # noqa: RET505
                return exists

        @ti.func
        def column_share(sheet: ti.template(), exists, b):
            if ti.static(tense_edges):
                return exists * sheet.by_column[(AREA_SHARE + 1) * sheet.width + b]
            else:  # noqa: RET505
                return exists

        return row_share, column_share

    def build_spring_forces(self, config: KernelConfig) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """Build the Taichi functions for the force of a mass point with displacement `u` on a neighbour [N].

        `exists` is 1, 0 for a spring beyond an edge, or a share from `build_cell_shares`.

        Returns:
            force_on_right(sheet, right, u, k, exists) for the right neighbour, entry `right` of u;
            force_on_other(sheet, entry, right, u, up, length, k, exists) for a neighbour in another row, entry `entry`
            of u, `up` [m] above and `right` columns to the right.
        """
        ti, vector, tense = config.ti, config.vector, self.tense
        open_edges, tense_edges = self.open_edges, self.tense_edges
        first_tension, parameters_of = config.first_constant(SpringTerm) + FIRST_TENSION, self._build_parameters(config)
        pull = config.compile_law(self.law, tense=tense).pull

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
        def tension_of(sheet: ti.template(), family: ti.template(), exists):
            """Return the tension tau of a spring [N/m]."""
            if ti.static(tense_edges):
                return sheet.constants[first_tension + family] * exists
            else:  # noqa: RET505
                return sheet.constants[first_tension + family]

        @ti.func
        def force(
            sheet: ti.template(), family: ti.template(), k, exists, square_difference, square, length,
            edge: ti.template(), q: ti.template(),
        ):  # fmt: skip
            """Return the force of the spring `edge`, the vector to the mass point that exerts it."""
            tension, parameters = tension_of(sheet, family, exists), parameters_of(sheet, family)
            per_length = pull(masked(k, exists), tension, square_difference, square, length, *parameters)
            total = [per_length * edge[c] for c in ti.static(range(3))]
            if ti.static(tense):
                for c in ti.static(range(3)):
                    total[c] += tension * q[c]
            return total

        @ti.func
        def force_on_right(sheet: ti.template(), right, u: ti.template(), k, exists):
            dx = sheet.constants[DX]
            x, y, z = u[0] - sheet.u[0][right], u[1] - sheet.u[1][right], u[2] - sheet.u[2][right]
            edge_x = x - dx
            rest = y * y + z * z
            square_difference = x * (edge_x - dx) + rest
            square = edge_x * edge_x + (rest + MIN_SQUARED_LENGTH)
            return force(sheet, ALONG_ROW, k, exists, square_difference, square, dx, [edge_x, y, z], [x, y, z])

        @ti.func
        def force_on_other(sheet: ti.template(), entry, right: ti.template(), u: ti.template(), up, length, k, exists):
            x, y, z = u[0] - sheet.u[0][entry], u[1] - sheet.u[1][entry], u[2] - sheet.u[2][entry]
            edge_x = x
            edge_y = y - up
            rest = z * z
            square_difference = x * x + (y * (edge_y - up) + rest)
            if ti.static(right != 0):
                edge_x = x - right * sheet.constants[DX]
                square_difference = x * (edge_x - right * sheet.constants[DX]) + (y * (edge_y - up) + rest)
            square = edge_x * edge_x + edge_y * edge_y + (rest + MIN_SQUARED_LENGTH)
            family = ti.static(DIAGONAL if right else ALONG_COLUMN)
            return force(sheet, family, k, exists, square_difference, square, length, [edge_x, edge_y, z], [x, y, z])

        return force_on_right, force_on_other

    def build_stiffness(self, config: KernelConfig) -> tuple[Callable[..., Any], ...]:
        """Build the Taichi functions for the stiffness k - tau of a spring along a row, a column and diagonals [N/m].

        Returns:
            row_stiffness(sheet, i, kind, b), column_stiffness(sheet, lower, b) and diagonal_stiffness(sheet, lower, b).
        """
        ti, real, first = config.ti, config.real, config.first_constant(SpringTerm)
        mapped, by_area = self.mapped, self.by_area

        @ti.func
        def row_stiffness(sheet: ti.template(), i, kind, b):
            """Return the stiffness of the spring right of entry b of row i; along an edge of tissue it is half."""
            if ti.static(mapped):
                return sheet.stiffness[i * sheet.width + b]
            elif ti.static(by_area):  # noqa: RET505  # Taichi would compile the rest as well.
                return sheet.constants[first + ALONG_ROW] * ti.select(kind == 1, ti.cast(1, real), ti.cast(0.5, real))
            else:
                return sheet.constants[first + ALONG_ROW]

        @ti.func
        def column_stiffness(sheet: ti.template(), lower, b):
            """Return the stiffness of the spring between entry b of row `lower` and the row above."""
            if ti.static(mapped):
                return sheet.stiffness[(sheet.rows + lower) * sheet.width + b]
            elif ti.static(by_area):  # noqa: RET505
                return sheet.constants[first + ALONG_COLUMN] * sheet.by_column[(AREA_SHARE + 1) * sheet.width + b]
            else:
                return sheet.constants[first + ALONG_COLUMN]

        @ti.func
        def diagonal_stiffness(sheet: ti.template(), lower, b):
            """Return the stiffness of the diagonals of the cell right of entry b, above row `lower`."""
            if ti.static(mapped):
                return sheet.stiffness[(2 * sheet.rows + 1 + lower) * sheet.width + b]
            else:  # noqa: RET505
                return sheet.constants[first + DIAGONAL]

        return row_stiffness, column_stiffness, diagonal_stiffness

    def build_spring_tangent(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function that differentiates the force of a mass point P on its neighbour Q.

        If q = u_P - u_Q changes by p, the force of a linear law changes by

            (k - tau) (s p + (1 - s) ((o + q) . p) (o + q) / L^2) + tau p,    s = 1 - L0 / L

        The map from p to this change is symmetric.
        """
        ti, tense, count = config.ti, self.tense, self.law.parameter_count
        _, derivatives, parameter_derivatives, _ = config.compile_law(self.law, tense=tense)
        first_tension, parameters_of = config.first_constant(SpringTerm) + FIRST_TENSION, self._build_parameters(config)

        @ti.func
        def differentiate(
            sheet: ti.template(), family: ti.template(), q: ti.template(), p: ti.template(), x0, y0, length, k
        ):
            """Return x, y and z of the change, and the derivatives of p . force by k - tau and by tau.

            A locking law has two more, by log(lock) and by the factor.
            """
            edge = [q[0] + x0, q[1] + y0, q[2]]
            square = edge[0] * edge[0] + edge[1] * edge[1] + (edge[2] * edge[2] + MIN_SQUARED_LENGTH)
            square_difference = q[0] * (edge[0] + x0) + (q[1] * (edge[1] + y0) + q[2] * q[2])
            along = edge[0] * p[0] + edge[1] * p[1] + edge[2] * p[2]
            tension, parameters = sheet.constants[first_tension + family], parameters_of(sheet, family)
            isotropic, axial, by_k, by_tau = derivatives(
                k, tension, square_difference, square, length, along, *parameters
            )
            if ti.static(tense):
                isotropic += tension
            change = [isotropic * p[c] + axial * edge[c] for c in ti.static(range(3))]
            by_tau = q[0] * p[0] + q[1] * p[1] + q[2] * p[2] + by_tau * along
            if ti.static(count > 0):
                by_lock, by_factor = parameter_derivatives(k, tension, square_difference, square, length, *parameters)
                return [change[0], change[1], change[2], by_k * along, by_tau, by_lock * along, by_factor * along]
            else:  # noqa: RET505
                return [change[0], change[1], change[2], by_k * along, by_tau]

        return differentiate

    def build_max_spring_force(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function max_force(sheet, entry), the largest squared force of right and lower springs."""
        ti = config.ti
        structural, shear, vector = self.structural, self.shear, config.vector
        force_on_right, force_on_other = self.build_spring_forces(config)
        row_stiffness, column_stiffness, diagonal_stiffness = self.build_stiffness(config)
        row_share, column_share = self.build_cell_shares(config)

        @ti.func
        def larger(largest, force: ti.template()):
            return ti.max(largest, force[0] * force[0] + force[1] * force[1] + force[2] * force[2])

        @ti.func
        def max_force(sheet: ti.template(), entry: ti.template()):
            row = ti.static(entry.row)
            u = ti.static(entry.u)
            b, largest = entry.b, vector(0)
            # Springs beyond an edge do not exist.
            has_left = sheet.by_column[HAS_LEFT * sheet.width + b]
            has_right = sheet.by_column[HAS_RIGHT * sheet.width + b]
            dx, dy = sheet.constants[DX], sheet.constants[DY]
            at, below, lower = row.i * sheet.width + b, (row.i + 1) * sheet.width + b, row.i + 1
            if ti.static(structural):
                k, share = vector(0) + row_stiffness(sheet, row.i, row.kind, b), row_share(has_right, row.kind)
                largest = larger(largest, force_on_right(sheet, at + 1, u, k * has_right, share))
            if lower < sheet.rows:
                if ti.static(structural):
                    k, share = vector(0) + column_stiffness(sheet, lower, b), column_share(sheet, vector(1), b)
                    largest = larger(largest, force_on_other(sheet, below, 0, u, 0 - dy, dy, k, share))
                if ti.static(shear):
                    diagonal = ti.sqrt(dx * dx + dy * dy)
                    for right, exists in ti.static(((-1, has_left), (1, has_right))):
                        k = vector(0) + diagonal_stiffness(sheet, lower, b + ti.static(min(right, 0)))
                        force = force_on_other(sheet, below + right, right, u, 0 - dy, diagonal, k * exists, exists)
                        largest = larger(largest, force)
            return largest

        return max_force

    def build_measures(self, config: KernelConfig) -> Sequence[Callable[..., None]]:
        ti = config.ti
        tense, open_edges, vector, first = self.tense, self.open_edges, config.vector, config.first_measure(SpringTerm)
        row_stiffness, column_stiffness, diagonal_stiffness = self.build_stiffness(config)
        row_share, column_share = self.build_cell_shares(config)
        tense_edges = self.tense_edges
        first_tension, parameters_of = config.first_constant(SpringTerm) + FIRST_TENSION, self._build_parameters(config)
        energy = config.compile_law(self.law, tense=self.tense).energy
        # For each family its index, and the rows down and columns right from one end of a spring to the other.
        structural = ((ALONG_ROW, 0, (1,)), (ALONG_COLUMN, 1, (0,))) if self.structural else ()
        families = structural + (((DIAGONAL, 1, (-1, 1)),) if self.shear else ())

        @ti.func
        def strains(sheet: ti.template(), p, q, b, right: ti.template(), x0, y0):
            """Return (L^2 - L0^2) / L0^2 and |q|^2 / L0^2 of the spring from entry b of row p to b + right of row q."""
            start, end = p * sheet.width + b, q * sheet.width + b + right
            x = sheet.u[0][end] - sheet.u[0][start]
            y = sheet.u[1][end] - sheet.u[1][start]
            z = sheet.u[2][end] - sheet.u[2][start]
            square = x0 * x0 + y0 * y0
            square_strain = (x * (x + 2 * x0) + (y * (y + 2 * y0) + z * z)) / square
            square_motion = (x * x + y * y + z * z) / square
            # Springs beyond the edge do not exist.
            if ti.static(open_edges and right != 0):
                side = ti.static(HAS_LEFT if right < 0 else HAS_RIGHT)
                square_strain = ti.select(sheet.by_column[side * sheet.width + b] > 0, square_strain, vector(0))
            return square_strain, square_motion

        @ti.func
        def measure(measures: ti.template(), sheet: ti.template(), p, i, kind, b):
            dx, dy = sheet.constants[DX], sheet.constants[DY]
            for family, down, rights in ti.static(families):
                if i + down < sheet.rows:
                    stretch_sum, tension_sum = vector(0), vector(0)
                    tension, parameters = sheet.constants[first_tension + family], parameters_of(sheet, family)
                    for right in ti.static(rights):
                        k = vector(0)
                        if ti.static(family == ALONG_ROW):
                            k += row_stiffness(sheet, i, kind, b)
                        elif ti.static(family == ALONG_COLUMN):
                            k += column_stiffness(sheet, i + 1, b)
                        else:
                            k += diagonal_stiffness(sheet, i + 1, b + ti.static(min(right, 0)))
                        strain, motion = strains(sheet, p, p + down, b, right, right * dx, -down * dy)
                        measures[first + MIN_STRAIN] = ti.min(measures[first + MIN_STRAIN], strain)
                        measures[first + MAX_STRAIN] = ti.max(measures[first + MAX_STRAIN], strain)
                        stretch_sum += energy(k, tension, strain, *parameters)
                        if ti.static(tense_edges):
                            share = vector(1)
                            if ti.static(right != 0):
                                share = sheet.by_column[
                                    ti.static(HAS_LEFT if right < 0 else HAS_RIGHT) * sheet.width + b
                                ]
                            if ti.static(family == ALONG_ROW):
                                share = row_share(share, kind)
                            if ti.static(family == ALONG_COLUMN):
                                share = column_share(sheet, share, b)
                            motion = ti.select(share > 0, motion, vector(0)) * share
                        tension_sum += motion
                    measures[first + STRETCH_SUMS + family] += stretch_sum
                    if ti.static(tense):
                        measures[first + TENSION_SUMS + family] += tension_sum

        return (measure,)

    def stiffness_array(self, plan: Plan) -> NDArray[Any] | None:
        """Return the kernels' array of stiffnesses k - tau [N/m], shape (3 rows + 2, cols); None without a map.

        From top to bottom: springs along rows, shape (rows, cols); along columns and along diagonals, each of shape
        (rows + 1, cols), with a first and last row of 0. Springs beyond the last column are 0 as well.
        """
        material = plan.material
        if material.factors is None:
            return None
        pads = ((0, 0), (0, 1)), ((1, 1), (0, 0)), ((1, 1), (0, 1))
        unmapped = spring_stiffness(material, np.ones_like(material.factors))
        families = zip(spring_stiffness(material, material.factors), unmapped, pads, strict=True)
        return np.concatenate([np.pad(np.maximum(k - k1 * material.tension, 0), pad) for k, k1, pad in families])


def _unmapped_bound(material: Material) -> float:
    """Return `SpringTerm.stiffness_bound` for factors of 1 [N/m]."""
    across, down, shear = material.across, material.down, material.shear
    steepest = 1.0 if material.stiffening is None else material.stiffening.factor
    return steepest * 4 * max(across + down, across + 2 * shear, down + 2 * shear)


def spring_stiffness(material: Material, factors: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Assemble the stiffness k of every spring from the factors of its cells.

    Args:
        material: coefficients of the sheet.
        factors: factors of the map, shape (rows - 1, cols - 1).

    Returns:
        Stiffness [N/m] of springs along rows, shape (rows, cols - 1), along columns, shape (rows - 1, cols), and along
        both diagonals of a cell, shape (rows - 1, cols - 1).
    """
    above_and_below, left_and_right = np.pad(factors, ((1, 1), (0, 0))), np.pad(factors, ((0, 0), (1, 1)))
    across = material.across / 2 * (above_and_below[:-1] + above_and_below[1:])
    down = material.down / 2 * (left_and_right[:, :-1] + left_and_right[:, 1:])
    if not material.by_area:
        # In scenes with `springs`, springs at an edge are as stiff as all others.
        across[[0, -1]] *= 2
        down[:, [0, -1]] *= 2
    return across, down, material.shear * factors
