"""Plausibility checks of conventions: centres of pixels, signs of axes and of forces, units of forces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.observations import Observations, seen_at_rest
from taichi_msm.fitting.predict import Predicted
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]

# Points rest where the scene moves them by less than this [px]; fewer points have no mean offset.
STILL_PX, FEWEST_POINTS = 0.02, 5

# The mean offset has a standard error below MAX_ERROR_PX, is within NEAR of them of half a pixel, and more than FAR of
# them from 0. What is known exactly is still this near [px].
MAX_ERROR_PX, NEAR, FAR, NEAR_PX = 0.1, 3.0, 5.0, 0.02

# Axes and forces are opposed below this cosine.
OPPOSED = -0.9

# Components below this share of the whole are left out, and so are those below so many sigma.
SMALL_SHARE, FEW_SIGMAS = 0.1, 5.0

# Fewer numbers have no cosine: with a sigma, and without.
FEWEST_KNOWN, FEWEST_UNKNOWN = 3, 12

# Units of force by their number in a newton, and the factor by which a ratio may be off.
UNITS, FACTOR = {"mN": 1000.0, "gf": 101.97, "kN": 0.001}, 3.0


def half_pixel(seen: Observations, scene: Scene, first: Predicted) -> Iterator[str]:
    """Compare pixels of points at rest with those of the scene: an equal offset of half a pixel is a convention."""
    rest = seen_at_rest(scene, seen)
    still = seen.there & (np.linalg.norm(first.values - rest, axis=2) < STILL_PX)
    number = still.sum(axis=1)
    offsets = np.where(still[..., None], seen.values - rest, 0.0).sum(axis=1)[number > 0] / number[number > 0, None]
    if len(offsets) < FEWEST_POINTS:
        return
    known = (seen.sigma or 0.0) / np.sqrt(number.sum())
    mean, error = offsets.mean(axis=0), np.maximum(offsets.std(axis=0, ddof=1) / np.sqrt(len(offsets)), known)
    halves = np.where(np.abs(mean) < 0.25, 0.0, 0.5 * np.sign(mean))
    away = np.abs(np.stack([mean, np.median(offsets, axis=0)]) - halves).max(axis=0)
    is_near = (away <= NEAR * error + NEAR_PX) & (error < MAX_ERROR_PX)
    if is_near.all() and ((halves != 0) & (np.abs(mean) > FAR * error)).any():
        shown = " and ".join(f"{one:+.2g} px in {axis}" for one, axis in zip(mean, "xy", strict=True))
        side, remedy = (0, "add") if halves.min() < 0 else (1, "subtract")
        said = f"is the centre of their first pixel at {side}? {remedy} 0.5, as it is at 0.5 here"
        yield f"{seen.name}: pixel: points at rest are off by {shown} on average; {said}"


def mirrored(seen: Observations, scene: Scene) -> Iterator[str]:
    """Compare the order of points along each axis with that at rest."""
    count = seen.there.sum(axis=1, keepdims=True)
    rest, places = (
        np.where(seen.known, values, 0.0).sum(axis=1)[count[:, 0] > 0, :2] / count[count > 0, None]
        for values in (seen_at_rest(scene, seen), seen.values)
    )
    if not (np.isfinite(rest).all() and len(rest) >= FEWEST_KNOWN):
        return
    axes = _opposed(places - places.mean(axis=0), rest - rest.mean(axis=0), None)
    if not axes:
        return
    remedies = {"x": "-x, right of the middle above 0", "y": "-y, above the middle above 0"}
    if seen.kind == "pixel":
        width, height = scene.render.size
        remedies = {"x": f"{width} - x, counted from the left", "y": f"{height} - y, counted from above"}
    said = " and ".join(remedies["xy"[axis]] for axis in axes)
    names = " and ".join("xy"[axis] for axis in axes)
    yield f"{seen.name}: {seen.kind}: {names} of the points at rest has the other sign in the scene; take {said}"


def opposed(seen: Observations, scene: Scene, *predictions: Predicted) -> Iterator[str]:
    """Compare signs of motion and forces with those of predictions: in all of them they are opposed."""
    rest = seen_at_rest(scene, seen)
    found = [set(_opposed(seen.values - rest, one.values - rest, seen.sigma)) for one in predictions]
    for axis in sorted(set.intersection(*found)):
        said = f"{'xyz'[axis]} changes against the scene's; is its sign, or that of a tool's force or path, wrong?"
        yield f"{seen.name}: {seen.kind}: {said} change the sign of either"
    if (forces := seen.forces) is not None:
        found = [set(_opposed(forces.force, one.forces, forces.sigma)) for one in predictions]
        for axis in sorted(set.intersection(*found)):
            said = "is it the force on the tool? give the force on the sheet, of the other sign"
            yield f"{forces.name}: force_{'xyz'[axis]}: acts against the scene's; {said}"


def force_unit(seen: Observations, *predictions: Predicted) -> Iterator[str]:
    """Compare the size of forces with those of predictions: in all of them the ratio is that of a unit."""
    if (forces := seen.forces) is None:
        return
    ratios = [_ratio(forces.force, one.forces, forces.sigma) for one in predictions]
    for unit, number in UNITS.items():
        if all(1 / FACTOR < ratio / number < FACTOR for ratio in ratios):
            said = f"{ratios[0]:.3g} times those of the scene where the search begins; are they in {unit}?"
            remedy = f"divide them by {number:g}" if number > 1 else f"multiply them by {1 / number:g}"
            yield f"{forces.name}: forces: {said} {remedy}, or start nearer by --set"
            return


def _opposed(observed: Array, predicted: Array, sigma: float | None) -> list[int]:
    """Return the components, in the last axis, that have a cosine below OPPOSED and are not small."""
    known = np.isfinite(observed) & np.isfinite(predicted)
    one, other = (np.where(known, array, 0.0).reshape(-1, known.shape[-1]) for array in (observed, predicted))
    lengths = np.linalg.norm(one, axis=0), np.linalg.norm(other, axis=0)
    counts = known.reshape(-1, known.shape[-1]).sum(axis=0)
    is_large = (counts >= (FEWEST_UNKNOWN if sigma is None else FEWEST_KNOWN)) & (
        lengths[0] > FEW_SIGMAS * (sigma or 0.0) * np.sqrt(counts)
    )
    for length in lengths:
        is_large &= length > SMALL_SHARE * np.linalg.norm(length)
    return np.flatnonzero(is_large & ((one * other).sum(axis=0) < OPPOSED * lengths[0] * lengths[1])).tolist()


def _ratio(observed: Array, predicted: Array, sigma: float) -> float:
    """Return how many times larger observed forces are; 0: they are small, or of another kind."""
    known = np.isfinite(observed)
    one, other = observed[known], predicted[known]
    lengths = float(np.linalg.norm(one)), float(np.linalg.norm(other))
    if len(one) < FEWEST_KNOWN or max(lengths) < FEW_SIGMAS * sigma * np.sqrt(len(one)):
        return 0.0
    return lengths[0] / lengths[1] if one @ other > -OPPOSED * lengths[0] * lengths[1] > 0 else 0.0
