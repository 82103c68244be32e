"""Map of the stiffness, and forces of presses at other places.

K at the mean offset c contains the effect of the offset o of its press, to first order exp(h (o - c)), with h the mean
d log g / do of the presses. As stiffness and offset may be correlated, log K at the mean offset depends on the offset
by b (o - c), with b from the presses by generalised least squares: b is h where the two are independent. A new press
has the stiffness exp(map + (b - h) (o - c) + e), with e the part of the noise of the process that b (o - c) leaves.
"""

from __future__ import annotations

import math
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
    slope: float  # b - h, the change of log K with the offset [1/m]
    scatter: float  # standard deviation of e

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
        # The force is not linear in the offset: near the contact, it is 0 on one side.
        shifted = [
            stiffness * math.exp(self.slope * shift) * law.force(depth + shift)
            for shift in (-NORMAL_90 * prior.width, 0.0, NORMAL_90 * prior.width)
        ]
        peak = np.zeros(presses.count)
        np.maximum.at(peak, index, force)
        of_noise = NORMAL_90 * prior.noise * peak[index]
        spread = NORMAL_90 * np.hypot(deviation, self.scatter)[index]
        low, high = (
            force + sign * np.sqrt((force * np.expm1(sign * spread)) ** 2 + (end - force) ** 2 + of_noise**2)
            for sign, end in ((-1, np.min(shifted, axis=0)), (1, np.max(shifted, axis=0)))
        )
        return Forces(force, low, high)


def build_map(presses: Presses, fit: PressFit) -> StiffnessMap:
    """Return the map of fitted presses."""
    depth = presses.depth + fit.prior.mean
    force, slope = fit.law.force(depth), fit.law.slope(depth)
    squares = presses.sum(force**2)
    touches = squares > 0
    effect = float(np.mean(presses.sum(force * slope)[touches] / squares[touches]))
    process = fit_process(presses.position, np.log(fit.mean_stiffness))
    of_process = process.regress(fit.offset - fit.prior.mean)
    scatter = math.sqrt(max(process.noise**2 - (of_process * fit.prior.width) ** 2, 0.0))
    return StiffnessMap(fit, process, of_process - effect, scatter)


def relative_residual(presses: Presses, force: Array) -> Array:
    """Return the root mean square of (F - force) / peak of each press."""
    return presses.root_mean_square(presses.target - force / presses.peak[presses.index])
