"""The values of every run of a sweep."""

from __future__ import annotations

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
        return [_combination(vary, run) for run in range(count_runs(vary, None))]
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


def values_of_some(vary: Mapping[str, Distribution], samples: int | None, seed: int, most: int) -> list[list[Any]]:
    """Give the values of at most so many runs, spread over all, without making those of the others."""
    if samples is not None:
        # The first points of the sequence are spread over all.
        return values_of_runs(vary, min(samples, most), seed)
    total = count_runs(vary, None)
    return [_combination(vary, run) for run in sorted({(2 * n + 1) * total // (2 * most) for n in range(most)})]


def count_runs(vary: Mapping[str, Distribution], samples: int | None) -> int:
    """Count the runs without making their values."""
    return math.prod(len(one.values) for one in vary.values()) if samples is None else samples


def _combination(vary: Mapping[str, Distribution], run: int) -> list[Any]:
    """Give the combination of the grids with a number."""
    values = []
    for one in reversed(list(vary.values())):
        run, index = divmod(run, len(one.values))
        values.append(one.values[index])
    return values[::-1]
