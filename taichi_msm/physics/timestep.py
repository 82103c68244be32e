"""The step limit and the choice of a step."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from taichi_msm.errors import Problem
from taichi_msm.physics.material import highest_frequency, material
from taichi_msm.scene import WHOLE, Scene


def stable_step(scene: Scene) -> float:
    """Find the largest stable step [s]; infinite where nothing oscillates.

    central: 2 / w. backward: (sqrt(g^2 + 4 w^2) - g) / w^2, written without its cancellation; g = C / m.
    """
    w = highest_frequency(scene)
    g = material(scene).drag if scene.time.damping_difference == "backward" else 0.0
    limit = math.hypot(g, 2 * w) + g
    return 4 / limit if limit > 0 else math.inf


def steps_per_frame(scene: Scene) -> int:
    """Count the steps of one frame.

    auto: the fewest whose step is at most half the stability limit; a tolerance may ask for more, which
    `error_control.choose_step` finds. A given step is what the scene says.
    """
    frame = 1 / scene.time.frames_per_second
    if scene.time.step == "auto":
        # The small slack keeps a frame that is exactly n half-limits from being cut into n + 1 by rounding.
        return max(1, math.ceil(2 * frame / stable_step(scene) * (1 - 1e-12)))
    return max(1, round(frame / scene.time.step))


def with_time(scene: Scene, **changes: Any) -> Scene:
    """Change keys of the scene's time."""
    return scene.model_copy(update={"time": scene.time.model_copy(update=changes)})


def with_steps(scene: Scene, count: int) -> Scene:
    """Give a frame of the scene so many steps."""
    return with_time(scene, step=1 / scene.time.frames_per_second / count, tolerance=None)


def step(scene: Scene) -> float:
    """Give the step h [s]: a whole fraction of a frame."""
    return 1 / (scene.time.frames_per_second * steps_per_frame(scene))


def problems(scene: Scene) -> Iterator[Problem]:
    """Say why a given step cannot be taken."""
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
