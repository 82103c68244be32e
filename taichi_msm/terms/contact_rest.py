"""Contact in quasi-static scenes: tools between two equilibria, begin and end of grips, and rough tools.

Scene: `friction: rough`. Between two equilibria, tools and mass points move along straight lines. A mass point that
touches a rough tool sticks to it: u = u' + c - c', with its displacement u' and the tip c' at the first touch. The tool
holds it like a grip, but never pulls it: it releases the mass point when the sum F of all other forces points out of
the tool, F . n > 0.

The memory of the term (`ContactTerm.memory`) contains the normals of contact and the holders of mass points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import NUMPY
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import GRIP_RADII, Clamp, Tool, grip_frames
from taichi_msm.terms.contact import (
    COLUMNS,
    CORRECTIONS,
    GRIP_SHIFT,
    HOLD_DISPLACEMENT,
    HOLDER,
    RADIUS,
    TIP_AFTER,
    TOOL_COLUMNS,
)

Array = NDArray[np.float64]


def touched_points(tools: int, memory: Array) -> NDArray[np.bool_]:
    """Return whether each tool touches or holds each mass point, shape (tools, rows, cols).

    Args:
        tools: number of tools.
        memory: memory of the term, shape (numbers, rows, cols).
    """
    normals = memory[: CORRECTIONS * tools].reshape(tools, CORRECTIONS, *memory.shape[1:])
    touched = (normals != 0).any(axis=1)
    if len(memory) > CORRECTIONS * tools:
        holder = memory[CORRECTIONS * tools + HOLDER]
        touched |= (holder > 0) & ((holder - 1) % tools == np.arange(tools)[:, None, None])
    return np.asarray(touched)


def is_gripping(tools: Sequence[Tool], memory: Array) -> bool:
    """Return whether any tool but a clamp grips a mass point.

    Args:
        tools: the position-controlled tools.
        memory: memory of the term, shape (numbers, rows, cols).
    """
    grips = [n + 1 for n, tool in enumerate(tools) if not isinstance(tool, Clamp)]
    begin = CORRECTIONS * len(tools) + HOLDER
    return bool(np.isin(memory[begin : begin + 1], grips).any())


def set_tools(plan: Plan, frame: int, time: float, columns: Array) -> None:
    """Write the positions of the tools into the columns of the term.

    Args:
        plan: plan of the run.
        frame: number of the next frame, which determines the active grips.
        time: time of the positions [s], at most that of the frame.
        columns: row of the load table from the first column of the term on, in and out.
    """
    for n, tool in enumerate(plan.tools):
        of_tool, centre = columns[COLUMNS + TOOL_COLUMNS * n :], tool.tip_centre(np.array([time]))[0]
        of_tool[TIP_AFTER : TIP_AFTER + 3] = centre
        start = _grip_start(plan, tool, frame)
        if isinstance(tool, Clamp):
            of_tool[GRIP_SHIFT : GRIP_SHIFT + 3] = centre
        elif start is not None:
            of_tool[GRIP_SHIFT : GRIP_SHIFT + 3] = centre - _centre_at_grip(plan, tool, start)


def memory_after_grips(plan: Plan, frame: int, displacement: Array, before: Array) -> Array:
    """Return the memory at a frame, after grips ended and began, shape (numbers, rows, cols).

    Args:
        plan: plan of the run.
        frame: number of the frame.
        displacement: x - X at the previous frame [m], shape (rows, cols, 3).
        before: memory at the previous frame, shape (numbers, rows, cols).
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
    """Return the first frame of the grip that is active at a frame; None without a grip."""
    frames = (grip_frames(grip, plan.grid.frames_per_second) for grip in tool.grips)
    return next((active.start for active in frames if frame in active), None)


def _centre_at_grip(plan: Plan, tool: Tool, frame: int) -> Array:
    """Return the tip's centre [m] one frame before the first frame of a grip, when the grip stores displacements."""
    return tool.tip_centre(np.array([max(0, frame - 1) / plan.grid.frames_per_second]))[0]


def stick(plan: Plan, memory: Array, start: Array, end: Array, times: tuple[float, float]) -> Array:
    """Return the memory after mass points began to stick to rough tools, shape (numbers, rows, cols).

    Args:
        plan: plan of the run.
        memory: memory before, shape (numbers, rows, cols).
        start: x - X at the first time [m], shape (rows, cols, 3).
        end: x - X at the second time if no tool touched more mass points [m], shape (rows, cols, 3).
        times: times between which the tools move along straight lines [s].
    """
    tools, memory, rest = plan.tools, memory.copy(), rest_positions(plan.scene.sheet)
    fields = memory[CORRECTIONS * len(tools) :]
    free, earliest = ~plan.fixed & (fields[HOLDER] == 0), np.full(plan.fixed.shape, np.inf)
    for n, tool in enumerate(tools):
        if tool.rough:
            first, last = tool.tip_centre(np.array(times))
            fraction = _first_touch(tool, rest + start - first, end - start - (last - first))
            touched = free & (fraction <= 1) & (fraction < earliest)
            earliest[touched] = fraction[touched]
            fields[HOLDER, touched] = len(tools) + n + 1
            shift = fraction[touched, None] * (end[touched] - start[touched] - (last - first))
            fields[HOLD_DISPLACEMENT:, touched] = (start[touched] - first + shift).T
    return memory


def stuck_points(plan: Plan, memory: Array) -> NDArray[np.bool_]:
    """Return whether each mass point sticks to a rough tool, shape (rows, cols).

    Args:
        plan: plan of the run.
        memory: memory of the term, shape (numbers, rows, cols).
    """
    tools = len(plan.tools)
    return np.asarray((memory[CORRECTIONS * tools + HOLDER :][:1] > tools).any(axis=0))


def without_rough_tools(plan: Plan, row: Array, first_column: int) -> Array:
    """Return a row of the load table in which rough tools touch nothing, because their radius is 0.

    Args:
        plan: plan of the run.
        row: row of the load table, shape (1, columns).
        first_column: first column of the term.
    """
    row = row.copy()
    for n, tool in enumerate(plan.tools):
        if tool.rough:
            row[0, first_column + COLUMNS + TOOL_COLUMNS * n + RADIUS] = 0
    return row


def compute_pulls(plan: Plan, memory: Array, displacement: Array, force: Array, time: float) -> Array:
    """Compute the pull of rough tools on the mass points that stick to them.

    Args:
        plan: plan of the run.
        memory: memory of the term, shape (numbers, rows, cols).
        displacement: x - X [m], shape (rows, cols, 3).
        force: sum of all forces except those of tools [N], shape (rows, cols, 3).
        time: time of the tools' positions [s].

    Returns:
        Pull along the outward normal [N], 0 where the tool pushes, shape (rows, cols).
    """
    tools, position = plan.tools, rest_positions(plan.scene.sheet) + displacement
    holder, pulls = memory[CORRECTIONS * len(tools) + HOLDER], np.zeros(plan.fixed.shape)
    for n, tool in enumerate(tools):
        stuck = holder == len(tools) + n + 1
        r = position[stuck] - tool.tip_centre(np.array([time]))[0]
        _, *normal = tool.shape.build_depth(NUMPY)(*r.T, *tool.axis, tool.length, tool.radius)
        pulls[stuck] = np.maximum((force[stuck].T * normal).sum(axis=0), 0)
    return pulls


def release(plan: Plan, memory: Array, pulls: Array) -> Array:
    """Return the memory after the release of mass points, shape (numbers, rows, cols).

    Only pulls above half the largest one lead to a release, because each release relieves other mass points.

    Args:
        plan: plan of the run.
        memory: memory before, shape (numbers, rows, cols).
        pulls: pull on each mass point [N], shape (rows, cols), not all 0.
    """
    memory = memory.copy()
    memory[CORRECTIONS * len(plan.tools) + HOLDER, pulls > 0.5 * pulls.max()] = 0
    return memory


def _first_touch(tool: Tool, r: Array, motion: Array) -> Array:
    """Return the fraction of a motion from r, relative to a tool, until each point touches it; else infinity."""
    distance = np.linalg.norm(motion, axis=-1)
    direction = motion / np.maximum(distance, np.finfo(float).tiny)[..., None]
    products = direction @ tool.axis, r @ tool.axis, (r * direction).sum(axis=-1), (r * r).sum(axis=-1)
    t, enters, *_ = tool.shape.build_ray(NUMPY)(1.0, *products, tool.length, tool.radius)
    depth, *_ = tool.shape.build_depth(NUMPY)(*np.moveaxis(r, -1, 0), *tool.axis, tool.length, tool.radius)
    with np.errstate(divide="ignore", invalid="ignore"):
        first = np.where(enters & (t >= 0) & (distance > 0), t / distance, np.inf)
    # Rounding can place a touching mass point just above the surface.
    return np.asarray(np.where(depth >= -1e-9 * tool.radius, 0.0, first))
