"""Contact, friction and grips of position-controlled tools. Scene: `probes` with `path`.

After each step, mass points that are neither fixed nor held are projected out of the tools' shapes, in the order of
the probes. With the displacement u after the step, the tip c of a tool, and the depth and normal n of X + u - c in its
shape (`taichi_msm.shapes`), the correction is

    where depth > 0:     correction = depth n
    with friction mu:    w = the part of (u + correction - u_before) - (c - c_before) perpendicular to n
                         correction -= w min(1, mu depth / |w|)

A grip holds the mass points that are within 1.5 radii of the tip's centre when it begins: u = u_then + c - c_then. A
clamp, a tool of radius 0, holds its mass points from the start: u = c. In a step, a correction has the effect of the
force m (1 + g h / 2) / h^2 times the correction (see `damping`). The sum of all corrections therefore yields the force
of the tool.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model import verlet
from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import GRIP_RADII, Clamp
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.shapes.shape import MIN_DISTANCE_M
from taichi_msm.terms.base import (
    DY,
    MOBILITY,
    REST_X,
    TOP_Y,
    Correction,
    KernelConfig,
    RestCorrection,
    Term,
    build_max_lane,
)
from taichi_msm.terms.contact_layout import (
    AXIS,
    COLUMNS,
    CORRECTIONS,
    FRICTION,
    GRIP_BEGINS,
    GRIP_CONTINUES,
    GRIP_SHIFT,
    GRIP_STATE,
    HOLD_DISPLACEMENT,
    HOLDER,
    INVERSE_AXIS,
    LENGTH,
    RADIUS,
    TIP_AFTER,
    TIP_BEFORE,
    TOOL_COLUMNS,
    WEIGHT,
    ContactLayout,
    build_penetration,
)
from taichi_msm.terms.contact_rest import build_project_out, build_remove_contact


@dataclass(frozen=True)
class ContactTerm(Term):
    """Position-controlled tools."""

    shapes: tuple[str, ...]  # name of the shape of every tool
    has_friction: tuple[bool, ...]  # whether each tool has friction
    grips: bool  # whether any tool can hold tissue, as grips, clamps and rough tools do

    @classmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        """Return the term's configuration; None without position-controlled tools."""
        tools = plan.tools
        grips = any(tool.grips or tool.rough or isinstance(tool, Clamp) for tool in tools)
        shapes = tuple(tool.shape.name for tool in tools)
        return cls(shapes, tuple(tool.friction > 0 for tool in tools), grips) if tools else None

    @property
    def memory(self) -> tuple[str, ...]:
        """The corrections of every tool, and with grips the held mass points."""
        names = tuple(f"correction {tool} {axis}" for tool in range(len(self.shapes)) for axis in "xyz")
        return (*names, "holder", *(f"held {axis}" for axis in "xyz")) if self.grips else names

    def fields(self, plan: Plan) -> NDArray[Any]:
        """Return the initial values of the fields, in which clamps hold their mass points."""
        fields = super().fields(plan)
        for n, tool in enumerate(plan.tools):
            if isinstance(tool, Clamp):
                fields[CORRECTIONS * len(plan.tools) + HOLDER, tool.points] = n + 1
        return fields

    @property
    def column_count(self) -> int:
        """Number of columns: the weight, and the columns of each tool."""
        return COLUMNS + TOOL_COLUMNS * len(self.shapes)

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        """Compute the positions of the tools before and after every step and the states of their grips."""
        grid, steps = plan.grid, first + np.arange(len(loads.active) + 1)
        t, frame = steps / grid.steps_per_second, 1 / grid.frames_per_second
        _, gain, first_gain = verlet.coefficients(plan)
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
        """Return the reason why kernels compiled for other tools do not support these tools."""
        if self.shapes != compiled.shapes:
            return "the shape of an instrument cannot change; restart with the new scene"
        friction = zip(self.has_friction, compiled.has_friction, strict=True)
        if all(needed <= available for needed, available in friction) and self.grips <= compiled.grips:
            return ""
        return (
            "friction and grips cannot be added where there were none; restart with the new scene, such as with a "
            "friction of 1e-9, at rest rough, or with a grip that ends before the start"
        )

    def build_correction(self, config: KernelConfig) -> Correction:
        """Build the functions that project mass points out of the tools, and move held ones, after a step."""
        return Correction(self._build_reaches(config), self._build_resolve(config))

    def build_rest_correction(self, config: KernelConfig) -> RestCorrection:
        """Build the functions that remove the forces carried by tools, and project mass points out of them."""
        layout = self.layout(config)
        return RestCorrection(build_remove_contact(config, layout), build_project_out(config, layout))

    def layout(self, config: KernelConfig) -> ContactLayout:
        """Return the columns and fields of the term."""
        first_field, first_column = config.first_field(ContactTerm), config.first_column(ContactTerm)
        return ContactLayout(self.shapes, self.has_friction, self.grips, first_field, first_column)

    def _build_reaches(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function reaches(sheet, i, low, high, now).

        It returns whether a tool may touch or hold mass points of row `i`. In it `low` and `high` bound the
        displacements of the row along y and z, two numbers each, and `now` is a row of the load table.
        """
        ti, real, vector, tools, grips = config.ti, config.real, config.vector, len(self.shapes), self.grips
        max_lane = build_max_lane(config)
        bases, holding = self.layout(config).bases, self.layout(config).grip_field + HOLDER

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
                    held = ti.max(held, sheet.fields[(holding * sheet.rows + i) * sheet.width + b])
                reached = reached or max_lane(held) > 0
            return reached

        return reaches

    def _build_resolve(self, config: KernelConfig) -> Callable[..., None]:
        """Build the Taichi function resolve(sheet, i, kind, at, b, now), which corrects entry b of row i.

        It is called after the step of the row. In it `kind` is that of a `KernelRow`, `at` the row of u, and `now` a
        row of the load table.
        """
        ti, vector, tools, has_friction, grips = (
            config.ti,
            config.vector,
            len(self.shapes),
            self.has_friction,
            self.grips,
        )
        layout, penetrations = self.layout(config), [build_penetration(config, shape) for shape in self.shapes]
        first_field, first, grip_field, base = layout.first_field, layout.first_column, layout.grip_field, layout.bases
        max_lane = build_max_lane(config)

        @ti.func
        def resolve(sheet: ti.template(), i, kind, at, b, now: ti.template()):
            rows, entry, point = sheet.rows, at * sheet.width + b, i * sheet.width + b
            rest = [
                sheet.by_column[REST_X * sheet.width + b],
                vector(sheet.constants[TOP_Y] - i * sheet.constants[DY]),
                vector(0),
            ]
            u, d = [sheet.u[c][entry] for c in ti.static(range(3))], [sheet.d[c][point] for c in ti.static(range(3))]
            free = ti.select(sheet.by_column[(MOBILITY + kind) * sheet.width + b] > 0, vector(1), vector(0))
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
                        sheet.fields[index] = sheet.fields[index] + correction[c] * now[first + WEIGHT]

        return resolve
