"""How much work a run is, and what follows from it: the precision that `auto` takes, and whether an estimate is cheap.

Counted in steps of one point in f32, by the scene alone, so that every machine decides alike; one takes 1 to 2 ns on
two cores of 2024.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from taichi_msm.errors import Problem
from taichi_msm.physics.lattice import spacing
from taichi_msm.physics.loads import probe_slots
from taichi_msm.physics.material import material
from taichi_msm.physics.timestep import step, steps_per_frame, with_time
from taichi_msm.scene import Scene

# Lengths [m] whose squares, and a few of their products, f32 holds.
SMALLEST_SINGLE, LARGEST_SINGLE = 1e-15, 1e17

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


def precision(scene: Scene, arch: str = "cpu") -> str:
    """Tell the precision that a scene is stepped in, f32 or f64.

    auto: f64 while stepping is a small part of the run, and where a tolerance is given; on a GPU, which is slow or
    unable in f64, f32.
    """
    if scene.time.precision != "auto":
        return scene.time.precision
    if arch != "cpu":
        return "f32"
    small = DOUBLE * _steps(scene) <= SMALL * _other(scene)
    return "f64" if small or scene.time.tolerance is not None else "f32"


def with_precision(scene: Scene, arch: str) -> Scene:
    """Give a scene the precision that it is stepped in."""
    return with_time(scene, precision=precision(scene, arch))


def problems(scene: Scene) -> Iterator[Problem]:
    """Find what would vanish or overflow in f32 when it is squared or multiplied."""
    if precision(scene) == "f64":
        return
    cells = spacing(scene.sheet)
    if min(cells) < SMALLEST_SINGLE or max(scene.sheet.size) > LARGEST_SINGLE:
        yield Problem(
            ("sheet", "size"),
            f"cells of {min(cells):g} m in a sheet of {max(scene.sheet.size):g} m leave the range of f32, "
            f"{SMALLEST_SINGLE:g} to {LARGEST_SINGLE:g} m; take time.precision: f64",
        )
    mass = material(scene).mass
    gain = step(scene) ** 2 / mass
    if not SMALLEST_SINGLE**2 < gain < LARGEST_SINGLE**2:
        yield Problem(
            ("time", "precision"),
            f"f32 cannot hold the {gain:g} m by which a step of {step(scene):g} s moves a mass of "
            f"{mass:g} kg for every newton; take f64",
        )


def affords_pilot(scene: Scene, ratio: int) -> bool:
    """Tell whether a pilot takes at most a third of a run.

    Args:
        scene: a checked scene.
        ratio: how many times as many steps the pilot takes.
    """
    steps = _steps(scene)
    # With tissue there are two with a quarter and a sixteenth of the points besides.
    coarse = 0.0 if scene.tissue is None else DOUBLE * steps * 5 / 16
    if precision(scene) == "f64":
        own, pilot = DOUBLE * steps, DOUBLE * ratio * steps + coarse
    else:
        own, pilot = steps, DOUBLE * (ratio + 1) * steps + coarse
    return pilot <= MOST_FOR_PILOT * (pilot + own + _other(scene))


def _steps(scene: Scene) -> float:
    moving = sum(slot.moves for slot in probe_slots(scene))
    cost = 1 + MOVING * moving + BENDING * (material(scene).bending > 0)
    return cost * scene.time.frames * steps_per_frame(scene) * math.prod(scene.sheet.points)


def _other(scene: Scene) -> float:
    """Count the work beside stepping."""
    pixels = (scene.time.frames + 1) * math.prod(scene.render.size) if scene.renders else 0
    return START + pixels * (ENCODING + SAMPLE * scene.render.supersample**2)
