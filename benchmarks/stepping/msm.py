"""This program."""

from __future__ import annotations

from benchmarks.stepping.problem import Problem, Stepper
from taichi_msm import runtime
from taichi_msm.dynamics import Dynamics


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest."""
    return Dynamics(problem.scene, runtime.start("cpu", threads))
