"""Contact, friction and grips: the tools that are moved, which no point may be in. Scene: `probes` with `path`.

After each step, the points that neither are fixed nor are held are pushed out of the rods, in the order of the probes.
u is what the step gives, c the middle of a rod's tip and a its axis:

    r = X + u - c,   s = clamp(r . a, 0, length),   r' = r - s a,   n = r' / |r'|  (+z if r' = 0)
    where |r'| < radius:   push = (radius - |r'|) n
    with friction mu:      w = the part of (u + push - u_before) - (c - c_before) that is perpendicular to n
                           push = push - w min(1, mu (radius - |r'|) / |w|)

A grip holds the points that are within 1.5 radius of the tip when it begins: u = u_then + c - c_then. A push is what a
force of push m (1 + g h / 2) / h^2 would do in a step (see `damping`), so the pushes add up to the force of the tool.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import GRASP
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.scene.tools import Probe
from taichi_msm.terms.base import ACROSS, DY, MOVES, TOP, StepCode, Term
from taichi_msm.terms.damping import coefficients

# Columns of the table of loads. For all tools: the weight of a step's pushes. For each tool: the middle of its tip
# after the step and before it; what its grip does, and how far it has come since that began; its shape and friction;
# 1 / the y and the z of its axis.
WEIGHT, COLUMNS = 0, 1
AFTER, BEFORE, GRIP, SINCE, AXIS, LENGTH, RADIUS, FRICTION, INVERSE, TOOL_COLUMNS = 0, 3, 6, 7, 10, 13, 14, 15, 16, 18

# What a grip does in a step: nothing, begin, or go on.
IDLE, BEGINS, GOES_ON = 0.0, 1.0, 2.0

# Fields: for every tool the sum of the pushes; with grips, which tool holds a point, plus 1, and u when it was taken.
PUSHES, HELD, TAKEN, GRIP_FIELDS = 3, 0, 1, 4

# A distance [m] that counts as none: its square is a number in f32 too.
NONE = 1e-18


@dataclass(frozen=True)
class ContactTerm(Term):
    """The tools that are moved."""

    tools: int  # how many there are
    rubs: tuple[bool, ...]  # for each, whether it has friction
    grips: bool  # whether any can hold tissue

    @classmethod
    def of(cls, plan: Plan) -> Self | None:
        """Leave it out without tools that are moved."""
        tools = plan.tools
        grips = any(tool.grips for tool in tools)
        return cls(len(tools), tuple(tool.friction > 0 for tool in tools), grips) if tools else None

    @property
    def field_count(self) -> int:
        """The pushes of every tool, and with grips what they hold."""
        return _field_count(self.tools, self.grips)

    def fields(self, plan: Plan) -> NDArray[Any]:
        """Give no pushes, and nothing held."""
        return np.zeros((self.field_count, *plan.scene.sheet.points))

    @property
    def column_count(self) -> int:
        """A few columns for each tool."""
        return COLUMNS + TOOL_COLUMNS * self.tools

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        """Give the places of the tools before and after every step, and what their grips do in it."""
        grid, steps = plan.grid, first + np.arange(len(loads.active) + 1)
        t, frame = steps / grid.steps_per_second, 1 / grid.frames_per_second
        _, gain, first_gain = coefficients(plan)
        columns = np.zeros((len(loads.active), self.column_count))
        # A push of the first step takes another force, as its gain is another.
        columns[:, WEIGHT] = np.where(steps[:-1] == 0, gain / first_gain, 1.0)
        for n, tool in enumerate(plan.tools):
            own = columns[:, COLUMNS + TOOL_COLUMNS * n : COLUMNS + TOOL_COLUMNS * (n + 1)]
            places = tool.middle(t)
            own[:, AFTER:BEFORE], own[:, BEFORE:GRIP] = places[1:], places[:-1]
            inverse = [1 / slope if abs(slope) > NONE else 1 / NONE for slope in tool.axis[1:]]
            own[:, AXIS:] = *tool.axis, tool.length, tool.radius, tool.friction, *inverse
            for begin, end in tool.grips:
                # The first steps at or after these times, but for rounding.
                taken, left = (
                    max(0, math.ceil((at - FRAME_TOLERANCE * frame) * grid.steps_per_second)) for at in (begin, end)
                )
                held = (steps[:-1] >= taken) & (steps[:-1] < left)
                own[held, GRIP] = np.where(steps[:-1] == taken, BEGINS, GOES_ON)[held]
                own[held, SINCE:AXIS] = (places[1:] - tool.middle(np.array([taken / grid.steps_per_second])))[held]
        return columns

    def is_compiled_in(self, compiled: Self) -> bool:
        """Tell whether a kernel that was compiled for `compiled` does all that these tools need."""
        rubs = all(rubs <= able for rubs, able in zip(self.rubs, compiled.rubs, strict=True))
        return rubs and self.grips <= compiled.grips

    def reaching(self, code: StepCode) -> Callable[..., Any]:
        """Make Taichi's function reaches(sheet, i, low, high, now): whether a tool may touch or hold a point of row i.

        The displacements of the row along y and z are between `low` and `high`, two numbers each.
        """
        ti, real, vector, tools, grips = code.ti, code.real, code.vector, self.tools, self.grips
        greatest = greatest_lane(code)
        first = code.first_column(ContactTerm) + COLUMNS
        holding = (code.first_field(ContactTerm) + PUSHES * tools + HELD) if grips else 0

        @ti.func
        def cut(low, high, begin, end, start, inverse):
            """Cut the part of a line, from `begin` to `end`, where start + s / inverse is between two numbers."""
            one, other = (low - start) * inverse, (high - start) * inverse
            return ti.max(begin, ti.min(one, other)), ti.min(end, ti.max(one, other))

        @ti.func
        def reaches(sheet: ti.template(), i, low: ti.template(), high: ti.template(), now: ti.template()):
            y, reached = sheet.numbers[TOP] - i * sheet.numbers[DY], False
            for tool in ti.static(range(tools)):
                own = ti.static(first + TOOL_COLUMNS * tool)
                # A little more than the radius, because of rounding.
                near = 1.001 * now[own + RADIUS]
                begin, end = cut(
                    y + low[0] - near, y + high[0] + near, ti.cast(0, real), now[own + LENGTH], now[own + AFTER + 1],
                    now[own + INVERSE],
                )  # fmt: skip
                begin, end = cut(
                    low[1] - near, high[1] + near, begin, end, now[own + AFTER + 2], now[own + INVERSE + 1]
                )
                reached = reached or begin <= end
                if ti.static(grips):
                    reached = reached or now[own + GRIP] == BEGINS
            if ti.static(grips):
                held = vector(0)
                for b in range(1, sheet.width - 1):
                    held = ti.max(held, sheet.fields[(holding * sheet.rows + i) * sheet.width + b])
                reached = reached or greatest(held) > 0
            return reached

        return reaches

    def resolving(self, code: StepCode) -> Callable[..., None]:
        """Make Taichi's function resolve(sheet, i, kind, at, b, now), which changes entry b of row i after its step.

        `at` is the row of u.
        """
        ti, vector, tools, rubs, grips = code.ti, code.vector, self.tools, self.rubs, self.grips
        first_field, first = code.first_field(ContactTerm), code.first_column(ContactTerm)
        grip_field = first_field + PUSHES * tools
        own, part = [first + COLUMNS + TOOL_COLUMNS * tool for tool in range(tools)], parting(code)
        greatest = greatest_lane(code)

        @ti.func
        def resolve(sheet: ti.template(), i, kind, at, b, now: ti.template()):
            row, entry, here = sheet.rows, at * sheet.width + b, i * sheet.width + b
            rest = [
                sheet.by_column[ACROSS * sheet.width + b],
                vector(sheet.numbers[TOP] - i * sheet.numbers[DY]),
                vector(0),
            ]
            u, d = [sheet.u[c][entry] for c in ti.static(range(3))], [sheet.d[c][here] for c in ti.static(range(3))]
            free = ti.select(sheet.by_column[(MOVES + kind) * sheet.width + b] > 0, vector(1), vector(0))
            held = vector(0)
            if ti.static(grips):
                held = sheet.fields[(grip_field + HELD) * row * sheet.width + here]
                # All grips let go before any takes hold.
                for tool in ti.static(range(tools)):
                    if now[own[tool] + GRIP] != GOES_ON:
                        held = ti.select(held == tool + 1, vector(0), held)
                for tool in ti.static(range(tools)):
                    if now[own[tool] + GRIP] == BEGINS:
                        away = vector(0)
                        for c in ti.static(range(3)):
                            off = rest[c] + (u[c] - d[c]) - now[own[tool] + BEFORE + c]
                            away += off * off
                        reach = GRASP * now[own[tool] + RADIUS]
                        takes = ti.select(away <= reach * reach, free, vector(0)) * ti.select(
                            held == 0, vector(1), vector(0)
                        )
                        held += takes * (tool + 1)
                        for c in ti.static(range(3)):
                            taken = (grip_field + TAKEN + c) * row * sheet.width + here
                            sheet.fields[taken] = ti.select(takes > 0, u[c] - d[c], sheet.fields[taken])
                sheet.fields[(grip_field + HELD) * row * sheet.width + here] = held
                free = ti.select(held == 0, free, vector(0))
            for tool in ti.static(range(tools)):
                inside, normal_x, normal_y, normal_z = part(rest, u, now, own[tool])
                depth = ti.max(inside, 0) * free
                pushed = depth
                if ti.static(grips):
                    pushed = ti.select(held == tool + 1, vector(1), depth)
                if greatest(pushed) > 0:
                    normal = [normal_x, normal_y, normal_z]
                    push = [depth * normal[c] for c in ti.static(range(3))]
                    if ti.static(rubs[tool]):
                        slip = [
                            d[c] + push[c] - (now[own[tool] + AFTER + c] - now[own[tool] + BEFORE + c])
                            for c in ti.static(range(3))
                        ]
                        along = vector(0)
                        for c in ti.static(range(3)):
                            along += slip[c] * normal[c]
                        speed = vector(0)
                        for c in ti.static(range(3)):
                            slip[c] = slip[c] - along * normal[c]
                            speed += slip[c] * slip[c]
                        stopped = now[own[tool] + FRICTION] * depth / ti.max(ti.sqrt(speed), NONE)
                        stopped = ti.min(stopped, 1)
                        for c in ti.static(range(3)):
                            push[c] = push[c] - slip[c] * stopped
                    if ti.static(grips):
                        for c in ti.static(range(3)):
                            target = sheet.fields[(grip_field + TAKEN + c) * row * sheet.width + here]
                            target += now[own[tool] + SINCE + c]
                            push[c] = ti.select(held == tool + 1, target - u[c], push[c])
                    for c in ti.static(range(3)):
                        # A lane that is not pushed keeps its bits, the sign of a zero too.
                        u[c] = ti.select(pushed > 0, u[c] + push[c], u[c])
                        d[c] = ti.select(pushed > 0, d[c] + push[c], d[c])
                        sheet.u[c][entry], sheet.d[c][here] = u[c], d[c]
                        pushes = (first_field + PUSHES * tool + c) * row * sheet.width + here
                        # Not `+=`, which would be atomic, and of vectors that does not compile.
                        sheet.fields[pushes] = sheet.fields[pushes] + push[c] * now[first + WEIGHT]

        return resolve


def greatest_lane(code: StepCode) -> Callable[..., Any]:
    """Make Taichi's function greatest(values), the greatest lane, by shuffles: Taichi's own takes lane after lane."""
    ti, vector, lanes = code.ti, code.vector, code.lanes
    halves = [lanes >> n for n in range(1, lanes.bit_length())]

    @ti.func
    def greatest(values: ti.template()):
        most = values + vector(0)
        for half in ti.static(halves):
            most = ti.max(most, vector([most[(lane + half) % lanes] for lane in ti.static(range(lanes))]))
        return most[0]

    return greatest


def parting(code: StepCode) -> Callable[..., Any]:
    """Make Taichi's function part(rest, u, now, own), which tells how deep a point is in a tool, and the way out.

    `own` is the first column of the tool. It gives radius - |r'|, and then n.
    """
    ti, vector = code.ti, code.vector

    @ti.func
    def part(rest: ti.template(), u: ti.template(), now: ti.template(), own: ti.template()):
        r = [rest[c] - now[own + AFTER + c] + u[c] for c in ti.static(range(3))]
        s = vector(0)
        for c in ti.static(range(3)):
            s += r[c] * now[own + AXIS + c]
        s = ti.max(ti.min(s, now[own + LENGTH]), 0)
        square = vector(0)
        for c in ti.static(range(3)):
            r[c] = r[c] - s * now[own + AXIS + c]
            square += r[c] * r[c]
        distance = ti.sqrt(square)
        normal = [r[c] / ti.max(distance, NONE) for c in ti.static(range(3))]
        normal[2] = ti.select(distance > 0, normal[2], vector(1))
        return now[own + RADIUS] - distance, normal[0], normal[1], normal[2]

    return part


def contact_fields(probes: Sequence[Probe]) -> int:
    """Count the fields that the contact with these probes needs."""
    return _field_count(sum(probe.moved for probe in probes), any(probe.grip for probe in probes))


def _field_count(tools: int, grips: bool) -> int:
    return PUSHES * tools + (GRIP_FIELDS if grips else 0)
