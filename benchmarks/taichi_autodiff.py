"""Taichi's automatic differentiation: fields with the full history, a launch per step, and its adjoint."""

# No `from __future__ import annotations` centre: Taichi reads the annotations of a kernel.

from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from benchmarks.stepping.problem import CELL, FORCE, Problem
from taichi_msm.model.loads import decay


class Differentiated:
    """The problem's steps, differentiable by the stiffness factors of the cells."""

    def __init__(self, problem: Problem, steps: int, threads: int) -> None:
        ti.init(arch=ti.cpu, log_level=ti.ERROR, cpu_max_num_threads=threads, default_fp=ti.f64)
        n, material, self._steps = problem.points, problem.material, steps
        self._factors = factors = ti.field(ti.f64, shape=(n - 1, n - 1), needs_grad=True)
        # Stiffness of springs to the right and down, and of both diagonals of a cell.
        across, down, shear = (ti.field(ti.f64, shape=(n, n), needs_grad=True) for _ in range(3))
        self._u = u = ti.Vector.field(3, ti.f64, shape=(steps + 1, n, n), needs_grad=True)
        self._loss = loss = ti.field(ti.f64, shape=(), needs_grad=True)
        load = ti.Vector.field(3, ti.f64, shape=(n, n))
        load.from_numpy(decay(problem.scene.probes[0], problem.plan)[..., None] * np.array(FORCE))
        factors.fill(1)
        dx, diagonal = CELL, CELL * 2**0.5
        k_across, k_down, k_shear, virtual = material.across, material.down, material.shear, material.virtual
        keep, gain, first_gain = problem.keep, problem.gain, problem.first_gain

        @ti.kernel
        def assemble():
            for i, j in factors:
                across[i, j] += k_across / 2 * factors[i, j]
                across[i + 1, j] += k_across / 2 * factors[i, j]
                down[i, j] += k_down / 2 * factors[i, j]
                down[i, j + 1] += k_down / 2 * factors[i, j]
                shear[i, j] += k_shear * factors[i, j]

        @ti.func
        def pull(k, between, length):
            return k * (1 - length / between.norm()) * between

        @ti.kernel
        def step(t: ti.i32):
            for i, j in ti.ndrange((1, n - 1), (1, n - 1)):
                centre = u[t, i, j]
                force = load[i, j] - virtual * centre
                force += pull(across[i, j], u[t, i, j + 1] - centre + ti.Vector([dx, 0.0, 0.0]), dx)
                force += pull(across[i, j - 1], u[t, i, j - 1] - centre - ti.Vector([dx, 0.0, 0.0]), dx)
                force += pull(down[i, j], u[t, i + 1, j] - centre - ti.Vector([0.0, dx, 0.0]), dx)
                force += pull(down[i - 1, j], u[t, i - 1, j] - centre + ti.Vector([0.0, dx, 0.0]), dx)
                force += pull(shear[i, j], u[t, i + 1, j + 1] - centre + ti.Vector([dx, -dx, 0.0]), diagonal)
                force += pull(shear[i, j - 1], u[t, i + 1, j - 1] - centre - ti.Vector([dx, dx, 0.0]), diagonal)
                force += pull(shear[i - 1, j], u[t, i - 1, j + 1] - centre + ti.Vector([dx, dx, 0.0]), diagonal)
                force += pull(shear[i - 1, j - 1], u[t, i - 1, j - 1] - centre - ti.Vector([dx, -dx, 0.0]), diagonal)
                u[t + 1, i, j] = centre + keep * (centre - u[t - 1, i, j]) + gain * force

        @ti.kernel
        def begin():
            for i, j in ti.ndrange((1, n - 1), (1, n - 1)):
                u[1, i, j] = first_gain * load[i, j]

        @ti.kernel
        def evaluate():
            for i, j in ti.ndrange(n, n):
                loss[None] += u[steps, i, j].norm_sqr() / 2

        self._stiffness = across, down, shear
        self._assemble, self._begin, self._step, self._evaluate = assemble, begin, step, evaluate

    def run(self) -> None:
        """Advance by all steps."""
        for k in self._stiffness:
            k.fill(0)
        self._assemble()
        self._begin()
        for t in range(1, self._steps):
            self._step(t)
        ti.sync()

    def differentiate(self) -> None:
        """Advance by all steps, and propagate the gradient back."""
        self.run()
        self._loss[None] = 0
        self._evaluate()
        for field in (self._u, self._factors, *self._stiffness):
            field.grad.fill(0)
        self._loss.grad[None] = 1
        self._evaluate.grad()
        for t in reversed(range(1, self._steps)):
            self._step.grad(t)
        self._assemble.grad()
        ti.sync()

    def gradient(self) -> NDArray[Any]:
        """Return the derivatives of the loss by the factors, shape (n - 1, n - 1)."""
        return self._factors.grad.to_numpy()
