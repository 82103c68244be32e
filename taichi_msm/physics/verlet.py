"""The coefficients of a Stoermer-Verlet step."""

from __future__ import annotations

from typing import Literal, NamedTuple

from taichi_msm.physics.material import Material


class Coefficients(NamedTuple):
    """d_{n+1} = keep d_n + gain F_n,  u_{n+1} = u_n + d_{n+1}; at the start d_1 = first_gain F_0 (eq. 6 to 9).

    Attributes:
        keep: factor by which the damping reduces the last difference.
        gain: displacement per force in one step [m/N].
        first_gain: the same for the first step, which starts at rest [m/N].
    """

    keep: float
    gain: float
    first_gain: float


def coefficients(made: Material, h: float, difference: Literal["central", "backward"]) -> Coefficients:
    """Compute the coefficients of a step.

    With g = C / m, keep is (1 - g h / 2) / (1 + g h / 2) for central differences, and 1 - g h for backward ones.

    Args:
        made: of the sheet; only mass and drag are used.
        h: the step [s].
        difference: finite difference that stands for the velocity in the damping.
    """
    g, whole = made.drag, h * h / made.mass
    if difference == "central":
        return Coefficients((1 - g * h / 2) / (1 + g * h / 2), whole / (1 + g * h / 2), whole / 2)
    return Coefficients(1 - g * h, whole, whole / 2)
