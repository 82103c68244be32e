"""The elastic (Winkler) foundation, or virtual springs: the force -K u pulls each mass point to its rest position.

A foundation that locks resists the depth w = -u . N > 0, along the normal N at rest, by K f(w) instead of K w, see
`terms.law`. On a flat sheet w = -u_z.

Scene: `springs.virtual` and `virtual_active`, or `tissue.foundation`, `foundation_active` and `foundation_map`.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.arithmetic import NUMPY, Array
from taichi_msm.laws import law_of
from taichi_msm.laws.law import Law, LawNumbers
from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import heights, rest_normals, rest_of
from taichi_msm.model.sheet import Material
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.terms.base import KernelConfig, Term
from taichi_msm.terms.law import build_law, law_places
from taichi_msm.terms.places import Places
from taichi_msm.terms.points import build_point_functions


@dataclass(frozen=True)
class FoundationTerm(Term):
    """Virtual springs. Their energy is not measured; `accuracy.divergence` bounds it."""

    has_gradient: ClassVar[bool] = True

    by_area: bool  # whether K is smaller at an open edge, because mass points have less area there
    mapped: bool  # whether the factor of K at each mass point is read from a field
    law: Law | None = None  # when it is pressed in; None if it is linear
    curved: bool = False  # whether the normals are fields, which a law needs

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        """Derive K [N/m], 0 if the foundation is never active; whether it is always active; and its law."""
        stiffening: LawNumbers | None = None
        if scene.tissue is not None:
            k = scene.tissue.foundation_stiffness * rest_of(scene.sheet).cell_area
            active, stiffening = scene.tissue.foundation_active, law_of(scene.tissue.foundation)
        else:
            assert scene.springs is not None
            k, active = scene.springs.virtual, scene.springs.virtual_active
        always = active == "always"
        virtual = k if always or scene.probes else 0.0
        return {"virtual": virtual, "always_active": always, "virtual_stiffening": stiffening}

    @classmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        material = plan.material
        mapped = material.virtual_factors is not None
        if material.virtual == 0:
            return None
        by_area, stiffening = plan.areas_vary and material.by_area and not mapped, material.virtual_stiffening
        curved = stiffening is not None and plan.scene.sheet.surface is not None
        return cls(by_area, mapped, stiffening.law if stiffening else None, curved)

    @staticmethod
    def stiffness_bound(material: Material, sheet: Sheet) -> float:
        factors = material.virtual_factors
        return _steepest(material) * (1.0 if factors is None else float(factors.max()))

    @classmethod
    def node_stiffness_bounds(cls, material: Material, sheet: Sheet) -> NDArray[Any] | float:
        factors = 1.0 if material.virtual_factors is None else material.virtual_factors
        areas = material.shares if material.by_area and material.shares is not None else 1.0
        return _steepest(material) * factors * areas

    @property
    def column_places(self) -> Places:
        return Places(stiffness=1)

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        return plan.material.virtual * loads.active[:, None]

    @property
    def field_places(self) -> Places:
        return Places(factor=int(self.mapped), normal=3 * self.curved)

    def fields(self, plan: Plan) -> NDArray[Any]:
        fields = super().fields(plan)
        if self.mapped:
            fields[self.field_places.factor] = point_shares(plan)
        if self.curved:
            fields[self.field_places.normal.start :] = np.moveaxis(rest_normals(plan.scene.sheet), -1, 0)
        return fields

    @property
    def constant_places(self) -> Places:
        return law_places(self.law)

    def constants(self, plan: Plan) -> tuple[float, ...]:
        law = plan.material.virtual_stiffening
        return law.constants(1.0) if law else ()

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        return (self._build_add(config, tangent=False),)

    def build_tangents(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        return (self._build_add(config, tangent=True),)

    def _build_add(self, config: KernelConfig, *, tangent: bool) -> Callable[..., Any]:
        ti, vector, columns = config.ti, config.vector, config.columns(FoundationTerm)
        has_law = self.law is not None
        stiffness_at, (secant, slope, _) = self.build_stiffness(config), self._build_law(config)
        curved, normals = self.curved, config.fields(FoundationTerm).normal

        @ti.func
        def add(force: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            k, u = (
                stiffness_at(sheet, entry, now[columns.stiffness]),
                ti.static(entry.displacement if tangent else entry.u),
            )
            if ti.static(curved):
                at = entry.row.i * sheet.width + entry.b
                n = [sheet.fields[normals[c] * sheet.rows * sheet.width + at] for c in ti.static(range(3))]
                along, moved = vector(0), vector(0)
                for c in ti.static(range(3)):
                    along += u[c] * n[c]
                    moved += entry.u[c] * n[c]
                # The law replaces the linear part along the normal.
                ratio = slope(sheet, along) if ti.static(tangent) else secant(sheet, along)
                for c in ti.static(range(3)):
                    force[c] = force[c] - k * (entry.u[c] + (ratio - 1) * moved * n[c])
            for c in ti.static(range(0 if curved else 3)):
                if ti.static(has_law and c == 2 and tangent):
                    force[c] = force[c] - k * (entry.u[c] * slope(sheet, u[2]))
                elif ti.static(has_law and c == 2):
                    force[c] = force[c] - k * (entry.u[c] * secant(sheet, u[2]))
                else:
                    force[c] = force[c] - k * entry.u[c]

        return add

    def build_derivatives(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function derive(sheet, p, u), which differentiates -p . force.

        It returns the derivatives with respect to K, log m and the shape of the law, divided by K but the first.
        """
        ti, has_law, count = config.ti, self.law is not None, self.law.shape_count if self.law else 0
        secant, tangent, by_shape = self._build_law(config)

        @ti.func
        def derive(sheet: ti.template(), p: ti.template(), u: ti.template()):
            if ti.static(has_law):
                ratio, slope = secant(sheet, u[2]), tangent(sheet, u[2])
                depth = p[2] * u[2]
                by_numbers = by_shape(sheet, u[2])
                by_law = [depth * by_numbers[n] for n in ti.static(range(count))]
                by_k = p[0] * u[0] + p[1] * u[1] + p[2] * (u[2] * ratio)
                return [by_k, depth * (ratio - slope)] + by_law  # noqa: RUF005  # Taichi nests an unpacked list.
            else:  # noqa: RET505
                return [p[0] * u[0] + p[1] * u[1] + p[2] * u[2]]

        return derive

    def build_stiffness(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function stiffness_at(sheet, entry, k), where k is the stiffness of a whole cell."""
        ti, mapped, by_area, fields = config.ti, self.mapped, self.by_area, config.fields(FoundationTerm)
        area_share = build_point_functions(config).area_share

        @ti.func
        def stiffness_at(sheet: ti.template(), entry: ti.template(), k):
            if ti.static(mapped):
                return k * sheet.fields[(fields.factor * sheet.rows + entry.row.i) * sheet.width + entry.b]
            elif ti.static(by_area):  # noqa: RET505  # Taichi would compile the rest as well.
                return k * area_share(sheet, entry.row.i, entry.row.kind, entry.b)
            else:
                return k

        return stiffness_at

    def _build_law(self, config: KernelConfig) -> tuple[Callable[..., Any], ...]:
        """Build the Taichi functions secant(sheet, u_z), tangent(sheet, u_z) and by_shape(sheet, u_z) of a law."""
        if self.law is None:
            return (_no_law,) * 3
        ti, places, functions = config.ti, config.constants(FoundationTerm), build_law(self.law, config.operations)

        def of_depth(function: Callable[..., Any]) -> Callable[..., Any]:
            @ti.func
            def at(sheet: ti.template(), u):
                shape = [sheet.constants[n] for n in ti.static(places.shape)]
                # ti.static takes expressions in a list only.
                return ti.static([function(0 - u * sheet.constants[places.inverse_scale], shape)])[0]

            return at

        return of_depth(functions.secant), of_depth(functions.tangent), of_depth(functions.by_shape)


def _no_law() -> None:
    """Stand in for the functions of a law, which a linear foundation does not call."""


def _steepest(material: Material) -> float:
    """Return the largest tangent stiffness for a factor of 1 [N/m]."""
    law = material.virtual_stiffening
    return material.virtual * (law.largest_slope if law else 1.0)


class FoundationForce(NamedTuple):
    """Force of the foundation on each mass point, and its derivatives."""

    force: Array  # [N], shape (rows, cols, 3)
    tangent: Array  # diagonal of the stiffness matrix [N/m], shape (rows, cols, 3)
    by_numbers: list[Array]  # derivatives of the z component by log m and the shape of the law [N], shape (rows, cols)


def foundation_force(material: Material, k: Array, displacement: Array) -> FoundationForce:
    """Return the force of a foundation of the stiffness k [N/m], shape (rows, cols), and its derivatives."""
    tangent, law = np.repeat(k[..., None], 3, axis=-1), material.virtual_stiffening
    force, by_numbers = -tangent * displacement, []
    if law is not None:
        functions, (scale, _, *shape), u_z = build_law(law.law, NUMPY), law.constants(1.0), displacement[..., 2]
        x = -u_z * scale
        secant, slope = functions.secant(x, shape), functions.tangent(x, shape)
        by_numbers = [-k * u_z * by for by in (secant - slope, *functions.by_shape(x, shape))]
        force[..., 2] *= secant
        tangent[..., 2] *= slope
    return FoundationForce(force, tangent, by_numbers)


def foundation_energy(plan: Plan, k: Array | float, displacement: Array) -> float:
    """Return the energy of a foundation of the stiffness k [N/m], a number or shape (rows, cols) [J]."""
    square, law = (displacement**2).sum(axis=-1), plan.material.virtual_stiffening
    if law is not None:
        along = heights(displacement, plan.scene.sheet)
        scale, depth, *shape = law.constants(1.0)
        square += depth**2 * law.law.build(NUMPY).integral(-along * scale, *shape) - along**2
    return float((k * square).sum()) / 2


def point_shares(plan: Plan) -> NDArray[Any]:
    """Return the factor of K at each mass point, map times share of a cell's area, shape (rows, cols)."""
    material = plan.material
    shares = plan.area_shares if material.by_area else np.ones(plan.fixed.shape)
    return shares if material.virtual_factors is None else material.virtual_factors * shares
