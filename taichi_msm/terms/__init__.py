"""The terms of the model, one per file: coefficients, force, energy, tangent and bound of the stable step.

docs/architecture.md describes how to add a term.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import Maps, Material, cell_factors, point_areas, point_factors
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.terms.base import Term
from taichi_msm.terms.bending import BendingTerm
from taichi_msm.terms.contact import ContactTerm
from taichi_msm.terms.damping import DampingTerm
from taichi_msm.terms.foundation import FoundationTerm
from taichi_msm.terms.loads import ProbeTerm
from taichi_msm.terms.springs import SpringTerm, assemble_springs, curved_springs
from taichi_msm.terms.viscoelasticity import ViscoelasticTerm

# All terms, in the order of summation, on which the last bits of results depend.
TERMS: tuple[type[Term], ...] = (
    SpringTerm,
    FoundationTerm,
    DampingTerm,
    BendingTerm,
    ViscoelasticTerm,
    ProbeTerm,
    ContactTerm,
)


def derive_material(scene: Scene, maps: Maps) -> Material:
    """Derive the coefficients of a sheet; without `maps`, images by key, its stiffness maps are ignored.

    The scene has no `material_key_problems`.
    """
    rest, mass = rest_of(scene.sheet), scene.sheet.mass
    samplers = {"map": cell_factors, "foundation_map": point_factors}
    factors = {key: samplers[key](scene.maps[key], maps[key], scene.sheet) for key in scene.maps.keys() & maps.keys()}
    if scene.tissue is not None:
        mass = (scene.tissue.density or 0.0) * scene.tissue.thickness * rest.cell_area
    if scene.time.at_rest:
        mass = 1.0  # Static equilibrium does not depend on it.
    assert mass is not None
    derived: dict[str, Any] = {name: value for term in TERMS for name, value in term.derive(scene).items()}
    material = Material(
        mass=mass,
        by_area=scene.tissue is not None,
        factors=factors.get("map"),
        virtual_factors=factors.get("foundation_map"),
        **derived,
    )
    if isinstance(rest, CurvedRest):
        membrane = scene.tissue.young * scene.tissue.thickness if scene.tissue else 0.0
        springs = curved_springs(material, scene.sheet, rest, membrane)
        return replace(material, springs=springs, shares=rest.areas / rest.cell_area)
    if rest.mask is not None:
        return replace(material, springs=assemble_springs(material, scene.sheet), shares=rest.mask.cell_counts / 4)
    return material


def build_terms(plan: Plan) -> tuple[Term, ...]:
    """Build the terms of a scene."""
    return tuple(term for kind in TERMS if (term := kind.from_plan(plan)) is not None)


def memory_names(plan: Plan) -> tuple[str, ...]:
    """Return the names of the state variables that the terms of a scene add to every mass point."""
    return tuple(name for term in build_terms(plan) for name in term.memory)


def fictitious_masses(material: Material, sheet: Sheet) -> NDArray[np.float64]:
    """Compute fictitious masses of the mass points, shape (rows, cols) [N/m].

    In their dimensionless time every angular frequency of the sheet is at most 1. Points without sheet have mass 0.
    """
    bounds = [np.broadcast_to(term.node_stiffness_bounds(material, sheet), sheet.points) for term in TERMS]
    return np.asarray(np.sum(bounds, axis=0))


def highest_frequency(material: Material, sheet: Sheet) -> float:
    """Return an upper bound of the angular frequencies [rad/s], valid while springs exceed half their rest length."""
    if material.shares is None and material.springs is None:
        return math.sqrt(sum(term.stiffness_bound(material, sheet) for term in TERMS) / material.mass)
    shares = point_areas(material, sheet) if material.by_area else np.ones(sheet.points)
    present = shares > 0
    return math.sqrt(float((fictitious_masses(material, sheet)[present] / shares[present]).max()) / material.mass)
