"""The loop over the frames of a scene: it simulates, draws and writes them."""

from __future__ import annotations

import math
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, cast

import numpy as np
import PIL
from numpy.typing import NDArray

from taichi_msm import __version__
from taichi_msm.arguments import require_path
from taichi_msm.errors import DamagedError, DeviceError, DivergedError, FilesError, SceneError, writing
from taichi_msm.physics import error_control
from taichi_msm.physics.error_control import Estimate
from taichi_msm.physics.lattice import rest_positions
from taichi_msm.physics.mesh_error import MeshEstimate, choose_points
from taichi_msm.physics.pilots import Pilots, choose_pilots, no_pilots
from taichi_msm.physics.probe_force import probe_records
from taichi_msm.physics.run_error import Known, RunError
from taichi_msm.physics.run_progress import RunProgress
from taichi_msm.physics.timestep import stable_step, time_grid, with_grid
from taichi_msm.physics.warnings import notes
from taichi_msm.physics.workload import ENCODING
from taichi_msm.progress import Progress
from taichi_msm.render.drawing_notes import drawing_notes
from taichi_msm.render.labels import Observed
from taichi_msm.render.texture import load_texture
from taichi_msm.results.manifest import Manifest, digests, read_manifest
from taichi_msm.results.record import RunRecord
from taichi_msm.results.writer import ResultWriter
from taichi_msm.scene import Scene
from taichi_msm.scenefile import budget
from taichi_msm.scenefile.validation import checked
from taichi_msm.simulation import Simulation
from taichi_msm.system import resources, runtime
from taichi_msm.system.compiler import chosen
from taichi_msm.system.runtime import Device
from taichi_msm.timegrid import TimeGrid


class Stopwatch:
    """Adds up the time of every stage.

    Args:
        started: `time.perf_counter()` when the first stage began; None: now.
    """

    def __init__(self, started: float | None) -> None:
        self.seconds: dict[str, float] = {}
        self._started = self._last = time.perf_counter() if started is None else started

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now

    def total(self) -> float:
        """Give the time since the beginning [s]."""
        return time.perf_counter() - self._started


def run(
    scene: Scene | Mapping[str, Any],
    directory: str | Path,
    *,
    arch: str = "cpu",
    threads: int | None = None,
    overrides: Sequence[str] = (),
    estimate_error: bool | None = None,
    started: float | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> RunRecord:
    """Simulate a scene and write its results, whole or not at all.

    An unfinished run of the same scene in the same directory is continued: the results have the same bits.

    Args:
        scene: what `load_scene` returned, or the same as a mapping.
        directory: where frames/, animation.gif, trajectory.npz and run.json go.
        arch: cpu, cuda or vulkan.
        threads: number of CPU threads; None takes every core.
        overrides: the overrides that made the scene, for the record.
        estimate_error: whether to estimate the error of the run, by pilots; None: if they take at most two fifths of
            the run. For a tolerance in the scene it is estimated in any case.
        started: `time.perf_counter()` when the program began; None: now.
        progress: called often, with the stage, the frames done and the frames in all; what it raises stops the run
            there. After a KeyboardInterrupt the finished frames are kept.

    Returns:
        The content of run.json; its "status" is "complete", "diverged" (then "error" says where and why) or
        "interrupted". After the last two, and after the process was killed, `resume` continues the run.

    Raises:
        ArgumentError: when an argument is not what it must be.
        SceneError: when the scene cannot be run, its picture cannot be decoded, no step meets its tolerance, or the
            disk has no room for the results.
        DeviceError: when the arch is not available.
        FilesError: when the results cannot be written.
        KeyboardInterrupt: when interrupted before the first frame; nothing is written then.
    """
    watch = Stopwatch(started)
    scene = checked(scene)
    require_path(directory)
    budget.require_disk(scene, Path(directory))
    device = runtime.start(arch, threads)
    sha256 = digests(scene)
    texture = load_texture(scene, sha256.get("image")) if scene.draws else None
    watch.lap("startup")
    given, estimate, mesh = scene, None, None
    if scene.sheet.tolerance is not None:
        scene, mesh = choose_points(scene, device, checked, partial(progress, "pilot"))
        budget.require_disk(scene, Path(directory))
        watch.lap("pilot")
    grid = time_grid(scene, device.arch)
    if scene.time.tolerance is not None:
        grid, estimate = error_control.choose_step(scene, grid, device, partial(progress, "pilot"))
        watch.lap("pilot")
    scene = with_grid(scene, grid)
    with writing(directory):
        here = str(Path.cwd())
    manifest = Manifest(
        given,
        scene,
        tuple(overrides),
        estimate,
        mesh,
        estimate_error,
        here,
        arch,
        sha256,
        versions(),
    )
    if begun := _begun(manifest, Path(directory)):
        with suppress(DamagedError):
            return _carry_out(_with_versions(begun), Path(directory), device, texture, watch, progress, resumes=True)
    return _carry_out(manifest, Path(directory), device, texture, watch, progress, resumes=False)


def _begun(manifest: Manifest, directory: Path) -> Manifest | None:
    """Find the unfinished run in a directory whose results have the same bits as those of this one."""
    try:
        found = read_manifest(directory)
    except (FilesError, SceneError):
        return None
    return replace(manifest, versions=found.versions) if manifest.gives_the_bits_of(found) else None


def _with_versions(begun: Manifest) -> Manifest:
    """Add the versions of this process, whose compiler may be another one, to those of the process that began a run."""
    return replace(begun, versions={**begun.versions, **versions()})


def resume(
    directory: str | Path,
    *,
    threads: int | None = None,
    started: float | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> RunRecord:
    """Continue a run that was interrupted or killed, ran out of disk space, or diverged; to the same bits.

    Args:
        directory: where the results of the run go.
        threads: as for `run`.
        started: as for `run`.
        progress: as for `run`.

    Returns:
        The same as `run`.

    Raises:
        SceneError: when the scene's picture or map cannot be decoded.
        DeviceError: when the arch is not available.
        FilesError: when there is nothing to resume, or what there is cannot be used; and as for `run`.
        KeyboardInterrupt: when interrupted before another frame is finished; nothing has changed then.
    """
    watch = Stopwatch(started)
    require_path(directory)
    manifest = read_manifest(Path(directory))
    if too_large := [str(problem) for problem in budget.problems(manifest.scene)]:
        raise SceneError(too_large)
    manifest.require_same(versions())
    texture = load_texture(manifest.scene, manifest.sha256.get("image")) if manifest.scene.draws else None
    device = runtime.start(manifest.arch, threads)
    watch.lap("startup")
    return _carry_out(_with_versions(manifest), Path(directory), device, texture, watch, progress, resumes=True)


def _carry_out(
    manifest: Manifest,
    directory: Path,
    device: Device,
    texture: NDArray[np.uint8] | None,
    watch: Stopwatch,
    progress: Progress,
    *,
    resumes: bool,
) -> RunRecord:
    """Simulate and draw all frames, or those that the unfinished run in the directory lacks."""
    scene, grid = manifest.scene, time_grid(manifest.scene, device.arch)
    frames = grid.frames + 1
    ending: dict[str, Any] = {"status": "complete"}

    def pause() -> None:
        watch.lap("simulate")
        progress("frames", writer.frames, frames)
        if writer.due:
            writer.save(simulation.save())
        watch.lap("hand over")

    progress("compile", 0, frames)
    cores = free_cores(scene, grid)
    # In this order, so that the encoder starts up while kernels are compiled.
    with (
        ResultWriter(directory, scene, grid, manifest.as_json(), resumes=resumes) as writer,
        Simulation(scene, device.arch, device.threads, texture, cores) as simulation,
        ExitStack() as opened,
    ):
        resumed = writer.stored
        pilots = _pilots(manifest, grid, device, resumed=resumed > 0)
        run_error: RunError | None = None
        known = Known(manifest.estimate, pilots.reason, manifest.mesh)
        if not pilots.reason:
            try:
                run_error = opened.enter_context(closing(RunError(scene, grid, pilots, known, device, cores)))
            except DeviceError:
                known = known._replace(reason=f"{device.arch} cannot run this scene in f64")
        rest = rest_positions(scene.sheet)
        for frame in range(resumed if scene.output else 0):
            progress("check", frame, resumed)
            writer.position(frame)  # finds damage before the positions are used
        watch.lap("startup")
        try:
            simulation.compile(partial(progress, "compile", 0, frames))
            if run_error:
                run_error.compile()
            watch.lap("compile")
            if writer.saved:
                simulation.restore(writer.saved)
            if run_error:
                for frame in range(1, writer.frames):
                    run_error.follow(writer.position(frame) - rest, partial(progress, "pilot", frame, writer.frames))
                    watch.lap("pilot")
            observed = Observed()
            # Frames that need no step are told apart, as they say nothing of the time that the others will take.
            without_steps = max(resumed, 1)
            for frame in range(writer.frames, frames):
                stage, of = ("redraw", without_steps) if frame < without_steps else ("frames", frames)
                told = partial(progress, stage, frame, of)
                told()
                watch.lap("hand over")
                if frame > simulation.frame:
                    simulation.advance(pause=pause)
                watch.lap("simulate")
                position = writer.position(frame) if frame < resumed else simulation.positions()
                observed = simulation.observe(observed.labels, position, frame / scene.time.frames_per_second)
                watch.lap("render")
                writer.add(position, observed, told)
                watch.lap("hand over")
                if run_error and frame > 0:
                    run_error.follow(position - rest, told)
                    watch.lap("pilot")
            try:
                if run_error:
                    kept = (writer.position(frame) - rest for frame in range(1, frames)) if scene.output else None
                    run_error.finish(kept, partial(progress, "pilot"))
                    watch.lap("pilot")
            except KeyboardInterrupt:
                # All frames are done, and what the coarse pilot tells stands.
                writer.finish()
            else:
                writer.finish(partial(progress, "frames", frames, frames))
        except KeyboardInterrupt:
            # An interruption outside `progress` may come before the last frame is stored.
            if simulation.steps > 0 and simulation.frame < writer.stored and not simulation.torn:
                # If the simulation diverges within this frame, the resumed run will find it.
                with suppress(DivergedError):
                    writer.save(simulation.save())
            # Without a new frame there are no new results; to end soon, new frames may be given up too.
            if writer.frames > resumed:
                writer.finish(hurry=True)
            if writer.frames <= resumed:
                raise
            ending = {"status": "interrupted"}
        except DivergedError as error:
            run_error, known = None, Known(reason="the run diverged")
            ending = {"status": "diverged", "error": str(error), "dump": None}
            with suppress(KeyboardInterrupt):
                found = simulation.diagnose(writer.load(), partial(progress, "diagnosis", writer.frames, frames))
                ending["error"] = found.message
                if found.good:
                    ending["dump"] = writer.save(found.good)
        progress("write", writer.frames, frames)
        writer.finish()
        if run_error:
            known = run_error.known
        record = {**ending, **_facts(manifest, grid, simulation.progress, known), "resumed": resumed}
        stages = ["startup", *(["pilot"] if "pilot" in watch.seconds else []), "compile", "simulate", "render"]
        seconds = {stage: watch.seconds.get(stage, 0.0) for stage in stages}
        record["timings"] = {**seconds, "encode": writer.encode_seconds, "total": watch.total()}
        record |= {"arch": device.arch, "device": device.name, "threads": device.threads, "lanes": simulation.lanes}
        record |= {"workers": simulation.workers, "versions": manifest.versions}
        return cast(RunRecord, writer.publish(record))


def _pilots(manifest: Manifest, grid: TimeGrid, device: Device, *, resumed: bool) -> Pilots:
    """Choose the pilots of a run, or say why there are none."""
    scene, asked = manifest.scene, manifest.asks_estimate
    if asked is False:
        return no_pilots("not asked for")
    if asked is None and device.arch != "cpu":
        return no_pilots("on a GPU, this needs --estimate-error")
    if resumed and not scene.output:
        return no_pilots("the frames before the interruption were not kept")
    return choose_pilots(scene, grid, asked=asked is True)


def _facts(manifest: Manifest, grid: TimeGrid, progress: RunProgress, known: Known) -> dict[str, Any]:
    """Say what was run, and what is known of its last frame, for run.json."""
    scene, limit = manifest.scene, stable_step(manifest.scene)
    return {
        # With the paths of pictures as they were given; only these two sections hold anything that is chosen.
        "scene": manifest.given.model_copy(update={"sheet": scene.sheet, "time": scene.time}).model_dump(mode="json"),
        "asked": _asked(manifest.given, scene),
        "working_directory": manifest.folder,
        "sha256": dict(manifest.sha256),
        "overrides": list(manifest.overrides),
        "points": list(scene.sheet.points),
        "step": grid.step,
        "stable_step": limit if limit < math.inf else None,
        "steps_per_frame": grid.steps_per_frame,
        "precision": grid.precision,
        "steps": progress.frame * grid.steps_per_frame,
        "max_displacement": progress.max_displacement,
        "shortest_spring": progress.shortest_spring,
        "longest_spring": progress.longest_spring,
        "probes": probe_records(scene),
        "notes": [*notes(scene, grid, progress, *known), *drawing_notes(scene)],
        "error_estimate": None if known.estimate is None else error_record(known.estimate, known.mesh),
        **({"error_estimate_reason": known.reason} if known.estimate is None else {}),
    }


def free_cores(scene: Scene, grid: TimeGrid) -> int:
    """Count the cores that are free for stepping: all but one for the encoder, unless that mostly waits for frames."""
    width, height = scene.render.size
    rows, cols = scene.sheet.points
    encoding = width * height * ENCODING if scene.draws else 0
    busy = encoding > rows * cols * grid.steps_per_frame
    return max(1, resources.available_threads() - busy)


def _asked(given: Scene, scene: Scene) -> dict[str, Any]:
    """Give the keys of a scene, by their paths, for which a run chose other values, and the values that they had."""
    keys = ("sheet.points", "sheet.tolerance", "time.step", "time.precision", "time.tolerance")
    pairs = [(key, attrgetter(key)(given), attrgetter(key)(scene)) for key in keys]
    return {key: asked for key, asked, chosen in pairs if asked != chosen}


def error_record(estimate: Estimate, mesh: MeshEstimate | None = None) -> dict[str, Any]:
    """Write an estimate for run.json, where null stands for what is not known."""
    found = {key: getattr(estimate, key) for key in ("error", "rounding", "in_f64", "order", "at_least")}
    if not estimate.parted:
        found |= {"rounding": None, "in_f64": None}
    if mesh is not None:
        found |= {"mesh_error": mesh.error, "mesh_doubt": mesh.doubt}
    return {key: None if value == math.inf else value for key, value in found.items()}


def versions() -> dict[str, str]:
    """Name the versions that the results depend on."""
    return {
        "taichi-msm": __version__,
        "python": platform.python_version(),
        chosen().name: chosen().version,
        "numpy": np.__version__,
        "pillow": PIL.__version__,
        "platform": f"{sys.platform} {platform.machine()}",
    }
