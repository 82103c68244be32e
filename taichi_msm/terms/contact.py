"""Contact, friction and grips of position-controlled tools. Scene: `probes` with `path`.

In dynamic scenes, contact corrects the displacements u of the mass points after each step, one tool after the other in
the order of `probes`. In the shape of a tool with the tip c, X + u - c has a depth and an outward normal n
(`taichi_msm.shapes`). Mass points with depth > 0, neither fixed nor held, are projected out of the shape, and the
friction mu reduces their slip; u' and c' are those before the step:

    slip = (u + depth n - u') - (c - c'),    w = slip - (slip . n) n
    correction = depth n - w min(1, mu depth / |w|)

A correction has the effect of the force correction / gain (`integrators`), so the corrections yield the force of the
tool.

A grip holds the mass points within 1.5 radii of the tip's centre at its start: u = u_start + c - c_start. A clamp, a
tool of radius 0 whose c is a displacement, holds its side from the start of the run: u = c.

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
from taichi_msm.model.tools import GRIP_RADII, Clamp
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.shapes import SHAPES
from taichi_msm.shapes.shape import MIN_DISTANCE_M
from taichi_msm.terms.base import DY, TOP_Y, Correction, KernelConfig, RestCorrection, Term, build_max_lane
from taichi_msm.terms.points import build_point_functions

# Columns of the load table. For all tools: the weight of the step's corrections. For each tool: the tip's centre after
# and before the step; the state of its grip, and the tool's displacement since the grip began; axis, length, radius and
# friction; the reciprocals of y and z of the axis.
WEIGHT, COLUMNS = 0, 1
TIP_AFTER, TIP_BEFORE, GRIP_STATE, GRIP_SHIFT, AXIS = 0, 3, 6, 7, 10
LENGTH, RADIUS, FRICTION, INVERSE_AXIS, TOOL_COLUMNS = 13, 14, 15, 16, 18

# States of a grip in a step; 0 without one.
GRIP_BEGINS, GRIP_CONTINUES = 1.0, 2.0

# Fields: for each tool, the sum of the corrections (3); with grips, the holder of a mass point and a displacement (3):
#     free                     0
#     held by tool n           n + 1             displacement when the grip began
#     stuck to rough tool n    tools + n + 1     displacement relative to the tip (`contact_rest`)
CORRECTIONS, HOLDER, HOLD_DISPLACEMENT = 3, 0, 1


@dataclass(frozen=True)
class ContactTerm(Term):
    """Position-controlled tools."""

    shapes: tuple[str, ...]  # for each tool, the name of its shape
    has_friction: tuple[bool, ...]  # for each tool, whether it has friction
    grips: bool  # whether any tool holds mass points, by a grip, as a clamp or as a rough tool

    @classmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        tools = plan.tools
        grips = any(tool.grips or tool.rough or isinstance(tool, Clamp) for tool in tools)
        shapes = tuple(tool.shape.name for tool in tools)
        return cls(shapes, tuple(tool.friction > 0 for tool in tools), grips) if tools else None

    @property
    def memory(self) -> tuple[str, ...]:
        names = tuple(f"correction {tool} {axis}" for tool in range(len(self.shapes)) for axis in "xyz")
        return (*names, "holder", *(f"held {axis}" for axis in "xyz")) if self.grips else names

    def has_history(self, plan: Plan) -> bool:
        """Return whether any tool is rough."""
        return any(tool.rough for tool in plan.tools)

    def fields(self, plan: Plan) -> NDArray[Any]:
        fields = super().fields(plan)
        for n, tool in enumerate(plan.tools):
            if isinstance(tool, Clamp):
                fields[CORRECTIONS * len(plan.tools) + HOLDER, tool.points] = n + 1
        return fields

    @property
    def column_count(self) -> int:
        return COLUMNS + TOOL_COLUMNS * len(self.shapes)

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        grid, steps = plan.grid, first + np.arange(len(loads.active) + 1)
        t, frame = steps / grid.steps_per_second, 1 / grid.frames_per_second
        _, gain, first_gain = plan.step_coefficients
        columns = np.zeros((len(loads.active), self.column_count))
        # The first step has another gain, so the force of its corrections differs.
        columns[:, WEIGHT] = np.where(steps[:-1] == 0, gain / first_gain, 1.0)
        for n, tool in enumerate(plan.tools):
            tool_columns = columns[:, COLUMNS + TOOL_COLUMNS * n : COLUMNS + TOOL_COLUMNS * (n + 1)]
            centres = tool.tip_centre(t)
            tool_columns[:, TIP_AFTER:TIP_BEFORE], tool_columns[:, TIP_BEFORE:GRIP_STATE] = centres[1:], centres[:-1]
            inverse = [1 / slope if abs(slope) > MIN_DISTANCE_M else 1 / MIN_DISTANCE_M for slope in tool.axis[1:]]
            tool_columns[:, AXIS:] = *tool.axis, tool.length, tool.radius, tool.friction, *inverse
            if isinstance(tool, Clamp):
                tool_columns[:, GRIP_STATE] = GRIP_CONTINUES
                tool_columns[:, GRIP_SHIFT:AXIS] = centres[1:]
            for begin, end in tool.grips:
                # The first steps at or after these times, up to rounding.
                start, stop = (
                    max(0, math.ceil((time - FRAME_TOLERANCE * frame) * grid.steps_per_second)) for time in (begin, end)
                )
                active = (steps[:-1] >= start) & (steps[:-1] < stop)
                tool_columns[active, GRIP_STATE] = np.where(steps[:-1] == start, GRIP_BEGINS, GRIP_CONTINUES)[active]
                centre_at_start = tool.tip_centre(np.array([start / grid.steps_per_second]))
                tool_columns[active, GRIP_SHIFT:AXIS] = (centres[1:] - centre_at_start)[active]
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

    def _places(self, config: KernelConfig) -> tuple[int, int, list[int]]:
        """Return the indices of the first field, of the first field of grips, and of the first column of each tool."""
        field, column = config.first_field(ContactTerm), config.first_column(ContactTerm) + COLUMNS
        tools = len(self.shapes)
        return field, field + CORRECTIONS * tools, [column + TOOL_COLUMNS * tool for tool in range(tools)]

    def _build_reaches(self, config: KernelConfig) -> Callable[..., Any]:
        ti, real, vector, tools, grips = config.ti, config.real, config.vector, len(self.shapes), self.grips
        max_lane = build_max_lane(config)
        _, grip_field, bases = self._places(config)
        holder_field = grip_field + HOLDER

        @ti.func
        def cut(low, high, begin, end, start, inverse):
            """Clip the interval [begin, end] of s to the part in which low <= start + s / inverse <= high."""
            at_low, at_high = (low - start) * inverse, (high - start) * inverse
            return ti.max(begin, ti.min(at_low, at_high)), ti.min(end, ti.max(at_low, at_high))

        @ti.func
        def reaches(sheet: ti.template(), i, low: ti.template(), high: ti.template(), now: ti.template()):
            y, reached = sheet.constants[TOP_Y] - i * sheet.constants[DY], False
            for tool in ti.static(range(tools)):
                base = ti.static(bases[tool])
                # Slightly more than the radius, because of rounding.
                reach = 1.001 * now[base + RADIUS]
                begin, end = cut(
                    y + low[0] - reach, y + high[0] + reach, ti.cast(0, real), now[base + LENGTH],
                    now[base + TIP_AFTER + 1], now[base + INVERSE_AXIS],
                )  # fmt: skip
                begin, end = cut(
                    low[1] - reach, high[1] + reach, begin, end, now[base + TIP_AFTER + 2], now[base + INVERSE_AXIS + 1]
                )
                reached = reached or begin <= end
                if ti.static(grips):
                    reached = reached or now[base + GRIP_STATE] == GRIP_BEGINS
            if ti.static(grips):
                held = vector(0)
                for b in range(1, sheet.width - 1):
                    held = ti.max(held, sheet.fields[(holder_field * sheet.rows + i) * sheet.width + b])
                reached = reached or max_lane(held) > 0
            return reached

        return reaches

    def _build_resolve(self, config: KernelConfig) -> Callable[..., None]:
        ti, vector, tools, has_friction = config.ti, config.vector, len(self.shapes), self.has_friction
        (first_field, grip_field, base), grips = self._places(config), self.grips
        weight, max_lane = config.first_column(ContactTerm) + WEIGHT, build_max_lane(config)
        mobility, _, rest_position = build_point_functions(config)
        penetrations = [_build_penetration(config, shape) for shape in self.shapes]

        @ti.func
        def resolve(sheet: ti.template(), i, kind, at, b, now: ti.template()):
            rows, entry, point = sheet.rows, at * sheet.width + b, i * sheet.width + b
            rest = rest_position(sheet, i, b)
            u, d = [sheet.u[c][entry] for c in ti.static(range(3))], [sheet.d[c][point] for c in ti.static(range(3))]
            free = ti.select(mobility(sheet, i, kind, b) > 0, vector(1), vector(0))
            held = vector(0)
            if ti.static(grips):
                held = sheet.fields[(grip_field + HOLDER) * rows * sheet.width + point]
                # All grips that end release their mass points before any other grip begins.
                for tool in ti.static(range(tools)):
                    if now[base[tool] + GRIP_STATE] != GRIP_CONTINUES:
                        held = ti.select(held == tool + 1, vector(0), held)
                for tool in ti.static(range(tools)):
                    if now[base[tool] + GRIP_STATE] == GRIP_BEGINS:
                        squared = vector(0)
                        for c in ti.static(range(3)):
                            offset = rest[c] + (u[c] - d[c]) - now[base[tool] + TIP_BEFORE + c]
                            squared += offset * offset
                        radius = GRIP_RADII * now[base[tool] + RADIUS]
                        gripped = ti.select(squared <= radius * radius, free, vector(0)) * ti.select(
                            held == 0, vector(1), vector(0)
                        )
                        held += gripped * (tool + 1)
                        for c in ti.static(range(3)):
                            stored = (grip_field + HOLD_DISPLACEMENT + c) * rows * sheet.width + point
                            sheet.fields[stored] = ti.select(gripped > 0, u[c] - d[c], sheet.fields[stored])
                sheet.fields[(grip_field + HOLDER) * rows * sheet.width + point] = held
                free = ti.select(held == 0, free, vector(0))
            for tool in ti.static(range(tools)):
                inside, normal_x, normal_y, normal_z = penetrations[tool](rest, u, now, base[tool])
                depth = ti.max(inside, 0) * free
                corrected = depth
                if ti.static(grips):
                    corrected = ti.select(held == tool + 1, vector(1), depth)
                if max_lane(corrected) > 0:
                    normal = [normal_x, normal_y, normal_z]
                    correction = [depth * normal[c] for c in ti.static(range(3))]
                    if ti.static(has_friction[tool]):
                        slip = [
                            d[c] + correction[c] - (now[base[tool] + TIP_AFTER + c] - now[base[tool] + TIP_BEFORE + c])
                            for c in ti.static(range(3))
                        ]
                        normal_slip = vector(0)
                        for c in ti.static(range(3)):
                            normal_slip += slip[c] * normal[c]
                        squared_slip = vector(0)
                        for c in ti.static(range(3)):
                            slip[c] = slip[c] - normal_slip * normal[c]
                            squared_slip += slip[c] * slip[c]
                        stopped = now[base[tool] + FRICTION] * depth / ti.max(ti.sqrt(squared_slip), MIN_DISTANCE_M)
                        stopped = ti.min(stopped, 1)
                        for c in ti.static(range(3)):
                            correction[c] = correction[c] - slip[c] * stopped
                    if ti.static(grips):
                        for c in ti.static(range(3)):
                            target = sheet.fields[(grip_field + HOLD_DISPLACEMENT + c) * rows * sheet.width + point]
                            target += now[base[tool] + GRIP_SHIFT + c]
                            correction[c] = ti.select(held == tool + 1, target - u[c], correction[c])
                    for c in ti.static(range(3)):
                        # Lanes without a correction keep their bits, including the sign of zero.
                        u[c] = ti.select(corrected > 0, u[c] + correction[c], u[c])
                        d[c] = ti.select(corrected > 0, d[c] + correction[c], d[c])
                        sheet.u[c][entry], sheet.d[c][point] = u[c], d[c]
                        index = (first_field + CORRECTIONS * tool + c) * rows * sheet.width + point
                        # `+=` would be atomic, which does not compile for vectors.
                        sheet.fields[index] = sheet.fields[index] + correction[c] * now[weight]

        return resolve

    def _build_remove(self, config: KernelConfig) -> Callable[..., None]:
        ti, vector, tools, grips = config.ti, config.vector, len(self.shapes), self.grips
        first_field, grip_field, _ = self._places(config)
        holder_field, iterations = grip_field + HOLDER, self._iterations

        @ti.func
        def remove(force: ti.template(), sheet: ti.template(), at):
            field = sheet.rows * sheet.width
            carried = [vector(0) for _ in ti.static(range(tools))]
            for _ in range(iterations):
                for tool in ti.static(range(tools)):
                    normal = [
                        sheet.fields[(first_field + CORRECTIONS * tool + c) * field + at] for c in ti.static(range(3))
                    ]
                    along = force[0] * normal[0] + force[1] * normal[1] + force[2] * normal[2]
                    total = ti.max(carried[tool] - along, 0)
                    change = total - carried[tool]
                    carried[tool] = total
                    for c in ti.static(range(3)):
                        force[c] += change * normal[c]
            if ti.static(grips):
                for c in ti.static(range(3)):
                    force[c] = ti.select(sheet.fields[holder_field * field + at] > 0, vector(0), force[c])

        return remove

    def _build_project(self, config: KernelConfig) -> Callable[..., None]:
        """Build the function that projects mass points and their momenta out of the tools, and moves held ones."""
        ti, vector, tools, grips = config.ti, config.vector, len(self.shapes), self.grips
        (first_field, grip_field, base), iterations = self._places(config), self._iterations
        mobility, _, rest_position = build_point_functions(config)
        penetrations = [_build_penetration(config, shape) for shape in self.shapes]
        # Holders, and the columns with the shift of their mass points: of grips, and of rough tools.
        holders = [(tool + 1, base[tool] + GRIP_SHIFT) for tool in range(tools)]
        holders += [(tools + tool + 1, base[tool] + TIP_AFTER) for tool in range(tools) if self.has_friction[tool]]

        @ti.func
        def project(sheet: ti.template(), i, kind, b, now: ti.template()):
            field, at = sheet.rows * sheet.width, i * sheet.width + b
            rest = rest_position(sheet, i, b)
            u, q = [sheet.u[c][at] for c in ti.static(range(3))], [sheet.q[c][at] for c in ti.static(range(3))]
            free = ti.select(mobility(sheet, i, kind, b) > 0, vector(1), vector(0))
            if ti.static(grips):
                held = sheet.fields[(grip_field + HOLDER) * field + at]
                for holder, shift in ti.static(holders):
                    for c in ti.static(range(3)):
                        target = sheet.fields[(grip_field + HOLD_DISPLACEMENT + c) * field + at] + now[shift + c]
                        u[c] = ti.select(held == holder, target, u[c])
                        q[c] = ti.select(held == holder, vector(0), q[c])
                free = ti.select(held > 0, vector(0), free)
            for tool in ti.static(range(tools)):
                for c in ti.static(range(3)):
                    sheet.fields[(first_field + CORRECTIONS * tool + c) * field + at] = vector(0)
            for _ in range(iterations):
                for tool in ti.static(range(tools)):
                    depth, x, y, z = penetrations[tool](rest, u, now, base[tool])
                    normal = [x, y, z]
                    touches = ti.select(depth > 0, free, vector(0))
                    inward = ti.min(q[0] * x + q[1] * y + q[2] * z, 0) * touches
                    for c in ti.static(range(3)):
                        u[c] += touches * depth * normal[c]
                        q[c] = q[c] - inward * normal[c]
                        index = (first_field + CORRECTIONS * tool + c) * field + at
                        sheet.fields[index] = ti.select(touches > 0, normal[c], sheet.fields[index])
            for c in ti.static(range(3)):
                sheet.u[c][at] = u[c]
                sheet.q[c][at] = q[c]

        return project

    @property
    def _iterations(self) -> int:
        return 8 if len(self.shapes) > 1 else 1


def _build_penetration(config: KernelConfig, shape: str) -> Callable[..., Any]:
    """Build penetration(rest, u, now, base), the depth in a tool with first column `base`, and the outward normal."""
    ti = config.ti
    depth = ti.func(SHAPES[shape].build_depth(config.operations))

    @ti.func
    def penetration(rest: ti.template(), u: ti.template(), now: ti.template(), base: ti.template()):
        r = [rest[c] - now[base + TIP_AFTER + c] + u[c] for c in ti.static(range(3))]
        return depth(
            r[0], r[1], r[2], now[base + AXIS], now[base + AXIS + 1], now[base + AXIS + 2], now[base + LENGTH],
            now[base + RADIUS],
        )  # fmt: skip

    return penetration
