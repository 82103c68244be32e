"""This program."""

from __future__ import annotations

from benchmarks.drawing.problem import Artist, Problem
from taichi_msm import runtime
from taichi_msm.drawing import Drawing


def prepare(problem: Problem, threads: int | None) -> Artist:
    """Set up the drawing."""
    runtime.start("cpu", threads)
    return Drawing(problem.scene, problem.texture)
