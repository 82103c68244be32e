"""Plausibility checks of observations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.fitting.observation import Observation
from taichi_msm.fitting.points import ROUNDING_SHARE
from taichi_msm.fitting.predict import FitProblem, Prediction
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE


def faults(observations: Sequence[Observation], scene: Scene, parameter_count: int) -> Iterator[str]:
    """Yield the faults found without a run: too few observations, wrong units or times, no motion."""
    count, first = sum(int(observed.known.sum()) for observed in observations), observations[0]
    if count <= parameter_count:
        fault = f"{count} observed numbers are too few for {parameter_count} parameters and their errors"
        yield f"{first.name}: {fault}; observe more points or times, or free fewer keys"
        return
    for observed in observations:
        yield from _time_faults(observed.time, observed.name, scene)
    for observed in observations:
        yield from observed.faults(scene)
    if all(observed.is_still(scene) for observed in observations):
        fault = f"by more than its error, sigma {first.sigma:g} {first.unit}" if first.sigma else "at all"
        yield f"{first.name}: no point moves {fault}; observe while a tool acts, at points near it"


def faults_at_start(problem: FitProblem, scene: Scene, initial: Prediction) -> Iterator[str]:
    """Yield the faults found with a run of the initial scene: no motion at the times, another camera or origin, signs.

    The prediction reaches to the last frame. A free camera skips the check of the camera; a linear parameter, which may
    change sign, skips that of signs.
    """
    observations, parameters = problem.observations, problem.parameters
    rate, motion, name = scene.time.frames_per_second, float(initial.motion.max()), observations[0].name
    if motion <= ROUNDING_SHARE * rest_of(scene.sheet).extent:
        yield f"{name}: none of its points moves in the scene; add probes that press near them"
        return
    times = np.concatenate([observed.time for observed in observations])
    observed_motion = float(np.interp(times * rate, np.arange(len(initial.motion)), initial.motion).max())
    if observed_motion < 0.1 * motion:
        moving = np.flatnonzero(initial.motion > 0.5 * motion) / rate
        fault = f"the scene's points then move by {1000 * observed_motion:.3g} of {1000 * motion:.3g} mm"
        remedy = f"add times between {moving[0]:g} and {moving[-1]:g} s"
        yield f"{name}: its {len(observations[0].time)} times miss the motion: {fault}; {remedy}"
        return
    same_camera = not any(parameter.key.startswith("render.") for parameter in parameters)
    messages: list[str] = []
    for observed, predicted in zip(observations, initial.values, strict=True):
        messages += observed.faults_at_start(scene, predicted, same_camera=same_camera)
    yield from messages
    if not messages and all(parameter.is_log for parameter in parameters):
        yield from opposed(observations, scene, initial)


def opposed(observations: Sequence[Observation], scene: Scene, *predictions: Prediction) -> Iterator[str]:
    """Yield a message for every component with the opposite sign in all predictions."""
    for n, observed in enumerate(observations):
        yield from observed.opposed(scene, *(prediction.values[n] for prediction in predictions))


def unit_faults(observations: Sequence[Observation], *predictions: Prediction) -> Iterator[str]:
    """Yield a message for every observation in another unit, if all predictions agree on it."""
    for n, observed in enumerate(observations):
        yield from observed.unit_faults(*(prediction.values[n] for prediction in predictions))


def _time_faults(time: Array, name: str, scene: Scene) -> Iterator[str]:
    duration, rate = scene.time.duration, scene.time.frames_per_second
    tolerance = FRAME_TOLERANCE / rate
    low, high = float(time.min()), float(time.max())
    if high > duration + tolerance:
        remedy = "cut them off, or --set time.duration=..."
        if (time == np.round(time)).all() and high / rate <= duration + 1 / rate + tolerance:
            remedy = f"are they frame numbers? divide time by the frames per second, {rate:g} in the scene"
        elif duration / 30 < high / 1000 <= duration * (1 + FRAME_TOLERANCE):
            remedy = "are they in ms? divide time by 1000"
        yield f"{name}: time: up to {high:g} s, but the scene ends at {duration:g} s; {remedy}"
    elif low < -tolerance:
        yield f"{name}: time: from {low:g} s, but the scene begins at 0 s; shift the times"
