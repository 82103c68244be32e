"""Back-off of workers that wait for each other by spinning, on a CPU that other programs use too.

After the timeout of a worker, a single worker steps for a back-off period of MIN_BACKOFF_S. If other programs compete
for the cores, the period is longer: four times the last one, halved for every HALF_LIFE_S of parallel steps since then.
"""

from __future__ import annotations

import time

from taichi_msm.system import process

# Shortest and longest back-off period, and half-life of its growth [s].
MIN_BACKOFF_S, MAX_BACKOFF_S, HALF_LIFE_S = 0.002, 0.2, 0.02


class Backoff:
    """Back-off of the workers of a sheet."""

    def __init__(self) -> None:
        self._period = self._until = 0.0
        # Start of the last parallel launch, and duration of all parallel launches since the last back-off [s].
        self._start = self._parallel_s = 0.0
        # CPU time of this process, and time waited for a core, at the end of the last back-off [s].
        self._cpu_time, self._wait_time = 0.0, 0.0

    @property
    def is_active(self) -> bool:
        """Whether a back-off period lasts, in which a single worker steps."""
        return time.perf_counter() < self._until

    def start_launch(self) -> None:
        """Call before a parallel launch."""
        if self._until:
            # The measurement excludes the back-off, because a single worker rarely waits for a core.
            self._cpu_time, self._wait_time = time.process_time(), process.core_wait_s() or 0.0
            self._until = 0.0
        self._start = time.perf_counter()

    def end_launch(self, *, timed_out: bool) -> None:
        """Call after a parallel launch; begin a back-off period if a worker timed out."""
        now = time.perf_counter()
        if timed_out:
            period = 4 * self._period * 0.5 ** (self._parallel_s / HALF_LIFE_S) if self._is_crowded() else 0.0
            self._period = min(max(period, MIN_BACKOFF_S), MAX_BACKOFF_S)
            self._parallel_s, self._until = 0.0, now + self._period
        else:
            self._parallel_s += now - self._start

    def _is_crowded(self) -> bool:
        """Return whether threads have waited for a core for 20 % of their CPU time or longer; True if unknown."""
        cpu_time, wait_time = time.process_time(), process.core_wait_s()
        return wait_time is None or wait_time - self._wait_time > 0.2 * (cpu_time - self._cpu_time)
