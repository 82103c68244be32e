"""Position-controlled tools, `probes` with `path` in a scene: shapes that touch the sheet, and clamps.

A shape (`taichi_msm.shapes`) has the axis c(t) + s a with 0 <= s <= length, where c is its tip and a the unit vector
along its shaft. It can grip the mass points at its tip.

A clamp holds a side of the sheet from the start. It is a tool of radius 0, which touches nothing, and c is its
displacement.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import NUMPY
from taichi_msm.errors import Problem
from taichi_msm.model.sheet import SIDES, fixed_points, fixed_sides, rest_positions, spacing
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE, Side
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe
from taichi_msm.shapes import SHAPES
from taichi_msm.shapes.shape import Shape

# Largest displacement of a rough tool between two equilibria, in radii of the tool. It limits the error of the places
# where mass points stick, on which the tool's force depends.
ROUGH_STRIDE_RADII = 1 / 16

# Largest spacing of mass points without a warning, in radii of the tool; a larger one makes the contact force uneven.
MAX_SPACING_RADII = 0.5
COARSE_TIP_PHRASE = "which touches few of them"

# Largest number of mass points that a remedy suggests, as a multiple of the sheet's.
MAX_POINTS_RATIO = 4

# A grip holds the mass points within this distance of the tip's centre, in radii of the tip.
GRIP_RADII = 1.5

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Tool:
    """A position-controlled tool: a probe with a path."""

    probe: int  # index of the probe in the scene
    times: Array  # times of the keyframes [s], shape (n,)
    tip_centres: Array  # c at the keyframes [m], shape (n, 3)
    heights: Array  # z of the lowest point of the tip at the keyframes [m], shape (n,)
    axis: Array  # unit vector a from the tip along the shaft, shape (3,)
    length: float  # of the axis [m]
    radius: float  # of tip and shaft [m]
    shape: Shape
    friction: float  # Coulomb's coefficient; infinite if rough
    grips: tuple[tuple[float, float], ...]  # start and end of every grip [s]
    stride_limit: float  # largest displacement between two equilibria and, except for a clamp, in a step [m]

    @property
    def rough(self) -> bool:
        """Whether touching mass points stick to the tool."""
        return self.friction == math.inf

    @property
    def path_length(self) -> float:
        """Length of the whole path [m]."""
        return float(np.linalg.norm(np.diff(self.tip_centres, axis=0), axis=1).sum())

    def max_stride(self, step: float, first: int = 0) -> tuple[float, int]:
        """Find the largest displacement of the tool in a step.

        As a function of the step's begin, the displacement is convex between the times at which a keyframe enters or
        leaves the step. Its maximum is therefore at one of these times.

        Args:
            step: time step [s].
            first: index of the keyframe before which the path is ignored.

        Returns:
            The displacement [m], and the index of the keyframe at the end of its path segment.
        """
        begin = np.maximum([0.0, *self.times, *(self.times - step)], max(0.0, self.times[first] if first else 0.0))
        strides = np.linalg.norm(self.tip_centre(begin + step) - self.tip_centre(begin), axis=1)
        longest = int(strides.argmax())
        key = min(int(self.times.searchsorted(begin[longest], "right")), len(self.times) - 1)
        return float(strides[longest]), key

    def tip_centre(self, t: Array) -> Array:
        """Return the tip's centre c [m] at times t [s], shape (n, 3), constant before and after the path."""
        return np.stack([np.interp(t, self.times, self.tip_centres[:, axis]) for axis in range(3)], axis=-1)

    def lowest_point(self, t: float) -> tuple[float, float, float]:
        """Return x, y and z [m] of the lowest point of the tip at a time t [s]."""
        x, y, z = (float(np.interp(t, self.times, each)) for each in (*self.tip_centres.T[:2], self.heights))
        return x, y, z

    def touches(self, positions: Array, t: float) -> bool:
        """Return whether any position is inside the shape or, up to rounding, on its surface.

        Args:
            positions: positions of mass points [m], shape (n, 3).
            t: time [s].
        """
        r = positions - self.tip_centre(np.array([t]))[0]
        depth, *_ = self.shape.build_depth(NUMPY)(*r.T, *self.axis, self.length, self.radius)
        return bool((depth > -1e-6 * self.radius).any())

    def substep_times(self, begin: float, end: float) -> Array:
        """Divide a time interval so that the tool moves at most `stride_limit` in each part, and a rough one straight.

        Args:
            begin: start of the interval [s].
            end: end of the interval [s].

        Returns:
            Ends of the parts [s], shape (parts,); the last is `end`.
        """
        count, limit = 1, self.stride_limit * (1 + 1e-9)
        while True:
            times = np.linspace(begin, end, count + 1)
            longest = float(np.linalg.norm(np.diff(self.tip_centre(times), axis=0), axis=1).max())
            if longest <= limit:
                bends = self.times[self.rough & (self.times > begin) & (self.times < end)]
                return np.union1d(times[1:], bends)
            count = max(count + 1, int(count * longest / limit))


@dataclass(frozen=True, eq=False)
class Clamp(Tool):
    """A clamp on a side of the sheet; `tip_centres` are its displacements, `heights` their z."""

    side: Side
    points: NDArray[np.bool_]  # whether the clamp holds each mass point, shape (rows, cols)
    rest_tip: Array  # mean rest position of its mass points [m], shape (3,)

    def lowest_point(self, t: float) -> tuple[float, float, float]:
        """Return the mean position of its mass points, x, y and z [m], at a time t [s]."""
        x, y, z = (self.rest_tip + self.tip_centre(np.array([t]))[0]).tolist()
        return x, y, z


def touching_tools(tools: Sequence[Tool]) -> list[Tool]:
    """Return the tools with a shape, all but clamps, in their order."""
    return [tool for tool in tools if not isinstance(tool, Clamp)]


def build_tools(probes: Sequence[Probe], sheet: Sheet) -> tuple[Tool, ...]:
    """Return the position-controlled tools of a scene, in the order of the probes.

    Args:
        probes: all probes of the scene; force-controlled ones are skipped.
        sheet: supplies the size, the mass points of clamps and the fixed mass points.
    """
    height, width = sheet.size
    tools: list[Tool] = []
    for index, probe in enumerate(probes):
        if probe.path is None:
            continue
        if probe.clamp is not None:
            earlier = [tool for tool in tools if isinstance(tool, Clamp)]
            tools.append(_build_clamp(index, probe.clamp, np.array(probe.path, dtype=float), sheet, earlier))
            continue
        assert probe.instrument is not None
        instrument, (time, across, down, heights) = probe.instrument, np.array(probe.path, dtype=float).T
        shape, axis, radius = SHAPES[instrument.shape], unit_vector(instrument.shaft), instrument.outer_radius
        tips = heights + shape.tip_height(axis, radius)
        tip_centres = np.stack([(across - 0.5) * width, (0.5 - down) * height, tips], axis=1)
        solid = axis, instrument.length, radius, shape
        friction = math.inf if probe.friction == "rough" else probe.friction
        stride = min(shape.max_stride, ROUGH_STRIDE_RADII if friction == math.inf else 1) * radius
        tools.append(Tool(index, time, tip_centres, heights, *solid, friction, probe.grip, stride))
    return tuple(tools)


def _build_clamp(probe: int, side: Side, path: Array, sheet: Sheet, earlier: Sequence[Clamp]) -> Clamp:
    """Build the clamp of a side, without the mass points that are fixed or belong to earlier clamps."""
    points = np.zeros(sheet.points, dtype=bool)
    points[SIDES[side]] = True
    for taken in (fixed_points(sheet), *(clamp.points for clamp in earlier)):
        points &= ~taken
    rest_tip = rest_positions(sheet)[points].sum(axis=0) / max(1, points.sum())
    solid = np.array([0.0, 0.0, 1.0]), 0.0, 0.0, SHAPES["capsule"]
    # Half the length of the shortest spring at rest.
    stride = 0.5 * min(spacing(sheet))
    return Clamp(probe, path[:, 0], path[:, 1:], path[:, 3], *solid, 0.0, (), stride, side, points, rest_tip)


def unit_vector(shaft: Sequence[float]) -> Array:
    """Normalise a vector."""
    # Division by the largest component first, so that no square overflows.
    axis = np.array(shaft) / max(map(abs, shaft))
    return np.asarray(axis / np.linalg.norm(axis))


def grip_frames(grip: tuple[float, float], rate: float) -> range:
    """Return the frames of a quasi-static scene at which a grip holds, up to rounding.

    Args:
        grip: start and end of the grip [s].
        rate: frames per second [1/s].
    """
    begin, end = (max(0, math.ceil(time * rate - FRAME_TOLERANCE)) for time in grip)
    return range(begin, end)


def path_problems(scene: Scene, tools: Sequence[Tool], grid: TimeGrid) -> Iterator[Problem]:
    """Yield problems of tools that begin in the sheet or move too fast, of friction, and of clamps.

    Args:
        scene: supplies the sheet and the kind of motion.
        tools: position-controlled tools of the scene.
        grid: supplies the step, which limits the speed of tools.
    """
    for tool in tools:
        key = ("probes", tool.probe, "path")
        if isinstance(tool, Clamp):
            yield from _clamp_problems(tool, scene)
            continue
        depth = -gap_to_sheet(tool, scene.sheet)
        if depth > 1e-9 * tool.radius:
            remedy = "begin above it, at a greater height"
            if tool.axis[2] < 0:
                remedy = "its shaft points down; take the direction from the tip to the handle"
            yield Problem(key, f"the instrument is {depth:.3g} m in the sheet at rest at 0 s; {remedy}")
        if problem := friction_problem(tool, at_rest=scene.time.at_rest):
            yield Problem(("probes", tool.probe, "friction"), problem)
        if not scene.time.at_rest and (fault := speed_problem(tool, grid)):
            hint = f"; {scene.sheet.unit_hint}" if scene.sheet.unit_hint else ""
            yield Problem((*key, fault[0]), fault[1] + hint)


def friction_problem(tool: Tool, *, at_rest: bool) -> str:
    """Return a message about friction that is impossible in this kind of motion; empty if possible.

    Args:
        tool: position-controlled tool.
        at_rest: whether the scene is quasi-static.
    """
    if tool.rough and not at_rest:
        return "rough needs time.motion: quasistatic; give Coulomb's coefficient, such as 0.3"
    if at_rest and 0 < tool.friction < math.inf:
        return f"{tool.friction:g} needs time.motion: dynamic, as at rest nothing slides; take rough or 0"
    return ""


def _clamp_problems(clamp: Clamp, scene: Scene) -> Iterator[Problem]:
    key, begin = ("probes", clamp.probe), [float(clamp.times[0]), *clamp.tip_centres[0].tolist()]
    if clamp.side in fixed_sides(scene.sheet):
        yield Problem((*key, "clamp"), f"{clamp.side} is in sheet.fixed; remove it there, or clamp another side")
    elif not clamp.points.any():
        text = f"every mass point of {clamp.side} is fixed or held by an earlier clamp; remove one of them"
        yield Problem((*key, "clamp"), text)
    if any(begin):
        text = f"is {begin}; a clamp begins at rest at 0 s, so put [0, 0, 0, 0] first"
        yield Problem((*key, "path", 0), text)


def speed_problem(tool: Tool, grid: TimeGrid, first: int = 0) -> tuple[int, str] | None:
    """Return the index of the keyframe after the fastest segment, and a message about the speed.

    The result is None for a tool that is slow enough for the time step, and for a clamp.

    Args:
        tool: position-controlled tool.
        grid: supplies the step.
        first: index of the keyframe before which the path is ignored.
    """
    stride, key = tool.max_stride(grid.step, first)
    if isinstance(tool, Clamp) or stride <= tool.stride_limit * (1 + 1e-9):
        return None
    return key, (
        f"moves {stride:.3g} m in a step of {grid.step:.3g} s, over {tool.shape.max_stride:g} of the radius of its "
        f"instrument; move at most {tool.stride_limit / grid.step:.3g} m/s, or take a smaller step"
    )


def min_steps_per_frame(tools: Sequence[Tool], grid: TimeGrid, min_steps: int) -> int:
    """Return the smallest number of steps per frame with which no tool is too fast.

    Args:
        tools: position-controlled tools.
        grid: supplies the frame rate.
        min_steps: lower bound of the number.
    """

    def speed_ratio(tool: Tool) -> float:
        return tool.max_stride(1 / grid.frames_per_second / min_steps)[0] / tool.stride_limit

    # With n times the steps, the largest displacement in a step is 1 / n of the previous one or more, so repeat.
    while (ratio := max(map(speed_ratio, touching_tools(tools)), default=0.0)) > 1 + 1e-9:
        min_steps = max(min_steps + 1, math.ceil(min_steps * ratio * (1 - 1e-9)))
    return min_steps


def path_warnings(scene: Scene, tools: Sequence[Tool]) -> Iterator[str]:
    """Yield warnings of implausible paths and grips, of tools too thin for the mesh, and of tools that intersect.

    Args:
        scene: supplies the sheet and the duration.
        tools: position-controlled tools of the scene.
    """
    spacing_max, side, end = max(spacing(scene.sheet)), max(scene.sheet.size), scene.time.duration
    for tool in tools:
        if isinstance(tool, Clamp):
            if (distance := float(np.linalg.norm(tool.tip_centres, axis=1).max())) > side:
                yield (
                    f"probes.{tool.probe}.path: a displacement of {distance:g} m, and the sheet is {side:g} m long; "
                    "displacements are in metres"
                )
        elif (height_max := float(np.abs(tool.heights).max())) > side:
            yield (
                f"probes.{tool.probe}.path: a height of {height_max:g} m, and the sheet is {side:g} m long; "
                "heights are in metres"
            )
        if tool.times[-1] > end * (1 + 1e-9):
            yield f"probes.{tool.probe}.path ends at {tool.times[-1]:g} s, after the end of the scene at {end:g} s"
        for begin, until in tool.grips:
            if begin >= end:
                yield f"probes.{tool.probe}.grip begins at {begin:g} s, not before the end of the scene at {end:g} s"
            elif scene.time.at_rest and not grip_frames((begin, until), scene.time.frames_per_second):
                yield f"probes.{tool.probe}.grip from {begin:g} to {until:g} s holds nothing: no frame is between them"
        if not isinstance(tool, Clamp) and spacing_max > MAX_SPACING_RADII * tool.radius:
            points = [int(np.ceil(length / (MAX_SPACING_RADII * tool.radius))) + 1 for length in scene.sheet.size]
            affordable = math.prod(points) <= MAX_POINTS_RATIO * math.prod(scene.sheet.points)
            remedy = f"try sheet.points: {points}" if affordable else "take a wider tip"
            yield (
                f"probes.{tool.probe}: the points are {spacing_max:.3g} m apart, more than half the radius of the "
                f"instrument, {tool.radius:.3g} m, {COARSE_TIP_PHRASE}; {remedy}"
            )

    if (intersection := overlap(tools, scene.time.duration)) is not None:
        first, second, time = intersection
        yield (
            f"probes.{first} and probes.{second}: their instruments run through each other at {time:.3g} s, so that "
            "the sheet cannot be outside both; keep them apart"
        )


def overlap(tools: Sequence[Tool], duration: float) -> tuple[int, int, float] | None:
    """Find the first intersection of two capsules, at 1025 equidistant times.

    Args:
        tools: position-controlled tools; plates and clamps are skipped.
        duration: duration of the scene [s].

    Returns:
        Indices of their probes, and the first time [s]; None if no tools intersect.
    """
    times = np.linspace(0, duration, 1025)
    for a, b in combinations([tool for tool in touching_tools(tools) if tool.shape.is_round], 2):
        distance = _axis_distance(a, b, a.tip_centre(times) - b.tip_centre(times))
        intersecting = np.flatnonzero(distance < (1 - 1e-9) * (a.radius + b.radius))
        if intersecting.size:
            return a.probe, b.probe, float(times[intersecting[0]])
    return None


def _axis_distance(a: Tool, b: Tool, offset: Array) -> Array:
    """Return the distances of the axes of two tools [m], shape (n,), at offsets of tip a from tip b, shape (n, 3)."""

    def from_end(offset: Array, axis: Array, length: float) -> Array:
        return np.asarray(np.linalg.norm(offset - np.clip(offset @ axis, 0, length)[:, None] * axis, axis=1))

    # Distance of an end of either axis from the other axis.
    distance = np.minimum(
        np.minimum(*(from_end(offset + s * a.axis, b.axis, b.length) for s in (0, a.length))),
        np.minimum(*(from_end(s * b.axis - offset, a.axis, a.length) for s in (0, b.length))),
    )
    # Distance of the infinite lines, at the minimum of |offset + s a - t b|, if both nearest points lie on the axes.
    normal = np.cross(a.axis, b.axis)
    if (square := float(normal @ normal)) > 1e-12:
        cosine, along_a, along_b = a.axis @ b.axis, offset @ a.axis, offset @ b.axis
        s, t = (cosine * along_b - along_a) / square, (along_b - cosine * along_a) / square
        inside = (s >= 0) & (s <= a.length) & (t >= 0) & (t <= b.length)
        distance = np.where(inside, np.minimum(distance, abs(offset @ normal) / math.sqrt(square)), distance)
    return distance


def gap_to_sheet(tool: Tool, sheet: Sheet, time: float = 0.0) -> float:
    """Return the distance of a tool at a time from the sheet at rest [m], negative inside the sheet.

    Args:
        tool: position-controlled tool with a shape.
        sheet: supplies the size.
        time: time [s].
    """
    half = np.array([sheet.size[1] / 2, sheet.size[0] / 2, 0.0])
    return tool.shape.gap(tool.tip_centre(np.array([time]))[0], tool.axis, tool.length, tool.radius, half)


def reaches_sheet(tool: Tool, scene: Scene) -> bool:
    """Return whether a tool meets the sheet at rest at any frame or keyframe.

    Args:
        tool: position-controlled tool with a shape.
        scene: supplies the sheet and the frames.
    """
    times = [*np.linspace(0, scene.time.duration, scene.time.frames + 1), *tool.times]
    return any(gap_to_sheet(tool, scene.sheet, time) < 0 for time in times if time <= scene.time.duration)
