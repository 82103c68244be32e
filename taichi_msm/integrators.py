"""Integrators: the update rule of a step, its stability limit and its order.

The state of a mass point is its displacement u_n = x_n - X and the last difference d_n = u_n - u_{n-1}. A step is the
position form (eq. 6 to 9), rearranged to avoid cancellation: in f32 it resolves small displacements of a large sheet.

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}

F_n contains all forces but the damping -C v. Verlet's method, with the step h, g = C / m, and central or backward
differences of v:

    central:   keep = (1 - g h / 2) / (1 + g h / 2)    gain = h^2 / m / (1 + g h / 2)
    backward:  keep = 1 - g h                          gain = h^2 / m
    step 0:    d_0 = 0                                 gain = h^2 / m / 2

`solver.arrays.build_point_step` performs it in the kernels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple


class Coefficients(NamedTuple):
    """The coefficients of a step; complex numbers in a complex-step derivative."""

    keep: float  # factor of the last difference
    gain: float  # displacement per force [m/N]
    first_gain: float  # gain of step 0 [m/N]


class Integrator(NamedTuple):
    """An integrator, for mass m of a point [kg], g = C / m [1/s], step h [s] and highest frequency w [rad/s]."""

    meaning: str  # for users
    coefficients: Callable[[float, float, float], Coefficients]  # of m, g and h; m and g may be complex
    largest_step: Callable[[float, float], float]  # of w and g; stable [s], infinite without stiffness and damping
    order: Callable[[float], int]  # of g; order of the method without contact
    # Largest g h in a stable step with which velocities keep their sign; infinite if they do in every stable step.
    resolved_damping: float = math.inf


def _central(m: float, g: float, h: float) -> Coefficients:
    undamped = h * h / m
    return Coefficients((1 - g * h / 2) / (1 + g * h / 2), undamped / (1 + g * h / 2), undamped / 2)


def _backward(m: float, g: float, h: float) -> Coefficients:
    undamped = h * h / m
    return Coefficients(1 - g * h, undamped, undamped / 2)


def stability_limit(frequency: float, g: float = 0.0) -> float:
    """Return Verlet's largest stable step (sqrt(g^2 + 4 w^2) - g) / w^2 [s], without cancellation.

    w is the frequency [rad/s]; g is C / m [1/s] of backward differences of the damping, 0 for central ones.
    """
    limit = math.hypot(g, 2 * frequency) + g
    return 4 / limit if limit > 0 else math.inf


# By the values of `time.damping_difference`.
INTEGRATORS = {
    "central": Integrator("of order 2", _central, lambda w, _: stability_limit(w), lambda _: 2, 2.0),
    "backward": Integrator("the paper's eq. 3, of order 1", _backward, stability_limit, lambda g: 1 if g > 0 else 2),
}
