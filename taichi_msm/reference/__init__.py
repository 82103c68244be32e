"""The model and the picture once more in plain float64 NumPy, slow and obvious: what the kernels are tested against.

Not to be confused with an independent check: it is itself tested against closed forms and SciPy's integrators.
"""

from taichi_msm.reference.drawing import draw, refine
from taichi_msm.reference.dynamics import (
    bending_force,
    displacements,
    elastic_force,
    energy,
    energy_density,
    force,
    longest_spring,
    shortest_spring,
    simulate,
    surgical_force,
)
from taichi_msm.reference.sheet import sheet

__all__ = [
    "bending_force",
    "displacements",
    "draw",
    "elastic_force",
    "energy",
    "energy_density",
    "force",
    "longest_spring",
    "refine",
    "sheet",
    "shortest_spring",
    "simulate",
    "surgical_force",
]
