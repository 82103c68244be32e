"""Warnings about rods that slide through the sheet or pierce it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions, spacing
from taichi_msm.model.tools import Tool
from taichi_msm.solver.state import RunProgress

# A tip that is deeper than this share of its radius makes the points of a soft sheet slide off sideways.
DEEPEST_WITHOUT_SLIDING = 1 / 5

# E t of a lattice of square cells, relative to the stiffness of its structural and shear springs together.
PLANE_STRESS = 8 / 9


def contact_notes(plan: Plan, progress: RunProgress) -> Iterator[str]:
    """Warn about tools that slide through a soft foundation, and about the first one that pierced the sheet."""
    stretching, foundation = _stiffnesses(plan)
    for tool in plan.tools:
        depth, limit = _depth(tool, plan.scene.time.duration), DEEPEST_WITHOUT_SLIDING * tool.radius
        if stretching < (held := foundation * tool.radius**2) and depth > limit * (1 + 1e-9):
            yield (
                f"probes.{tool.probe}: the sheet slides off the tip sideways, and its force is too small: the sheet "
                f"resists stretching by {stretching:.3g} N/m (young x thickness), less than the foundation under the "
                f"tip, {held:.3g} N/m (foundation x radius^2), and the tip goes {1000 * depth:.3g} mm deep, more than "
                f"a fifth of its radius, {1000 * limit:.3g} mm; press less deep, or with a wider tip"
            )
    for tool in plan.tools:
        if tool.probe == progress.pierced_by - 1:
            time, apart = progress.pierced_frame / plan.grid.frames_per_second, max(spacing(plan.scene.sheet))
            yield (
                f"probes.{tool.probe}: the instrument went through the sheet, first seen at {time:.6g} s, frame "
                f"{progress.pierced_frame}: its middle line passes between points, which are {apart:.3g} m apart at "
                f"rest; its radius is {tool.radius:.3g} m. Its force means nothing from there on; take a wider "
                "instrument or more points, press less, or move it from above and within the border"
            )


def piercing(plan: Plan, displacement: NDArray[np.floating], frame: int) -> int:
    """Find the first tool whose middle line passes through the sheet.

    Args:
        plan: with the tools that are moved.
        displacement: of the mass points [m], shape (rows, cols, 3).
        frame: number of the frame with these displacements.

    Returns:
        The index of its probe, plus 1; 0: there is none.
    """
    if not plan.tools:
        return 0
    position, time = rest_positions(plan.scene.sheet) + displacement, frame / plan.grid.frames_per_second
    return next((tool.probe + 1 for tool in plan.tools if _pierces(tool, position, time)), 0)


def _pierces(tool: Tool, position: NDArray[np.floating], time: float) -> bool:
    """Return whether the middle line of a tool meets a triangle of the sheet."""
    frame = np.linalg.svd(tool.axis[None])[2]  # first the axis, or its opposite, then two directions across it
    frame[0] = tool.axis
    place = (position - tool.tip_centre(np.array([time]))[0]) @ frame.T
    # The cells around the line: of the four corners some are on either side in both directions.
    around = np.ones([count - 1 for count in position.shape[:2]], dtype=bool)
    for value in (place[..., 1], place[..., 2]):
        for side in (value <= 0, value >= 0):
            pairs = side[:-1] | side[1:]
            around &= pairs[:, :-1] | pairs[:, 1:]
    i, j = np.nonzero(around)
    for third in (place[i, j + 1], place[i + 1, j]):
        triangle = np.stack([place[i, j], third, place[i + 1, j + 1]], axis=1)
        x, y = triangle[..., 1], triangle[..., 2]
        shares = np.roll(x, -1, 1) * np.roll(y, -2, 1) - np.roll(x, -2, 1) * np.roll(y, -1, 1)
        inside = ((shares >= 0).all(axis=1) | (shares <= 0).all(axis=1)) & (shares.sum(axis=1) != 0)
        met = (shares * triangle[..., 0]).sum(axis=1)[inside] / shares.sum(axis=1)[inside]
        if ((met >= 0) & (met <= tool.length)).any():
            return True
    return False


def _depth(tool: Tool, duration: float) -> float:
    """Return the greatest depth of a tip below the sheet at rest until the end [m]."""
    heights = np.interp([*tool.times, duration], tool.times, tool.heights)
    return -float(heights[np.array([*tool.times, duration]) <= duration * (1 + 1e-9)].min())


def _stiffnesses(plan: Plan) -> tuple[float, float]:
    """Return E t [N/m] and the foundation's modulus [N/m^3], of maps with their mean factors."""
    scene, material = plan.scene, plan.material
    if scene.tissue is not None:
        stretching = scene.tissue.young * scene.tissue.thickness
    else:
        assert scene.springs is not None
        stretching = PLANE_STRESS * (scene.springs.structural + scene.springs.shear)
    factor, held = (
        1.0 if each is None else float(each.mean()) for each in (material.factors, material.virtual_factors)
    )
    return factor * stretching, held * material.virtual / math.prod(spacing(scene.sheet))
