"""NVIDIA Warp on the CPU, where it takes one thread: a vector a point, one launch a step."""

# No `from __future__ import annotations` here: Warp reads the annotations of a kernel.

import numpy as np
import warp as wp

from benchmarks.stepping.problem import Array, Problem, Stepper
from taichi_msm.model.sheet import spacing


@wp.struct
class Numbers:
    """The numbers of the problem."""

    dx: float
    dy: float
    structural: float
    shear: float
    ground: float
    keep: float


@wp.func
def pull(to: wp.vec3, length: float, stiffness: float) -> wp.vec3:
    """Give the force of a spring."""
    return stiffness * (1.0 - length / wp.length(to)) * to


@wp.kernel
def step(
    now: wp.array2d(dtype=wp.vec3),
    before: wp.array2d(dtype=wp.vec3),
    load: wp.array2d(dtype=wp.vec3),
    c: Numbers,
    gain: float,
):
    """Step an inner point."""
    i, j = wp.tid()
    i += 1
    j += 1
    u = now[i, j]
    right = wp.vec3(c.dx, 0.0, 0.0)
    up = wp.vec3(0.0, c.dy, 0.0)
    diagonal = wp.sqrt(c.dx * c.dx + c.dy * c.dy)
    force = load[i, j] - c.ground * u
    force += pull(now[i, j - 1] - u - right, c.dx, c.structural)
    force += pull(now[i, j + 1] - u + right, c.dx, c.structural)
    force += pull(now[i - 1, j] - u + up, c.dy, c.structural)
    force += pull(now[i + 1, j] - u - up, c.dy, c.structural)
    force += pull(now[i - 1, j - 1] - u - right + up, diagonal, c.shear)
    force += pull(now[i - 1, j + 1] - u + right + up, diagonal, c.shear)
    force += pull(now[i + 1, j - 1] - u - right - up, diagonal, c.shear)
    force += pull(now[i + 1, j + 1] - u + right - up, diagonal, c.shear)
    before[i, j] = u + c.keep * (u - before[i, j]) + gain * force


class WarpStepper:
    """The state as displacements u_n and u_{n-1}."""

    def __init__(self, problem: Problem) -> None:
        n, sheet = problem.points, problem.material
        self._now, self._before = (wp.zeros((n, n), dtype=wp.vec3, device="cpu") for _ in range(2))
        self._load = wp.array(problem.load.transpose(1, 2, 0).copy(), dtype=wp.vec3, device="cpu")
        numbers = self._numbers = Numbers()
        numbers.dx, numbers.dy = spacing(problem.scene.sheet)
        numbers.structural, numbers.shear, numbers.ground = sheet.across, sheet.shear, sheet.virtual
        numbers.keep = problem.keep
        self._gain, self._next_gain = problem.first_gain, problem.gain

    def advance(self, steps: int) -> None:
        """Launch the steps one by one."""
        n = self._now.shape[0]
        for _ in range(steps):
            inputs = [self._now, self._before, self._load, self._numbers, self._gain]
            wp.launch(step, dim=(n - 2, n - 2), inputs=inputs, device="cpu")
            self._now, self._before = self._before, self._now
            self._gain = self._next_gain

    def displacement(self) -> Array:
        """Give the displacement, shape (n, n, 3)."""
        return np.asarray(self._now.numpy())


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest."""
    del threads
    return WarpStepper(problem)
