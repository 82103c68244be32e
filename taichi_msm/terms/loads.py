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
from taichi_msm.model.sheet import axes, spacing
from taichi_msm.model.tool_force import probe_force
from taichi_msm.terms.base import KernelConfig, Term
from taichi_msm.terms.points import build_point_functions

# Columns of a slot: force (3), control point (2), falloff, shift and offset.
FORCE, POINT, FALLOFF, SHIFT, OFFSET, SLOT_COLUMNS = 0, 3, 5, 6, 7, 8


@dataclass(frozen=True)
class ProbeTerm(Term):
    """Loads of force-controlled probes."""

    has_gradient: ClassVar[bool] = True

    moves: tuple[bool, ...]  # for each slot, whether its control point moves
    by_area: tuple[bool, ...]  # for each slot, whether its forces are smaller at an open edge

    @classmethod
    def from_plan(cls, plan: Plan) -> Self:
        probes = plan.scene.probes
        by_area = tuple(plan.areas_vary and probes[slot.probe].total is not None for slot in plan.slots)
        return cls(tuple(slot.moves for slot in plan.slots), by_area)

    @property
    def column_count(self) -> int:
        return SLOT_COLUMNS * len(self.moves)

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        slots = np.empty((len(loads.active), len(self.moves), SLOT_COLUMNS))
        slots[..., FORCE:POINT] = loads.strength
        slots[..., POINT:FALLOFF] = loads.point
        for n, slot in enumerate(plan.slots):
            force = probe_force(plan.scene.probes[slot.probe], plan.scene.sheet)
            slots[:, n, FALLOFF:] = force.falloff, force.shift, force.offset
        return slots.reshape(len(slots), self.column_count)

    @property
    def field_count(self) -> int:
        return self.moves.count(False)

    def fields(self, plan: Plan) -> NDArray[Any]:
        scene = plan.scene
        decays = [decay(scene.probes[slot.probe], plan) for slot in plan.slots if not slot.moves]
        return np.array(decays).reshape(-1, *scene.sheet.points)

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        ti = config.ti
        moves, by_area, first = self.moves, self.by_area, config.first_column(ProbeTerm)
        vector, lanes = config.vector, config.lanes
        first_field, (_, area_share, rest_position) = config.first_field(ProbeTerm), build_point_functions(config)
        stationary = [first_field + moves[:n].count(False) for n in range(len(moves))]

        @ti.func
        def add(force: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            for n in ti.static(range(len(moves))):
                column = ti.static(first + SLOT_COLUMNS * n)
                factor = vector(0)
                if ti.static(moves[n]):
                    rest = rest_position(sheet, entry.row.i, entry.b)
                    off_x, off_y = rest[0] - now[column + POINT], rest[1] - now[column + POINT + 1]
                    exponent = now[column + FALLOFF] * ti.sqrt(off_x * off_x + off_y * off_y) + now[column + SHIFT]
                    exponent = ti.max(exponent, now[column + OFFSET])
                    factor = vector([ti.exp(-exponent[lane]) for lane in ti.static(range(lanes))])
                    if ti.static(by_area[n]):
                        factor *= area_share(sheet, entry.row.i, entry.row.kind, entry.b)
                else:
                    factor = sheet.fields[(stationary[n] * sheet.rows + entry.row.i) * sheet.width + entry.b]
                for c in ti.static(range(3)):
                    force[c] += now[column + c] * factor

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

    def decay_gradients(self, plan: Plan) -> NDArray[Any]:
        """Differentiate the fields by x and y of the control point [1/m], shape (field_count, 2, rows, cols)."""
        scene = plan.scene
        gradients = [decay_gradient(scene.probes[slot.probe], plan) for slot in plan.slots if not slot.moves]
        return np.array(gradients).reshape(-1, 2, *scene.sheet.points)

    def build_load_adjoint(self, config: KernelConfig, first_gradient: int) -> Callable[..., None]:
        """Build the adjoint of the loads.

        Args:
            config: compile-time configuration.
            first_gradient: index of the first field of `decay_gradients` among the fields in `sheet.derivatives`.

        Returns:
            The Taichi function add_adjoint(sums, sheet, entry, now). It differentiates force . `entry.u` of each slot
            with respect to the force (3) and the control point (2), and adds the derivatives to the list `sums`.
        """
        ti = config.ti
        moves, by_area, first = self.moves, self.by_area, config.first_column(ProbeTerm)
        vector, lanes, first_field = config.vector, config.lanes, config.first_field(ProbeTerm)
        _, area_share, rest_position = build_point_functions(config)
        stationary = [moves[:n].count(False) for n in range(len(moves))]

        @ti.func
        def add_adjoint(sums: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            i, b = entry.row.i, entry.b
            for n in ti.static(range(len(moves))):
                column = ti.static(first + SLOT_COLUMNS * n)
                factor, gradient = vector(0), [vector(0), vector(0)]
                if ti.static(moves[n]):
                    rest = rest_position(sheet, i, b)
                    off_x, off_y = rest[0] - now[column + POINT], rest[1] - now[column + POINT + 1]
                    distance = ti.sqrt(off_x * off_x + off_y * off_y)
                    exponent = now[column + FALLOFF] * distance + now[column + SHIFT]
                    # The derivative is 0 where the force does not depend on the distance, and at the control point.
                    slope = now[column + FALLOFF] / ti.select(distance > 0, distance, vector(1))
                    slope = ti.select(exponent > now[column + OFFSET], slope, vector(0))
                    exponent = ti.max(exponent, now[column + OFFSET])
                    factor = vector([ti.exp(-exponent[lane]) for lane in ti.static(range(lanes))])
                    if ti.static(by_area[n]):
                        factor *= area_share(sheet, i, entry.row.kind, b)
                    gradient[0], gradient[1] = factor * slope * off_x, factor * slope * off_y
                else:
                    factor = sheet.fields[((first_field + stationary[n]) * sheet.rows + i) * sheet.width + b]
                    for axis in ti.static(range(2)):
                        row = (first_gradient + 2 * stationary[n] + axis) * sheet.rows + i
                        gradient[axis] = sheet.derivatives[row * sheet.width + b]
                work = vector(0)
                for c in ti.static(range(3)):
                    sums[5 * n + c] += factor * entry.u[c]
                    work += now[column + c] * entry.u[c]
                for axis in ti.static(range(2)):
                    sums[5 * n + 3 + axis] += work * gradient[axis]

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
    """Return an upper bound of the Euclidean norm of a slot's decay factors, over all mass points.

    Args:
        slot: slot of a probe; its control point may move.
        plan: plan of the slot.
    """
    scene = plan.scene
    if not slot.moves:
        return float(np.linalg.norm(decay(scene.probes[slot.probe], plan)))
    # The control point is within half a cell's diagonal of some mass point. Four copies of the sheet that meet at this
    # mass point cover the sheet, and their norm is twice that of one copy with the mass point at its corner.
    x, y = axes(scene.sheet)
    nearest = np.maximum(np.hypot(x - x[0], y - y[0]) - math.hypot(*spacing(scene.sheet)) / 2, 0)
    return 2 * float(np.linalg.norm(probe_force(scene.probes[slot.probe], scene.sheet).decay(nearest)))


def _format_flags(flags: tuple[bool, ...]) -> str:
    return ", ".join("yes" if flag else "no" for flag in flags) or "none"
