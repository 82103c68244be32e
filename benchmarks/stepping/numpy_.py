"""NumPy without temporaries: every spring once, in preallocated buffers."""

from __future__ import annotations

import numpy as np

from benchmarks.stepping.problem import Array, Problem


class Stepper:
    """The state as displacements u_n and u_{n-1}, coordinate by coordinate."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        shape = (3, problem.points, problem.points)
        self._now, self._before, self._force, self._between = (np.zeros(shape, np.float32) for _ in range(4))
        self._square, self._part = (np.empty(shape[1:], np.float32) for _ in range(2))
        self._load = problem.load
        self._started = False

    def advance(self, steps: int) -> None:
        """Advance step by step."""
        inner = np.s_[:, 1:-1, 1:-1]
        for _ in range(steps):
            self._sum_forces()
            gain = self._problem.gain if self._started else self._problem.first_gain
            self._started = True
            self._force *= np.float32(gain)
            # u_{n+1} = u_n + keep (u_n - u_{n-1}) + gain F replaces u_{n-1}.
            self._before *= np.float32(-self._problem.keep)
            np.multiply(self._now, np.float32(1 + self._problem.keep), out=self._between)
            self._before[inner] += self._between[inner]
            self._before[inner] += self._force[inner]
            self._now, self._before = self._before, self._now

    def displacement(self) -> Array:
        """Return the displacements [m], shape (n, n, 3)."""
        return np.moveaxis(self._now, 0, -1)

    def _sum_forces(self) -> None:
        force, points = self._force, (self._problem.points,) * 2
        np.multiply(self._now, np.float32(-self._problem.material.virtual), out=force)
        force += self._load
        for spring in self._problem.springs:
            start, end = ((slice(None), *window) for window in spring.ends(points))
            between, pull, part = self._between[start], self._square[start[1:]], self._part[start[1:]]
            np.subtract(self._now[end], self._now[start], out=between)
            for axis in (0, 1):
                if spring.offset[axis]:
                    between[axis] += np.float32(spring.offset[axis])
            np.multiply(between[0], between[0], out=pull)
            for axis in (1, 2):
                np.multiply(between[axis], between[axis], out=part)
                pull += part
            np.sqrt(pull, out=pull)
            np.divide(np.float32(-spring.stiffness * spring.length), pull, out=pull)
            pull += np.float32(spring.stiffness)
            between *= pull
            force[start] += between
            force[end] -= between


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest; NumPy has one thread."""
    del threads
    return Stepper(problem)
