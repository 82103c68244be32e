"""Plausibility checks of conventions: centres of pixels, signs of axes and of forces, units of forces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.observations import Observations, observe_at_rest
from taichi_msm.fitting.predict import Prediction
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]

# Largest predicted motion of points at rest [px], and their smallest number for a mean offset.
MAX_REST_MOTION_PX, MIN_POINTS = 0.02, 5

# An offset of half a pixel has a standard error below MAX_ERROR_PX, is within MAX_OFFSET_ERRORS of them and the
# tolerance of half a pixel, and more than MIN_OFFSET_ERRORS of them from 0.
MAX_ERROR_PX, MAX_OFFSET_ERRORS, MIN_OFFSET_ERRORS, OFFSET_TOLERANCE_PX = 0.1, 3.0, 5.0, 0.02

# Largest cosine of opposed axes and forces.
MAX_COSINE = -0.9

# Smallest components that are compared: as a share of the norm, and in sigma.
MIN_COMPONENT_SHARE, MIN_SIGMAS = 0.1, 5.0

# Smallest number of values for a cosine, with and without sigma.
MIN_COUNT_WITH_SIGMA, MIN_COUNT_WITHOUT_SIGMA = 3, 12

# Units of force per newton, and the largest deviation of a ratio, as a factor.
UNITS_PER_NEWTON, MAX_UNIT_FACTOR = {"mN": 1000.0, "gf": 101.97, "kN": 0.001}, 3.0


def half_pixel(observations: Observations, scene: Scene, first: Prediction) -> Iterator[str]:
    """Yield an offset of half a pixel, common to all points at rest."""
    rest = observe_at_rest(scene, observations)
    still = observations.there & (np.linalg.norm(first.values - rest, axis=2) < MAX_REST_MOTION_PX)
    number = still.sum(axis=1)
    offsets = (
        np.where(still[..., None], observations.values - rest, 0.0).sum(axis=1)[number > 0] / number[number > 0, None]
    )
    if len(offsets) < MIN_POINTS:
        return
    known = (observations.sigma or 0.0) / np.sqrt(number.sum())
    mean, error = offsets.mean(axis=0), np.maximum(offsets.std(axis=0, ddof=1) / np.sqrt(len(offsets)), known)
    halves = np.where(np.abs(mean) < 0.25, 0.0, 0.5 * np.sign(mean))
    away = np.abs(np.stack([mean, np.median(offsets, axis=0)]) - halves).max(axis=0)
    is_near = (away <= MAX_OFFSET_ERRORS * error + OFFSET_TOLERANCE_PX) & (error < MAX_ERROR_PX)
    if is_near.all() and ((halves != 0) & (np.abs(mean) > MIN_OFFSET_ERRORS * error)).any():
        shown = " and ".join(f"{one:+.2g} px in {axis}" for one, axis in zip(mean, "xy", strict=True))
        side, remedy = (0, "add") if halves.min() < 0 else (1, "subtract")
        said = f"is the centre of their first pixel at {side}? {remedy} 0.5, as it is at 0.5 here"
        yield f"{observations.name}: pixel: points at rest are off by {shown} on average; {said}"


def mirrored(observations: Observations, scene: Scene) -> Iterator[str]:
    """Yield mirrored axes of the points at rest."""
    count = observations.there.sum(axis=1, keepdims=True)
    rest, places = (
        np.where(observations.known, values, 0.0).sum(axis=1)[count[:, 0] > 0, :2] / count[count > 0, None]
        for values in (observe_at_rest(scene, observations), observations.values)
    )
    if not (np.isfinite(rest).all() and len(rest) >= MIN_COUNT_WITH_SIGMA):
        return
    axes = _opposed(places - places.mean(axis=0), rest - rest.mean(axis=0), None)
    if not axes:
        return
    remedies = {"x": "-x, right of the middle above 0", "y": "-y, above the middle above 0"}
    if observations.kind == "pixel":
        width, height = scene.render.size
        remedies = {"x": f"{width} - x, counted from the left", "y": f"{height} - y, counted from above"}
    said = " and ".join(remedies["xy"[axis]] for axis in axes)
    names = " and ".join("xy"[axis] for axis in axes)
    where = f"{observations.name}: {observations.kind}"
    yield f"{where}: {names} of the points at rest has the other sign in the scene; take {said}"


def opposed(observations: Observations, scene: Scene, *predictions: Prediction) -> Iterator[str]:
    """Yield components of motion and forces that are opposed to those of all predictions."""
    rest = observe_at_rest(scene, observations)
    found = [set(_opposed(observations.values - rest, one.values - rest, observations.sigma)) for one in predictions]
    for axis in sorted(set.intersection(*found)):
        said = f"{'xyz'[axis]} changes against the scene's; is its sign, or that of a tool's force or path, wrong?"
        yield f"{observations.name}: {observations.kind}: {said} change the sign of either"
    if (forces := observations.forces) is not None:
        found = [set(_opposed(forces.force, one.forces, forces.sigma)) for one in predictions]
        for axis in sorted(set.intersection(*found)):
            said = "is it the force on the tool? give the force on the sheet, of the other sign"
            yield f"{forces.name}: force_{'xyz'[axis]}: acts against the scene's; {said}"


def force_unit(observations: Observations, *predictions: Prediction) -> Iterator[str]:
    """Yield a unit that is the ratio of measured to predicted forces in all predictions."""
    if (forces := observations.forces) is None:
        return
    ratios = [_ratio(forces.force, one.forces, forces.sigma) for one in predictions]
    for unit, number in UNITS_PER_NEWTON.items():
        if all(1 / MAX_UNIT_FACTOR < ratio / number < MAX_UNIT_FACTOR for ratio in ratios):
            said = f"{ratios[0]:.3g} times those of the scene where the search begins; are they in {unit}?"
            remedy = f"divide them by {number:g}" if number > 1 else f"multiply them by {1 / number:g}"
            yield f"{forces.name}: forces: {said} {remedy}, or start nearer by --set"
            return


def _opposed(observed: Array, predicted: Array, sigma: float | None) -> list[int]:
    """Return the components, in the last axis, with a cosine below MAX_COSINE and a significant size."""
    known = np.isfinite(observed) & np.isfinite(predicted)
    one, other = (np.where(known, array, 0.0).reshape(-1, known.shape[-1]) for array in (observed, predicted))
    lengths = np.linalg.norm(one, axis=0), np.linalg.norm(other, axis=0)
    counts = known.reshape(-1, known.shape[-1]).sum(axis=0)
    is_large = (counts >= (MIN_COUNT_WITHOUT_SIGMA if sigma is None else MIN_COUNT_WITH_SIGMA)) & (
        lengths[0] > MIN_SIGMAS * (sigma or 0.0) * np.sqrt(counts)
    )
    for length in lengths:
        is_large &= length > MIN_COMPONENT_SHARE * np.linalg.norm(length)
    return np.flatnonzero(is_large & ((one * other).sum(axis=0) < MAX_COSINE * lengths[0] * lengths[1])).tolist()


def _ratio(observed: Array, predicted: Array, sigma: float) -> float:
    """Return the ratio of observed to predicted forces; 0 if they are small or not parallel."""
    known = np.isfinite(observed)
    one, other = observed[known], predicted[known]
    lengths = float(np.linalg.norm(one)), float(np.linalg.norm(other))
    if len(one) < MIN_COUNT_WITH_SIGMA or max(lengths) < MIN_SIGMAS * sigma * np.sqrt(len(one)):
        return 0.0
    return lengths[0] / lengths[1] if one @ other > -MAX_COSINE * lengths[0] * lengths[1] > 0 else 0.0
