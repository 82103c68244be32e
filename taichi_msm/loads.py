"""The probes in time: how hard each presses, where, and whether the virtual springs exist, step by step.

At a jump the value is the mean of its left and right limits, and at t = 0 the right limit; so a Verlet step that
falls on a release stays of order 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.lattice import axes
from taichi_msm.scene import Probe, Scene, Sheet
from taichi_msm.stability import steps_per_frame

# A key is on a step when their times differ by no more than rounding, as a fraction of the time: decimal key times
# meet binary step times.
SNAP = 1e-13

# Jumps that only so fine steps meet are met by none.
MOST_CUTS = 1000

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grip:
    """A place at which a probe acts; a probe whose control point jumps has one before every jump and one after it.

    Attributes:
        probe: index of the probe in the scene.
        times: keys of the control point [s], shape (n,); one key stands still.
        points: control point at those keys, x and y at rest [m], shape (n, 2).
        jumps: times at which the control point jumps [s].
        before: whether it acts only at a jump, where that begins; else where the jump ends, and at all other times.
    """

    probe: int
    times: Array
    points: Array
    jumps: Array
    before: bool

    @property
    def moves(self) -> bool:
        """Whether the control point moves."""
        return len(self.times) > 1


class Schedule(NamedTuple):
    """The loads at consecutive steps.

    Attributes:
        strength: force at the control point before its decay [N], shape (steps, grips, 3).
        point: control point, x and y at rest [m], shape (steps, grips, 2).
        active: share of the virtual springs' stiffness, 0, 1 or, where it jumps, 1/2; shape (steps,).
    """

    strength: Array
    point: Array
    active: Array


def control_points(probe: Probe, sheet: Sheet) -> tuple[Array, Array]:
    """Give the keys of a probe's control point: times [s], shape (n,), and points [m], shape (n, 2)."""
    first = probe.at[0]
    keys = probe.at if isinstance(first, tuple) else ((0.0, *probe.at),)
    time, across, down = np.array(keys, dtype=float).T
    height, width = sheet.size
    return time, np.stack([(across - 0.5) * width, (0.5 - down) * height], axis=1)


def grips(scene: Scene) -> tuple[Grip, ...]:
    """List the grips of all probes.

    The force at a jump of a control point is the mean of its limits, not the force at the mean of two places: half of
    it acts at each.
    """
    found = []
    for index, probe in enumerate(scene.probes):
        times, points = control_points(probe, scene.sheet)
        jumps = times[1:][(times[1:] == times[:-1]) & (points[1:] != points[:-1]).any(axis=1)]
        found += [Grip(index, times, points, jumps, before) for before in ((True, False) if jumps.size else (False,))]
    return tuple(found)


def decay(grip: Grip, scene: Scene) -> Array:
    """Evaluate exp(-falloff d - offset) of a standing grip (eq. 5).

    Returns:
        Share of the force that each point feels, shape (rows, cols).
    """
    probe = scene.probes[grip.probe]
    x, y = axes(scene.sheet)
    distance = np.hypot(x - grip.points[0, 0], y - grip.points[0, 1])
    return np.exp(-probe.falloff * distance - probe.offset)


def _between(times: Array, values: Array, t: Array, after: NDArray[np.intp], before: float | Array) -> Array:
    """Interpolate between the keys after[n] - 1 and after[n]; `before` the first key, the last value after the last."""
    low = np.maximum(after - 1, 0)
    high = np.minimum(after, len(times) - 1)
    span = times[high] - times[low]
    share = np.divide(t - times[low], span, out=np.zeros_like(t), where=span > 0)
    shape = (-1,) + (1,) * (values.ndim - 1)
    value = values[low] + share.reshape(shape) * (values[high] - values[low])
    return np.where((after == 0).reshape(shape), before, value)


def schedule(scene: Scene, first: int, count: int) -> Schedule:
    """Evaluate the loads at the steps first, ..., first + count - 1.

    The time of step n is n / (frames per second x steps per frame), never a sum of steps.
    """
    rate = scene.time.frames_per_second * steps_per_frame(scene)
    return loads_at(scene, np.arange(first, first + count) / rate)


def loads_at(scene: Scene, t: Array) -> Schedule:
    """Evaluate the loads at times that increase [s], shape (steps,)."""
    t, left, right = _both_sides(scene, t)
    return Schedule(_mean(left.strength, right.strength, t), right.point, _mean(left.active, right.active, t))


def key_times(scene: Scene) -> Array:
    """List the times of all keys after 0 and before the end [s], where the loads are not smooth."""
    times = {time for probe in scene.probes for time, _ in probe.load}
    times |= {float(time) for grip in grips(scene) for time in grip.times}
    return np.array(sorted(time for time in times if 0 < time < scene.time.duration))


class Envelope:
    """How hard the loads push at most from one time to another.

    Args:
        scene: a checked scene.
    """

    def __init__(self, scene: Scene) -> None:
        keys = np.array(sorted({time for times in _key_lists(scene) for time in times if time > 0} | {0.0}))
        # After the last key nothing changes.
        self._times, left, right = _both_sides(scene, np.append(keys, keys[-1] + 1))
        self._left, self._right = (np.linalg.norm(side.strength, axis=-1) for side in (left, right))
        self._active = right.active > 0
        self._begins = left.active < right.active

    def between(self, begin: float, end: float) -> tuple[Array, bool, int]:
        """Bound what the loads do from one time to another, both included.

        Returns:
            The largest force at each grip's control point [N], shape (grips,); whether the virtual springs act at any
            time; and how often they begin to.
        """
        # A key that is at one of them but for rounding counts there, as it does for the steps.
        first = self._times.searchsorted(begin * (1 - 2 * SNAP), "left")
        last = self._times.searchsorted(end * (1 + 2 * SNAP), "right")
        forces = [self._at(begin), self._at(end), *self._left[first:last], *self._right[first:last]]
        active = self._active[max(0, first - 1) : last].any()
        return np.max(forces, axis=0), bool(active), int(self._begins[first:last].sum())

    def _at(self, t: float) -> Array:
        """Bound the forces at one time: no force is greater than its limits at the keys before and after."""
        after = min(int(self._times.searchsorted(t, "right")), len(self._times) - 1)
        before = after - 1
        share = min(1.0, (t - self._times[before]) / (self._times[after] - self._times[before]))
        return (1 - share) * self._right[before] + share * self._left[after]


def jumps(scene: Scene) -> Array:
    """List the times after 0 and before the end at which a force or the activity of the virtual springs jumps [s]."""
    t, left, right = _both_sides(scene, key_times(scene))
    changes = (left.strength != right.strength).any(axis=(1, 2))
    if scene.springs.virtual > 0:
        changes |= left.active != right.active
    return t[changes]


def steps_to_meet_jumps(scene: Scene) -> int:
    """Find the number of steps a frame of which every multiple has a step at every jump; 0 where there is none."""
    frames = [Fraction(float(t) * scene.time.frames_per_second).limit_denominator(MOST_CUTS) for t in jumps(scene)]
    steps = math.lcm(*(share.denominator for share in frames))
    return steps if steps <= MOST_CUTS and _meet(scene, steps, jumps(scene)) else 0


def meets_jumps(scene: Scene) -> bool:
    """Tell whether every jump falls on a step and no ramp is shorter than one: if not, the method is of order 1."""
    steps = steps_per_frame(scene)
    rate = scene.time.frames_per_second * steps
    return _meet(scene, steps, jumps(scene)) and shortest_ramp(scene) * rate >= 1 - SNAP


def _meet(scene: Scene, steps: int, times: Array) -> bool:
    rate = scene.time.frames_per_second * steps
    return bool((np.abs(np.round(times * rate) / rate - times) <= SNAP * times).all())


def shortest_ramp(scene: Scene) -> float:
    """Find the shortest time between two keys of one list that are no jump [s]; infinite where there is none."""
    return min((float(gap) for times in _key_lists(scene) for gap in np.diff(times) if gap > 0), default=math.inf)


def shortest_event(scene: Scene) -> float:
    """Find the shortest time in which more than a jump or a ramp happens: three keys of one list [s]; or infinity.

    What takes less than two steps may fall between them, or be counted in full for the one instant that a step sees.
    """
    spans = [times[2:] - times[:-2] for times in _key_lists(scene) if len(times) > 2]
    return min((float(span) for each in spans for span in each), default=math.inf)


def _key_lists(scene: Scene) -> list[Array]:
    """List the times of every list of keys [s]."""
    loads = [np.array([time for time, _ in probe.load]) for probe in scene.probes]
    return [*loads, *(control_points(probe, scene.sheet)[0] for probe in scene.probes)]


def _both_sides(scene: Scene, t: Array) -> tuple[Array, Schedule, Schedule]:
    """Take the left and the right limits of the loads; the times come back moved onto the keys that they mean."""
    count = len(t)
    percent = np.zeros((len(scene.probes), 2, count))
    pressing = np.zeros((2, count), dtype=bool)
    for index, probe in enumerate(scene.probes):
        times, values = np.array(probe.load).T
        t = _snap(t, times)
        # Not zero between two keys when it is not zero at one of them; afterwards when the last value is not.
        nonzero = np.concatenate([[False], (values[:-1] != 0) | (values[1:] != 0), [values[-1] != 0]])
        for side, after in enumerate(_limits(times, t)):
            percent[index, side] = _between(times, values, t, after, 0.0)
            pressing[side] |= nonzero[after]
    if scene.springs.virtual_active == "always":
        pressing[:] = True

    parts = grips(scene)
    for part in parts:
        t = _snap(t, part.times)
    strength = np.zeros((2, count, len(parts), 3))
    point = np.zeros((count, len(parts), 2))
    for n, part in enumerate(parts):
        jumps = np.isin(t, part.jumps)
        for side, acts in enumerate((jumps, np.False_) if part.before else (~jumps, np.True_)):
            share = percent[part.probe, side] * acts / 100
            strength[side, :, n] = np.multiply.outer(share, scene.probes[part.probe].force)
        limit = _limits(part.times, t)[0 if part.before else 1]
        point[:, n] = _between(part.times, part.points, t, limit, part.points[0])
    active = pressing * 1.0
    return t, Schedule(strength[0], point, active[0]), Schedule(strength[1], point, active[1])


def _snap(t: Array, keys: Array) -> Array:
    """Move every time that is on a key but for rounding onto the key; the keys are in order."""
    after = keys.searchsorted(t)
    for index in (np.maximum(after - 1, 0), np.minimum(after, len(keys) - 1)):
        key = keys[index]
        t = np.where(np.abs(t - key) <= SNAP * np.abs(key), key, t)
    return t


def _limits(times: Array, t: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Number the first key at or after t (for the left limit) and the first key after t (for the right one)."""
    return np.searchsorted(times, t, "left"), np.searchsorted(times, t, "right")


def _mean(left: Array, right: Array, t: Array) -> Array:
    """Take the mean of both limits; at t = 0, before which nothing is, the right one."""
    return np.where(t.reshape((-1,) + (1,) * (left.ndim - 1)) <= 0, right, (left + right) / 2)
