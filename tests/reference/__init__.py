"""The model and the picture a second time, in plain float64 NumPy, slow and simple: the kernels are tested against it.

This is no independent check of the model; it is itself tested against closed forms and SciPy's integrators.
"""

from tests.reference.drawing import draw, refine
from tests.reference.dynamics import (
    bending_force,
    displacements,
    elastic_force,
    energy,
    force,
    longest_spring,
    shortest_spring,
    simulate,
    steps,
    surgical_force,
    tangent,
)
from tests.reference.rest import clearance, equilibrium, equilibrium_outside_tool, place, potential, stiffness
from tests.reference.sheet import sheet

__all__ = [
    "bending_force",
    "clearance",
    "displacements",
    "draw",
    "elastic_force",
    "energy",
    "equilibrium",
    "equilibrium_outside_tool",
    "force",
    "longest_spring",
    "place",
    "potential",
    "refine",
    "sheet",
    "shortest_spring",
    "simulate",
    "steps",
    "stiffness",
    "surgical_force",
    "tangent",
]
