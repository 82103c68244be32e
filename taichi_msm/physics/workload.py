"""How much work a run is, and what follows from it: whether f64 is cheap enough for `auto`, and whether a pilot is.

Counted in steps of one point in f32, by the scene alone, so that every machine decides alike; one takes 1 to 2 ns on
two cores of 2024.
"""

from __future__ import annotations

import math

from taichi_msm.physics.loads import probe_slots
from taichi_msm.physics.material import material
from taichi_msm.scene import Scene
from taichi_msm.timegrid import TimeGrid

# Starting Python, Taichi and the kernels.
START = 4e8

# A step of a point in f64.
DOUBLE = 2.0

# What a control point that moves and bending add to a step, as shares of it.
MOVING, BENDING = 1.2, 1.0

# Encoding a pixel, and drawing a sample of it.
ENCODING, SAMPLE = 40.0, 6.0

# Stepping in f64 is a small part of a run up to this share of all else.
SMALL = 0.25

# Without a tolerance, a pilot is run only where it takes at most this share of the run.
MOST_FOR_PILOT = 1 / 3


def is_small_in_f64(scene: Scene, grid: TimeGrid) -> bool:
    """Tell whether stepping in f64 is a small part of a run, so that the precision `auto` takes it.

    Args:
        scene: a checked scene.
        grid: its steps, whatever their precision.
    """
    return DOUBLE * _steps(scene, grid) <= SMALL * _other(scene)


def affords_pilot(scene: Scene, grid: TimeGrid, ratio: int) -> bool:
    """Tell whether a pilot takes at most a third of a run.

    Args:
        scene: a checked scene.
        grid: its steps.
        ratio: how many times as many steps the pilot takes.
    """
    steps = _steps(scene, grid)
    # With tissue there are two with a quarter and a sixteenth of the points besides.
    coarse = 0.0 if scene.tissue is None else DOUBLE * steps * 5 / 16
    if grid.precision == "f64":
        own, pilot = DOUBLE * steps, DOUBLE * ratio * steps + coarse
    else:
        own, pilot = steps, DOUBLE * (ratio + 1) * steps + coarse
    return pilot <= MOST_FOR_PILOT * (pilot + own + _other(scene))


def _steps(scene: Scene, grid: TimeGrid) -> float:
    """Count the steps of points, each by what it costs."""
    moving = sum(slot.moves for slot in probe_slots(scene.probes, scene.sheet, grid.step))
    cost = 1 + MOVING * moving + BENDING * (material(scene).bending > 0)
    return cost * grid.steps * math.prod(scene.sheet.points)


def _other(scene: Scene) -> float:
    """Count the work beside stepping."""
    pixels = (scene.time.frames + 1) * math.prod(scene.render.size) if scene.draws else 0
    return START + pixels * (ENCODING + SAMPLE * scene.render.supersample**2)
