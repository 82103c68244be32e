"""Size of the picture of a page: that of its screen, if the machine is fast enough."""

from __future__ import annotations

import math
import statistics
from collections import deque

# Smallest number of pictures per second for which pictures are drawn larger than the scene's.
MIN_RATE = 30.0

# Largest number of pixels of a picture, unless the scene's is larger.
MAX_PIXELS = 4e6

# Number of sizes between that of the scene and that of the screen, and of pictures that are measured at each.
LEVELS, MEASURED = 4, 9

# Share of the time for a picture that a larger one may be expected to take, so that sizes do not alternate.
CAUTION = 0.7


class Resolution:
    """Size of a page's picture with the aspect of the scene's (width, height) [px], at least that size."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size, self._factor, self._level = size, 1.0, 0
        # Durations of the last pictures [s/px].
        self._costs: deque[float] = deque(maxlen=MEASURED)

    def set_width(self, pixels: float) -> None:
        """Set the width of the picture on the screen [px]."""
        width, height = self._size
        self._factor = max(1.0, min(pixels / width, math.sqrt(MAX_PIXELS / (width * height))))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the next picture [px]."""
        return self._size_at(self._level)

    def _size_at(self, level: int) -> tuple[int, int]:
        factor = 1 + (self._factor - 1) * level / LEVELS
        return round(factor * self._size[0]), round(factor * self._size[1])

    def measure(self, seconds: float, load: float) -> None:
        """Adapt the size to the duration of a picture; `load` is the time of stepping per simulated time."""
        self._costs.append(seconds / math.prod(self.size))
        if len(self._costs) < MEASURED:
            return
        # The median ignores a picture for which a kernel was compiled.
        cost, limit = statistics.median(self._costs), (1 - load) / MIN_RATE
        if cost * math.prod(self.size) > limit:
            level = max(0, self._level - 1)
        elif cost * math.prod(self._size_at(min(LEVELS, self._level + 1))) < CAUTION * limit:
            level = min(LEVELS, self._level + 1)
        else:
            return
        if level != self._level:
            self._level = level
            self._costs.clear()
