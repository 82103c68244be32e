"""Damping: the force -C v on every mass point, part of the update rule (`integrators`).

Scene: `damping`, or `tissue.damping`.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import Self

from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene
from taichi_msm.terms.base import KernelConfig, Term
from taichi_msm.terms.places import Places


@dataclass(frozen=True)
class DampingTerm(Term):
    """Damping. It stores no energy; an integrator includes its effect on the stable step."""

    has_gradient: ClassVar[bool] = True

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
        return cls() if plan.material.drag > 0 else None

    @property
    def constant_places(self) -> Places:
        return Places(keep=1)

    def constants(self, plan: Plan) -> tuple[float, ...]:
        return (plan.step_coefficients.keep,)

    def build_damping(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        ti, keep = config.ti, config.constants(DampingTerm).keep

        @ti.func
        def reduce(d: ti.template(), sheet: ti.template()):
            for c in ti.static(range(3)):
                d[c] *= sheet.constants[keep]

        return (reduce,)
