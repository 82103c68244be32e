"""Tools that are moved: the rods that touch the sheet, where they are, and when they hold it. Scene: `probes`, `path`.

A rod is all that is within `radius` of its middle line, c(t) + s a with 0 <= s <= length, where c is the middle of its
round tip and a the unit vector along its shaft.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Problem
from taichi_msm.model.sheet import spacing
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe

# A tool may move by this share of its radius in a step, and be this much larger than the distance between points
# before a note is made.
LARGEST_STRIDE = WIDEST_CELL = 0.5
TOO_FEW = "which touches few of them"

# Advice is at most this many times as many points.
MOST_FINER = 4

# At how many moments it is looked whether two tools are in one place.
MOMENTS = 1024

# A tip holds the points within this many times its radius of its middle.
GRASP = 1.5

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Tool:
    """A probe with a path."""

    probe: int  # index of the probe in the scene
    times: Array  # of the keys [s], shape (n,)
    middles: Array  # of the round tip at those times, c [m], shape (n, 3)
    heights: Array  # of the lowest point of the round tip [m], shape (n,)
    axis: Array  # a, shape (3,)
    length: float  # of the middle line [m]
    radius: float  # [m]
    friction: float  # Coulomb's coefficient
    grips: tuple[tuple[float, float], ...]  # from, to [s]

    @property
    def way(self) -> float:
        """How far the tool goes in all [m]."""
        return float(np.linalg.norm(np.diff(self.middles, axis=0), axis=1).sum())

    def stride(self, step: float, first: int = 0) -> tuple[float, int]:
        """Give how far the tool comes at most in a step from 0 s on [m], and the key that it goes to then.

        Between the times where a key enters or leaves the step, how far it comes is a convex function.

        first: the key from which on its way counts.
        """
        begin = np.maximum([0.0, *self.times, *(self.times - step)], max(0.0, self.times[first] if first else 0.0))
        far = np.linalg.norm(self.middle(begin + step) - self.middle(begin), axis=1)
        most = int(far.argmax())
        return float(far[most]), min(int(self.times.searchsorted(begin[most], "right")), len(self.times) - 1)

    def middle(self, t: Array) -> Array:
        """Give the middle of the tip at times [s], linear between the keys and held outside, shape (times, 3)."""
        return np.stack([np.interp(t, self.times, self.middles[:, axis]) for axis in range(3)], axis=-1)

    def lowest(self, t: float) -> tuple[float, float, float]:
        """Give the lowest point of the round tip at a time [s]; x, y and z [m]."""
        x, y, z = (float(np.interp(t, self.times, each)) for each in (*self.middles.T[:2], self.heights))
        return x, y, z

    def touches(self, places: Array, t: float) -> bool:
        """Tell whether any of these places [m], shape (n, 3), is in or, but for rounding, on the rod at a time [s]."""
        r = places - self.middle(np.array([t]))[0]
        s = np.clip(r @ self.axis, 0, self.length)
        return bool((np.linalg.norm(r - s[:, None] * self.axis, axis=1) < self.radius * (1 + 1e-6)).any())

    def strides(self, begin: float, end: float) -> Array:
        """Cut the way from one time to another into parts of at most LARGEST_STRIDE radii; the ends of these [s]."""
        parts, most = 1, LARGEST_STRIDE * self.radius * (1 + 1e-9)
        while True:
            times = np.linspace(begin, end, parts + 1)
            longest = float(np.linalg.norm(np.diff(self.middle(times), axis=0), axis=1).max())
            if longest <= most:
                return times[1:]
            parts = max(parts + 1, int(parts * longest / most))


def tools_of(probes: Sequence[Probe], sheet: Sheet) -> tuple[Tool, ...]:
    """List the probes that have a path."""
    height, width = sheet.size
    tools = []
    for index, probe in enumerate(probes):
        if probe.path is None:
            continue
        assert probe.instrument is not None
        rod, (time, across, down, lowest) = probe.instrument, np.array(probe.path, dtype=float).T
        middles = np.stack([(across - 0.5) * width, (0.5 - down) * height, lowest + rod.radius], axis=1)
        shape = unit(rod.shaft), rod.length, rod.radius
        tools.append(Tool(index, time, middles, lowest, *shape, probe.friction, probe.grip))
    return tuple(tools)


def unit(shaft: Sequence[float]) -> Array:
    """Give a direction the length 1; the largest number is divided by first, so that no square overflows."""
    axis = np.array(shaft) / max(map(abs, shaft))
    return np.asarray(axis / np.linalg.norm(axis))


def grip_frames(grip: tuple[float, float], rate: float) -> range:
    """List the frames at rest that a grip holds: from the first at or after its begin to before that of its end."""
    # But for rounding.
    begin, end = (max(0, math.ceil(time * rate - FRAME_TOLERANCE)) for time in grip)
    return range(begin, end)


def path_problems(scene: Scene, tools: Sequence[Tool], grid: TimeGrid) -> Iterator[Problem]:
    """Find tools that are in the sheet from the start, and such that move too far in a step."""
    for tool in tools:
        where = ("probes", tool.probe, "path")
        depth = tool.radius - _distance(tool, scene.sheet)
        if depth > 1e-9 * tool.radius:
            said = f"the instrument is {depth:.3g} m in the sheet at rest at 0 s; begin above it, at a greater height"
            yield Problem(where, said)
        if scene.time.at_rest:
            if tool.friction > 0:
                said = f"{tool.friction:g} needs time.motion: dynamic, as at rest nothing slides; remove friction"
                yield Problem(("probes", tool.probe, "friction"), said)
        elif fault := too_fast(tool, grid):
            yield Problem((*where, fault[0]), fault[1])


def too_fast(tool: Tool, grid: TimeGrid, first: int = 0) -> tuple[int, str] | None:
    """Find the key after the `first` to which a tool moves too far in a step, and say so; None: there is none."""
    stride, key = tool.stride(grid.step, first)
    if stride <= LARGEST_STRIDE * tool.radius * (1 + 1e-9):
        return None
    return key, (
        f"moves {stride:.3g} m in a step of {grid.step:.3g} s, over half the radius of its "
        f"instrument; move at most {LARGEST_STRIDE * tool.radius / grid.step:.3g} m/s, or take a smaller step"
    )


def fewest_steps(tools: Sequence[Tool], grid: TimeGrid, least: int) -> int:
    """Count the fewest steps of a frame, `least` or more, in which no tool moves too far."""

    def times_too_far(tool: Tool) -> float:
        return tool.stride(1 / grid.frames_per_second / least)[0] / (LARGEST_STRIDE * tool.radius)

    # In a step of 1 / n it moves at least 1 / n as far.
    while (most := max(map(times_too_far, tools), default=0.0)) > 1 + 1e-9:
        least = max(least + 1, math.ceil(least * most * (1 - 1e-9)))
    return least


def path_notes(scene: Scene, tools: Sequence[Tool]) -> Iterator[str]:
    """Note the tools that are too thin for the points, and two that are in one place."""
    apart, side, end = max(spacing(scene.sheet)), max(scene.sheet.size), scene.time.duration
    for tool in tools:
        if (far := float(np.abs(tool.heights).max())) > side:
            yield f"probes.{tool.probe}.path: a height of {far:g} m beside a sheet of {side:g} m; heights are in metres"
        if tool.times[-1] > end * (1 + 1e-9):
            yield f"probes.{tool.probe}.path ends at {tool.times[-1]:g} s, after the end of the scene at {end:g} s"
        for begin, until in tool.grips:
            if begin >= end:
                yield f"probes.{tool.probe}.grip begins at {begin:g} s, not before the end of the scene at {end:g} s"
            elif scene.time.at_rest and not grip_frames((begin, until), scene.time.frames_per_second):
                yield f"probes.{tool.probe}.grip from {begin:g} to {until:g} s holds nothing: no frame is between them"
        if apart > WIDEST_CELL * tool.radius:
            (height, width), most = scene.sheet.size, WIDEST_CELL * tool.radius
            points = [int(np.ceil(side / most)) + 1 for side in (height, width)]
            few = math.prod(points) <= MOST_FINER * math.prod(scene.sheet.points)
            remedy = f"try sheet.points: {points}" if few else "take a wider tip"
            yield (
                f"probes.{tool.probe}: the points are {apart:.3g} m apart, more than half the radius of the "
                f"instrument, {tool.radius:.3g} m, {TOO_FEW}; {remedy}"
            )

    if (where := overlap(tools, scene.time.duration)) is not None:
        one, other, time = where
        yield (
            f"probes.{one} and probes.{other}: their instruments run through each other at {time:.3g} s, so that the "
            "sheet cannot be outside both; keep them apart"
        )


def overlap(tools: Sequence[Tool], duration: float) -> tuple[int, int, float] | None:
    """Find two tools that run through each other: the indices of their probes, and when first [s]."""
    times = np.linspace(0, duration, MOMENTS + 1)
    for one, other in combinations(tools, 2):
        apart = _apart(one, other, one.middle(times) - other.middle(times))
        within = np.flatnonzero(apart < (1 - 1e-9) * (one.radius + other.radius))
        if within.size:
            return one.probe, other.probe, float(times[within[0]])
    return None


def _apart(one: Tool, other: Tool, between: Array) -> Array:
    """Give the distance of two middle lines [m], shape (n,); between: the one's tip minus the other's, shape (n, 3)."""

    def from_end(way: Array, axis: Array, length: float) -> Array:
        return np.asarray(np.linalg.norm(way - np.clip(way @ axis, 0, length)[:, None] * axis, axis=1))

    # From an end of either to anywhere on the other.
    apart = np.minimum(
        np.minimum(*(from_end(between + s * one.axis, other.axis, other.length) for s in (0, one.length))),
        np.minimum(*(from_end(s * other.axis - between, one.axis, one.length) for s in (0, other.length))),
    )
    # Or where both are nearest if they had no ends, |between + s a - t b| least.
    across = np.cross(one.axis, other.axis)
    if (square := float(across @ across)) > 1e-12:
        cosine, along, there = one.axis @ other.axis, between @ one.axis, between @ other.axis
        s, t = (cosine * there - along) / square, (there - cosine * along) / square
        inside = (s >= 0) & (s <= one.length) & (t >= 0) & (t <= other.length)
        apart = np.where(inside, np.minimum(apart, abs(between @ across) / math.sqrt(square)), apart)
    return apart


def _distance(tool: Tool, sheet: Sheet) -> float:
    """Give the distance of the middle line at 0 s from the sheet at rest [m]."""
    start, half = tool.middle(np.zeros(1))[0], np.array([sheet.size[1] / 2, sheet.size[0] / 2, 0.0])

    def distance(s: float) -> float:
        place = start + s * tool.axis
        return float(np.linalg.norm(place - np.clip(place, -half, half)))

    # It is a convex function of s.
    low, high = 0.0, tool.length
    for _ in range(200):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        low, high = (low, right) if distance(left) <= distance(right) else (left, high)
    return distance(low)
