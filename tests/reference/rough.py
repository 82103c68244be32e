"""NumPy reference of rough tools in equilibrium: SciPy's equilibria, and sticking points found one by one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import solid_tools
from tests.reference.contact import centre
from tests.reference.dynamics import force
from tests.reference.loads import frame_loads
from tests.reference.rest import clearance, equilibrium, outward
from tests.reference.sheet import Sheet, sheet

Array = NDArray[np.float64]


def rough_frames(
    plan: Plan, start: Array, assembled: Sheet | None = None
) -> Iterator[tuple[Array, Array, NDArray[np.bool_]]]:
    """Simulate a quasi-static scene with one rough tool.

    Between two frames the free points move on straight lines to the equilibrium without contact; one that meets the
    tool sticks to it from there. Afterwards stuck points that the tool pulls are let go, the strongest pulls first.

    Args:
        plan: plan of the scene.
        start: displacements at frame 0 [m], shape (rows, cols, 3).
        assembled: another sheet than the scene's.

    Yields:
        For each further frame, displacements [m], shape (rows, cols, 3); the tool's force [N], shape (3,); and the
        stuck points, shape (rows, cols).
    """
    assembled = assembled or sheet(plan.scene)
    u, stuck, anchor = start, np.zeros(plan.fixed.shape, dtype=bool), np.zeros_like(start)
    rate = plan.grid.frames_per_second
    for frame in range(1, plan.grid.frames + 1):
        loads, times = frame_loads(plan, frame), ((frame - 1) / rate, frame / rate)
        after = _centre(plan, times[1], assembled)
        untouched = u
        if stuck.any():
            untouched = equilibrium(plan, loads, np.where(stuck[..., None], anchor + after, u), stuck, assembled)
        for i, j in np.argwhere(~plan.fixed & ~stuck):
            share = _first_touch(plan, u, untouched, (i, j), times, assembled)
            if share is not None:
                stuck[i, j] = True
                middle = _centre(plan, times[0] + share * (times[1] - times[0]), assembled)
                anchor[i, j] = u[i, j] + share * (untouched[i, j] - u[i, j]) - middle
        while True:
            u = equilibrium(plan, loads, np.where(stuck[..., None], anchor + after, untouched), stuck, assembled)
            others = force(plan.scene, u, loads, 0, assembled)
            pulls = np.where(stuck, (others * outward(plan, u, times[1], assembled)[0]).sum(axis=-1), 0)
            if pulls.max() <= 1e-7 * np.abs(others).max():
                break
            stuck = stuck & (pulls <= pulls.max() / 2)
        assert clearance(plan, u, times[1], assembled)[0][~stuck].min() > 0
        yield u, -others[stuck].sum(axis=0), stuck.copy()


def _centre(plan: Plan, time: float, assembled: Sheet) -> Array:
    return centre(plan.scene, plan.tools[0], time, assembled)


def _first_touch(
    plan: Plan,
    before: Array,
    after: Array,
    point: tuple[int, int],
    times: tuple[float, float],
    assembled: Sheet,
) -> float | None:
    """Return the share of the stride at which a point meets the tool; its clearance is convex along the stride."""

    def gap(share: float) -> float:
        u = before + share * (after - before)
        return float(clearance(plan, u, times[0] + share * (times[1] - times[0]), assembled)[0][point])

    if gap(0) <= 1e-9 * solid_tools(plan.tools)[0].radius:
        return 0.0
    nearest = 1.0 if gap(1) < 0 else float(minimize_scalar(gap, bounds=(0, 1), method="bounded").x)
    return float(brentq(gap, 0, nearest, xtol=1e-14)) if gap(nearest) < 0 else None
