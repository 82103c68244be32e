"""The springs of a sheet as float64 arrays with their forces, energies and tangents, for SciPy and exports."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import area_shares, spacing
from taichi_msm.terms.springs import spring_stiffness

Array = NDArray[np.float64]
Window = tuple[slice, slice]


class SpringFamily(NamedTuple):
    """All springs with the same offset between their ends."""

    # start, end: slices of the mass points at both ends; `end` is below or to the right of `start`
    start: Window
    end: Window
    offset: Array  # vector from start to end at rest [m], shape (3,)
    length: float  # at rest [m]
    stiffness: Array  # k of each spring [N/m], shape as selected by `start`
    unstretched_length: Array  # length without force [m], as selected by `start`; below `length` under tension

    def edge_vectors(self, displacement: Array) -> tuple[Array, Array]:
        """Return the vectors from start to end of each spring and their lengths [m]."""
        edges = displacement[self.end] - displacement[self.start] + self.offset
        return edges, np.linalg.norm(edges, axis=-1)

    def tangent(self, displacement: Array) -> Array:
        """Return the symmetric derivative of each spring's force by the position of an end [N/m], shape (..., 3, 3)."""
        edges, length = self.edge_vectors(displacement)
        unit, length_ratio = edges / length[..., None], self.unstretched_length / length
        transverse = self.stiffness * (1 - length_ratio)
        return transverse[..., None, None] * np.eye(3) + (self.stiffness * length_ratio)[..., None, None] * (
            unit[..., :, None] * unit[..., None, :]
        )


def spring_families(plan: Plan) -> Iterator[SpringFamily]:
    """Build the families of springs along rows, along columns and along both diagonals."""
    (rows, cols), (dx, dy), material = plan.scene.sheet.points, spacing(plan.scene.sheet), plan.material
    factors = np.ones((rows - 1, cols - 1)) if material.factors is None else material.factors
    along_rows, along_columns, diagonals = spring_stiffness(material, factors)
    # The tension of a spring at rest does not depend on the map; at an edge of tissue it is half, like the stiffness.
    shares = (np.where(np.isin(np.arange(count), (0, count - 1)), 0.5, 1.0) for count in (rows, cols))
    row_shares, column_shares = np.ix_(*shares) if material.by_area else (1.0, 1.0)
    for down, right, stiffness, unmapped in (
        (0, 1, along_rows, material.across * row_shares),
        (1, 0, along_columns, material.down * column_shares),
        (1, 1, diagonals, material.shear),
        (1, -1, diagonals, material.shear),
    ):
        start = slice(0, rows - down), slice(max(0, -right), cols - max(0, right))
        end = slice(down, rows), slice(max(0, right), cols - max(0, -right))
        length = math.hypot(right * dx, down * dy)
        tension = np.broadcast_to(material.tension * unmapped * length, stiffness.shape)
        stretch = np.divide(tension, stiffness, out=np.zeros_like(stiffness), where=stiffness > 0)
        offset = np.array([right * dx, -down * dy, 0.0])
        yield SpringFamily(start, end, offset, length, stiffness, length - stretch)


def elastic_force(families: Sequence[SpringFamily], displacement: Array) -> Array:
    """Sum k (L - L0) (Q - P) / L over the neighbours Q of every mass point P (eq. 2), without the tension at rest.

    Args:
        families: all springs, from `spring_families`.
        displacement: x - X [m], shape (rows, cols, 3).

    Returns:
        Force on every mass point [N], shape (rows, cols, 3).
    """
    force = np.zeros_like(displacement)
    for family in families:
        edges, length = family.edge_vectors(displacement)
        stretch = np.divide(length - family.unstretched_length, length, out=np.zeros_like(length), where=length > 0)
        rest_tension = family.stiffness * (family.length - family.unstretched_length) / family.length
        forward = (family.stiffness * stretch)[..., None] * edges - rest_tension[..., None] * family.offset
        force[family.start] += forward
        force[family.end] -= forward
    return force


def energy_density(plan: Plan, displacement: Array) -> Array:
    """Compute the energy density of the springs relative to the state at rest, without bending and foundation.

    Each end of a spring has half of its energy. The sum of density times `area_shares` times the area of a cell is
    therefore the energy of all springs.

    Args:
        plan: the plan.
        displacement: x - X [m], shape (rows, cols, 3).

    Returns:
        Energy per area at rest [J/m2], shape (rows, cols).
    """
    by_point, (dx, dy) = np.zeros(displacement.shape[:2]), spacing(plan.scene.sheet)
    for family in spring_families(plan):
        edges, length = family.edge_vectors(displacement)
        rest_stretch = family.length - family.unstretched_length
        # The linear part cancels in the sum over all springs, because the sheet is in equilibrium at rest.
        linear = (edges - family.offset) @ family.offset * rest_stretch / family.length
        energy = family.stiffness * ((length - family.unstretched_length) ** 2 / 2 - rest_stretch**2 / 2 - linear)
        by_point[family.start] += energy / 2
        by_point[family.end] += energy / 2
    return by_point / (dx * dy * area_shares(plan.scene.sheet))
