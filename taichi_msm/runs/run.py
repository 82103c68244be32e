"""Run of a scene: simulate, draw and write all frames, with error estimates and checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.companions import QUASISTATIC_REASON, CompanionRuns, choose_companion_runs
from taichi_msm.accuracy.path_dependence import PathDependence
from taichi_msm.accuracy.run_errors import RunErrorEstimates, RunErrorEstimator, run_warnings
from taichi_msm.accuracy.surface import surface_record
from taichi_msm.errors import (
    ArgumentError,
    DamagedError,
    DeviceError,
    DivergedError,
    FilesError,
    Pause,
    SceneError,
    StageProgressCallback,
    require_path,
    require_type,
    writing,
)
from taichi_msm.load import cost
from taichi_msm.load.check import check_scene
from taichi_msm.load.resolve import resolve
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tool_force import probe_records
from taichi_msm.render.camera import view_at
from taichi_msm.render.labels import FrameOutputs
from taichi_msm.render.notes import drawing_warnings
from taichi_msm.render.texture import load_texture
from taichi_msm.runs.checkpoint import Manifest, input_digests, read_manifest
from taichi_msm.runs.simulation import Simulation
from taichi_msm.runs.writer import ResultWriter, RunRecord
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import ENCODING_WORK
from taichi_msm.system import process, runtime
from taichi_msm.system.compiler import versions
from taichi_msm.system.runtime import Device
from taichi_msm.version import commit


class Stopwatch:
    """Timer of the stages of a run, which begins with startup. A nested stage pauses the outer one."""

    def __init__(self, started: float | None) -> None:
        self.seconds: dict[str, float] = {}  # time spent in each stage
        self._stage = "startup"
        self._started = self._last = time.perf_counter() if started is None else started

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Attribute the time of a block to a stage."""
        outer = self._switch(name)
        try:
            yield
        finally:
            self._switch(outer)

    def _switch(self, stage: str) -> str:
        """Begin a stage; return the previous one."""
        now, previous = time.perf_counter(), self._stage
        self.seconds[previous] = self.seconds.get(previous, 0.0) + now - self._last
        self._last, self._stage = now, stage
        return previous

    def total(self) -> float:
        """Return the time since the start [s]."""
        return time.perf_counter() - self._started


def run(
    scene: Plan | Scene | Mapping[str, Any],
    directory: str | Path,
    *,
    arch: str = "cpu",
    threads: int | None = None,
    overrides: Sequence[str] = (),
    estimate_error: bool | None = None,
    started: float | None = None,
    progress: StageProgressCallback = lambda stage, done, total: None,
) -> RunRecord:
    """Simulate a scene and write its results atomically.

    An unfinished run of the same scene in the directory is continued, with the same bits as without interruption.
    Without `output` no frames are stored, so a run with an error estimate, which needs all frames, starts again.

    Args:
        scene: the scene, from `load_scene` or as a mapping with the keys of a scene file.
        directory: destination of frames/, animation.gif, animation.mp4, trajectory.npz, forces.csv and run.json; with
            several cameras, pictures and labels go to a subfolder named after each camera.
        arch: cpu, cuda or vulkan.
        threads: number of CPU threads; None for all cores. With 1, this process also encodes the pictures.
        overrides: overrides already applied to the scene file, for run.json.
        estimate_error: whether to estimate the error by companion runs; None: only if they take at most two fifths of
            the run's time. A scene with a tolerance always has an estimate.
        started: `time.perf_counter()` at the start of the program; None for now.
        progress: called often with the stage, the finished frames and the total number of frames. An exception from it
            stops the run; after a KeyboardInterrupt, finished frames are kept.

    Returns:
        The content of run.json. Its "status" is "complete", "interrupted" or "diverged", with the location and the
        cause in "error". `resume` continues diverged, interrupted and killed runs.

    Raises:
        ArgumentError: when an argument is invalid.
        SceneError: when the scene cannot be run, its picture cannot be decoded, no step meets its tolerance, or there
            is too little free disk space.
        DeviceError: when the arch is not available.
        FilesError: when the results cannot be written.
        KeyboardInterrupt: when interrupted before the first frame; nothing is written then.

    Example:
        >>> from taichi_msm import load_scene, run
        >>> scene = load_scene("scenes/press.yaml", {"sheet.points": [41, 41]})
        >>> record = run(scene, "output/press")
        >>> record["status"], record["frames"], record["precision"]
        ('complete', 31, 'f64')
    """
    require_type(estimate_error, bool | None, "estimate_error", "True, False or None")
    if not isinstance(overrides, (list, tuple)) or not all(isinstance(text, str) for text in overrides):
        raise ArgumentError(f'overrides: {overrides!r}; take a list of texts, such as ["sheet.points=[61,61]"]')
    _require_callbacks(started, progress)
    stopwatch = Stopwatch(started)
    plan = check_scene(scene)
    require_path(directory)
    folder = Path(directory)
    cost.require_disk(plan, folder)
    device = runtime.start(arch, threads)
    sha256 = input_digests(plan)
    given = plan.scene
    texture = load_texture(given, sha256.get("image")) if given.draws else None
    has_tolerance = given.sheet.tolerance is not None or given.time.tolerance is not None
    with stopwatch.stage("pilot" if has_tolerance else "startup"):
        plan, estimate, mesh = resolve(plan, device, partial(progress, "pilot"))
    if mesh is not None:
        cost.require_disk(plan, folder)
    with writing(directory):
        current_folder = str(Path.cwd())
    manifest = Manifest(
        given, plan.scene, tuple(overrides), estimate, mesh, estimate_error, current_folder, arch, sha256, versions()
    )
    context = _RunContext(manifest, plan, texture, device, folder, stopwatch, progress)
    if unfinished := _find_unfinished(context):
        with suppress(DamagedError):  # a damaged run starts again
            return _execute(context._replace(manifest=_add_current_versions(unfinished)), resumes=True)
    return _execute(context, resumes=False)


def resume(
    directory: str | Path,
    *,
    threads: int | None = None,
    started: float | None = None,
    progress: StageProgressCallback = lambda stage, done, total: None,
) -> RunRecord:
    """Continue a run that was interrupted or killed, ran out of disk space, or diverged.

    The results have the same bits as those of an uninterrupted run.

    Args:
        directory: destination of the run's results.
        threads: as for `run`.
        started: as for `run`.
        progress: as for `run`.

    Returns:
        As for `run`.

    Raises:
        SceneError: when the scene's picture or a map cannot be decoded.
        DeviceError: when the arch is not available.
        FilesError: when the unfinished run is missing or damaged; and as for `run`.
        KeyboardInterrupt: when interrupted before another frame is finished; nothing has changed then.
    """
    _require_callbacks(started, progress)
    stopwatch = Stopwatch(started)
    require_path(directory)
    manifest, plan = read_manifest(Path(directory))
    if too_large := [str(problem) for problem in cost.size_problems(plan)]:
        raise SceneError(too_large)
    manifest.require_same_inputs(input_digests(plan), versions())
    texture = load_texture(plan.scene, manifest.sha256.get("image")) if plan.scene.draws else None
    device = runtime.start(manifest.arch, threads)
    manifest = _add_current_versions(manifest)
    return _execute(_RunContext(manifest, plan, texture, device, Path(directory), stopwatch, progress), resumes=True)


def _require_callbacks(started: float | None, progress: StageProgressCallback) -> None:
    require_type(started, int | float | None, "started", "a value of time.perf_counter() or None")
    require_type(progress, Callable, "progress", "a function")


def _find_unfinished(context: _RunContext) -> Manifest | None:
    """Return the manifest with the versions of the unfinished run; None unless both have the same bits and estimate."""
    try:
        unfinished, _ = read_manifest(context.directory)
    except (FilesError, SceneError):
        return None
    has_same_estimate = _choose_companions(context, resumed=True) == _choose_companions(context, resumed=False)
    if context.manifest.has_same_bits_as(unfinished) and has_same_estimate:
        return replace(context.manifest, versions=unfinished.versions)
    return None


def _add_current_versions(manifest: Manifest) -> Manifest:
    """Add the versions of this process to a manifest, as the compilers of both processes affect the results."""
    return replace(manifest, versions={**manifest.versions, **versions()})


class _RunContext(NamedTuple):
    """Inputs, device and destination of a run, and the observers of its stages."""

    manifest: Manifest  # inputs on which the results depend
    plan: Plan  # of the manifest's resolved scene
    texture: NDArray[np.uint8] | None  # the picture on the sheet, if the scene is drawn
    device: Device
    directory: Path  # destination of the results
    stopwatch: Stopwatch
    progress: StageProgressCallback


def _execute(context: _RunContext, *, resumes: bool) -> RunRecord:
    """Simulate, draw and publish all frames; with `resumes`, only those missing in the directory."""
    with ExitStack() as opened:
        run = _Run(context, opened, resumes=resumes)
        run.verify_stored_frames()
        with context.stopwatch.stage("write"):
            try:
                run.prepare()
                run.simulate_frames()
                ending: dict[str, Any] = {"status": "complete"}
            except KeyboardInterrupt:
                ending = run.save_finished_frames()
            except DivergedError as error:
                ending = run.diagnose_divergence(error)
            return run.publish_results(ending)


class _Run:
    """Run in progress: the simulation, its companion runs and the writer of the results."""

    def __init__(self, context: _RunContext, opened: ExitStack, *, resumes: bool) -> None:
        self._context, self._stopwatch, self._progress = context, context.stopwatch, context.progress
        plan, device, manifest = context.plan, context.device, context.manifest
        self._frames = plan.grid.frames + 1
        self._progress("compile", 0, self._frames)
        self._cores = cores = free_cores(plan)
        # The writer is created first, so that its encoder starts while kernels are compiled.
        writer = ResultWriter(context.directory, plan, manifest.as_json(), resumes=resumes, threads=device.threads)
        self._writer = opened.enter_context(writer)
        self._simulation = opened.enter_context(Simulation(plan, device.arch, device.threads, context.texture, cores))
        self._resumed_frames = self._writer.checkpoint.frames
        companions = _choose_companions(context, resumed=self._resumed_frames > 0)
        self._error_estimator: RunErrorEstimator | None = None
        self._path_dependence = PathDependence(plan) if plan.scene.time.at_rest else None
        self._seeks_second_solutions = manifest.asks_estimate
        if self._path_dependence and self._seeks_second_solutions is None:
            is_affordable = self._path_dependence.affords(companions.cost)
            self._seeks_second_solutions = device.arch == "cpu" and is_affordable
        self._estimates = RunErrorEstimates(manifest.estimate, companions.reason, manifest.mesh)
        if companions.planned:
            try:
                self._error_estimator = RunErrorEstimator(plan, companions, self._estimates, device, cores)
            except DeviceError:
                self._estimates = self._estimates._replace(reason=f"{device.arch} cannot run this scene in f64")

    def verify_stored_frames(self) -> None:
        """Verify the checksums of stored positions before they are used."""
        for frame in range(self._resumed_frames if self._context.plan.scene.output else 0):
            self._progress("check", frame, self._resumed_frames)
            self._writer.checkpoint.read_positions(frame)

    def prepare(self) -> None:
        """Compile, and restore the simulation to the state of the unfinished run."""
        with self._stopwatch.stage("compile"):
            self._simulation.compile(partial(self._progress, "compile", 0, self._frames))
            if self._error_estimator:
                self._error_estimator.compile()
        if self._writer.saved:
            self._simulation.restore(self._writer.saved)

    def simulate_frames(self) -> None:
        """Simulate, draw and write every missing frame, and estimate the error."""
        writer, simulation, scene = self._writer, self._simulation, self._context.plan.scene
        stage, rest = self._stopwatch.stage, rest_positions(scene.sheet)
        observed = dict.fromkeys(scene.render.all_cameras, FrameOutputs())
        # The first frame and redrawn frames have no steps. They are other stages, because they would distort the
        # estimate of the remaining time.
        for frame in range(0 if scene.output else writer.frames, self._frames):
            stage_name, total = ("frames", self._frames) if frame else ("start", 1)
            if frame < self._resumed_frames:
                stage_name, total = "redraw", self._resumed_frames
            report = partial(self._progress, stage_name, frame, total)
            report()
            with stage("simulate"):
                simulation.advance(max(0, frame - simulation.frame), self._pause)
            is_stored = frame < self._resumed_frames
            position = writer.checkpoint.read_positions(frame) if is_stored else simulation.positions()
            if frame == writer.frames:  # otherwise it is stored, and has no pictures or labels
                with stage("render"):
                    time = frame / scene.time.frames_per_second
                    for camera, previous in observed.items():
                        observed[camera] = simulation.observe(previous.labels, camera, position, time)
                writer.add(position, observed, simulation.forces())
            self._compare_frame(frame, position - rest, report)
        # All frames are finished and have an error estimate. An interruption only skips its refinement.
        with suppress(KeyboardInterrupt):
            self._refine_estimate()

    def _compare_frame(self, frame: int, displacement: NDArray[Any], pause: Pause) -> None:
        """Compare the displacements of a frame with those of the companion runs, and check them for a jump."""
        if self._path_dependence:
            self._path_dependence.check_frame(frame, displacement)
        if self._error_estimator and frame > 0:
            with self._stopwatch.stage("pilot"):
                is_stored = frame < self._resumed_frames
                by_probe = self._writer.checkpoint.read_forces(frame) if is_stored else self._simulation.forces()
                forces = np.array([by_probe[tool.probe].force for tool in self._context.plan.tools]).reshape(-1, 3)
                self._error_estimator.compare_frame(displacement, pause, forces)

    def _refine_estimate(self) -> None:
        """Run the subsequent companion runs, and look for second solutions of a quasi-static scene."""
        scene, stage = self._context.plan.scene, self._stopwatch.stage
        if self._error_estimator:
            rest = rest_positions(scene.sheet)
            displacements = (self._writer.checkpoint.read_positions(frame) - rest for frame in range(1, self._frames))
            with stage("pilot"):
                self._error_estimator.finish(displacements if scene.output else None, partial(self._progress, "pilot"))
        if self._path_dependence and self._seeks_second_solutions:
            with stage("pilot"):
                pause = partial(self._progress, "pilot", 0, 1)
                self._path_dependence.finish(self._context.device, self._cores, pause)

    def save_finished_frames(self) -> dict[str, Any]:
        """Save the state and the finished frames of an interrupted run; reraise if there is no new frame."""
        writer, simulation = self._writer, self._simulation
        # A saved state needs all of its frames, and the last simulated frame may not be stored yet.
        if simulation.steps > 0 and simulation.frame < writer.checkpoint.frames and not simulation.inconsistent:
            # A divergence within this frame will recur in the resumed run.
            with suppress(DivergedError):
                writer.checkpoint.save(simulation.save())
        if writer.frames > self._resumed_frames:
            writer.finish()
        if writer.frames <= self._resumed_frames:  # `finish` drops an incomplete last frame
            raise KeyboardInterrupt
        return {"status": "interrupted"}

    def diagnose_divergence(self, error: DivergedError) -> dict[str, Any]:
        """Diagnose the divergence, and save the last valid state."""
        writer = self._writer
        self._error_estimator, self._estimates = None, RunErrorEstimates(reason="the run diverged")
        ending: dict[str, Any] = {"status": "diverged", "error": str(error), "dump": None}
        with suppress(KeyboardInterrupt):
            report = partial(self._progress, "diagnosis", writer.frames, self._frames)
            diagnosis = self._simulation.diagnose(writer.checkpoint.load(), report)
            ending["error"] = diagnosis.message
            if diagnosis.last_sound_state:
                ending["dump"] = writer.checkpoint.save(diagnosis.last_sound_state)
        return ending

    def publish_results(self, ending: dict[str, Any]) -> RunRecord:
        """Publish the results together with run.json."""
        writer, simulation, device = self._writer, self._simulation, self._context.device
        self._progress("write", writer.frames, self._frames)
        writer.finish()
        seconds = self._stopwatch.seconds
        stages = ["startup", *(["pilot"] if "pilot" in seconds else []), "compile", "simulate", "render"]
        timings = {stage: seconds.get(stage, 0.0) for stage in stages}
        record = {
            **ending,
            **self._scene_entries(),
            "resumed": self._resumed_frames,
            "timings": {**timings, "encode": writer.encode_seconds, "total": self._stopwatch.total()},
            "arch": device.arch,
            "device": device.name,
            "threads": device.threads,
            "lanes": simulation.lanes,
            "workers": simulation.workers,
            "versions": self._context.manifest.versions,
            "commit": commit(),
        }
        return cast(RunRecord, writer.publish(record))

    def _scene_entries(self) -> dict[str, Any]:
        """Build the entries of run.json about the scene, the last frame and the errors."""
        manifest, plan, progress = self._context.manifest, self._context.plan, self._simulation.progress
        scene = plan.scene
        estimates = self._error_estimator.estimates if self._error_estimator else self._estimates
        probes = probe_records(scene)
        for record, peak in zip(probes, self._simulation.felt.greatest, strict=True):
            record["greatest_force"], record["greatest_force_vector"] = math.hypot(*peak.force), list(peak.force)
            record["greatest_force_time"] = peak.time
        notes = [
            *run_warnings(plan, probes, progress, estimates, _runs_within_an_hour, _pixels_per_metre(scene)),
            *(self._path_dependence.warnings() if self._path_dependence else ()),
            *drawing_warnings(scene),
        ]
        # Paths are as given; only the sections sheet and time contain resolved values.
        given_paths = dict(zip(scene.sheet.files.values(), manifest.given.sheet.files.values(), strict=True))
        sheet = scene.sheet.with_files(given_paths.__getitem__)
        simulated = manifest.given.model_copy(update={"sheet": sheet, "time": scene.time})
        return {
            "scene": simulated.model_dump(mode="json"),
            "asked": _requested_values(manifest.given, scene),
            "working_directory": manifest.folder,
            "sha256": dict(manifest.sha256),
            "overrides": list(manifest.overrides),
            "points": list(scene.sheet.points),
            **({"surface": surface} if (surface := surface_record(scene)) else {}),
            **cost.step_entries(plan, progress.frame),
            **({"residual": progress.residual, "evaluations": progress.evaluations} if scene.time.at_rest else {}),
            "max_displacement": progress.max_displacement,
            "max_displacement_frame": progress.max_displacement_frame,
            "shortest_spring": progress.shortest_spring,
            "longest_spring": progress.longest_spring,
            "probes": probes,
            "notes": notes,
            "error_estimate": _error_record(estimates),
            **({"error_estimate_reason": estimates.reason} if estimates.time_step is None else {}),
        }

    def _pause(self) -> None:
        """Report the progress within a frame, and save the state when due."""
        with self._stopwatch.stage("write"):
            self._progress("frames", self._writer.frames, self._frames)
            if self._writer.checkpoint.is_save_due:
                self._writer.checkpoint.save(self._simulation.save())


def _choose_companions(context: _RunContext, *, resumed: bool) -> CompanionRuns:
    """Choose the companion runs for the error estimate, or the reason for their absence."""
    requested = context.manifest.asks_estimate
    if requested is False:
        return CompanionRuns(reason="not asked for")
    if requested is None and context.device.arch != "cpu":
        return CompanionRuns(reason="on a GPU, this needs --estimate-error")
    companions = choose_companion_runs(context.plan, requested=requested is True)
    if companions.planned and resumed and not context.plan.scene.output:
        return CompanionRuns(reason="the frames before the interruption were not kept")
    return companions


def _runs_within_an_hour(plan: Plan) -> bool:
    return cost.estimate_duration(plan).seconds <= 3600


def free_cores(plan: Plan) -> int:
    """Return the number of cores for stepping: all, or one less if encoding takes longer than stepping."""
    width, height = plan.scene.render.size
    rows, cols = plan.scene.sheet.points
    encoding = width * height * len(plan.scene.render.all_cameras) * ENCODING_WORK if plan.scene.draws else 0
    is_encoder_busy = encoding > rows * cols * plan.grid.steps_per_frame
    return max(1, process.available_threads() - is_encoder_busy)


def _requested_values(given: Scene, scene: Scene) -> dict[str, Any]:
    """Return the requested values that differ from the resolved ones, by dotted key."""
    keys = ["sheet.points", "sheet.tolerance", "time.step", "time.precision", "time.tolerance"]
    if given.sheet.surface and given.sheet.surface.depth:
        keys.append("sheet.surface.depth.smooth")
    values = zip(keys, attrgetter(*keys)(given), attrgetter(*keys)(scene), strict=True)
    return {key: requested for key, requested, resolved in values if requested != resolved}


def _pixels_per_metre(scene: Scene) -> float | None:
    """Return the image scale at the centre of the sheet [px/m]; None without pictures or if it is out of view."""
    if not scene.renders:
        return None
    points = np.array([[0.0, 0, 0], [1e-4, 0, 0], [0, 1e-4, 0]])
    centre, right, up = view_at(scene, 0.0, next(iter(scene.render.all_cameras))).pixels(points)
    scale = float(max(np.linalg.norm(right - centre), np.linalg.norm(up - centre))) / 1e-4
    return scale if math.isfinite(scale) else None


def _error_record(estimates: RunErrorEstimates) -> dict[str, Any] | None:
    """Build the error estimate for run.json; unknown values are null."""
    estimate, mesh, keys = estimates.time_step, estimates.mesh, ("error", "rounding", "in_f64", "order", "at_least")
    if estimate is not None:
        fields: dict[str, Any] = {key: getattr(estimate, key) for key in keys}
        if not estimate.separate:
            fields |= {"rounding": None, "in_f64": None}
    elif mesh is not None and estimates.reason == QUASISTATIC_REASON:
        fields = dict.fromkeys(keys) | {"at_least": False}
    else:
        return None
    if mesh is not None:
        fields |= {"mesh_error": mesh.error, "mesh_doubt": mesh.doubt}
    if estimates.force is not None:
        fields |= {"force_error": estimates.force.error, "force_doubt": estimates.force.doubt}
    return {key: None if value == math.inf else value for key, value in fields.items()}
