"""Write the labels of the frames of a run to files."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.render.camera import calibration, view
from taichi_msm.render.labels import Labels, Observed, Sight, track_grid
from taichi_msm.results.flo import write_flo
from taichi_msm.results.folder import Folder
from taichi_msm.results.npz import write_array
from taichi_msm.results.publication import (
    CAMERA,
    COORDINATES,
    DEPTH,
    FLOW,
    INSTRUMENT,
    OCCLUSION,
    TRACKS,
    series_file,
    series_length,
)
from taichi_msm.scene import UNTIL_NEXT, Scene

# Masks consist of few large areas, for which the fastest compression is enough.
COMPRESS_LEVEL = 1


class LabelWriter:
    """Writes the labels of a run, frame by frame.

    Args:
        folder: where the files go.
        scene: what is run; its `output` says which labels are wanted.
    """

    def __init__(self, folder: Folder, scene: Scene) -> None:
        self._folder = folder
        self._scene = scene
        self._series = [name for name in _WRITERS if name in scene.output]
        wanted = "tracks" in scene.output
        self._tracks = Tracks(scene.render.tracks, scene.time.frames + 1) if wanted else None
        self._added = 0

    def add(self, frame: int, observed: Observed) -> None:
        """Write the labels of a frame, and the flow from the frame before."""
        self._added = frame + 1
        for name in self._series:
            number = frame - 1 if name in UNTIL_NEXT else frame
            if number >= 0:
                with (
                    self._folder.folder(name, create=True) as folder,
                    folder.create(series_file(name, number), buffering=0) as file,
                ):
                    _WRITERS[name](file, observed)
        if self._tracks is not None and observed.tracks is not None:
            self._tracks.add(frame, observed.tracks)

    def finish(self, frames: int) -> None:
        """Keep the files of the first frames only, this many, and write those that belong to all frames together."""
        for name in self._series if frames else ():
            with self._folder.folder(name, create=True) as folder:
                for number in range(series_length(name, frames), self._added):
                    folder.remove(series_file(name, number))
        if self._scene.output_camera and frames:
            found = {"size": list(self._scene.render.size), **calibration(view(self._scene))}
            with self._folder.create(CAMERA) as file:
                file.write((json.dumps(found, indent=2) + "\n").encode())
        if self._tracks is not None and frames:
            with self._folder.create(TRACKS) as file:
                self._tracks.write(file, frames)


class Tracks:
    """The tracks of a run, frame by frame; held until all are there, as a file has them point by point.

    Args:
        count: points along each side of their grid.
        frames: how many frames there may be.
    """

    def __init__(self, count: int, frames: int) -> None:
        self._coordinates = track_grid(count)
        self._points = np.empty((count * count, frames, 2), np.float32)
        self._occluded = np.empty((count * count, frames), np.bool_)

    def add(self, frame: int, sight: Sight) -> None:
        """Add where the points are in a frame."""
        self._points[:, frame] = sight.pixels
        self._occluded[:, frame] = sight.hidden

    def write(self, file: BinaryIO, frames: int) -> None:
        """Write the first so many frames as tracks.npz."""
        arrays = {
            "coordinates": self._coordinates,
            "points": self._points[:, :frames],
            "occluded": self._occluded[:, :frames],
        }
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, array in arrays.items():
                # Point by point, so that there is no second copy of all.
                write_array(archive, name, array.dtype, array.shape, (point.tobytes() for point in array))


def _write_coordinates(file: BinaryIO, observed: Observed) -> None:
    np.save(file, _labels(observed).coordinates)


def _write_depth(file: BinaryIO, observed: Observed) -> None:
    Image.fromarray(_labels(observed).depth).save(file, "TIFF")


def _write_instrument(file: BinaryIO, observed: Observed) -> None:
    _write_mask(file, _labels(observed).instrument)


def _write_flow(file: BinaryIO, observed: Observed) -> None:
    assert observed.flow is not None
    write_flo(file, observed.flow.flow)


def _write_occlusion(file: BinaryIO, observed: Observed) -> None:
    assert observed.flow is not None
    _write_mask(file, observed.flow.occlusion)


def _write_mask(file: BinaryIO, mask: NDArray[np.uint8]) -> None:
    Image.fromarray(mask).save(file, "PNG", compress_level=COMPRESS_LEVEL)


def _labels(observed: Observed) -> Labels:
    assert observed.labels is not None
    return observed.labels


_WRITERS: dict[str, Callable[[BinaryIO, Any], None]] = {
    COORDINATES: _write_coordinates,
    DEPTH: _write_depth,
    INSTRUMENT: _write_instrument,
    FLOW: _write_flow,
    OCCLUSION: _write_occlusion,
}
