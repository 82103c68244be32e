"""Map of the stiffness, and forces of presses at other places.

K at the mean offset c contains the effect of the offset o of its press, to first order exp(h (o - c)), with h the mean
d log g / do of the presses; the noise of the process contains it too. So the offset of a new press changes the
logarithm of its force by (d log g / do - h) (o - c) in addition to that noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.palpation.fit import PressFit
from taichi_msm.palpation.presses import Presses
from taichi_msm.palpation.process import Process, fit_process

# Quantiles of normal errors, of intervals of 90 % and 95 %.
NORMAL_90, NORMAL_95 = 1.645, 1.960


class Forces(NamedTuple):
    """Predicted forces of rows, and the ends of their 90 % intervals [N], shape (N,)."""

    force: Array
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class StiffnessMap:
    """Law of the presses, and the process of log K at the mean offset."""

    fit: PressFit
    process: Process
    slope: float  # h, the mean effect of an offset on log K at the mean offset [1/m]

    def stiffness(self, places: Array) -> tuple[Array, Array, Array]:
        """Return K and the ends of its 95 % interval, without noise [N/m3], at places [m], shape (k, 3)."""
        mean, deviation = self.process.predict(places)
        low, high = (np.exp(mean + sign * NORMAL_95 * deviation) for sign in (-1, 1))
        return np.exp(mean), low, high

    def predict(self, presses: Presses) -> Forces:
        """Return the forces of new presses at their places and depths."""
        mean, deviation = self.process.predict(presses.position)
        law, prior, index = self.fit.law, self.fit.prior, presses.index
        stiffness, depth = np.exp(mean)[index], presses.depth + prior.mean
        force = stiffness * law.force(depth)
        of_offset = prior.width * (stiffness * law.slope(depth) - self.slope * force)
        peak = np.zeros(presses.count)
        np.maximum.at(peak, index, force)
        others = of_offset**2 + (prior.noise * peak[index]) ** 2
        spread = np.sqrt(deviation**2 + self.process.noise**2)[index]
        low, high = (
            force + sign * np.sqrt((force * np.expm1(sign * NORMAL_90 * spread)) ** 2 + NORMAL_90**2 * others)
            for sign in (-1, 1)
        )
        return Forces(force, low, high)


def build_map(presses: Presses, fit: PressFit) -> StiffnessMap:
    """Return the map of fitted presses."""
    depth = presses.depth + fit.prior.mean
    force, slope = fit.law.force(depth), fit.law.slope(depth)
    squares = presses.sum(force**2)
    touches = squares > 0
    effect = float(np.mean(presses.sum(force * slope)[touches] / squares[touches]))
    return StiffnessMap(fit, fit_process(presses.position, np.log(fit.mean_stiffness)), effect)


def relative_residual(presses: Presses, force: Array) -> Array:
    """Return the root mean square of (F - force) / peak of each press."""
    return presses.root_mean_square(presses.target - force / presses.peak[presses.index])
