"""The tool of a live session, as a probe of a scene: force-controlled, or position-controlled.

Every frame adds the keyframes that a run needs to repeat the session.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import MAX_STRIDE_RADII
from taichi_msm.scene.tools import Probe

# Time in which the tool goes from no force to the full force, or from the highest to the deepest position [s].
RISE_TIME_S = 0.2

# Number of last keyframes that determine the next frame, with the jump at its beginning.
LATEST = 4

# A position on the sheet, as fractions (across, down) of its size.
SheetPosition = tuple[float, float]


class ForceControlledTool:
    """A tool that presses at one position at a time, with the force, the falloff and the offset of a probe.

    Presses, moves and releases take effect at the next frame, at most one press or release per frame. So the force
    jumps only between frames, and it is 0 for at least one frame before the tool acts at another position. The force
    rises within `RISE_TIME_S` and falls to 0 at once.

    Args:
        probe: has the force, the falloff and the offset of the tool.
        frame_rate: frames per second of the session.

    Attributes:
        strength: force of a press [% of the full force].
        percent: current force [% of the full force]; negative when pulling.
        position: current control point.
        probe: as given.
    """

    def __init__(self, probe: Probe, frame_rate: float) -> None:
        self.strength = 100.0
        self.probe = probe
        self._frame_rate = frame_rate
        self.reset()

    def reset(self) -> None:
        """Discard the recorded keyframes and the pending actions."""
        self.percent = 0.0
        self.position: SheetPosition = (0.5, 0.5)
        self._target = self.position
        self._direction = 0
        # Pending actions: presses, with position and direction (1 to push, -1 to pull), and releases (None).
        self._pending: deque[tuple[SheetPosition, int] | None] = deque()
        # Percentage and position of the last returned probe.
        self._last_returned: tuple[float, SheetPosition] | None = None
        self._load: list[tuple[float, float]] = [(0.0, 0.0)]
        self._at: list[tuple[float, float, float]] = [(0.0, *self.position)]

    @property
    def target(self) -> SheetPosition:
        """The position of the tool after all pending actions."""
        return next((press[0] for press in reversed(self._pending) if press is not None), self._target)

    @property
    def engaged(self) -> bool:
        """Whether the tool presses after all pending actions."""
        return self._pending[-1] is not None if self._pending else self._direction != 0

    def set_strength(self, strength: float) -> None:
        """Set the force of a press [% of the full force], limited to 0 to 100."""
        self.strength = min(100.0, max(0.0, strength))

    def press(self, position: SheetPosition, direction: int) -> None:
        """Press or pull, after a release at another position.

        Args:
            position: where to press.
            direction: 1 to press, -1 to pull.
        """
        if len(self._pending) > 1 and self._pending[-1] is None:
            # A click that has not taken effect yet, such as in a paused session, is discarded.
            self._pending.pop()
            self._pending.pop()
        if self.engaged:
            self.release()
        self._pending.append((on_sheet(position), direction))

    def move(self, position: SheetPosition) -> None:
        """Move to another position, in a straight line within a frame."""
        position = on_sheet(position)
        if self._pending and self._pending[-1] is not None:
            self._pending[-1] = (position, self._pending[-1][1])
        else:
            self._target = position

    def release(self) -> None:
        """Release the tissue."""
        self._pending.append(None)

    def advance(self, frame: int) -> Probe | None:
        """Apply the pending action for a frame.

        Args:
            frame: number of the frame at which the step begins.

        Returns:
            The probe with the keyframes that affect this frame, or None if the probe has not changed.
        """
        begin, end = frame / self._frame_rate, (frame + 1) / self._frame_rate
        if self._pending:
            if (press := self._pending.popleft()) is None:
                self._direction = 0
            else:
                self._target, self._direction = press
                self._move_to_target(begin)
        if self._direction == 0 and self.percent != 0:
            self.percent = 0.0
            self._load.append((begin, 0.0))
        if self._direction != 0:
            self.percent = self._approach(self._direction * self.strength)
            self._move_to_target(end)
        extend(self._load, (end, self.percent))
        if self._last_returned == (self.percent, self.position):
            return None
        self._last_returned = self.percent, self.position
        return self._as_probe(self._load[-LATEST:], self._at[-LATEST:], end)

    def recorded_probe(self, frame: int) -> Probe:
        """Return the probe with all keyframes up to a frame."""
        return self._as_probe(self._load, self._at, frame / self._frame_rate)

    def _approach(self, target: float) -> float:
        """Return the percentage after a frame in which the force rises towards a target."""
        limit = 100 / (RISE_TIME_S * self._frame_rate)
        change = target - self.percent
        return target if abs(change) <= limit else self.percent + math.copysign(limit, change)

    def _move_to_target(self, time: float) -> None:
        """Add a keyframe at the target."""
        self.position = self._target
        if self._at[-1][0] == time:
            self._at.pop()
        extend(self._at, (time, *self.position))

    def _as_probe(
        self, load: Sequence[tuple[float, float]], at: Sequence[tuple[float, float, float]], end: float
    ) -> Probe:
        """Build a probe whose control point has at least two keyframes, as the kernel is compiled for a moving one."""
        if len(at) == 1:
            at = [*at, (max(end, 1 / self._frame_rate), *at[0][1:])]
        return self.probe.model_copy(update={"load": tuple(load), "at": tuple(at)})


def extend(keys: list[Any], key: tuple[float, ...]) -> None:
    """Append a keyframe; of three keyframes with equal values the middle one is removed, which changes no result.

    Args:
        keys: keyframes, each a time [s] followed by values.
        key: the new keyframe.
    """
    if len(keys) > 1 and keys[-1][1:] == keys[-2][1:] == key[1:]:
        keys.pop()
    keys.append(key)


def on_sheet(position: SheetPosition) -> SheetPosition:
    """Limit a position to the sheet, and round it to the six decimal places of a scene file."""
    across, down = (round(min(1.0, max(0.0, fraction)), 6) for fraction in position)
    return across, down


# Height of the tip above the sheet at rest while it does not press [tip radii].
HOVER_RADII = 1.0

# Largest depth of the tip, and largest height of a grip [tip radii]. Both are also limited to a quarter of the sheet's
# shorter side.
MAX_DEPTH_RADII = 5.0

# Coefficient of Coulomb friction, if the scene has none.
DEFAULT_FRICTION = 0.5

# A grip interval before the start, which has no effect; with it the kernel is compiled for grips.
NO_GRIP = (-2.0, -1.0)

PathKey = tuple[float, float, float, float]


class PositionControlledTool:
    """A tool whose tip follows the pointer: above the sheet, or at a chosen depth while it presses.

    Between frames the tip moves in straight lines, down and up within `RISE_TIME_S`, and in a step never farther than a
    run allows. A grip begins when the tip has reached its depth, and ends with the release.

    Args:
        probe: has the instrument, and may have a path; its friction is used if it is set, except in equilibrium.
        plan: of the session.

    Attributes:
        strength: depth of a press [% of the largest depth]; negative to lift a grip.
        height: current height of the lowest point of the tip above the sheet at rest [m].
        position: current position of the tip.
        target: position to which the tip moves.
        engaged: whether the tool presses or grips.
    """

    def __init__(self, probe: Probe, plan: Plan) -> None:
        assert probe.instrument is not None
        self._grid, self._sheet, self._radius = plan.grid, plan.scene.sheet, probe.instrument.radius
        self._max_depth = min(MAX_DEPTH_RADII * self._radius, 0.25 * min(self._sheet.size))
        self._hover_height = _rounded(HOVER_RADII * self._radius)
        friction = probe.friction if "friction" in probe.model_fields_set else DEFAULT_FRICTION
        if plan.scene.time.at_rest:
            friction = 0.0
        self._probe = Probe(path=((0.0, 0.5, 0.5, self._hover_height),), friction=friction, instrument=probe.instrument)
        # The default depth of a press is the radius of the tip.
        self.strength = min(100.0, 100 * self._radius / self._max_depth)
        self._press_strength = self.strength
        self.reset()

    def reset(self) -> None:
        """Discard the recorded keyframes, and return to the initial position."""
        self.position: SheetPosition = (0.5, 0.5)
        self.target = self.position
        self.height = self._hover_height
        self.engaged = self._grip_requested = False
        # Start of the current grip, and intervals of earlier grips [s].
        self._grip_start: float | None = None
        self._grips: list[tuple[float, float]] = []
        self._path: list[PathKey] = [(0.0, *self.position, self.height)]

    @property
    def depth(self) -> float:
        """The depth of a press [m]; negative to lift a grip."""
        return self._max_depth * self.strength / 100

    @property
    def percent(self) -> float:
        """The current depth of the tip [% of the largest depth]; negative above the sheet."""
        return -100 * self.height / self._max_depth

    @property
    def gripping(self) -> bool:
        """Whether a grip is active."""
        return self._grip_start is not None

    def set_strength(self, strength: float) -> None:
        """Set the depth of a press [% of the largest depth], limited to 0 to 100, or to -100 to 100 during a grip."""
        self.strength = min(100.0, max(-100.0 if self._grip_requested else 0.0, strength))

    def press(self, position: SheetPosition, direction: int) -> None:
        """Press or grip.

        Args:
            position: where to press.
            direction: 1 to press, -1 to grip.
        """
        self.release()
        self.engaged, self._grip_requested, self._press_strength = True, direction < 0, self.strength
        self.move(position)

    def move(self, position: SheetPosition) -> None:
        """Move to another position."""
        self.target = on_sheet(position)

    def release(self) -> None:
        """Release the tissue, and rise."""
        if self._grip_requested:
            # The height of a lifted grip must not become the depth of the next press.
            self.strength = self._press_strength
        self.engaged = self._grip_requested = False

    def advance(self, frame: int) -> Probe:
        """Move the tip for a frame.

        Args:
            frame: number of the frame at which the step begins.

        Returns:
            The probe for `Simulation.steer`.
        """
        begin, end = self._time(frame), self._time(frame + 1)
        if self._grip_start is not None and not self._grip_requested:
            self._grips.append((self._grip_start, begin))
            self._grip_start = None
        elif self._grip_requested and self._grip_start is None and self.height == self._target_height:
            self._grip_start = begin
        self._move_tip()
        key = end, *self.position, self.height
        extend(self._path, key)
        # The end of an active grip is not known yet, so it is later than the end of any session.
        grip = NO_GRIP if self._grip_start is None else (self._grip_start, self._grip_start + 1e9)
        return self._probe.model_copy(update={"path": (key,), "grip": (grip,)})

    def recorded_probe(self, frame: int) -> Probe:
        """Return the probe with all keyframes up to a frame."""
        grips = [*self._grips, *([] if self._grip_start is None else [(self._grip_start, self._time(frame))])]
        return self._probe.model_copy(update={"path": tuple(self._path), "grip": tuple(grips) or (NO_GRIP,)})

    @property
    def _target_height(self) -> float:
        return _rounded(0.0 - self.depth) if self.engaged else self._hover_height

    def _move_tip(self) -> None:
        """Move the tip towards its target, within the limits of a frame."""
        max_rise = (HOVER_RADII * self._radius + self._max_depth) / (RISE_TIME_S * self._grid.frames_per_second)
        rise = self._target_height - self.height
        goal = self._target_height if abs(rise) <= max_rise else self.height + math.copysign(max_rise, rise)
        (across, down), (to_across, to_down), (height, width) = self.position, self.target, self._sheet.size
        distance = math.hypot((to_across - across) * width, (to_down - down) * height, goal - self.height)
        # A margin of 2 % allows for the rounding of positions.
        max_distance = 0.98 * MAX_STRIDE_RADII * self._radius * self._grid.steps_per_frame
        fraction = min(1.0, max_distance / distance) if distance > 0 else 1.0
        if fraction < 1:
            self.position = on_sheet((across + fraction * (to_across - across), down + fraction * (to_down - down)))
            self.height = _rounded(self.height + fraction * (goal - self.height))
        else:
            self.position, self.height = self.target, _rounded(goal)

    def _time(self, frame: int) -> float:
        """Return the time of a frame [s], with the bits of the time of its step, so the tip is exactly at its key."""
        return self._grid.time(frame * self._grid.steps_per_frame)


def _rounded(height: float) -> float:
    """Round a height to the nine significant digits of a scene file."""
    return float(f"{height:.9g}")
