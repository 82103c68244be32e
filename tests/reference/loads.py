"""NumPy reference of loads in time, in fractions of the sheet, which has any surface."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.tools import Probe

Array = NDArray[np.float64]

# Abscissae of Gauss' rule of two points, exact for the product of a load and a hat.
GAUSS = np.array([-1, 1]) / np.sqrt(3)


class Loads(NamedTuple):
    """Loads of force-controlled tools at steps or frames; a tool acts once for each part of `at` between jumps."""

    probes: tuple[int, ...]  # index of the probe of each of the second axis, shape (slots,)
    percent: Array  # shape (times, slots)
    at: Array  # control points, across and down, shape (times, slots, 2)
    active: Array  # share of the virtual springs that are active, 0 to 1, shape (times,)


def step_loads(plan: Plan) -> Loads:
    """Average the loads of all steps with the hat of half-width h about each time, and with half of it at time 0."""
    scene, h = plan.scene, plan.grid.step
    every = np.arange(plan.grid.steps) / plan.grid.steps_per_second
    parts = [(index, *part) for index, probe in enumerate(scene.probes) if not probe.moved for part in _parts(probe)]
    percent, at = np.zeros((len(every), len(parts))), np.zeros((len(every), len(parts), 2))
    active = np.zeros(len(every))
    for n, t in enumerate(every):
        nodes, weights = _hat(float(t), h, _key_times(scene))
        active[n] = (weights * _active(scene, nodes)).sum()
        for slot, (index, begin, end, keys) in enumerate(parts):
            within = (nodes > begin) & (nodes < end)
            percent[n, slot] = (weights * within * _percent(scene.probes[index], nodes)).sum()
            at[n, slot] = [np.interp(t, keys[:, 0], keys[:, axis]) for axis in (1, 2)]
    return Loads(tuple(index for index, *_ in parts), percent, at, active)


def frame_loads(plan: Plan, frame: int) -> Loads:
    """Return the loads at a frame, after a jump at it; a key within 1e-6 of a frame counts as at it."""
    scene, rate = plan.scene, plan.grid.frames_per_second
    t = max((key for key in _key_times(scene) if abs(key * rate - frame) <= 1e-6), default=frame / rate)
    slots, percent, at, active = [], [], [], _is_always_active(scene)
    for index, probe in enumerate(scene.probes):
        if probe.path is not None:
            active = active or probe.path[0][0] <= t <= probe.path[-1][0]
            continue
        *_, (_, _, keys) = (part for part in _parts(probe) if part[0] <= t)
        slots.append(index)
        percent.append(float(_percent(probe, np.array([t]))[0]))
        at.append([np.interp(t, keys[:, 0], keys[:, axis]) for axis in (1, 2)])
        active = active or percent[-1] != 0
    return Loads(tuple(slots), np.array([percent]), np.reshape(at, (1, len(at), 2)), np.array([float(active)]))


def _parts(probe: Probe) -> list[tuple[float, float, Array]]:
    """Return begin and end [s] and keys (t, across, down) of the parts of a control point's path between jumps."""
    at: Any = probe.at if isinstance(probe.at[0], tuple) else ((0.0, *probe.at),)
    keys = np.array(at, dtype=float)
    jumps = 1 + np.flatnonzero((np.diff(keys[:, 0]) == 0) & np.diff(keys[:, 1:], axis=0).any(axis=1))
    bounds = [-np.inf, *keys[jumps, 0], np.inf]
    return list(zip(bounds[:-1], bounds[1:], np.split(keys, jumps), strict=True))


def _key_times(scene: Scene) -> list[float]:
    times = {float(key[0]) for probe in scene.probes for key in (*probe.load, *(probe.path or ()))}
    return sorted(times | {float(begin) for probe in scene.probes if not probe.moved for begin, _, _ in _parts(probe)})


def _percent(probe: Probe, t: Array) -> Array:
    """Return the load [%] at times [s], after a jump at one of them."""
    times, percents = np.array(probe.load, dtype=float).T
    after = times.searchsorted(t, "right")
    low, high = np.maximum(after - 1, 0), np.minimum(after, len(times) - 1)
    share = (t - times[low]) / np.where(high > low, times[high] - times[low], 1)
    return np.where(after == 0, 0, percents[low] + np.where(high > low, share, 0) * (percents[high] - percents[low]))


def _is_always_active(scene: Scene) -> bool:
    if scene.tissue is not None:
        return scene.tissue.foundation_active == "always"
    return scene.springs is not None and scene.springs.virtual_active == "always"


def _active(scene: Scene, t: Array) -> Array:
    """Return whether the virtual springs are active at times that are no keys [s]."""
    active = np.full(t.shape, _is_always_active(scene))
    for probe in scene.probes:
        if probe.path is None:
            active |= _percent(probe, t) != 0
        else:
            active |= (probe.path[0][0] < t) & (t < probe.path[-1][0])
    return active


def _hat(t: float, h: float, keys: list[float]) -> tuple[Array, Array]:
    """Return nodes [s] and weights of the average with the hat about a time, in pieces between keys."""
    low, high = (0.0 if t <= 0 else t - h), t + h
    cuts = np.unique([low, t, high, *(key for key in keys if low < key < high)])
    half, middle = np.diff(cuts) / 2, (cuts[1:] + cuts[:-1]) / 2
    nodes = (middle[:, None] + half[:, None] * GAUSS).ravel()
    weights = np.repeat(half, 2) * (1 - np.abs(nodes - t) / h) / h
    return nodes, weights * (2 if t <= 0 else 1)
