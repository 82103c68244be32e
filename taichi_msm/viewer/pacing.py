"""Real time: how many frames are due, and what to say when the machine cannot keep up."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

# A delay beyond this is not made up for; and no picture waits longer than this for its frames [s].
LONGEST = 0.1

# The speed is averaged over this time [s].
OBSERVED = 1.0

# Below this share of real time the speed is reported as too slow.
SLOW = 0.95


class Pacing:
    """Decides how many frames to simulate before the next picture, so that simulated time keeps up with real time.

    Args:
        rate: frames per second.
        clock: returns the time [s].
    """

    def __init__(self, rate: float, clock: Callable[[], float]) -> None:
        self._rate = rate
        self._clock = clock
        self._next = clock()
        # For each of the last pictures, when it began and how many frames were simulated for it.
        self._pictures: deque[tuple[float, int]] = deque()

    def wait(self) -> float:
        """Tell how long it is until the next frame is due [s]."""
        return max(0.0, self._next - self._clock())

    def due(self) -> Iterator[int]:
        """Count the frames that are due; ends when no more are due, or when the picture must not wait any longer."""
        begun = self._clock()
        self._next = max(self._next, begun - LONGEST)
        count = 0
        while self._next <= self._clock() and (count == 0 or self._clock() < begun + LONGEST):
            self._next += 1 / self._rate
            yield count
            count += 1
        self._pictures.append((begun, count))
        while begun - self._pictures[0][0] > OBSERVED:
            self._pictures.popleft()

    def said(self) -> str:
        """Say how many pictures are shown per second, and, if simulated time is too slow, how fast it goes."""
        if len(self._pictures) < 2:
            return ""
        seconds = self._pictures[-1][0] - self._pictures[0][0]
        shown = f"{(len(self._pictures) - 1) / seconds:.0f} pictures/s"
        # The last picture is not counted, as its time is not over.
        speed = sum(count for _, count in list(self._pictures)[:-1]) / self._rate / seconds
        return shown if speed >= SLOW else f"{shown}  ·  too slow: {speed:.2f} x real time"
