"""What cannot be right about observations of a scene: a sentence each, with the remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.conventions import force_unit, half_pixel, mirrored, opposed
from taichi_msm.fitting.observations import Observations, places_at_rest, seen_at_rest
from taichi_msm.fitting.predict import Predicted
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE

Array = NDArray[np.float64]

# Units are wrong if what was seen is spread so many times wider than the points are at rest, or narrower.
OFF = 30.0

# Points move if one of them does by so many sigma in the root mean square over time, or if the sum of all squares over
# sigma^2 is so many of its standard deviations above what errors alone give.
MOVES, SIGNIFICANT = 1.5, 5.0

# Without a sigma, and in the scene, what moves by less than this share of where it is moves by rounding.
ROUNDING = 1e-9

# Frames miss the motion if the points move less at the observed times than this share of their motion.
MISSED = 0.1

# Pixels are fractions of the frame if none is greater.
FRACTION = 1.5

# Pixels are of another camera, and positions of another place, if the points are farther from where they are at rest
# than this [px], or this share of the sheet, and than so many times the motion.
ASTRAY, ASIDE, TIMES = 3.0, 0.02, 3.0


def faults(seen: Observations, scene: Scene, parameters: int) -> Iterator[str]:
    """Say what is wrong before anything is run: too few numbers, units, times, nothing that moves."""
    numbers, name = int(seen.known.sum()), seen.name
    forces = 0 if seen.forces is None else int(np.isfinite(seen.forces.force).sum())
    if numbers + forces <= parameters:
        said = f"{numbers + forces} numbers were seen, too few for {parameters} parameters and their errors"
        yield f"{name}: {said}; observe more points or times, or name fewer keys in --free"
        return
    yield from _times(seen.time, name, scene)
    if seen.forces is not None:
        yield from _times(seen.forces.time, seen.forces.name, scene)
    yield from _units(seen, scene)
    yield from _lost(seen, scene)
    if seen.forces is None and _is_still(seen, scene):
        said = f"by more than its error, sigma {seen.sigma:g} {seen.unit}" if seen.sigma else "at all"
        yield f"{name}: no point moves {said}; observe while a tool acts, at points near it"


def faults_beside(
    seen: Observations, scene: Scene, first: Predicted, *, same_camera: bool = True, same_signs: bool = True
) -> Iterator[str]:
    """Check observations against a run of the scene to its end.

    Args:
        seen: the observations.
        scene: with the values where the search begins.
        first: its prediction.
        same_camera: whether the scene has the camera that saw, and not one that is to be found.
        same_signs: whether the parameters keep the signs of forces and motion.

    Yields:
        A line of each fault: times that miss the motion, another camera, conventions of other programs.
    """
    rate, whole = scene.time.frames_per_second, float(first.motion.max())
    if whole <= ROUNDING * max(scene.sheet.size):
        yield f"{seen.name}: none of its points moves in the scene; give the scene probes that press near them"
        return
    times = seen.time if seen.forces is None else np.concatenate([seen.time, seen.forces.time])
    observed = float(np.interp(times * rate, np.arange(len(first.motion)), first.motion).max())
    if observed < MISSED * whole:
        moving = np.flatnonzero(first.motion > 0.5 * whole) / rate
        yield (
            f"{seen.name}: its {len(seen.time)} times miss the motion: the scene's points move by up to "
            f"{1000 * whole:.3g} mm, and at these times by {1000 * observed:.3g} mm; observe between "
            f"{moving[0]:g} and {moving[-1]:g} s too"
        )
        return
    if lost := int((seen.known & ~np.isfinite(first.values)).any(axis=(1, 2)).sum()):
        said = "are behind the eye of the scene's camera, or beyond its lens, where the search begins"
        remedy = "give the scene the camera that saw them, or NaN in their place"
        yield f"{seen.name}: {seen.kind}: {lost} of the points that were seen {said}; {remedy}"
        return
    wrong = [*_other_places(seen, scene, first)] if same_camera else []
    yield from wrong
    if same_signs and not wrong:
        yield from opposed(seen, scene, first)


def faults_of_best(seen: Observations, scene: Scene, first: Predicted, best: Predicted) -> Iterator[str]:
    """Check signs and units of forces, which are wrong where the search begins and where it ended."""
    yield from opposed(seen, scene, first, best)
    yield from force_unit(seen, first, best)


def _other_places(seen: Observations, scene: Scene, first: Predicted) -> Iterator[str]:
    """Compare places at rest: mirrored ones, others, and those half a pixel off."""
    if wrong := [*mirrored(seen, scene)]:
        yield from wrong
        return
    yield from _elsewhere(seen, scene, first)
    if seen.kind == "pixel":
        yield from half_pixel(seen, scene, first)


def moved(seen: Observations, scene: Scene) -> float:
    """Give the motion of the point that moves most: root mean square over time, or from rest [m] or [px]."""
    motion = _motion(seen, scene)
    return float(np.sqrt(np.nanmean(motion**2, axis=(1, 2)).max())) if len(motion) else math.inf


def _motion(seen: Observations, scene: Scene) -> Array:
    """Give the points that were seen from their means in time, or, if each was seen once, from rest."""
    known = seen.there.any(axis=1)
    values, several = seen.values[known], seen.there.sum(axis=1).max() > 1
    motion = values - (np.nanmean(values, axis=1, keepdims=True) if several else seen_at_rest(scene, seen)[known])
    # At rest a camera may not see all of them.
    return motion[np.isfinite(motion).any(axis=(1, 2))]


def _is_still(seen: Observations, scene: Scene) -> bool:
    """Tell whether nothing was seen but errors."""
    if seen.sigma is None:
        return moved(seen, scene) <= ROUNDING * float(np.nanmax(np.abs(seen.values)))
    square = float(np.nansum((_motion(seen, scene) / seen.sigma) ** 2))
    freedom = seen.known.sum() - seen.known.any(axis=1).sum()
    is_significant = square > freedom + SIGNIFICANT * math.sqrt(2 * freedom) > 0
    return not (is_significant or moved(seen, scene) > MOVES * seen.sigma)


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


def _units(seen: Observations, scene: Scene) -> Iterator[str]:
    """Compare how wide the points are spread with how wide they are at rest."""
    known = seen.there
    rest = places_at_rest(scene, seen)[known.any(axis=1)]
    if seen.kind != "position" or len(rest) < 2:
        return
    values = seen.values[known.any(axis=1)]
    middle = np.nanmedian(values, axis=1)[:, :2]
    spread, expected = (
        float(np.linalg.norm(points - points.mean(axis=0), axis=1).max()) for points in (middle, rest[:, :2])
    )
    if expected > 0 and spread > 0 and not 1 / OFF < spread / expected < OFF:
        said = f"the points are {spread:.3g} m from their middle, and {expected:.3g} m at rest; give metres"
        unit = {3: ": are they in mm? divide them by 1000", 2: ": are they in cm? divide them by 100"}
        yield f"{seen.name}: position: {said}{unit.get(round(math.log10(spread / expected)), '')}"


def _lost(seen: Observations, scene: Scene) -> Iterator[str]:
    """Find numbers that stand for points that were lost, and fractions of the frame in place of pixels."""
    rest = seen_at_rest(scene, seen)
    least = ASTRAY if seen.kind == "pixel" else ASIDE * max(scene.sheet.size)
    alike = (seen.values == seen.values[..., :1]).all(axis=2)
    alike &= ~(np.linalg.norm(rest - seen.values[..., :1], axis=-1) < least)
    for mark, number in zip(*np.unique(seen.values[alike][:, 0], return_counts=True), strict=True):
        if mark in (0, -1) or number > 1:
            said = f"{mark:g} in all numbers of {number} points and times; are they lost points? take NaN for them"
            yield f"{seen.name}: {seen.kind}: {said}"
            return
    if seen.kind == "pixel" and np.nanmax(np.abs(seen.values)) <= FRACTION < ASTRAY < np.nan_to_num(np.abs(rest)).max():
        width, height = scene.render.size
        said = "are they fractions of the frame? multiply them by its width and height"
        most = np.nanmax(np.abs(seen.values))
        yield f"{seen.name}: pixel: up to {most:.3g}; {said}, {width} and {height} in the scene"


def _elsewhere(seen: Observations, scene: Scene, first: Predicted) -> Iterator[str]:
    """Compare where points are seen at the first time with where they are at rest."""
    known = seen.there
    begins = int(np.argmax(known.any(axis=0)))
    rest = seen_at_rest(scene, seen)
    far = np.linalg.norm((seen.values - rest)[:, begins], axis=1)[known[:, begins]]
    apart = float(np.median(np.where(np.isfinite(far), far, math.inf)))
    motion = float(np.nanmax(np.linalg.norm(first.values - rest, axis=2)))
    least = ASTRAY if seen.kind == "pixel" else ASIDE * max(scene.sheet.size)
    if apart <= max(least, 5 * (seen.sigma or 0.0), TIMES * max(motion, moved(seen, scene))):
        return
    width, height = scene.render.size
    where, remedy = (
        (
            f"the scene's camera sees them at rest in its {width} x {height} px",
            "give the scene that camera and size, and count from the picture's upper left corner, right and down",
        )
        if seen.kind == "pixel"
        else ("they are at rest in the scene", "count from the sheet's middle, x right, y up, z toward the viewer")
    )
    said = f"half of the points are {apart:.3g} {seen.unit} or more from where {where}"
    yield f"{seen.name}: {seen.kind}: {said}; {remedy}"
