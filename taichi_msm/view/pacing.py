"""Real time of a session: when its next frames are due, and the speed that is reached."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

# Longer delays are not caught up [s].
MAX_DELAY_S = 0.1

# After this time of stepping the next picture follows, although frames are due [s].
MAX_STEPPING_S = 0.03


class Pacing:
    """Scheduler that synchronises simulated with real time.

    Args:
        rate: frames per second of the session.
        clock: returns the current time [s].
    """

    def __init__(self, rate: float, clock: Callable[[], float]) -> None:
        self._rate = rate
        self._clock = clock
        self._next = clock()
        # Start [s] and number of simulated frames of each recent picture.
        self._pictures: deque[tuple[float, int]] = deque()

    def delay_s(self) -> float:
        """Return the time until the next frame is due [s]."""
        return max(0.0, self._next - self._clock())

    def due_frames(self) -> Iterator[int]:
        """Yield the number of each due frame, until none is due or they took `MAX_STEPPING_S`."""
        start = self._clock()
        self._next = max(self._next, start - MAX_DELAY_S)
        count = 0
        while self._next <= self._clock() and (count == 0 or self._clock() < start + MAX_STEPPING_S):
            self._next += 1 / self._rate
            yield count
            count += 1
        self._pictures.append((start, count))
        # The speed is averaged over 1 s.
        while start - self._pictures[0][0] > 1.0:
            self._pictures.popleft()

    def status(self) -> str:
        """Format the pictures per second, and the speed relative to real time if it is below 95 %."""
        if len(self._pictures) < 2:
            return ""
        seconds = self._pictures[-1][0] - self._pictures[0][0]
        rate = f"{(len(self._pictures) - 1) / seconds:.0f} pictures/s"
        # The last picture is excluded, as its duration is not known yet.
        speed = sum(count for _, count in list(self._pictures)[:-1]) / self._rate / seconds
        return rate if speed >= 0.95 else f"{rate}  ·  too slow: {speed:.2f} x real time"
