"""Timing of repeatable work."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

# Samples per process, whose median counts in a round.
SAMPLES = 3

# Duration of a sample, and of work that is timed once [s].
SAMPLE_S, SLOW_S = 0.2, 2.0


def seconds(work: Callable[[int], object], longest: int = 1 << 20) -> float:
    """Return the median time of one repetition of compiled, warm work [s].

    Args:
        work: takes the number of repetitions.
        longest: most repetitions of a call.
    """
    count, took = 1, _once(work, 1)
    while took < SAMPLE_S / 4 and count < longest:
        count = min(longest, 4 * count)
        took = _once(work, count)
    if took > SLOW_S:
        return took
    count = max(1, min(longest, round(count * SAMPLE_S / took)))
    return statistics.median(_once(work, count) / count for _ in range(SAMPLES))


def in_turn(works: Mapping[str, Callable[[], object]], rounds: int, repetitions: int = 1) -> dict[str, list[float]]:
    """Return times of works, measured in turn, per repetition [s]; a first round, which compiles, does not count."""
    samples: dict[str, list[float]] = {name: [] for name in works}
    for number in range(1 + rounds):
        for name, work in works.items():
            start = time.perf_counter()
            for _ in range(repetitions):
                work()
            if number:
                samples[name].append((time.perf_counter() - start) / repetitions)
    return samples


def _once(work: Callable[[int], object], count: int) -> float:
    start = time.perf_counter()
    work(count)
    return time.perf_counter() - start
