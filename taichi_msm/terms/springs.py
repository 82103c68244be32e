"""Springs between neighbouring mass points: along rows, along columns and along both diagonals of a cell.

Scene: `springs.structural`, `springs.shear` and `springs.map`, or `tissue.young`, `thickness`, `pretension` and `map`.

`terms.law` contains the force of a spring; a mass point P pulls its neighbour Q exactly as Q pulls P.

In tissue each cell of size dx by dy contributes to the springs along its edges and diagonals, with the map's factor f,

    along x     f E t (9/8 dy/dx - 3/8 dx/dy) / 2        along y: the same with x and y exchanged
    diagonals   f 3/16 E t (dx^2 + dy^2) / (dx dy)

so that the lattice approximates an isotropic sheet in plane stress. Springs imply Poisson's ratio 1/3; docs/model.md
contains the derivation.

Under a pretension S each spring has the tension tau L at rest, with tau = k1 e, its stiffness k1 for f = 1 and
e = S / (3/2 E t).
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

# Measures: the smallest and the largest (L^2 - L0^2) / L0^2; for each family the sum of (k - tau) (L / L0 - 1)^2; under
# tension, for each family the sum of |q|^2 / L0^2.
MIN_STRAIN, MAX_STRAIN, STRETCH_SUMS, TENSION_SUMS = 0, 1, 2, 5

# Constants: k - tau of each family, followed by tau of each family, and by the parameters of the law for each family.
FIRST_TENSION, FIRST_PARAMETER = 3, 6

# Prevents a division by 0 at L = 0, where the force then is 0. Literals in kernels are f32, which can represent it.
MIN_SQUARED_LENGTH = 1e-36


@dataclass(frozen=True)
class SpringTerm(Term):
    """Springs between neighbouring mass points."""

    has_gradient: ClassVar[bool] = True

    structural: bool  # whether the sheet has springs along rows and columns
    shear: bool  # whether the sheet has springs along diagonals
    open_edges: bool  # whether mass points at an edge can move; springs beyond the edge are then excluded
    by_area: bool  # whether springs along an open edge are softer, because they belong to one cell
    mapped: bool  # whether each stiffness is read from an array, with 0 for springs beyond an edge
    tense: bool  # whether the sheet is under tension at rest
    law: Law = LINEAR  # of the springs

    reach: ClassVar[int] = 1
    reductions: ClassVar[tuple[str, ...]] = ("min", "max", "sum", "sum", "sum", "sum", "sum", "sum")

    @property
    def tense_edges(self) -> bool:
        """Whether the sheet is under tension at rest, and mass points at an edge can move, because they are clamped."""
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
        """Return a bound of m w^2 [N/m], as long as no spring is shorter than half its rest length.

        Args:
            material: coefficients of the sheet.
            sheet: section `sheet` of the scene.

        The energy is a sum over cells. A spring of a cell has at most the energy k / 2 |q|^2. With a quarter of the
        mass of a mass point at each corner, every mode of a cell, and hence every mode of the sheet, satisfies

            m w^2 <= 4 max(across + down, across + 2 shear, down + 2 shear)

        With a map, the mass of each mass point is distributed over its cells in proportion to their stiffness. The
        bound is then multiplied by the largest mean of the factors around a mass point.
        """
        largest = 1.0
        if material.factors is not None:
            largest = largest_mean(material.factors) if material.by_area else float(material.factors.max())
        return _unmapped_bound(material) * largest

    @classmethod
    def node_stiffness_bounds(cls, plan: Plan) -> NDArray[Any] | float:
        """Bound the stiffness at each mass point [N/m], shape (rows, cols).

        Each cell contributes a quarter of its bound to each corner. Mass points at an edge of tissue have fewer cells;
        `springs` are not softer at an edge, so their bound uses the largest factor around the mass point.
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

    def build_parameters(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function that returns the parameters of the law for a family of springs, as a list."""
        ti, count, first = config.ti, self.law.parameter_count, config.first_constant(SpringTerm) + FIRST_PARAMETER

        @ti.func
        def parameters_of(sheet: ti.template(), family: ti.template()):
            return [sheet.constants[first + count * family + n] for n in ti.static(range(count))]

        return parameters_of

    def build_shares(self, config: KernelConfig) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """Build the Taichi functions for the argument `exists` of the force of a spring.

        Returns:
            share_of_row(exists, kind) and share_of_column(sheet, exists, b). In a sheet with `tense_edges` they return
            the share of the spring's cells that exist, because its tension is their sum; otherwise `exists`.
        """
        ti, real, tense_edges = config.ti, config.real, self.tense_edges

        @ti.func
        def share_of_row(exists, kind):
            if ti.static(tense_edges):
                return exists * ti.select(kind == 1, ti.cast(1, real), ti.cast(0.5, real))
            else:  # noqa: RET505
                return exists

        @ti.func
        def share_of_column(sheet: ti.template(), exists, b):
            if ti.static(tense_edges):
                return exists * sheet.by_column[(AREA_SHARE + 1) * sheet.width + b]
            else:  # noqa: RET505
                return exists

        return share_of_row, share_of_column

    def build_spring_forces(self, config: KernelConfig) -> tuple[Callable[..., Any], ...]:
        """Build the Taichi functions for the forces and stiffness of springs.

        Returns:
            along(sheet, right, u, k, exists), the force [N] of a mass point with displacement u on its right neighbour,
            entry `right` of u; to_other_row(sheet, entry, right, u, up, length, k, exists), that on `entry` of a row
            `up` [m] above and `right` columns to the right; and of_row(sheet, i, kind, b), of_column(sheet, lower, b)
            and of_diagonal(sheet, lower, b), the stiffness k - tau [N/m] of a spring of each family.
        """
        ti = config.ti
        tense, mapped, by_area = self.tense, self.mapped, self.by_area and not self.mapped
        open_edges, real, first = self.open_edges, config.real, config.first_constant(SpringTerm)
        tense_edges, vector = self.tense_edges, config.vector
        first_tension, parameters_of = first + FIRST_TENSION, self.build_parameters(config)
        pull = config.compile_law(self.law, tense=self.tense).pull

        @ti.func
        def masked(k, exists):
            if ti.static(tense_edges):
                return ti.select(exists > 0, k, vector(0))
            elif ti.static(open_edges):  # noqa: RET505
                return k * exists
            else:
                return k

        @ti.func
        def tension_of(sheet: ti.template(), family: ti.template(), exists):
            if ti.static(tense_edges):
                return sheet.constants[first_tension + family] * exists
            else:  # noqa: RET505
                return sheet.constants[first_tension + family]

        @ti.func
        def force(
            sheet: ti.template(), family: ti.template(), k, exists, square_difference, square, length,
            to: ti.template(), q: ti.template(),
        ):  # fmt: skip
            """Return the force of a spring of a family, for k - tau, 0 beyond an edge, L^2 - L0^2, L^2 and L0."""
            tension, parameters = tension_of(sheet, family, exists), parameters_of(sheet, family)
            share = pull(masked(k, exists), tension, square_difference, square, length, *parameters)
            total = [share * to[c] for c in ti.static(range(3))]
            if ti.static(tense):
                for c in ti.static(range(3)):
                    total[c] += tension * q[c]
            return total

        @ti.func
        def along(sheet: ti.template(), right, u: ti.template(), k, exists):
            """Return the force of a mass point displaced by `u` on its right neighbour, entry `right`."""
            dx = sheet.constants[DX]
            x, y, z = u[0] - sheet.u[0][right], u[1] - sheet.u[1][right], u[2] - sheet.u[2][right]
            to_x = x - dx
            rest = y * y + z * z
            square_difference = x * (to_x - dx) + rest
            square = to_x * to_x + (rest + MIN_SQUARED_LENGTH)
            return force(sheet, ALONG_ROW, k, exists, square_difference, square, dx, [to_x, y, z], [x, y, z])

        @ti.func
        def to_other_row(sheet: ti.template(), entry, right: ti.template(), u: ti.template(), up, length, k, exists):
            """Return the force of a mass point displaced by `u` on `entry`, `up` [m] above, `right` columns on."""
            x, y, z = u[0] - sheet.u[0][entry], u[1] - sheet.u[1][entry], u[2] - sheet.u[2][entry]
            to_x = x
            to_y = y - up
            rest = z * z
            square_difference = x * x + (y * (to_y - up) + rest)
            if ti.static(right != 0):
                to_x = x - right * sheet.constants[DX]
                square_difference = x * (to_x - right * sheet.constants[DX]) + (y * (to_y - up) + rest)
            square = to_x * to_x + to_y * to_y + (rest + MIN_SQUARED_LENGTH)
            family = ti.static(DIAGONAL if right else ALONG_COLUMN)
            return force(sheet, family, k, exists, square_difference, square, length, [to_x, to_y, z], [x, y, z])

        @ti.func
        def of_row(sheet: ti.template(), i, kind, b):
            """Return the stiffness of the spring to the right of entry b of row i; at an edge of tissue it is half."""
            if ti.static(mapped):
                return sheet.stiffness[i * sheet.width + b]
            elif ti.static(by_area):  # noqa: RET505  # Taichi would compile the rest as well.
                return sheet.constants[first + ALONG_ROW] * ti.select(kind == 1, ti.cast(1, real), ti.cast(0.5, real))
            else:
                return sheet.constants[first + ALONG_ROW]

        @ti.func
        def of_column(sheet: ti.template(), lower, b):
            """Return the stiffness of the spring between entry b of row `lower` and the row above."""
            if ti.static(mapped):
                return sheet.stiffness[(sheet.rows + lower) * sheet.width + b]
            elif ti.static(by_area):  # noqa: RET505
                return sheet.constants[first + ALONG_COLUMN] * sheet.by_column[(AREA_SHARE + 1) * sheet.width + b]
            else:
                return sheet.constants[first + ALONG_COLUMN]

        @ti.func
        def of_diagonal(sheet: ti.template(), lower, b):
            """Return the stiffness of the diagonals of the cell right of entry b, above row `lower`."""
            if ti.static(mapped):
                return sheet.stiffness[(2 * sheet.rows + 1 + lower) * sheet.width + b]
            else:  # noqa: RET505
                return sheet.constants[first + DIAGONAL]

        return along, to_other_row, of_row, of_column, of_diagonal

    def build_spring_tangent(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function that differentiates the force of a mass point P on its neighbour Q.

        If u_P - u_Q changes from q by p, the force changes by

            (k - tau) (s p + (1 - s) ((o + q) . p) (o + q) / L^2) + tau p,    s = 1 - L0 / L

        with a linear law. The map from p to this change is symmetric.
        """
        ti, tense, count, law = (
            config.ti,
            self.tense,
            self.law.parameter_count,
            config.compile_law(self.law, tense=self.tense),
        )
        derivatives, parameter_derivatives = law.derivatives, law.parameter_derivatives
        first_tension, parameters_of = config.first_constant(SpringTerm) + FIRST_TENSION, self.build_parameters(config)

        @ti.func
        def differentiate(
            sheet: ti.template(), family: ti.template(), q: ti.template(), p: ti.template(), x0, y0, length, k
        ):
            """Return the change of the force (3), and derivatives of its product with p.

            The derivatives are with respect to k - tau and tau, and for a law that locks to log(lock) and the factor.
            """
            to = [q[0] + x0, q[1] + y0, q[2]]
            square = to[0] * to[0] + to[1] * to[1] + (to[2] * to[2] + MIN_SQUARED_LENGTH)
            square_difference = q[0] * (to[0] + x0) + (q[1] * (to[1] + y0) + q[2] * q[2])
            along = to[0] * p[0] + to[1] * p[1] + to[2] * p[2]
            tension, parameters = sheet.constants[first_tension + family], parameters_of(sheet, family)
            isotropic, axial, by_k, by_tau = derivatives(
                k, tension, square_difference, square, length, along, *parameters
            )
            if ti.static(tense):
                isotropic += tension
            change = [isotropic * p[c] + axial * to[c] for c in ti.static(range(3))]
            product = q[0] * p[0] + q[1] * p[1] + q[2] * p[2] + by_tau * along
            if ti.static(count > 0):
                by_lock, by_factor = parameter_derivatives(k, tension, square_difference, square, length, *parameters)
                return [change[0], change[1], change[2], by_k * along, product, by_lock * along, by_factor * along]
            else:  # noqa: RET505
                return [change[0], change[1], change[2], by_k * along, product]

        return differentiate

    def build_max_spring_force(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function that squares the largest force of the springs to the right and below."""
        ti = config.ti
        structural, shear, vector = self.structural, self.shear, config.vector
        along, to_other_row, of_row, of_column, of_diagonal = self.build_spring_forces(config)
        share_of_row, share_of_column = self.build_shares(config)

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
                k, in_row = vector(0) + of_row(sheet, row.i, row.kind, b), share_of_row(has_right, row.kind)
                largest = larger(largest, along(sheet, at + 1, u, k * has_right, in_row))
            if lower < sheet.rows:
                if ti.static(structural):
                    k, in_column = vector(0) + of_column(sheet, lower, b), share_of_column(sheet, vector(1), b)
                    largest = larger(largest, to_other_row(sheet, below, 0, u, 0 - dy, dy, k, in_column))
                if ti.static(shear):
                    diagonal = ti.sqrt(dx * dx + dy * dy)
                    for right, exists in ti.static(((-1, has_left), (1, has_right))):
                        k = vector(0) + of_diagonal(sheet, lower, b + ti.static(min(right, 0)))
                        force = to_other_row(sheet, below + right, right, u, 0 - dy, diagonal, k * exists, exists)
                        largest = larger(largest, force)
            return largest

        return max_force

    def build_measures(self, config: KernelConfig) -> Sequence[Callable[..., None]]:
        ti = config.ti
        tense, open_edges, vector, first = self.tense, self.open_edges, config.vector, config.first_measure(SpringTerm)
        _, _, of_row, of_column, of_diagonal = self.build_spring_forces(config)
        share_of_row, share_of_column = self.build_shares(config)
        tense_edges = self.tense_edges
        first_tension, parameters_of = config.first_constant(SpringTerm) + FIRST_TENSION, self.build_parameters(config)
        energy = config.compile_law(self.law, tense=self.tense).energy
        # For each family: its index, and the offsets in rows and columns from one end to the other.
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
            share = (x * (x + 2 * x0) + (y * (y + 2 * y0) + z * z)) / square
            squared = (x * x + y * y + z * z) / square
            # Springs beyond the edge do not exist.
            if ti.static(open_edges and right != 0):
                side = ti.static(HAS_LEFT if right < 0 else HAS_RIGHT)
                share = ti.select(sheet.by_column[side * sheet.width + b] > 0, share, vector(0))
            return share, squared

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
                            k += of_row(sheet, i, kind, b)
                        elif ti.static(family == ALONG_COLUMN):
                            k += of_column(sheet, i + 1, b)
                        else:
                            k += of_diagonal(sheet, i + 1, b + ti.static(min(right, 0)))
                        share, squared = strains(sheet, p, p + down, b, right, right * dx, -down * dy)
                        measures[first + MIN_STRAIN] = ti.min(measures[first + MIN_STRAIN], share)
                        measures[first + MAX_STRAIN] = ti.max(measures[first + MAX_STRAIN], share)
                        stretch_sum += energy(k, tension, share, *parameters)
                        if ti.static(tense_edges):
                            cells = vector(1)
                            if ti.static(right != 0):
                                cells = sheet.by_column[
                                    ti.static(HAS_LEFT if right < 0 else HAS_RIGHT) * sheet.width + b
                                ]
                            if ti.static(family == ALONG_ROW):
                                cells = share_of_row(cells, kind)
                            if ti.static(family == ALONG_COLUMN):
                                cells = share_of_column(sheet, cells, b)
                            squared = ti.select(cells > 0, squared, vector(0)) * cells
                        tension_sum += squared
                    measures[first + STRETCH_SUMS + family] += stretch_sum
                    if ti.static(tense):
                        measures[first + TENSION_SUMS + family] += tension_sum

        return (measure,)

    def stiffness_array(self, plan: Plan) -> NDArray[Any] | None:
        """Return the kernels' array of stiffnesses k - tau [N/m], shape (3 rows + 2, cols); None without a map.

        Its parts are the springs along rows (one row per row of the sheet), along columns and along diagonals (rows + 1
        each). The first and the last row of the latter two, and entries beyond the last column, are 0.
        """
        material = plan.material
        if material.factors is None:
            return None
        pads = ((0, 0), (0, 1)), ((1, 1), (0, 0)), ((1, 1), (0, 1))
        unmapped = spring_stiffness(material, np.ones_like(material.factors))
        families = zip(spring_stiffness(material, material.factors), unmapped, pads, strict=True)
        return np.concatenate([np.pad(np.maximum(k - k1 * material.tension, 0), pad) for k, k1, pad in families])


def _unmapped_bound(material: Material) -> float:
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
