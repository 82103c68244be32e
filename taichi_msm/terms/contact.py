"""Contact, friction and grips of position-controlled tools. Scene: `probes` with `path`.

In dynamic scenes, contact corrects the displacements u of the mass points after each step, one tool after the other in
the order of `probes`. In the shape of a tool with the tip c, X + u - c has a depth and an outward normal n
(`taichi_msm.shapes`). Mass points with depth > 0, neither fixed nor held, are projected out of the shape, and the
friction mu reduces their slip; u' and c' are those before the step:

    slip = (u + depth n - u') - (c - c'),    w = slip - (slip . n) n
    correction = depth n - w min(1, mu depth / |w|)

A correction has the effect of the force correction / gain (`integrators`), so the corrections yield the force of the
tool.

A grip holds the mass points within 1.5 radii of the tip at its start: u = u_start + c - c_start. A clamp, whose
c is a displacement, touches nothing and holds its side from the start of the run: u = c.

In quasi-static scenes a tool pushes the mass points that touch it, and never pulls. Of the force F on a mass point it
carries the part into its shape, min(F . n, 0) n; the remainder, tangential or outward, vanishes in equilibrium. If
several tools touch a mass point, projected Gauss-Seidel iteration finds their parts and corrections. The fields of
corrections store n, and 0 without contact. Mass points that are held, or stick to a rough tool, move with their tool,
which carries all of F.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import GRIP_RADII, clamps, solid_tools
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.shapes import SHAPES
from taichi_msm.shapes.shape import MIN_DISTANCE_M
from taichi_msm.terms.base import DY, TOP_Y, Correction, KernelConfig, RestCorrection, Term, build_max_lane
from taichi_msm.terms.places import Places
from taichi_msm.terms.points import build_point_functions

# Columns of a tool in the load table; those from `axis` on are 0 for a clamp.
TOOL = Places(
    tip_after=3,  # c after the step [m]
    tip_before=3,  # c before the step [m]
    grip_state=1,  # GRIP_BEGINS, GRIP_CONTINUES or 0
    grip_shift=3,  # displacement of the tool since its grip began [m]
    axis=3,  # unit vector from the tip along the shaft
    axis_length=1,  # [m]
    radius=1,  # [m]
    friction=1,  # Coulomb's coefficient; infinite if rough
    inverse_axis=2,  # reciprocals of y and z of the axis
)

# States of a grip in a step; 0 without one.
GRIP_BEGINS, GRIP_CONTINUES = 1.0, 2.0

# Iterations of projected Gauss-Seidel, where several tools may touch a mass point.
MAX_ITERATIONS = 8

# Holder of a mass point that no tool holds.
FREE = 0


def held_by(tool: int) -> int:
    """Return the holder of the mass points in the grip of a tool."""
    return 1 + tool


def stuck_to(tool: int, tools: int) -> int:
    """Return the holder of the mass points that stick to a rough tool, one of `tools` tools."""
    return 1 + tools + tool


def contact_fields(tools: int, *, grips: bool = True) -> Places:
    """Return the fields of contact; without grips only the corrections.

    The hold of a gripped mass point is its displacement when the grip began [m]; that of a stuck one is its
    displacement relative to the tip.
    """
    return Places(corrections=[3] * tools, holder=int(grips), hold=3 * grips)


@dataclass(frozen=True)
class ContactTerm(Term):
    """Position-controlled tools."""

    shapes: tuple[str, ...]  # for each tool, the name of its shape; empty for a clamp
    has_friction: tuple[bool, ...]  # for each tool, whether it has friction
    grips: bool  # whether any tool holds mass points, by a grip, as a clamp or as a rough tool

    @classmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        tools, solids, numbers = plan.tools, solid_tools(plan.tools), range(len(plan.tools))
        if not tools:
            return None
        return cls(
            shapes=tuple(solids[n].shape.name if n in solids else "" for n in numbers),
            has_friction=tuple(n in solids and solids[n].friction > 0 for n in numbers),
            grips=bool(clamps(tools)) or any(tool.grips or tool.rough for tool in tools),
        )

    @property
    def memory(self) -> tuple[str, ...]:
        names = tuple(f"correction {tool} {axis}" for tool in range(len(self.shapes)) for axis in "xyz")
        return (*names, "holder", *(f"held {axis}" for axis in "xyz")) if self.grips else names

    def has_history(self, plan: Plan) -> bool:
        """Return whether any tool is rough."""
        return any(tool.rough for tool in plan.tools)

    @property
    def field_places(self) -> Places:
        return contact_fields(len(self.shapes), grips=self.grips)

    def fields(self, plan: Plan) -> NDArray[Any]:
        fields = super().fields(plan)
        for n, clamp in clamps(plan.tools).items():
            fields[self.field_places.holder, clamp.points] = held_by(n)
        return fields

    @property
    def column_places(self) -> Places:
        # For all tools the weight of the step's corrections, then the columns of each.
        return Places(weight=1, tools=[TOOL] * len(self.shapes))

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        grid, steps = plan.grid, first + np.arange(len(loads.active) + 1)
        t, frame = steps / grid.steps_per_second, 1 / grid.frames_per_second
        _, gain, first_gain = plan.step_coefficients
        places = self.column_places
        columns = np.zeros((len(loads.active), places.count))
        # The first step has another gain, so the force of its corrections differs.
        columns[:, places.weight] = np.where(steps[:-1] == 0, gain / first_gain, 1.0)
        for tool, at in zip(plan.tools, places.tools, strict=True):
            centres = tool.path_at(t)
            columns[:, at.tip_after], columns[:, at.tip_before] = centres[1:], centres[:-1]
            for begin, end in tool.grips:
                # The first steps at or after these times, up to rounding.
                start, stop = (
                    max(0, math.ceil((time - FRAME_TOLERANCE * frame) * grid.steps_per_second)) for time in (begin, end)
                )
                active = (steps[:-1] >= start) & (steps[:-1] < stop)
                columns[active, at.grip_state] = np.where(steps[:-1] == start, GRIP_BEGINS, GRIP_CONTINUES)[active]
                centre_at_start = tool.path_at(np.array([start / grid.steps_per_second]))
                columns[np.ix_(active, at.grip_shift)] = (centres[1:] - centre_at_start)[active]
        for n in clamps(plan.tools):
            at = places.tools[n]
            columns[:, at.grip_state], columns[:, at.grip_shift] = GRIP_CONTINUES, columns[:, at.tip_after]
        for n, solid in solid_tools(plan.tools).items():
            at = places.tools[n]
            columns[:, at.axis], columns[:, at.axis_length] = solid.axis, solid.length
            columns[:, at.radius], columns[:, at.friction] = solid.radius, solid.friction
            inverse = [1 / slope if abs(slope) > MIN_DISTANCE_M else 1 / MIN_DISTANCE_M for slope in solid.axis[1:]]
            columns[:, at.inverse_axis] = inverse
        return columns

    def supports(self, compiled: Self) -> str:
        if self.shapes != compiled.shapes:
            return "the shape of an instrument cannot change; restart with the new scene"
        friction = zip(self.has_friction, compiled.has_friction, strict=True)
        if all(needed <= available for needed, available in friction) and self.grips <= compiled.grips:
            return ""
        return (
            "friction and grips cannot be added to a tool later; restart with the new scene, or begin with friction: "
            "1e-9 (rough in quasi-static scenes) or with a grip that ends before 0 s"
        )

    def build_correction(self, config: KernelConfig) -> Correction:
        return Correction(self._build_reaches(config), self._build_resolve(config))

    def build_rest_correction(self, config: KernelConfig) -> RestCorrection:
        return RestCorrection(self._build_remove(config), self._build_project(config))

    @property
    def _solids(self) -> list[int]:
        """Indices of the tools with a shape."""
        return [n for n, shape in enumerate(self.shapes) if shape]

    def _build_reaches(self, config: KernelConfig) -> Callable[..., Any]:
        ti, real, vector, grips = config.ti, config.real, config.vector, self.grips
        max_lane, columns, fields = build_max_lane(config), config.columns(ContactTerm), config.fields(ContactTerm)
        solids, curved = [columns.tools[n] for n in self._solids], config.curved

        @ti.func
        def cut(low, high, begin, end, start, inverse):
            """Clip the interval [begin, end] of s to the part in which low <= start + s / inverse <= high."""
            at_low, at_high = (low - start) * inverse, (high - start) * inverse
            return ti.max(begin, ti.min(at_low, at_high)), ti.min(end, ti.max(at_low, at_high))

        @ti.func
        def reaches(sheet: ti.template(), i, low: ti.template(), high: ti.template(), now: ti.template()):
            y, reached = ti.cast(0, real), False
            if ti.static(not curved):
                y = sheet.constants[TOP_Y] - i * sheet.constants[DY]
            for tool in ti.static(solids):
                # Slightly more than the radius, because of rounding.
                reach = 1.001 * now[tool.radius]
                begin, end = cut(
                    y + low[0] - reach, y + high[0] + reach, ti.cast(0, real), now[tool.axis_length],
                    now[tool.tip_after[1]], now[tool.inverse_axis[0]],
                )  # fmt: skip
                begin, end = cut(
                    low[1] - reach, high[1] + reach, begin, end, now[tool.tip_after[2]], now[tool.inverse_axis[1]]
                )
                reached = reached or begin <= end
                if ti.static(grips):
                    reached = reached or now[tool.grip_state] == GRIP_BEGINS
            if ti.static(grips):
                held = vector(0)
                for b in range(1, sheet.width - 1):
                    held = ti.max(held, sheet.fields[(fields.holder * sheet.rows + i) * sheet.width + b])
                reached = reached or max_lane(held) > 0
            return reached

        return reaches

    def _build_resolve(self, config: KernelConfig) -> Callable[..., None]:
        ti, vector, has_friction, grips = config.ti, config.vector, self.has_friction, self.grips
        columns, fields, max_lane = config.columns(ContactTerm), config.fields(ContactTerm), build_max_lane(config)
        mobility, _, rest_position = build_point_functions(config)
        penetrations = {n: self._build_penetration(config, n) for n in self._solids}
        tools, holders = columns.tools, [held_by(n) for n in range(len(self.shapes))]

        @ti.func
        def resolve(sheet: ti.template(), i, kind, at, b, now: ti.template()):
            rows, entry, point = sheet.rows, at * sheet.width + b, i * sheet.width + b
            rest = rest_position(sheet, i, b)
            u, d = [sheet.u[c][entry] for c in ti.static(range(3))], [sheet.d[c][point] for c in ti.static(range(3))]
            free = ti.select(mobility(sheet, i, kind, b) > 0, vector(1), vector(0))
            held = vector(0)
            if ti.static(grips):
                held = sheet.fields[fields.holder * rows * sheet.width + point]
                # All grips that end release their mass points before any other grip begins.
                for n, tool in ti.static(enumerate(tools)):
                    if now[tool.grip_state] != GRIP_CONTINUES:
                        held = ti.select(held == holders[n], vector(FREE), held)
                for n, tool in ti.static(enumerate(tools)):
                    if now[tool.grip_state] == GRIP_BEGINS:
                        squared = vector(0)
                        for c in ti.static(range(3)):
                            offset = rest[c] + (u[c] - d[c]) - now[tool.tip_before[c]]
                            squared += offset * offset
                        radius = GRIP_RADII * now[tool.radius]
                        gripped = ti.select(squared <= radius * radius, free, vector(0)) * ti.select(
                            held == FREE, vector(1), vector(0)
                        )
                        held += gripped * holders[n]
                        for c in ti.static(range(3)):
                            stored = fields.hold[c] * rows * sheet.width + point
                            sheet.fields[stored] = ti.select(gripped > 0, u[c] - d[c], sheet.fields[stored])
                sheet.fields[fields.holder * rows * sheet.width + point] = held
                free = ti.select(held == FREE, free, vector(0))
            for n, tool in ti.static(enumerate(tools)):
                depth, normal = vector(0), [vector(0) for _ in ti.static(range(3))]
                if ti.static(n in penetrations):
                    inside, normal_x, normal_y, normal_z = penetrations[n](rest, u, now)
                    depth = ti.max(inside, 0) * free
                    normal[0], normal[1], normal[2] = normal_x, normal_y, normal_z
                corrected = depth
                if ti.static(grips):
                    corrected = ti.select(held == holders[n], vector(1), depth)
                if max_lane(corrected) > 0:
                    correction = [depth * normal[c] for c in ti.static(range(3))]
                    if ti.static(has_friction[n]):
                        slip = [
                            d[c] + correction[c] - (now[tool.tip_after[c]] - now[tool.tip_before[c]])
                            for c in ti.static(range(3))
                        ]
                        normal_slip = vector(0)
                        for c in ti.static(range(3)):
                            normal_slip += slip[c] * normal[c]
                        squared_slip = vector(0)
                        for c in ti.static(range(3)):
                            slip[c] = slip[c] - normal_slip * normal[c]
                            squared_slip += slip[c] * slip[c]
                        stopped = now[tool.friction] * depth / ti.max(ti.sqrt(squared_slip), MIN_DISTANCE_M)
                        stopped = ti.min(stopped, 1)
                        for c in ti.static(range(3)):
                            correction[c] = correction[c] - slip[c] * stopped
                    if ti.static(grips):
                        for c in ti.static(range(3)):
                            target = sheet.fields[fields.hold[c] * rows * sheet.width + point]
                            target += now[tool.grip_shift[c]]
                            correction[c] = ti.select(held == holders[n], target - u[c], correction[c])
                    for c in ti.static(range(3)):
                        # Lanes without a correction keep their bits, including the sign of zero.
                        u[c] = ti.select(corrected > 0, u[c] + correction[c], u[c])
                        d[c] = ti.select(corrected > 0, d[c] + correction[c], d[c])
                        sheet.u[c][entry], sheet.d[c][point] = u[c], d[c]
                        index = fields.corrections[n][c] * rows * sheet.width + point
                        # `+=` would be atomic, which does not compile for vectors.
                        sheet.fields[index] = sheet.fields[index] + correction[c] * now[columns.weight]

        return resolve

    def _build_remove(self, config: KernelConfig) -> Callable[..., None]:
        ti, vector, count, grips = config.ti, config.vector, len(self.shapes), self.grips
        fields, iterations = config.fields(ContactTerm), self._iterations

        @ti.func
        def remove(force: ti.template(), sheet: ti.template(), at):
            field = sheet.rows * sheet.width
            carried = [vector(0) for _ in ti.static(range(count))]
            for _ in range(iterations):
                for n in ti.static(range(count)):
                    normal = [sheet.fields[fields.corrections[n][c] * field + at] for c in ti.static(range(3))]
                    along = force[0] * normal[0] + force[1] * normal[1] + force[2] * normal[2]
                    total = ti.max(carried[n] - along, 0)
                    change = total - carried[n]
                    carried[n] = total
                    for c in ti.static(range(3)):
                        force[c] += change * normal[c]
            if ti.static(grips):
                for c in ti.static(range(3)):
                    force[c] = ti.select(sheet.fields[fields.holder * field + at] > 0, vector(0), force[c])

        return remove

    def _build_project(self, config: KernelConfig) -> Callable[..., None]:
        """Build the function that projects mass points and their momenta out of the tools, and moves held ones."""
        ti, vector, count, grips, solids = config.ti, config.vector, len(self.shapes), self.grips, self._solids
        tools, fields, iterations = config.columns(ContactTerm).tools, config.fields(ContactTerm), self._iterations
        mobility, _, rest_position = build_point_functions(config)
        penetrations = {n: self._build_penetration(config, n) for n in solids}
        # Holders, and the columns with the shift of their mass points: of grips, and of rough tools.
        holders = [(held_by(n), tools[n].grip_shift) for n in range(count)]
        holders += [(stuck_to(n, count), tools[n].tip_after) for n in range(count) if self.has_friction[n]]

        @ti.func
        def project(sheet: ti.template(), i, kind, b, now: ti.template()):
            field, at = sheet.rows * sheet.width, i * sheet.width + b
            rest = rest_position(sheet, i, b)
            u, q = [sheet.u[c][at] for c in ti.static(range(3))], [sheet.q[c][at] for c in ti.static(range(3))]
            free = ti.select(mobility(sheet, i, kind, b) > 0, vector(1), vector(0))
            if ti.static(grips):
                held = sheet.fields[fields.holder * field + at]
                for holder, shift in ti.static(holders):
                    for c in ti.static(range(3)):
                        target = sheet.fields[fields.hold[c] * field + at] + now[shift[c]]
                        u[c] = ti.select(held == holder, target, u[c])
                        q[c] = ti.select(held == holder, vector(0), q[c])
                free = ti.select(held > 0, vector(0), free)
            for n in ti.static(solids):
                for c in ti.static(range(3)):
                    sheet.fields[fields.corrections[n][c] * field + at] = vector(0)
            for _ in range(iterations):
                for n in ti.static(solids):
                    depth, x, y, z = penetrations[n](rest, u, now)
                    normal = [x, y, z]
                    touches = ti.select(depth > 0, free, vector(0))
                    inward = ti.min(q[0] * x + q[1] * y + q[2] * z, 0) * touches
                    for c in ti.static(range(3)):
                        u[c] += touches * depth * normal[c]
                        q[c] = q[c] - inward * normal[c]
                        index = fields.corrections[n][c] * field + at
                        sheet.fields[index] = ti.select(touches > 0, normal[c], sheet.fields[index])
            for c in ti.static(range(3)):
                sheet.u[c][at] = u[c]
                sheet.q[c][at] = q[c]

        return project

    def _build_penetration(self, config: KernelConfig, n: int) -> Callable[..., Any]:
        """Build the Taichi function penetration(rest, u, now), the depth in tool n and the outward normal."""
        ti, tool = config.ti, config.columns(ContactTerm).tools[n]
        depth = ti.func(SHAPES[self.shapes[n]].build_depth(config.operations))

        @ti.func
        def penetration(rest: ti.template(), u: ti.template(), now: ti.template()):
            r = [rest[c] - now[tool.tip_after[c]] + u[c] for c in ti.static(range(3))]
            axis = [now[tool.axis[c]] for c in ti.static(range(3))]
            return depth(r[0], r[1], r[2], axis[0], axis[1], axis[2], now[tool.axis_length], now[tool.radius])

        return penetration

    @property
    def _iterations(self) -> int:
        return MAX_ITERATIONS if len(self.shapes) > 1 else 1
