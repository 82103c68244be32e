"""Damping: the force -C v on every mass point. Scene: `damping`, or `tissue.damping`.

In a Verlet step, d_{n+1} = keep d_n + gain F_n and u_{n+1} = u_n + d_{n+1} (eq. 6 to 9), with g = C / m and the step h,

    central:   keep = (1 - g h / 2) / (1 + g h / 2)    gain = h^2 / m / (1 + g h / 2)
    backward:  keep = 1 - g h                          gain = h^2 / m
    step 0:    d_0 = 0                                 gain = h^2 / m / 2
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import Self

from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene
from taichi_msm.terms.base import KernelConfig, Term


def coefficients(plan: Plan) -> tuple[float, float, float]:
    """Return keep, the gain [m/N] and the gain of step 0 [m/N], for central or backward differences."""
    material, h = plan.material, plan.grid.step
    g, undamped = material.drag, h * h / material.mass
    if plan.scene.time.damping_difference == "central":
        return (1 - g * h / 2) / (1 + g * h / 2), undamped / (1 + g * h / 2), undamped / 2
    return 1 - g * h, undamped, undamped / 2


@dataclass(frozen=True)
class DampingTerm(Term):
    """Damping. It stores no energy; `planning.stable_step` includes its effect on the stable step."""

    constant_count: ClassVar[int] = 1

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        """Derive C / m [1/s], 0 in quasi-static scenes."""
        if scene.time.at_rest:
            return {"drag": 0.0}
        if scene.tissue is not None:
            return {"drag": scene.tissue.damping}
        assert scene.sheet.mass is not None
        return {"drag": scene.damping / scene.sheet.mass}

    @classmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        """Return the term's configuration; None without damping."""
        return cls() if plan.material.drag > 0 else None

    def constants(self, plan: Plan) -> tuple[float, ...]:
        """Return the factor `keep`."""
        return coefficients(plan)[:1]

    def build_damping(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Build the function that multiplies the last difference by `keep`."""
        ti, keep = config.ti, config.first_constant(DampingTerm)

        @ti.func
        def reduce(d: ti.template(), sheet: ti.template()):
            for c in ti.static(range(3)):
                d[c] *= sheet.constants[keep]

        return (reduce,)
