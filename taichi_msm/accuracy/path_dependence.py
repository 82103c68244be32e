"""Equilibria that depend on the way of loading: frames that jump, and frames that another way leaves elsewhere.

A sheet that buckles or wrinkles has several equilibria under one load. That is seen in three ways: between two frames
the sheet moves much farther, for the change of the loads, than between the frames before and after; two frames under
the same loads, such as on the way up and down, differ; or the sheet comes to rest elsewhere if the loads of a frame act
at once on the flat sheet and tools go straight to where they are.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.time_step import longest
from taichi_msm.errors import DivergedError, Pause
from taichi_msm.model.loads import FrameLoad
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import grip_frames
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import affords_companions, plan_variant
from taichi_msm.solver.rest import build_dynamics
from taichi_msm.system.runtime import Device

# Shapes that differ by more than this share of the largest displacement are different equilibria.
ELSEWHERE = 0.01

# A jump moves the sheet this many times farther, for the same change of the loads, than the frames before and after it;
# a sheet without tension, which moves as the cube root of its load, comes to 4.5 where the load changes its sign.
JUMP = 6.0

# The number of second solutions, and of frames that each costs, as it comes from rest.
SECOND_SOLUTIONS, COST = 3, 3

# Frames are compared with earlier ones under the same loads up to this number of mass points in all frames.
MOST_COMPARED = 2_000_000

# Loads that differ by less than this share are the same.
SAME_LOAD = 1e-9

Array = NDArray[Any]


class PathDependence:
    """Follows the frames of a run at rest.

    Args:
        plan: of the run.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan, self._loads = plan, _Loads(plan)
        # The frame before, the one with the largest displacement, and the first after it with less than half of it.
        self._before: tuple[int, Array] | None = None
        self._largest, self._most = 0.0, (0, np.zeros(()))
        self._unloaded: tuple[int, Array] | None = None
        self._moves: deque[tuple[float, float]] = deque(maxlen=3)  # of the last frames: how far, and the loads' change
        self._jumps: dict[int, float] = {}
        self._alike: dict[int, float] = {}
        self._elsewhere: dict[int, float] = {}
        compares = (plan.grid.frames + 1) * math.prod(plan.scene.sheet.points) <= MOST_COMPARED
        self._by_load: dict[tuple[int, ...], Array] | None = {} if compares else None

    def follow(self, frame: int, displacement: Array) -> None:
        """Compare the next frame, displacement [m] of shape (rows, cols, 3), with those before it."""
        size, now = longest(displacement), (frame, displacement)
        if size > self._largest:
            self._largest, self._most, self._unloaded = size, now, None
        elif self._unloaded is None and size < self._largest / 2:
            self._unloaded = now
        if self._before is not None and self._before[0] == frame - 1:
            self._moves.append((longest(displacement - self._before[1]), self._loads.change(frame)))
            if len(self._moves) == 3 and min(change for _, change in self._moves) > 0:
                before, moved, after = (far / change for far, change in self._moves)
                if moved > JUMP * max(before, after):
                    self._jumps[frame - 1] = self._moves[1][0]
        if self._by_load is not None and (loads := self._loads.at(frame)):
            self._alike[frame] = longest(displacement - self._by_load.setdefault(loads, displacement))
        self._before = now

    def affords(self, pilots: float) -> bool:
        """Return whether second solutions, in addition to pilots of this cost, are a small part of the run."""
        return affords_companions(self._plan, pilots + SECOND_SOLUTIONS * COST / (self._plan.grid.frames + 1))

    def finish(self, device: Device, cores: int | None, pause: Pause) -> None:
        """Solve the last frame, the one with the largest displacement and one after it a second time, from rest."""
        if self._largest == 0:
            return
        for frame, displacement in dict(filter(None, (self._most, self._unloaded, self._before))).items():
            second = second_solution(self._plan, frame, device, cores, pause)
            if second is not None:
                self._elsewhere[frame] = longest(displacement - second)

    def notes(self) -> Iterator[str]:
        """Warn of the frame that differs most from what another way of loading leads to."""
        rate, remedy = self._plan.grid.frames_per_second, "tissue.pretension, bending or a stiffer foundation"
        if self._plan.scene.tissue is None:
            remedy = "larger springs.virtual"
        found = [
            (distance / max(self._largest, 1e-300), frame, what)
            for distances, what in (
                (self._jumps, "from the frame before the sheet jumps by {} of the largest displacement"),
                (self._alike, "the sheet is {} of the largest displacement away from an earlier frame of equal loads"),
                (self._elsewhere, "loaded at once, from rest, the sheet differs by {} of the largest displacement"),
            )
            for frame, distance in distances.items()
        ]
        share, frame, what = max(found, default=(0.0, 0, ""))
        if share > ELSEWHERE:
            yield (
                f"path-dependent at {frame / rate:.6g} s, frame {frame}: {what.format(f'{100 * share:.2g} %')}: there "
                "are several equilibria under one load, as the sheet buckles, wrinkles or slips off a tool, and what "
                f"was found holds for this way of loading alone; {remedy} may leave one equilibrium"
            )


def second_solution(plan: Plan, frame: int, device: Device, cores: int | None, pause: Pause) -> Array | None:
    """Solve a frame from rest: its loads act at once, then tools go straight from their first place to that at it.

    Args:
        plan: of a scene at rest.
        frame: its number.
        device: where to solve it.
        cores: number of cores; None: all.
        pause: called often; what it raises stops here.

    Returns:
        Displacements [m], shape (rows, cols, 3); None: a tool holds tissue then, which it took on its way, or no
        equilibrium was found.
    """
    scene, rate = plan.scene, plan.grid.frames_per_second
    if any(frame in grip_frames(grip, rate) for tool in plan.tools for grip in tool.grips):
        return None
    probes = tuple(_at_once(plan, probe, frame) for probe in scene.probes)
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


def _at_once(plan: Plan, probe: Probe, frame: int) -> Probe:
    """Return a probe that does from 0 s on, or with its tool at 1 s, what it does at a frame."""
    rate, sheet = plan.grid.frames_per_second, plan.scene.sheet
    if probe.path is None:
        percent, (x, y) = FrameLoad(probe, sheet).at(frame, rate)
        at = (x / sheet.size[1] + 0.5, 0.5 - y / sheet.size[0])
        return probe.model_copy(update={"load": ((0.0, percent),), "at": at})
    times, *places = np.array(probe.path, dtype=float).T
    place = (float(np.interp(frame / rate, times, each)) for each in places)
    # After its last key a tool does not count as pressing, where that matters.
    end = 1.0 if frame / rate <= times[-1] else 0.5
    return probe.model_copy(update={"path": ((0.0, *probe.path[0][1:]), (end, *place)), "grip": ()})


class _Loads:
    """The loads and the places of the tools of a plan at its frames."""

    def __init__(self, plan: Plan) -> None:
        scene, self._rate, self._tools = plan.scene, plan.grid.frames_per_second, plan.tools
        probes = [probe for probe in scene.probes if not probe.moved]
        self._probes = [
            (FrameLoad(probe, scene.sheet), max(abs(percent) for _, percent in probe.load) or 1.0) for probe in probes
        ]
        self._size = max(scene.sheet.size)

    def at(self, frame: int) -> tuple[int, ...]:
        """Return numbers that are equal for frames under the same loads; empty while a tool holds tissue."""
        rate = self._rate
        if any(frame in grip_frames(grip, rate) for tool in self._tools for grip in tool.grips):
            return ()
        shares = [
            number
            for load, most in self._probes
            for percent, (x, y) in (load.at(frame, rate),)
            for number in (percent / most, x / self._size, y / self._size)
        ]
        for tool in self._tools:
            pressing = tool.times[0] <= frame / rate <= tool.times[-1]
            shares += [pressing, *tool.tip_centre(np.array([frame / rate]))[0] / self._size]
        return tuple(np.rint(np.array(shares) / SAME_LOAD).astype(np.int64).tolist())

    def change(self, frame: int) -> float:
        """Return by which share the loads and tools change from the frame before; 0: not at all, or grips do."""
        change = 0.0
        for load, most in self._probes:
            (before, start), (after, end) = (load.at(each, self._rate) for each in (frame - 1, frame))
            change += abs(after - before) / most + float(np.linalg.norm(end - start)) / self._size
        for tool in self._tools:
            frames = [grip_frames(grip, self._rate) for grip in tool.grips]
            if any((frame in held) != (frame - 1 in held) for held in frames):
                return 0.0
            before, after = tool.tip_centre(np.array([frame - 1, frame]) / self._rate)
            change += math.dist(before, after) / max(tool.path_length, 1e-300)
        return change
