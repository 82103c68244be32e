"""This program in float64."""

from __future__ import annotations

from benchmarks.stepping.problem import Problem, Stepper
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.system import runtime


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest."""
    return Dynamics(problem.plan.with_grid(precision="f64"), runtime.start("cpu", threads))
