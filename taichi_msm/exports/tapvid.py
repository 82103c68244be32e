"""TAP-Vid export: 2D tracks.

A single pickle like that of TAP-Vid-DAVIS: a dictionary of videos by name, one per run, each a dictionary of

    video      frames, uint8, shape (frames, height, width, 3)
    points     positions, float32, shape (tracks, frames, 2): x / width and y / height, 0 at the left and the upper
               edge of the picture, so that the centre of the first pixel is at (0.5 / width, 0.5 / height); (0, 0)
               behind the camera
    occluded   whether the track is occluded or outside the picture, bool, shape (tracks, frames)

Loaders multiply `points` by width and height to obtain pixels, with the origin at the picture's upper left corner.

Source: google-deepmind/tapnet, tapnet/tapvid/README.md, evaluation_datasets.py (create_davis_dataset) and visualize.py.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import FilesError, ProgressCallback
from taichi_msm.exports.formats import ExportSource
from taichi_msm.exports.inputs import read_tracks
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.system.process import available_memory


class _Pickler(pickle.Pickler):
    """Pickler for arrays that NumPy 1 can read; by default NumPy 2 refers to a module that 1.26.0 lacks."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return np.ndarray, ((0,),), value.__reduce__()[2]
        return NotImplemented


def write(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
    """Write the tracks and frames of runs."""
    _require_memory([source.run for source in sources])
    videos = {}
    for run, name, progress in sources:
        videos[name or run.directory.resolve().name] = _video(run, progress)
        yield []
    with create_file(folder / "tapvid.pkl") as file:
        _Pickler(file, protocol=4).dump(videos)  # readable by Python 3.4 and later


def _require_memory(runs: Sequence[FinishedRun]) -> None:
    # Writing takes twice the memory of all videos.
    need, free = 2 * 3 * sum(run.frames * math.prod(run.scene.render.size) for run in runs), available_memory()
    if need > free:
        subject, remedy = f"the videos of {len(runs)} runs take", "export fewer runs at a time"
        if len(runs) == 1:
            subject = f"{runs[0].directory}: its video takes"
            remedy = "run the scene with a smaller render.size or fewer frames"
        raise FilesError(f"{subject} {need / 2**30:.1f} GiB of memory, and {free / 2**30:.1f} are free; {remedy}")


def _video(run: FinishedRun, progress: ProgressCallback) -> dict[str, NDArray[Any]]:
    width, height = run.scene.render.size
    points, occluded = read_tracks(run)
    points = np.nan_to_num(points)
    video = np.empty((run.frames, height, width, 3), np.uint8)
    for frame in range(run.frames):
        progress(frame, run.frames)
        video[frame] = run.read_picture("png", frame)
    return {"video": video, "points": (points / (width, height)).astype(np.float32), "occluded": occluded}
