"""The loads: what probes exert on the points around their control points. Scene: `probes`.

The force on a point at the distance d is F exp(-max(falloff d + shift, offset)) (see `probe_force`), tabulated for
every step in a few columns for each `ProbeSlot`. Where a control point stands, its decay is a field.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.loads import Schedule, decay, decay_slope
from taichi_msm.model.plan import Plan, ProbeSlot
from taichi_msm.model.sheet import axes, spacing
from taichi_msm.model.tool_force import probe_force
from taichi_msm.scene.scene import Scene
from taichi_msm.terms.base import ACROSS, AREA, DY, TOP, StepCode, Term

# Columns of a slot: force (3), control point (2), falloff, shift and offset.
FORCE, POINT, FALLOFF, SHIFT, OFFSET, SLOT_COLUMNS = 0, 3, 5, 6, 7, 8


@dataclass(frozen=True)
class ProbeTerm(Term):
    """The loads."""

    moves: tuple[bool, ...]  # for every slot, whether its control point moves
    by_area: tuple[bool, ...]  # for every slot, whether points at an open edge get less of its force

    @classmethod
    def of(cls, plan: Plan) -> Self:
        """Tell which slots stand."""
        probes = plan.scene.probes
        by_area = tuple(plan.open_edges and probes[slot.probe].total is not None for slot in plan.slots)
        return cls(tuple(slot.moves for slot in plan.slots), by_area)

    @property
    def column_count(self) -> int:
        """A few columns for each slot."""
        return SLOT_COLUMNS * len(self.moves)

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        """Give forces and places of every slot."""
        slots = np.empty((len(loads.active), len(self.moves), SLOT_COLUMNS))
        slots[..., FORCE:POINT] = loads.strength
        slots[..., POINT:FALLOFF] = loads.point
        for n, slot in enumerate(plan.slots):
            acts = probe_force(plan.scene.probes[slot.probe], plan.scene.sheet)
            slots[:, n, FALLOFF:] = acts.falloff, acts.shift, acts.offset
        return slots.reshape(len(slots), self.column_count)

    @property
    def field_count(self) -> int:
        """One field for each slot that stands."""
        return self.moves.count(False)

    def fields(self, plan: Plan) -> NDArray[Any]:
        """Give the decays of the standing slots."""
        scene = plan.scene
        decays = [decay(scene.probes[slot.probe], scene.sheet) for slot in plan.slots if not slot.moves]
        return np.array(decays).reshape(-1, *scene.sheet.points)

    def forces(self, code: StepCode) -> Sequence[Callable[..., Any]]:
        """Make the function that adds the forces of all slots."""
        ti = code.ti
        moves, by_area, first = self.moves, self.by_area, code.first_column(ProbeTerm)
        vector, lanes = code.vector, code.lanes
        first_field = code.first_field(ProbeTerm)
        standing = [first_field + moves[:n].count(False) for n in range(len(moves))]

        @ti.func
        def add(force: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            for n in ti.static(range(len(moves))):
                column = ti.static(first + SLOT_COLUMNS * n)
                share = vector(0)
                if ti.static(moves[n]):
                    off_x = sheet.by_column[ACROSS * sheet.width + entry.b] - now[column + POINT]
                    off_y = sheet.numbers[TOP] - entry.row.i * sheet.numbers[DY] - now[column + POINT + 1]
                    exponent = now[column + FALLOFF] * ti.sqrt(off_x * off_x + off_y * off_y) + now[column + SHIFT]
                    exponent = ti.max(exponent, now[column + OFFSET])
                    share = vector([ti.exp(-exponent[lane]) for lane in ti.static(range(lanes))])
                    if ti.static(by_area[n]):
                        share *= sheet.by_column[(AREA + entry.row.kind) * sheet.width + entry.b]
                else:
                    share = sheet.fields[(standing[n] * sheet.rows + entry.row.i) * sheet.width + entry.b]
                for c in ti.static(range(3)):
                    force[c] += now[column + c] * share

        return (add,)

    def slopes(self, plan: Plan) -> NDArray[Any]:
        """Give the derivatives of the decays of the standing slots by x and y of the control point, (slots, 2, ...)."""
        scene = plan.scene
        slopes = [decay_slope(scene.probes[slot.probe], scene.sheet) for slot in plan.slots if not slot.moves]
        return np.array(slopes).reshape(-1, 2, *scene.sheet.points)

    def sensing(self, code: StepCode, first_slope: int) -> Callable[..., None]:
        """Make the function that differentiates the work of all slots by their forces and their control points.

        An entry's work on it is the product of the force and `entry.u`; of a slot, three derivatives by the force and
        two by the control point are added to a list. `slopes` are in `sheet.derivatives`, from `first_slope` times the
        sheet's rows on.
        """
        ti = code.ti
        moves, by_area, first = self.moves, self.by_area, code.first_column(ProbeTerm)
        vector, lanes, first_field = code.vector, code.lanes, code.first_field(ProbeTerm)
        standing = [moves[:n].count(False) for n in range(len(moves))]

        @ti.func
        def sense(sums: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            i, b = entry.row.i, entry.b
            for n in ti.static(range(len(moves))):
                column = ti.static(first + SLOT_COLUMNS * n)
                share, slope = vector(0), [vector(0), vector(0)]
                if ti.static(moves[n]):
                    off_x = sheet.by_column[ACROSS * sheet.width + b] - now[column + POINT]
                    off_y = sheet.numbers[TOP] - i * sheet.numbers[DY] - now[column + POINT + 1]
                    distance = ti.sqrt(off_x * off_x + off_y * off_y)
                    exponent = now[column + FALLOFF] * distance + now[column + SHIFT]
                    # 0 on the flat end, and where the point is the control point.
                    turned = now[column + FALLOFF] / ti.select(distance > 0, distance, vector(1))
                    turned = ti.select(exponent > now[column + OFFSET], turned, vector(0))
                    exponent = ti.max(exponent, now[column + OFFSET])
                    share = vector([ti.exp(-exponent[lane]) for lane in ti.static(range(lanes))])
                    if ti.static(by_area[n]):
                        share *= sheet.by_column[(AREA + entry.row.kind) * sheet.width + b]
                    slope[0], slope[1] = share * turned * off_x, share * turned * off_y
                else:
                    share = sheet.fields[((first_field + standing[n]) * sheet.rows + i) * sheet.width + b]
                    for axis in ti.static(range(2)):
                        row = (first_slope + 2 * standing[n] + axis) * sheet.rows + i
                        slope[axis] = sheet.derivatives[row * sheet.width + b]
                work = vector(0)
                for c in ti.static(range(3)):
                    sums[5 * n + c] += share * entry.u[c]
                    work += now[column + c] * entry.u[c]
                for axis in ti.static(range(2)):
                    sums[5 * n + 3 + axis] += work * slope[axis]

        return sense


def standing(plan: Plan) -> list[tuple[object, ...]]:
    """List everything that the decays of the standing slots depend on."""
    probes = [plan.scene.probes[slot.probe] for slot in plan.slots if not slot.moves]
    return [(probe.at, probe_force(probe, plan.scene.sheet)[1:]) for probe in probes]


def free_acceleration(plan: Plan) -> float:
    """Bound the acceleration that the probes give to a free point [m/s^2]."""
    forces = (
        probe_force(probe, plan.scene.sheet).size * max(abs(percent) for _, percent in probe.load) / 100
        for probe in plan.scene.probes
        if not probe.moved
    )
    return sum(forces) / plan.material.mass


def norm(slot: ProbeSlot, scene: Scene) -> float:
    """Bound |F| over all points for a force of 1 N at the control point."""
    if not slot.moves:
        return float(np.linalg.norm(decay(scene.probes[slot.probe], scene.sheet)))
    # The moving control point is within half a cell's diagonal of some lattice point. The sheet around that point lies
    # within four sheets that meet there, and their norm is twice that of one.
    x, y = axes(scene.sheet)
    nearest = np.maximum(np.hypot(x - x[0], y - y[0]) - math.hypot(*spacing(scene.sheet)) / 2, 0)
    return 2 * float(np.linalg.norm(probe_force(scene.probes[slot.probe], scene.sheet).decay(nearest)))
