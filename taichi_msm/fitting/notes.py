"""What the user of a fit should know beside its numbers, a line each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.estimation import Solution
from taichi_msm.fitting.identifiability import Unseen
from taichi_msm.fitting.observations import Observations
from taichi_msm.fitting.parameters import Parameter, rounded
from taichi_msm.fitting.uncertainty import Alike, Uncertainty

Array = NDArray[np.float64]

# A parameter this close to a bound, in units of x, has ended there.
AT_BOUND = 1e-3

# Parameters are tied together, and errors are alike, if they correlate by more than this.
TIED, ALIKE = 0.95, 0.3

# What is left is too small to say anything of below this share of the motion.
NOTHING_LEFT = 1e-6

# Nor below this share of a sigma that is given.
LITTLE_LEFT = 0.1


def of_the_search(solution: Solution, parameters: Sequence[Parameter], *, fits: bool) -> Iterator[str]:
    """Note what is wrong with the place where the search ended; fits: whether little is left there."""
    if not solution.converged:
        yield "the search ended before it came to rest; start nearer by --set, or give --bounds"
    if not fits:
        yield "what is left is large: the scene does not move as was seen with any of these values"
    for one, x in zip(parameters, solution.x.tolist(), strict=True):
        low, high = one.limits
        if min(x - low, high - x) < AT_BOUND:
            bounded = math.isfinite(one.low) or math.isfinite(one.high)
            end = "a bound" if bounded else "1000 times from where it starts"
            yield f"{one.key}: ended at {one.value(x):.4g}, {end}: its interval says little"


def of_the_points(
    parameters: Sequence[Parameter], x: Array, uncertain: Uncertainty, shifts: Array | None
) -> Iterator[str]:
    """Note the parameters that the number of points moves farther than what was seen leaves open."""
    wide = uncertain.quantile * uncertain.deviations
    if shifts is not None and (
        moved := [
            f"{one.key} by about {rounded(100 * one.share(x[n], float(shifts[n])))} %"
            for n, one in enumerate(parameters)
            if shifts[n] > wide[n]
        ]
    ):
        said = "more than what was seen leaves open; take more sheet.points"
        yield f"the number of points moves {', '.join(moved)}: {said}"


def of_ties(parameters: Sequence[Parameter], uncertain: Uncertainty, blind: Sequence[Unseen]) -> Iterator[str]:
    """Note parameters that are tied together, but for those that are not seen."""
    for n, m in zip(*np.nonzero(np.triu(np.abs(uncertain.correlation) > TIED, 1)), strict=True):
        keys = parameters[n].key, parameters[m].key
        if not any(set(keys) <= set(one.parameters) for one in blind):
            tied = f"{keys[0]} and {keys[1]} correlate by {uncertain.correlation[n, m]:.3f}"
            yield f"{tied}: they are known best together"


def of_what_is_left(
    seen: Observations, solution: Solution, uncertain: Uncertainty, motion: float, alike: Alike
) -> Iterator[str]:
    """Note errors that are larger than sigma, or that are not independent though they are taken to be."""
    if uncertain.factor > 1.5:
        times = rounded(math.sqrt(uncertain.factor))
        yield f"what is left is {times} times sigma, and the intervals are widened by as much"
    left = solution.predicted.values - seen.values
    if np.sqrt(np.nanmean(left**2)) < max(NOTHING_LEFT * motion, LITTLE_LEFT * (seen.sigma or 0.0)):
        if seen.sigma is None:
            yield "next to nothing is left, and the intervals are those of so small errors; give their size by --sigma"
        return
    beside, after = _alike(left, seen.coordinates)
    if beside > ALIKE and alike.correlation is None:
        remedy = "; give --correlation PX" if seen.kind == "pixel" else ""
        said = f"what is left of neighbouring points is alike (correlation {beside:.2f})"
        yield f"{said}, so that the intervals are too narrow{remedy}"
    elif after > ALIKE and alike.drift is None:
        said = f"what is left of a point is alike from one time to the next (correlation {after:.2f})"
        yield f"{said}, so that the intervals are too narrow; give --drift SECONDS"


def _alike(left: Array, coordinates: Array) -> tuple[float, float]:
    """Correlate what is left of points, shape (N, T, numbers), with that of their nearest neighbours, and in time."""
    from scipy.spatial import KDTree

    def likeness_of(one: Array, other: Array) -> float:
        product, square = one * other, one**2 + other**2
        there = np.isfinite(product)
        return 2 * float(product[there].sum()) / max(float(square[there].sum()), 1e-300)

    # The nearest to a point but for itself.
    beside = likeness_of(left, left[KDTree(coordinates).query(coordinates, 2)[1][:, 1]]) if len(left) > 1 else 0.0
    return beside, likeness_of(left[:, 1:], left[:, :-1])
