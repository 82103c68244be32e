"""The clock of all measurements."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

# Samples of one process; their median is one sample of the round.
SAMPLES = 3

# A sample is long enough for the clock when it takes this [s].
LONG_ENOUGH = 0.2

# What takes longer is timed once in a process [s].
SLOW = 2.0


def seconds(work: Callable[[int], object], longest: int = 1 << 20) -> float:
    """Time a piece of work that can be repeated within one call.

    Args:
        work: does it so many times; compiled and warm.
        longest: most repetitions of a call.

    Returns:
        The median time of one repetition [s].
    """
    count, took = 1, _once(work, 1)
    while took < LONG_ENOUGH / 4 and count < longest:
        count = min(longest, 4 * count)
        took = _once(work, count)
    if took > SLOW:
        return took
    count = max(1, min(longest, round(count * LONG_ENOUGH / took)))
    return statistics.median(_once(work, count) / count for _ in range(SAMPLES))


def _once(work: Callable[[int], object], count: int) -> float:
    start = time.perf_counter()
    work(count)
    return time.perf_counter() - start
