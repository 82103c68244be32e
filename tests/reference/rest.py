"""The reference for the sheet at rest: SciPy's minimum of the potential energy."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import minimize
from scipy.sparse.linalg import spsolve

from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from tests.reference.dynamics import energy, force, surgical_force, tangent
from tests.reference.sheet import sheet

Array = NDArray[np.float64]


def potential(scene: Scene, displacement: Array, loads: Schedule) -> float:
    """Give the energy of springs, bending and virtual springs, less the work of the loads [J]."""
    held = loads.active[0] / 2 * float((sheet(scene).virtual[..., None] * displacement**2).sum())
    return energy(scene, displacement) + held - float((surgical_force(scene, loads, 0) * displacement).sum())


def place(plan: Plan, displacement: Array) -> Array:
    """Give the positions of displaced points [m]."""
    return rest_positions(plan.scene.sheet) + displacement


def clearance(plan: Plan, displacement: Array, time: float) -> Array:
    """Tell how far each point is from the surface of each tool [m], below 0 within it; shape (tools, rows, cols)."""
    radii = np.array([tool.radius for tool in plan.tools])
    return np.linalg.norm(_from_axes(plan, displacement, time), axis=-1) - radii[:, None, None]


def away(plan: Plan, displacement: Array, time: float) -> Array:
    """Give the unit vectors from the middle line of each tool to each point, shape (tools, rows, cols, 3)."""
    r = _from_axes(plan, displacement, time)
    return r / np.linalg.norm(r, axis=-1)[..., None]


def _from_axes(plan: Plan, displacement: Array, time: float) -> Array:
    every = np.empty((len(plan.tools), *displacement.shape))
    for n, tool in enumerate(plan.tools):
        r = place(plan, displacement) - tool.tip_centre(np.array([time]))[0]
        every[n] = r - np.clip(r @ tool.axis, 0, tool.length)[..., None] * tool.axis
    return every


def equilibrium(plan: Plan, loads: Schedule, start: Array, held: NDArray[np.bool_] | None = None) -> Array:
    """Minimise the potential from a start, whose fixed and held points stay, without tools [m], shape (rows, cols, 3).

    Near the minimum the energy is all rounding, and Newton's steps go on.
    """
    free = ~plan.fixed if held is None else ~(plan.fixed | held)

    def spread(x: Array) -> Array:
        u = start.copy()
        u[free] = x.reshape(-1, 3)
        return u

    def slope(x: Array) -> Array:
        return -force(plan.scene, spread(x), loads, 0)[free].ravel()

    found = minimize(
        lambda x: potential(plan.scene, spread(x), loads),
        start[free].ravel(),
        jac=slope,
        method="L-BFGS-B",
        options={"maxiter": 20000, "maxfun": 40000, "ftol": 1e-13, "gtol": 0, "maxcor": 30},
    )
    x, moving = found.x, np.flatnonzero(np.repeat(free, 3))
    for _ in range(5):
        x = x - spsolve(stiffness(plan.scene, spread(x), loads.active[0])[moving][:, moving], slope(x))
    return spread(x)


def equilibrium_outside_tool(plan: Plan, loads: Schedule, time: float, size: float) -> Array:
    """Minimise the potential over all shapes outside the only tool at a time, from the flat sheet on, by SLSQP.

    size: of the displacements [m], roughly, by which SLSQP's variables are scaled.
    """
    free, count = ~plan.fixed, int((~plan.fixed).sum())
    work = size * float(np.linalg.norm(force(plan.scene, np.full((*free.shape, 3), size) * free[..., None], loads, 0)))

    def spread(x: Array) -> Array:
        u = np.zeros((*free.shape, 3))
        u[free] = size * x.reshape(-1, 3)
        return u

    def outward(x: Array) -> Array:
        """Differentiate the clearance of each point by all variables."""
        slopes = np.zeros((count, count, 3))
        slopes[np.arange(count), np.arange(count)] = away(plan, spread(x), time)[0][free]
        return slopes.reshape(count, -1)

    found = minimize(
        lambda x: potential(plan.scene, spread(x), loads) / work,
        np.zeros(3 * count),
        jac=lambda x: -force(plan.scene, spread(x), loads, 0)[free].ravel() * size / work,
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda x: clearance(plan, spread(x), time)[0][free] / size, "jac": outward},
        options={"ftol": 1e-15, "maxiter": 500},
    )
    assert found.success, found.message
    return spread(found.x)


def stiffness(scene: Scene, displacement: Array | float = 0.0, active: float = 1.0) -> Any:
    """Differentiate all forces but those of the probes: sparse, shape (3 points, 3 points).

    No point feels two others of which both coordinates differ by multiples of five, so that these change together.
    """
    rows, cols = scene.sheet.points
    u = np.zeros((rows, cols, 3)) + displacement
    number, (i, j) = np.arange(u.size).reshape(u.shape), np.mgrid[:rows, :cols]
    made, entries = sheet(scene), []
    for down, right, axis in itertools.product(range(5), range(5), range(3)):
        change = np.zeros_like(u)
        change[down::5, right::5, axis] = 1
        felt = -tangent(scene, u, change, active, made)
        row, column = i + (down - i + 2) % 5 - 2, j + (right - j + 2) % 5 - 2
        near = (row >= 0) & (row < rows) & (column >= 0) & (column < cols)
        by = np.repeat(number[row[near], column[near], axis], 3)
        entries.append((felt[near].ravel(), number[near].ravel(), by))
    values, to, of = (np.concatenate(each) for each in zip(*entries, strict=True))
    return sparse.csc_array((values, (to, of)), shape=(u.size, u.size))
