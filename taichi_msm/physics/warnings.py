"""What one should know before trusting the result of a run."""

from __future__ import annotations

import math
from collections.abc import Iterator

from taichi_msm.physics.error_control import Estimate
from taichi_msm.physics.timestep import step, steps_per_frame, with_steps
from taichi_msm.scene import Scene

# Down to this share of its rest length no spring shakes the limit of stability (see `timestep.highest_frequency`).
SHORTEST = 0.5

# An error above this share of the largest displacement is told with what would help.
WRONG = 0.01


def notes(
    scene: Scene,
    max_displacement: float,
    shortest_spring: float,
    estimate: Estimate | None,
    reason: str = "",
    *,
    reached: bool = True,
) -> Iterator[str]:
    """Say what is remarkable about a run, one line each.

    Args:
        scene: with the step that was taken.
        max_displacement: largest displacement [m].
        shortest_spring: smallest length of a spring over its rest length.
        estimate: of the error, if there is one.
        reason: why there is none.
        reached: whether any frame after the first was reached.
    """
    if estimate is not None:
        yield error(estimate)
        if WRONG < estimate.error < math.inf:
            wrong = float(f"{100 * estimate.error:.2g}")
            yield f"the run is about {wrong:g} % wrong; {_remedy(scene, estimate)}"
    elif reason:
        yield f"error not estimated: {reason}"
    if max_displacement == 0 and reached:
        yield "nothing moved: does a probe press where and when it should?"
    if shortest_spring < SHORTEST:
        yield (
            f"a spring was pressed to {shortest_spring:.2g} of its rest length: below {SHORTEST} the sheet folds over "
            "itself and small errors grow; press less"
        )
    h = step(scene)
    quick = scene.damping / scene.sheet.mass * h
    if quick > 2 and scene.time.damping_difference == "central":
        yield (
            f"the damping stops a point within 1/{quick:.3g} of a step: velocities change their sign at every step; "
            f"take a time.step of at most {2 * h / quick:.2g} s"
        )


def error(estimate: Estimate) -> str:
    """Say how wrong a run is."""
    if estimate.error == math.inf:
        return "error not known: a pilot run diverged, or a step is longer than the damping"
    parts = f"step {estimate.in_f64:.1g}, rounding {estimate.rounding:.1g}" if estimate.rounding else "of the step"
    return f"error {estimate.error:.1g} of the largest displacement ({parts})"


def _remedy(scene: Scene, estimate: Estimate) -> str:
    """Say what would make it less wrong."""
    said = []
    if estimate.rounding > WRONG / 2:
        said.append("time.precision: f64")
        if scene.springs.structural > 0 or scene.springs.shear > 0:
            said.append("stiffer springs.virtual, where the sheet buckles")
    if estimate.in_f64 > WRONG / 2:
        needed = steps_per_frame(scene) * (estimate.in_f64 / (WRONG / 2)) ** (1 / estimate.order)
        said.insert(0, f"time.step: {step(with_steps(scene, math.ceil(needed))):.9g}")
    return f"try {', or '.join(said)}"
