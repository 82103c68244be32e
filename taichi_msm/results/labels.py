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
        self._tracks: list[Sight] = []
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
        if observed.tracks is not None:
            self._tracks.append(observed.tracks)

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
        if "tracks" in self._scene.output and frames:
            with self._folder.create(TRACKS) as file:
                write_tracks(file, track_grid(self._scene.render.tracks), self._tracks[:frames])


def write_tracks(file: BinaryIO, coordinates: NDArray[np.float32], sights: list[Sight]) -> None:
    """Write tracks.npz.

    Args:
        file: open for writing.
        coordinates: of the points, shape (n, 2).
        sights: where they are in every frame.
    """
    points = np.stack([sight.pixels for sight in sights], axis=1)
    occluded = np.stack([sight.hidden for sight in sights], axis=1)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in (("coordinates", coordinates), ("points", points), ("occluded", occluded)):
            write_array(archive, name, array.dtype, array.shape, [np.ascontiguousarray(array).tobytes()])


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
