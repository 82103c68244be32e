"""The elastic (Winkler) foundation, or virtual springs: the force -K u pulls each mass point to its rest position.

Scene: `springs.virtual` and `virtual_active`, or `tissue.foundation`, `foundation_active` and `foundation_map`.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Material, area_shares, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.terms.base import AREA_SHARE, KernelConfig, Term


@dataclass(frozen=True)
class FoundationTerm(Term):
    """Virtual springs. Their energy is not measured; `accuracy.divergence` bounds it."""

    by_area: bool  # whether K is smaller at an open edge, because mass points have less area there
    mapped: bool  # whether the factor of K at each mass point is read from a field

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        """Derive K [N/m], 0 if the foundation is never active, and whether it is always active."""
        if scene.tissue is not None:
            k = scene.tissue.foundation_stiffness * math.prod(spacing(scene.sheet))
            active = scene.tissue.foundation_active
        else:
            assert scene.springs is not None
            k, active = scene.springs.virtual, scene.springs.virtual_active
        always = active == "always"
        return {"virtual": k if always or scene.probes else 0.0, "always_active": always}

    @classmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        """Return the term's configuration; None if the foundation is never active."""
        material = plan.material
        mapped = material.virtual_factors is not None
        return cls(plan.open_edges and material.by_area and not mapped, mapped) if material.virtual > 0 else None

    @staticmethod
    def stiffness_bound(material: Material, sheet: Sheet) -> float:
        """Return the largest K [N/m]."""
        factors = material.virtual_factors
        return material.virtual if factors is None else material.virtual * float(factors.max())

    @classmethod
    def node_stiffness_bounds(cls, plan: Plan) -> NDArray[Any] | float:
        """Return K at each mass point without the reduction at edges [N/m]."""
        factors = plan.material.virtual_factors
        return plan.material.virtual * (1.0 if factors is None else factors)

    @property
    def column_count(self) -> int:
        """One column: K times its active share."""
        return 1

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        """Return K times its active share at every step [N/m], shape (steps, 1)."""
        return plan.material.virtual * loads.active[:, None]

    @property
    def field_count(self) -> int:
        """One field if the foundation has a map."""
        return int(self.mapped)

    def fields(self, plan: Plan) -> NDArray[Any]:
        """Return the factors of K at the mass points, shape (1, rows, cols)."""
        return point_shares(plan)[None] if self.mapped else super().fields(plan)

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Build the function that adds -K u."""
        ti = config.ti
        by_area, mapped, column = self.by_area, self.mapped, config.first_column(FoundationTerm)
        field = config.first_field(FoundationTerm)

        @ti.func
        def add(force: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            if ti.static(mapped):
                stiffness = now[column] * sheet.fields[(field * sheet.rows + entry.row.i) * sheet.width + entry.b]
                for c in ti.static(range(3)):
                    force[c] = force[c] - stiffness * entry.u[c]
            elif ti.static(by_area):
                stiffness = now[column] * sheet.by_column[(AREA_SHARE + entry.row.kind) * sheet.width + entry.b]
                for c in ti.static(range(3)):
                    force[c] = force[c] - stiffness * entry.u[c]
            else:
                for c in ti.static(range(3)):
                    force[c] = force[c] - now[column] * entry.u[c]

        return (add,)

    def build_tangents(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        """Return `build_forces`, because the force is linear in the displacements."""
        return self.build_forces(config)


def point_shares(plan: Plan) -> NDArray[Any]:
    """Return the factor of K at each mass point, map times share of a cell's area, shape (rows, cols)."""
    material = plan.material
    shares = area_shares(plan.scene.sheet) if material.by_area else np.ones(plan.fixed.shape)
    return shares if material.virtual_factors is None else material.virtual_factors * shares
