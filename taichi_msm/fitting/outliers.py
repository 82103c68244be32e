"""Outliers of a robust fit of points and forces.

A sample consists of all components of a point, or of a force, at one time. From the solution with soft_l1 on, samples
are left out if the sum of their squared residuals is above the limit of chi-square for `PROBABILITY`, in units of the
median residual of the rest, or of sigma if that is larger. The rest is fitted by least squares, until the same samples
are left out: the loss is min(r^2, limit). Gross outliers have no weight, 99.9 % of normal errors have full weight.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.fitting.least_squares import Misfit, Search, Solution
from taichi_msm.fitting.observation import Observation
from taichi_msm.fitting.parameters import rounded

# Probability that normal errors exceed the limit of a sample.
PROBABILITY = 1e-3

# Number of estimates of sigma, and largest number of fits of the rest.
MAX_FITS = 10

# Smallest limit, as a share of the motion or force: residuals of exact observations are not normal.
MIN_SHARE = 1e-4


# Largest share of the values that are a few, and smallest share of chi-square that they carry.
MAX_FEW, MIN_CARRIED = 0.3, 0.9


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Outliers of an observation."""

    noun: str  # of the observation
    mask: NDArray[np.bool_]  # outliers, with the shape of the values without components
    known: int  # number of samples, including the outliers

    @property
    def share(self) -> float:
        """Share of the outliers in all samples."""
        return float(self.mask.sum()) / self.known

    def as_json(self) -> dict[str, Any]:
        """Return JSON data, as in fit.json."""
        return {"values": self.noun, "share": self.share, "samples": np.argwhere(self.mask).tolist()}

    def __str__(self) -> str:
        share = f"{rounded(100 * self.share)} % of the {self.noun}"
        return f"{share} are outliers and left out, {self.mask.sum()} of {self.known} samples"


def leave_out(search: Search, solution: Solution) -> tuple[Solution, list[LeftOut]]:
    """Fit the observations without outliers by least squares; the misfit of the search becomes that of the rest.

    Return the solution of the rest, and the outliers of every observation.
    """
    everything, left_out = search.misfit, None
    for _ in range(MAX_FITS):
        pairs = zip(everything.observations, solution.predicted.values, everything.signals, strict=True)
        found = [_find(observed, predicted, signal) for observed, predicted, signal in pairs]
        if left_out is not None and all(map(np.array_equal, found, left_out)):
            break
        left_out = found
        rest = [observed.without(mask) for observed, mask in zip(everything.observations, left_out, strict=True)]
        search.misfit = Misfit(rest, everything.signals, robust=False)
        solution = search.refine(solution.x)
    assert left_out is not None
    masks = zip(everything.observations, left_out, strict=True)
    return solution, [LeftOut(each.noun, mask, int(each.known.any(axis=-1).sum())) for each, mask in masks]


def outlier_notes(residuals: Array) -> Iterator[str]:
    """Yield a warning if a few residuals of a fit by least squares, shape (known,), carry chi-square."""
    from scipy.stats import chi2

    squares = residuals**2
    # 1.4826 converts the median magnitude of normal errors to sigma.
    is_outlier = squares > chi2.isf(PROBABILITY, 1) * 1.4826**2 * np.median(squares)
    carried = float(squares[is_outlier].sum() / max(squares.sum(), 1e-300))
    if is_outlier.mean() <= MAX_FEW and carried >= MIN_CARRIED:
        shares = f"{is_outlier.sum()} of {len(squares)} values carry {rounded(100 * carried)} % of chi-square"
        yield f"{shares}: if they are outliers, --robust reduces their weight or leaves them out"


def _find(observed: Observation, predicted: Array, signal: float) -> NDArray[np.bool_]:
    """Return the mask of the outliers, with the shape of the values without components."""
    from scipy.stats import chi2

    residuals, known = np.where(observed.known, predicted - observed.values, 0.0), observed.known
    squares = np.sum(residuals**2, axis=-1)
    limit = chi2.isf(PROBABILITY, np.maximum(known.sum(axis=-1), 1))
    smallest = max(float(np.max(observed.sigma or 0.0)), MIN_SHARE * signal)
    rest = known
    for _ in range(MAX_FITS):
        # 1.4826 converts the median magnitude of normal errors to sigma.
        sigma = max(1.4826 * float(np.median(np.abs(residuals[rest]))), smallest)
        rest = known & (squares <= limit * sigma**2)[..., None]
    return np.asarray(known.any(axis=-1) & ~rest.any(axis=-1))
