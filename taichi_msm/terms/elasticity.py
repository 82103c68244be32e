"""The springs of a sheet as float64 arrays with their energies and tangents, for SciPy and exports."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.arithmetic import NUMPY, Array
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.terms.law import SpringFunctions, build_spring
from taichi_msm.terms.springs import Window, assemble_springs, spring_ends


class Elongation(NamedTuple):
    """The elongation of each spring of a family; arrays have the shape (...) of the springs."""

    difference: Array  # displacement of the end minus that of the start, q [m], shape (..., 3)
    edge: Array  # vector from start to end [m], shape (..., 3)
    square_difference: Array  # L^2 - L0^2 [m2], shape (...)
    square: Array  # L^2 [m2], shape (...)


class SpringFamily(NamedTuple):
    """All springs with the same offset between their ends."""

    start: Window  # slices of the mass points at the start of each spring
    end: Window  # slices of the mass points at the end, below or to the right of the start
    offset: Array  # vector from start to end at rest [m], shape (..., 3)
    length: Array  # at rest [m], shape (...)
    stiffness: Array  # k - tau of each spring [N/m], shape (...) as selected by `start`
    tension: Array  # tau of each spring, its tension at rest divided by its length [N/m], shape (...)
    functions: SpringFunctions
    numbers: tuple[Any, ...]  # `LawNumbers.constants` of each spring; () without a law

    def elongation(self, displacement: Array) -> Elongation:
        """Compute the elongation of each spring; displacement: x - X [m], shape (rows, cols, 3)."""
        q = displacement[self.end] - displacement[self.start]
        edges = q + self.offset
        return Elongation(q, edges, (q * (edges + self.offset)).sum(axis=-1), (edges**2).sum(axis=-1))

    def tangent(self, displacement: Array) -> Array:
        """Differentiate each spring's force with respect to the position of an end [N/m], shape (..., 3, 3)."""
        _, edges, square_difference, square = self.elongation(displacement)
        isotropic, axial, *_ = self.derivatives(square_difference, square, 1.0)
        along = axial[..., None, None] * edges[..., :, None] * edges[..., None, :]
        return (isotropic + self.tension)[..., None, None] * np.eye(3) + along

    def derivatives(self, square_difference: Array, square: Array, along: Array | float) -> tuple[Any, ...]:
        """Return `SpringFunctions.derivatives` for each spring, shape (...) each; `along` is (o + q) . p [m2]."""
        return self.functions.derivatives(
            self.stiffness, self.tension, square_difference, square, self.length, along, self.numbers
        )

    def energy(self, displacement: Array) -> Array:
        """Compute the energy of each spring above that at rest [J], shape (...).

        The part that is linear in the displacement is left out. Its sum over all springs is 0, because the sheet is in
        equilibrium at rest.
        """
        q, _, square_difference, _ = self.elongation(displacement)
        square_strain = square_difference / self.length**2
        stretched = self.functions.energy(self.stiffness, self.tension, square_strain, self.numbers)
        return (stretched * self.length**2 + self.tension * (q**2).sum(axis=-1)) / 2


def spring_families(plan: Plan) -> Iterator[SpringFamily]:
    """Build the families of springs along rows, along columns and along both diagonals."""
    material, sheet = plan.material, plan.scene.sheet
    springs, law = assemble_springs(material, sheet), material.stiffening
    functions = build_spring(law.law if law else None, NUMPY)
    rest = rest_of(sheet).position if springs.rest is None else springs.rest
    for k, tension, (start, end) in zip(springs.stiffness, springs.tension, spring_ends(sheet.points), strict=True):
        offset = rest[end] - rest[start]
        length = np.sqrt((offset**2).sum(axis=-1))
        length[length == 0] = 1.0  # of cells without sheet; they have no stiffness
        numbers = law.constants(length) if law else ()
        yield SpringFamily(start, end, offset, length, k - tension, tension, functions, numbers)


def energy_density(plan: Plan, displacement: Array) -> Array:
    """Return the energy density of the springs [J/m2], shape (rows, cols), without bending and foundation.

    Each end of a spring has half of its energy. The sum of density times `area_shares` times the area of a cell is
    therefore the energy of all springs, relative to the state at rest. The displacement x - X [m] has the shape (rows,
    cols, 3). Points without sheet have the density 0.
    """
    by_point, areas = np.zeros(displacement.shape[:2]), rest_of(plan.scene.sheet).cell_area * plan.area_shares
    for family in spring_families(plan):
        energy = family.energy(displacement)
        by_point[family.start] += energy / 2
        by_point[family.end] += energy / 2
    return by_point / np.where(areas > 0, areas, 1.0)
