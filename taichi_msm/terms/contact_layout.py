"""Columns, fields and penetration depth of position-controlled tools, for motion and equilibrium."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from typing import Any, NamedTuple

from taichi_msm.shapes import SHAPES
from taichi_msm.terms.base import KernelConfig

# Columns of the load table. For all tools: the weight of the step's corrections. For each tool: the tip's centre after
# and before the step; the state of its grip, and the tool's displacement since the grip began; axis, length, radius and
# friction; the inverse y and z components of the axis.
WEIGHT, COLUMNS = 0, 1
TIP_AFTER, TIP_BEFORE, GRIP_STATE, GRIP_SHIFT, AXIS = 0, 3, 6, 7, 10
LENGTH, RADIUS, FRICTION, INVERSE_AXIS, TOOL_COLUMNS = 13, 14, 15, 16, 18

# States of a grip in a step.
GRIP_IDLE, GRIP_BEGINS, GRIP_CONTINUES = 0.0, 1.0, 2.0

# Fields: for every tool the three components of the summed corrections; with grips, the index of the tool that holds a
# mass point plus 1, and the displacement of the mass point when the grip began. Of mass points that stick to a rough
# tool (`rough`) the index is larger by the number of tools, and the displacement is that relative to the tool.
CORRECTIONS, HOLDER, HOLD_DISPLACEMENT = 3, 0, 1


class ContactLayout(NamedTuple):
    """The columns and fields of contact in a load table and in the fields of a sheet."""

    shapes: tuple[str, ...]  # name of the shape of every tool
    has_friction: tuple[bool, ...]  # whether each tool has friction, and at rest is rough
    grips: bool  # whether any tool can hold tissue
    first_field: int
    first_column: int

    @property
    def grip_field(self) -> int:
        """Index of the first field of grips."""
        return self.first_field + CORRECTIONS * len(self.shapes)

    @property
    def bases(self) -> list[int]:
        """The first column of every tool."""
        return [self.first_column + COLUMNS + TOOL_COLUMNS * tool for tool in range(len(self.shapes))]


def build_penetration(config: KernelConfig, shape: str) -> Callable[..., Any]:
    """Build the Taichi function penetration(rest, u, now, base), the depth of mass points in a tool and the normals.

    In it `base` is the first column of the tool. It returns the depth and the three components of the outward normal.
    """
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
