"""Study of a scene: stepping, drawing and meshes."""

from __future__ import annotations

import os
from functools import partial
from typing import Any

from taichi_msm.errors import SceneError, StageProgressCallback
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.texture import load_texture
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import choose_precision, plan_variant, with_time
from taichi_msm.study.measurements import MeshStudy, SteppingStudy, measure_pictures
from taichi_msm.study.result import Study
from taichi_msm.system import process, runtime
from taichi_msm.system.compiler import versions
from taichi_msm.system.runtime import Device


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
    """Measure the cost and the error of the settings of a scene on this machine; `name` is the scene's in the report.

    `tolerance` is the largest allowed error, as a fraction of the largest displacement; by default the scene's, else
    1e-3. If `quick`, measurements are fewer and shorter. A KeyboardInterrupt from `progress` ends the study with the
    results so far. A quasi-static scene, an invalid picture, or trajectories that do not fit in memory raise a
    SceneError.
    """
    plan, device = check_scene(scene), runtime.start(arch, threads)
    scene = plan.scene
    if scene.time.at_rest:
        raise SceneError(["time.motion: quasistatic takes no steps, which a study compares; set time.motion: dynamic"])
    _require_memory(scene)
    texture = load_texture(scene) if scene.image is not None else None
    tolerance = tolerance or scene.time.tolerance or 1e-3
    results = Study(name, scene.model_dump(mode="json"), "complete", tolerance, machine_record(device))
    # Approximate time limit of a run of the whole scene [s].
    longest_run = 0.25 if quick else 2.0
    # No tolerance: the study varies the step itself.
    plan = choose_precision(plan_variant(plan, with_time(scene, tolerance=None)), device.arch)
    scene = plan.scene
    try:
        frames = SteppingStudy(plan, device, longest_run, results, partial(progress, "stepping")).run()
        if texture is None:
            results.notes.append("drawing was not measured: the scene has no image")
        else:
            deformed = max(frames, key=lambda frame: (frame**2).sum(axis=-1).max())
            position = rest_positions(scene.sheet) + deformed
            measure_pictures(scene, position, texture, quick, results, partial(progress, "drawing"))
        MeshStudy(plan, device, longest_run, results, partial(progress, "points")).run()
    except KeyboardInterrupt:
        results.status = "interrupted"
        results.notes.append("interrupted; these are the measurements so far")
    results.finish()
    return results


def machine_record(device: Device) -> dict[str, Any]:
    """Return a record of this machine and its software for a study, as JSON data."""
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
    # There are at most six trajectories at a time: reference, its extrapolation, compared runs.
    needed = 6 * scene.time.frames * rows * cols * 3 * 8
    available = process.available_memory()
    if needed > available:
        fault = (
            f"time.duration: a study keeps the trajectories of all frames, {needed / 2**30:.3g} GiB here, but "
            f"{available / 2**30:.3g} GiB is free; reduce time.duration or sheet.points"
        )
        raise SceneError([fault])
