"""The tool in a person's hand, held by force, as a probe of a scene.

Every frame adds the keys that a run needs to repeat it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

from taichi_msm.scene import Probe

# How long a hand takes from no force to the full force [s]. It lets go at once.
RISE = 0.2

# Decimal places of a control point's fractions: a millionth of the sheet.
DIGITS = 6

# This many of the last keys of a list decide what happens in the next frame, with the jump at its beginning.
LATEST = 4

Place = tuple[float, float]


class HeldTool:
    """Presses at one place at a time.

    Presses, moves and releases take effect at the next frame, at most one press or release per frame. So the force
    jumps only between frames, and it is 0 for at least one frame before the tool acts elsewhere. It has the force, the
    falloff and the offset of a probe.

    Attributes:
        strength: the percentage of the full force that a press goes up to.
        percent: the percentage of the full force that acts now, below 0 when pulling.
        place: the control point now, as fractions of the sheet.
        probe: whose tool it is.
    """

    def __init__(self, probe: Probe, rate: float) -> None:
        self.strength = 100.0
        self.probe = probe
        self._rate = rate
        self.rest()

    def rest(self) -> None:
        """Forget all that was done."""
        self.percent = 0.0
        self.place: Place = (0.5, 0.5)
        self._goal = self.place
        self._pressing = 0
        # What is still to be done: presses, each with its place and 1 to push or -1 to pull, and releases.
        self._asked: deque[tuple[Place, int] | None] = deque()
        # The percentage and the place of the last probe that was given, if there was one.
        self._given: tuple[float, Place] | None = None
        self._load: list[tuple[float, float]] = [(0.0, 0.0)]
        self._at: list[tuple[float, float, float]] = [(0.0, *self.place)]

    @property
    def goal(self) -> Place:
        """The place of the tool once all that was asked for is done."""
        return next((press[0] for press in reversed(self._asked) if press is not None), self._goal)

    @property
    def held(self) -> bool:
        """Whether the tool presses, or will press, unless it is released."""
        return self._asked[-1] is not None if self._asked else self._pressing != 0

    def ask(self, strength: float) -> None:
        """Ask for another strength."""
        self.strength = min(100.0, max(0.0, strength))

    def press(self, place: Place, direction: int) -> None:
        """Press (1) or pull (-1) at a place; the tool lets go of any other place."""
        if len(self._asked) > 1 and self._asked[-1] is None:
            # A click that has not taken effect yet, as while the session is paused, is dropped.
            self._asked.pop()
            self._asked.pop()
        if self.held:
            self.release()
        self._asked.append((on_sheet(place), direction))

    def move(self, place: Place) -> None:
        """Move to another place, in a straight line within a frame."""
        place = on_sheet(place)
        if self._asked and self._asked[-1] is not None:
            self._asked[-1] = (place, self._asked[-1][1])
        else:
            self._goal = place

    def release(self) -> None:
        """Let go."""
        self._asked.append(None)

    def follow(self, frame: int) -> Probe | None:
        """Do what was asked for, from one frame to the next.

        Gives the probe, with the keys that matter for this time; None if the last values of the one before still hold.
        """
        begin, end = frame / self._rate, (frame + 1) / self._rate
        if self._asked:
            if (press := self._asked.popleft()) is None:
                self._pressing = 0
            else:
                self._goal, self._pressing = press
                self._put(begin)
        if self._pressing == 0 and self.percent != 0:
            self.percent = 0.0
            self._load.append((begin, 0.0))
        if self._pressing != 0:
            self.percent = self._nearer(self._pressing * self.strength)
            self._put(end)
        extend(self._load, (end, self.percent))
        if self._given == (self.percent, self.place):
            return None
        self._given = self.percent, self.place
        return self._as_probe(self._load[-LATEST:], self._at[-LATEST:], end)

    def recorded(self, frame: int) -> Probe:
        """Give the probe with all its keys up to a frame."""
        return self._as_probe(self._load, self._at, frame / self._rate)

    def _nearer(self, goal: float) -> float:
        """Come as near to a percentage as a hand can within a frame."""
        most = 100 / (RISE * self._rate)
        return goal if abs(goal - self.percent) <= most else self.percent + math.copysign(most, goal - self.percent)

    def _put(self, time: float) -> None:
        """Come to the goal at a time."""
        self.place = self._goal
        if self._at[-1][0] == time:
            self._at.pop()
        extend(self._at, (time, *self.place))

    def _as_probe(
        self, load: Sequence[tuple[float, float]], at: Sequence[tuple[float, float, float]], end: float
    ) -> Probe:
        """Make a probe whose control point has at least two keys, as the kernel is compiled for one that moves."""
        if len(at) == 1:
            at = [*at, (max(end, 1 / self._rate), *at[0][1:])]
        return self.probe.model_copy(update={"load": tuple(load), "at": tuple(at)})


def extend(keys: list[Any], key: tuple[float, ...]) -> None:
    """Add a key; if it and the two before differ only in time, the middle one is dropped, which changes no bit."""
    if len(keys) > 1 and keys[-1][1:] == keys[-2][1:] == key[1:]:
        keys.pop()
    keys.append(key)


def on_sheet(place: Place) -> Place:
    """Limit a place to the sheet, and round it to the digits that a scene file gets."""
    across, down = (round(min(1.0, max(0.0, fraction)), DIGITS) for fraction in place)
    return across, down
