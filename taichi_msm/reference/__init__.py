"""The model and the picture once more in plain float64 NumPy, slow and obvious: what the kernels are tested against.

Not to be confused with an independent check: it is itself tested against closed forms and SciPy's integrators.
"""

from taichi_msm.reference.drawing import draw, refine
from taichi_msm.reference.dynamics import (
    displacements,
    elastic_force,
    force,
    shortest_spring,
    simulate,
    surgical_force,
)

__all__ = [
    "displacements",
    "draw",
    "elastic_force",
    "force",
    "refine",
    "shortest_spring",
    "simulate",
    "surgical_force",
]
