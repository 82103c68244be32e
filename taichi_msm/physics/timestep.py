"""The stability limit of the step, and the choice of a step."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from taichi_msm.errors import Problem
from taichi_msm.physics.lattice import spacing
from taichi_msm.physics.material import Material
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.terms import highest_frequency
from taichi_msm.scene import WHOLE, Scene, Sheet, Time

# Lengths [m] whose squares, and a few of their products, f32 holds.
SMALLEST_SINGLE, LARGEST_SINGLE = 1e-15, 1e17


def stable_step(material: Material, sheet: Sheet, difference: str) -> float:
    """Find the largest stable step [s]; infinite where nothing oscillates.

    central: 2 / w. backward: (sqrt(g^2 + 4 w^2) - g) / w^2, written without its cancellation; g = C / m.

    Args:
        material: of the sheet.
        sheet: its size and points.
        difference: time.damping_difference.
    """
    w = highest_frequency(material, sheet)
    g = material.drag if difference == "backward" else 0.0
    limit = math.hypot(g, 2 * w) + g
    return 4 / limit if limit > 0 else math.inf


def stable_steps(plan: Plan) -> int:
    """Count the fewest stable steps of a frame."""
    # The small slack keeps a frame that is exactly n limits from being cut into n + 1 by rounding.
    return max(1, math.ceil(1 / plan.grid.frames_per_second / plan.stable_step * (1 - 1e-12)))


def steps_per_frame(time: Time, limit: float) -> int:
    """Count the steps of one frame.

    auto: the fewest whose step is at most half the stability limit. A given step is rounded to a fraction of a frame.
    A tolerance may ask for more steps, which `error_control.choose_step` finds.
    """
    frame = 1 / time.frames_per_second
    if time.step == "auto":
        # The small slack keeps a frame that is exactly n half-limits from being cut into n + 1 by rounding.
        return max(1, math.ceil(2 * frame / limit * (1 - 1e-12)))
    return max(1, round(frame / time.step))


def with_time(scene: Scene, **changes: Any) -> Scene:
    """Change keys of the scene's time."""
    return scene.model_copy(update={"time": scene.time.model_copy(update=changes)})


def with_chosen_grid(plan: Plan) -> Plan:
    """Write the grid into the scene, so that every plan of it has the same grid, on any arch.

    The precision is written, and a step in the place of a tolerance; a step that follows from the scene stays "auto".
    """
    changes: dict[str, Any] = {"precision": plan.grid.precision}
    if plan.scene.time.tolerance is not None:
        changes |= {"step": 1 / plan.grid.frames_per_second / plan.grid.steps_per_frame, "tolerance": None}
    return replace(plan, scene=with_time(plan.scene, **changes))


def step_problems(plan: Plan) -> Iterator[Problem]:
    """Find a given step that cannot be taken, and what f32 cannot hold."""
    yield from _given_step_problems(plan.scene.time, plan.stable_step)
    if plan.grid.precision == "f32":
        yield from _range_problems(plan)


def _given_step_problems(time: Time, limit: float) -> Iterator[Problem]:
    """Find a given step that is unstable or does not divide a frame."""
    given = time.step
    if given == "auto":
        return
    frame = 1 / time.frames_per_second
    if given > limit * (1 + 1e-12):
        below = frame / math.ceil(frame / limit)
        yield Problem(
            ("time", "step"),
            f"{given:g} s is above the stability limit {limit:.6g} s; try {below:.9g}, or auto",
        )
    elif abs(frame / given - round(frame / given)) > WHOLE * max(1.0, frame / given):
        yield Problem(
            ("time", "step"),
            f"{given:g} s does not divide a frame of {frame:.9g} s; try {frame / math.ceil(frame / given):.9g}",
        )


def _range_problems(plan: Plan) -> Iterator[Problem]:
    """Find what would vanish or overflow in f32 when it is squared or multiplied."""
    cells, size, step, mass = spacing(plan.scene.sheet), plan.scene.sheet.size, plan.grid.step, plan.material.mass
    if min(cells) < SMALLEST_SINGLE or max(size) > LARGEST_SINGLE:
        yield Problem(
            ("sheet", "size"),
            f"cells of {min(cells):g} m in a sheet of {max(size):g} m leave the range of f32, "
            f"{SMALLEST_SINGLE:g} to {LARGEST_SINGLE:g} m; take time.precision: f64",
        )
    gain = step**2 / mass
    if not SMALLEST_SINGLE**2 < gain < LARGEST_SINGLE**2:
        yield Problem(
            ("time", "precision"),
            f"f32 cannot hold the {gain:g} m by which a step of {step:g} s moves a mass of "
            f"{mass:g} kg for every newton; take f64",
        )
