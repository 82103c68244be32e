"""The elastic (Winkler) foundation, or virtual springs: the force -K u pulls each mass point to its rest position.

A foundation that locks resists the depth w = -u_z > 0 by K f(w) instead of K w, see `terms.law`.

Scene: `springs.virtual` and `virtual_active`, or `tissue.foundation`, `foundation_active` and `foundation_map`.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.arithmetic import NUMPY
from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Material, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Foundation, Sheet
from taichi_msm.terms.base import KernelConfig, Term
from taichi_msm.terms.law import LockingLaw, build_locking, law_parameters, make_stiffening
from taichi_msm.terms.points import build_point_functions


@dataclass(frozen=True)
class FoundationTerm(Term):
    """Virtual springs. Their energy is not measured; `accuracy.divergence` bounds it."""

    has_gradient: ClassVar[bool] = True

    by_area: bool  # whether K is smaller at an open edge, because mass points have less area there
    mapped: bool  # whether the factor of K at each mass point is read from a field
    locks: bool = False  # whether it stiffens when it is pressed in

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        """Derive K [N/m], 0 if the foundation is never active; whether it is always active; and its law."""
        stiffening = None
        if scene.tissue is not None:
            k = scene.tissue.foundation_stiffness * math.prod(spacing(scene.sheet))
            active, foundation = scene.tissue.foundation_active, scene.tissue.foundation
            if isinstance(foundation, Foundation):
                stiffening = make_stiffening(foundation.lock, foundation.factor)
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
        by_area = plan.areas_vary and material.by_area and not mapped
        return cls(by_area, mapped, material.virtual_stiffening is not None)

    @staticmethod
    def stiffness_bound(material: Material, sheet: Sheet) -> float:
        factors = material.virtual_factors
        return _steepest(material) * (1.0 if factors is None else float(factors.max()))

    @classmethod
    def node_stiffness_bounds(cls, material: Material, sheet: Sheet) -> NDArray[Any] | float:
        factors = 1.0 if material.virtual_factors is None else material.virtual_factors
        return _steepest(material) * factors * (1.0 if material.shares is None else material.shares)

    @property
    def column_count(self) -> int:
        return 1

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        return plan.material.virtual * loads.active[:, None]

    @property
    def field_count(self) -> int:
        return int(self.mapped)

    def fields(self, plan: Plan) -> NDArray[Any]:
        return point_shares(plan)[None] if self.mapped else super().fields(plan)

    @property
    def constant_count(self) -> int:  # type: ignore[override]
        return LockingLaw.parameter_count if self.locks else 0

    def constants(self, plan: Plan) -> tuple[float, ...]:
        return law_parameters(plan.material.virtual_stiffening, 1.0)

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        return (self._build_add(config, tangent=False),)

    def build_tangents(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        return (self._build_add(config, tangent=True),)

    def _build_add(self, config: KernelConfig, *, tangent: bool) -> Callable[..., Any]:
        ti, locks, column = config.ti, self.locks, config.first_column(FoundationTerm)
        stiffness_at, (secant, slope) = self.build_stiffness(config), self._build_law(config)
        ratio = slope if tangent else secant

        @ti.func
        def add(force: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            k, u = stiffness_at(sheet, entry, now[column]), ti.static(entry.displacement if tangent else entry.u)
            for c in ti.static(range(3)):
                if ti.static(locks and c == 2):
                    force[c] = force[c] - k * (entry.u[c] * ratio(sheet, u[2]))
                else:
                    force[c] = force[c] - k * entry.u[c]

        return add

    def build_derivatives(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function derive(sheet, p, u), which differentiates -p . force.

        It returns the derivatives with respect to K, log(lock) and the factor, the latter two divided by K.
        """
        ti, locks, first = config.ti, self.locks, config.first_constant(FoundationTerm)
        secant, tangent = self._build_law(config)

        @ti.func
        def derive(sheet: ti.template(), p: ti.template(), u: ti.template()):
            by_k = p[0] * u[0] + p[1] * u[1] + p[2] * u[2]
            by_lock, by_factor = 0 * u[2], 0 * u[2]
            if ti.static(locks):
                ratio = secant(sheet, u[2])
                by_k = p[0] * u[0] + p[1] * u[1] + p[2] * (u[2] * ratio)
                by_lock = p[2] * u[2] * (ratio - tangent(sheet, u[2]))
                end = sheet.constants[first + 1] / sheet.constants[first]
                by_factor = p[2] * ti.min(u[2] + end, 0)
            return [by_k, by_lock, by_factor]

        return derive

    def build_stiffness(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function stiffness_at(sheet, entry, k), where k is the stiffness of a whole cell."""
        ti, mapped, by_area, field = config.ti, self.mapped, self.by_area, config.first_field(FoundationTerm)
        area_share = build_point_functions(config).area_share

        @ti.func
        def stiffness_at(sheet: ti.template(), entry: ti.template(), k):
            if ti.static(mapped):
                return k * sheet.fields[(field * sheet.rows + entry.row.i) * sheet.width + entry.b]
            elif ti.static(by_area):  # noqa: RET505  # Taichi would compile the rest as well.
                return k * area_share(sheet, entry.row.i, entry.row.kind, entry.b)
            else:
                return k

        return stiffness_at

    def _build_law(self, config: KernelConfig) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """Build the Taichi functions secant(sheet, u_z) and tangent(sheet, u_z) of a foundation that locks."""
        ti, first, law = config.ti, config.first_constant(FoundationTerm), build_locking(config.operations)

        def of_depth(function: Callable[..., Any]) -> Callable[..., Any]:
            law_function = ti.func(function)

            @ti.func
            def at(sheet: ti.template(), u):
                return law_function(0 - u * sheet.constants[first], sheet.constants[first + 1])

            return at

        return of_depth(law.secant), of_depth(law.tangent)


def _steepest(material: Material) -> float:
    """Return the largest tangent stiffness for a factor of 1 [N/m]."""
    stiffening = material.virtual_stiffening
    return material.virtual * (1.0 if stiffening is None else stiffening.factor)


def foundation_force(material: Material, k: NDArray[Any] | float, displacement: NDArray[Any]) -> NDArray[Any]:
    """Return the force of the foundation on each mass point [N], shape (rows, cols, 3).

    Args:
        material: coefficients of the sheet.
        k: stiffness [N/m], a number or shape (rows, cols).
        displacement: x - X [m], shape (rows, cols, 3).
    """
    force = -np.asarray(k)[..., None] * displacement
    if material.virtual_stiffening is not None:
        scale, end, _ = law_parameters(material.virtual_stiffening, 1.0)
        force[..., 2] *= build_locking(NUMPY).secant(-displacement[..., 2] * scale, end)
    return force


def foundation_energy(material: Material, k: NDArray[Any] | float, displacement: NDArray[Any]) -> float:
    """Return the energy of the foundation [J].

    Args:
        material: coefficients of the sheet.
        k: stiffness [N/m], a number or shape (rows, cols).
        displacement: x - X [m], shape (rows, cols, 3).
    """
    square = displacement**2
    if material.virtual_stiffening is not None:
        scale, end, lock = law_parameters(material.virtual_stiffening, 1.0)
        square[..., 2] = lock**2 * build_locking(NUMPY).energy(-displacement[..., 2] * scale, end)
    return float((k * square.sum(axis=-1)).sum()) / 2


def foundation_derivatives(material: Material, k: NDArray[Any], u_z: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Differentiate the z component of `foundation_force` with respect to log(lock) and to the factor.

    Args:
        material: coefficients of the sheet.
        k: stiffness [N/m], shape (rows, cols).
        u_z: z component of x - X [m], shape (rows, cols).

    Returns:
        Both derivatives [N], shape (rows, cols) each; 0 for a linear foundation.
    """
    if material.virtual_stiffening is None:
        return np.zeros_like(u_z), np.zeros_like(u_z)
    (scale, end, lock), law = law_parameters(material.virtual_stiffening, 1.0), build_locking(NUMPY)
    x = -u_z * scale
    return -k * u_z * (law.secant(x, end) - law.tangent(x, end)), k * lock * np.maximum(x - end, 0)


def foundation_tangent(material: Material, k: NDArray[Any], displacement: NDArray[Any]) -> NDArray[Any]:
    """Return the diagonal of the foundation's stiffness matrix [N/m], shape (rows, cols, 3).

    Args:
        material: coefficients of the sheet.
        k: stiffness [N/m], shape (rows, cols).
        displacement: x - X [m], shape (rows, cols, 3).
    """
    tangent = np.repeat(k[..., None], 3, axis=-1)
    if material.virtual_stiffening is not None:
        scale, end, _ = law_parameters(material.virtual_stiffening, 1.0)
        tangent[..., 2] *= build_locking(NUMPY).tangent(-displacement[..., 2] * scale, end)
    return tangent


def point_shares(plan: Plan) -> NDArray[Any]:
    """Return the factor of K at each mass point, map times share of a cell's area, shape (rows, cols)."""
    material = plan.material
    shares = plan.area_shares if material.by_area else np.ones(plan.fixed.shape)
    return shares if material.virtual_factors is None else material.virtual_factors * shares
