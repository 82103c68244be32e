"""First-order sensitivity: the share of a result's variance that one parameter explains alone.

Source: Plischke, "An effective algorithm for computing global sensitivity indices (EASI)", 2010, and Tissot and Prieur,
"Bias correction for the estimation of sensitivity indices based on random balance designs", 2012; both as RBD-FAST of
SALib. It takes the results in the order of a parameter, in which the others must come at random. In Sobol points and
grids they do not: of neighbours in one coordinate, one is low in another coordinate and one is high. So we shuffle
neighbours, and take the mean over some shuffles. (Without that, the index for y of 3 x + y from 64 Sobol points was
wrong by 0.3 in the root mean square; with it, by 0.07.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.sweeps.parameters import Parameter

# Fewer runs do not tell parameters apart.
FEWEST_RUNS = 64

# Neighbours that are shuffled, how often, and the waves over the range of a parameter that its effect is made of.
NEIGHBOURS, SHUFFLES, WAVES = 4, 8, 4

# Of half of the runs, for each shuffle.
RESAMPLES = 25


class Index(NamedTuple):
    """The first-order sensitivity of a result to a parameter."""

    result: str
    parameter: str
    first_order: float  # 0 to 1, about
    confidence: float  # half the width of the 95 % interval


def sensitivity(parameters: Sequence[Parameter], results: Mapping[str, NDArray[np.float64]]) -> list[Index]:
    """Estimate the sensitivity of every result that enough runs have; ImportError: SALib is not installed."""
    indices = []
    for name, column in results.items():
        known = np.isfinite(column)
        if np.count_nonzero(known) >= FEWEST_RUNS:
            indices += [
                Index(name, parameter.name, *first_order(parameter.numbers[known], column[known]))
                for parameter in parameters
            ]
    return indices


def first_order(parameter: NDArray[np.float64], result: NDArray[np.float64]) -> tuple[float, float]:
    """Estimate the index of one parameter, and half the width of its 95 % interval."""
    from SALib.analyze import rbd_fast

    random = np.random.default_rng(0)
    problem = {"num_vars": 1, "names": [""]}
    estimates = []
    for shuffle in range(SHUFFLES):
        shuffled = random.permutation(len(result))
        ranks = np.argsort(np.argsort(parameter[shuffled], kind="stable"), kind="stable")
        ordered = result[shuffled][np.argsort(ranks // NEIGHBOURS, kind="stable")]
        place = np.arange(len(result), dtype=np.float64)[:, np.newaxis]
        found = rbd_fast.analyze(problem, place, ordered, M=WAVES, num_resamples=RESAMPLES, seed=1 + shuffle)
        estimates.append((found["S1"][0], found["S1_conf"][0]))
    estimate, confidence = np.mean(estimates, axis=0)
    return float(estimate), float(confidence)
