"""What is measured of a peer: whether its answer is right, and the time of a step."""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clock import seconds
from benchmarks.process import CACHE
from benchmarks.stepping.problem import Problem, Stepper

# Largest distance of any point from where float64 has it, as a fraction of the largest displacement. In f32 rounding
# makes some 1e-6 of it, a spring too few or a wrong first step far more.
TOLERANCE = 1e-4


def steps_to_check(points: int) -> int:
    """Choose how many steps are compared: the twin takes a while for a large sheet."""
    return 200 if points <= 101 else 20 if points <= 1024 else 2


def prepare(peer: str, points: int, threads: int | None) -> Stepper:
    """Set up a peer."""
    return importlib.import_module(peer).prepare(Problem(points), threads)


def check(peer: str, points: int, threads: int | None = None) -> dict[str, Any]:
    """Compare a peer with the twin, and time its start."""
    importlib.import_module(peer)
    start = time.perf_counter()
    stepper = prepare(peer, points, threads)
    stepper.advance(1)
    compile_seconds = time.perf_counter() - start
    steps = steps_to_check(points)
    stepper.advance(steps - 1)
    truth = _answer(points, steps)
    error = _longest(stepper.displacement() - truth) / _longest(truth)
    return {
        "answer": error,
        # Written so that NaN is wrong too.
        "right": bool(error <= TOLERANCE),
        "wanted": f"{error:.2g} from the answer in float64 after {steps} steps, of at most {TOLERANCE:g}",
        "compile": compile_seconds,
    }


def clock(peer: str, points: int, threads: int | None = None) -> float:
    """Time a step [s]."""
    stepper = prepare(peer, points, threads)
    stepper.advance(2)
    return seconds(stepper.advance)


def launch(peer: str, points: int) -> float:
    """Time a launch of one step [s]."""
    stepper = prepare(peer, points, None)
    stepper.advance(2)

    def one_by_one(count: int) -> None:
        for _ in range(count):
            stepper.advance(1)

    return seconds(one_by_one)


def _longest(displacement: NDArray[Any]) -> float:
    return float(np.sqrt(np.einsum("ijk,ijk->ij", displacement, displacement).max()))


def _answer(points: int, steps: int) -> NDArray[Any]:
    """Take the twin's answer, once for all peers."""
    kept = CACHE / f"answer-{points}-{steps}.npy"
    if not kept.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        np.save(kept, Problem(points).answer(steps))
    return np.load(kept)
