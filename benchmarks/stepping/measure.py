"""Measurements of a stepper: correctness, and time of a step."""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clock import seconds
from benchmarks.process import CACHE
from benchmarks.stepping.problem import Problem, Stepper

# Largest error of any point, relative to the largest displacement. In f32 rounding is about 1e-6 of it; a missing
# spring or a wrong first step is far more.
TOLERANCE = 1e-4


def steps_to_check(points: int) -> int:
    """Return the number of steps to compare: the reference is slow for large sheets."""
    return 200 if points <= 101 else 20 if points <= 1024 else 2


def prepare(peer: str, points: int, threads: int | None) -> Stepper:
    """Set up a peer."""
    return importlib.import_module(peer).prepare(Problem(points), threads)


def check(peer: str, points: int, threads: int | None = None) -> dict[str, Any]:
    """Compare a peer with the reference, and time its start."""
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
        # False for NaN.
        "correct": bool(error <= TOLERANCE),
        "wanted": f"{error:.2g} from the answer in float64 after {steps} steps, of at most {TOLERANCE:g}",
        "compile": compile_seconds,
    }


def clock(peer: str, points: int, threads: int | None = None) -> float:
    """Return the time of a step [s]."""
    stepper = prepare(peer, points, threads)
    stepper.advance(2)
    return seconds(stepper.advance)


def launch(peer: str, points: int) -> float:
    """Return the time of a launch of one step [s]."""
    stepper = prepare(peer, points, None)
    stepper.advance(2)

    def one_by_one(count: int) -> None:
        for _ in range(count):
            stepper.advance(1)

    return seconds(one_by_one)


def _longest(displacement: NDArray[Any]) -> float:
    return float(np.sqrt(np.einsum("ijk,ijk->ij", displacement, displacement).max()))


def _answer(points: int, steps: int) -> NDArray[Any]:
    """Return the reference's displacements, computed once for all peers."""
    cached = CACHE / f"answer-{points}-{steps}.npy"
    if not cached.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        np.save(cached, Problem(points).answer(steps))
    return np.load(cached)
