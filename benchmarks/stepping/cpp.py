"""Hand-written C++, step.cpp, called through ctypes."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np

from benchmarks.native import library
from benchmarks.stepping.planes import Planes
from benchmarks.stepping.problem import FORCE, Problem
from taichi_msm.model.sheet import spacing

FLOATS = np.ctypeslib.ndpointer(np.float32, flags="C_CONTIGUOUS")


class Stepper(Planes):
    """State and parameters of step.cpp."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.points)
        self._advance = library(Path(__file__).with_name("step.cpp")).advance
        self._advance.argtypes = [FLOATS] * 5 + [ctypes.c_int64] * 3
        self._advance.restype = None
        sheet = problem.material
        self._numbers = np.array(
            [
                *(*spacing(problem.scene.sheet), sheet.across, sheet.shear, sheet.virtual),
                *(problem.keep, problem.gain, problem.first_gain),
            ],
            np.float32,
        )
        self._force = np.array(FORCE, np.float32)
        self._share = np.ascontiguousarray(problem.load[0] / self._force[0])

    def advance(self, steps: int) -> None:
        """Advance by all steps in one call."""
        n = self._share.shape[0]
        self._advance(self._now, self._before, self._share, self._force, self._numbers, n, self._done, steps)
        self._count(steps)


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest; OpenMP reads the number of threads from the environment."""
    del threads
    return Stepper(problem)
