"""This program."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.process import vector_bits
from benchmarks.stepping.problem import Problem, Stepper
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.sheet_solver import choose_layout
from taichi_msm.system import runtime


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest."""
    device = runtime.start("cpu", threads)
    layout = choose_layout(problem.plan, device)
    layout = replace(layout, config=replace(layout.config, lanes=vector_bits() // 32))
    return Dynamics(problem.plan, device, layout)
