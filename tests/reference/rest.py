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
from taichi_msm.model.tools import solid_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Foundation
from tests.reference.contact import centre
from tests.reference.dynamics import (
    energy,
    force,
    foundation_force,
    lock_energy,
    spring_pull,
    surgical_force,
    tangent,
)
from tests.reference.loads import Loads
from tests.reference.sheet import Sheet, sheet

Array = NDArray[np.float64]


def potential(scene: Scene, displacement: Array, loads: Schedule | Loads, assembled: Sheet | None = None) -> float:
    """Return the energy of springs, bending and virtual springs, less the work of the loads [J].

    Args:
        scene: scene with springs or tissue.
        displacement: u [m], shape (rows, cols, 3).
        loads: schedule; its first row counts.
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(scene)
    squares, keys = (displacement**2).sum(axis=-1) / 2, None if scene.tissue is None else scene.tissue.foundation
    if isinstance(keys, Foundation) and keys.lock is not None:
        squares += lock_energy(-(displacement * assembled.normal).sum(axis=-1), keys.lock, keys.factor)
    foundation = loads.active[0] * float((assembled.virtual * squares).sum())
    work = float((surgical_force(scene, loads, 0, assembled) * displacement).sum())
    return energy(scene, displacement, assembled) + foundation - work


def clearance(plan: Plan, displacement: Array, time: float, assembled: Sheet | None = None) -> Array:
    """Return the distance of each point from each tool's surface [m], negative inside; shape (tools, rows, cols).

    Args:
        plan: plan of a scene with tools.
        displacement: u [m], shape (rows, cols, 3).
        time: time of the tools' poses [s].
        assembled: another sheet than the scene's.
    """
    radii = np.array([tool.radius for tool in solid_tools(plan.tools).values()])
    return np.linalg.norm(_from_axes(plan, displacement, time, assembled), axis=-1) - radii[:, None, None]


def outward(plan: Plan, displacement: Array, time: float, assembled: Sheet | None = None) -> Array:
    """Return unit vectors from the middle line of each tool to each point, shape (tools, rows, cols, 3).

    Args:
        plan: plan of a scene with tools.
        displacement: u [m], shape (rows, cols, 3).
        time: time of the tools' poses [s].
        assembled: another sheet than the scene's.
    """
    r = _from_axes(plan, displacement, time, assembled)
    return r / np.linalg.norm(r, axis=-1)[..., None]


def _from_axes(plan: Plan, displacement: Array, time: float, assembled: Sheet | None) -> Array:
    assembled = assembled or sheet(plan.scene)
    position = assembled.rest + displacement
    tools = solid_tools(plan.tools)
    offsets = np.empty((len(tools), *displacement.shape))
    for n, tool in enumerate(tools.values()):
        r = position - centre(plan.scene, tool, time, assembled)
        offsets[n] = r - np.clip(r @ tool.axis, 0, tool.length)[..., None] * tool.axis
    return offsets


def equilibrium(
    plan: Plan,
    loads: Schedule | Loads,
    start: Array,
    held: NDArray[np.bool_] | None = None,
    assembled: Sheet | None = None,
) -> Array:
    """Return the displacements of least potential, without tools [m], shape (rows, cols, 3).

    L-BFGS-B, then five Newton steps, as near the minimum the energy is all rounding.

    Args:
        plan: plan of a scene.
        loads: schedule; its first row counts.
        start: initial displacements [m], shape (rows, cols, 3).
        held: points that keep their initial displacement in addition to the fixed ones, shape (rows, cols).
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(plan.scene)
    free = ~plan.fixed if held is None else ~(plan.fixed | held)

    def spread(x: Array) -> Array:
        u = start.copy()
        u[free] = x.reshape(-1, 3)
        return u

    def slope(x: Array) -> Array:
        return -force(plan.scene, spread(x), loads, 0, assembled)[free].ravel()

    solution = minimize(
        lambda x: potential(plan.scene, spread(x), loads, assembled),
        start[free].ravel(),
        jac=slope,
        method="L-BFGS-B",
        options={"maxiter": 20000, "maxfun": 40000, "ftol": 1e-13, "gtol": 0, "maxcor": 30},
    )
    x, moving = solution.x, np.flatnonzero(np.repeat(free, 3))
    for _ in range(5):
        matrix = stiffness(plan.scene, spread(x), loads.active[0], assembled)[moving][:, moving]
        x = x - spsolve(matrix, slope(x))
    return spread(x)


def residual(
    scene: Scene, displacement: Array, loads: Schedule | Loads, free: NDArray[np.bool_], assembled: Sheet | None = None
) -> float:
    """Return the largest force on a free mass point, over the largest force of a spring, load or foundation.

    Args:
        scene: scene with springs or tissue.
        displacement: u [m], shape (rows, cols, 3).
        loads: schedule; its first row counts.
        free: points that are neither fixed nor held nor touched, shape (rows, cols).
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(scene)
    parts = [surgical_force(scene, loads, 0, assembled), foundation_force(scene, displacement, assembled)]
    parts[1] *= loads.active[0]
    parts += [spring_pull(scene, springs, displacement) for springs in assembled.springs]
    largest = max(float(np.linalg.norm(part, axis=-1).max()) for part in parts)
    left = force(scene, displacement, loads, 0, assembled)[free]
    return float(np.linalg.norm(left, axis=-1).max()) / largest


def equilibrium_outside_tool(
    plan: Plan, loads: Schedule | Loads, time: float, size: float, assembled: Sheet | None = None
) -> Array:
    """Return the displacements of least potential outside the only tool [m], shape (rows, cols, 3).

    SLSQP with the clearance of every free point as a constraint, from the sheet at rest.

    Args:
        plan: plan of a scene with one tool.
        loads: schedule; its first row counts.
        time: time of the tool's pose [s].
        size: rough size of the displacements [m], by which the variables are scaled.
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(plan.scene)
    free, count = ~plan.fixed, int((~plan.fixed).sum())
    work = size * float(
        np.linalg.norm(force(plan.scene, np.full((*free.shape, 3), size) * free[..., None], loads, 0, assembled))
    )

    def spread(x: Array) -> Array:
        u = np.zeros((*free.shape, 3))
        u[free] = size * x.reshape(-1, 3)
        return u

    def clearance_gradients(x: Array) -> Array:
        gradients = np.zeros((count, count, 3))
        gradients[np.arange(count), np.arange(count)] = outward(plan, spread(x), time, assembled)[0][free]
        return gradients.reshape(count, -1)

    solution = minimize(
        lambda x: potential(plan.scene, spread(x), loads, assembled) / work,
        np.zeros(3 * count),
        jac=lambda x: -force(plan.scene, spread(x), loads, 0, assembled)[free].ravel() * size / work,
        method="SLSQP",
        constraints={
            "type": "ineq",
            "fun": lambda x: clearance(plan, spread(x), time, assembled)[0][free] / size,
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
