"""Shapes of tools: their table, and a file per shape."""

from taichi_msm.shapes.capsule import Capsule
from taichi_msm.shapes.plate import Plate
from taichi_msm.shapes.shape import Shape

SHAPES: dict[str, Shape] = {shape.name: shape for shape in (Capsule(), Plate())}
