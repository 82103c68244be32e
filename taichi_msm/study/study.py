"""A whole study: stepping, SciPy for comparison, drawing, points, terms; when interrupted it keeps what is done."""

from __future__ import annotations

import os
import time
from contextlib import closing
from functools import partial
from typing import Any, NamedTuple

from taichi_msm.errors import Progress, SceneError
from taichi_msm.load.check import checked
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.texture import load_texture
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import on, variant, with_time
from taichi_msm.study.measurements import (
    IntegrationError,
    MeshStudy,
    SteppingStudy,
    TimeLimitError,
    measure_pictures,
    measure_terms,
    solve_with_dop853,
)
from taichi_msm.study.result import PeerMeasurement, Study
from taichi_msm.system import process, runtime
from taichi_msm.system.compiler import versions
from taichi_msm.system.runtime import Device

TOLERANCE = 1e-3

# What notes say of the integrator that the study compares with.
DOP853 = "DOP853, SciPy's general integrator, which the study compares its own steps with,"
APART = "no other figure depends on it"

# Number of trajectories in memory at one time: the reference, and those that it is made of or compared with.
TRAJECTORIES = 6


class TimeBudget(NamedTuple):
    """How long the parts of a study may take."""

    longest_run: float  # of stepping through the whole scene once [s]
    peer: float  # of SciPy for each of its tolerances [s]
    peer_rtols: tuple[float, ...]
    sample: float  # of one measurement of a step [s]


QUICK = TimeBudget(longest_run=0.25, peer=10.0, peer_rtols=(1e-4,), sample=0.02)
FULL = TimeBudget(longest_run=2.0, peer=30.0, peer_rtols=(1e-3, 1e-5, 1e-7), sample=0.1)


def study(
    scene: Plan | Scene,
    name: str,
    *,
    tolerance: float | None = None,
    quick: bool = False,
    arch: str = "cpu",
    threads: int | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Study:
    """Measure the cost and the error of the settings of a scene on this machine, under a name for the report.

    The tolerance is a fraction of the largest displacement; None: the scene's, or else 1e-3. `quick` measures fewer
    settings, in about a minute for a small sheet. If `progress` raises KeyboardInterrupt, the study returns what is
    done.

    Raises:
        SceneError: when the picture cannot be decoded, or the trajectories do not fit in memory.
        DeviceError: when the arch is not there.
    """
    given, device = checked(scene), runtime.start(arch, threads)
    scene = given.scene
    if scene.time.at_rest:
        raise SceneError(["time.motion: quasistatic takes no steps, which a study compares; set time.motion: dynamic"])
    _require_memory(scene)
    texture = load_texture(scene) if scene.image is not None else None
    results = Study(
        scene=name,
        settings=scene.model_dump(mode="json"),
        status="complete",
        tolerance=tolerance or scene.time.tolerance or TOLERANCE,
        machine=machine_record(device),
    )
    effort = QUICK if quick else FULL
    # The study itself varies the step.
    plan = on(variant(given, with_time(scene, tolerance=None)), device.arch)
    scene = plan.scene
    try:
        stepping = SteppingStudy(plan, device, effort.longest_run, results, partial(progress, "stepping"))
        with closing(stepping):
            stepping.run()
        _measure_peer(plan, stepping, effort, results, progress)
        if texture is None:
            results.notes.append("drawing was left out: the scene names no image")
        else:
            assert stepping.frames is not None
            deformed = max(stepping.frames, key=lambda frame: (frame**2).sum(axis=-1).max())
            position = rest_positions(scene.sheet) + deformed
            measure_pictures(scene, position, texture, quick, results, partial(progress, "drawing"))
        MeshStudy(plan, device, effort.longest_run, results, partial(progress, "points")).run()
        measure_terms(plan, device, effort.sample, results, partial(progress, "terms"))
    except KeyboardInterrupt:
        results.status = "interrupted"
        results.notes.append("interrupted: what was measured until then")
    results.finish()
    return results


def machine_record(device: Device) -> dict[str, Any]:
    """Describe the machine that the study ran on."""
    return {
        "cpu": process.processor(),
        "cores": os.cpu_count(),
        "arch": device.arch,
        "threads": device.threads,
        "vectors": runtime.vector_bits(),
        "versions": versions(),
    }


def _require_memory(scene: Scene) -> None:
    rows, cols = scene.sheet.points
    needed = TRAJECTORIES * scene.time.frames * rows * cols * 3 * 8
    available = process.available_memory()
    if needed > available:
        said = (
            f"time.duration: a study keeps the trajectories of all frames, {needed / 2**30:.3g} GiB here, but "
            f"{available / 2**30:.3g} GiB is free; study a shorter time.duration or fewer sheet.points"
        )
        raise SceneError([said])


def _measure_peer(plan: Plan, stepping: SteppingStudy, effort: TimeBudget, results: Study, progress: Progress) -> None:
    """Solve by DOP853 at several tolerances, each as many times as time allows, up to 5."""
    assert results.reference is not None
    if plan.tools:
        results.notes.append(f"{DOP853} is left out, as it knows no contact; {APART}")
        return
    for index, rtol in enumerate(effort.peer_rtols):
        samples: list[float] = []
        deadline = time.perf_counter() + effort.peer
        atol = rtol * (results.reference.largest or 1.0) / 10
        tick = partial(progress, "dop853", index, len(effort.peer_rtols))
        try:
            while len(samples) < 5:
                start = time.perf_counter()
                frames, evaluations = solve_with_dop853(plan, rtol, atol, deadline, tick)
                samples.append(time.perf_counter() - start)
        except TimeLimitError:
            if not samples:
                said = f"takes more than {effort.peer:g} s at rtol {rtol:g} and was stopped"
                results.notes.append(f"{DOP853} {said}; {APART}")
                return
        except IntegrationError as failure:
            said = (
                f"finds no step small enough {failure}, at rtol {rtol:g}: forces change too suddenly for it there, as "
                "where a spring is pressed to a point or the sheet runs away"
            )
            results.notes.append(f"{DOP853} {said}; {APART}")
            return
        error = stepping.relative(frames)
        results.peers.append(PeerMeasurement(rtol, error, stepping.known(error), evaluations, samples=samples))
