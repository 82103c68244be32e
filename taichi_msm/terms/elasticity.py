"""The springs of a sheet as arrays in float64, with their forces and energies: for SciPy and for exports."""

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
    """All springs with the same number of points down and to the right between their ends."""

    # here, there: select the points at their ends; `there` is down or to the right of `here`
    start: Window
    end: Window
    offset: Array  # vector from here to there at rest [m], x right, y up, z
    length: float  # at rest [m]
    stiffness: Array  # k of each [N/m], shape as selected by `here`
    unstretched_length: Array  # length at which each has no force [m]; shorter than `length` under tension

    def edge_vectors(self, displacement: Array) -> tuple[Array, Array]:
        """Give the vectors from one end of each spring to the other, and their lengths [m]."""
        between = displacement[self.end] - displacement[self.start] + self.offset
        return between, np.linalg.norm(between, axis=-1)

    def tangent(self, displacement: Array) -> Array:
        """Give how the forces change as an end moves [N/m], symmetric, shape (..., 3, 3): see `terms.springs`."""
        between, length = self.edge_vectors(displacement)
        unit, slack = between / length[..., None], self.unstretched_length / length
        straight = self.stiffness * (1 - slack)
        return straight[..., None, None] * np.eye(3) + (self.stiffness * slack)[..., None, None] * (
            unit[..., :, None] * unit[..., None, :]
        )


def spring_families(plan: Plan) -> Iterator[SpringFamily]:
    """List the springs along rows, along columns and along both diagonals, each spring once."""
    (rows, cols), (dx, dy), sheet = plan.scene.sheet.points, spacing(plan.scene.sheet), plan.material
    factors = np.ones((rows - 1, cols - 1)) if sheet.factors is None else sheet.factors
    across, down_columns, shear = spring_stiffness(sheet, factors)
    # Under tension a spring pulls at rest as if there were no map; at edges half as strongly, like its stiffness.
    shares = (np.where(np.isin(np.arange(count), (0, count - 1)), 0.5, 1.0) for count in (rows, cols))
    of_rows, of_columns = np.ix_(*shares) if sheet.by_area else (1.0, 1.0)
    for down, right, own, unmapped in (
        (0, 1, across, sheet.across * of_rows),
        (1, 0, down_columns, sheet.down * of_columns),
        (1, 1, shear, sheet.shear),
        (1, -1, shear, sheet.shear),
    ):
        here = slice(0, rows - down), slice(max(0, -right), cols - max(0, right))
        there = slice(down, rows), slice(max(0, right), cols - max(0, -right))
        length = math.hypot(right * dx, down * dy)
        pull = np.broadcast_to(sheet.tension * unmapped * length, own.shape)
        shorter = np.divide(pull, own, out=np.zeros_like(own), where=own > 0)
        yield SpringFamily(here, there, np.array([right * dx, -down * dy, 0.0]), length, own, length - shorter)


def elastic_force(every: Sequence[SpringFamily], displacement: Array) -> Array:
    """Sum k (L - L0) (Q - P) / L over the neighbours Q of every point P (eq. 2), without the part that cancels at rest.

    Displacement x - X [m] and force [N] have shape (rows, cols, 3).
    """
    force = np.zeros_like(displacement)
    for family in every:
        between, length = family.edge_vectors(displacement)
        pull = np.divide(length - family.unstretched_length, length, out=np.zeros_like(length), where=length > 0)
        at_rest = family.stiffness * (family.length - family.unstretched_length) / family.length
        forward = (family.stiffness * pull)[..., None] * between - at_rest[..., None] * family.offset
        force[family.start] += forward
        force[family.end] -= forward
    return force


def energy_density(plan: Plan, displacement: Array) -> Array:
    """Give the elastic energy of springs above that at rest, per area, without bending and the virtual springs.

    Each end of a spring gets half of its energy, and a point has the share of the sheet's area at rest that
    `area_shares` gives it, so that the sum of density times area is the energy of all springs.

    Returns:
        Energy per area at rest [J/m2], shape (rows, cols), for displacements x - X [m], shape (rows, cols, 3).
    """
    at_points, (dx, dy) = np.zeros(displacement.shape[:2]), spacing(plan.scene.sheet)
    for family in spring_families(plan):
        between, length = family.edge_vectors(displacement)
        rest = family.length - family.unstretched_length
        # The part that is linear in the displacements cancels in the sum, as the sheet is in equilibrium at rest.
        linear = (between - family.offset) @ family.offset * rest / family.length
        energy = family.stiffness * ((length - family.unstretched_length) ** 2 / 2 - rest**2 / 2 - linear)
        at_points[family.start] += energy / 2
        at_points[family.end] += energy / 2
    return at_points / (dx * dy * area_shares(plan.scene.sheet))
