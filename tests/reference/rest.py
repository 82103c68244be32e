"""NumPy reference of quasi-static equilibrium: SciPy's minimum of the potential energy."""

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
from taichi_msm.model.tools import solid_tools
from taichi_msm.scene.scene import Scene
from tests.reference.dynamics import energy, force, surgical_force, tangent
from tests.reference.sheet import Sheet, sheet

Array = NDArray[np.float64]


def potential(scene: Scene, displacement: Array, loads: Schedule) -> float:
    """Return the energy of springs, bending and virtual springs, less the work of the loads [J].

    Args:
        scene: scene with springs or tissue.
        displacement: u [m], shape (rows, cols, 3).
        loads: schedule; its first row counts.
    """
    foundation = loads.active[0] / 2 * float((sheet(scene).virtual[..., None] * displacement**2).sum())
    return energy(scene, displacement) + foundation - float((surgical_force(scene, loads, 0) * displacement).sum())


def clearance(plan: Plan, displacement: Array, time: float) -> Array:
    """Return the distance of each point from each tool's surface [m], negative inside; shape (tools, rows, cols).

    Args:
        plan: plan of a scene with tools.
        displacement: u [m], shape (rows, cols, 3).
        time: time of the tools' poses [s].
    """
    radii = np.array([tool.radius for tool in solid_tools(plan.tools).values()])
    return np.linalg.norm(_from_axes(plan, displacement, time), axis=-1) - radii[:, None, None]


def outward(plan: Plan, displacement: Array, time: float) -> Array:
    """Return unit vectors from the middle line of each tool to each point, shape (tools, rows, cols, 3).

    Args:
        plan: plan of a scene with tools.
        displacement: u [m], shape (rows, cols, 3).
        time: time of the tools' poses [s].
    """
    r = _from_axes(plan, displacement, time)
    return r / np.linalg.norm(r, axis=-1)[..., None]


def _from_axes(plan: Plan, displacement: Array, time: float) -> Array:
    position = rest_positions(plan.scene.sheet) + displacement
    tools = solid_tools(plan.tools)
    offsets = np.empty((len(tools), *displacement.shape))
    for n, tool in enumerate(tools.values()):
        r = position - tool.path_at(np.array([time]))[0]
        offsets[n] = r - np.clip(r @ tool.axis, 0, tool.length)[..., None] * tool.axis
    return offsets


def equilibrium(plan: Plan, loads: Schedule, start: Array, held: NDArray[np.bool_] | None = None) -> Array:
    """Return the displacements of least potential, without tools [m], shape (rows, cols, 3).

    L-BFGS-B, then five Newton steps, as near the minimum the energy is all rounding.

    Args:
        plan: plan of a scene.
        loads: schedule; its first row counts.
        start: initial displacements [m], shape (rows, cols, 3).
        held: points that keep their initial displacement in addition to the fixed ones, shape (rows, cols).
    """
    free = ~plan.fixed if held is None else ~(plan.fixed | held)

    def spread(x: Array) -> Array:
        u = start.copy()
        u[free] = x.reshape(-1, 3)
        return u

    def slope(x: Array) -> Array:
        return -force(plan.scene, spread(x), loads, 0)[free].ravel()

    solution = minimize(
        lambda x: potential(plan.scene, spread(x), loads),
        start[free].ravel(),
        jac=slope,
        method="L-BFGS-B",
        options={"maxiter": 20000, "maxfun": 40000, "ftol": 1e-13, "gtol": 0, "maxcor": 30},
    )
    x, moving = solution.x, np.flatnonzero(np.repeat(free, 3))
    for _ in range(5):
        x = x - spsolve(stiffness(plan.scene, spread(x), loads.active[0])[moving][:, moving], slope(x))
    return spread(x)


def equilibrium_outside_tool(plan: Plan, loads: Schedule, time: float, size: float) -> Array:
    """Return the displacements of least potential outside the only tool [m], shape (rows, cols, 3).

    SLSQP with the clearance of every free point as a constraint, from the flat sheet.

    Args:
        plan: plan of a scene with one tool.
        loads: schedule; its first row counts.
        time: time of the tool's pose [s].
        size: rough size of the displacements [m], by which the variables are scaled.
    """
    free, count = ~plan.fixed, int((~plan.fixed).sum())
    work = size * float(np.linalg.norm(force(plan.scene, np.full((*free.shape, 3), size) * free[..., None], loads, 0)))

    def spread(x: Array) -> Array:
        u = np.zeros((*free.shape, 3))
        u[free] = size * x.reshape(-1, 3)
        return u

    def clearance_gradients(x: Array) -> Array:
        gradients = np.zeros((count, count, 3))
        gradients[np.arange(count), np.arange(count)] = outward(plan, spread(x), time)[0][free]
        return gradients.reshape(count, -1)

    solution = minimize(
        lambda x: potential(plan.scene, spread(x), loads) / work,
        np.zeros(3 * count),
        jac=lambda x: -force(plan.scene, spread(x), loads, 0)[free].ravel() * size / work,
        method="SLSQP",
        constraints={
            "type": "ineq",
            "fun": lambda x: clearance(plan, spread(x), time)[0][free] / size,
            "jac": clearance_gradients,
        },
        options={"ftol": 1e-15, "maxiter": 500},
    )
    assert solution.success, solution.message
    return spread(solution.x)


def stiffness(
    scene: Scene, displacement: Array | float = 0.0, active: float = 1.0, assembled: Sheet | None = None
) -> Any:
    """Return the stiffness matrix, -dF/du without the probes [N/m]: sparse, shape (3 rows cols, 3 rows cols).

    By 75 products with `tangent`: a point feels at most two rows and columns of neighbours, so every fifth row and
    column is displaced at once.

    Args:
        scene: scene with springs or tissue.
        displacement: u at which it is taken [m], shape (rows, cols, 3), or 0 for the sheet at rest.
        active: share of the virtual springs that are active, 0 to 1.
        assembled: another sheet than the scene's.
    """
    rows, cols = scene.sheet.points
    u = np.zeros((rows, cols, 3)) + displacement
    number, (i, j) = np.arange(u.size).reshape(u.shape), np.mgrid[:rows, :cols]
    assembled, entries = assembled or sheet(scene), []
    for down, right, axis in itertools.product(range(5), range(5), range(3)):
        change = np.zeros_like(u)
        change[down::5, right::5, axis] = 1
        force = -tangent(scene, u, change, active, assembled)
        row, column = i + (down - i + 2) % 5 - 2, j + (right - j + 2) % 5 - 2
        near = (row >= 0) & (row < rows) & (column >= 0) & (column < cols)
        by = np.repeat(number[row[near], column[near], axis], 3)
        entries.append((force[near].ravel(), number[near].ravel(), by))
    values, to, by = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    return sparse.csc_array((values, (to, by)), shape=(u.size, u.size))
