"""What one should know before trusting the result of a run."""

from __future__ import annotations

import math
from collections.abc import Iterator

from taichi_msm.accuracy import Estimate
from taichi_msm.loads import meets_jumps, shortest_event, steps_to_meet_jumps
from taichi_msm.scene import Scene
from taichi_msm.stability import step, steps_per_frame, with_steps

# Down to this share of its rest length no spring shakes the limit of stability (see `stability.highest_frequency`).
SHORTEST = 0.5


def notes(scene: Scene, max_displacement: float, shortest_spring: float, estimate: Estimate | None) -> Iterator[str]:
    """Say what is remarkable about a run, one line each.

    Args:
        scene: with the step that was taken.
        max_displacement: largest displacement [m].
        shortest_spring: smallest length of a spring over its rest length.
        estimate: of the error, if it was wanted.
    """
    if estimate is not None:
        yield error(estimate)
    if max_displacement == 0:
        yield "nothing moved: does a probe press where and when it should?"
    if shortest_spring < SHORTEST:
        yield (
            f"a spring was pressed to {shortest_spring:.2g} of its rest length: below {SHORTEST} the sheet folds over "
            "itself and small errors grow; look at --estimate-error, or press less"
        )
    if not meets_jumps(scene):
        yield jumping(scene)
    h, event = step(scene), shortest_event(scene)
    if event < 2 * h:
        yield (
            f"three keys of a load or control point lie within {event:.2g} s, less than two steps of {h:.2g} s: steps "
            f"may miss what happens there, or count it too much; take a time.step of at most {event / 2:.2g} s"
        )
    quick = scene.damping / scene.sheet.mass * h
    if quick > 2 and scene.time.damping_difference == "central":
        yield (
            f"the damping stops a point within 1/{quick:.3g} of a step: velocities change their sign at every step; "
            f"take a time.step of at most {2 * h / quick:.2g} s"
        )


def jumping(scene: Scene) -> str:
    """Say that a jump is missed, and which step meets it."""
    said = (
        "a load, a control point or the virtual springs jump between two steps, or within one, which makes the "
        "method one of order 1"
    )
    meeting = steps_to_meet_jumps(scene)
    if meeting:
        finer = with_steps(scene, math.ceil(steps_per_frame(scene) / meeting) * meeting)
        if meets_jumps(finer):
            said += f"; a time.step of {step(finer):.12g} s meets every jump"
    return said


def error(estimate: Estimate) -> str:
    """Say how wrong a run is."""
    if estimate.error == math.inf:
        return "error not known: a pilot run diverged, or a step is longer than the damping or the load"
    said = f"error about {estimate.error:.2g} of the largest displacement, by pilot runs"
    if estimate.in_f64 < estimate.error / 2:
        said += f"; most of it is rounding in f32: with time.precision: f64 it is about {estimate.in_f64:.2g}"
    return said
