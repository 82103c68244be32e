"""Write the results of a run: frames, animations, trajectory, forces and record, whole or not at all."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import writing
from taichi_msm.outputs import table
from taichi_msm.outputs.npz import Pieces, write_arrays
from taichi_msm.physics.state import Saved, TipForce
from taichi_msm.progress import Pause
from taichi_msm.render.labels import Observed
from taichi_msm.results.checkpoint import CHECKPOINT, PATTERNS, Checkpoint
from taichi_msm.results.encoder import Encoder
from taichi_msm.results.labels import LabelWriter
from taichi_msm.results.pictures import Job, PictureWriter
from taichi_msm.results.publication import Contents, Listed, Publication
from taichi_msm.results.whole import add, create
from taichi_msm.scene import Scene
from taichi_msm.timegrid import TimeGrid


def _listed(record: Mapping[str, Any]) -> Listed:
    """Tell of a file whether it is one of the run with this record."""
    return partial(table.listed, set(record["outputs"]), int(record["frames"]))


# The results of a run, and beside them the checkpoint from which it can go on.
RUN = Contents("run", table.RECORD, table.PATTERNS, _listed, beside=(CHECKPOINT, PATTERNS))


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
        self.saved: Saved | None = None
        self.frames = 0
        self.encode_seconds = 0.0
        self._directory = directory
        self._scene = scene
        self._manifest = manifest
        self._resumes = resumes
        self._beside = beside
        names = table.file_names(table.results(scene.folders), scene.time.frames + 1)
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
        observed: Mapping[str, Observed],
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

    def save(self, saved: Saved) -> str:
        """Save the state of the run, in case it ends here; returns the file."""
        with writing(self._directory):
            return self._checkpoint.save(saved)

    def load(self) -> Saved | None:
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
            results = table.results(self._scene.folders if self.frames else {})
            # By these names the next run into the directory recognises our files.
            facts = {**record, "frames": self.frames, "outputs": results}
            text = json.dumps(facts, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
            # A file name that is not UTF-8 has surrogates; escaped with a backslash they are valid JSON.
            add(self._publication.staged / table.RECORD, text.encode("utf-8", "backslashreplace"))
            self._publication.publish(table.file_names(results, self.frames))
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
        with create(self._publication.staged / table.OUTPUTS["trajectory"].path()) as file:
            write_arrays(file, arrays)

    def _write_forces(self) -> None:
        """Write the forces of all frames, with numbers that can be read again without loss."""
        with (
            create(self._publication.staged / table.OUTPUTS["forces"].path()) as file,
            io.TextIOWrapper(file, encoding="ascii", newline="") as text,
        ):
            rows = csv.writer(text, lineterminator="\n")
            rows.writerow(table.FORCES_HEADER)
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
