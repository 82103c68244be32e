"""Path dependence of quasi-static equilibria.

A sheet that buckles or wrinkles has several equilibria under one load. Two checks detect them:

- Jump: relative to the change of the loads, the sheet moves much farther between two frames than between the frames
  before and after them.
- Second solution: the sheet reaches another equilibrium if all loads of a frame act at once on the sheet at rest, and
  tools move straight to their positions. This also detects different shapes in loading and unloading.
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
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tools import grip_frames
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import affords_companions, plan_variant
from taichi_msm.solver.rest import build_solver
from taichi_msm.system.runtime import Device
from taichi_msm.terms import build_terms

# Smallest ratio of the movement in a jump to that between the frames before and after it, each per change of the loads.
# The ratio of a sheet without tension, which moves as the cube root of its load, is 4.5 at a change of the load's sign.
JUMP_FACTOR = 6.0

Array = NDArray[Any]


class PathDependence:
    """Monitor of the path dependence of a quasi-static run."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        pushing = [probe for probe in plan.scene.probes if not probe.moved]
        peaks = [max(abs(percent) for _, percent in probe.load) or 1.0 for probe in pushing]
        self._loads = [(FrameLoad(probe, plan.scene.sheet), peak) for probe, peak in zip(pushing, peaks, strict=True)]
        # Frames, as a pair of number and displacements: the previous one, the one with the largest displacement, and
        # the first one after that with less than half of it.
        self._previous: tuple[int, Array] | None = None
        self._largest, self._most_displaced = 0.0, (0, np.zeros(()))
        self._unloaded: tuple[int, Array] | None = None
        # Movement of the last frames [m], and change of their loads.
        self._moves: deque[tuple[float, float]] = deque(maxlen=3)
        # Distance from the result of another loading path [m], frame, and description.
        self._differences: list[tuple[float, int, str]] = []

    def check_frame(self, frame: int, displacement: Array) -> None:
        """Check the next frame for a jump, and keep it for second solutions; `displacement` [m]: (rows, cols, 3)."""
        size, current = max_norm(displacement), (frame, displacement)
        if size > self._largest:
            self._largest, self._most_displaced, self._unloaded = size, current, None
        elif self._unloaded is None and size < self._largest / 2:
            self._unloaded = current
        if self._previous is not None and self._previous[0] == frame - 1:
            self._moves.append((max_norm(displacement - self._previous[1]), self._load_change(frame)))
            if len(self._moves) == 3 and min(change for _, change in self._moves) > 0:
                before, rate, after = (distance / change for distance, change in self._moves)
                if rate > JUMP_FACTOR * max(before, after):
                    description = "since the previous frame the sheet jumped by"
                    self._differences.append((self._moves[1][0], frame - 1, description))
        self._previous = current

    def _load_change(self, frame: int) -> float:
        """Return the relative change of loads and tools since the previous frame; 0 if a grip begins or ends."""
        change, rate, rest = 0.0, self._plan.grid.frames_per_second, rest_of(self._plan.scene.sheet)
        for load, peak in self._loads:
            (before, start), (after, end) = (load.at(each, rate) for each in (frame - 1, frame))
            change += abs(after - before) / peak + math.dist(*rest.place(np.stack([start, end]))) / rest.extent
        for tool in self._plan.tools:
            grips = [grip_frames(grip, rate) for grip in tool.grips]
            if any((frame in grip) != (frame - 1 in grip) for grip in grips):
                return 0.0
            before, after = tool.path_at(np.array([frame - 1, frame]) / rate)
            change += math.dist(before, after) / max(tool.path_length, 1e-300)
        return change

    def affords(self, companion_cost: float) -> bool:
        """Return whether second solutions and companion runs of a given cost together cost a small part of the run."""
        # Three second solutions, each at the cost of about three frames, as it begins at rest.
        second_cost = 3 * 3 / (self._plan.grid.frames + 1)
        return affords_companions(self._plan, companion_cost + second_cost)

    def finish(self, device: Device, cores: int | None, pause: Pause) -> None:
        """Solve the most displaced frame, a later half-unloaded frame and the last frame again by `second_solution`."""
        has_history = any(term.has_history(self._plan) for term in build_terms(self._plan))
        if self._largest == 0 or has_history:
            return
        for frame, displacement in dict(filter(None, (self._most_displaced, self._unloaded, self._previous))).items():
            second = second_solution(self._plan, frame, device, cores, pause)
            if second is not None:
                description = "loaded at once, from rest, the sheet differs by"
                self._differences.append((max_norm(displacement - second), frame, description))

    def warnings(self) -> Iterator[str]:
        """Warn of the frame with the largest difference between loading paths."""
        distance, frame, description = max(self._differences, default=(0.0, 0, ""))
        # A difference above 1 % of the largest displacement means different equilibria.
        if distance > 0.01 * self._largest:
            remedy = "tissue.pretension, bending or a stiffer foundation"
            if self._plan.scene.sheet.surface:
                remedy = "tissue.pretension or a stiffer foundation"
            if self._plan.scene.tissue is None:
                remedy = "larger springs.virtual"
            yield (
                f"path-dependent at {frame / self._plan.grid.frames_per_second:.6g} s, frame {frame}: {description} "
                f"{100 * distance / self._largest:.2g} % of the largest displacement: there are several equilibria "
                "under one load, as the sheet buckles, wrinkles or slips off a tool, and the result holds for this "
                f"loading path only; {remedy} may leave one equilibrium"
            )


def second_solution(plan: Plan, frame: int, device: Device, cores: int | None, pause: Pause) -> Array | None:
    """Solve a frame from rest: its loads act at once, then tools move straight from their first positions.

    Return displacements [m], shape (rows, cols, 3); None without an equilibrium, or in a grip, whose equilibrium always
    depends on the path.
    """
    scene, rate = plan.scene, plan.grid.frames_per_second
    if any(frame in grip_frames(grip, rate) for tool in plan.tools for grip in tool.grips):
        return None
    probes = tuple(_load_at_once(plan, probe, frame) for probe in scene.probes)
    time = scene.time.model_copy(update={"duration": 1.0, "frames_per_second": 1})
    variant = plan_variant(plan, scene.model_copy(update={"probes": probes, "time": time}))
    sheet = build_solver(variant, device, cores=cores)
    try:
        sheet.advance(1, pause)
        return sheet.displacement()
    except DivergedError:
        return None
    finally:
        sheet.close()


def _load_at_once(plan: Plan, probe: Probe, frame: int) -> Probe:
    """Return a probe with the constant load of a frame, or with a straight path to its position at the frame."""
    rate, sheet = plan.grid.frames_per_second, plan.scene.sheet
    if probe.path is None:
        percent, coordinates = FrameLoad(probe, sheet).at(frame, rate)
        at = tuple(rest_of(sheet).fractions(coordinates).tolist())
        return probe.model_copy(update={"load": ((0.0, percent),), "at": at})
    times, *coordinates = np.array(probe.path, dtype=float).T
    position = (float(np.interp(frame / rate, times, each)) for each in coordinates)
    # A path that ended before the frame ends at 0.5 s, before the solution at 1 s. Hence a foundation that is active
    # only under load is active in both or in neither.
    end = 1.0 if frame / rate <= times[-1] else 0.5
    return probe.model_copy(update={"path": ((0.0, *probe.path[0][1:]), (end, *position)), "grip": ()})
