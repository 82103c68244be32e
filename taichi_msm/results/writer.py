"""The results of a run: frames, animation, trajectory and record, whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from numpy.typing import NDArray

from taichi_msm.errors import writing
from taichi_msm.physics.run_progress import Saved
from taichi_msm.progress import Pause
from taichi_msm.render.labels import Observed
from taichi_msm.results.checkpoint import Checkpoint
from taichi_msm.results.encoder import Encoder, Job
from taichi_msm.results.labels import LabelWriter
from taichi_msm.results.publication import (
    ANIMATION,
    CAMERA,
    FRAMES,
    RECORD,
    SERIES,
    TRACKS,
    TRAJECTORY,
    Publication,
    result_names,
)
from taichi_msm.results.trajectory import write_trajectory
from taichi_msm.scene import Scene


class ResultWriter:
    """Writes the frames of a run as they come, and puts all in place at the end.

    Within the with statement the files grow out of sight. Left without `publish` they are removed; but once a run with
    a manifest has a frame, its checkpoint takes the place of any earlier one, and stays until results are published as
    complete.

    Args:
        directory: where the results go; made where it does not exist. Files there that no run writes stay.
        scene: what is run; its `output` says which files are wanted.
        manifest: what another process must know to go on with this run, in JSON.
        resumes: whether this run is to go on from its checkpoint in the directory.

    Raises:
        FilesError: on entering and in every method, when the directory cannot be written, another run writes there,
            or something is in the way that no run has put there.

    Attributes:
        saved: where the run is to go on; None: at rest.
    """

    def __init__(
        self, directory: Path, scene: Scene, manifest: Mapping[str, Any] | None = None, *, resumes: bool = False
    ) -> None:
        self.saved: Saved | None = None
        self._directory = directory
        self._scene = scene
        self._plan = manifest
        self._resumes = resumes
        self._publication = Publication(directory, self._names(scene.time.frames + 1))
        self._checkpoint: Checkpoint
        self._labels: LabelWriter
        self._encoder: Encoder | None = None
        self._open = ExitStack()
        self._frames = 0
        self._finished = False
        self._encode_seconds = 0.0

    @property
    def frames(self) -> int:
        """Number of frames that are in the results. After an interruption only `finish` knows."""
        return self._frames

    @property
    def encode_seconds(self) -> float:
        """Processor time spent encoding pictures, beside the simulation [s]; known after `finish`."""
        return self._encode_seconds

    @property
    def stored(self) -> int:
        """Number of frames whose positions are there; those of a run that is resumed are from the start."""
        return self._checkpoint.frames

    def position(self, frame: int) -> NDArray[Any]:
        """Read the positions of a frame that is stored [m], shape (rows, cols, 3)."""
        with writing(self._directory):
            return self._checkpoint.position(frame)

    def add(self, position: NDArray[Any], observed: Observed, pause: Pause = lambda: None) -> None:
        """Add the next frame.

        Args:
            position: positions [m], shape (rows, cols, 3).
            observed: what is seen of it, as far as it is wanted.
            pause: called some times a second while the encoder takes no more; what it raises gives the picture up.
        """
        with writing(self._directory):
            # In this order, whatever is interrupted, there are at least as many positions as pictures.
            if self.stored == 0:
                self._publication.keep = False
                self._checkpoint.begin(self._plan or {})
            if self._frames == self.stored:
                self._checkpoint.add(position)
                self._publication.keep = self._plan is not None
            self._labels.add(self._frames, observed)
            if self._encoder and observed.picture is not None:
                self._encoder.add(observed.picture, pause)
            self._frames += 1

    @property
    def due(self) -> bool:
        """Whether it is time to save where the run is."""
        return self.stored > 0 and self._checkpoint.due

    def save(self, saved: Saved) -> str:
        """Keep where the run is, in case it ends here; gives the file that has it."""
        with writing(self._directory):
            return self._checkpoint.save(saved)

    def load(self) -> Saved | None:
        """Give what was saved last; None: nothing was."""
        with writing(self._directory):
            return self._checkpoint.load()

    def finish(self, pause: Pause = lambda: None, *, hurry: bool = False) -> None:
        """Wait until every frame is encoded and close the files.

        Args:
            pause: called some times a second while it waits; what it raises stops the waiting, and this can be called
                again.
            hurry: give up frames that are not being encoded yet.
        """
        if self._finished:
            return
        with writing(self._directory):
            if self._encoder:
                report = self._encoder.finish(pause, hurry=hurry)
                self._frames, self._encode_seconds = report.frames, report.seconds
            self._labels.finish(self._frames)
            if TRAJECTORY in self._outputs(self._frames):
                scene = self._scene
                with self._publication.staged.create(TRAJECTORY) as file:
                    write_trajectory(
                        file,
                        self._checkpoint.positions(self._frames),
                        self._frames,
                        scene.sheet.points,
                        self._checkpoint.precision,
                        scene.time.frames_per_second,
                    )
        self._finished = True

    def publish(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Write run.json and put the results in the place of earlier ones.

        Args:
            record: what run.json holds, besides the number of "frames" and the names of "outputs", itself the last.

        Returns:
            What it holds.
        """
        self.finish()
        with writing(self._directory):
            # The next run into the directory knows our files by these.
            facts = {**record, "frames": self._frames, "outputs": self._outputs(self._frames)}
            text = json.dumps(facts, indent=2, ensure_ascii=False, allow_nan=False)
            with self._publication.staged.create(RECORD) as file:
                # A file name that is not UTF-8 has surrogates, whose backslash form is their JSON form.
                file.write((text + "\n").encode("utf-8", "backslashreplace"))
            self._publication.publish(self._names(self._frames))
            self._publication.keep &= record.get("status") != "complete"
        return facts

    def _outputs(self, frames: int) -> list[str]:
        """List what results of so many frames consist of, the record last."""
        kinds = {"png": FRAMES, "gif": ANIMATION, "trajectory": TRAJECTORY, "tracks": TRACKS}
        wanted = [kinds.get(kind, kind) for kind in self._scene.output] if frames else []
        if frames and self._scene.output_camera:
            wanted.append(CAMERA)
        order = (*SERIES, ANIMATION, TRAJECTORY, TRACKS, CAMERA)
        return [*(name for name in order if name in wanted), RECORD]

    def _names(self, frames: int) -> list[str]:
        """List the files of results of so many frames."""
        return result_names(self._outputs(frames), frames)

    def __enter__(self) -> ResultWriter:
        scene = self._scene
        with writing(self._directory), ExitStack() as opened:
            opened.enter_context(self._publication)
            self._checkpoint = Checkpoint(self._publication.staging, scene)
            self._labels = LabelWriter(self._publication.staged, scene)
            if scene.draws:
                job = Job(
                    folder=self._publication.staged,
                    size=scene.render.size,
                    rate=scene.time.frames_per_second,
                    png="png" in scene.output,
                    gif="gif" in scene.output,
                    background=scene.render.background,
                )
                self._encoder = Encoder(job, inherit=self._publication.lock_descriptors)
                opened.callback(self._encoder.abort)
            opened.callback(self._checkpoint.close)
            if self._resumes:
                self.saved = self._checkpoint.go_on()
            self._frames = 0 if scene.renders else self.stored
            self._open = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
