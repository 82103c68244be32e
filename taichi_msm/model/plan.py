"""The plan of a run: a scene resolved into arrays and a time grid before the first step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.integrators import Coefficients
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import Maps, Material, has_fixed_border, point_areas
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.model.tool_force import control_points
from taichi_msm.model.tools import Tool, build_tools, clamps, solid_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe

# Keyframes closer to an end of the hat than this fraction of its half-width count as outside: their contribution is
# below rounding.
HAT_TOLERANCE = 1e-9


class ProbeSegment(NamedTuple):
    """The path of a control point between two jumps, constant before its first and after its last keyframe."""

    times: Array  # times of the keyframes [s], shape (n,)
    points: Array  # coordinates of the control point at the keyframes, see `Rest`, shape (n, 2)


@dataclass(frozen=True)
class ProbeSlot:
    """One of the control points at which a probe acts in the same step.

    In a step whose hat contains a jump of the control point, the probe acts both at the point before and at the point
    after the jump. A probe has one slot more than the largest number of jumps in a hat, and its segments belong to the
    slots in turn.
    """

    probe: int  # index of the probe in the scene
    segments: tuple[ProbeSegment, ...]  # all segments of the control point, including those of other slots

    @property
    def moves(self) -> bool:
        """Whether the control point moves."""
        return len(self.segments) > 1 or len(self.segments[0].times) > 1

    @property
    def jumps(self) -> Array:
        """Times at which the control point jumps [s], shape (segments - 1,)."""
        return np.array([segment.times[0] for segment in self.segments[1:]])


def probe_slots(probes: Sequence[Probe], sheet: Sheet, h: float) -> tuple[ProbeSlot, ...]:
    """Return the slots of all force-controlled probes, in the order of the probes.

    The half-width h of the hat is the time step [s], or 0 for loads without averages, with one slot per probe.
    """
    slots = []
    for index, probe in enumerate(probes):
        if probe.moved:
            continue
        times, points = control_points(probe, sheet)
        jumps = np.flatnonzero((times[1:] == times[:-1]) & (points[1:] != points[:-1]).any(axis=1)) + 1
        segments = tuple(map(ProbeSegment, np.split(times, jumps), np.split(points, jumps)))
        jump_times = times[jumps]
        hat_ends = jump_times + 2 * h * (1 - HAT_TOLERANCE)
        jumps_in_hat = np.searchsorted(jump_times, hat_ends, "left") - np.arange(len(jump_times))
        slots += [ProbeSlot(index, segments)] * (1 + int(jumps_in_hat.max(initial=0)))
    return tuple(slots)


def build_slots(scene: Scene, grid: TimeGrid) -> tuple[ProbeSlot, ...]:
    """Return the slots of a scene's probes, in their order, one per probe in a quasi-static scene."""
    return probe_slots(scene.probes, scene.sheet, 0.0 if scene.time.at_rest else grid.step)


@dataclass(frozen=True, eq=False)
class Plan:
    """A scene with its material, time grid and tools, built by `planning.make_plan`."""

    scene: Scene  # as read or built by the user
    maps: Maps  # images of its stiffness maps
    fixed: NDArray[np.bool_]  # whether each mass point is fixed or without sheet, shape (rows, cols)
    material: Material  # coefficients of the sheet, with its maps as arrays
    stable_step: float  # largest stable step [s]; infinite without stiffness and damping
    grid: TimeGrid  # frames, steps and precision
    slots: tuple[ProbeSlot, ...]  # control points of the force-controlled probes
    tools: tuple[Tool, ...]  # position-controlled tools
    sha256: Mapping[str, str] = field(default_factory=dict)  # checksums of camera files, by key of the scene

    @property
    def open_edges(self) -> bool:
        """Whether any mass point at an edge can move."""
        return not has_fixed_border(self.fixed)

    @property
    def area_shares(self) -> Array:
        """Area of each mass point as a share of a cell's, shape (rows, cols)."""
        return point_areas(self.material, self.scene.sheet)

    @property
    def mobility(self) -> Array:
        """Inverse mass of each mass point in units of a cell's, 0 if it is fixed, shape (rows, cols)."""
        shares = self.area_shares if self.areas_vary and self.material.by_area else 1.0
        # A point without sheet has no area.
        return ~self.fixed / np.where(self.fixed, 1.0, shares)

    @property
    def areas_vary(self) -> bool:
        """Whether mass points that can move have different areas."""
        return self.open_edges or self.material.shares is not None

    @cached_property
    def loose_parts(self) -> tuple[int, ...]:
        """Parts of a masked sheet, see `Mask.parts`, without a fixed or clamped mass point."""
        mask, held = rest_of(self.scene.sheet).mask, self.fixed.copy()
        if mask is None:
            return ()
        for clamp in clamps(self.tools).values():
            held |= clamp.points
        return tuple(sorted({*range(1, int(mask.parts.max()) + 1)} - mask.parts_with(held)))

    @property
    def is_held(self) -> bool:
        """Whether any mass point of the sheet, and of each of its parts, is fixed or clamped."""
        return not self.loose_parts and (bool(self.fixed.any()) or bool(clamps(self.tools)))

    @property
    def has_contact(self) -> bool:
        """Whether mass points can meet and leave a tool."""
        return bool(solid_tools(self.tools))

    @property
    def step_coefficients(self) -> Coefficients:
        """Coefficients of the steps."""
        material = self.material
        return self.scene.time.integrator.coefficients(material.mass, material.drag, self.grid.step)

    @property
    def convergence_order(self) -> int:
        """Order of the steps: that of the integrator, but 1 with contact."""
        return 1 if self.has_contact else self.scene.time.integrator.order(self.material.drag)

    def with_grid(self, **changes: Any) -> Plan:
        """Return a copy with other attributes of the time grid, such as `steps_per_frame` or `precision`."""
        grid = replace(self.grid, **changes)
        if grid.step == self.grid.step:
            return replace(self, grid=grid)
        return replace(self, grid=grid, slots=build_slots(self.scene, grid))

    def with_probes(self, probes: Sequence[Probe | Mapping[str, Any]]) -> Plan:
        """Return a copy with other probes, each a `Probe` or a mapping of its keys; a SceneError if one is invalid."""
        scene = self.scene.model_copy(update={"probes": tuple(probes)})
        tools = build_tools(scene.probes, scene.sheet)
        return replace(self, scene=scene, slots=build_slots(scene, self.grid), tools=tools)
