"""Loads: the forces of force-controlled probes on the mass points around their control points. Scene: `probes`.

The force on a mass point at the distance d is F exp(-max(falloff d + shift, offset)), see `probe_force`. The load
table contains F and the other parameters for every step and `ProbeSlot`. A slot with a stationary control point has a
field with the decay factors, the exponentials.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.loads import Schedule, decay, decay_gradient
from taichi_msm.model.plan import Plan, ProbeSlot
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import axes, spacing
from taichi_msm.model.tool_force import probe_force
from taichi_msm.terms.base import KernelConfig, Term
from taichi_msm.terms.places import Places
from taichi_msm.terms.points import build_point_functions


@dataclass(frozen=True)
class ProbeTerm(Term):
    """Loads of force-controlled probes."""

    has_gradient: ClassVar[bool] = True

    moves: tuple[bool, ...]  # for each slot, whether its control point moves
    by_area: tuple[bool, ...]  # for each slot, whether its forces are proportional to areas, which vary
    dimensions: int = 2  # of control points: x and y at rest on a flat sheet, x, y and z on a curved one [m]

    @classmethod
    def from_plan(cls, plan: Plan) -> Self:
        probes = plan.scene.probes
        by_area = tuple(plan.areas_vary and probes[slot.probe].total is not None for slot in plan.slots)
        dimensions = 2 if rest_of(plan.scene.sheet).is_flat else 3
        return cls(tuple(slot.moves for slot in plan.slots), by_area, dimensions)

    @property
    def column_places(self) -> Places:
        slot = Places(force=3, point=self.dimensions, falloff=1, shift=1, offset=1)  # See `ProbeForce`.
        return Places(slots=[slot] * len(self.moves))

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        columns = np.empty((len(loads.active), self.column_places.count))
        for n, (slot, places) in enumerate(zip(plan.slots, self.column_places.slots, strict=True)):
            law = probe_force(plan.scene.probes[slot.probe], plan.scene.sheet)
            columns[:, places.force], columns[:, places.point] = loads.strength[:, n], loads.point[:, n]
            columns[:, [places.falloff, places.shift, places.offset]] = law.falloff, law.shift, law.offset
        return columns

    @property
    def field_places(self) -> Places:
        return Places(decays=[1] * self.moves.count(False))

    def fields(self, plan: Plan) -> NDArray[Any]:
        scene = plan.scene
        decays = [decay(scene.probes[slot.probe], plan) for slot in plan.slots if not slot.moves]
        return np.array(decays).reshape(-1, *scene.sheet.points)

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        ti = config.ti
        moves, by_area, slots = self.moves, self.by_area, config.columns(ProbeTerm).slots
        vector, lanes, decays = config.vector, config.lanes, self._decay_fields(config)
        _, area_share, rest_position = build_point_functions(config)
        curved = self.dimensions == 3

        @ti.func
        def add(force: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            for n, slot in ti.static(enumerate(slots)):
                factor = vector(0)
                if ti.static(moves[n]):
                    rest = rest_position(sheet, entry.row.i, entry.b)
                    off_x, off_y = rest[0] - now[slot.point[0]], rest[1] - now[slot.point[1]]
                    squared = off_x * off_x + off_y * off_y
                    if ti.static(curved):
                        off_z = rest[2] - now[slot.point[2]]
                        squared += off_z * off_z
                    exponent = now[slot.falloff] * ti.sqrt(squared) + now[slot.shift]
                    exponent = ti.max(exponent, now[slot.offset])
                    factor = vector([ti.exp(-exponent[lane]) for lane in ti.static(range(lanes))])
                    if ti.static(by_area[n]):
                        factor *= area_share(sheet, entry.row.i, entry.row.kind, entry.b)
                else:
                    factor = sheet.fields[(decays[n] * sheet.rows + entry.row.i) * sheet.width + entry.b]
                for c in ti.static(range(3)):
                    force[c] += now[slot.force[c]] * factor

        return (add,)

    def supports(self, compiled: Self) -> str:
        if self.moves != compiled.moves:
            return (
                "a control point cannot change between fixed and moving (moving before: "
                f"{_format_flags(compiled.moves)}; now: {_format_flags(self.moves)}); restart with the new scene"
            )
        if self.by_area != compiled.by_area:
            return "a probe cannot change between total and force; restart with the new scene"
        return ""

    def _decay_fields(self, config: KernelConfig) -> list[int | None]:
        """Return the field with the decay factors of each slot, None for a moving control point."""
        fields = iter(config.fields(ProbeTerm).decays)
        return [None if moves else next(fields) for moves in self.moves]

    def decay_gradients(self, plan: Plan) -> NDArray[Any]:
        """Differentiate the fields by x and y of the control point [1/m], shape (fields, 2, rows, cols)."""
        scene = plan.scene
        gradients = [decay_gradient(scene.probes[slot.probe], plan) for slot in plan.slots if not slot.moves]
        return np.array(gradients).reshape(-1, 2, *scene.sheet.points)

    def build_load_adjoint(self, config: KernelConfig, first_gradient: int) -> Callable[..., None]:
        """Build add_adjoint(sums, sheet, entry, now), which differentiates force . `entry.u` of each slot.

        It adds the derivatives with respect to the force (3) and the control point (2) of each slot to the list `sums`.
        `first_gradient` is the index of the first field of `decay_gradients` among the fields in `sheet.derivatives`.
        """
        ti = config.ti
        moves, by_area, slots = self.moves, self.by_area, config.columns(ProbeTerm).slots
        vector, lanes, decays = config.vector, config.lanes, self._decay_fields(config)
        _, area_share, rest_position = build_point_functions(config)
        # Derivatives of a slot; and of all stationary ones by x and y of the control point, among `sheet.derivatives`.
        sums_of = Places(slots=[Places(force=3, point=2)] * len(moves)).slots
        gradients = iter(Places(first_gradient, stationary=[2] * moves.count(False)).stationary)
        gradient_fields = [None if moves[n] else next(gradients) for n in range(len(moves))]

        @ti.func
        def add_adjoint(sums: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            i, b = entry.row.i, entry.b
            for n, slot in ti.static(enumerate(slots)):
                factor, gradient = vector(0), [vector(0), vector(0)]
                if ti.static(moves[n]):
                    rest = rest_position(sheet, i, b)
                    off_x, off_y = rest[0] - now[slot.point[0]], rest[1] - now[slot.point[1]]
                    distance = ti.sqrt(off_x * off_x + off_y * off_y)
                    exponent = now[slot.falloff] * distance + now[slot.shift]
                    # The derivative is 0 where the force does not depend on the distance, and at the control point.
                    slope = now[slot.falloff] / ti.select(distance > 0, distance, vector(1))
                    slope = ti.select(exponent > now[slot.offset], slope, vector(0))
                    exponent = ti.max(exponent, now[slot.offset])
                    factor = vector([ti.exp(-exponent[lane]) for lane in ti.static(range(lanes))])
                    if ti.static(by_area[n]):
                        factor *= area_share(sheet, i, entry.row.kind, b)
                    gradient[0], gradient[1] = factor * slope * off_x, factor * slope * off_y
                else:
                    factor = sheet.fields[(decays[n] * sheet.rows + i) * sheet.width + b]
                    for axis in ti.static(range(2)):
                        row = gradient_fields[n][axis] * sheet.rows + i
                        gradient[axis] = sheet.derivatives[row * sheet.width + b]
                work = vector(0)
                for c in ti.static(range(3)):
                    sums[sums_of[n].force[c]] += factor * entry.u[c]
                    work += now[slot.force[c]] * entry.u[c]
                for axis in ti.static(range(2)):
                    sums[sums_of[n].point[axis]] += work * gradient[axis]

        return add_adjoint


def decay_parameters(plan: Plan) -> list[tuple[object, ...]]:
    """Return control point and force law, without the force, of the stationary slots, to detect other decay factors."""
    probes = [plan.scene.probes[slot.probe] for slot in plan.slots if not slot.moves]
    return [(probe.at, probe_force(probe, plan.scene.sheet)[1:]) for probe in probes]


def max_free_acceleration(plan: Plan) -> float:
    """Return an upper bound of the acceleration of a free mass point, the sum over all probes [m/s2]."""
    forces = (
        probe_force(probe, plan.scene.sheet).max_force * max(abs(percent) for _, percent in probe.load) / 100
        for probe in plan.scene.probes
        if not probe.moved
    )
    return sum(forces) / plan.material.mass


def decay_norm_bound(slot: ProbeSlot, plan: Plan) -> float:
    """Return an upper bound of the Euclidean norm of a slot's decay factors, over all mass points."""
    scene = plan.scene
    if not slot.moves:
        return float(np.linalg.norm(decay(scene.probes[slot.probe], plan)))
    # The control point is within half a cell's diagonal of some mass point. Four copies of the sheet that meet at this
    # mass point cover the sheet, and their norm is twice that of one copy with the mass point at its corner.
    if scene.sheet.surface:
        law = probe_force(scene.probes[slot.probe], scene.sheet)
        areas = plan.area_shares if law.by_area else np.ones(plan.fixed.shape)
        return float(law.decay(np.zeros(())) * np.linalg.norm(areas))
    x, y = axes(scene.sheet)
    nearest = np.maximum(np.hypot(x - x[0], y - y[0]) - math.hypot(*spacing(scene.sheet)) / 2, 0)
    return 2 * float(np.linalg.norm(probe_force(scene.probes[slot.probe], scene.sheet).decay(nearest)))


def _format_flags(flags: tuple[bool, ...]) -> str:
    return ", ".join("yes" if flag else "no" for flag in flags) or "none"
