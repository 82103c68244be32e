"""Estimated duration of a run: its work, times the time that this machine takes for a unit of work."""

from __future__ import annotations

import math
import time
from functools import cache
from typing import NamedTuple

import numpy as np

from taichi_msm.physics.pilots import choose_pilots
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.workload import work

# Time of a unit of work [s], and of the calibration, on two cores of an AMD EPYC of 2024.
UNIT, CALIBRATION = 1.5e-9, 1e-4


class Duration(NamedTuple):
    """How long a run will take."""

    seconds: float  # from start to end [s]
    start: float  # the part of it before the first step [s]


def estimate(plan: Plan) -> Duration:
    """Estimate how long a run takes on a CPU, with every core; computing it takes milliseconds."""
    parts = work(plan, choose_pilots(plan).cost)
    unit = UNIT * _calibrate() / CALIBRATION
    return Duration(unit * sum(parts), unit * parts.start)


@cache
def _calibrate() -> float:
    """Time a step of a small sheet in NumPy [s]: the fastest of some, which other programs disturb least."""
    field, fastest = np.zeros((256, 256), np.float32), math.inf
    for _ in range(20):
        start = time.perf_counter()
        around = field[:-2, 1:-1] + field[2:, 1:-1] + field[1:-1, :-2] + field[1:-1, 2:]
        field[1:-1, 1:-1] += 0.1 * (around - 4 * field[1:-1, 1:-1])
        fastest = min(fastest, time.perf_counter() - start)
    return fastest
