"""The values of every run of a sweep."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

from taichi_msm.sweeps.distribution import Distribution


def values_of_runs(vary: Mapping[str, Distribution], samples: int | None, seed: int) -> list[list[Any]]:
    """Give the values of the varied keys, in their order, for every run.

    Every combination of the grids, the last key varying fastest; or, with a number of samples, the first points of a
    scrambled Sobol sequence, of which every number and every choice takes a dimension, in the order of the keys.

    Source: Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; SciPy's `qmc.Sobol`.
    """
    if samples is None:
        return [list(values) for values in itertools.product(*(one.values for one in vary.values()))]
    import numpy as np
    from scipy.stats import qmc

    counts = [one.dimensions for one in vary.values()]
    # A generator, as SciPy turns a number into different ones from version to version; a power of two, as it warns of
    # any other number, whose first points are the same.
    sequence = qmc.Sobol(sum(counts), scramble=True, seed=np.random.default_rng(seed))
    points = sequence.random_base2(math.ceil(math.log2(samples)))[:samples]
    parts = np.split(points, np.cumsum(counts)[:-1], axis=1)
    columns = [[one.value(shares) for shares in part.tolist()] for one, part in zip(vary.values(), parts, strict=True)]
    return [list(values) for values in zip(*columns, strict=True)]


def count_runs(vary: Mapping[str, Distribution], samples: int | None) -> int:
    """Count the runs without making their values."""
    return math.prod(len(one.values) for one in vary.values()) if samples is None else samples
