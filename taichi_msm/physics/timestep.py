"""The stability limit, and the choice of a step and a precision: the time grid of a scene."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from taichi_msm.errors import Problem
from taichi_msm.physics.lattice import spacing
from taichi_msm.physics.material import highest_frequency, material
from taichi_msm.physics.workload import is_small_in_f64
from taichi_msm.scene import WHOLE, Scene
from taichi_msm.timegrid import TimeGrid

# Lengths [m] whose squares, and a few of their products, f32 holds.
SMALLEST_SINGLE, LARGEST_SINGLE = 1e-15, 1e17


def stable_step(scene: Scene) -> float:
    """Find the largest stable step [s]; infinite where nothing oscillates.

    central: 2 / w. backward: (sqrt(g^2 + 4 w^2) - g) / w^2, written without its cancellation; g = C / m.
    """
    w = highest_frequency(scene)
    g = material(scene).drag if scene.time.damping_difference == "backward" else 0.0
    limit = math.hypot(g, 2 * w) + g
    return 4 / limit if limit > 0 else math.inf


def stable_steps(scene: Scene) -> int:
    """Count the fewest stable steps of a frame."""
    # The small slack keeps a frame that is exactly n limits from being cut into n + 1 by rounding.
    return max(1, math.ceil(1 / scene.time.frames_per_second / stable_step(scene) * (1 - 1e-12)))


def time_grid(scene: Scene, arch: str = "cpu") -> TimeGrid:
    """Decide the steps and the precision of a scene.

    A tolerance may ask for more steps, which `error_control.choose_step` finds.

    Args:
        scene: a scene, with the step "auto" or one that divides a frame.
        arch: cpu, cuda or vulkan.
    """
    time = scene.time
    grid = TimeGrid(time.frames_per_second, time.frames, _steps_per_frame(scene), "f64")
    if time.precision != "auto":
        return replace(grid, precision=time.precision)
    # A tolerance asks for f64. On a GPU it is slow or missing.
    in_f64 = arch == "cpu" and (time.tolerance is not None or is_small_in_f64(scene, grid))
    return grid if in_f64 else replace(grid, precision="f32")


def _steps_per_frame(scene: Scene) -> int:
    """Count the steps of one frame.

    auto: the fewest whose step is at most half the stability limit. A given step is rounded to a fraction of a frame.
    """
    frame = 1 / scene.time.frames_per_second
    if scene.time.step == "auto":
        # The small slack keeps a frame that is exactly n half-limits from being cut into n + 1 by rounding.
        return max(1, math.ceil(2 * frame / stable_step(scene) * (1 - 1e-12)))
    return max(1, round(frame / scene.time.step))


def with_time(scene: Scene, **changes: Any) -> Scene:
    """Change keys of the scene's time."""
    return scene.model_copy(update={"time": scene.time.model_copy(update=changes)})


def with_grid(scene: Scene, grid: TimeGrid) -> Scene:
    """Write into a scene what was decided for it, so that `time_grid` gives the same grid for it on any arch.

    The precision is written, and a step in the place of a tolerance; a step that follows from the scene stays "auto".
    """
    if scene.time.tolerance is None:
        return with_time(scene, precision=grid.precision)
    step = 1 / grid.frames_per_second / grid.steps_per_frame
    return with_time(scene, precision=grid.precision, step=step, tolerance=None)


def problems(scene: Scene) -> Iterator[Problem]:
    """Find a given step that cannot be taken, and what f32 cannot hold."""
    yield from _step_problems(scene)
    yield from _range_problems(scene)


def _step_problems(scene: Scene) -> Iterator[Problem]:
    """Find a given step that is unstable or does not divide a frame."""
    given = scene.time.step
    if given == "auto":
        return
    frame = 1 / scene.time.frames_per_second
    limit = stable_step(scene)
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


def _range_problems(scene: Scene) -> Iterator[Problem]:
    """Find what would vanish or overflow in f32 when it is squared or multiplied."""
    grid = time_grid(scene)
    if grid.precision == "f64":
        return
    cells = spacing(scene.sheet)
    if min(cells) < SMALLEST_SINGLE or max(scene.sheet.size) > LARGEST_SINGLE:
        yield Problem(
            ("sheet", "size"),
            f"cells of {min(cells):g} m in a sheet of {max(scene.sheet.size):g} m leave the range of f32, "
            f"{SMALLEST_SINGLE:g} to {LARGEST_SINGLE:g} m; take time.precision: f64",
        )
    mass = material(scene).mass
    gain = grid.step**2 / mass
    if not SMALLEST_SINGLE**2 < gain < LARGEST_SINGLE**2:
        yield Problem(
            ("time", "precision"),
            f"f32 cannot hold the {gain:g} m by which a step of {grid.step:g} s moves a mass of "
            f"{mass:g} kg for every newton; take f64",
        )
