"""Warnings about position-controlled tools that slide through the sheet or pierce it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import NUMPY
from taichi_msm.model.crossings import cells_on_line
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tools import SolidTool, solid_tools
from taichi_msm.solver.state import RunProgress


def tool_contact_warnings(plan: Plan, progress: RunProgress) -> Iterator[str]:
    """Yield warnings of tools that slide through a soft sheet, and of the first tool that pierced the sheet."""
    membrane, foundation = _stiffnesses(plan)
    remedy = "take friction: rough, " if plan.scene.time.at_rest else ""
    for tool in (tool for tool in solid_tools(plan.tools).values() if not tool.rough):
        # Deeper than a fifth of the radius, the mass points of a soft sheet slide off sideways.
        depth, limit = _max_depth(tool, plan.scene.time.duration), tool.radius / 5
        if membrane < (support := foundation * tool.radius**2) and depth > limit * (1 + 1e-9):
            yield (
                f"probes.{tool.probe}: the sheet slides off the tip sideways, so the force is too small: young x "
                f"thickness of the sheet, {membrane:.3g} N/m, is less than foundation x radius^2 under the tip, "
                f"{support:.3g} N/m, and the depth of the tip, {1000 * depth:.3g} mm, is more than a fifth of its "
                f"radius, {1000 * limit:.3g} mm; {remedy}press less deep, or with a wider tip"
            )
    for tool in solid_tools(plan.tools).values():
        if tool.probe == progress.pierced_by - 1:
            time, cell = progress.pierced_frame / plan.grid.frames_per_second, rest_of(plan.scene.sheet).longest_side
            yield (
                f"probes.{tool.probe}: the instrument went through the sheet, first at {time:.6g} s, frame "
                f"{progress.pierced_frame}: its axis passes between points, which are {cell:.3g} m apart at "
                f"rest; its radius is {tool.radius:.3g} m. Its force is invalid from there on; take a wider "
                "instrument or more points, press less, or move it from above and within the border"
            )


def first_piercing_probe(plan: Plan, displacement: NDArray[np.floating], frame: int) -> int:
    """Return the index, plus 1, of the first probe whose axis passes through the sheet; 0 if none does.

    `displacement` is that of the mass points in a frame [m], shape (rows, cols, 3).
    """
    if not plan.has_contact:
        return 0
    rest, time = rest_of(plan.scene.sheet), frame / plan.grid.frames_per_second
    position, tools = rest.position + displacement, solid_tools(plan.tools).values()
    return next((tool.probe + 1 for tool in tools if _pierces(tool, position, rest.present, time)), 0)


def _pierces(tool: SolidTool, position: NDArray[np.floating], present: NDArray[np.bool_], time: float) -> bool:
    """Return whether the axis of a tool intersects a triangle of the sheet."""
    # Rows: the axis, up to its sign, and two directions orthogonal to it.
    basis = np.linalg.svd(tool.axis[None])[2]
    basis[0] = tool.axis
    local = (position - tool.path_at(np.array([time]))[0]) @ basis.T
    i, j = np.nonzero(cells_on_line((local[..., 1], local[..., 2])) & present)
    for corner in (local[i, j + 1], local[i + 1, j]):
        triangle = np.stack([local[i, j], corner, local[i + 1, j + 1]], axis=1)
        x, y = triangle[..., 1], triangle[..., 2]
        weights = np.roll(x, -1, 1) * np.roll(y, -2, 1) - np.roll(x, -2, 1) * np.roll(y, -1, 1)
        inside = ((weights >= 0).all(axis=1) | (weights <= 0).all(axis=1)) & (weights.sum(axis=1) != 0)
        height = (weights * triangle[..., 0]).sum(axis=1)[inside] / weights.sum(axis=1)[inside]
        # A tenth of the radius is tolerated, because the tip of a plate lies on the pressed tissue.
        depth, *_ = tool.shape.build_depth(NUMPY)(*np.outer(tool.axis, height), *tool.axis, tool.length, tool.radius)
        if ((height >= 0) & (height <= tool.length) & (depth > 0.1 * tool.radius)).any():
            return True
    return False


def _max_depth(tool: SolidTool, duration: float) -> float:
    """Return the largest depth of a tip below the undeformed sheet [m]."""
    heights = np.interp([*tool.times, duration], tool.times, tool.heights)
    return -float(heights[np.array([*tool.times, duration]) <= duration * (1 + 1e-9)].min())


def _stiffnesses(plan: Plan) -> tuple[float, float]:
    """Return young x thickness [N/m] and the foundation modulus [N/m3], times the mean factors of the maps."""
    scene, material = plan.scene, plan.material
    if scene.tissue is not None:
        membrane = scene.tissue.young * scene.tissue.thickness
    else:
        assert scene.springs is not None
        # In plane stress, E t of a lattice of square cells is 8/9 of its structural and shear stiffness together.
        membrane = 8 / 9 * (scene.springs.structural + scene.springs.shear)
    rest = rest_of(scene.sheet)
    present = rest.present, True if rest.mask is None else rest.mask.points
    factor, foundation_factor = (
        1.0 if each is None else float(each.mean(where=where))
        for each, where in zip((material.factors, material.virtual_factors), present, strict=True)
    )
    return factor * membrane, foundation_factor * material.virtual / rest.cell_area
