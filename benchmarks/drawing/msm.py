"""This program."""

from __future__ import annotations

from benchmarks.drawing.problem import Artist, Problem
from benchmarks.process import vector_bits
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.system import runtime


def prepare(problem: Problem, threads: int | None) -> Artist:
    """Set up the drawing."""
    runtime.start("cpu", threads)
    config = drawing_config(problem.scene)._replace(lanes=vector_bits() // 32)
    return Rasterizer(problem.scene, problem.texture, config)
