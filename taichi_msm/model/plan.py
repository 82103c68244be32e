"""A scene resolved: what is decided before the first step, once, and then handed on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.sheet import Maps, Material, has_fixed_border
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.model.tool_force import control_points
from taichi_msm.model.tools import Tool, build_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe

# A key closer than this to an end of the hat, as a fraction of its half-width, counts as outside: it would contribute
# less than rounding does.
HAT_TOLERANCE = 1e-9

Array = NDArray[np.float64]


class ProbeSegment(NamedTuple):
    """A control point between two jumps."""

    times: Array  # of the keys [s], shape (n,)
    points: Array  # control point at those times, x and y at rest [m], shape (n, 2); constant before and after them


@dataclass(frozen=True)
class ProbeSlot:
    """A place where a probe acts; a probe whose control point jumps has several slots and uses them by turns.

    If a jump falls within the hat, the probe acts in that step at the places before and after the jump. So the segments
    of the control point are dealt out to two slots: the first, third, ... to one, the second, fourth, ... to the other.
    If several jumps can fall within one hat, there are as many slots as it takes.
    """

    probe: int  # index of the probe in the scene
    segments: tuple[ProbeSegment, ...]  # all segments of the control point, also those of the other slots
    turn: int  # index of the slot's first segment
    turns: int  # number of slots that the probe has; every `turns`-th segment from `turn` on is the slot's

    @property
    def moves(self) -> bool:
        """Whether the control point moves."""
        return len(self.segments) > 1 or len(self.segments[0].times) > 1

    @property
    def jumps(self) -> Array:
        """Times at which the control point jumps [s]: the first key of every segment but the first."""
        return np.array([segment.times[0] for segment in self.segments[1:]])


def probe_slots(probes: Sequence[Probe], sheet: Sheet, h: float) -> tuple[ProbeSlot, ...]:
    """List the slots of all probes that exert a force.

    h: half-width of the hat, which is the step [s]; 0 if loads are not averaged: every probe then has one slot.
    """
    slots = []
    for index, probe in enumerate(probes):
        if probe.moved:
            continue
        times, points = control_points(probe, sheet)
        jumps = np.flatnonzero((times[1:] == times[:-1]) & (points[1:] != points[:-1]).any(axis=1)) + 1
        parts = zip(np.split(times, jumps), np.split(points, jumps), strict=True)
        segments = tuple(ProbeSegment(*part) for part in parts)
        # One more than the largest number of jumps in any hat.
        jumped = times[jumps]
        within = np.searchsorted(jumped, jumped + 2 * h * (1 - HAT_TOLERANCE), "left") - np.arange(len(jumped))
        turns = 1 + int(within.max(initial=0))
        slots += [ProbeSlot(index, segments, turn, turns) for turn in range(turns)]
    return tuple(slots)


def build_slots(scene: Scene, grid: TimeGrid) -> tuple[ProbeSlot, ...]:
    """List the slots of a scene's probes; at rest loads are not averaged."""
    return probe_slots(scene.probes, scene.sheet, 0.0 if scene.time.at_rest else grid.step)


@dataclass(frozen=True, eq=False)
class Plan:
    """What a scene comes to; `planning.make_plan` makes it."""

    scene: Scene  # as it was given
    maps: Maps  # the files of its maps
    fixed: NDArray[np.bool_]  # which points are fixed, shape (rows, cols)
    material: Material  # what the sheet is made of, with its maps as arrays
    stable_step: float  # the largest stable step [s]; infinite where nothing oscillates
    grid: TimeGrid  # the steps
    slots: tuple[ProbeSlot, ...]  # the places where probes act with a force
    tools: tuple[Tool, ...]  # the probes that are moved
    sha256: Mapping[str, str] = field(default_factory=dict)  # of the files of its cameras, by the keys that name them

    @property
    def open_edges(self) -> bool:
        """Whether a point at an edge moves."""
        return not has_fixed_border(self.fixed)

    def with_grid(self, **changes: Any) -> Plan:
        """Change attributes of the time grid: steps_per_frame, precision."""
        grid = replace(self.grid, **changes)
        if grid.step == self.grid.step:
            return replace(self, grid=grid)
        return replace(self, grid=grid, slots=build_slots(self.scene, grid))

    def with_probes(self, probes: Sequence[Probe | Mapping[str, Any]]) -> Plan:
        """Replace the probes; SceneError: one of them is not a probe."""
        scene = self.scene.model_copy(update={"probes": tuple(probes)})
        tools = build_tools(scene.probes, scene.sheet)
        return replace(self, scene=scene, slots=build_slots(scene, self.grid), tools=tools)
