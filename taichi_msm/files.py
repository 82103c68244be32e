"""The results of a run: frames, animation, trajectory and record, whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.encoding import Encoder, Job
from taichi_msm.errors import writing
from taichi_msm.gif import Picture
from taichi_msm.publication import ANIMATION, FRAMES, RECORD, TRAJECTORY, Publication
from taichi_msm.scene import Scene
from taichi_msm.trajectory import TrajectoryWriter


class ResultWriter:
    """Writes the frames of a run as they come, and puts all in place at the end.

    Within the with statement the files grow out of sight; leaving it without `publish` discards them.

    Args:
        directory: where the results go; made where it does not exist. Files there that no run writes stay.
        scene: what is run; its `output` says which files are wanted.

    Raises:
        FilesError: on entering and in every method, when the directory cannot be written, or another run
            writes there.
    """

    def __init__(self, directory: Path, scene: Scene) -> None:
        self._directory = directory
        self._scene = scene
        self._publication = Publication(directory)
        self._encoder: Encoder | None = None
        self._trajectory: TrajectoryWriter | None = None
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

    def add(self, position: NDArray[Any], picture: Picture | None) -> None:
        """Add the next frame.

        Args:
            position: positions [m], shape (rows, cols, 3).
            picture: colours, shape (height, width, 3); None where none is wanted.
        """
        with writing(self._directory):
            # In this order, whatever is interrupted, there are at least as many positions as pictures.
            if self._trajectory:
                self._trajectory.add(position)
            if self._encoder and picture is not None:
                self._encoder.add(picture)
            self._frames += 1

    def finish(self) -> None:
        """Wait until every frame is encoded and close the files."""
        if self._finished:
            return
        with writing(self._directory):
            if self._encoder:
                report = self._encoder.finish()
                self._frames, self._encode_seconds = report.frames, report.seconds
            if self._trajectory:
                self._trajectory.finish(self._frames)
        self._finished = True

    def publish(self, record: Mapping[str, Any]) -> list[str]:
        """Write run.json and put the results in the place of earlier ones.

        Args:
            record: what run.json holds, besides the "outputs" that are returned.

        Returns:
            The names of what was written, run.json the last.
        """
        self.finish()
        with writing(self._directory):
            staged = self._publication.staged
            outputs = [name for name in (FRAMES, ANIMATION, TRAJECTORY) if (staged / name).exists()]
            outputs.append(RECORD)
            text = json.dumps({**record, "outputs": outputs}, indent=2, ensure_ascii=False, allow_nan=False)
            # A file name that is not UTF-8 has surrogates, whose backslash form is their JSON form.
            (staged / RECORD).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
            self._publication.publish()
        return outputs

    def __enter__(self) -> ResultWriter:
        scene = self._scene
        with writing(self._directory), ExitStack() as opened:
            opened.enter_context(self._publication)
            if scene.draws:
                job = Job(
                    directory=self._publication.staged,
                    size=scene.render.size,
                    rate=scene.time.frames_per_second,
                    png="png" in scene.output,
                    gif="gif" in scene.output,
                    background=scene.render.background,
                )
                self._encoder = Encoder(job, inherit=self._publication.lock_descriptors)
                opened.callback(self._encoder.abort)
            if "trajectory" in scene.output:
                self._trajectory = TrajectoryWriter(
                    self._publication.staged / TRAJECTORY,
                    scene.sheet.points,
                    np.float32 if scene.time.precision == "f32" else np.float64,
                    scene.time.frames_per_second,
                )
                opened.callback(self._trajectory.close)
            self._open = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
