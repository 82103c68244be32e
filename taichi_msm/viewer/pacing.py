"""Real time: how many frames are due, and what to say when the machine cannot keep up."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

# Time that is behind by more than this is not made up for, and a picture waits no longer for its frames [s].
LONGEST = 0.1

# What is said of the speed is of so many seconds.
OBSERVED = 1.0

# Slower than this share of real time is said to be slow.
SLOW = 0.95


class Pacing:
    """Tells how many frames to simulate before the next picture, so that simulated time goes as fast as real time.

    Args:
        rate: frames per second.
        clock: tells the time [s].
    """

    def __init__(self, rate: float, clock: Callable[[], float]) -> None:
        self._rate = rate
        self._clock = clock
        self._next = clock()
        # When pictures began, and how many frames were simulated for each.
        self._pictures: deque[tuple[float, int]] = deque()

    def wait(self) -> float:
        """Tell how long nothing is due [s]."""
        return max(0.0, self._next - self._clock())

    def due(self) -> Iterator[int]:
        """Count the frames that are due; ends when there is none more, or when the picture must not wait longer."""
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
        """Say how many pictures there are a second, and how fast time goes where it is slow."""
        if len(self._pictures) < 2:
            return ""
        seconds = self._pictures[-1][0] - self._pictures[0][0]
        shown = f"{(len(self._pictures) - 1) / seconds:.0f} pictures/s"
        # What the last picture shows is not counted, as its time is not over.
        speed = sum(count for _, count in list(self._pictures)[:-1]) / self._rate / seconds
        return shown if speed >= SLOW else f"{shown}  ·  too slow: time goes at {speed:.2f} of real time"
