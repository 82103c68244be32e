"""Study of a scene: stepping, SciPy for comparison, drawing, meshes and terms."""

from __future__ import annotations

import os
import time
from contextlib import closing
from functools import partial
from typing import Any, NamedTuple

from taichi_msm.errors import SceneError, StageProgressCallback
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.texture import load_texture
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import choose_precision, plan_variant, with_time
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

# Beginning and end of the notes about DOP853.
DOP853_SUBJECT = "DOP853, SciPy's general integrator, which the study compares its own steps with,"
DOP853_INDEPENDENCE = "no other figure depends on it"


class TimeBudget(NamedTuple):
    """Time budget of the parts of a study.

    Attributes:
        longest_run: limit of a run of the whole scene [s].
        peer: limit of DOP853 for each of its tolerances [s].
        peer_rtols: relative tolerances of DOP853.
        sample: time of one measurement of a step [s].
    """

    longest_run: float
    peer: float
    peer_rtols: tuple[float, ...]
    sample: float


QUICK = TimeBudget(longest_run=0.25, peer=10.0, peer_rtols=(1e-4,), sample=0.02)
FULL = TimeBudget(longest_run=2.0, peer=30.0, peer_rtols=(1e-3, 1e-5, 1e-7), sample=0.1)


def run_study(
    scene: Plan | Scene,
    name: str,
    *,
    tolerance: float | None = None,
    quick: bool = False,
    arch: str = "cpu",
    threads: int | None = None,
    progress: StageProgressCallback = lambda stage, done, total: None,
) -> Study:
    """Measure the cost and the error of the settings of a scene on this machine.

    Args:
        scene: the scene or its plan.
        name: of the scene, in the report.
        tolerance: largest allowed error, as a fraction of the largest displacement; None: the scene's, otherwise 1e-3.
        quick: whether to measure fewer settings, in about a minute for a small sheet.
        arch: cpu, cuda or vulkan.
        threads: number of CPU threads; None: one per core.
        progress: called with the stage, the finished part and the total; after a KeyboardInterrupt from it the study
            returns the results so far.

    Raises:
        SceneError: when the scene is quasi-static, the picture cannot be decoded, or the trajectories do not fit in
            memory.
        DeviceError: when the arch is not available.
    """
    plan, device = check_scene(scene), runtime.start(arch, threads)
    scene = plan.scene
    if scene.time.at_rest:
        raise SceneError(["time.motion: quasistatic takes no steps, which a study compares; set time.motion: dynamic"])
    _require_memory(scene)
    texture = load_texture(scene) if scene.image is not None else None
    results = Study(
        scene=name,
        settings=scene.model_dump(mode="json"),
        status="complete",
        tolerance=tolerance or scene.time.tolerance or 1e-3,
        machine=machine_record(device),
    )
    budget = QUICK if quick else FULL
    # The study itself varies the step.
    plan = choose_precision(plan_variant(plan, with_time(scene, tolerance=None)), device.arch)
    scene = plan.scene
    try:
        stepping = SteppingStudy(plan, device, budget.longest_run, results, partial(progress, "stepping"))
        with closing(stepping):
            stepping.run()
        _measure_peer(plan, stepping, budget, results, progress)
        if texture is None:
            results.notes.append("drawing was left out: the scene names no image")
        else:
            assert stepping.frames is not None
            deformed = max(stepping.frames, key=lambda frame: (frame**2).sum(axis=-1).max())
            position = rest_positions(scene.sheet) + deformed
            measure_pictures(scene, position, texture, quick, results, partial(progress, "drawing"))
        MeshStudy(plan, device, budget.longest_run, results, partial(progress, "points")).run()
        measure_terms(plan, device, budget.sample, results, partial(progress, "terms"))
    except KeyboardInterrupt:
        results.status = "interrupted"
        results.notes.append("interrupted: the measurements until then")
    results.finish()
    return results


def machine_record(device: Device) -> dict[str, Any]:
    """Return the machine of a study as JSON data."""
    return {
        "cpu": process.processor_name(),
        "cores": os.cpu_count(),
        "arch": device.arch,
        "threads": device.threads,
        "vectors": runtime.vector_bits(),
        "versions": versions(),
    }


def _require_memory(scene: Scene) -> None:
    rows, cols = scene.sheet.points
    # At most six trajectories are in memory: the reference, and those of its extrapolation and comparison.
    needed = 6 * scene.time.frames * rows * cols * 3 * 8
    available = process.available_memory()
    if needed > available:
        fault = (
            f"time.duration: a study keeps the trajectories of all frames, {needed / 2**30:.3g} GiB here, but "
            f"{available / 2**30:.3g} GiB is free; study a shorter time.duration or fewer sheet.points"
        )
        raise SceneError([fault])


def _measure_peer(
    plan: Plan, stepping: SteppingStudy, budget: TimeBudget, results: Study, progress: StageProgressCallback
) -> None:
    """Measure DOP853 at several tolerances, at most five times each, within the time budget."""
    assert results.reference is not None
    if plan.tools:
        results.notes.append(f"{DOP853_SUBJECT} is left out, as it knows no contact; {DOP853_INDEPENDENCE}")
        return
    for index, rtol in enumerate(budget.peer_rtols):
        samples: list[float] = []
        deadline = time.perf_counter() + budget.peer
        atol = rtol * (results.reference.largest or 1.0) / 10
        tick = partial(progress, "dop853", index, len(budget.peer_rtols))
        try:
            while len(samples) < 5:
                start = time.perf_counter()
                frames, evaluations = solve_with_dop853(plan, rtol, atol, deadline, tick)
                samples.append(time.perf_counter() - start)
        except TimeLimitError:
            if not samples:
                reason = f"takes more than {budget.peer:g} s at rtol {rtol:g} and was stopped"
                results.notes.append(f"{DOP853_SUBJECT} {reason}; {DOP853_INDEPENDENCE}")
                return
        except IntegrationError as failure:
            reason = (
                f"finds no step small enough {failure}, at rtol {rtol:g}: forces change too suddenly for it there, as "
                "where a spring is pressed to a point or the sheet runs away"
            )
            results.notes.append(f"{DOP853_SUBJECT} {reason}; {DOP853_INDEPENDENCE}")
            return
        error = stepping.relative_error(frames)
        results.peers.append(PeerMeasurement(rtol, error, stepping.determines(error), evaluations, samples=samples))
