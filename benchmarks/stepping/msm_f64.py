"""This program in float64, which is what twice the digits cost."""

from __future__ import annotations

from benchmarks.stepping.problem import Problem, Stepper
from taichi_msm import runtime
from taichi_msm.dynamics import Dynamics


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest."""
    time = problem.scene.time.model_copy(update={"precision": "f64"})
    return Dynamics(problem.scene.model_copy(update={"time": time}), runtime.start("cpu", threads))
