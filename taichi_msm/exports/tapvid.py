"""Tracks of points in the format of TAP-Vid.

One pickle like that of TAP-Vid-DAVIS: a dictionary from the video's name to a dictionary of

    video      frames, uint8, shape (frames, height, width, 3)
    points     where each point is, float32, shape (tracks, frames, 2): x / width and y / height, 0 at the left and the
               upper edge of the picture, so that the centre of the first pixel is at (0.5 / width, 0.5 / height)
    occluded   whether it is hidden or outside the picture, bool, shape (tracks, frames)

Its readers multiply `points` by width and height to get pixels, with the origin at the picture's upper left corner.

Source: google-deepmind/tapnet, tapnet/tapvid/README.md, evaluation_datasets.py (create_davis_dataset) and visualize.py.
"""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import FilesError
from taichi_msm.outputs.npz import read_rows
from taichi_msm.progress import Count
from taichi_msm.results.finished_run import FinishedRun, damaged, reading
from taichi_msm.results.whole import create
from taichi_msm.system.resources import available_memory

# The pickle protocol that every Python from 3.4 on reads.
PROTOCOL = 4


class _Pickler(pickle.Pickler):
    """Pickles arrays so that every NumPy reads them: NumPy 2 would name a module that 1.26.0 and earlier lack."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return np.ndarray, ((0,),), value.__reduce__()[2]
        return NotImplemented


def write(run: FinishedRun, folder: Path, progress: Count) -> list[str]:
    """Write the tracks of a run and its frames; raises a FilesError when the video does not fit into memory."""
    width, height = run.scene.render.size
    points, occluded = read_tracks(run)
    # Readers hold the whole video in memory; writing it takes twice that.
    need, free = 2 * 3 * run.frames * height * width, available_memory()
    if need > free:
        raise FilesError(
            f"{run.directory}: its video takes {need / 2**30:.1f} GiB of memory, and {free / 2**30:.1f} are free; "
            f"run the scene with a smaller render.size or fewer frames"
        )
    video = np.empty((run.frames, height, width, 3), np.uint8)
    for frame in range(run.frames):
        progress(frame, run.frames)
        video[frame] = run.picture("png", frame)
    scaled = (points / (width, height)).astype(np.float32)
    with create(folder / "tapvid.pkl") as file:
        name = run.directory.resolve().name
        _Pickler(file, PROTOCOL).dump({name: {"video": video, "points": scaled, "occluded": occluded}})
    return []


def read_tracks(run: FinishedRun) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Read where each point is [px], shape (tracks, frames, 2), and whether it is hidden, shape (tracks, frames).

    A point behind the eye has no place in the picture's plane; it is hidden and at (0, 0).
    """
    path = run.result("tracks")
    with reading(path), zipfile.ZipFile(path) as archive:
        points = read_rows(archive, "points", np.float32, (run.frames, 2))
        occluded = read_rows(archive, "occluded", np.bool_, (run.frames,))
    somewhere = np.isfinite(points).all(axis=-1)
    if points.shape[:2] != occluded.shape or not (somewhere | occluded).all():
        raise damaged(path)
    return np.where(somewhere[..., None], points, np.float32(0)), occluded
