"""Tools of a live session, force-controlled or position-controlled; their keyframes repeat the session as a scene."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from taichi_msm.model.geometry import Rest
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tool_force import control_points
from taichi_msm.model.tools import SolidTool, build_tools, overlap, solid_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Instrument, Probe
from taichi_msm.shapes import SHAPES

# Time in which the force rises from 0 to full, or the tip moves from its highest to its deepest position [s].
RISE_TIME_S = 0.2

# Number of last keyframes that determine a frame, even with a jump at its beginning.
ACTIVE_KEYFRAMES = 4

# Height of an idle tip above the sheet at rest [tip radii].
HOVER_HEIGHT_RADII = 1.0

# Position on the sheet, fractions (across, down) of its size.
SheetPosition = tuple[float, float]

# Positions at which a tool may start, in order of preference.
CENTRE = 0.5, 0.5
STARTS: tuple[SheetPosition, ...] = (CENTRE, *product((0.1, 0.9), (0.1, 0.9)), *product((0.0, 1.0), (0.0, 1.0)))


def clear_start(probe: Probe, scene_probes: Sequence[Probe], scene: Scene) -> SheetPosition:
    """Return the first of `STARTS` on the sheet at which an idle tool intersects no tool of `scene_probes`.

    Otherwise it is the first one on the sheet, or else the middle of the cell nearest to the centre.
    """
    rest = rest_of(scene.sheet)
    starts = tuple(start for start in STARTS if rest.covers(np.array([start]))[0]) or (_central_cell(rest),)
    if probe.instrument is None:
        return starts[0]
    others = [_capsule(each, scene.sheet) for each in scene_probes if each.instrument is not None]
    for start in starts:
        hovering = Probe(path=((0.0, *start, _hover_height(probe.instrument)),), instrument=probe.instrument)
        if all(overlap((_capsule(hovering, scene.sheet), each), scene.time.duration) is None for each in others):
            return start
    return starts[0]


def _central_cell(rest: Rest) -> SheetPosition:
    cells = rest.present
    middles = rest.sheet_places((np.argwhere(cells)[:, ::-1] + 0.5) / cells.shape[::-1])
    across, down = middles[np.abs(middles - CENTRE).max(axis=1).argmin()].tolist()
    return on_sheet((across, down))


def _capsule(probe: Probe, sheet: Sheet) -> SolidTool:
    """Build a capsule with the motion of a probe's instrument; a force-controlled one stays on the sheet at rest."""
    assert probe.instrument is not None
    capsule, path = (
        probe.instrument.model_copy(update={"radius": probe.instrument.outer_radius, "plate": None}),
        probe.path,
    )
    if path is None:
        times, points = control_points(probe, sheet)
        path = tuple((time, *at, 0.0) for time, at in zip(times, rest_of(sheet).fractions(points), strict=True))
    # A copy, because control points may jump.
    moved = Probe(path=((0.0, *CENTRE, 0.0),), instrument=capsule).model_copy(update={"path": path})
    (tool,) = solid_tools(build_tools([moved], sheet)).values()
    return tool


def _hover_height(instrument: Instrument) -> float:
    return _round_height(HOVER_HEIGHT_RADII * instrument.outer_radius)


def _round_height(height: float) -> float:
    """Round a height to the nine significant digits of a scene file."""
    return float(f"{height:.9g}")


class ForceControlledTool:
    """A tool that presses at one control point at a time, with the force, falloff and offset of a probe.

    A frame applies at most one press or release, and the others wait: the force is 0 for at least a frame before the
    tool acts at another position. It rises within `RISE_TIME_S`, and drops to 0 at a release. On a sheet with a mask,
    it stays on the sheet; only between two presses it jumps over holes.
    """

    def __init__(
        self, probe: Probe, frame_rate: float, start: SheetPosition = CENTRE, rest: Rest | None = None
    ) -> None:
        self.strength = 100.0  # force of a press [% of the full force]
        self.probe = probe
        self._frame_rate, self._start, self._rest = frame_rate, start, rest
        self.reset()

    def reset(self) -> None:
        """Discard the recorded keyframes and the pending actions."""
        self.percent = 0.0  # current force [% of the full force]; negative when pulling
        self.position = self._start
        self._target = self.position
        self._direction = 0
        # Presses, with position and direction (1 to push, -1 to pull), and releases (None).
        self._pending: deque[tuple[SheetPosition, int] | None] = deque()
        self._load: list[tuple[float, float]] = [(0.0, 0.0)]
        self._at: list[tuple[float, float, float]] = [(0.0, *self.position)]

    @property
    def target(self) -> SheetPosition:
        """Position after all pending actions."""
        return next((press[0] for press in reversed(self._pending) if press is not None), self._target)

    @property
    def engaged(self) -> bool:
        """Whether the tool presses after all pending actions."""
        return self._pending[-1] is not None if self._pending else self._direction != 0

    def set_strength(self, strength: float) -> None:
        """Set the force of a press [% of the full force], clamped to 0 to 100."""
        self.strength = min(100.0, max(0.0, strength))

    def press(self, position: SheetPosition, direction: int) -> None:
        """Press in direction 1, pull in direction -1; an engaged tool is released first."""
        if len(self._pending) > 1 and self._pending[-1] is None:
            # Discard a pending click, such as one in a paused session.
            self._pending.pop()
            self._pending.pop()
        if self.engaged:
            self.release()
        self._pending.append((on_sheet(position), direction))

    def move(self, position: SheetPosition) -> None:
        """Move to another position, in a straight line within a frame; stay if the line leaves the sheet."""
        position = on_sheet(position)
        press = self._pending[-1] if self._pending else None
        if self._has_gap(position if press else self.position, position):
            return
        if press:
            self._pending[-1] = (position, press[1])
        else:
            self._target = position

    def release(self) -> None:
        """Release the tissue."""
        self._pending.append(None)

    def advance(self, frame: int) -> Probe:
        """Apply the next pending action from a frame on; return the probe of the interval for `Simulation.steer`."""
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
            limit = 100 / (RISE_TIME_S * self._frame_rate)
            target = self._direction * self.strength
            change = target - self.percent
            self.percent = target if abs(change) <= limit else self.percent + math.copysign(limit, change)
            self._move_to_target(end)
        _append_keyframe(self._load, (end, self.percent))
        at = self._at[-ACTIVE_KEYFRAMES:]
        jumps = [n for n in range(1, len(at)) if at[n][0] == at[n - 1][0]]
        return self._as_probe(self._load[-ACTIVE_KEYFRAMES:], at[max(jumps, default=0) :], end)

    def recorded_probe(self, frame: int) -> Probe:
        """Return the probe with all keyframes up to a frame."""
        return self._as_probe(self._load, self._at, frame / self._frame_rate)

    def _move_to_target(self, time: float) -> None:
        self.position = self._target
        if self._at[-1][0] == time:
            self._at.pop()
        if self._at and self._has_gap(self._at[-1][1:], self.position):
            _append_keyframe(self._at, (time, *self._at[-1][1:]))
        _append_keyframe(self._at, (time, *self.position))

    def _has_gap(self, start: tuple[float, ...], end: SheetPosition) -> bool:
        """Return whether a straight line leaves the sheet."""
        return self._rest is not None and self._rest.first_gap(np.array(start), np.array(end)) is not None

    def _as_probe(
        self, load: Sequence[tuple[float, float]], at: Sequence[tuple[float, float, float]], end: float
    ) -> Probe:
        """Build a probe with at least two control points, as the kernel is compiled for a moving one."""
        if len(at) == 1:
            at = [*at, (max(end, 1 / self._frame_rate), *at[0][1:])]
        return self.probe.model_copy(update={"load": tuple(load), "at": tuple(at)})


def _append_keyframe(keys: list[Any], key: tuple[float, ...]) -> None:
    """Append a keyframe (time [s], values...), and remove the middle one of three with equal values."""
    if len(keys) > 1 and keys[-1][1:] == keys[-2][1:] == key[1:]:
        keys.pop()
    keys.append(key)


def on_sheet(position: SheetPosition) -> SheetPosition:
    """Clamp a position to the sheet, and round it to the six decimals of a scene file."""
    across, down = (round(min(1.0, max(0.0, fraction)), 6) for fraction in position)
    return across, down


# Largest depth of the tip and height of a grip [tip radii]; also limited to a quarter of the sheet's shorter side.
MAX_DEPTH_RADII = 5.0

# Coefficient of Coulomb friction of probes without one.
DEFAULT_FRICTION = 0.5

# Interval of a grip before the start [s], which has no effect; with it, the kernel is compiled with grips.
NO_GRIP = (-2.0, -1.0)


class PositionControlledTool:
    """A tool whose tip follows the pointer: at a given depth during a press, otherwise above the sheet.

    Between frames the tip moves in a straight line, up and down within `RISE_TIME_S`, and by at most the stride of its
    shape per step. A grip begins when the tip reaches its depth, and ends with the release. A friction of the probe
    other than rough is 0 in quasi-static sessions.
    """

    def __init__(self, probe: Probe, plan: Plan, start: SheetPosition = CENTRE) -> None:
        assert probe.instrument is not None
        self.grid, self._sheet, self._radius = plan.grid, plan.scene.sheet, probe.instrument.outer_radius
        self._max_stride = SHAPES[probe.instrument.shape].max_stride * self._radius
        self._max_depth = min(MAX_DEPTH_RADII * self._radius, 0.25 * min(rest_of(self._sheet).sides))
        self._start, self._hover_height = start, _hover_height(probe.instrument)
        friction = probe.friction if "friction" in probe.model_fields_set else DEFAULT_FRICTION
        if plan.scene.time.at_rest and friction != "rough":
            friction = 0.0
        self._probe = Probe(path=((0.0, *start, self._hover_height),), friction=friction, instrument=probe.instrument)
        # Depth of a press [% of the largest depth], negative to lift a grip; initially the radius of the tip.
        self.strength = min(100.0, 100 * self._radius / self._max_depth)
        self._press_strength = self.strength
        self.reset()

    def reset(self) -> None:
        """Discard the recorded keyframes, and return to the initial position."""
        self.position = self.target = self._start
        self.height = self._hover_height  # of the lowest point of the tip above the sheet at rest [m]
        self.engaged = self._grip_requested = False
        # Start of the current grip, and intervals of earlier grips [s].
        self._grip_start: float | None = None
        self._grips: list[tuple[float, float]] = []
        self._path: list[tuple[float, float, float, float]] = [(0.0, *self.position, self.height)]

    @property
    def depth(self) -> float:
        """Depth of a press [m]; negative to lift a grip."""
        return self._max_depth * self.strength / 100

    @property
    def gripping(self) -> bool:
        """Whether a grip is active."""
        return self._grip_start is not None

    def set_strength(self, strength: float) -> None:
        """Set the depth of a press [% of the largest depth], clamped to 0 to 100, or -100 to 100 during a grip."""
        self.strength = min(100.0, max(-100.0 if self._grip_requested else 0.0, strength))

    def press(self, position: SheetPosition, direction: int) -> None:
        """Press in direction 1, grip in direction -1."""
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
        """Move the tip from a frame on; return the probe of the interval for `Simulation.steer`."""
        begin, end = self._time(frame), self._time(frame + 1)
        if self._grip_start is not None and not self._grip_requested:
            self._grips.append((self._grip_start, begin))
            self._grip_start = None
        elif self._grip_requested and self._grip_start is None and self.height == self._target_height:
            self._grip_start = begin
        self._move_tip(begin, end)
        key = end, *self.position, self.height
        _append_keyframe(self._path, key)
        # An active grip has no end yet: take one after any session.
        grip = NO_GRIP if self._grip_start is None else (self._grip_start, self._grip_start + 1e9)
        return self._probe.model_copy(update={"path": (key,), "grip": (grip,)})

    def recorded_probe(self, frame: int) -> Probe:
        """Return the probe with all keyframes up to a frame."""
        grips = [*self._grips, *([] if self._grip_start is None else [(self._grip_start, self._time(frame))])]
        return self._probe.model_copy(update={"path": tuple(self._path), "grip": tuple(grips) or (NO_GRIP,)})

    @property
    def _target_height(self) -> float:
        return _round_height(0.0 - self.depth) if self.engaged else self._hover_height

    def _move_tip(self, begin: float, end: float) -> None:
        """Move the tip towards its target between two times [s], by at most the stride of its shape per step."""
        max_rise = (HOVER_HEIGHT_RADII * self._radius + self._max_depth) / (RISE_TIME_S * self.grid.frames_per_second)
        rise = self._target_height - self.height
        goal = self._target_height if abs(rise) <= max_rise else self.height + math.copysign(max_rise, rise)
        start, (across, down), (to_across, to_down) = (begin, *self.position, self.height), self.position, self.target
        fraction, position, height = 1.0, self.target, _round_height(goal)
        while (stride := self._stride(start, (end, *position, height))) > self._max_stride:
            # The margin of 2 % allows for rounded positions.
            fraction *= 0.98 * self._max_stride / stride
            position = on_sheet((across + fraction * (to_across - across), down + fraction * (to_down - down)))
            height = _round_height(self.height + fraction * (goal - self.height))
        self.position, self.height = position, height

    def _stride(self, *path: tuple[float, float, float, float]) -> float:
        """Return the largest displacement of the tip in a step of a path [m]."""
        (tool,) = build_tools([self._probe.model_copy(update={"path": path})], self._sheet)
        return tool.max_stride(self.grid.step)[0]

    def _time(self, frame: int) -> float:
        """Return the time of a frame [s], bit-identical to its step, so that the tip is exactly at the keyframe."""
        return self.grid.time(frame * self.grid.steps_per_frame)
