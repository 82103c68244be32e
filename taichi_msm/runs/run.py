"""The loop over the frames of a scene: it simulates, draws and writes them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
from taichi_msm.accuracy.report import RunErrorEstimates, RunErrorEstimator, run_warnings
from taichi_msm.errors import (
    DamagedError,
    DeviceError,
    DivergedError,
    FilesError,
    SceneError,
    StageProgressCallback,
    require_path,
    writing,
)
from taichi_msm.load import cost
from taichi_msm.load.check import check_scene
from taichi_msm.load.resolve import resolve
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tool_force import ProbeRecord, probe_records
from taichi_msm.render.camera import view_at
from taichi_msm.render.labels import FrameOutputs
from taichi_msm.render.notes import drawing_warnings
from taichi_msm.render.texture import load_texture
from taichi_msm.runs.manifest import Manifest, digests, read_manifest
from taichi_msm.runs.simulation import Simulation
from taichi_msm.runs.writer import ResultWriter, RunRecord
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import ENCODING
from taichi_msm.solver.state import ProbeForces, RunProgress
from taichi_msm.system import process, runtime
from taichi_msm.system.compiler import versions
from taichi_msm.system.runtime import Device

# Points are advised only for a run that takes no longer than this [s].
LONGEST_ADVISED = 3600.0


class Stopwatch:
    """Adds up the time of every stage of a run [s]; a stage within another one interrupts it.

    The first stage, startup, began at `started`, a `time.perf_counter()`; None: now.
    """

    def __init__(self, started: float | None) -> None:
        self.seconds: dict[str, float] = {}
        self._stage = "startup"
        self._started = self._last = time.perf_counter() if started is None else started

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time of a block as that of a stage."""
        around = self._switch(name)
        try:
            yield
        finally:
            self._switch(around)

    def _switch(self, stage: str) -> str:
        """Begin a stage; returns the one that it interrupts."""
        now, before = time.perf_counter(), self._stage
        self.seconds[before] = self.seconds.get(before, 0.0) + now - self._last
        self._last, self._stage = now, stage
        return before

    def total(self) -> float:
        """Give the time since the beginning [s]."""
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
    """Simulate a scene and write its results, whole or not at all.

    An unfinished run of the same scene in the same directory is continued: the results have the same bits. Without any
    output, and with an estimate of the error, it begins anew, as the estimate needs the frames that were not kept.

    Args:
        scene: what `load_scene` returned, or the same as a mapping.
        directory: where frames/, animation.gif, animation.mp4, trajectory.npz, forces.csv and run.json go; of several
            cameras, what each sees goes to a folder there that has its name.
        arch: cpu, cuda or vulkan.
        threads: number of CPU threads; None takes every core. With 1, pictures are encoded in this process too.
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

    Example:
        >>> from taichi_msm import load_scene, run
        >>> scene = load_scene("scenes/press.yaml", {"sheet.points": [41, 41]})
        >>> record = run(scene, "output/press")
        >>> record["status"], record["frames"], record["precision"]
        ('complete', 31, 'f64')
    """
    watch = Stopwatch(started)
    plan = check_scene(scene)
    require_path(directory)
    folder = Path(directory)
    cost.require_disk(plan, folder)
    device = runtime.start(arch, threads)
    sha256 = digests(plan)
    given = plan.scene
    texture = load_texture(given, sha256.get("image")) if given.draws else None
    seeks = given.sheet.tolerance is not None or given.time.tolerance is not None
    with watch.stage("pilot" if seeks else "startup"):
        plan, estimate, mesh = resolve(plan, device, partial(progress, "pilot"))
    if mesh is not None:
        cost.require_disk(plan, folder)
    with writing(directory):
        here = str(Path.cwd())
    manifest = Manifest(
        given, plan.scene, tuple(overrides), estimate, mesh, estimate_error, here, arch, sha256, versions()
    )
    task = _Task(manifest, plan, texture, device, folder)
    if begun := _begun(task):
        with suppress(DamagedError):
            return _carry_out(task._replace(manifest=_with_versions(begun)), watch, progress, resumes=True)
    return _carry_out(task, watch, progress, resumes=False)


def resume(
    directory: str | Path,
    *,
    threads: int | None = None,
    started: float | None = None,
    progress: StageProgressCallback = lambda stage, done, total: None,
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
    manifest, plan = read_manifest(Path(directory))
    if too_large := [str(problem) for problem in cost.size_problems(plan)]:
        raise SceneError(too_large)
    manifest.require_same(digests(plan), versions())
    texture = load_texture(plan.scene, manifest.sha256.get("image")) if plan.scene.draws else None
    device = runtime.start(manifest.arch, threads)
    task = _Task(_with_versions(manifest), plan, texture, device, Path(directory))
    return _carry_out(task, watch, progress, resumes=True)


def _begun(task: _Task) -> Manifest | None:
    """Find the unfinished run in the directory that leads to the same bits, and to the same estimate of their error."""
    manifest = task.manifest
    try:
        unfinished, _ = read_manifest(task.directory)
    except (FilesError, SceneError):
        return None
    if not manifest.gives_the_bits_of(unfinished) or _pilots(task, resumed=True) != _pilots(task, resumed=False):
        return None
    return replace(manifest, versions=unfinished.versions)


def _with_versions(begun: Manifest) -> Manifest:
    """Add the versions of this process, whose compiler may be another one, to those of the process that began a run."""
    return replace(begun, versions={**begun.versions, **versions()})


class _Task(NamedTuple):
    """What is to be run."""

    manifest: Manifest  # as it is written down
    plan: Plan  # of its scene, in which nothing is left open
    texture: NDArray[np.uint8] | None  # the picture on the sheet, if anything is drawn
    device: Device
    directory: Path  # where the results go


def _carry_out(task: _Task, watch: Stopwatch, progress: StageProgressCallback, *, resumes: bool) -> RunRecord:
    """Simulate and draw all frames, or those that the unfinished run in the directory lacks."""
    with ExitStack() as opened:
        run = _Run(task, watch, progress, opened, resumes=resumes)
        run.check_stored_frames()
        with watch.stage("hand over"):
            try:
                run.prepare()
                run.go_through_frames()
                ending: dict[str, Any] = {"status": "complete"}
            except KeyboardInterrupt:
                ending = run.keep_finished_frames()
            except DivergedError as error:
                ending = run.find_cause(error)
            return run.conclude(ending)


class _Run:
    """A run under way: a simulation, the pilots beside it, and the results as they grow; all opened in a stack."""

    def __init__(
        self, task: _Task, watch: Stopwatch, progress: StageProgressCallback, opened: ExitStack, *, resumes: bool
    ) -> None:
        self._task, self._watch, self._progress = task, watch, progress
        plan, device, manifest = task.plan, task.device, task.manifest
        self._frames = plan.grid.frames + 1
        progress("compile", 0, self._frames)
        self._cores = cores = free_cores(plan)
        # With one thread there is no core for an encoder beside the simulation.
        beside = device.threads > 1
        # In this order, so that the encoder starts up while kernels are compiled.
        self._writer = opened.enter_context(
            ResultWriter(task.directory, plan.scene, plan.grid, manifest.as_json(), resumes=resumes, beside=beside)
        )
        self._simulation = opened.enter_context(Simulation(plan, device.arch, device.threads, task.texture, cores))
        self._resumed = self._writer.stored
        pilots = _pilots(task, resumed=self._resumed > 0)
        self._error: RunErrorEstimator | None = None
        self._ways = PathDependence(plan) if plan.scene.time.at_rest else None
        asked = manifest.asks_estimate
        self._solves_again = self._ways is not None and (
            asked is True or (asked is None and device.arch == "cpu" and self._ways.affords(pilots.cost))
        )
        self._known = RunErrorEstimates(manifest.estimate, pilots.reason, manifest.mesh)
        if pilots.planned:
            try:
                self._error = RunErrorEstimator(plan, pilots, self._known, device, cores)
            except DeviceError:
                self._known = self._known._replace(reason=f"{device.arch} cannot run this scene in f64")

    def check_stored_frames(self) -> None:
        """Find damage in the stored positions before they are used."""
        for frame in range(self._resumed if self._task.plan.scene.output else 0):
            self._progress("check", frame, self._resumed)
            self._writer.position(frame)

    def prepare(self) -> None:
        """Compile, and bring the simulation and its pilots to where the unfinished run was left."""
        writer, rest = self._writer, rest_positions(self._task.plan.scene.sheet)
        with self._watch.stage("compile"):
            self._simulation.compile(partial(self._progress, "compile", 0, self._frames))
            if self._error:
                self._error.compile()
        if writer.saved:
            self._simulation.restore(writer.saved)
        if self._ways and self._task.plan.scene.output:
            for frame in range(writer.frames):
                self._ways.check_frame(frame, writer.position(frame) - rest)
        if self._error:
            with self._watch.stage("pilot"):
                for frame in range(1, writer.frames):
                    told = partial(self._progress, "pilot", frame, writer.frames)
                    self._error.compare_frame(writer.position(frame) - rest, told)

    def go_through_frames(self) -> None:
        """Simulate, draw and write every frame that is missing, and finish the results."""
        writer, simulation, scene = self._writer, self._simulation, self._task.plan.scene
        stage, rest = self._watch.stage, rest_positions(scene.sheet)
        observed = dict.fromkeys(scene.render.all_cameras, FrameOutputs())
        # Frames that need no step are told apart, as they say nothing of the time that the others will take.
        without_steps = max(self._resumed, 1)
        for frame in range(writer.frames, self._frames):
            kind, of = ("redraw", without_steps) if frame < without_steps else ("frames", self._frames)
            told = partial(self._progress, kind, frame, of)
            told()
            with stage("simulate"):
                simulation.advance(max(0, frame - simulation.frame), self._pause)
            position = writer.position(frame) if frame < self._resumed else simulation.positions()
            with stage("render"):
                time = frame / scene.time.frames_per_second
                for camera, before in observed.items():
                    observed[camera] = simulation.observe(before.labels, camera, position, time)
            writer.add(position, observed, simulation.forces(), told)
            if self._ways:
                self._ways.check_frame(frame, position - rest)
            if self._error and frame > 0:
                with stage("pilot"):
                    of_tools = [simulation.forces()[tool.probe].force for tool in self._task.plan.tools]
                    forces = np.array(of_tools).reshape(-1, 3) if frame >= self._resumed else None
                    self._error.compare_frame(position - rest, told, forces)
        try:
            if self._error:
                kept = (writer.position(frame) - rest for frame in range(1, self._frames)) if scene.output else None
                with stage("pilot"):
                    self._error.finish(kept, partial(self._progress, "pilot"))
            if self._ways and self._solves_again:
                with stage("pilot"):
                    self._ways.finish(self._task.device, self._cores, partial(self._progress, "pilot", 0, 1))
        except KeyboardInterrupt:
            # All frames are done, and what the coarse pilot tells stands.
            writer.finish()
        else:
            writer.finish(partial(self._progress, "frames", self._frames, self._frames))

    def keep_finished_frames(self) -> dict[str, Any]:
        """Save what an interrupted run has; KeyboardInterrupt: no new frame."""
        writer, simulation = self._writer, self._simulation
        # An interruption outside `progress` may come before the last frame is stored.
        if simulation.steps > 0 and simulation.frame < writer.stored and not simulation.inconsistent:
            # If the simulation diverges within this frame, the resumed run will find it.
            with suppress(DivergedError):
                writer.save(simulation.save())
        # Without a new frame there are no new results; to end soon, new frames may be given up too.
        if writer.frames > self._resumed:
            writer.finish(hurry=True)
        if writer.frames <= self._resumed:
            raise KeyboardInterrupt
        return {"status": "interrupted"}

    def find_cause(self, error: DivergedError) -> dict[str, Any]:
        """Say why the run diverged, and save its last sound state."""
        writer = self._writer
        self._error, self._known = None, RunErrorEstimates(reason="the run diverged")
        ending: dict[str, Any] = {"status": "diverged", "error": str(error), "dump": None}
        with suppress(KeyboardInterrupt):
            diagnosis = self._simulation.diagnose(
                writer.load(), partial(self._progress, "diagnosis", writer.frames, self._frames)
            )
            ending["error"] = diagnosis.message
            if diagnosis.last_sound_state:
                ending["dump"] = writer.save(diagnosis.last_sound_state)
        return ending

    def conclude(self, ending: dict[str, Any]) -> RunRecord:
        """Publish the results with their record."""
        writer, simulation, device, watch = self._writer, self._simulation, self._task.device, self._watch
        self._progress("write", writer.frames, self._frames)
        writer.finish()
        known = self._error.estimates if self._error else self._known
        stages = ["startup", *(["pilot"] if "pilot" in watch.seconds else []), "compile", "simulate", "render"]
        seconds = {stage: watch.seconds.get(stage, 0.0) for stage in stages}
        record = {
            **ending,
            **_facts(
                self._task, simulation.progress, simulation.felt, known, self._ways.warnings() if self._ways else ()
            ),
            "resumed": self._resumed,
            "timings": {**seconds, "encode": writer.encode_seconds, "total": watch.total()},
            "arch": device.arch,
            "device": device.name,
            "threads": device.threads,
            "lanes": simulation.lanes,
            "workers": simulation.workers,
            "versions": self._task.manifest.versions,
        }
        return cast(RunRecord, writer.publish(record))

    def _pause(self) -> None:
        """Show the progress within a frame, and save the state of the run from time to time."""
        with self._watch.stage("hand over"):
            self._progress("frames", self._writer.frames, self._frames)
            if self._writer.due:
                self._writer.save(self._simulation.save())


def _pilots(task: _Task, *, resumed: bool) -> CompanionRuns:
    """Choose the pilots of a run, or say why there are none."""
    asked = task.manifest.asks_estimate
    if asked is False:
        return CompanionRuns(reason="not asked for")
    if asked is None and task.device.arch != "cpu":
        return CompanionRuns(reason="on a GPU, this needs --estimate-error")
    pilots = choose_companion_runs(task.plan, requested=asked is True)
    if pilots.planned and resumed and not task.plan.scene.output:
        return CompanionRuns(reason="the frames before the interruption were not kept")
    return pilots


def _facts(
    task: _Task, progress: RunProgress, felt: ProbeForces, known: RunErrorEstimates, path_dependence: Iterable[str]
) -> dict[str, Any]:
    """Say what was run, and what is known of its last frame, for run.json."""
    manifest, plan = task.manifest, task.plan
    scene = plan.scene
    probes = [
        ProbeRecord(
            **record,
            greatest_force=math.hypot(*peak.force),
            greatest_force_vector=list(peak.force),
            greatest_force_time=peak.time,
        )
        for record, peak in zip(probe_records(scene), felt.greatest, strict=True)
    ]
    return {
        # With the paths of pictures as they were given; only these two sections hold anything that is chosen.
        "scene": manifest.given.model_copy(update={"sheet": scene.sheet, "time": scene.time}).model_dump(mode="json"),
        "asked": _asked(manifest.given, scene),
        "working_directory": manifest.folder,
        "sha256": dict(manifest.sha256),
        "overrides": list(manifest.overrides),
        "points": list(scene.sheet.points),
        **_steps(plan, progress),
        "max_displacement": progress.max_displacement,
        "shortest_spring": progress.shortest_spring,
        "longest_spring": progress.longest_spring,
        "probes": probes,
        "notes": [
            *run_warnings(plan, probes, progress, *known, _affords, _scale(scene)),
            *path_dependence,
            *drawing_warnings(scene),
        ],
        "error_estimate": error_record(known),
        **({"error_estimate_reason": known.reason} if known.estimate is None else {}),
    }


def _steps(plan: Plan, progress: RunProgress) -> dict[str, Any]:
    """Say what steps were taken; at rest there are none, and how well the forces balance is said instead."""
    grid, limit = plan.grid, plan.stable_step
    if plan.scene.time.at_rest:
        steps = dict.fromkeys(("step", "stable_step", "steps_per_frame", "steps"))
        found = {"residual": progress.residual, "evaluations": progress.evaluations}
        return {**steps, "precision": grid.precision, **found}
    return {
        "step": grid.step,
        "stable_step": limit if limit < math.inf else None,
        "steps_per_frame": grid.steps_per_frame,
        "precision": grid.precision,
        "steps": progress.frame * grid.steps_per_frame,
    }


def free_cores(plan: Plan) -> int:
    """Count the cores that are free for stepping: all but one for the encoder, unless that mostly waits for frames."""
    width, height = plan.scene.render.size
    rows, cols = plan.scene.sheet.points
    encoding = width * height * len(plan.scene.render.all_cameras) * ENCODING if plan.scene.draws else 0
    busy = encoding > rows * cols * plan.grid.steps_per_frame
    return max(1, process.available_threads() - busy)


def _asked(given: Scene, scene: Scene) -> dict[str, Any]:
    """Give the keys of a scene, by their paths, for which a run chose other values, and the values that they had."""
    keys = ("sheet.points", "sheet.tolerance", "time.step", "time.precision", "time.tolerance")
    pairs = [(key, attrgetter(key)(given), attrgetter(key)(scene)) for key in keys]
    return {key: asked for key, asked, chosen in pairs if asked != chosen}


def _affords(plan: Plan) -> bool:
    """Tell whether a run takes at most an hour, as `check` estimates it."""
    return cost.estimate_duration(plan).seconds <= LONGEST_ADVISED


def _scale(scene: Scene) -> float | None:
    """Compute the pixels per metre at the middle of the sheet; None: no picture is drawn, or it is out of sight."""
    if not scene.renders:
        return None
    middle, right, up = view_at(scene, 0.0, next(iter(scene.render.all_cameras))).pixels(
        np.array([[0.0, 0, 0], [1e-4, 0, 0], [0, 1e-4, 0]])
    )
    scale = float(max(np.linalg.norm(right - middle), np.linalg.norm(up - middle))) / 1e-4
    return scale if math.isfinite(scale) else None


def error_record(known: RunErrorEstimates) -> dict[str, Any] | None:
    """Write what is known of the error for run.json, where null stands for what is not known, or not there."""
    estimate, mesh, keys = known.estimate, known.mesh, ("error", "rounding", "in_f64", "order", "at_least")
    if estimate is not None:
        fields: dict[str, Any] = {key: getattr(estimate, key) for key in keys}
    elif mesh is not None and known.reason == QUASISTATIC_REASON:
        fields = dict.fromkeys(keys) | {"at_least": False}
    else:
        return None
    if estimate is not None and not estimate.parted:
        fields |= {"rounding": None, "in_f64": None}
    if mesh is not None:
        fields |= {"mesh_error": mesh.error, "mesh_doubt": mesh.doubt}
    if known.force is not None:
        fields |= {"force_error": known.force.error, "force_doubt": known.force.doubt}
    return {key: None if value == math.inf else value for key, value in fields.items()}
