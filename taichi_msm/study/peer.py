"""The same equations solved by SciPy's DOP853, as a careful person would do without this program."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.elasticity import elastic_force, spring_families
from taichi_msm.physics.lattice import axes, spacing
from taichi_msm.physics.loads import Schedule, key_times, loads_at
from taichi_msm.physics.material import area_shares
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.probe_force import probe_force
from taichi_msm.scene import Scene

# Loads are evaluated this far inside an interval between two keys, as a fraction of it: at its ends they may jump.
INSIDE = 1e-9

Array = NDArray[np.float64]


class TooSlowError(Exception):
    """The time limit is exceeded."""


class FailedError(Exception):
    """The solver finds no step that is small enough; the message says when."""


def solve(plan: Plan, rtol: float, atol: float, deadline: float, tick: Callable[[], None]) -> tuple[Array, int]:
    """Integrate from key to key of the loads, between which they are smooth.

    The absolute tolerance is of displacements [m] and velocities [m/s]; `tick` is called now and then.

    Returns:
        Displacements at every frame but the first [m], shape (F, rows, cols, 3); and the number of evaluations.

    Raises:
        TooSlowError: when `time.perf_counter()` has come to the deadline.
        FailedError: when SciPy fails.
    """
    from scipy.integrate import solve_ivp

    scene = plan.scene
    shape = (*scene.sheet.points, 3)
    accelerate, moves = acceleration(plan), ~plan.fixed[..., None]
    state = np.zeros(2 * int(np.prod(shape)))
    evaluations = 0
    displacements = []
    for start, end, frames in _pieces(scene):
        margin = INSIDE * (end - start)
        first = loads_at(plan, np.array([start + margin, end - margin]))

        def motion(t: float, y: Array, start: float = start, end: float = end, ends: Schedule = first) -> Array:
            if time.perf_counter() > deadline:
                raise TooSlowError
            tick()
            share = (t - start) / (end - start)
            between = (each[:1] + share * (each[1:] - each[:1]) for each in ends[1:])
            loads = Schedule(ends.slots, *between)
            u, v = y.reshape(2, *shape)
            return np.concatenate([v.ravel(), (accelerate(u, v, loads) * moves).ravel()])

        times = np.union1d(frames, end)
        solved = solve_ivp(motion, (start, end), state, "DOP853", t_eval=times, rtol=rtol, atol=atol)
        if not solved.success:
            raise FailedError(f"after {solved.t[-1] if solved.t.size else start:.3g} s")
        state = solved.y[:, -1]
        evaluations += solved.nfev
        displacements += [column[: state.size // 2].reshape(shape) for column in solved.y.T[: len(frames)]]
    return np.array(displacements), evaluations


def acceleration(plan: Plan) -> Callable[[Array, Array, Schedule], Array]:
    """Prepare the right side of eq. 1 over the mass: displacements [m] and velocities [m/s] to accelerations [m/s2].

    The arrays have the shape (rows, cols, 3), and the schedule one step.
    """
    scene, sheet, every = plan.scene, plan.material, tuple(spring_families(plan))
    (dx, dy), (x, y) = spacing(scene.sheet), axes(scene.sheet)
    shares = area_shares(scene.sheet)
    area = shares if sheet.by_area else np.ones_like(shares)
    held = area if sheet.virtual_factors is None else area * sheet.virtual_factors
    probes = [probe_force(probe, scene.sheet) for probe in scene.probes]

    def laplacian(u: Array) -> Array:
        inner = u[1:-1, 1:-1]
        return (u[1:-1, 2:] - 2 * inner + u[1:-1, :-2]) / dx**2 + (u[2:, 1:-1] - 2 * inner + u[:-2, 1:-1]) / dy**2

    def accelerate(u: Array, v: Array, loads: Schedule) -> Array:
        force = elastic_force(every, u) - (loads.active[0] * sheet.virtual * held)[..., None] * u
        for slot, strength, (at_x, at_y) in zip(loads.slots, loads.strength[0], loads.point[0], strict=True):
            probe = probes[slot.probe]
            decay = probe.decay(np.hypot(x - at_x, y - at_y)) * (shares if probe.by_area else 1)
            force += decay[..., None] * strength
        if sheet.bending:
            # Points with four neighbours have a moment; those at the edges, which are fixed, need no force.
            moment = np.zeros_like(u)
            moment[1:-1, 1:-1] = sheet.bending * laplacian(u)
            force[1:-1, 1:-1] -= laplacian(moment)
        return np.asarray(force / (sheet.mass * area)[..., None] - sheet.drag * v)

    return accelerate


def _pieces(scene: Scene) -> Iterator[tuple[float, float, Array]]:
    """Split the time at the keys: start, end, and the times t of frames with start < t <= end."""
    frames = np.arange(1, scene.time.frames + 1) / scene.time.frames_per_second
    bounds = [0.0, *key_times(scene), float(frames[-1])]
    for start, end in pairwise(bounds):
        # A key that differs from the time of a frame only by rounding is at that frame.
        near = frames[(frames > start * (1 + INSIDE)) & (frames <= end * (1 + INSIDE))]
        yield start, end, np.minimum(near, end)
