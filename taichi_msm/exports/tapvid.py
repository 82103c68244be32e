"""Tracks of points in the format of TAP-Vid.

One pickle like that of TAP-Vid-DAVIS: a dictionary from the name of each video, one a run, to a dictionary of

    video      frames, uint8, shape (frames, height, width, 3)
    points     where each point is, float32, shape (tracks, frames, 2): x / width and y / height, 0 at the left and the
               upper edge of the picture, so that the centre of the first pixel is at (0.5 / width, 0.5 / height)
    occluded   whether it is hidden or outside the picture, bool, shape (tracks, frames);
               behind the eye it is at (0, 0)

Its readers multiply `points` by width and height to get pixels, with the origin at the picture's upper left corner.

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

from taichi_msm.errors import Count, FilesError
from taichi_msm.exports.formats import ExportSource
from taichi_msm.exports.inputs import read_tracks
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.system.process import available_memory

# The pickle protocol that every Python from 3.4 on reads.
PROTOCOL = 4


class _Pickler(pickle.Pickler):
    """Pickles arrays so that every NumPy reads them: NumPy 2 would name a module that 1.26.0 and earlier lack."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return np.ndarray, ((0,),), value.__reduce__()[2]
        return NotImplemented


def write(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
    """Write the tracks of runs and their frames; raises a FilesError when the videos do not fit into memory."""
    _require_memory([source.run for source in sources])
    videos = {}
    for run, name, progress in sources:
        videos[name or run.directory.resolve().name] = _video(run, progress)
        yield []
    with create_file(folder / "tapvid.pkl") as file:
        _Pickler(file, PROTOCOL).dump(videos)


def _require_memory(runs: Sequence[FinishedRun]) -> None:
    # Readers hold all videos in memory; writing them takes twice that.
    need, free = 2 * 3 * sum(run.frames * math.prod(run.scene.render.size) for run in runs), available_memory()
    if need > free:
        whose, remedy = f"the videos of {len(runs)} runs take", "export fewer runs at a time"
        if len(runs) == 1:
            whose = f"{runs[0].directory}: its video takes"
            remedy = "run the scene with a smaller render.size or fewer frames"
        raise FilesError(f"{whose} {need / 2**30:.1f} GiB of memory, and {free / 2**30:.1f} are free; {remedy}")


def _video(run: FinishedRun, progress: Count) -> dict[str, NDArray[Any]]:
    """Read the frames and tracks of a run."""
    width, height = run.scene.render.size
    points, occluded = read_tracks(run)
    points = np.nan_to_num(points)
    video = np.empty((run.frames, height, width, 3), np.uint8)
    for frame in range(run.frames):
        progress(frame, run.frames)
        video[frame] = run.read_picture("png", frame)
    return {"video": video, "points": (points / (width, height)).astype(np.float32), "occluded": occluded}
