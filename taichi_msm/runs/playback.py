"""Rendering of a finished run: pictures, labels and optical flow of any frame from any camera."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError
from taichi_msm.render.labels import Flow, Labels, Sight
from taichi_msm.render.renderer import CameraLike
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene


class Playback(AbstractContextManager["Playback"]):
    """Frames of a finished run. As a context manager, it frees its memory at exit.

    Args:
        directory: folder of the results, which must include the trajectory.
        arch: as for `Simulation`.
        threads: as for `Simulation`.

    Raises:
        ArgumentError: here and in all methods, when an argument is invalid.
        DeviceError: as for `Simulation`.
        FilesError: when the trajectory is missing or damaged.

    Attributes:
        scene: the scene as simulated, with resolved mesh, step and precision.
        time: times of the frames [s], shape (frames,).
        positions: positions of the mass points [m], shape (frames, rows, cols, 3); read-only.

    Example:
        >>> from taichi_msm import Playback
        >>> with Playback("output/press") as run:
        ...     picture = run.draw(9, camera="top")
        ...     flow, occlusion = run.flow(9, 15)
        >>> picture.shape, flow.shape
        ((512, 512, 3), (512, 512, 2))
    """

    scene: Scene
    time: NDArray[np.float64]
    positions: NDArray[np.floating]

    def __init__(self, directory: str | Path, arch: str = "cpu", threads: int | None = None) -> None:
        run = read_run(directory)
        with run.unchanged():
            self.scene, self.time, self.positions = run.scene, run.time, run.positions()
        run.require_same_pictures(drawn=False)
        self._require_picture = cache(partial(run.require_same_pictures, drawn=True))
        self._simulation = Simulation(run.scene, arch, threads)

    def draw(self, frame: int, camera: CameraLike = None) -> NDArray[np.uint8]:
        """Draw a frame.

        Args:
            frame: index, from 0.
            camera: as for `Simulation.draw`.

        Returns:
            Colours, shape (height, width, 3).

        Raises:
            FilesError: when the scene's picture has changed since the run.
        """
        self._require_picture()
        return self._simulation.draw(camera, *self._frame_state(frame))

    def labels(self, frame: int, camera: CameraLike = None) -> Labels:
        """Compute the ground-truth labels of a frame.

        Args:
            frame: index, from 0.
            camera: as for `Simulation.draw`.

        Returns:
            As for `Simulation.labels`.
        """
        return self._simulation.labels(camera, *self._frame_state(frame))

    def flow(self, first: int, second: int, camera: CameraLike = None, camera_then: CameraLike = None) -> Flow:
        """Compute the optical flow from one frame to another, and the occlusion of the first one's pixels in the other.

        Args:
            first: index of the frame that the flow starts from.
            second: index of the frame that the flow leads to, before or after `first` or the same.
            camera: camera of the first frame, as for `Simulation.draw`.
            camera_then: camera of the second frame; None for the same camera.

        Returns:
            As for `Simulation.flow`.
        """
        then = camera if camera_then is None else camera_then
        return self._simulation.flow(self.labels(first, camera), then, *self._frame_state(second))

    def locate(self, frame: int, coordinates: NDArray[np.floating], camera: CameraLike = None) -> Sight:
        """Project material points into the picture of a frame, and determine their occlusion.

        Args:
            frame: index, from 0.
            coordinates: as for `Simulation.locate`, shape (n, 2).
            camera: as for `Simulation.draw`.

        Returns:
            As for `Simulation.locate`.
        """
        return self._simulation.locate(coordinates, camera, *self._frame_state(frame))

    def close(self) -> None:
        """Free the memory."""
        self._simulation.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _frame_state(self, frame: int) -> tuple[NDArray[np.floating], float]:
        if isinstance(frame, bool) or not isinstance(frame, int | np.integer) or not 0 <= frame < len(self.time):
            raise ArgumentError(f"frame: {frame!r}; take a whole number, 0 to {len(self.time) - 1}")
        return self.positions[frame], float(self.time[frame])
