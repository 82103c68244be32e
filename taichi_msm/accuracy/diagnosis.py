"""Why a run diverged, and which step would not have: it is repeated, and then run with finer steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from taichi_msm.accuracy import divergence
from taichi_msm.accuracy.divergence import Watch
from taichi_msm.errors import Pause
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import axes
from taichi_msm.model.surface import to_positions
from taichi_msm.model.tool_force import control_points, probe_force
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import Dynamics, ForceRecorder
from taichi_msm.solver.state import RunProgress, Snapshot, largest_displacement

# How many times finer the steps are that are tried, and how many steps of a point all trials together may take: some
# ten seconds. Counted, so that the message is the same on every machine.
CUTS = (2, 4, 8, 16, 32, 64)
MOST_STEPS = 5e9


@dataclass(frozen=True)
class Diagnosis:
    """What was found out about a divergence."""

    message: str  # the time, the step, the point, the key that is the most likely cause, and the remedy
    good: Snapshot | None  # the last sound state of the run; None: only the start is known to be sound


def diagnose(dynamics: Dynamics, start: Snapshot | None, pause: Pause) -> Diagnosis:
    """Find out how a run diverged within the current frame, from a sound state on; None: from rest.

    The state of the dynamics afterwards is arbitrary.
    """
    plan, grid, bad = dynamics.plan, dynamics.plan.grid, dynamics.steps_done
    gauge = ForceRecorder(plan)
    state, progress, felt = (None, RunProgress(), gauge.at_rest()) if start is None else start[:3]
    watch = Watch(plan, progress)
    dynamics.restart(plan, state)
    low, wrong = dynamics.state(), ""
    while low.steps < bad:
        dynamics.advance(min(bad, (watch.progress.frame + 1) * grid.steps_per_frame) - low.steps, pause)
        reading = dynamics.read()
        wrong = watch.follow(reading)
        if wrong:
            break
        if watch.progress.frame * grid.steps_per_frame == reading.steps:
            position = to_positions(reading.displacement, plan.scene.sheet)
            felt = gauge.follow(felt, watch.progress.frame, position, dynamics.tool_forces())
        low = dynamics.state()
    if not wrong:
        said = "but not when it was repeated, so the machine has made an error; continue with --resume"
        return Diagnosis(divergence.message(grid.time(bad), bad, said, exact=False), start)
    high = dynamics.steps_done
    while high - low.steps > 1:
        dynamics.restart(plan, low)
        dynamics.advance((high - low.steps) // 2, pause)
        if watch.judge(dynamics.read()):
            high = dynamics.steps_done
        else:
            low = dynamics.state()
    dynamics.restart(plan, low)
    dynamics.advance(1)
    reading = dynamics.read()
    cause = _cause(dynamics, high, largest_displacement(reading.displacement)[:2], pause)
    said = f"{watch.judge(reading)}; {cause}"
    good = Snapshot(low, watch.progress, felt, plan.scene.probes)
    return Diagnosis(divergence.message(grid.time(high), high, said, exact=True), good)


def _cause(dynamics: Dynamics, bad: int, point: tuple[int, int], pause: Pause) -> str:
    """Name the key that is the most likely cause: the step, if a finer one does not diverge, or else a force."""
    plan, grid = dynamics.plan, dynamics.plan.grid
    frames, tried, left = -(-bad // grid.steps_per_frame), math.inf, MOST_STEPS
    for cut in CUTS:
        finer = plan.with_grid(steps_per_frame=cut * grid.steps_per_frame)
        left -= frames * finer.grid.steps_per_frame * math.prod(plan.scene.sheet.points)
        if left < 0:
            break
        if _goes_well(dynamics, finer, frames, pause):
            return f"likely cause: time.step, {grid.step:.6g} s; with {finer.grid.step:.9g} s it does not diverge here"
        tried = finer.grid.step
    if not plan.slots:
        speeds = [tool.max_stride(grid.step)[0] / grid.step for tool in plan.tools]
        tool, speed = max(zip(plan.tools, speeds, strict=True), key=lambda pair: pair[1])
        said = f"likely cause: probes.{tool.probe}.path, at up to {speed:.3g} m/s"
        return f"{said}; move the tool more slowly, or less far"
    index, force = _strongest_probe(plan.scene, point)
    name = "force" if plan.scene.probes[index].total is None else "total"
    said = f"likely cause: probes.{index}.{name}, which reaches {force:.3g} N at this point"
    if tried < math.inf:
        return f"{said}; take less, as it diverges with every time.step that was tried, down to {tried:.3g} s"
    return f"{said}; take less, or a time.step below {grid.step:.6g} s; finer steps would take too long to try here"


def _goes_well(dynamics: Dynamics, plan: Plan, frames: int, pause: Pause) -> bool:
    """Tell whether a number of frames from rest are sound."""
    dynamics.restart(plan)
    watch = Watch(plan)
    for _ in range(frames):
        dynamics.advance(plan.grid.steps_per_frame, pause)
        if watch.follow(dynamics.read()):
            return False
    return True


def _strongest_probe(scene: Scene, point: tuple[int, int]) -> tuple[int, float]:
    """Find the probe with the largest force on a point at any time, and this force [N]."""
    x, y = axes(scene.sheet)
    rest = np.array([x[point[1]], y[point[0], 0]])

    def force(index: int) -> float:
        probe = scene.probes[index]
        nearest = np.linalg.norm(control_points(probe, scene.sheet)[1] - rest, axis=1).min()
        acts, most = probe_force(probe, scene.sheet), max(abs(percent) for _, percent in probe.load) / 100
        return most * math.hypot(*acts.force) * float(acts.decay(nearest))

    strongest = max((index for index, probe in enumerate(scene.probes) if not probe.moved), key=force)
    return strongest, force(strongest)
