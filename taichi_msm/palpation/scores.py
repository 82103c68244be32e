"""Scores of the map: presses are left out in five random parts, and predicted from the others.

Lock, prior of the offsets and process are fitted to the others alone. A constant stiffness, and that of the nearest
press, are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from taichi_msm.arithmetic import Array
from taichi_msm.errors import ProgressCallback
from taichi_msm.palpation.fit import PressFit, refit
from taichi_msm.palpation.predict import Forces, build_map, relative_residual
from taichi_msm.palpation.presses import Presses

PARTS = 5


@dataclass(frozen=True, eq=False)
class Scores:
    """Relative residuals of presses that were left out, root mean square over each press, shape (n,)."""

    constant: Array
    nearest: Array
    map: Array
    forces: Forces  # by the map, of all rows
    coverage: float  # share of rows within the 90 % intervals


def score(presses: Presses, fit: PressFit, progress: ProgressCallback) -> Scores:
    """Return the scores of a fit of presses."""
    parts = np.array_split(np.random.default_rng(0).permutation(presses.count), PARTS)
    residuals, forces = np.empty((3, presses.count)), np.empty((3, len(presses.depth)))
    for n, part in enumerate(parts):
        progress(n, PARTS)
        left_out = np.sort(part)
        rows, kept = np.isin(presses.index, part), np.setdiff1d(np.arange(presses.count), part)
        known, new = presses.subset(kept), presses.subset(left_out)
        fitted = refit(known, replace(fit, offset=fit.offset[kept]))
        built = build_map(known, fitted)
        predicted = built.predict(new)
        forces[:, rows] = predicted
        logs = np.log(fitted.mean_stiffness)
        nearest = logs[cdist(new.position, known.position).argmin(axis=1)]
        shape = fitted.law.force(new.depth + fitted.prior.mean)
        for k, log in enumerate([np.full(new.count, logs.mean()), nearest]):
            residuals[k, left_out] = relative_residual(new, np.exp(log)[new.index] * shape)
        residuals[2, left_out] = relative_residual(new, predicted.force)
    coverage = float(np.mean((forces[1] <= presses.force) & (presses.force <= forces[2])))
    constant, nearest, by_map = residuals
    return Scores(constant, nearest, by_map, Forces(*forces), coverage)
