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

# Largest ratio of the observed extent to that at rest, or its inverse, with correct units.
MAX_EXTENT_RATIO = 30.0

# Smallest root mean square of the motion of a point that is significant [sigma].
MIN_MOTION_SIGMAS = 1.5

# Motion below this share of the coordinates is rounding.
ROUNDING_SHARE = 1e-9

# Largest offset of the first observed points from rest, with the correct camera and origin: in pixels, or as a share
# of the sheet.
MAX_OFFSET_PX, MAX_OFFSET_SHARE = 3.0, 0.02


def faults(observations: Observations, scene: Scene, parameters: int) -> Iterator[str]:
    """Yield the faults that need no run: too few observations, units, times, no motion."""
    count, name = int(observations.known.sum()), observations.name
    force_count = 0 if observations.forces is None else int(np.isfinite(observations.forces.force).sum())
    if count + force_count <= parameters:
        fault = f"{count + force_count} numbers were observed, too few for {parameters} parameters and their errors"
        yield f"{name}: {fault}; observe more points or times, or name fewer keys in --free"
        return
    yield from _times(observations.time, name, scene)
    if observations.forces is not None:
        yield from _times(observations.forces.time, observations.forces.name, scene)
    yield from _units(observations, scene)
    yield from _lost_markers(observations, scene)
    if observations.forces is None and _is_still(observations, scene):
        fault = (
            f"by more than its error, sigma {observations.sigma:g} {observations.unit}"
            if observations.sigma
            else "at all"
        )
        yield f"{name}: no point moves {fault}; observe while a tool acts, at points near it"


def faults_at_start(
    observations: Observations, scene: Scene, first: Prediction, *, same_camera: bool = True, same_signs: bool = True
) -> Iterator[str]:
    """Yield the faults of observations that a run of the scene shows.

    Args:
        observations: the observations.
        scene: the scene with its initial values.
        first: prediction of the scene up to its end.
        same_camera: whether the camera is not fitted.
        same_signs: whether the parameters cannot change the signs of forces and motion.

    Yields:
        A line per fault: times that miss the motion, another camera, conventions of other programs.
    """
    rate, motion = scene.time.frames_per_second, float(first.motion.max())
    if motion <= ROUNDING_SHARE * max(scene.sheet.size):
        yield f"{observations.name}: none of its points moves in the scene; give the scene probes that press near them"
        return
    times = (
        observations.time
        if observations.forces is None
        else np.concatenate([observations.time, observations.forces.time])
    )
    observed = float(np.interp(times * rate, np.arange(len(first.motion)), first.motion).max())
    if observed < 0.1 * motion:
        moving = np.flatnonzero(first.motion > 0.5 * motion) / rate
        yield (
            f"{observations.name}: its {len(observations.time)} times miss the motion: "
            f"the scene's points move by up to {1000 * motion:.3g} mm, and at these times by {1000 * observed:.3g} mm; "
            f"observe between {moving[0]:g} and {moving[-1]:g} s too"
        )
        return
    if invisible := int((observations.known & ~np.isfinite(first.values)).any(axis=(1, 2)).sum()):
        fault = "are behind the eye of the scene's camera, or beyond its lens, where the search begins"
        remedy = "give the scene the camera that saw them, or NaN in their place"
        subject = f"{observations.name}: {observations.kind}"
        yield f"{subject}: {invisible} of the observed points {fault}; {remedy}"
        return
    found = [*_faults_at_rest(observations, scene, first)] if same_camera else []
    yield from found
    if same_signs and not found:
        yield from opposed(observations, scene, first)


def faults_at_solution(observations: Observations, scene: Scene, first: Prediction, best: Prediction) -> Iterator[str]:
    """Yield the signs and units that contradict both the initial and the fitted scene."""
    yield from opposed(observations, scene, first, best)
    yield from force_unit(observations, first, best)


def _faults_at_rest(observations: Observations, scene: Scene, first: Prediction) -> Iterator[str]:
    """Yield the faults of the points at rest: mirrored axes, wrong camera or origin, half-pixel offset."""
    if found := [*mirrored(observations, scene)]:
        yield from found
        return
    yield from _misplaced(observations, scene, first)
    if observations.kind == "pixel":
        yield from half_pixel(observations, scene, first)


def largest_motion(observations: Observations, scene: Scene) -> float:
    """Return the largest root mean square of the motion of a point [m] or [px]."""
    motion = _motion(observations, scene)
    return float(np.sqrt(np.nanmean(motion**2, axis=(1, 2)).max())) if len(motion) else math.inf


def _motion(observations: Observations, scene: Scene) -> Array:
    """Return observed minus mean positions, or minus rest positions if every point was observed once."""
    known = observations.is_observed.any(axis=1)
    values, is_repeated = observations.values[known], observations.is_observed.sum(axis=1).max() > 1
    motion = values - (
        np.nanmean(values, axis=1, keepdims=True) if is_repeated else observe_at_rest(scene, observations)[known]
    )
    # Rest positions may be behind the camera.
    return motion[np.isfinite(motion).any(axis=(1, 2))]


def _is_still(observations: Observations, scene: Scene) -> bool:
    """Return whether the observed motion is within its errors."""
    if observations.sigma is None:
        return largest_motion(observations, scene) <= ROUNDING_SHARE * float(np.nanmax(np.abs(observations.values)))
    chi_square = float(np.nansum((_motion(observations, scene) / observations.sigma) ** 2))
    freedom = observations.known.sum() - observations.known.any(axis=1).sum()
    # Five standard deviations of chi-square above its mean.
    is_significant = chi_square > freedom + 5.0 * math.sqrt(2 * freedom) > 0
    return not (is_significant or largest_motion(observations, scene) > MIN_MOTION_SIGMAS * observations.sigma)


def _times(time: Array, name: str, scene: Scene) -> Iterator[str]:
    duration = scene.time.duration
    tolerance = FRAME_TOLERANCE / scene.time.frames_per_second
    low, high = float(time.min()), float(time.max())
    if high > duration + tolerance:
        are_milliseconds = duration / 30 < high / 1000 <= duration * (1 + FRAME_TOLERANCE)
        rate = scene.time.frames_per_second
        are_frame_numbers = bool((time == np.round(time)).all()) and high / rate <= duration + 1 / rate + tolerance
        remedy = "cut them off, or --set time.duration=..."
        if are_frame_numbers:
            remedy = f"are they frame numbers? divide time by the frames per second, {rate:g} in the scene"
        elif are_milliseconds:
            remedy = "are they in ms? divide time by 1000"
        yield f"{name}: time: up to {high:g} s, and the scene ends at {duration:g} s; {remedy}"
    elif low < -tolerance:
        yield f"{name}: time: from {low:g} s, and the scene begins at 0 s; let the scene's clock count"


def _units(observations: Observations, scene: Scene) -> Iterator[str]:
    """Compare the extent of the observed points with that at rest."""
    is_observed = observations.is_observed
    rest = positions_at_rest(scene, observations)[is_observed.any(axis=1)]
    if observations.kind != "position" or len(rest) < 2:
        return
    values = observations.values[is_observed.any(axis=1)]
    centres = np.nanmedian(values, axis=1)[:, :2]
    extent, rest_extent = (
        float(np.linalg.norm(points - points.mean(axis=0), axis=1).max()) for points in (centres, rest[:, :2])
    )
    if rest_extent > 0 and extent > 0 and not 1 / MAX_EXTENT_RATIO < extent / rest_extent < MAX_EXTENT_RATIO:
        fault = f"the points are {extent:.3g} m from their middle, and {rest_extent:.3g} m at rest; give metres"
        unit = {3: ": are they in mm? divide them by 1000", 2: ": are they in cm? divide them by 100"}
        yield f"{observations.name}: position: {fault}{unit.get(round(math.log10(extent / rest_extent)), '')}"


def _lost_markers(observations: Observations, scene: Scene) -> Iterator[str]:
    """Yield sentinel values of lost points, and fractions of the frame instead of pixels."""
    rest = observe_at_rest(scene, observations)
    tolerance = MAX_OFFSET_PX if observations.kind == "pixel" else MAX_OFFSET_SHARE * max(scene.sheet.size)
    is_sentinel = (observations.values == observations.values[..., :1]).all(axis=2)
    is_sentinel &= ~(np.linalg.norm(rest - observations.values[..., :1], axis=-1) < tolerance)
    for sentinel, count in zip(*np.unique(observations.values[is_sentinel][:, 0], return_counts=True), strict=True):
        if sentinel in (0, -1) or count > 1:
            fault = f"{sentinel:g} in all numbers of {count} points and times; are they lost points? take NaN for them"
            yield f"{observations.name}: {observations.kind}: {fault}"
            return
    if (
        observations.kind == "pixel"
        and np.nanmax(np.abs(observations.values)) <= 1.5 < MAX_OFFSET_PX < np.nan_to_num(np.abs(rest)).max()
    ):
        width, height = scene.render.size
        fault = "are they fractions of the frame? multiply them by its width and height"
        largest = np.nanmax(np.abs(observations.values))
        yield f"{observations.name}: pixel: up to {largest:.3g}; {fault}, {width} and {height} in the scene"


def _misplaced(observations: Observations, scene: Scene, first: Prediction) -> Iterator[str]:
    """Compare the first observed points with their rest positions: the camera or origin may differ."""
    is_observed = observations.is_observed
    start = int(np.argmax(is_observed.any(axis=0)))
    rest = observe_at_rest(scene, observations)
    offsets = np.linalg.norm((observations.values - rest)[:, start], axis=1)[is_observed[:, start]]
    offset = float(np.median(np.where(np.isfinite(offsets), offsets, math.inf)))
    motion = float(np.nanmax(np.linalg.norm(first.values - rest, axis=2)))
    tolerance = MAX_OFFSET_PX if observations.kind == "pixel" else MAX_OFFSET_SHARE * max(scene.sheet.size)
    if offset <= max(
        tolerance, 5 * (observations.sigma or 0.0), 3.0 * max(motion, largest_motion(observations, scene))
    ):
        return
    width, height = scene.render.size
    expected, remedy = (
        (
            f"the scene's camera sees them at rest in its {width} x {height} px",
            "give the scene that camera and size, and count from the picture's upper left corner, right and down",
        )
        if observations.kind == "pixel"
        else ("they are at rest in the scene", "count from the sheet's middle, x right, y up, z toward the viewer")
    )
    fault = f"half of the points are {offset:.3g} {observations.unit} or more from where {expected}"
    yield f"{observations.name}: {observations.kind}: {fault}; {remedy}"
