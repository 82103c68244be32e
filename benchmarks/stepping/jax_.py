"""JAX on the CPU: all steps in one compiled loop, neighbours as shifted slices."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.neighbours import springs
from benchmarks.stepping.problem import Array, Problem


class Stepper:
    """The state as displacements u_n and u_{n-1}, coordinate by coordinate."""

    def __init__(self, problem: Problem) -> None:
        n = problem.points
        now, before = (tuple(jnp.zeros((n, n)) for _ in range(3)) for _ in range(2))
        self._state = now, before, jnp.int32(0)
        self._load = tuple(jnp.array(share[1:-1, 1:-1]) for share in problem.load)
        stencil = springs(problem.scene)
        virtual, keep, gain = problem.material.virtual, problem.keep, problem.gain
        first_gain = problem.first_gain

        def step(load, _, state):
            now, before, done = state
            x, y, z = (u[1:-1, 1:-1] for u in now)
            force = [share - virtual * u for share, u in zip(load, (x, y, z), strict=True)]
            for down, right, (off_x, off_y), length, stiffness in stencil:
                end = [u[1 + down : n - 1 + down, 1 + right : n - 1 + right] for u in now]
                to = end[0] - x + off_x, end[1] - y + off_y, end[2] - z
                pull = stiffness - stiffness * length * jax.lax.rsqrt(to[0] * to[0] + to[1] * to[1] + to[2] * to[2])
                force = [f + pull * t for f, t in zip(force, to, strict=True)]
            by = jnp.where(done > 0, gain, first_gain)
            after = tuple(
                jnp.pad(u + keep * (u - w[1:-1, 1:-1]) + by * f, 1)
                for u, w, f in zip((x, y, z), before, force, strict=True)
            )
            return after, now, done + 1

        @partial(jax.jit, donate_argnums=0)
        def advance(state, load, steps):
            return jax.lax.fori_loop(0, steps, partial(step, load), state)

        self._advance = advance

    def advance(self, steps: int) -> None:
        """Advance by all steps in one call."""
        self._state = jax.block_until_ready(self._advance(self._state, self._load, steps))

    def displacement(self) -> Array:
        """Return the displacements [m], shape (n, n, 3)."""
        return np.stack([np.asarray(u) for u in self._state[0]], axis=-1)


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest; JAX chooses the number of threads."""
    del threads
    return Stepper(problem)
