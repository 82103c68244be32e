"""SciPy's general integrator DOP853 on the equations of scenes/figure-3.yaml, in NumPy."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from benchmarks.process import ROOT
from taichi_msm import load_scene
from taichi_msm.model.loads import decay, evaluate_loads
from taichi_msm.solver.planning import make_plan
from tests import reference

Array = NDArray[Any]

RTOLS = (1e-3, 1e-5, 1e-7)
REFERENCE_RTOL = 1e-10


def integrate(rtol: float, largest: float = 0.03) -> Array:
    """Return the displacements at every frame but the first [m], shape (frames, rows, cols, 3).

    Args:
        rtol: relative tolerance; the absolute one is rtol x largest / 10.
        largest: rough largest displacement [m].
    """
    plan = make_plan(load_scene(ROOT / "scenes" / "figure-3.yaml", ["output=[]"]))
    scene, shape = plan.scene, (*plan.scene.sheet.points, 3)
    assembled, free = reference.sheet(scene), ~plan.fixed[..., None]
    share = decay(scene.probes[0], plan)[..., None]
    frames = np.arange(1, plan.grid.frames + 1) / plan.grid.frames_per_second
    state, displacements = np.zeros((2, *shape)).ravel(), []
    # Intervals between keyframes, where loads are smooth.
    for start, end in pairwise(sorted({0.0, *(t for t, _ in scene.probes[0].load), float(frames[-1])})):
        margin = 1e-9 * (end - start)  # loads jump at keyframes

        def motion(t: float, y: Array, first: float = start + margin, last: float = end - margin) -> Array:
            u, v = y.reshape(2, *shape)
            loads = evaluate_loads(plan, np.clip([t], first, last))
            force = reference.elastic_force(scene, u, assembled) - loads.active[0] * plan.material.virtual * u
            force += share * loads.strength[0, 0]
            acceleration = (force - scene.damping * v) / scene.sheet.mass
            return np.stack([v, acceleration * free]).ravel()

        inside = frames[(frames > start + margin) & (frames <= end + margin)]
        times = np.union1d(np.minimum(inside, end), end)
        solution = solve_ivp(motion, (start, end), state, "DOP853", t_eval=times, rtol=rtol, atol=rtol * largest / 10)
        state = solution.y[:, -1]
        displacements += [column.reshape(2, *shape)[0] for column in solution.y.T[: len(inside)]]
    return np.array(displacements)


def measure() -> dict[float, tuple[float, float]]:
    """Return time [s] and error, as a fraction of the largest displacement, by relative tolerance."""
    exact = integrate(REFERENCE_RTOL)
    largest = np.linalg.norm(exact, axis=-1).max()
    results = {}
    for rtol in RTOLS:
        start = time.perf_counter()
        frames = integrate(rtol)
        seconds = time.perf_counter() - start
        results[rtol] = seconds, float(np.linalg.norm(frames - exact, axis=-1).max() / largest)
    return results
