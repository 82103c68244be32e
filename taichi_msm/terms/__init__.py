"""The terms of the model, a file each: what its keys mean, its force, its energy and its bound of the step.

docs/architecture.md tells how to add one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Maps, Material, cell_factors, point_factors, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.terms.base import Term
from taichi_msm.terms.bending import BendingTerm
from taichi_msm.terms.contact import ContactTerm
from taichi_msm.terms.damping import DampingTerm
from taichi_msm.terms.foundation import FoundationTerm
from taichi_msm.terms.loads import ProbeTerm
from taichi_msm.terms.springs import SpringTerm

# All terms. What they contribute is added up in this order, on which the last bits depend.
TERMS: tuple[type[Term], ...] = (SpringTerm, FoundationTerm, DampingTerm, BendingTerm, ProbeTerm, ContactTerm)


def derive_material(scene: Scene, maps: Maps) -> Material:
    """Derive the material."""
    (dx, dy), mass = spacing(scene.sheet), scene.sheet.mass
    there = {name: (one, maps[name], scene.sheet) for name, one in scene.maps.items() if name in maps}
    if scene.tissue is not None:
        mass = (scene.tissue.density or 0.0) * scene.tissue.thickness * (dx * dy)
    if scene.time.at_rest:
        mass = 1.0  # Any will do.
    assert mass is not None
    derived: dict[str, Any] = {name: value for term in TERMS for name, value in term.derive(scene).items()}
    return Material(
        mass=mass,
        by_area=scene.tissue is not None,
        factors=cell_factors(*there["map"]) if "map" in there else None,
        virtual_factors=point_factors(*there["foundation_map"]) if "foundation_map" in there else None,
        **derived,
    )


def build_terms(plan: Plan) -> tuple[Term, ...]:
    """List the terms that a scene has."""
    return tuple(term for kind in TERMS if (term := kind.from_plan(plan)) is not None)


def fictitious_masses(plan: Plan) -> NDArray[np.float64]:
    """Give every point a mass with which no frequency is above 1 [N/m]: so much stiffness it feels, (rows, cols)."""
    return np.sum([np.broadcast_to(term.node_stiffness_bounds(plan), plan.fixed.shape) for term in TERMS], axis=0)


def highest_frequency(material: Material, sheet: Sheet) -> float:
    """Bound the highest angular frequency of the sheet [rad/s] in any shape without springs below half their length."""
    return math.sqrt(sum(term.stiffness_bound(material, sheet) for term in TERMS) / material.mass)
