"""Write the labels of the frames of a run to files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.outputs.flo import write_flo
from taichi_msm.outputs.npz import write_arrays
from taichi_msm.outputs.table import CAMERA, OUTPUTS
from taichi_msm.physics.deformed import on_surface
from taichi_msm.render.camera import calibration, moves, pose, view_at
from taichi_msm.render.labels import Observed, track_grid
from taichi_msm.results.whole import add, create
from taichi_msm.scene import Scene

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

    def add(self, frame: int, observed: Observed, position: NDArray[Any]) -> None:
        """Write the labels of a frame, whose points are at `position` [m], and the flow from the frame before."""
        self._added = frame + 1
        for output in self._series:
            number = frame - 1 if output.until_next else frame
            if number >= 0:
                path = self._folder / output.path(number)
                path.parent.mkdir(exist_ok=True)
                with create(path) as file:
                    _WRITERS[path.suffix](file, getattr(getattr(observed, output.source), output.name))
        if observed.tracks is not None:
            self._points[:, frame], self._occluded[:, frame] = observed.tracks
            self._position[:, frame] = on_surface(position, self._scene.render.refine, self._grid)

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
            if moves(scene, name):
                rate = scene.time.frames_per_second
                matrices["poses"] = [pose(view_at(scene, frame / rate, name)) for frame in range(frames)]
            add(self._folder / CAMERA, (json.dumps(matrices, indent=2) + "\n").encode())
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
