"""The coefficients of Stoermer and Verlet's steps."""

from __future__ import annotations

from typing import Literal, NamedTuple

from taichi_msm.physics.material import Material


class Coefficients(NamedTuple):
    """d_{n+1} = keep d_n + gain F_n,  u_{n+1} = u_n + d_{n+1}; at the start d_1 = first_gain F_0 (eq. 6 to 9).

    Attributes:
        keep: share of the difference that the damping leaves.
        gain: [m/N].
        first_gain: [m/N], of the step from rest.
    """

    keep: float
    gain: float
    first_gain: float


def coefficients(made: Material, h: float, difference: Literal["central", "backward"]) -> Coefficients:
    """Find the coefficients of a step.

    With g = C / m, the damping by central differences takes (1 - g h / 2) / (1 + g h / 2) of a difference, and by
    backward ones 1 - g h.

    Args:
        made: of the sheet; its mass and drag count.
        h: the step [s].
        difference: that stands for the velocity in the damping.
    """
    g, whole = made.drag, h * h / made.mass
    if difference == "central":
        return Coefficients((1 - g * h / 2) / (1 + g * h / 2), whole / (1 + g * h / 2), whole / 2)
    return Coefficients(1 - g * h, whole, whole / 2)
