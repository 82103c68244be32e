"""Verlet's method: the update rule of a step, its stability limit, its order, and the force of a displacement.

The state of a mass point is its displacement u_n = x_n - X and the last difference d_n = u_n - u_{n-1}. A step is the
position form (eq. 6 to 9), rearranged to avoid cancellation: in f32 it resolves small displacements of a large sheet.

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}

F_n contains all forces but the damping -C v. With the step h, g = C / m, and central or backward differences of v,

    central:   keep = (1 - g h / 2) / (1 + g h / 2)    gain = h^2 / m / (1 + g h / 2)
    backward:  keep = 1 - g h                          gain = h^2 / m
    step 0:    d_0 = 0                                 gain = h^2 / m / 2

`solver.arrays.build_point_step` performs it in the kernels.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numpy.typing import NDArray

from taichi_msm.model.plan import Plan


class Coefficients(NamedTuple):
    """The coefficients of a step; complex numbers in a complex-step derivative."""

    keep: float  # factor of the last difference
    gain: float  # displacement per force [m/N]
    first_gain: float  # gain of step 0 [m/N]


def coefficients(plan: Plan) -> Coefficients:
    """Return the coefficients of the steps of a plan."""
    material, h = plan.material, plan.grid.step
    g, undamped = material.drag, h * h / material.mass
    if plan.scene.time.damping_difference == "central":
        return Coefficients((1 - g * h / 2) / (1 + g * h / 2), undamped / (1 + g * h / 2), undamped / 2)
    return Coefficients(1 - g * h, undamped, undamped / 2)


def mean_force(plan: Plan, displacement: NDArray[Any], steps: int) -> NDArray[Any]:
    """Return the mean contact force of some steps [N], from the sum of the displacements that contact added [m].

    It is m (1 + g h / 2) / h^2 times the added displacement per step, or m / h^2 with backward differences.
    """
    return displacement / (coefficients(plan).gain * steps)


def stability_limit(frequency: float, drag: float, difference: str) -> float:
    """Return the largest stable step [s]; infinite without stiffness and damping.

    For the highest angular frequency w [rad/s] it is 2 / w for central differences of the damping, and (sqrt(g^2 + 4
    w^2) - g) / w^2 for backward ones, with g = C / m [1/s], which the code rearranges to avoid cancellation.
    """
    g = drag if difference == "backward" else 0.0
    limit = math.hypot(g, 2 * frequency) + g
    return 4 / limit if limit > 0 else math.inf


def convergence_order(plan: Plan) -> int:
    """Return the order of the method: 1 with damping by backward differences or with contact, else 2."""
    backward = plan.scene.time.damping_difference == "backward" and plan.material.drag > 0
    return 1 if backward or plan.has_contact else 2
