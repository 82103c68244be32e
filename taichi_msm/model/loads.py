"""The probes in time: how hard and where each presses, and whether the virtual springs act, step by step.

Step n takes the load averaged with the hat function of half-width h about t_n,

    percent_n = integral of percent(t) (1 - |t - t_n| / h) dt / h,    at n = 0 twice that over [0, h].

It moves a free point exactly as far as the load itself does, so the method keeps its order 2 for every load, wherever
it jumps. If no key lies within the hat, the average is the value at t_n. The activity of the virtual springs is
averaged in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import EDGE, Plan, ProbeSegment, ProbeSlot, probe_slots
from taichi_msm.model.sheet import area_shares, axes
from taichi_msm.model.tool_force import control_points, point_at, probe_force
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe

# A time before all others [s].
LONG_AGO = -1e300

Array = NDArray[np.float64]


class Schedule(NamedTuple):
    """The loads at consecutive steps."""

    slots: tuple[ProbeSlot, ...]  # where the probes act; the columns of the arrays
    strength: Array  # force at the control point before the decay [N], shape (steps, slots, 3)
    point: Array  # control point, x and y at rest [m], shape (steps, slots, 2)
    active: Array  # share of their stiffness with which the virtual springs act, 0 to 1; shape (steps,)


def decay(probe: Probe, sheet: Sheet, at: Array | None = None) -> Array:
    """Give the share of a probe's force that each point feels, shape (rows, cols).

    at: the control point, x and y at rest [m]; None: its first place.
    """
    acts, (at_x, at_y) = probe_force(probe, sheet), control_points(probe, sheet)[1][0] if at is None else at
    x, y = axes(sheet)
    shares = acts.decay(np.hypot(x - at_x, y - at_y))
    return shares * area_shares(sheet) if acts.by_area else shares


def decay_slope(probe: Probe, sheet: Sheet, at: Array | None = None) -> Array:
    """Differentiate `decay` by x and y of the control point [1/m], shape (2, rows, cols); at its tip, 0."""
    acts, (at_x, at_y) = probe_force(probe, sheet), control_points(probe, sheet)[1][0] if at is None else at
    x, y = axes(sheet)
    off = np.stack(np.broadcast_arrays(x - at_x, y - at_y))
    distance = np.hypot(*off)
    outside = (acts.falloff * distance + acts.shift > acts.offset) & (distance > 0)
    return decay(probe, sheet, at) * acts.falloff * outside * off / np.where(outside, distance, 1)


def schedule(plan: Plan, first: int, count: int) -> Schedule:
    """Average the loads over the steps first, ..., first + count - 1 of a plan."""
    scene, parts = plan.scene, plan.slots
    t, h = np.arange(first, first + count) / plan.grid.steps_per_second, plan.grid.step
    strength, point = np.zeros((count, len(parts), 3)), np.zeros((count, len(parts), 2))
    for index in sorted({part.probe for part in parts}):
        probe, own = scene.probes[index], [n for n, part in enumerate(parts) if part.probe == index]
        turns, segments, jumps = len(own), parts[own[0]].segments, parts[own[0]].jumps
        line = _load(probe)
        if turns == 1:
            shares, places = line.averages(t, h)[:, None], np.zeros((count, 1), np.intp)
        else:
            shares, places = _by_turns(line, jumps, turns, t, h)
        strength[:, own] = np.multiply.outer(shares / 100, probe_force(probe, scene.sheet).force)
        for n, place in zip(own, places.T, strict=True):
            for number in np.unique(place):
                chosen = place == number
                point[chosen, n] = _held(segments[number], t[chosen])
    return Schedule(parts, strength, point, _activity(plan).averages(t, h))


def loads_at(plan: Plan, t: Array) -> Schedule:
    """Evaluate the loads themselves, not their averages, with one slot a probe, at times that are no keys [s]."""
    scene = plan.scene
    parts = plan.slots if scene.time.at_rest else probe_slots(scene.probes, scene.sheet, 0.0)
    strength, point = np.zeros((len(t), len(parts), 3)), np.zeros((len(t), len(parts), 2))
    for n, part in enumerate(parts):
        probe = scene.probes[part.probe]
        strength[:, n] = np.multiply.outer(_load(probe).values(t) / 100, probe_force(probe, scene.sheet).force)
        number = part.jumps.searchsorted(t, "right")
        for segment in np.unique(number):
            point[number == segment, n] = _held(part.segments[segment], t[number == segment])
    return Schedule(parts, strength, point, _activity(plan).values(t))


class FrameLoad:
    """The load of a probe at frames: the load itself, not its average.

    Attributes:
        moves: whether the control point moves.
    """

    def __init__(self, probe: Probe, sheet: Sheet) -> None:
        self._line, (self._times, self._points) = _load(probe), control_points(probe, sheet)
        self.moves = len(self._times) > 1
        self._keys = np.unique(np.concatenate([self._line.times, self._times]))

    def at(self, frame: int, rate: float) -> tuple[float, Array]:
        """Give the percent, and the control point, x and y at rest [m], at a frame; at a jump, those after it."""
        time = frame / rate
        # A key that is as good as at the frame counts as at it.
        key = float(self._keys[max(0, self._keys.searchsorted(time + FRAME_TOLERANCE / rate, "right") - 1)])
        time = key if abs(time - key) <= FRAME_TOLERANCE / rate else time
        return float(self._line.values(np.array([time]))[0]), point_at(self._times, self._points, time)


def frame_loads(plan: Plan, frame: int) -> Schedule:
    """Evaluate the loads at a frame; at a jump the later value counts.

    A key within FRAME_TOLERANCE of a frame is at it.

    Foundations that are `loaded` act where the percent of any probe is not 0, and from a path's first key to its last.
    """
    scene, rate = plan.scene, plan.grid.frames_per_second
    time = frame / rate
    near = [key for key in _every_key(scene) if abs(key - time) <= FRAME_TOLERANCE / rate]
    t = np.array([max(near, default=time)])
    loads = loads_at(plan, t)
    pressed = any(
        _load(probe).values(t)[0] != 0 if probe.path is None else probe.path[0][0] <= t[0] <= probe.path[-1][0]
        for probe in scene.probes
    )
    return loads._replace(active=np.array([float(plan.material.always or pressed)]))


def key_times(scene: Scene) -> Array:
    """List the times of all keys between 0 and the end [s]: only there the loads are not smooth."""
    times = _every_key(scene)
    return times[(times > 0) & (times < scene.time.duration)]


def _every_key(scene: Scene) -> Array:
    """List the times of all keys [s]."""
    keys: list[Any] = [[]]
    for probe in scene.probes:
        if probe.path is None:
            keys += [time for time, _ in probe.load], control_points(probe, scene.sheet)[0]
        else:
            keys += [time for time, *_ in probe.path], np.ravel(probe.grip)
    return np.unique(np.concatenate(keys))


class Envelope:
    """Bounds of the loads from one time to another."""

    def __init__(self, plan: Plan) -> None:
        scene, self._h = plan.scene, plan.grid.step
        probes = [scene.probes[slot.probe] for slot in plan.slots]
        self._lines = [_load(probe) for probe in probes]
        self._forces = [math.hypot(*probe_force(probe, scene.sheet).force) / 100 for probe in probes]
        self._activity = _activity(plan)
        self._begins = self._activity.times[self._activity.before < self._activity.after]

    def between(self, begin: float, end: float) -> tuple[Array, bool, int]:
        """Bound what the loads do in the steps from one time to another, both included.

        Returns:
            The largest force at the control point of each slot [N], shape (slots,); whether the virtual springs act at
            any time; and how many times they begin to act.
        """
        # A step depends on everything within its hat.
        begin, end = begin - self._h, end + self._h
        most = [force * line.largest(begin, end) for force, line in zip(self._forces, self._lines, strict=True)]
        begun = self._begins.searchsorted(end, "right") - self._begins.searchsorted(begin, "left")
        return np.array(most), self._activity.largest(begin, end) > 0, int(begun)


class _Line:
    """A piecewise linear function of time [s] that jumps where two keys have one time; 0 before the first key.

    After the last key it is constant.
    """

    def __init__(self, times: Array, values: Array) -> None:
        keys = np.unique(times)
        # The limits from the left and from the right at every key.
        before, after = values[times.searchsorted(keys, "left")], values[times.searchsorted(keys, "right") - 1]
        before[0] = 0.0
        # Keys that change nothing are dropped, so that they do not change the rounding either.
        last, following = np.append(0.0, after[:-1]), np.append(before[1:], after[-1])
        told = (last != before) | (before != after) | (after != following)
        told[0] = True
        self.times, self.before, self.after = keys[told], before[told], after[told]

    def values(self, t: Array) -> Array:
        """Evaluate the function; at a key, its limit from the right."""
        return self._values(t, self.times.searchsorted(t, "right"))

    def averages(self, t: Array, h: float, begin: float = -math.inf, end: float = math.inf) -> Array:
        """Average the function with the hat of half-width h about times t >= 0; it counts as 0 outside [begin, end].

        If neither a key nor begin nor end lies within the hat, the average is the value itself.
        """
        edges = [edge for edge in (begin, end) if math.isfinite(edge)]
        averages = self.values(t) * ((begin <= t) & (t < end))
        bounds = np.union1d(self.times, edges)
        # At t = 0 there is only half a hat, so that even the average of a line is not its value at t.
        uneven = (t <= 0) | (
            bounds.searchsorted(t + h * (1 - EDGE), "left") > bounds.searchsorted(t - h * (1 - EDGE), "right")
        )
        for n in np.flatnonzero(uneven):
            averages[n] = self._average(float(t[n]), h, begin, end)
        return averages

    def largest(self, begin: float, end: float) -> float:
        """Find the largest absolute value from one time to another."""
        first, last = self.times.searchsorted(begin, "left"), self.times.searchsorted(end, "right")
        ends = np.array([begin, end])
        return float(np.abs(np.concatenate([self.values(ends), self.before[first:last], self.after[first:last]])).max())

    def _values(self, t: Array, after: NDArray[np.intp]) -> Array:
        """Evaluate the function between the keys after[n] - 1 and after[n]."""
        low, high = np.maximum(after - 1, 0), np.minimum(after, len(self.times) - 1)
        span = self.times[high] - self.times[low]
        share = np.divide(t - self.times[low], span, out=np.zeros_like(t), where=span > 0)
        slope = np.where(span > 0, self.before[high] - self.after[low], 0.0)
        return np.where(after == 0, 0.0, self.after[low] + share * slope)

    def _average(self, t: float, h: float, begin: float, end: float) -> float:
        """Integrate piece by piece: on each piece hat and function are linear, so that Simpson's rule is exact."""
        low, high = max(t - h, 0.0 if t <= 0 else -math.inf, begin), min(t + h, end)
        inner = self.times[(self.times > low) & (self.times < high)]
        cuts = np.unique(np.concatenate([[low, high], inner, [t] if low < t < high else []]))
        if low >= high:
            return 0.0
        left, right = cuts[:-1], cuts[1:]
        piece = self.times.searchsorted((left + right) / 2, "right")
        ends = np.stack([self._values(left, piece), self._values(right, piece)])
        weights = 1 - np.abs(np.stack([left, right]) - t) / h
        middle = ends.sum(axis=0) * weights.sum(axis=0)
        total = float(((right - left) * ((ends * weights).sum(axis=0) + middle)).sum() / (6 * h))
        return 2 * total if t <= 0 else total


def _by_turns(line: _Line, jumps: Array, turns: int, t: Array, h: float) -> tuple[Array, NDArray[np.intp]]:
    """Share the load of a probe that jumps out among its slots: percent and index of the segment, (steps, slots)."""
    bounds = np.concatenate([[-math.inf], jumps, [math.inf]])
    first = jumps.searchsorted(t - h * (1 - EDGE), "right")
    last = jumps.searchsorted(t + h * (1 - EDGE), "left")
    shares, places = np.zeros((len(t), turns)), np.empty((len(t), turns), np.intp)
    for turn in range(turns):
        place = first + (turn - first) % turns
        acts = place <= last
        places[:, turn] = np.where(acts, place, first)
        for number in np.unique(place[acts]):
            chosen = acts & (place == number)
            shares[chosen, turn] = line.averages(t[chosen], h, bounds[number], bounds[number + 1])
    return shares, places


def _held(segment: ProbeSegment, t: Array) -> Array:
    """Interpolate a control point, constant before and after its keys; shape (times, 2)."""
    return np.stack([np.interp(t, segment.times, segment.points[:, axis]) for axis in range(2)], axis=-1)


def _load(probe: Probe) -> _Line:
    """Give the percent of a probe's force as a function of time."""
    return _Line(*np.array(probe.load, dtype=float).T)


def _presses(probe: Probe) -> Sequence[tuple[float, float]]:
    """Give keys of a function that is not 0 while a probe presses; a path does so from its first key to its last."""
    if probe.path is None:
        return probe.load
    begin, end = probe.path[0][0], probe.path[-1][0]
    return (begin, 1.0), (end, 1.0), (end, 0.0)


def _activity(plan: Plan) -> _Line:
    """Tell when the virtual springs act: 1 always or while any probe presses, else 0."""
    scene = plan.scene
    if plan.material.always:
        return _Line(np.array([LONG_AGO]), np.array([1.0]))
    presses = [_presses(probe) for probe in scene.probes]
    times = np.unique([time for keys in presses for time, _ in keys])
    if not times.size:
        return _Line(np.zeros(1), np.zeros(1))
    # A time between each two keys, and one after the last.
    middles = np.append((times[:-1] + times[1:]) / 2, times[-1] + 1)
    active = np.zeros(len(times))
    for keys in presses:
        line = _Line(*np.array(keys, dtype=float).T)
        after = line.times.searchsorted(middles, "right")
        following = np.minimum(after, len(line.times) - 1)
        pressed = (line.after[after - 1] != 0) | ((line.before[following] != 0) & (after < len(line.times)))
        active[(after > 0) & pressed] = 1.0
    return _Line(np.repeat(times, 2)[1:], np.repeat(active, 2)[:-1])
