"""The tool in a person's hand, held by force, as a probe of a scene.

Every frame adds the keys that a run needs to repeat it.

The tool in a person's hand, held by position: a probe with a path, which touches, drags and grips the tissue.

Every frame adds the keys that a run needs to repeat it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import MAX_STRIDE_RADII
from taichi_msm.scene.tools import Probe

# How long a hand takes from no force to the full force [s]. It lets go at once.
RISE = 0.2

# Decimal places of a control point's fractions: a millionth of the sheet.
FRACTION_DECIMALS = 6

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
    across, down = (round(min(1.0, max(0.0, fraction)), FRACTION_DECIMALS) for fraction in place)
    return across, down


pass  # REMOVED

# While it does not press, the tip is this many times its radius above the sheet at rest.
HOVER = 1.0

# The tip goes this many times its radius deep, and lifts what it grips as high; but no farther than this share of the
# sheet's shorter side.
DEEPEST, LARGEST_SHARE = 5.0, 0.25

# A press is this many times the radius deep, unless another depth is asked for.
PRESS = 1.0

# Coulomb's coefficient, where the scene gives none.
FRICTION = 0.5

# The tip moves by at most this share of what a run allows, as its places are rounded.
MARGIN = 0.98

# Significant digits of a height.
HEIGHT_DIGITS = 9

# A grip that holds nothing, as it is over before the start: with it the kernel is compiled for grips.
NO_GRIP = (-2.0, -1.0)

# A grip that is on lasts longer than any session [s].
LONG = 1e9

PathKey = tuple[float, float, float, float]


class MovedTool:
    """Moves where the pointer is: above the sheet, or as deep as is asked for while it presses.

    It goes to and fro between frames in straight lines, down and up at a hand's speed, and never farther in a step than
    a run allows. A grip begins when the tip has come to its depth, and ends when it is released.

    Args:
        probe: with the instrument, and with a path or without one; its friction counts if it is given, and not at rest.
        plan: of the session.

    Attributes:
        strength: how deep a press goes, as a percentage of the greatest depth; below 0 a grip lifts.
        height: of the lowest point of the tip above the sheet at rest now [m].
        place: where the tip is now, as fractions of the sheet.
        goal: where it goes.
        held: whether it presses, or grips.
    """

    def __init__(self, probe: Probe, plan: Plan) -> None:
        assert probe.instrument is not None
        self._grid, self._sheet, self._radius = plan.grid, plan.scene.sheet, probe.instrument.radius
        self._deepest = min(DEEPEST * self._radius, LARGEST_SHARE * min(self._sheet.size))
        self._hover = _rounded(HOVER * self._radius)
        friction = probe.friction if "friction" in probe.model_fields_set else FRICTION
        if plan.scene.time.at_rest:
            friction = 0.0
        self._probe = Probe(path=((0.0, 0.5, 0.5, self._hover),), friction=friction, instrument=probe.instrument)
        self.strength = min(100.0, 100 * PRESS * self._radius / self._deepest)
        self._usual = self.strength
        self.rest()

    def rest(self) -> None:
        """Forget all that was done."""
        self.place: Place = (0.5, 0.5)
        self.goal = self.place
        self.height = self._hover
        self.held = self._grips = False
        # When the grip began that is on, and from when to when each earlier one was.
        self._since: float | None = None
        self._gripped: list[tuple[float, float]] = []
        self._path: list[PathKey] = [(0.0, *self.place, self.height)]

    @property
    def depth(self) -> float:
        """How deep a press goes [m]; below 0 a grip lifts."""
        return self._deepest * self.strength / 100

    @property
    def percent(self) -> float:
        """How deep the tip is now, as a percentage of the greatest depth; above the sheet it is below 0."""
        return -100 * self.height / self._deepest

    @property
    def grips(self) -> bool:
        """Whether a grip is on."""
        return self._since is not None

    def ask(self, strength: float) -> None:
        """Ask for another strength; only a grip goes above the sheet."""
        self.strength = min(100.0, max(-100.0 if self._grips else 0.0, strength))

    def press(self, place: Place, direction: int) -> None:
        """Press at a place (1), or grip what is there (-1)."""
        self.release()
        self.held, self._grips, self._usual = True, direction < 0, self.strength
        self.move(place)

    def move(self, place: Place) -> None:
        """Go to another place."""
        self.goal = on_sheet(place)

    def release(self) -> None:
        """Let go, and rise."""
        if self._grips:
            # What was lifted says nothing of how deep to press next.
            self.strength = self._usual
        self.held = self._grips = False

    def follow(self, frame: int) -> Probe:
        """Do what was asked for, from one frame to the next; gives the probe for `Simulation.steer`."""
        begin, end = self._time(frame), self._time(frame + 1)
        if self._since is not None and not self._grips:
            self._gripped.append((self._since, begin))
            self._since = None
        elif self._grips and self._since is None and self.height == self._wanted:
            self._since = begin
        self._go()
        key = end, *self.place, self.height
        extend(self._path, key)
        grip = NO_GRIP if self._since is None else (self._since, self._since + LONG)
        return self._probe.model_copy(update={"path": (key,), "grip": (grip,)})

    def recorded(self, frame: int) -> Probe:
        """Give the probe with all its keys up to a frame."""
        grips = [*self._gripped, *([] if self._since is None else [(self._since, self._time(frame))])]
        return self._probe.model_copy(update={"path": tuple(self._path), "grip": tuple(grips) or (NO_GRIP,)})

    @property
    def _wanted(self) -> float:
        """The height to go to [m]."""
        return _rounded(0.0 - self.depth) if self.held else self._hover

    def _go(self) -> None:
        """Come as near to the goal as a hand can within a frame."""
        most = (HOVER * self._radius + self._deepest) / (RISE * self._grid.frames_per_second)
        up = self._wanted - self.height
        goal = self._wanted if abs(up) <= most else self.height + math.copysign(most, up)
        (across, down), (to_across, to_down), (height, width) = self.place, self.goal, self._sheet.size
        way = math.hypot((to_across - across) * width, (to_down - down) * height, goal - self.height)
        longest = MARGIN * MAX_STRIDE_RADII * self._radius * self._grid.steps_per_frame
        share = min(1.0, longest / way) if way > 0 else 1.0
        if share < 1:
            self.place = on_sheet((across + share * (to_across - across), down + share * (to_down - down)))
            self.height = _rounded(self.height + share * (goal - self.height))
        else:
            self.place, self.height = self.goal, _rounded(goal)

    def _time(self, frame: int) -> float:
        """Tell the time of a frame as that of its step, to the bit: the tip is then exactly at its key [s]."""
        return self._grid.time(frame * self._grid.steps_per_frame)


def _rounded(height: float) -> float:
    """Round a height to the digits that a scene file gets."""
    return float(f"{height:.{HEIGHT_DIGITS}g}")
