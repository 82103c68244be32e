"""The kernel against solutions that take no steps: the shape at rest under a load, and the modes of small motions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root

from taichi_msm.model.loads import evaluate_loads
from taichi_msm.model.sheet import fixed_points
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.state import State
from taichi_msm.system.runtime import Device
from tests import reference
from tests.motion import dynamics_of
from tests.scenes import SPRINGS, plan_of, scene

SHEET = {"points": [6, 7], "size": [0.3, 0.4], "mass": 1e-3}


def residual(made: Scene, moving: NDArray[np.float64]) -> NDArray[np.float64]:
    """Forces on the points that move, given their displacements, at the end of the scene."""
    free = ~fixed_points(made.sheet)
    u = np.zeros((*made.sheet.points, 3))
    u[free] = moving.reshape(-1, 3)
    return reference.force(made, u, evaluate_loads(plan_of(made), np.array([made.time.duration])), 0)[free].ravel()


def test_a_sheet_comes_to_rest_where_the_forces_balance(device: Device) -> None:
    probe = {"at": [0.4, 0.6], "force": [0.01, 0.02, -0.1], "load": [[0, 0], [0.1, 100]], "falloff": 20, "offset": 0}
    made = scene(sheet=SHEET, probes=[probe], damping=0.05, time={"duration": 12.0})
    dynamics = dynamics_of(made, device)
    dynamics.advance(plan_of(made).grid.steps)
    u = dynamics.displacement()
    dynamics.close()
    moving = u[~fixed_points(made.sheet)].ravel()
    found = root(lambda x: residual(made, x), 0.9 * moving, tol=1e-13)
    assert np.abs(found.fun).max() < 1e-12
    assert np.abs(found.x).max() > 0.01
    # What is left of the motion after 12 s of a damping that halves it within a tenth of a second is rounding.
    np.testing.assert_allclose(moving, found.x, atol=1e-9 * np.abs(found.x).max())


def test_small_motions_have_the_frequencies_of_the_stiffness(device: Device) -> None:
    springs = {**SPRINGS, "virtual_active": "always"}
    made = scene(sheet=SHEET, springs=springs, probes=[], damping=0, time={"duration": 0.4})
    free, grid, m = ~fixed_points(made.sheet), plan_of(made).grid, made.sheet.mass
    size, small = 3 * int(free.sum()), 1e-7
    rows = [(residual(made, small * one) - residual(made, -small * one)) / (2 * small) for one in np.eye(size)]
    stiffness = -np.array(rows)
    values, vectors = np.linalg.eigh((stiffness + stiffness.T) / 2)
    dynamics = dynamics_of(made, device)
    for mode in (0, size // 2, size - 1):
        theta = 2 * math.asin(math.sqrt(values[mode] / m) * grid.step / 2)
        shape = np.zeros((*made.sheet.points, 3))
        # So small that what is not linear in it is less than rounding, and far above that.
        shape[free] = 1e-9 * vectors[:, mode].reshape(-1, 3)
        dynamics.restart(plan_of(made), State(1, shape, shape * (1 - math.cos(theta))))
        dynamics.advance(grid.steps)
        found = float((dynamics.displacement() * shape).sum() / (shape * shape).sum())
        assert abs(found - math.cos(grid.steps * theta)) < 1e-5, mode
    dynamics.close()
