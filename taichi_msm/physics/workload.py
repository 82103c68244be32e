"""How much work a run is, and what follows from it: whether f64 is cheap enough for `auto`, and whether pilots are.

The unit of work is a step of one point in f32, which takes 1 to 2 ns on two cores of 2024. It is counted from the scene
alone, so that the decisions are the same on every machine.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from taichi_msm.physics.plan import Plan
from taichi_msm.scene import Scene

# Work of starting Python and Taichi and of compiling the kernels.
START = 4e8

# Work of a step of a point in f64.
DOUBLE = 2.0

# Additional work of a step for a moving control point, for bending and for a tool that touches, relative to the step
# without them.
MOVING, BENDING, CONTACT = 1.2, 1.0, 0.5

# Work of encoding a pixel, and of drawing one of its samples.
ENCODING, SAMPLE = 40.0, 6.0

# Evaluations of the forces that a frame at rest takes, for each of the rows and columns together. Each is a step, and
# as much again to move the points.
EVALUATIONS = 2.0

# Stepping in f64 is a small part of a run if it takes at most this share of the time of everything else.
SMALL = 0.25

# Unless they are asked for, pilots are run only if they take at most this share of the run.
MOST_FOR_PILOTS = 2 / 5


class Work(NamedTuple):
    """The work of the parts of a run."""

    start: float  # starting Python and Taichi, and compiling the kernels
    stepping: float  # all steps
    pilots: float  # those that go with the run
    pictures: float  # drawing and encoding


def work(plan: Plan, pilots: float) -> Work:
    """Count the work of a run; pilots: their steps in f64 for each step of it, counted in steps of the whole sheet."""
    steps = _steps(plan)
    stepping = DOUBLE * steps if plan.grid.precision == "f64" else steps
    return Work(START, stepping, DOUBLE * pilots * steps, _other(plan.scene) - START)


def is_small_in_f64(plan: Plan) -> bool:
    """Tell whether stepping in f64 is a small part of a run, so that `auto` chooses it."""
    return DOUBLE * _steps(plan) <= SMALL * _other(plan.scene)


def affords_pilots(plan: Plan, pilots: float) -> bool:
    """Tell whether pilots take at most two fifths of a run; arguments as for `work`."""
    parts = work(plan, pilots)
    return parts.pilots <= MOST_FOR_PILOTS * sum(parts)


def _steps(plan: Plan) -> float:
    """Count the work of stepping in f32, or of finding the shape of every frame."""
    moving, points = sum(slot.moves for slot in plan.slots), plan.scene.sheet.points
    cost = 1 + MOVING * moving + BENDING * (plan.material.bending > 0) + CONTACT * len(plan.tools)
    steps = float(plan.grid.steps)
    if plan.scene.time.at_rest:
        cost, steps = cost + 1, EVALUATIONS * sum(points) * (plan.grid.frames + 1)
    return cost * steps * math.prod(points)


def _other(scene: Scene) -> float:
    """Count the work of everything but stepping."""
    pixels = (scene.time.frames + 1) * math.prod(scene.render.size) * len(scene.render.all_cameras) * scene.renders
    return START + pixels * (ENCODING + SAMPLE * scene.render.supersample**2)
