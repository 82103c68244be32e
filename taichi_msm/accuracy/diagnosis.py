"""Diagnosis of a divergence: its step by repetition of the run, and its cause by runs with finer steps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from taichi_msm.accuracy import divergence
from taichi_msm.accuracy.divergence import DivergenceMonitor
from taichi_msm.errors import Pause
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import to_positions
from taichi_msm.model.tool_force import control_points, probe_force
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import ForceRecorder
from taichi_msm.solver.sheet_solver import SheetSolver
from taichi_msm.solver.state import RunProgress, Snapshot, largest_displacement


@dataclass(frozen=True)
class Diagnosis:
    """The cause of a divergence, and the last state before it."""

    message: str  # time, step, mass point, likely cause and remedy
    last_sound_state: Snapshot | None  # last state of the run without a fault; None for the state of rest


def diagnose(dynamics: SheetSolver[Any], start: Snapshot | None, pause: Pause) -> Diagnosis:
    """Return the step, the mass point and the likely cause of a divergence within the current frame.

    The run is repeated from the sound state `start`, None for rest; the state of the solver is arbitrary afterwards.
    """
    plan, grid, bad_step = dynamics.plan, dynamics.plan.grid, dynamics.steps_done
    recorder = ForceRecorder(plan)
    state, progress, forces = (None, RunProgress(), recorder.at_start()) if start is None else start[:3]
    monitor = DivergenceMonitor(plan, progress)
    dynamics.restart(plan, state)
    sound, fault = dynamics.state(), ""
    while sound.steps < bad_step:
        dynamics.advance(min(bad_step, (monitor.progress.frame + 1) * grid.steps_per_frame) - sound.steps, pause)
        reading = dynamics.read()
        fault = monitor.check_frame(reading)
        if fault:
            break
        if monitor.progress.frame * grid.steps_per_frame == reading.steps:
            position = to_positions(reading.displacement, plan.scene.sheet)
            forces = recorder.at_frame(forces, monitor.progress.frame, position, dynamics.tool_forces())
        sound = dynamics.state()
    if not fault:
        reason = "the repeated run does not diverge, so the machine has made an error; continue with --resume"
        return Diagnosis(divergence.format_message(grid.time(bad_step), bad_step, reason, exact=False), start)
    bad_step = dynamics.steps_done
    while bad_step - sound.steps > 1:
        dynamics.restart(plan, sound)
        dynamics.advance((bad_step - sound.steps) // 2, pause)
        if monitor.check(dynamics.read()):
            bad_step = dynamics.steps_done
        else:
            sound = dynamics.state()
    dynamics.restart(plan, sound)
    dynamics.advance(1)
    reading = dynamics.read()
    cause = _likely_cause(dynamics, bad_step, largest_displacement(reading.displacement)[:2], pause)
    reason = f"{monitor.check(reading)}; {cause}"
    last_sound_state = Snapshot(sound, monitor.progress, forces, plan.scene.probes)
    message = divergence.format_message(grid.time(bad_step), bad_step, reason, exact=True)
    return Diagnosis(message, last_sound_state)


def _likely_cause(dynamics: SheetSolver[Any], bad_step: int, point: tuple[int, int], pause: Pause) -> str:
    """Describe the likely cause: the time step if the run with a finer one is sound, else a force or a path."""
    plan, grid = dynamics.plan, dynamics.plan.grid
    frames, finest_step = -(-bad_step // grid.steps_per_frame), math.inf
    # Steps times mass points of all trial runs, about ten seconds; a count gives the same message on every machine.
    budget = 5e9
    for refinement in (2, 4, 8, 16, 32, 64):
        finer = plan.with_grid(steps_per_frame=refinement * grid.steps_per_frame)
        budget -= frames * finer.grid.steps_per_frame * math.prod(plan.scene.sheet.points)
        if budget < 0:
            break
        if _is_stable(dynamics, finer, frames, pause):
            return f"likely cause: time.step, {grid.step:.6g} s; with {finer.grid.step:.9g} s it does not diverge here"
        finest_step = finer.grid.step
    if not plan.slots:
        speeds = [tool.max_stride(grid.step)[0] / grid.step for tool in plan.tools]
        tool, speed = max(zip(plan.tools, speeds, strict=True), key=lambda pair: pair[1])
        cause = f"likely cause: probes.{tool.probe}.path, at up to {speed:.3g} m/s"
        return f"{cause}; move the tool more slowly, or less far"
    index, force = _strongest_probe(plan.scene, point)
    name = "force" if plan.scene.probes[index].total is None else "total"
    cause = f"likely cause: probes.{index}.{name}, which reaches {force:.3g} N at this point"
    if finest_step < math.inf:
        return f"{cause}; take less, as it diverges with every time.step that was tried, down to {finest_step:.3g} s"
    return f"{cause}; take less, or a time.step below {grid.step:.6g} s; finer steps would take too long to try here"


def _is_stable(dynamics: SheetSolver[Any], plan: Plan, frames: int, pause: Pause) -> bool:
    """Return whether the first frames of a plan, from rest, have no fault."""
    dynamics.restart(plan)
    monitor = DivergenceMonitor(plan)
    for _ in range(frames):
        dynamics.advance(plan.grid.steps_per_frame, pause)
        if monitor.check_frame(dynamics.read()):
            return False
    return True


def _strongest_probe(scene: Scene, point: tuple[int, int]) -> tuple[int, float]:
    """Return the probe with the largest force on a mass point at any time, and this force [N]."""
    rest = rest_of(scene.sheet)
    position = rest.position[point]

    def force(index: int) -> float:
        probe = scene.probes[index]
        distance = np.linalg.norm(rest.place(control_points(probe, scene.sheet)[1]) - position, axis=1).min()
        profile, load = probe_force(probe, scene.sheet), max(abs(percent) for _, percent in probe.load) / 100
        return load * math.hypot(*profile.force) * float(profile.decay(distance))

    strongest = max((index for index, probe in enumerate(scene.probes) if not probe.moved), key=force)
    return strongest, force(strongest)
