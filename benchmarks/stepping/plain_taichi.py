"""Taichi in the style of its tutorials: a field of vectors, one launch per step, neighbours in a static loop."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import taichi as ti

from benchmarks.neighbours import springs
from benchmarks.stepping.problem import Array, Problem, Stepper


class PlainTaichi:
    """The state as displacements u_n and u_{n-1}."""

    def __init__(self, problem: Problem, threads: int | None) -> None:
        ti.init(arch=ti.cpu, log_level=ti.ERROR, **({} if threads is None else {"cpu_max_num_threads": threads}))
        n = problem.points
        now, before, load = (ti.Vector.field(3, ti.f32, shape=(n, n)) for _ in range(3))
        load.from_numpy(problem.load.transpose(1, 2, 0).copy())
        stencil = [(s.down, s.right, *s.offset, s.length, s.stiffness) for s in springs(problem.scene)]
        virtual, keep = problem.material.virtual, problem.keep

        @ti.kernel
        def step(now: ti.template(), before: ti.template(), gain: ti.f32):
            for i, j in ti.ndrange((1, n - 1), (1, n - 1)):
                u = now[i, j]
                force = load[i, j] - virtual * u
                for spring in ti.static(stencil):
                    down, right, x, y, length, stiffness = ti.static(spring)
                    between = now[i + down, j + right] - u + ti.Vector([x, y, 0.0])
                    force += stiffness * (1 - length / between.norm()) * between
                before[i, j] = u + keep * (u - before[i, j]) + gain * force

        self._step, self._now, self._before = step, now, before
        self._gain, self._next_gain = problem.first_gain, problem.gain

    def advance(self, steps: int) -> None:
        """Launch the steps one by one."""
        for _ in range(steps):
            self._step(self._now, self._before, self._gain)
            self._now, self._before = self._before, self._now
            self._gain = self._next_gain

    def displacement(self) -> Array:
        """Return the displacements [m], shape (n, n, 3)."""
        return self._now.to_numpy()


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest."""
    return PlainTaichi(problem, threads)
