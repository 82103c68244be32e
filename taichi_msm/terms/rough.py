"""Rough tools in quasi-static equilibrium, to which the mass points that they touch stick. Scene: `friction: rough`.

Between two shapes tools and mass points move along straight lines. A mass point with the displacement u' that a
tool reaches when its tip is at c' sticks to it: with the tip at c, u = u' + c - c'. It is
held as by a grip (`contact_rest`) until the tool would pull it, that is, until the sum F of all other forces on it
points out of the tool, F . n > 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import NUMPY
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import Tool
from taichi_msm.terms.contact_layout import COLUMNS, CORRECTIONS, HOLD_DISPLACEMENT, HOLDER, RADIUS, TOOL_COLUMNS

Array = NDArray[np.float64]

# A mass point within this share of the radius above the surface of a tool touches it.
TOUCH_TOLERANCE = 1e-9

# Mass points are released together if the pulls on them exceed this share of the largest pull.
RELEASE_SHARE = 0.5


def stick(plan: Plan, memory: Array, start: Array, end: Array, times: tuple[float, float]) -> Array:
    """Return the memory of contact after rough tools have taken the mass points that they reach between two shapes.

    Args:
        plan: the plan.
        memory: memory of contact, shape (numbers, rows, cols).
        start: displacements at the first time [m], shape (rows, cols, 3).
        end: displacements at the second time without further contact [m], shape (rows, cols, 3).
        times: the two times [s].
    """
    tools, memory, rest = plan.tools, memory.copy(), rest_positions(plan.scene.sheet)
    fields = memory[CORRECTIONS * len(tools) :]
    free, earliest = ~plan.fixed & (fields[HOLDER] == 0), np.full(plan.fixed.shape, np.inf)
    for n, tool in enumerate(tools):
        if tool.rough:
            first, last = tool.tip_centre(np.array(times))
            share = _first_touch(tool, rest + start - first, end - start - (last - first))
            touched = free & (share <= 1) & (share < earliest)
            earliest[touched] = share[touched]
            by = share[touched, None]
            fields[HOLDER, touched] = len(tools) + n + 1
            shift = by * (end[touched] - start[touched] - (last - first))
            fields[HOLD_DISPLACEMENT:, touched] = (start[touched] - first + shift).T
    return memory


def stuck_points(plan: Plan, memory: Array) -> NDArray[np.bool_]:
    """Return whether each mass point sticks to a rough tool, for a memory of contact of shape (numbers, rows, cols)."""
    tools = len(plan.tools)
    return np.asarray((memory[CORRECTIONS * tools + HOLDER :][:1] > tools).any(axis=0))


def without_rough_tools(plan: Plan, row: Array, first_column: int) -> Array:
    """Return a row of the load table in which rough tools touch nothing, because their radius is 0."""
    row = row.copy()
    for n, tool in enumerate(plan.tools):
        if tool.rough:
            row[0, first_column + COLUMNS + TOOL_COLUMNS * n + RADIUS] = 0
    return row


def compute_pulls(plan: Plan, memory: Array, displacement: Array, force: Array, time: float) -> Array:
    """Compute the pull of rough tools on the mass points that stick to them, 0 where they push [N], shape (rows, cols).

    Args:
        plan: the plan.
        memory: memory of contact, shape (numbers, rows, cols).
        displacement: x - X [m], shape (rows, cols, 3).
        force: sum of all forces but those of tools [N], shape (rows, cols, 3).
        time: of the tools [s].
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
    """Return the memory of contact without the mass points of the largest pulls, as each release relieves others."""
    memory = memory.copy()
    memory[CORRECTIONS * len(plan.tools) + HOLDER, pulls > RELEASE_SHARE * pulls.max()] = 0
    return memory


def _first_touch(tool: Tool, r: Array, motion: Array) -> Array:
    """Return the first share of a motion relative to a tool at which a point touches it, infinite if it does not.

    Args:
        tool: the tool.
        r: positions relative to the centre of the tip [m], shape (..., 3).
        motion: of the points relative to the tool [m], shape (..., 3).
    """
    distance = np.linalg.norm(motion, axis=-1)
    direction = motion / np.maximum(distance, np.finfo(float).tiny)[..., None]
    products = direction @ tool.axis, r @ tool.axis, (r * direction).sum(axis=-1), (r * r).sum(axis=-1)
    t, enters, *_ = tool.shape.build_ray(NUMPY)(1.0, *products, tool.length, tool.radius)
    depth, *_ = tool.shape.build_depth(NUMPY)(*np.moveaxis(r, -1, 0), *tool.axis, tool.length, tool.radius)
    with np.errstate(divide="ignore", invalid="ignore"):
        first = np.where(enters & (t >= 0) & (distance > 0), t / distance, np.inf)
    return np.asarray(np.where(depth >= -TOUCH_TOLERANCE * tool.radius, 0.0, first))
