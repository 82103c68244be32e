"""Plausibility checks of conventions: pixel centres, signs of axes and forces, units of forces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.observations import Observations, observe_at_rest
from taichi_msm.fitting.predict import Prediction
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]

# Largest cosine of opposed axes and forces.
MAX_COSINE = -0.9

# Smallest norm of compared components [sigma].
MIN_SIGMAS = 5.0

# Smallest number of values for a cosine; without sigma it is larger.
MIN_COUNT = 3

# Units of force per newton, and the largest deviation of a ratio from them, as a factor.
UNITS_PER_NEWTON, MAX_UNIT_FACTOR = {"mN": 1000.0, "gf": 101.97, "kN": 0.001}, 3.0


def half_pixel(observations: Observations, scene: Scene, first: Prediction) -> Iterator[str]:
    """Yield a common half-pixel offset of all points at rest, whose predicted motion is below 0.02 px."""
    rest = observe_at_rest(scene, observations)
    is_at_rest = observations.is_observed & (np.linalg.norm(first.values - rest, axis=2) < 0.02)
    count = is_at_rest.sum(axis=1)
    offsets = (
        np.where(is_at_rest[..., None], observations.values - rest, 0.0).sum(axis=1)[count > 0] / count[count > 0, None]
    )
    if len(offsets) < 5:
        return
    sigma_error = (observations.sigma or 0.0) / np.sqrt(count.sum())
    mean, error = offsets.mean(axis=0), np.maximum(offsets.std(axis=0, ddof=1) / np.sqrt(len(offsets)), sigma_error)
    halves = np.where(np.abs(mean) < 0.25, 0.0, 0.5 * np.sign(mean))
    distance = np.abs(np.stack([mean, np.median(offsets, axis=0)]) - halves).max(axis=0)
    # The mean offset is within 3 standard errors of a half or 0, precise, and significant [px].
    is_near = (distance <= 3.0 * error + 0.02) & (error < 0.1)
    if is_near.all() and ((halves != 0) & (np.abs(mean) > 5.0 * error)).any():
        shown = " and ".join(f"{offset:+.2g} px in {axis}" for offset, axis in zip(mean, "xy", strict=True))
        side, remedy = (0, "add") if halves.min() < 0 else (1, "subtract")
        question = f"is the centre of their first pixel at {side}? {remedy} 0.5, as it is at 0.5 here"
        yield f"{observations.name}: pixel: points at rest are off by {shown} on average; {question}"


def mirrored(observations: Observations, scene: Scene) -> Iterator[str]:
    """Yield mirrored axes, from the points at rest."""
    count = observations.is_observed.sum(axis=1, keepdims=True)
    rest, observed = (
        np.where(observations.known, values, 0.0).sum(axis=1)[count[:, 0] > 0, :2] / count[count > 0, None]
        for values in (observe_at_rest(scene, observations), observations.values)
    )
    if not (np.isfinite(rest).all() and len(rest) >= MIN_COUNT):
        return
    axes = _opposed(observed - observed.mean(axis=0), rest - rest.mean(axis=0), None)
    if not axes:
        return
    remedies = {"x": "-x, right of the middle above 0", "y": "-y, above the middle above 0"}
    if observations.kind == "pixel":
        width, height = scene.render.size
        remedies = {"x": f"{width} - x, counted from the left", "y": f"{height} - y, counted from above"}
    remedy = " and ".join(remedies["xy"[axis]] for axis in axes)
    names = " and ".join("xy"[axis] for axis in axes)
    subject = f"{observations.name}: {observations.kind}"
    yield f"{subject}: {names} of the points at rest has the other sign in the scene; take {remedy}"


def opposed(observations: Observations, scene: Scene, *predictions: Prediction) -> Iterator[str]:
    """Yield components of motion and forces of opposite sign to all predictions."""
    rest = observe_at_rest(scene, observations)
    opposed_axes = [
        set(_opposed(observations.values - rest, prediction.values - rest, observations.sigma))
        for prediction in predictions
    ]
    for axis in sorted(set.intersection(*opposed_axes)):
        fault = f"{'xyz'[axis]} changes against the scene's; is its sign, or that of a tool's force or path, wrong?"
        yield f"{observations.name}: {observations.kind}: {fault} change the sign of either"
    if (forces := observations.forces) is not None:
        opposed_axes = [set(_opposed(forces.force, prediction.forces, forces.sigma)) for prediction in predictions]
        for axis in sorted(set.intersection(*opposed_axes)):
            fault = "is it the force on the tool? give the force on the sheet, of the other sign"
            yield f"{forces.name}: force_{'xyz'[axis]}: acts against the scene's; {fault}"


def force_unit(observations: Observations, *predictions: Prediction) -> Iterator[str]:
    """Yield the unit of force that explains the ratio of measured to predicted forces, for all predictions."""
    if (forces := observations.forces) is None:
        return
    ratios = [_ratio(forces.force, prediction.forces, forces.sigma) for prediction in predictions]
    for unit, per_newton in UNITS_PER_NEWTON.items():
        if all(1 / MAX_UNIT_FACTOR < ratio / per_newton < MAX_UNIT_FACTOR for ratio in ratios):
            fault = f"{ratios[0]:.3g} times those of the scene where the search begins; are they in {unit}?"
            remedy = f"divide them by {per_newton:g}" if per_newton > 1 else f"multiply them by {1 / per_newton:g}"
            yield f"{forces.name}: forces: {fault} {remedy}, or start nearer by --set"
            return


def _opposed(observed: Array, predicted: Array, sigma: float | Array | None) -> list[int]:
    """Return the components (last axis) with a significant size and a cosine below `MAX_COSINE`."""
    known = np.isfinite(observed) & np.isfinite(predicted)
    first, second = (np.where(known, array, 0.0).reshape(-1, known.shape[-1]) for array in (observed, predicted))
    lengths = np.linalg.norm(first, axis=0), np.linalg.norm(second, axis=0)
    counts = known.reshape(-1, known.shape[-1]).sum(axis=0)
    is_large = (counts >= (12 if sigma is None else MIN_COUNT)) & (
        lengths[0] > MIN_SIGMAS * (sigma or 0.0) * np.sqrt(counts)
    )
    for length in lengths:
        is_large &= length > 0.1 * np.linalg.norm(length)
    return np.flatnonzero(is_large & ((first * second).sum(axis=0) < MAX_COSINE * lengths[0] * lengths[1])).tolist()


def _ratio(observed: Array, predicted: Array, sigma: float | Array) -> float:
    """Return the ratio of observed to predicted forces; 0: insignificant, or not parallel."""
    known = np.isfinite(observed)
    measured, expected = observed[known], predicted[known]
    lengths = float(np.linalg.norm(measured)), float(np.linalg.norm(expected))
    if len(measured) < MIN_COUNT or max(lengths) < MIN_SIGMAS * sigma * np.sqrt(len(measured)):
        return 0.0
    return lengths[0] / lengths[1] if measured @ expected > -MAX_COSINE * lengths[0] * lengths[1] > 0 else 0.0
