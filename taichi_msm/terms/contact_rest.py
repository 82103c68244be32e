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

from taichi_msm.arithmetic import NUMPY, Array
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import GRIP_RADII, SolidTool, Tool, clamps, grip_frames, solid_tools
from taichi_msm.terms.contact import FREE, contact_fields, held_by, stuck_to
from taichi_msm.terms.places import Places


def _has_grips(tools: int, memory: Array) -> bool:
    """Return whether the memory has the holders of mass points."""
    return len(memory) > contact_fields(tools).holder


def touched_points(tools: int, memory: Array) -> NDArray[np.bool_]:
    """Return whether each tool touches or holds each mass point, shape (tools, rows, cols)."""
    fields, touched = contact_fields(tools), np.zeros((tools, *memory.shape[1:]), dtype=bool)
    for n, normal in enumerate(fields.corrections):
        touched[n] = (memory[normal] != 0).any(axis=0)
        if _has_grips(tools, memory):
            touched[n] |= np.isin(memory[fields.holder], [held_by(n), stuck_to(n, tools)])
    return touched


def is_gripping(tools: Sequence[Tool], memory: Array) -> bool:
    """Return whether any tool but a clamp grips a mass point."""
    if not _has_grips(len(tools), memory):
        return False
    return bool(np.isin(memory[contact_fields(len(tools)).holder], [held_by(n) for n in solid_tools(tools)]).any())


def set_tools(plan: Plan, frame: int, time: float, columns: Array, places: Places) -> None:
    """Write the positions of the tools at a time [s] up to `frame`, whose grips are active, into the columns."""
    for n, tool in enumerate(plan.tools):
        at, centre = places.tools[n], tool.path_at(np.array([time]))[0]
        columns[at.tip_after] = centre
        if n in clamps(plan.tools):
            columns[at.grip_shift] = centre
        elif (start := _grip_start(plan, tool, frame)) is not None:
            columns[at.grip_shift] = centre - _centre_at_grip(plan, tool, start)


def memory_after_grips(plan: Plan, frame: int, displacement: Array, before: Array) -> Array:
    """Return the memory at a frame, after grips ended and began, from the last frame's memory and displacements [m]."""
    tools, memory = plan.tools, before.copy()
    if not _has_grips(len(tools), memory):
        return memory
    (holder, hold), position = _holders(plan, memory), rest_positions(plan.scene.sheet) + displacement
    starts = [_grip_start(plan, tool, frame) for tool in tools]
    for n, (tool, start) in enumerate(zip(tools, starts, strict=True)):
        if start is None or start == frame:
            holder[holder == held_by(n)] = FREE
        if not tool.rough:
            holder[holder == stuck_to(n, len(tools))] = FREE
    for n, clamp in clamps(tools).items():
        holder[clamp.points] = held_by(n)
    for n, tool in solid_tools(tools).items():
        if starts[n] == frame:
            distance = np.linalg.norm(position - _centre_at_grip(plan, tool, frame), axis=-1)
            is_available = (holder == FREE) | np.isin(holder, [stuck_to(m, len(tools)) for m in range(len(tools))])
            gripped = (distance <= GRIP_RADII * tool.radius) & ~plan.fixed & is_available
            holder[gripped] = held_by(n)
            hold[:, gripped] = displacement[gripped].T
    return memory


def _grip_start(plan: Plan, tool: Tool, frame: int) -> int | None:
    """Return the first frame of the grip that is active at a frame; None without a grip."""
    frames = (grip_frames(grip, plan.grid.frames_per_second) for grip in tool.grips)
    return next((active.start for active in frames if frame in active), None)


def _centre_at_grip(plan: Plan, tool: Tool, frame: int) -> Array:
    """Return the tip's centre [m] one frame before the first frame of a grip, when the grip stores displacements."""
    return tool.path_at(np.array([max(0, frame - 1) / plan.grid.frames_per_second]))[0]


def stick(plan: Plan, memory: Array, start: Array, end: Array, times: tuple[float, float]) -> Array:
    """Return the memory after mass points began to stick to rough tools, between two times [s].

    The tools move along straight lines, and mass points from the displacements `start` to `end` [m], shape
    (rows, cols, 3), those at the second time if no tool touched more of them.
    """
    tools, memory, rest = plan.tools, memory.copy(), rest_positions(plan.scene.sheet)
    holder, hold = _holders(plan, memory)
    free, earliest = ~plan.fixed & (holder == FREE), np.full(plan.fixed.shape, np.inf)
    for n, tool in solid_tools(tools).items():
        if tool.rough:
            first, last = tool.path_at(np.array(times))
            fraction = _first_touch(tool, rest + start - first, end - start - (last - first))
            touched = free & (fraction <= 1) & (fraction < earliest)
            earliest[touched] = fraction[touched]
            holder[touched] = stuck_to(n, len(tools))
            shift = fraction[touched, None] * (end[touched] - start[touched] - (last - first))
            hold[:, touched] = (start[touched] - first + shift).T
    return memory


def stuck_points(plan: Plan, memory: Array) -> NDArray[np.bool_]:
    """Return whether each mass point sticks to a rough tool, shape (rows, cols)."""
    tools = len(plan.tools)
    if not _has_grips(tools, memory):
        return np.zeros(plan.fixed.shape, dtype=bool)
    return np.isin(_holders(plan, memory)[0], [stuck_to(n, tools) for n in range(tools)])


def without_rough_tools(plan: Plan, row: Array, places: Places) -> Array:
    """Return a row of the load table, shape (1, columns), in which rough tools touch nothing: their radius is 0."""
    row = row.copy()
    for n, tool in enumerate(plan.tools):
        if tool.rough:
            row[0, places.tools[n].radius] = 0
    return row


def compute_pulls(plan: Plan, memory: Array, displacement: Array, force: Array, time: float) -> Array:
    """Return the pull of rough tools on the mass points that stick to them [N], shape (rows, cols), at a time [s].

    It is the outward component of `force`, the sum of all forces except those of tools [N], shape (rows, cols, 3), or 0
    where the tool pushes.
    """
    tools, position = plan.tools, rest_positions(plan.scene.sheet) + displacement
    holder, pulls = _holders(plan, memory)[0], np.zeros(plan.fixed.shape)
    for n, tool in solid_tools(tools).items():
        stuck = holder == stuck_to(n, len(tools))
        r = position[stuck] - tool.path_at(np.array([time]))[0]
        _, *normal = tool.shape.build_depth(NUMPY)(*r.T, *tool.axis, tool.length, tool.radius)
        pulls[stuck] = np.maximum((force[stuck].T * normal).sum(axis=0), 0)
    return pulls


def release(plan: Plan, memory: Array, pulls: Array) -> Array:
    """Return the memory after the release of mass points with pulls [N], shape (rows, cols), that are not all 0.

    Only pulls above half the largest one lead to a release, because each release relieves other mass points.
    """
    memory = memory.copy()
    _holders(plan, memory)[0][pulls > 0.5 * pulls.max()] = FREE
    return memory


def _holders(plan: Plan, memory: Array) -> tuple[Array, Array]:
    """Return views of the holders, shape (rows, cols), and of the holds [m], shape (3, rows, cols)."""
    fields = contact_fields(len(plan.tools))
    return memory[fields.holder], memory[fields.hold.start : fields.hold.stop]


def _first_touch(tool: SolidTool, r: Array, motion: Array) -> Array:
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
