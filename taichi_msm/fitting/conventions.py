"""Plausibility checks of conventions: pixel centres, signs of axes and forces, units of forces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Largest cosine of opposed axes and forces.
MAX_COSINE = -0.9

# Smallest norm of compared components [sigma].
MIN_SIGMAS = 5.0

# Smallest number of values for a cosine; without sigma it is larger.
MIN_COUNT = 3

# Units of force per newton, and the largest deviation of a ratio from them, as a factor.
UNITS_PER_NEWTON, MAX_UNIT_FACTOR = {"mN": 1000.0, "gf": 101.97, "kN": 0.001}, 3.0


def half_pixel(
    subject: str, values: Array, rest: Array, predicted: Array, is_observed: NDArray[np.bool_], sigma: Any
) -> Iterator[str]:
    """Yield a common half-pixel offset of all points at rest, whose predicted motion is below 0.02 px.

    Args:
        subject: name of the values, in messages.
        values: observed pixels [px], shape (N, T, 2).
        rest: pixels of the sheet at rest.
        predicted: predicted pixels.
        is_observed: mask of the observed points, shape (N, T).
        sigma: standard deviation of the errors [px]; None: not known.
    """
    is_at_rest = is_observed & (np.linalg.norm(predicted - rest, axis=2) < 0.02)
    count = is_at_rest.sum(axis=1)
    offsets = np.where(is_at_rest[..., None], values - rest, 0.0).sum(axis=1)[count > 0] / count[count > 0, None]
    if len(offsets) < 5:
        return
    sigma_error = (sigma or 0.0) / np.sqrt(count.sum())
    mean, error = offsets.mean(axis=0), np.maximum(offsets.std(axis=0, ddof=1) / np.sqrt(len(offsets)), sigma_error)
    halves = np.where(np.abs(mean) < 0.25, 0.0, 0.5 * np.sign(mean))
    distance = np.abs(np.stack([mean, np.median(offsets, axis=0)]) - halves).max(axis=0)
    # The mean offset is within 3 standard errors of a half or 0, precise, and significant [px].
    is_near = (distance <= 3.0 * error + 0.02) & (error < 0.1)
    if is_near.all() and ((halves != 0) & (np.abs(mean) > 5.0 * error)).any():
        shown = " and ".join(f"{offset:+.2g} px in {axis}" for offset, axis in zip(mean, "xy", strict=True))
        side, remedy = (0, "add") if halves.min() < 0 else (1, "subtract")
        question = f"is the centre of their first pixel at {side}? {remedy} 0.5, as it is at 0.5 here"
        yield f"{subject}: points at rest are off by {shown} on average; {question}"


def mirrored_axes(values: Array, rest: Array, known: NDArray[np.bool_]) -> list[int]:
    """Return the axes on which points at rest have the other sign; all arrays have the shape (N, T, numbers)."""
    count = known[..., 0].sum(axis=1, keepdims=True)
    means = (
        np.where(known, each, 0.0).sum(axis=1)[count[:, 0] > 0, :2] / count[count > 0, None] for each in (rest, values)
    )
    expected, observed = means
    if not (np.isfinite(expected).all() and len(expected) >= MIN_COUNT):
        return []
    return _opposed(observed - observed.mean(axis=0), expected - expected.mean(axis=0), None)


def opposed_axes(observed: Array, predictions: Sequence[Array], sigma: Any) -> list[int]:
    """Return the components (last axis) that have the other sign in all predictions."""
    return sorted(set.intersection(*(set(_opposed(observed, predicted, sigma)) for predicted in predictions)))


def unit_of_force(observed: Array, predictions: Sequence[Array], sigma: Any) -> tuple[str, float, float] | None:
    """Return the unit of force that explains the ratios of observed to predicted forces, or None.

    Returns:
        The unit, the number of it in a newton, and the ratio of the first prediction.
    """
    ratios = [_ratio(observed, predicted, sigma) for predicted in predictions]
    for unit, per_newton in UNITS_PER_NEWTON.items():
        if all(1 / MAX_UNIT_FACTOR < ratio / per_newton < MAX_UNIT_FACTOR for ratio in ratios):
            return unit, per_newton, ratios[0]
    return None


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
