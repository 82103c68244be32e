"""Path dependence of quasi-static equilibria, shown by jumps and by second solutions on another loading path.

A sheet that buckles or wrinkles has several equilibria under one load. There are three signs of this. Between two
frames the sheet moves much farther, relative to the change of the loads, than between the frames before and after. Two
frames under equal loads differ, for example in loading and unloading. The sheet reaches another equilibrium if the
loads of a frame act at once on the flat sheet and tools move straight to their positions.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.errors import DivergedError, Pause
from taichi_msm.model.loads import FrameLoad
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import grip_frames
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import affords_companions, plan_variant
from taichi_msm.solver.rest import build_dynamics
from taichi_msm.system.runtime import Device

# Shapes that differ by more than this share of the largest displacement are different equilibria.
DIFFERENCE_TOLERANCE = 0.01

# Smallest ratio of the movement in a jump to that between the frames before and after it, for the same change of the
# loads. A sheet without tension, which moves as the cube root of its load, reaches 4.5 where the load changes its sign.
JUMP_FACTOR = 6.0

# Number of second solutions, and the cost of each, from rest, in frames of the run.
SECOND_SOLUTIONS, SECOND_SOLUTION_FRAMES = 3, 3

# Largest number of mass points in all frames together for which frames under equal loads are compared.
MAX_COMPARED_NODES = 2_000_000

# Loads that differ by less than this share of their largest values are equal.
LOAD_TOLERANCE = 1e-9

Array = NDArray[Any]


class PathDependence:
    """Monitor of the path dependence of a quasi-static run."""

    def __init__(self, plan: Plan) -> None:
        self._plan, self._loads = plan, _LoadingPath(plan)
        # Previous frame, frame with the largest displacement, and the first frame after it with less than half of that.
        self._previous: tuple[int, Array] | None = None
        self._largest, self._most_displaced = 0.0, (0, np.zeros(()))
        self._unloaded: tuple[int, Array] | None = None
        # Movement of the last frames [m], and change of their loads.
        self._moves: deque[tuple[float, float]] = deque(maxlen=3)
        self._jumps: dict[int, float] = {}
        self._equal_load_distances: dict[int, float] = {}
        self._second_distances: dict[int, float] = {}
        # Tissue that relaxes, and mass points that stick to tools, depend on the history of the loads in any case.
        self._has_history = bool(plan.material.relaxation) or any(tool.rough for tool in plan.tools)
        nodes = (plan.grid.frames + 1) * math.prod(plan.scene.sheet.points)
        compares = nodes <= MAX_COMPARED_NODES and not self._has_history
        self._by_load: dict[tuple[int, ...], Array] | None = {} if compares else None

    def check_frame(self, frame: int, displacement: Array) -> None:
        """Compare the displacements of the next frame [m], shape (rows, cols, 3), with those of earlier frames."""
        size, current = max_norm(displacement), (frame, displacement)
        if size > self._largest:
            self._largest, self._most_displaced, self._unloaded = size, current, None
        elif self._unloaded is None and size < self._largest / 2:
            self._unloaded = current
        if self._previous is not None and self._previous[0] == frame - 1:
            self._moves.append((max_norm(displacement - self._previous[1]), self._loads.change(frame)))
            if len(self._moves) == 3 and min(change for _, change in self._moves) > 0:
                before, rate, after = (distance / change for distance, change in self._moves)
                if rate > JUMP_FACTOR * max(before, after):
                    self._jumps[frame - 1] = self._moves[1][0]
        if self._by_load is not None and (loads := self._loads.key(frame)):
            earlier = self._by_load.setdefault(loads, displacement)
            self._equal_load_distances[frame] = max_norm(displacement - earlier)
        self._previous = current

    def affords(self, companion_cost: float) -> bool:
        """Return whether second solutions, in addition to companion runs of a cost, are a small part of the run."""
        second_cost = SECOND_SOLUTIONS * SECOND_SOLUTION_FRAMES / (self._plan.grid.frames + 1)
        return affords_companions(self._plan, companion_cost + second_cost)

    def finish(self, device: Device, cores: int | None, pause: Pause) -> None:
        """Solve the most displaced frame, one after it and the last frame a second time, see `second_solution`."""
        if self._largest == 0 or self._has_history:
            return
        for frame, displacement in dict(filter(None, (self._most_displaced, self._unloaded, self._previous))).items():
            second = second_solution(self._plan, frame, device, cores, pause)
            if second is not None:
                self._second_distances[frame] = max_norm(displacement - second)

    def warnings(self) -> Iterator[str]:
        """Warn of the frame that differs most from the result of another loading path."""
        rate, remedy = self._plan.grid.frames_per_second, "tissue.pretension, bending or a stiffer foundation"
        if self._plan.scene.tissue is None:
            remedy = "larger springs.virtual"
        candidates = [
            (distance / max(self._largest, 1e-300), frame, text)
            for distances, text in (
                (self._jumps, "from the frame before the sheet jumps by {} of the largest displacement"),
                (
                    self._equal_load_distances,
                    "the sheet is {} of the largest displacement away from an earlier frame of equal loads",
                ),
                (
                    self._second_distances,
                    "loaded at once, from rest, the sheet differs by {} of the largest displacement",
                ),
            )
            for frame, distance in distances.items()
        ]
        share, frame, text = max(candidates, default=(0.0, 0, ""))
        if share > DIFFERENCE_TOLERANCE:
            yield (
                f"path-dependent at {frame / rate:.6g} s, frame {frame}: {text.format(f'{100 * share:.2g} %')}: there "
                "are several equilibria under one load, as the sheet buckles, wrinkles or slips off a tool, and what "
                f"was found holds for this way of loading alone; {remedy} may leave one equilibrium"
            )


def second_solution(plan: Plan, frame: int, device: Device, cores: int | None, pause: Pause) -> Array | None:
    """Solve a frame from rest: its loads act at once, then tools move straight from their first positions.

    Args:
        plan: Plan of a quasi-static scene.
        frame: Number of the frame.
        device: Device to solve on.
        cores: Number of CPU cores; None for all.
        pause: Called often; an exception from it ends the solution.

    Returns:
        Displacements [m], shape (rows, cols, 3). None if a tool holds tissue at this frame, which depends on its path,
        or if there is no equilibrium.
    """
    scene, rate = plan.scene, plan.grid.frames_per_second
    if any(frame in grip_frames(grip, rate) for tool in plan.tools for grip in tool.grips):
        return None
    probes = tuple(_load_at_once(plan, probe, frame) for probe in scene.probes)
    time = scene.time.model_copy(update={"duration": 1.0, "frames_per_second": 1})
    sheet = build_dynamics(
        plan_variant(plan, scene.model_copy(update={"probes": probes, "time": time})), device, cores=cores
    )
    try:
        sheet.advance(1, pause)
        return sheet.displacement()
    except DivergedError:
        return None
    finally:
        sheet.close()


def _load_at_once(plan: Plan, probe: Probe, frame: int) -> Probe:
    """Return a probe with the load of a frame from 0 s on, or with a straight path to its position at the frame."""
    rate, sheet = plan.grid.frames_per_second, plan.scene.sheet
    if probe.path is None:
        percent, (x, y) = FrameLoad(probe, sheet).at(frame, rate)
        at = (x / sheet.size[1] + 0.5, 0.5 - y / sheet.size[0])
        return probe.model_copy(update={"load": ((0.0, percent),), "at": at})
    times, *coordinates = np.array(probe.path, dtype=float).T
    position = (float(np.interp(frame / rate, times, each)) for each in coordinates)
    # After its last keyframe a tool does not count as pressing.
    end = 1.0 if frame / rate <= times[-1] else 0.5
    return probe.model_copy(update={"path": ((0.0, *probe.path[0][1:]), (end, *position)), "grip": ()})


class _LoadingPath:
    """The loads and tool positions of a plan at its frames."""

    def __init__(self, plan: Plan) -> None:
        scene, self._rate, self._tools = plan.scene, plan.grid.frames_per_second, plan.tools
        probes = [probe for probe in scene.probes if not probe.moved]
        self._probes = [
            (FrameLoad(probe, scene.sheet), max(abs(percent) for _, percent in probe.load) or 1.0) for probe in probes
        ]
        self._size = max(scene.sheet.size)

    def key(self, frame: int) -> tuple[int, ...]:
        """Return a key of the loads that is equal for equal loads; empty while a tool holds tissue."""
        rate = self._rate
        if any(frame in grip_frames(grip, rate) for tool in self._tools for grip in tool.grips):
            return ()
        shares = [
            number
            for load, peak in self._probes
            for percent, (x, y) in (load.at(frame, rate),)
            for number in (percent / peak, x / self._size, y / self._size)
        ]
        for tool in self._tools:
            pressing = tool.times[0] <= frame / rate <= tool.times[-1]
            shares += [pressing, *tool.tip_centre(np.array([frame / rate]))[0] / self._size]
        return tuple(np.rint(np.array(shares) / LOAD_TOLERANCE).astype(np.int64).tolist())

    def change(self, frame: int) -> float:
        """Return the relative change of loads and tools since the previous frame; 0 if a grip begins or ends."""
        change = 0.0
        for load, peak in self._probes:
            (before, start), (after, end) = (load.at(each, self._rate) for each in (frame - 1, frame))
            change += abs(after - before) / peak + float(np.linalg.norm(end - start)) / self._size
        for tool in self._tools:
            frames = [grip_frames(grip, self._rate) for grip in tool.grips]
            if any((frame in gripped) != (frame - 1 in gripped) for gripped in frames):
                return 0.0
            before, after = tool.tip_centre(np.array([frame - 1, frame]) / self._rate)
            change += math.dist(before, after) / max(tool.path_length, 1e-300)
        return change
