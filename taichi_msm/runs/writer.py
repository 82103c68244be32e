"""Writers of the results of a run: pictures, labels, trajectory, forces and run.json, published atomically."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from typing_extensions import NotRequired

from taichi_msm.accuracy.surface import SurfaceRecord
from taichi_msm.cameras.view import pair_transform
from taichi_msm.errors import writing
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import surface_positions
from taichi_msm.model.tool_force import ProbeRecord
from taichi_msm.render.camera import calibration, is_moving, pose, view_at
from taichi_msm.render.labels import FrameOutputs, track_grid
from taichi_msm.runs.arrays import ChunkedArray, write_arrays, write_flo
from taichi_msm.runs.checkpoint import CHECKPOINT_FOLDER, CHECKPOINT_PATTERNS, Checkpoint
from taichi_msm.runs.directory import Publication, PublicationSpec, create_file, write_new_file
from taichi_msm.runs.encoder import Encoder, EncodingJob, PictureWriter
from taichi_msm.scene import outputs
from taichi_msm.scene.outputs import CAMERA_FILE, OUTPUTS
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.state import TipForce

RUN_PUBLICATION = PublicationSpec(
    "run",
    outputs.RUN_RECORD,
    outputs.RESULT_PATTERNS,
    lambda record: partial(outputs.is_result, set(record["outputs"]), int(record["frames"])),
    unpublished=(CHECKPOINT_FOLDER, CHECKPOINT_PATTERNS),
)


class ResultWriter(AbstractContextManager["ResultWriter"]):
    """Streaming writer of the results of a run, as a context manager.

    Files are written to a hidden folder, and `publish` moves them into place atomically. Without `publish`, they are
    deleted at exit. A checkpoint with the manifest exists from the first frame to the publication of complete results,
    and a later writer `resumes` from it. With one of `threads`, no core is free for an encoding process, and `add`
    encodes the pictures. Foreign files in the directory are never changed; one at the path of a result is a FilesError,
    as is another run that writes there.
    """

    def __init__(
        self, directory: Path, plan: Plan, manifest: Mapping[str, Any], *, resumes: bool = False, threads: int = 2
    ) -> None:
        self._directory, self._manifest = directory, manifest
        self._scene = scene = plan.scene
        self._finished = False
        self.encode_seconds = 0.0  # processor time of encoding pictures; valid after `finish`
        names = outputs.file_names(outputs.result_names(scene.folders), scene.time.frames + 1)
        names += [outputs.REST_FILE] * (scene.sheet.surface is not None)
        with writing(directory), ExitStack() as opened:
            self._publication = opened.enter_context(Publication(directory, RUN_PUBLICATION, names))
            new_folder = self._publication.new_folder
            for name in scene.render.all_cameras if scene.renders else ():
                (new_folder / name).mkdir(exist_ok=True)
            self._labels = {name: LabelWriter(new_folder / name, scene, name) for name in scene.render.all_cameras}
            self._encoder: Encoder | PictureWriter | None = None
            if scene.draws:
                folders = tuple(new_folder / name for name in scene.render.all_cameras)
                render, rate = scene.render, scene.time.frames_per_second
                job = EncodingJob(folders, render.size, rate, scene.output, render.background, render.quality)
                locks = self._publication.lock_descriptors
                self._encoder = Encoder(job, locks) if threads > 1 else PictureWriter(job)
                opened.callback(self._encoder.abort)
            self.checkpoint = Checkpoint(self._publication.staging_folder / CHECKPOINT_FOLDER, plan)
            opened.callback(self.checkpoint.close)
            # State from which the run continues; None for the initial state.
            self.saved = self.checkpoint.reopen() if resumes else None
            # Number of frames in the results; after an interruption, valid after `finish`.
            self.frames = 0 if scene.renders else self.checkpoint.frames
            self._open = opened.pop_all()

    def add(
        self, position: NDArray[Any], observed: Mapping[str, FrameOutputs], forces: Sequence[TipForce] = ()
    ) -> None:
        """Add the next frame: positions [m], shape (rows, cols, 3), outputs by camera, and the force of every probe.

        If the frame is already in the checkpoint of a resumed run, only its files are written.
        """
        with writing(self._directory):
            # Positions are stored first, so that an interruption never leaves a picture without positions.
            if self.checkpoint.frames == 0:
                self._publication.keep_unpublished = False
                self.checkpoint.begin(self._manifest)
            if self.frames == self.checkpoint.frames:
                self.checkpoint.add(position, forces)
                self._publication.keep_unpublished = True
            for name, labels in self._labels.items():
                labels.add(self.frames, observed[name], position)
            if self._encoder:
                pictures = [frame.picture for frame in observed.values() if frame.picture is not None]
                self._encoder.add(np.stack(pictures) if len(pictures) > 1 else pictures[0][None])
            self.frames += 1

    def finish(self) -> None:
        """Wait until all frames are encoded, and write the files that combine frames."""
        if self._finished:
            return
        with writing(self._directory):
            if self._encoder:
                self.frames, self.encode_seconds = self._encoder.finish()
            for labels in self._labels.values():
                labels.finish(self.frames)
            if self.frames and "trajectory" in self._scene.output:
                self._write_trajectory()
            if self.frames and "forces" in self._scene.output:
                self._write_forces()
        self._finished = True

    def publish(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Replace earlier results; write and return run.json, which is `record` with "frames" and "outputs" added."""
        self.finish()
        with writing(self._directory):
            results = outputs.result_names(self._scene.folders if self.frames else {})
            if self._scene.sheet.surface:
                self._write_rest()
                results.insert(-1, outputs.REST_FILE)
            # By "outputs", the next run into the directory recognises the files that it may replace.
            complete_record = {**record, "frames": self.frames, "outputs": results}
            text = json.dumps(complete_record, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
            # File names that are not UTF-8 contain surrogates; with backslash escapes the JSON is valid.
            write_new_file(self._publication.new_folder / outputs.RUN_RECORD, text.encode("utf-8", "backslashreplace"))
            self._publication.publish(outputs.file_names(results, self.frames))
            if record.get("status") == "complete":
                self.checkpoint.invalidate()
                self._publication.keep_unpublished = False
        return complete_record

    def _write_trajectory(self) -> None:
        """Write times [s] and positions [m] of all frames, in chunks, because they may exceed memory."""
        checkpoint, frames = self.checkpoint, self.frames
        shape = (frames, *self._scene.sheet.points, 3)
        arrays: dict[str, NDArray[Any] | ChunkedArray] = {
            "time": np.arange(frames) / self._scene.time.frames_per_second,
            "position": ChunkedArray(checkpoint.precision, shape, map(checkpoint.read_positions, range(frames))),
        }
        with create_file(self._publication.new_folder / OUTPUTS["trajectory"].path()) as file:
            write_arrays(file, arrays)

    def _write_rest(self) -> None:
        """Write positions [m], areas [m2] and normals of the mass points at rest, and their places in the picture."""
        rest = rest_of(self._scene.sheet)
        assert isinstance(rest, CurvedRest)
        arrays = {"position": rest.position, "area": rest.areas, "normal": rest.point_normals}
        if isinstance(rest, PicturedRest):
            arrays["texture"] = rest.texture
        if rest.origin.grid is not None:
            arrays["grid"] = rest.origin.grid
        with create_file(self._publication.new_folder / outputs.REST_FILE) as file:
            write_arrays(file, arrays)

    def _write_forces(self) -> None:
        """Write the forces of all frames, as decimals that round-trip to float64."""
        path = self._publication.new_folder / OUTPUTS["forces"].path()
        with io.TextIOWrapper(create_file(path), "ascii", newline="") as text:
            rows = csv.writer(text, lineterminator="\n")
            rows.writerow(outputs.FORCES_HEADER)
            for frame in range(self.frames):
                time = frame / self._scene.time.frames_per_second
                forces = self.checkpoint.read_forces(frame)
                rows.writerows((time, force.probe, *force.tip, *force.force) for force in forces)

    def __exit__(self, *_: object) -> None:
        self._open.close()


class LabelWriter:
    """Writer of the labels of a camera, "" for an unnamed one, frame by frame."""

    def __init__(self, folder: Path, scene: Scene, camera: str) -> None:
        self._folder, self._scene, self._camera = folder, scene, camera
        selected = [output for name, output in OUTPUTS.items() if name in scene.folders[camera]]
        self._frame_outputs = [output for output in selected if output.source in ("labels", "flow", "stereo")]
        self._writes_camera = any(OUTPUTS[name].needs_camera for names in scene.folders.values() for name in names)
        # Tracks stay in memory until `finish`, as their arrays are ordered by track, not by frame.
        rest = rest_of(scene.sheet)
        self._grid = track_grid(scene.render.tracks, rest)
        self._mesh = rest.mesh_places(self._grid.astype(float)).clip(0, 1)
        shape = len(self._grid) if scene.asks_for("tracks") else 0, scene.time.frames + 1
        self._pixels, self._occluded = np.empty((*shape, 2), np.float32), np.empty(shape, np.bool_)
        self._position = np.empty((*shape, 3), np.float32)
        self._added = 0

    def add(self, frame: int, observed: FrameOutputs, position: NDArray[Any]) -> None:
        """Write the labels of a frame, with positions [m], shape (rows, cols, 3); tracks are kept until `finish`."""
        self._added = frame + 1
        for output in self._frame_outputs:
            number = frame - 1 if output.is_frame_pair else frame
            if number >= 0:
                labels, path = getattr(observed, output.source), self._folder / output.path(number)
                path.parent.mkdir(exist_ok=True)
                with create_file(path) as file:
                    _LABEL_WRITERS[path.suffix](file, getattr(labels, output.name))
        if observed.tracks is not None:
            self._pixels[:, frame], self._occluded[:, frame] = observed.tracks
            self._position[:, frame] = surface_positions(position, self._scene.render.refine, self._mesh)

    def finish(self, frames: int) -> None:
        """Write camera.json and the tracks of the first `frames` frames, and delete the files of later ones."""
        if not frames:
            return
        for output in self._frame_outputs:
            for number in range(output.count(frames), self._added):
                (self._folder / output.path(number)).unlink(missing_ok=True)
        if self._writes_camera:
            scene, name = self._scene, self._camera
            matrices = {"size": list(scene.render.size), **calibration(view_at(scene, 0.0, name))}
            matrices |= pair_transform(scene.render.all_cameras[name])
            if is_moving(scene, name):
                rate = scene.time.frames_per_second
                matrices["poses"] = [pose(view_at(scene, frame / rate, name)) for frame in range(frames)]
            write_new_file(self._folder / CAMERA_FILE, (json.dumps(matrices, indent=2) + "\n").encode())
        if self._scene.asks_for("tracks"):
            tracks = {"points": self._pixels, "occluded": self._occluded, "position": self._position}
            tracks = {name: values[:, :frames] for name, values in tracks.items()}
            with create_file(self._folder / OUTPUTS["tracks"].path()) as file:
                write_arrays(file, {"coordinates": self._grid, **tracks})


_LABEL_WRITERS: dict[str, Callable[[BinaryIO, Any], None]] = {
    ".npy": np.save,
    ".tiff": lambda file, depth: Image.fromarray(depth).save(file, "TIFF"),
    ".flo": write_flo,
    # Level 1 suffices, as masks consist of few large areas.
    ".png": lambda file, mask: Image.fromarray(mask).save(file, "PNG", compress_level=1),
}


class ErrorRecord(TypedDict):
    """Estimated errors of a run, relative to the largest displacement. Unknown ones are None, as after a divergence."""

    error: float | None  # largest error of any mass point in any frame, due to step and rounding; None if quasi-static
    rounding: float | None  # share of `error` due to f32; None if not separated by the companion runs
    in_f64: float | None  # error of the same step in f64; None as for `rounding`
    order: int | None  # of the method; None if quasi-static
    at_least: bool  # whether `error` is a lower bound
    mesh_error: NotRequired[float | None]  # discretisation error; only with tissue
    mesh_doubt: NotRequired[str]  # reason for a larger or an unknown `mesh_error`; empty if it is reliable
    force_error: NotRequired[float | None]  # of position-controlled tools, relative to the greatest force
    force_doubt: NotRequired[str]  # reason for an unknown `force_error`


class RunRecord(TypedDict, total=False):
    """Content of run.json."""

    status: Literal["complete", "diverged", "interrupted"]
    error: str  # location and cause of the divergence; only if diverged
    dump: str | None  # file with the last valid state, or None; only if diverged
    scene: dict[str, Any]  # as simulated, with resolved mesh, step and precision
    asked: dict[str, Any]  # requested values that differ from the resolved ones, by dotted key
    working_directory: str  # folder to which picture paths are relative
    # Digests of picture, map and camera files by scene key, such as image and tissue.map.image. An unreadable picture
    # that is not drawn is omitted.
    sha256: dict[str, str]
    overrides: list[str]  # of the scene file
    points: list[int]  # rows and columns of mass points
    surface: SurfaceRecord  # only of a sheet that is curved at rest
    step: float | None  # [s]; None if quasi-static
    stable_step: float | None  # largest stable step [s]; None if quasi-static or if every step is stable
    steps_per_frame: int | None  # None if quasi-static
    precision: str  # f32 or f64
    steps: int | None  # number of steps so far; None if quasi-static
    residual: float  # quasi-static: largest net force on a mass point in any frame, relative to the largest force
    evaluations: int  # quasi-static: number of force evaluations so far
    max_displacement: float  # [m]
    max_displacement_frame: int  # frame with this displacement
    shortest_spring: float  # smallest ratio of a spring's length to its rest length
    longest_spring: float  # largest such ratio
    probes: list[ProbeRecord]
    notes: list[str]  # warnings about the validity of the results
    error_estimate: ErrorRecord | None  # None for the reason in `error_estimate_reason`
    error_estimate_reason: str
    resumed: int  # number of frames simulated before the run was resumed
    timings: dict[str, float]  # time of every stage [s]
    arch: str  # cpu, cuda or vulkan
    device: str  # name of the processor or the GPU; empty if unknown
    threads: int  # number of CPU threads of the compiler
    lanes: int  # number of SIMD lanes used for stepping; 1 on a GPU
    workers: int  # number of threads used for stepping; 0 on a GPU
    versions: dict[str, str]  # of all software that affects the results
    commit: str | None  # git commit of the program; None without a clone
    frames: int
    outputs: list[str]  # names of files, and of folders with a file per frame
