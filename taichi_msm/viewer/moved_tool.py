"""The tool in a person's hand, held by position: a probe with a path, which touches, drags and grips the tissue.

Every frame adds the keys that a run needs to repeat it.
"""

from __future__ import annotations

import math

from taichi_msm.physics.paths import LARGEST_STRIDE
from taichi_msm.physics.plan import Plan
from taichi_msm.scene import Probe
from taichi_msm.viewer.held_tool import RISE, Place, extend, on_sheet

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
DIGITS = 9

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
        longest = MARGIN * LARGEST_STRIDE * self._radius * self._grid.steps_per_frame
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
    return float(f"{height:.{DIGITS}g}")
