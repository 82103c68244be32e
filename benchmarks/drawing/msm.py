"""This program."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.drawing.problem import Artist, Problem
from benchmarks.process import vector_bits
from taichi_msm.render.rasterizer import Drawing, structure
from taichi_msm.system import runtime


def prepare(problem: Problem, threads: int | None) -> Artist:
    """Set up the drawing."""
    runtime.start("cpu", threads)
    code = replace(structure(problem.scene), lanes=vector_bits() // 32)
    return Drawing(problem.scene, problem.texture, code)
