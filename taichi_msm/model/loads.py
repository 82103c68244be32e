"""Loads in time: the force and control point of each probe, and the activity of the virtual springs, per step.

Step n uses the load averaged with the hat function of half-width h about t_n,

    percent_n = integral of percent(t) (1 - |t - t_n| / h) dt / h,    at n = 0 twice that over [0, h].

The averaged load displaces a free mass point by exactly the same distance as the load itself. The method therefore
keeps order 2 for every load, including one that jumps between steps. The average is the value at t_n if the hat
contains no keyframe. The activity of the virtual springs is averaged in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.model.plan import HAT_TOLERANCE, Plan, ProbeSegment, ProbeSlot, probe_slots
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import axes
from taichi_msm.model.tool_force import control_points, point_at, probe_directions, probe_force
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe


class Schedule(NamedTuple):
    """Loads at consecutive steps or given times."""

    slots: tuple[ProbeSlot, ...]  # the second axis of `strength` and `point`
    strength: Array  # force without decay [N], shape (steps, slots, 3)
    point: Array  # control point, `Rest.load_points` [m], shape (steps, slots, 2 or 3)
    active: Array  # factor of the virtual springs' stiffness, 0 to 1, shape (steps,)


def decay(probe: Probe, plan: Plan, at: Array | None = None) -> Array:
    """Return the decay factor of a probe's force at each mass point, shape (rows, cols).

    The factor of a probe with `total` includes the mass point's share of a cell's area. The coordinates of the control
    point are `at`, by default those of the first keyframe of `probe.at`.
    """
    sheet = plan.scene.sheet
    law, at = probe_force(probe, sheet), control_points(probe, sheet)[1][0] if at is None else at
    factors = law.decay(rest_of(sheet).distances(at))
    return factors * plan.area_shares if law.by_area else factors


def decay_gradient(probe: Probe, plan: Plan, at: Array | None = None) -> Array:
    """Return the derivatives of `decay` by x and y of the control point [1/m], shape (2, rows, cols).

    A mass point at the control point has the derivative 0; the decay has none there.
    """
    sheet = plan.scene.sheet
    law, (at_x, at_y) = probe_force(probe, sheet), control_points(probe, sheet)[1][0] if at is None else at
    x, y = axes(sheet)
    off = np.stack(np.broadcast_arrays(x - at_x, y - at_y))
    distance = np.hypot(*off)
    outside = (law.falloff * distance + law.shift > law.offset) & (distance > 0)
    return decay(probe, plan, at) * law.falloff * outside * off / np.where(outside, distance, 1)


def average_loads(plan: Plan, first: int, count: int) -> Schedule:
    """Return the loads of `count` steps from the step `first` on, averaged with the hat function of each step."""
    scene, slots = plan.scene, plan.slots
    t, h = np.arange(first, first + count) / plan.grid.steps_per_second, plan.grid.step
    strength, coordinates = np.zeros((count, len(slots), 3)), np.zeros((count, len(slots), 2))
    for index in sorted({slot.probe for slot in slots}):
        probe, columns = scene.probes[index], [n for n, slot in enumerate(slots) if slot.probe == index]
        slot_count, segments, jumps = len(columns), slots[columns[0]].segments, slots[columns[0]].jumps
        load = _load(probe)
        if slot_count == 1:
            percents, numbers = load.averages(t, h)[:, None], np.zeros((count, 1), np.intp)
        else:
            percents, numbers = _distribute_over_slots(load, jumps, slot_count, t, h)
        for n, percent, segment_numbers in zip(columns, percents.T, numbers.T, strict=True):
            for number in np.unique(segment_numbers):
                steps = segment_numbers == number
                coordinates[steps, n] = _control_point(segments[number], t[steps])
            strength[:, n] = percent[:, None] / 100 * probe_directions(probe, scene.sheet, coordinates[:, n])
    return Schedule(slots, strength, _load_points(plan, coordinates), _activity(plan).averages(t, h))


def evaluate_loads(plan: Plan, t: Array) -> Schedule:
    """Evaluate the loads at times [s], shape (n,), without averaging; at a jump they are those after it.

    Each probe has one slot, and the arrays of the result have the first axis (n,).
    """
    scene = plan.scene
    slots = plan.slots if scene.time.at_rest else probe_slots(scene.probes, scene.sheet, 0.0)
    strength, coordinates = np.zeros((len(t), len(slots), 3)), np.zeros((len(t), len(slots), 2))
    for n, slot in enumerate(slots):
        probe = scene.probes[slot.probe]
        segment_numbers = slot.jumps.searchsorted(t, "right")
        for number in np.unique(segment_numbers):
            steps = segment_numbers == number
            coordinates[steps, n] = _control_point(slot.segments[number], t[steps])
        percent = _load(probe).values(t)
        strength[:, n] = percent[:, None] / 100 * probe_directions(probe, scene.sheet, coordinates[:, n])
    return Schedule(slots, strength, _load_points(plan, coordinates), _activity(plan).values(t))


def _load_points(plan: Plan, coordinates: Array) -> Array:
    """Return `Rest.load_points` of control points, shape (steps, slots, 2 or 3), for coordinates (steps, slots, 2)."""
    points = rest_of(plan.scene.sheet).load_points(coordinates.reshape(-1, 2))
    return points.reshape(*coordinates.shape[:2], points.shape[1])


class FrameLoad:
    """The load of a force-controlled probe at frames, without averaging; `moves` if its control point moves."""

    def __init__(self, probe: Probe, sheet: Sheet) -> None:
        self._line, (self._times, self._points) = _load(probe), control_points(probe, sheet)
        self.moves = len(self._times) > 1
        self._keys = np.unique(np.concatenate([self._line.times, self._times]))

    def at(self, frame: int, rate: float) -> tuple[float, Array]:
        """Return the load [%] and the coordinates of the control point at a frame; at a jump, those after it."""
        time = frame / rate
        # Frame times are rounded, so a keyframe very close to the frame counts as at the frame.
        key = float(self._keys[max(0, self._keys.searchsorted(time + FRAME_TOLERANCE / rate, "right") - 1)])
        time = key if abs(time - key) <= FRAME_TOLERANCE / rate else time
        return float(self._line.values(np.array([time]))[0]), point_at(self._times, self._points, time)


def evaluate_frame_loads(plan: Plan, frame: int) -> Schedule:
    """Return the loads at a frame, as a schedule of one step with one slot per probe.

    At a jump the loads are those after it. A keyframe within FRAME_TOLERANCE frames counts as at the frame. A
    foundation with `foundation_active: loaded` is active if any load differs from 0, or if any path has begun and not
    ended.
    """
    scene, rate = plan.scene, plan.grid.frames_per_second
    time = frame / rate
    keys_at_frame = [key for key in _all_key_times(scene) if abs(key - time) <= FRAME_TOLERANCE / rate]
    t = np.array([max(keys_at_frame, default=time)])
    loads = evaluate_loads(plan, t)
    pressed = any(
        _load(probe).values(t)[0] != 0 if probe.path is None else probe.path[0][0] <= t[0] <= probe.path[-1][0]
        for probe in scene.probes
    )
    return loads._replace(active=np.array([float(plan.material.always_active or pressed)]))


def _all_key_times(scene: Scene) -> Array:
    keys: list[Any] = [[]]
    for probe in scene.probes:
        if probe.path is None:
            keys += [time for time, _ in probe.load], control_points(probe, scene.sheet)[0]
        else:
            keys += [time for time, *_ in probe.path], np.ravel(probe.grip)
    return np.unique(np.concatenate(keys))


class LoadBounds:
    """Bounds of the loads of a plan over time intervals."""

    def __init__(self, plan: Plan) -> None:
        scene, self._h = plan.scene, plan.grid.step
        probes = [scene.probes[slot.probe] for slot in plan.slots]
        self._lines = [_load(probe) for probe in probes]
        self._forces = [math.hypot(*probe_force(probe, scene.sheet).force) / 100 for probe in probes]
        self._activity = _activity(plan)
        self._begins = self._activity.times[self._activity.before < self._activity.after]

    def between(self, begin: float, end: float) -> tuple[Array, bool, int]:
        """Bound the loads of all steps in a closed time interval [s].

        Return the largest force at the control point of each slot [N], shape (slots,); whether the virtual springs are
        active at any time; and the number of their activations.
        """
        # The hat of a step extends one step beyond the interval.
        begin, end = begin - self._h, end + self._h
        forces = [force * load.max_abs(begin, end) for force, load in zip(self._forces, self._lines, strict=True)]
        activations = self._begins.searchsorted(end, "right") - self._begins.searchsorted(begin, "left")
        return np.array(forces), self._activity.max_abs(begin, end) > 0, int(activations)


class _PiecewiseLinear:
    """A piecewise linear function of time [s], 0 before the first keyframe and constant after the last.

    It jumps where two of the ascending times have the same value.
    """

    def __init__(self, times: Array, values: Array) -> None:
        keys = np.unique(times)
        # Limits from the left and from the right at every keyframe.
        before, after = values[times.searchsorted(keys, "left")], values[times.searchsorted(keys, "right") - 1]
        before[0] = 0.0
        # Drop redundant keyframes, because they would change the rounding.
        last, following = np.append(0.0, after[:-1]), np.append(before[1:], after[-1])
        needed = (last != before) | (before != after) | (after != following)
        needed[0] = True
        self.times, self.before, self.after = keys[needed], before[needed], after[needed]

    def values(self, t: Array) -> Array:
        """Evaluate the function; at a jump, its limit from the right."""
        return self._values(t, self.times.searchsorted(t, "right"))

    def averages(self, t: Array, h: float, begin: float = -math.inf, end: float = math.inf) -> Array:
        """Return the averages with hat functions of half-width h about the times t, where t >= 0 [s].

        The function counts as 0 before `begin` and from `end` on [s]. The average is the value at t if the hat contains
        no keyframe and neither `begin` nor `end`.
        """
        edges = [edge for edge in (begin, end) if math.isfinite(edge)]
        averages = self.values(t) * ((begin <= t) & (t < end))
        bounds = np.union1d(self.times, edges)
        # At t = 0 the hat has its right half only, so even the average of a straight line differs from its value.
        uneven = (t <= 0) | (
            bounds.searchsorted(t + h * (1 - HAT_TOLERANCE), "left")
            > bounds.searchsorted(t - h * (1 - HAT_TOLERANCE), "right")
        )
        for n in np.flatnonzero(uneven):
            averages[n] = self._average(float(t[n]), h, begin, end)
        return averages

    def max_abs(self, begin: float, end: float) -> float:
        """Return the largest absolute value in the closed time interval from `begin` to `end` [s]."""
        first, last = self.times.searchsorted(begin, "left"), self.times.searchsorted(end, "right")
        ends = np.array([begin, end])
        return float(np.abs(np.concatenate([self.values(ends), self.before[first:last], self.after[first:last]])).max())

    def _values(self, t: Array, after: NDArray[np.intp]) -> Array:
        """Evaluate the function between the keyframes after[n] - 1 and after[n]."""
        low, high = np.maximum(after - 1, 0), np.minimum(after, len(self.times) - 1)
        span = self.times[high] - self.times[low]
        fraction = np.divide(t - self.times[low], span, out=np.zeros_like(t), where=span > 0)
        slope = np.where(span > 0, self.before[high] - self.after[low], 0.0)
        return np.where(after == 0, 0.0, self.after[low] + fraction * slope)

    def _average(self, t: float, h: float, begin: float, end: float) -> float:
        """Return the average about a time, by Simpson's rule on each piece; exact for products of linear functions."""
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


def _distribute_over_slots(
    load: _PiecewiseLinear, jumps: Array, slot_count: int, t: Array, h: float
) -> tuple[Array, NDArray[np.intp]]:
    """Return the load [%] and the segment number of each slot of a probe with jumps, both of shape (steps, slots)."""
    bounds = np.concatenate([[-math.inf], jumps, [math.inf]])
    first = jumps.searchsorted(t - h * (1 - HAT_TOLERANCE), "right")
    last = jumps.searchsorted(t + h * (1 - HAT_TOLERANCE), "left")
    percents, numbers = np.zeros((len(t), slot_count)), np.empty((len(t), slot_count), np.intp)
    for slot in range(slot_count):
        candidates = first + (slot - first) % slot_count
        acts = candidates <= last
        numbers[:, slot] = np.where(acts, candidates, first)
        for number in np.unique(candidates[acts]):
            steps = acts & (candidates == number)
            percents[steps, slot] = load.averages(t[steps], h, bounds[number], bounds[number + 1])
    return percents, numbers


def _control_point(segment: ProbeSegment, t: Array) -> Array:
    """Return the coordinates of a segment at times t [s], constant outside its keyframes, shape (times, 2)."""
    return np.stack([np.interp(t, segment.times, segment.points[:, axis]) for axis in range(2)], axis=-1)


def _load(probe: Probe) -> _PiecewiseLinear:
    return _PiecewiseLinear(*np.array(probe.load, dtype=float).T)


def _pressing_keys(probe: Probe) -> Sequence[tuple[float, float]]:
    """Return the keyframes of a function that is not 0 while a probe acts: its load, or 1 along its path."""
    if probe.path is None:
        return probe.load
    begin, end = probe.path[0][0], probe.path[-1][0]
    return (begin, 1.0), (end, 1.0), (end, 0.0)


def _activity(plan: Plan) -> _PiecewiseLinear:
    """Return the activity of the virtual springs: 1 if always active or while any probe acts, else 0."""
    scene = plan.scene
    if plan.material.always_active:
        # One keyframe [s], before any run.
        return _PiecewiseLinear(np.array([-1e300]), np.array([1.0]))
    probe_keys = [_pressing_keys(probe) for probe in scene.probes]
    times = np.unique([time for keys in probe_keys for time, _ in keys])
    if not times.size:
        return _PiecewiseLinear(np.zeros(1), np.zeros(1))
    # A time inside each interval between keyframes, and one after the last keyframe.
    middles = np.append((times[:-1] + times[1:]) / 2, times[-1] + 1)
    active = np.zeros(len(times))
    for keys in probe_keys:
        line = _PiecewiseLinear(*np.array(keys, dtype=float).T)
        after = line.times.searchsorted(middles, "right")
        following = np.minimum(after, len(line.times) - 1)
        pressed = (line.after[after - 1] != 0) | ((line.before[following] != 0) & (after < len(line.times)))
        active[(after > 0) & pressed] = 1.0
    return _PiecewiseLinear(np.repeat(times, 2)[1:], np.repeat(active, 2)[:-1])
