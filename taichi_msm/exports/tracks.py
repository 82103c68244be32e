"""The tracked points of a run, read without trusting the file."""

from __future__ import annotations

import zipfile

import numpy as np
from numpy.typing import NDArray

from taichi_msm.outputs.npz import read_rows
from taichi_msm.results.finished_run import FinishedRun, damaged, reading


def read_tracks(run: FinishedRun) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Read where each point is [px], shape (tracks, frames, 2), and whether it is hidden, shape (tracks, frames).

    A point behind the eye has no place in the picture's plane: it is hidden and NaN.
    """
    path = run.result("tracks")
    with reading(path), zipfile.ZipFile(path) as archive:
        points = read_rows(archive, "points", np.float32, (run.frames, 2))
        occluded = read_rows(archive, "occluded", np.bool_, (run.frames,))
    somewhere = np.isfinite(points).all(axis=-1)
    if points.shape[:2] != occluded.shape or not (somewhere | occluded).all():
        raise damaged(path)
    return np.where(somewhere[..., None], points, np.float32(np.nan)), occluded


def read_places(run: FinishedRun) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read the points' coordinates on the sheet, shape (tracks, 2), and where they are [m], (tracks, frames, 3)."""
    path = run.result("tracks")
    with reading(path), zipfile.ZipFile(path) as archive:
        coordinates = read_rows(archive, "coordinates", np.float32, (2,))
        position = read_rows(archive, "position", np.float32, (run.frames, 3))
        tracks, _ = read_rows(archive, "occluded", np.bool_, (run.frames,)).shape
    if not len(coordinates) == len(position) == tracks or not np.isfinite(position).all():
        raise damaged(path)
    return coordinates, position
