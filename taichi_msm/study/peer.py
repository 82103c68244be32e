"""The same equations solved by SciPy's DOP853, as a careful person would do without this program."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from taichi_msm import reference
from taichi_msm.physics.loads import Schedule, key_times, loads_at
from taichi_msm.physics.plan import Plan
from taichi_msm.reference.sheet import sheet
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

    Args:
        plan: of the scene.
        rtol: relative tolerance.
        atol: absolute tolerance of displacements [m] and velocities [m/s].
        deadline: `time.perf_counter()` at which to give up.
        tick: called now and then.

    Returns:
        Displacements at every frame but the first [m], shape (F, rows, cols, 3); and the number of evaluations.

    Raises:
        TooSlowError: at the deadline.
        FailedError: when SciPy fails.
    """
    from scipy.integrate import solve_ivp

    scene = plan.scene
    shape = (*scene.sheet.points, 3)
    made, moves = sheet(scene), ~plan.fixed[..., None]
    state = np.zeros(2 * int(np.prod(shape)))
    evaluations = 0
    found = []
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
            force = reference.force(scene, u, loads, 0) - made.drag[..., None] * v
            return np.concatenate([v.ravel(), (force / made.mass[..., None] * moves).ravel()])

        times = np.union1d(frames, end)
        solved = solve_ivp(motion, (start, end), state, "DOP853", t_eval=times, rtol=rtol, atol=atol)
        if not solved.success:
            raise FailedError(f"after {solved.t[-1] if solved.t.size else start:.3g} s")
        state = solved.y[:, -1]
        evaluations += solved.nfev
        found += [column[: state.size // 2].reshape(shape) for column in solved.y.T[: len(frames)]]
    return np.array(found), evaluations


def _pieces(scene: Scene) -> Iterator[tuple[float, float, Array]]:
    """Split the time at the keys: start, end, and the times t of frames with start < t <= end."""
    frames = np.arange(1, scene.time.frames + 1) / scene.time.frames_per_second
    bounds = [0.0, *key_times(scene), float(frames[-1])]
    for start, end in pairwise(bounds):
        # A key that differs from the time of a frame only by rounding is at that frame.
        near = frames[(frames > start * (1 + INSIDE)) & (frames <= end * (1 + INSIDE))]
        yield start, end, np.minimum(near, end)
