"""Plausibility checks of observations."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.conventions import force_unit, half_pixel, mirrored, opposed
from taichi_msm.fitting.observations import Observations, observe_at_rest, positions_at_rest
from taichi_msm.fitting.predict import Prediction
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE

Array = NDArray[np.float64]

# Largest ratio of the observed extent to that at rest, or its inverse, with the right units.
MAX_EXTENT_RATIO = 30.0

# Motion is significant if the root mean square of a point exceeds this many sigma, or if chi-square exceeds that of
# errors alone by this many of its standard deviations.
MIN_MOTION_SIGMAS, MIN_SIGNIFICANCE = 1.5, 5.0

# Motion below this share of the coordinates is rounding.
ROUNDING_SHARE = 1e-9

# Smallest share of the whole motion that the observed times must contain.
MIN_MOTION_SHARE = 0.1

# Pixels up to this value are fractions of the frame.
MAX_FRACTION = 1.5

# Largest offset of the first observed points from rest, with the right camera and origin: in pixels or as a share of
# the sheet, and in multiples of the motion.
MAX_OFFSET_PX, MAX_OFFSET_SHARE, MAX_OFFSET_MOTIONS = 3.0, 0.02, 3.0


def faults(observations: Observations, scene: Scene, parameters: int) -> Iterator[str]:
    """Yield the faults that are known before any run: too few observations, units, times, no motion."""
    numbers, name = int(observations.known.sum()), observations.name
    forces = 0 if observations.forces is None else int(np.isfinite(observations.forces.force).sum())
    if numbers + forces <= parameters:
        said = f"{numbers + forces} numbers were observed, too few for {parameters} parameters and their errors"
        yield f"{name}: {said}; observe more points or times, or name fewer keys in --free"
        return
    yield from _times(observations.time, name, scene)
    if observations.forces is not None:
        yield from _times(observations.forces.time, observations.forces.name, scene)
    yield from _units(observations, scene)
    yield from _lost_markers(observations, scene)
    if observations.forces is None and _is_still(observations, scene):
        said = (
            f"by more than its error, sigma {observations.sigma:g} {observations.unit}"
            if observations.sigma
            else "at all"
        )
        yield f"{name}: no point moves {said}; observe while a tool acts, at points near it"


def faults_at_start(
    observations: Observations, scene: Scene, first: Prediction, *, same_camera: bool = True, same_signs: bool = True
) -> Iterator[str]:
    """Check observations against a run of the scene to its end.

    Args:
        observations: the observations.
        scene: the scene with its initial values.
        first: its prediction.
        same_camera: whether the camera is known, and not fitted.
        same_signs: whether the parameters cannot change the signs of forces and motion.

    Yields:
        A line for each fault: times that miss the motion, another camera, conventions of other programs.
    """
    rate, whole = scene.time.frames_per_second, float(first.motion.max())
    if whole <= ROUNDING_SHARE * max(scene.sheet.size):
        yield f"{observations.name}: none of its points moves in the scene; give the scene probes that press near them"
        return
    times = (
        observations.time
        if observations.forces is None
        else np.concatenate([observations.time, observations.forces.time])
    )
    observed = float(np.interp(times * rate, np.arange(len(first.motion)), first.motion).max())
    if observed < MIN_MOTION_SHARE * whole:
        moving = np.flatnonzero(first.motion > 0.5 * whole) / rate
        yield (
            f"{observations.name}: its {len(observations.time)} times miss the motion: "
            f"the scene's points move by up to {1000 * whole:.3g} mm, and at these times by {1000 * observed:.3g} mm; "
            f"observe between {moving[0]:g} and {moving[-1]:g} s too"
        )
        return
    if lost := int((observations.known & ~np.isfinite(first.values)).any(axis=(1, 2)).sum()):
        said = "are behind the eye of the scene's camera, or beyond its lens, where the search begins"
        remedy = "give the scene the camera that saw them, or NaN in their place"
        where = f"{observations.name}: {observations.kind}"
        yield f"{where}: {lost} of the observed points {said}; {remedy}"
        return
    wrong = [*_faults_at_rest(observations, scene, first)] if same_camera else []
    yield from wrong
    if same_signs and not wrong:
        yield from opposed(observations, scene, first)


def faults_at_solution(observations: Observations, scene: Scene, first: Prediction, best: Prediction) -> Iterator[str]:
    """Yield signs and units that contradict both the initial and the fitted scene."""
    yield from opposed(observations, scene, first, best)
    yield from force_unit(observations, first, best)


def _faults_at_rest(observations: Observations, scene: Scene, first: Prediction) -> Iterator[str]:
    """Yield faults of the points at rest: mirrored, misplaced, half a pixel off."""
    if wrong := [*mirrored(observations, scene)]:
        yield from wrong
        return
    yield from _misplaced(observations, scene, first)
    if observations.kind == "pixel":
        yield from half_pixel(observations, scene, first)


def largest_motion(observations: Observations, scene: Scene) -> float:
    """Return the largest motion of a point: root mean square over time, or from rest [m] or [px]."""
    motion = _motion(observations, scene)
    return float(np.sqrt(np.nanmean(motion**2, axis=(1, 2)).max())) if len(motion) else math.inf


def _motion(observations: Observations, scene: Scene) -> Array:
    """Return the observed points from their means in time, or from rest if each was observed once."""
    known = observations.there.any(axis=1)
    values, several = observations.values[known], observations.there.sum(axis=1).max() > 1
    motion = values - (
        np.nanmean(values, axis=1, keepdims=True) if several else observe_at_rest(scene, observations)[known]
    )
    # At rest some points may be behind the camera.
    return motion[np.isfinite(motion).any(axis=(1, 2))]


def _is_still(observations: Observations, scene: Scene) -> bool:
    """Return whether the observed motion is within its errors."""
    if observations.sigma is None:
        return largest_motion(observations, scene) <= ROUNDING_SHARE * float(np.nanmax(np.abs(observations.values)))
    square = float(np.nansum((_motion(observations, scene) / observations.sigma) ** 2))
    freedom = observations.known.sum() - observations.known.any(axis=1).sum()
    is_significant = square > freedom + MIN_SIGNIFICANCE * math.sqrt(2 * freedom) > 0
    return not (is_significant or largest_motion(observations, scene) > MIN_MOTION_SIGMAS * observations.sigma)


def _times(time: Array, name: str, scene: Scene) -> Iterator[str]:
    duration = scene.time.duration
    slack = FRAME_TOLERANCE / scene.time.frames_per_second
    low, high = float(time.min()), float(time.max())
    if high > duration + slack:
        thousand = duration / 30 < high / 1000 <= duration * (1 + FRAME_TOLERANCE)
        rate = scene.time.frames_per_second
        numbers = bool((time == np.round(time)).all()) and high / rate <= duration + 1 / rate + slack
        remedy = "cut them off, or --set time.duration=..."
        if numbers:
            remedy = f"are they frame numbers? divide time by the frames per second, {rate:g} in the scene"
        elif thousand:
            remedy = "are they in ms? divide time by 1000"
        yield f"{name}: time: up to {high:g} s, and the scene ends at {duration:g} s; {remedy}"
    elif low < -slack:
        yield f"{name}: time: from {low:g} s, and the scene begins at 0 s; let the scene's clock count"


def _units(observations: Observations, scene: Scene) -> Iterator[str]:
    """Compare the extent of the observed points with that at rest."""
    known = observations.there
    rest = positions_at_rest(scene, observations)[known.any(axis=1)]
    if observations.kind != "position" or len(rest) < 2:
        return
    values = observations.values[known.any(axis=1)]
    middle = np.nanmedian(values, axis=1)[:, :2]
    spread, expected = (
        float(np.linalg.norm(points - points.mean(axis=0), axis=1).max()) for points in (middle, rest[:, :2])
    )
    if expected > 0 and spread > 0 and not 1 / MAX_EXTENT_RATIO < spread / expected < MAX_EXTENT_RATIO:
        said = f"the points are {spread:.3g} m from their middle, and {expected:.3g} m at rest; give metres"
        unit = {3: ": are they in mm? divide them by 1000", 2: ": are they in cm? divide them by 100"}
        yield f"{observations.name}: position: {said}{unit.get(round(math.log10(spread / expected)), '')}"


def _lost_markers(observations: Observations, scene: Scene) -> Iterator[str]:
    """Yield repeated numbers that mark lost points, and fractions of the frame instead of pixels."""
    rest = observe_at_rest(scene, observations)
    least = MAX_OFFSET_PX if observations.kind == "pixel" else MAX_OFFSET_SHARE * max(scene.sheet.size)
    error_correlation = (observations.values == observations.values[..., :1]).all(axis=2)
    error_correlation &= ~(np.linalg.norm(rest - observations.values[..., :1], axis=-1) < least)
    for mark, number in zip(*np.unique(observations.values[error_correlation][:, 0], return_counts=True), strict=True):
        if mark in (0, -1) or number > 1:
            said = f"{mark:g} in all numbers of {number} points and times; are they lost points? take NaN for them"
            yield f"{observations.name}: {observations.kind}: {said}"
            return
    if (
        observations.kind == "pixel"
        and np.nanmax(np.abs(observations.values)) <= MAX_FRACTION < MAX_OFFSET_PX < np.nan_to_num(np.abs(rest)).max()
    ):
        width, height = scene.render.size
        said = "are they fractions of the frame? multiply them by its width and height"
        most = np.nanmax(np.abs(observations.values))
        yield f"{observations.name}: pixel: up to {most:.3g}; {said}, {width} and {height} in the scene"


def _misplaced(observations: Observations, scene: Scene, first: Prediction) -> Iterator[str]:
    """Compare the observed points at the first time with those at rest."""
    known = observations.there
    begins = int(np.argmax(known.any(axis=0)))
    rest = observe_at_rest(scene, observations)
    far = np.linalg.norm((observations.values - rest)[:, begins], axis=1)[known[:, begins]]
    apart = float(np.median(np.where(np.isfinite(far), far, math.inf)))
    motion = float(np.nanmax(np.linalg.norm(first.values - rest, axis=2)))
    least = MAX_OFFSET_PX if observations.kind == "pixel" else MAX_OFFSET_SHARE * max(scene.sheet.size)
    if apart <= max(
        least, 5 * (observations.sigma or 0.0), MAX_OFFSET_MOTIONS * max(motion, largest_motion(observations, scene))
    ):
        return
    width, height = scene.render.size
    where, remedy = (
        (
            f"the scene's camera sees them at rest in its {width} x {height} px",
            "give the scene that camera and size, and count from the picture's upper left corner, right and down",
        )
        if observations.kind == "pixel"
        else ("they are at rest in the scene", "count from the sheet's middle, x right, y up, z toward the viewer")
    )
    said = f"half of the points are {apart:.3g} {observations.unit} or more from where {where}"
    yield f"{observations.name}: {observations.kind}: {said}; {remedy}"
