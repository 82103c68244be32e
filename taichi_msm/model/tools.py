"""Position-controlled tools, `probes` with `path` in a scene: shapes that touch the sheet, and clamps.

A shape (`taichi_msm.shapes`) has the axis c(t) + s a with 0 <= s <= length, where c is its tip and a the unit vector
along its shaft. It can grip the mass points at its tip. Over a curved sheet the tool follows the surface at rest: with
X the place (across, down) on it, N its normal there and h the height, which are linear between keyframes,
c = X + (h + tip) N, where tip is the height of the shape's tip above its lowest point along N.

A clamp holds a side of the sheet from the start and displaces all its mass points alike.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import heappop, heappush
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import NUMPY, Array
from taichi_msm.errors import Problem
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import SIDES, fixed_points, fixed_sides, rest_positions
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

# Largest number of points between mass points at which a tool may meet a curved sheet at rest.
MAX_POINTS_BETWEEN = 2_000_000

# Distance from a block of cells, in radii of the tool, from which it counts as the distance from the sheet.
CLEARANCE_RADII = 0.01

# A grip holds the mass points within this distance of the tip's centre, in radii of the tip.
GRIP_RADII = 1.5


@dataclass(frozen=True, eq=False)
class Tool(ABC):
    """A position-controlled tool: a probe with a path."""

    probe: int  # index of the probe in the scene
    times: Array  # times of the keyframes [s], shape (n,)
    path: Array  # centres c of the tip, or displacements of a clamp, at the keyframes [m], shape (n, 3)
    stride_limit: float  # largest displacement between two equilibria and, except for a clamp, in a step [m]
    grips: tuple[tuple[float, float], ...]  # start and end of every grip [s]; a clamp, which always holds, has none

    @property
    def rough(self) -> bool:
        """Whether touching mass points stick to the tool."""
        return False

    @property
    def path_length(self) -> float:
        """Length of the whole path [m]."""
        return float(np.linalg.norm(np.diff(self.path_at(self.bends), axis=0), axis=1).sum())

    @property
    def reach(self) -> float:
        """Largest displacement of a mass point by the tool [m]."""
        return self.path_length

    def path_at(self, t: Array) -> Array:
        """Return the path at times t [m], shape (n, 3), constant before its first and after its last keyframe."""
        return _interpolate(t, self.times, self.path)

    @property
    def bends(self) -> Array:
        """Times between which the path is straight, or on a curved sheet smooth [s]."""
        return self.times

    def max_stride(self, step: float, first: int = 0) -> tuple[float, int]:
        """Return the largest displacement in a step [m], and the index of the keyframe after it.

        The path before keyframe `first` is ignored. As a function of the step's begin, the displacement is convex
        between the times at which a bend enters or leaves the step. Its maximum is therefore at one of these times; on
        a curved sheet approximately, as the path between bends is nearly straight.
        """
        bends = self.bends
        begin = np.maximum([0.0, *bends, *(bends - step)], max(0.0, self.times[first] if first else 0.0))
        strides = np.linalg.norm(self.path_at(begin + step) - self.path_at(begin), axis=1)
        longest = int(strides.argmax())
        key = min(int(self.times.searchsorted(begin[longest], "right")), len(self.times) - 1)
        return float(strides[longest]), key

    def substep_times(self, begin: float, end: float) -> Array:
        """Divide a time interval [s] into parts in which the tool moves at most `stride_limit`; return their ends."""
        count, limit = 1, self.stride_limit * (1 + 1e-9)
        while True:
            times = np.linspace(begin, end, count + 1)
            longest = float(np.linalg.norm(np.diff(self.path_at(times), axis=0), axis=1).max())
            if longest <= limit:
                return times[1:]
            count = max(count + 1, int(count * longest / limit))

    @abstractmethod
    def lowest_point(self, t: float) -> tuple[float, float, float]:
        """Return x, y and z of the tip's lowest point at a time, of a clamp its mass points' mean position [m]."""

    @abstractmethod
    def problems(self, scene: Scene, grid: TimeGrid) -> Iterator[Problem]:
        """Yield problems of the path and of the mass points that the tool holds or touches."""

    @abstractmethod
    def warnings(self, scene: Scene) -> Iterator[str]:
        """Yield warnings of implausible lengths in the path."""

    def _length_warnings(self, noun: str, largest: float, sheet: Sheet) -> Iterator[str]:
        if largest > (side := rest_of(sheet).extent):
            fault = f"a {noun} of {largest:g} m, and the sheet is {side:g} m long"
            yield f"probes.{self.probe}.path: {fault}; {noun}s are in metres"


@dataclass(frozen=True, eq=False)
class SolidTool(Tool):
    """A tool with a shape, which touches the sheet."""

    heights: Array  # z of the lowest point of the tip at the keyframes [m], shape (n,)
    axis: Array  # unit vector a from the tip along the shaft, shape (3,)
    length: float  # of the axis [m]
    radius: float  # of tip and shaft [m]
    shape: Shape
    friction: float  # Coulomb's coefficient; infinite if rough

    @property
    def rough(self) -> bool:
        return self.friction == math.inf

    @property
    def reach(self) -> float:
        return self.path_length + self.radius

    def substep_times(self, begin: float, end: float) -> Array:
        """Divide a time interval like a `Tool`, and at the keyframes of a rough tool."""
        keyframes = self.times[self.rough & (self.times > begin) & (self.times < end)]
        return np.union1d(super().substep_times(begin, end), keyframes)

    def lowest_point(self, t: float) -> tuple[float, float, float]:
        x, y, z = (float(np.interp(t, self.times, each)) for each in (*self.path.T[:2], self.heights))
        return x, y, z

    def direction_at(self, t: float) -> Array:  # noqa: ARG002
        """Return the unit vector at a time [s] along which the height of the tip is measured, shape (3,)."""
        return np.array([0.0, 0.0, 1.0])

    def touches(self, positions: Array, t: float) -> bool:
        """Return whether any position [m], shape (n, 3), is in the shape or, up to rounding, on it at a time [s]."""
        r = positions - self.path_at(np.array([t]))[0]
        depth, *_ = self.shape.build_depth(NUMPY)(*r.T, *self.axis, self.length, self.radius)
        return bool((depth > -1e-6 * self.radius).any())

    def point_spacing(self, sheet: Sheet) -> float:
        """Return the largest distance of neighbouring mass points at rest that the tool may touch [m]."""
        return rest_of(sheet).longest_side

    def gap_at(self, centre: Array, sheet: Sheet, points: Array | None = None) -> float:
        """Return the distance from the sheet at rest [m] with the tip's centre c [m], shape (3,); below 0 inside it.

        On a curved sheet it is that from points [m], shape (n, 3), by default its mass points. On a flat sheet with a
        mask it may be too small where the tool is clear of the sheet.
        """
        rest = rest_of(sheet)
        if not rest.is_flat:
            return self._gap_from(rest.hull if points is None else points, centre)
        if rest.mask is not None:
            return self._gap_from_cells(rest.mask.cells, rest.position, centre)
        half = np.array([sheet.size[1] / 2, sheet.size[0] / 2, 0.0])
        return self.shape.gap(centre, self.axis, self.length, self.radius, half)

    def _gap_from(self, points: Array, centre: Array) -> float:
        """Return the distance from points [m], shape (n, 3)."""
        depth, *_ = self.shape.build_depth(NUMPY)(*(points - centre).T, *self.axis, self.length, self.radius)
        return -float(depth.max())

    def _gap_from_cells(self, cells: NDArray[np.bool_], position: Array, centre: Array) -> float:
        """Return the distance from the cells of a flat sheet [m], by dividing the nearest block of cells in two.

        The distance from a block is a lower bound of that from its cells, and returned if the tool is clear of it.
        """
        blocks: list[tuple[float, tuple[int, ...]]] = []

        def add(top: int, bottom: int, left: int, right: int) -> None:
            present = cells[top:bottom, left:right]
            if present.any():
                rows, cols = (np.flatnonzero(present.any(axis=axis)).tolist() for axis in (1, 0))
                block = top + rows[0], top + rows[-1] + 1, left + cols[0], left + cols[-1] + 1
                first, last = position[block[0], block[2]], position[block[1], block[3]]
                tip, half = centre - (first + last) / 2, np.abs(last - first) / 2
                heappush(blocks, (self.shape.gap(tip, self.axis, self.length, self.radius, half), block))

        add(0, cells.shape[0], 0, cells.shape[1])
        while True:
            gap, (top, bottom, left, right) = heappop(blocks)
            if gap > CLEARANCE_RADII * self.radius or cells[top:bottom, left:right].all():
                return gap
            row, col = (top + bottom) // 2, (left + right) // 2
            is_tall = bottom - top > right - left
            add(top, row if is_tall else bottom, left, right if is_tall else col)
            add(row if is_tall else top, bottom, left if is_tall else col, right)

    def keys_at(self, centres: Array, sheet: Sheet) -> Array:
        """Return across, down and height [m] of keyframes for centres c of the tip [m], shape (n, 3) each."""
        heights = centres[:, 2:] - (self.path[0, 2] - self.heights[0])
        return np.concatenate([rest_of(sheet).fractions(centres[:, :2]), heights], axis=1)

    def reaches(self, scene: Scene) -> bool:
        """Return whether the tool meets the sheet at rest at any frame or keyframe."""
        times = np.array([*np.linspace(0, scene.time.duration, scene.time.frames + 1), *self.times])
        centres, points = self.path_at(times[times <= scene.time.duration]), self.points_between(scene.sheet)
        if points is None:
            return any(self.gap_at(centre, scene.sheet) < 0 for centre in centres)
        return any(self._gap_from(points, centre) < 0 for centre in centres)

    def points_between(self, sheet: Sheet, radii: float = 0.5) -> Array | None:
        """Return points of a sheet, some radii or a tenth of a cell apart; None for a flat one without a mask."""
        rest = rest_of(sheet)
        most = min(9, math.isqrt(MAX_POINTS_BETWEEN // math.prod(sheet.points)) - 1)
        if rest.is_flat and rest.mask is None:
            return None
        return rest.refined(max(0, min(most, int(rest.longest_side / (radii * self.radius)))))

    def problems(self, scene: Scene, grid: TimeGrid) -> Iterator[Problem]:
        points = self.points_between(scene.sheet)
        key, depth = ("probes", self.probe, "path"), -self.gap_at(self.path_at(np.zeros(1))[0], scene.sheet, points)
        if depth > 1e-9 * self.radius:
            remedy = "begin above it, at a greater height"
            if self.axis @ self.direction_at(0.0) < 0:
                remedy = "its shaft points down; take the direction from the tip to the handle"
            yield Problem(key, f"the instrument is {depth:.3g} m in the sheet at rest at 0 s; {remedy}")
        if problem := self.friction_problem(at_rest=scene.time.at_rest):
            yield Problem(("probes", self.probe, "friction"), problem)
        if not scene.time.at_rest and (fault := self.speed_problem(grid)):
            hint = f"; {scene.sheet.unit_hint}" if scene.sheet.unit_hint else ""
            yield Problem((*key, fault[0]), fault[1] + hint)

    def friction_problem(self, *, at_rest: bool) -> str:
        """Return a message about friction that is impossible in this kind of motion; empty if possible."""
        if self.rough and not at_rest:
            return "rough needs time.motion: quasistatic; give Coulomb's coefficient, such as 0.3"
        if at_rest and 0 < self.friction < math.inf:
            return f"{self.friction:g} needs time.motion: dynamic, as at rest nothing slides; take rough or 0"
        return ""

    def speed_problem(self, grid: TimeGrid, first: int = 0) -> tuple[int, str] | None:
        """Return the index of the keyframe after the fastest segment, and a message if it is too fast for the step.

        The path before keyframe `first` is ignored.
        """
        stride, key = self.max_stride(grid.step, first)
        if stride <= self.stride_limit * (1 + 1e-9):
            return None
        return key, (
            f"moves {stride:.3g} m in a step of {grid.step:.3g} s, over {self.shape.max_stride:g} of the radius of its "
            f"instrument; move at most {self.stride_limit / grid.step:.3g} m/s, or take a smaller step"
        )

    def places_at(self, t: Array, sheet: Sheet) -> Array:
        """Return across and down of the tip at times [s], shape (n, 2)."""
        return rest_of(sheet).fractions(self.path_at(t)[:, :2])

    def warnings(self, scene: Scene) -> Iterator[str]:
        yield from self._length_warnings("height", float(np.abs(self.heights).max()), scene.sheet)
        places = self.places_at(self.times, scene.sheet)
        outside = ((places < -1e-9) | (places > 1 + 1e-9)).any(axis=1)
        # A tool may come from beyond an edge, above the sheet.
        if outside.all() or (outside & (self.heights <= 0)).any():
            first = int(np.flatnonzero(outside & ((self.heights <= 0) | outside.all()))[0])
            place = f"{places[first, 0]:g} across and {places[first, 1]:g} down"
            yield (
                f"probes.{self.probe}.path: at {self.times[first]:g} s the tip is outside the sheet, at {place}; on "
                "the sheet both are 0 to 1, as fractions of its width and height"
            )
        yield from self._grip_warnings(scene)

    def _grip_warnings(self, scene: Scene) -> Iterator[str]:
        """Yield warnings of grips that begin in a hole or outside the sheet, farther from it than they hold."""
        rest = rest_of(scene.sheet)
        for begin, until in self.grips:
            places = self.places_at(np.array([begin]), scene.sheet)
            point = rest.place(rest.coordinates(places))
            is_sheet = np.ones(scene.sheet.points, bool) if rest.mask is None else rest.mask.points
            gap = float(np.linalg.norm(rest.position[is_sheet] - point, axis=1).min())
            covered = ((places >= 0) & (places <= 1)).all() if rest.mask is None else rest.mask.covers(places)[0]
            if not covered and gap > GRIP_RADII * self.radius:
                fault = f"holds nothing of the sheet at rest, which is {gap:.3g} m from the tip"
                yield f"probes.{self.probe}.grip from {begin:g} to {until:g} s {fault}; move path onto the sheet"


@dataclass(frozen=True, eq=False)
class FollowingTool(SolidTool):
    """A tool over a curved sheet, whose path follows the surface at rest."""

    rest: CurvedRest
    places: Array  # across and down at the keyframes, shape (n, 2)

    def path_at(self, t: Array) -> Array:
        points, normals, heights = self._follow(t)
        directions = normals[:1] if self.shape.is_round else normals  # The tip of a round shape has one height.
        tips = np.array([tip_offset(self.shape, self.axis, self.radius, normal) for normal in directions])
        return points + (heights + tips)[:, None] * normals

    @cached_property
    def bends(self) -> Array:
        # The path is smooth between the edges of cells, and there nearly straight.
        cells = np.abs(np.diff(self.places, axis=0)) @ np.array(self.rest.position.shape[1::-1])
        parts = zip(self.times, self.times[1:], cells, strict=False)
        return np.unique(np.concatenate([self.times, *(np.linspace(a, b, 2 + 8 * int(n)) for a, b, n in parts)]))

    def lowest_point(self, t: float) -> tuple[float, float, float]:
        points, normals, heights = self._follow(np.array([t]))
        x, y, z = (points[0] + heights[0] * normals[0]).tolist()
        return x, y, z

    def point_spacing(self, sheet: Sheet) -> float:  # noqa: ARG002
        places = self.rest.mesh_places(_interpolate(self.bends, self.times, self.places))
        (down, across), count = self.rest.side_lengths(), np.array(self.rest.position.shape[1::-1]) - 1
        # The cells under the path, and those next to them.
        first, last = (np.clip(np.floor(places * count).astype(int) + n, 0, count) for n in (-1, 2))
        windows = ((down[i:k, j : m + 1], across[i : k + 1, j:m]) for (j, i), (m, k) in zip(first, last, strict=True))
        return max(float(np.nan_to_num(each).max(initial=0.0)) for window in windows for each in window)

    def places_at(self, t: Array, sheet: Sheet) -> Array:  # noqa: ARG002
        return _interpolate(t, self.times, self.places)

    def direction_at(self, t: float) -> Array:
        return self._follow(np.array([t]))[1][0]

    def keys_at(self, centres: Array, sheet: Sheet) -> Array:  # noqa: ARG002
        from scipy.optimize import root

        size, keys = self.rest.extent, [np.array([*self.places[0], self.heights[0] / self.rest.extent])]

        def distance(key: Array, centre: Array) -> Array:
            placed = replace(self, times=np.zeros(1), places=key[None, :2], heights=size * key[2:])
            return np.asarray((placed.path_at(np.zeros(1))[0] - centre) / size)

        for centre in centres:
            found = root(distance, keys[-1], centre, tol=1e-14)
            assert np.abs(found.fun).max() < 1e-9, found.message
            keys.append(found.x)
        return np.array(keys[1:]) * (1, 1, size)

    def _follow(self, t: Array) -> tuple[Array, Array, Array]:
        """Return X [m] and N, shape (n, 3) each, and the height [m], shape (n,)."""
        places = _interpolate(t, self.times, self.places)
        return self.rest.place(places), self.rest.normals(places), np.interp(t, self.times, self.heights)


def tip_offset(shape: Shape, axis: Array, radius: float, normal: Array) -> float:
    """Return the height of a shape's tip above its lowest point along a normal [m]."""
    # The shape's formula is for the normal z: an axis at the same angle from it.
    along = float(axis @ normal)
    return shape.tip_height(np.array([float(np.linalg.norm(axis - along * normal)), 0.0, along]), radius)


def _interpolate(t: Array, times: Array, values: Array) -> Array:
    """Interpolate values at keyframes, shape (n, k), at times [s], shape (m,); shape (m, k)."""
    return np.stack([np.interp(t, times, column) for column in values.T], axis=-1)


@dataclass(frozen=True, eq=False)
class Clamp(Tool):
    """A clamp on a side of the sheet."""

    side: Side
    points: NDArray[np.bool_]  # whether the clamp holds each mass point, shape (rows, cols)
    rest_tip: Array  # mean rest position of its mass points [m], shape (3,)

    def lowest_point(self, t: float) -> tuple[float, float, float]:
        x, y, z = (self.rest_tip + self.path_at(np.array([t]))[0]).tolist()
        return x, y, z

    def problems(self, scene: Scene, grid: TimeGrid) -> Iterator[Problem]:  # noqa: ARG002
        key, begin = ("probes", self.probe), [float(self.times[0]), *self.path[0].tolist()]
        if self.side in fixed_sides(scene.sheet):
            yield Problem((*key, "clamp"), f"{self.side} is in sheet.fixed; remove it there, or clamp another side")
        elif (mask := rest_of(scene.sheet).mask) and not mask.points[SIDES[self.side]].any():
            yield Problem((*key, "clamp"), f"{self.side} has no sheet; clamp another side, or draw it in sheet.mask")
        elif not self.points.any():
            text = f"every mass point of {self.side} is fixed or held by an earlier clamp; remove one of them"
            yield Problem((*key, "clamp"), text)
        if any(begin):
            text = f"is {begin}; a clamp begins at rest at 0 s, so put [0, 0, 0, 0] first"
            yield Problem((*key, "path", 0), text)

    def warnings(self, scene: Scene) -> Iterator[str]:
        yield from self._length_warnings("displacement", float(np.linalg.norm(self.path, axis=1).max()), scene.sheet)


def solid_tools(tools: Sequence[Tool]) -> dict[int, SolidTool]:
    """Return the tools with a shape, by their index among all position-controlled tools."""
    return {n: tool for n, tool in enumerate(tools) if isinstance(tool, SolidTool)}


def clamps(tools: Sequence[Tool]) -> dict[int, Clamp]:
    """Return the clamps, by their index among all position-controlled tools."""
    return {n: tool for n, tool in enumerate(tools) if isinstance(tool, Clamp)}


def build_tools(probes: Sequence[Probe], sheet: Sheet) -> tuple[Tool, ...]:
    """Return the position-controlled tools of a scene, in the order of the probes, of which the others are skipped."""
    rest = rest_of(sheet)
    tools: list[Tool] = []
    clamped: list[Side] = []
    for index, probe in enumerate(probes):
        if probe.path is None:
            continue
        if probe.clamp is not None:
            tools.append(_build_clamp(index, probe.clamp, np.array(probe.path, dtype=float), sheet, clamped))
            clamped.append(probe.clamp)
            continue
        assert probe.instrument is not None
        instrument, keys = probe.instrument, np.array(probe.path, dtype=float)
        time, places, heights = keys[:, 0], keys[:, 1:3], keys[:, 3]
        shape, axis, radius = SHAPES[instrument.shape], unit_vector(instrument.shaft), instrument.outer_radius
        path = rest.place(rest.coordinates(places))
        path[:, 2] += heights + shape.tip_height(axis, radius)
        friction = math.inf if probe.friction == "rough" else probe.friction
        stride = min(shape.max_stride, ROUGH_STRIDE_RADII if friction == math.inf else 1) * radius
        numbers = index, time, path, stride, probe.grip, heights, axis, instrument.length, radius, shape, friction
        if isinstance(rest, CurvedRest):
            following = FollowingTool(*numbers, rest, places)
            tools.append(replace(following, path=following.path_at(time)))
        else:
            tools.append(SolidTool(*numbers))
    return tuple(tools)


def _build_clamp(probe: int, side: Side, path: Array, sheet: Sheet, earlier: Sequence[Side]) -> Clamp:
    """Build the clamp of a side, without the mass points that are fixed or belong to earlier clamps."""
    points = np.zeros(sheet.points, dtype=bool)
    points[SIDES[side]] = True
    for clamped in earlier:
        points[SIDES[clamped]] = False
    points &= ~fixed_points(sheet)
    rest_tip = rest_positions(sheet)[points].sum(axis=0) / max(1, points.sum())
    # Half the length of the shortest spring at rest.
    return Clamp(probe, path[:, 0], path[:, 1:], 0.5 * rest_of(sheet).shortest_side, (), side, points, rest_tip)


def unit_vector(shaft: Sequence[float]) -> Array:
    """Normalise a vector."""
    # Division by the largest component first, so that no square overflows.
    axis = np.array(shaft) / max(map(abs, shaft))
    return np.asarray(axis / np.linalg.norm(axis))


def grip_frames(grip: tuple[float, float], rate: float) -> range:
    """Return the frames, `rate` per second, of a quasi-static scene at which a grip [s] holds, up to rounding."""
    begin, end = (max(0, math.ceil(time * rate - FRAME_TOLERANCE)) for time in grip)
    return range(begin, end)


def path_problems(scene: Scene, tools: Sequence[Tool], grid: TimeGrid) -> Iterator[Problem]:
    """Yield problems of tools that begin in the sheet or move too fast, of friction, and of clamps."""
    for tool in tools:
        yield from tool.problems(scene, grid)


def min_steps_per_frame(tools: Sequence[Tool], grid: TimeGrid, min_steps: int) -> int:
    """Return the smallest number of steps per frame, from `min_steps` on, with which no tool is too fast."""

    def speed_ratio(tool: Tool) -> float:
        return tool.max_stride(1 / grid.frames_per_second / min_steps)[0] / tool.stride_limit

    # With n times the steps, the largest displacement in a step is 1 / n of the previous one or more, so repeat.
    while (ratio := max(map(speed_ratio, solid_tools(tools).values()), default=0.0)) > 1 + 1e-9:
        min_steps = max(min_steps + 1, math.ceil(min_steps * ratio * (1 - 1e-9)))
    return min_steps


def path_warnings(scene: Scene, tools: Sequence[Tool]) -> Iterator[str]:
    """Yield warnings of implausible paths and grips, of tools too thin for the mesh, and of tools that intersect."""
    rest, end, solids = rest_of(scene.sheet), scene.time.duration, solid_tools(tools)
    for n, tool in enumerate(tools):
        yield from tool.warnings(scene)
        if tool.times[-1] > end * (1 + 1e-9):
            yield f"probes.{tool.probe}.path ends at {tool.times[-1]:g} s, after the end of the scene at {end:g} s"
        for begin, until in tool.grips:
            if begin >= end:
                yield f"probes.{tool.probe}.grip begins at {begin:g} s, not before the end of the scene at {end:g} s"
            elif scene.time.at_rest and not grip_frames((begin, until), scene.time.frames_per_second):
                yield f"probes.{tool.probe}.grip from {begin:g} to {until:g} s holds nothing: no frame is between them"
        if n not in solids:
            continue
        spacing_max, radius = solids[n].point_spacing(scene.sheet), solids[n].radius
        if spacing_max > (limit := MAX_SPACING_RADII * radius):
            lengths = scene.sheet.size if rest.is_flat else [(count - 1) * spacing_max for count in scene.sheet.points]
            points = [int(np.ceil(length / limit)) + 1 for length in lengths]
            affordable = math.prod(points) <= MAX_POINTS_RATIO * math.prod(scene.sheet.points)
            remedy = f"try sheet.points: {points}" if affordable else "take a wider tip"
            yield (
                f"probes.{tool.probe}: the points are {spacing_max:.3g} m apart, more than half the radius of the "
                f"instrument, {radius:.3g} m, {COARSE_TIP_PHRASE}; {remedy}"
            )

    if (intersection := overlap(tools, scene.time.duration)) is not None:
        first, second, time = intersection
        yield (
            f"probes.{first} and probes.{second}: their instruments run through each other at {time:.3g} s, so that "
            "the sheet cannot be outside both; keep them apart"
        )


def overlap(tools: Sequence[Tool], duration: float) -> tuple[int, int, float] | None:
    """Return the probes of the first two capsules that intersect, and the time [s], at 1025 equidistant times."""
    times = np.linspace(0, duration, 1025)
    for a, b in combinations([tool for tool in solid_tools(tools).values() if tool.shape.is_round], 2):
        distance = _axis_distance(a, b, a.path_at(times) - b.path_at(times))
        intersecting = np.flatnonzero(distance < (1 - 1e-9) * (a.radius + b.radius))
        if intersecting.size:
            return a.probe, b.probe, float(times[intersecting[0]])
    return None


def _axis_distance(a: SolidTool, b: SolidTool, offset: Array) -> Array:
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
