"""Write the results of a run: frames, animations, trajectory, forces and record, whole or not at all.

Write the labels of the frames of a run to files.

The content of run.json.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from typing_extensions import NotRequired

from taichi_msm.errors import Pause, writing
from taichi_msm.model.surface import surface_positions
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.model.tool_force import ProbeRecord
from taichi_msm.render.camera import calibration, is_moving, pose, view_at
from taichi_msm.render.labels import FrameOutputs, track_grid
from taichi_msm.runs.arrays import Pieces, write_arrays, write_flo
from taichi_msm.runs.checkpoint import CHECKPOINT, PATTERNS, Checkpoint
from taichi_msm.runs.directory import Contents, Listed, Publication, add, create
from taichi_msm.runs.encoder import Encoder
from taichi_msm.runs.media import Job, PictureWriter
from taichi_msm.scene import outputs
from taichi_msm.scene.outputs import CAMERA_FILE, OUTPUTS
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.state import Snapshot, TipForce

pass  # REMOVED


def _listed(record: Mapping[str, Any]) -> Listed:
    """Tell of a file whether it is one of the run with this record."""
    return partial(outputs.is_result, set(record["outputs"]), int(record["frames"]))


# The results of a run, and beside them the checkpoint from which it can go on.
RUN = Contents("run", outputs.RUN_RECORD, outputs.RESULT_PATTERNS, _listed, beside=(CHECKPOINT, PATTERNS))


class ResultWriter:
    """Writes the frames of a run as they come, and puts all files in place at the end.

    Within the with statement the files grow in a hidden folder. Leaving it without `publish` removes them. But once a
    run with a manifest has a frame, its checkpoint replaces any earlier one, and stays until results are published as
    complete. A run that `resumes` continues from its checkpoint. Files that no run has written stay. Pictures are
    encoded `beside` the simulation, in a process of their own, or else in this one, each before `add` returns.

    Raises:
        FilesError: on entering and in every method, when the directory cannot be written, another run writes there,
            or something is in the way that no run has put there.

    Attributes:
        saved: the state from which the run continues; None: from rest.
        frames: in the results; after an interruption their number is known only after `finish`.
        encode_seconds: processor time spent encoding pictures [s]; known after `finish`.
    """

    def __init__(
        self,
        directory: Path,
        scene: Scene,
        grid: TimeGrid,
        manifest: Mapping[str, Any] | None = None,
        *,
        resumes: bool = False,
        beside: bool = True,
    ) -> None:
        self.saved: Snapshot | None = None
        self.frames = 0
        self.encode_seconds = 0.0
        self._directory = directory
        self._scene = scene
        self._manifest = manifest
        self._resumes = resumes
        self._beside = beside
        names = outputs.file_names(outputs.result_names(scene.folders), scene.time.frames + 1)
        self._publication = Publication(directory, RUN, names)
        folder = self._publication.staging / CHECKPOINT
        self._checkpoint = Checkpoint(folder, scene, grid)
        staged = self._publication.staged
        self._labels = {name: LabelWriter(staged / name, scene, name) for name in scene.render.all_cameras}
        self._encoder: Encoder | PictureWriter | None = None
        self._open = ExitStack()
        self._finished = False

    @property
    def stored(self) -> int:
        """Number of frames whose positions are stored, including those from before the run was resumed."""
        return self._checkpoint.frames

    def position(self, frame: int) -> NDArray[Any]:
        """Read the positions of a stored frame [m], shape (rows, cols, 3)."""
        with writing(self._directory):
            return self._checkpoint.position(frame)

    def add(
        self,
        position: NDArray[Any],
        observed: Mapping[str, FrameOutputs],
        forces: Sequence[TipForce] = (),
        pause: Pause = lambda: None,
    ) -> None:
        """Add the next frame.

        Args:
            position: of the points [m], shape (rows, cols, 3).
            observed: what else is wanted, by the names of the cameras.
            forces: of the probes; of a frame that is stored already they are not needed.
            pause: as for `Encoder.add`.
        """
        with writing(self._directory):
            # Positions come first: whenever the run is interrupted, there are at least as many of them as pictures.
            if self.stored == 0:
                self._publication.keep = False
                self._checkpoint.begin(self._manifest or {})
            if self.frames == self.stored:
                self._checkpoint.add(position, forces)
                self._publication.keep = self._manifest is not None
            for name, labels in self._labels.items():
                labels.add(self.frames, observed[name], position)
            if self._encoder:
                pictures = [seen.picture for seen in observed.values() if seen.picture is not None]
                self._encoder.add(np.stack(pictures) if len(pictures) > 1 else pictures[0][None], pause)
            self.frames += 1

    @property
    def due(self) -> bool:
        """Whether it is time to save the state of the run."""
        return self.stored > 0 and self._checkpoint.due

    def save(self, saved: Snapshot) -> str:
        """Save the state of the run, in case it ends here; returns the file."""
        with writing(self._directory):
            return self._checkpoint.save(saved)

    def load(self) -> Snapshot | None:
        """Give the state that was saved last; None: none was."""
        with writing(self._directory):
            return self._checkpoint.load()

    def finish(self, pause: Pause = lambda: None, *, hurry: bool = False) -> None:
        """Wait until every frame is encoded, and write what belongs to them all; arguments as for `Encoder.finish`."""
        if self._finished:
            return
        with writing(self._directory):
            if self._encoder:
                self.frames, self.encode_seconds = self._encoder.finish(pause, hurry=hurry)
            for labels in self._labels.values():
                labels.finish(self.frames)
            if self.frames and "trajectory" in self._scene.output:
                self._write_trajectory()
            if self.frames and "forces" in self._scene.output:
                self._write_forces()
        self._finished = True

    def publish(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Write run.json: the record, "frames", their number, and "outputs", all results; replace earlier results.

        Gives the content of run.json.
        """
        self.finish()
        with writing(self._directory):
            results = outputs.result_names(self._scene.folders if self.frames else {})
            # By these names the next run into the directory recognises our files.
            facts = {**record, "frames": self.frames, "outputs": results}
            text = json.dumps(facts, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
            # A file name that is not UTF-8 has surrogates; escaped with a backslash they are valid JSON.
            add(self._publication.staged / outputs.RUN_RECORD, text.encode("utf-8", "backslashreplace"))
            self._publication.publish(outputs.file_names(results, self.frames))
            if record.get("status") == "complete":
                self._checkpoint.forget()
                self._publication.keep = False
        return facts

    def _write_trajectory(self) -> None:
        """Write the time [s] and the positions [m] of all frames, which may be larger than memory."""
        checkpoint, frames = self._checkpoint, self.frames
        shape = (frames, *self._scene.sheet.points, 3)
        arrays: dict[str, NDArray[Any] | Pieces] = {
            "time": np.arange(frames) / self._scene.time.frames_per_second,
            "position": Pieces(checkpoint.precision, shape, map(checkpoint.position, range(frames))),
        }
        with create(self._publication.staged / outputs.OUTPUTS["trajectory"].path()) as file:
            write_arrays(file, arrays)

    def _write_forces(self) -> None:
        """Write the forces of all frames, with numbers that can be read again without loss."""
        with (
            create(self._publication.staged / outputs.OUTPUTS["forces"].path()) as file,
            io.TextIOWrapper(file, encoding="ascii", newline="") as text,
        ):
            rows = csv.writer(text, lineterminator="\n")
            rows.writerow(outputs.FORCES_HEADER)
            for frame in range(self.frames):
                time = frame / self._scene.time.frames_per_second
                rows.writerows((time, one.probe, *one.tip, *one.force) for one in self._checkpoint.forces(frame))

    def __enter__(self) -> ResultWriter:
        scene = self._scene
        with writing(self._directory), ExitStack() as opened:
            opened.enter_context(self._publication)
            for name in scene.render.all_cameras if scene.renders else ():
                (self._publication.staged / name).mkdir(exist_ok=True)
            if scene.draws:
                job = Job(
                    folders=tuple(self._publication.staged / name for name in scene.render.all_cameras),
                    size=scene.render.size,
                    rate=scene.time.frames_per_second,
                    png="png" in scene.output,
                    gif="gif" in scene.output,
                    background=scene.render.background,
                    mp4="mp4" in scene.output,
                    quality=scene.render.quality,
                )
                locks = self._publication.lock_descriptors
                self._encoder = Encoder(job, locks) if self._beside else PictureWriter(job)
                opened.callback(self._encoder.abort)
            opened.callback(self._checkpoint.close)
            if self._resumes:
                self.saved = self._checkpoint.reopen()
            self.frames = 0 if scene.renders else self.stored
            self._open = opened.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()


# Masks consist of few large areas, for which the fastest compression is enough.
COMPRESS_LEVEL = 1


class LabelWriter:
    """Writes the labels of a camera that a scene's `output` asks for into a folder, frame by frame."""

    def __init__(self, folder: Path, scene: Scene, camera: str = "") -> None:
        self._folder, self._scene, self._camera = folder, scene, camera
        wanted = [output for name, output in OUTPUTS.items() if name in scene.folders[camera]]
        self._series = [output for output in wanted if output.source in ("labels", "flow", "stereo")]
        self._described = any(output.needs_camera for output in wanted)
        # Tracks are held until all are there, as their file has them point by point.
        shape = scene.render.tracks**2 if scene.asks_for("tracks") else 0, scene.time.frames + 1
        self._points, self._occluded = np.empty((*shape, 2), np.float32), np.empty(shape, np.bool_)
        self._position = np.empty((*shape, 3), np.float32)
        self._grid = track_grid(scene.render.tracks)
        self._added = 0

    def add(self, frame: int, observed: FrameOutputs, position: NDArray[Any]) -> None:
        """Write the labels of a frame, whose points are at `position` [m], and the flow from the frame before."""
        self._added = frame + 1
        for output in self._series:
            number = frame - 1 if output.is_frame_pair else frame
            if number >= 0:
                path = self._folder / output.path(number)
                path.parent.mkdir(exist_ok=True)
                with create(path) as file:
                    _WRITERS[path.suffix](file, getattr(getattr(observed, output.source), output.name))
        if observed.tracks is not None:
            self._points[:, frame], self._occluded[:, frame] = observed.tracks
            self._position[:, frame] = surface_positions(position, self._scene.render.refine, self._grid)

    def finish(self, frames: int) -> None:
        """Keep the files of the first frames only, this many, and write those that belong to all frames together."""
        if not frames:
            return
        for output in self._series:
            for number in range(output.count(frames), self._added):
                (self._folder / output.path(number)).unlink(missing_ok=True)
        if self._described:
            scene, name = self._scene, self._camera
            matrices = {"size": list(scene.render.size), **calibration(view_at(scene, 0.0, name))}
            if is_moving(scene, name):
                rate = scene.time.frames_per_second
                matrices["poses"] = [pose(view_at(scene, frame / rate, name)) for frame in range(frames)]
            add(self._folder / CAMERA_FILE, (json.dumps(matrices, indent=2) + "\n").encode())
        if self._scene.asks_for("tracks"):
            tracks = {"points": self._points, "occluded": self._occluded, "position": self._position}
            tracks = {name: values[:, :frames] for name, values in tracks.items()}
            with create(self._folder / OUTPUTS["tracks"].path()) as file:
                write_arrays(file, {"coordinates": self._grid, **tracks})


_WRITERS: dict[str, Callable[[BinaryIO, Any], None]] = {
    ".npy": np.save,
    ".tiff": lambda file, depth: Image.fromarray(depth).save(file, "TIFF"),
    ".flo": write_flo,
    ".png": lambda file, mask: Image.fromarray(mask).save(file, "PNG", compress_level=COMPRESS_LEVEL),
}


class ErrorRecord(TypedDict):
    """The error of a run, as fractions of the largest displacement; None: not known, because a pilot diverged."""

    error: float | None  # None at rest, too; largest of any point at any frame, due to the step and to rounding
    rounding: float | None  # the part of it that comes from f32; None also where a coarse pilot does not tell the parts
    in_f64: float | None  # the error of the same step in f64; None likewise
    order: int | None  # of the method; None at rest
    at_least: bool  # whether `error` may be larger
    mesh_error: NotRequired[float | None]  # the error that the number of points makes; only with tissue
    mesh_doubt: NotRequired[str]  # why `mesh_error` may be larger or is not known; empty: it is about that
    force_error: NotRequired[float | None]  # of tools on a path, as a fraction of the greatest force
    force_doubt: NotRequired[str]  # why `force_error` is not known


class RunRecord(TypedDict, total=False):
    """What was run, on which machine, how far it came, and its error."""

    status: Literal["complete", "diverged", "interrupted"]
    error: str  # where and why the run diverged; only if it did
    dump: str | None  # file with the last good state; only if the run diverged. None: there is no such file
    scene: dict[str, Any]  # as it was run, with the points, the step and the precision that were chosen
    asked: dict[str, Any]  # keys by their paths, with the values of the scene where others were chosen
    working_directory: str  # from which the paths of the scene's pictures start
    # Of the files of the picture and the maps, by the keys that name them, such as image and tissue.map.image; without
    # one that could not be read and was not drawn.
    sha256: dict[str, str]
    overrides: list[str]  # of the scene file
    points: list[int]  # rows and columns of mass points
    step: float | None  # [s]; None: at rest, as the next ones
    stable_step: float | None  # the largest stable step [s]; None: every step is stable
    steps_per_frame: int | None
    precision: str  # of the steps
    steps: int | None  # in the run so far
    residual: float  # at rest: the largest force left on a point at any frame, as a share of the largest force
    evaluations: int  # at rest: of the forces, in the run so far
    max_displacement: float  # [m]
    shortest_spring: float  # smallest ratio of a spring's length to its rest length
    longest_spring: float  # and the largest
    probes: list[ProbeRecord]  # forces of each
    notes: list[str]  # what to know before trusting the result
    error_estimate: ErrorRecord | None  # None: there is none, for the reason that follows
    error_estimate_reason: str
    resumed: int  # number of frames that an earlier run had simulated
    timings: dict[str, float]  # of every stage [s]
    arch: str
    device: str
    threads: int
    lanes: int
    workers: int
    versions: dict[str, str]  # of all that the results depend on
    frames: int
    outputs: list[str]  # names of the files written, and of the folders with a file for every frame
