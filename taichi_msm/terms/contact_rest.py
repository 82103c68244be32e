"""Contact in quasi-static equilibrium: contact forces of tools, and projection of mass points out of their shapes.

A tool can push a mass point that touches it but cannot pull it. Of the force F on the mass point, the tool therefore
carries the part into the shape, min(F . n, 0) n; the remainder, tangential or outward, must vanish in equilibrium.
The normals n are stored in the fields of corrections and are 0 where a mass point touches no tool. Held mass points,
also those that stick to a rough tool, move with their tool, which carries their whole force.

A mass point may touch several tools. Their contact forces and corrections are then found by projected Gauss-Seidel
iteration.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import GRIP_RADII, Clamp, Tool, grip_frames
from taichi_msm.terms.base import DY, MOBILITY, REST_X, TOP_Y, KernelConfig
from taichi_msm.terms.contact_layout import (
    COLUMNS,
    CORRECTIONS,
    GRIP_SHIFT,
    HOLD_DISPLACEMENT,
    HOLDER,
    TIP_AFTER,
    TOOL_COLUMNS,
    ContactLayout,
    build_penetration,
)

Array = NDArray[np.float64]


def build_remove_contact(config: KernelConfig, layout: ContactLayout) -> Callable[..., None]:
    """Build the Taichi function remove_contact(force, sheet, at), which removes contact forces at an entry."""
    ti, vector, tools, grips, first_field = (
        config.ti,
        config.vector,
        len(layout.shapes),
        layout.grips,
        layout.first_field,
    )
    holding, iterations = layout.grip_field + HOLDER, _iterations(tools)

    @ti.func
    def remove_contact(force: ti.template(), sheet: ti.template(), at):
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
                force[c] = ti.select(sheet.fields[holding * field + at] > 0, vector(0), force[c])

    return remove_contact


def build_project_out(config: KernelConfig, layout: ContactLayout) -> Callable[..., None]:
    """Build the Taichi function project_out(sheet, i, kind, b, now) for entry b of row i of a `RestSheet`.

    It projects mass points out of the tools, removes their momentum into the tools, and moves held mass points with
    their tool.
    """
    ti, vector, tools, grips = config.ti, config.vector, len(layout.shapes), layout.grips
    first_field, grip_field, base = layout.first_field, layout.grip_field, layout.bases
    penetrations = [build_penetration(config, shape) for shape in layout.shapes]
    iterations = _iterations(tools)
    # Holders, and the columns with the shift of their mass points: of grips, and of rough tools.
    holders = [(tool + 1, base[tool] + GRIP_SHIFT) for tool in range(tools)]
    holders += [(tools + tool + 1, base[tool] + TIP_AFTER) for tool in range(tools) if layout.has_friction[tool]]

    @ti.func
    def project_out(sheet: ti.template(), i, kind, b, now: ti.template()):
        field, at = sheet.rows * sheet.width, i * sheet.width + b
        rest = [
            sheet.by_column[REST_X * sheet.width + b],
            vector(sheet.constants[TOP_Y] - i * sheet.constants[DY]),
            vector(0),
        ]
        u, q = [sheet.u[c][at] for c in ti.static(range(3))], [sheet.q[c][at] for c in ti.static(range(3))]
        free = ti.select(sheet.by_column[(MOBILITY + kind) * sheet.width + b] > 0, vector(1), vector(0))
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

    return project_out


def _iterations(tools: int) -> int:
    """Return the number of Gauss-Seidel iterations."""
    return 8 if tools > 1 else 1


def touched_points(tools: int, memory: Array) -> NDArray[np.bool_]:
    """Return whether each tool touches or holds each mass point.

    Args:
        tools: number of tools.
        memory: memory of the term, shape (numbers, rows, cols).

    Returns:
        Shape (tools, rows, cols).
    """
    normals = memory[: CORRECTIONS * tools].reshape(tools, CORRECTIONS, *memory.shape[1:])
    touched = (normals != 0).any(axis=1)
    if len(memory) > CORRECTIONS * tools:
        holder = memory[CORRECTIONS * tools + HOLDER]
        touched |= (holder > 0) & ((holder - 1) % tools == np.arange(tools)[:, None, None])
    return np.asarray(touched)


def grips(tools: Sequence[Tool], memory: Array) -> bool:
    """Return whether the tip of any tool holds a mass point; see `touched_points`."""
    touching = [n + 1 for n, tool in enumerate(tools) if not isinstance(tool, Clamp)]
    begin = CORRECTIONS * len(tools) + HOLDER
    return bool(np.isin(memory[begin : begin + 1], touching).any())


def set_tools(plan: Plan, frame: int, time: float, columns: Array) -> None:
    """Write the positions of the tools at a time [s], up to that of a frame, into the columns of the term."""
    for n, tool in enumerate(plan.tools):
        of_tool, centre = columns[COLUMNS + TOOL_COLUMNS * n :], tool.tip_centre(np.array([time]))[0]
        of_tool[TIP_AFTER : TIP_AFTER + 3] = centre
        start = _grip_start(plan, tool, frame)
        if isinstance(tool, Clamp):
            of_tool[GRIP_SHIFT : GRIP_SHIFT + 3] = centre
        elif start is not None:
            of_tool[GRIP_SHIFT : GRIP_SHIFT + 3] = centre - _centre_at_grip(plan, tool, start)


def memory_after_grips(plan: Plan, frame: int, displacement: Array, before: Array) -> Array:
    """Return the memory at the start of a frame, after grips have ended and begun.

    Args:
        plan: the plan.
        frame: number of the frame.
        displacement: x - X at the frame before [m], shape (rows, cols, 3).
        before: memory of the term at the frame before, shape (numbers, rows, cols).
    """
    tools, memory = plan.tools, before.copy()
    if len(memory) == CORRECTIONS * len(tools):
        return memory
    fields = memory[CORRECTIONS * len(tools) :]
    holder, held_displacement = fields[HOLDER], fields[HOLD_DISPLACEMENT:]
    position = rest_positions(plan.scene.sheet) + displacement
    starts = [_grip_start(plan, tool, frame) for tool in tools]
    for n, (tool, start) in enumerate(zip(tools, starts, strict=True)):
        if start is None or start == frame:
            holder[holder == n + 1] = 0
        if isinstance(tool, Clamp):
            holder[tool.points] = n + 1
        if not tool.rough:
            holder[holder == len(tools) + n + 1] = 0
    for n, (tool, start) in enumerate(zip(tools, starts, strict=True)):
        if start == frame:
            distance = np.linalg.norm(position - _centre_at_grip(plan, tool, frame), axis=-1)
            gripped = (distance <= GRIP_RADII * tool.radius) & ~plan.fixed & ((holder == 0) | (holder > len(tools)))
            holder[gripped] = n + 1
            held_displacement[:, gripped] = displacement[gripped].T
    return memory


def _grip_start(plan: Plan, tool: Tool, frame: int) -> int | None:
    """Return the first frame of the grip that is active at a frame; None without one."""
    frames = (grip_frames(grip, plan.grid.frames_per_second) for grip in tool.grips)
    return next((active.start for active in frames if frame in active), None)


def _centre_at_grip(plan: Plan, tool: Tool, frame: int) -> Array:
    """Return the tip's centre [m] at the frame before a grip begins, whose displacements the grip stores."""
    return tool.tip_centre(np.array([max(0, frame - 1) / plan.grid.frames_per_second]))[0]
