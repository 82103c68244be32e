"""State of the peers that step in place: u_n and u_{n-1}, in two alternating buffers."""

from __future__ import annotations

import numpy as np

from benchmarks.stepping.problem import Array


class Planes:
    """A sheet of n x n mass points at rest."""

    def __init__(self, points: int) -> None:
        self._now, self._before = (np.zeros((3, points, points), np.float32) for _ in range(2))
        self._done = 0

    def _count(self, steps: int) -> None:
        """Count steps, each of which overwrote the older of the two."""
        self._done += steps
        if steps % 2:
            self._now, self._before = self._before, self._now

    def displacement(self) -> Array:
        """Return the displacements [m], shape (n, n, 3)."""
        return np.moveaxis(self._now, 0, -1)
