"""Draw and label a run that has ended: any of its frames, from any camera, and the flow between any two frames."""

from __future__ import annotations

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


class Playback:
    """The frames of a run, by number. Usable in a with statement, which frees its memory.

    Args:
        directory: where its results are; the trajectory must be among them.
        arch: as for `Simulation`.
        threads: as for `Simulation`.

    Raises:
        ArgumentError: here and in all methods, when an argument is not what it must be.
        DeviceError: as for `Simulation`.
        FilesError: when there is no trajectory of a run, or it is damaged.

    Attributes:
        scene: the scene as it was run, with the points, the step and the precision that were chosen.
        time: of every frame [s], shape (frames,).
        positions: of the points in every frame [m], shape (frames, rows, cols, 3); not to be written to.

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
        run.require_pictures(drawn=False)
        self._require_picture = cache(partial(run.require_pictures, drawn=True))
        self._simulation = Simulation(run.scene, arch, threads)

    def draw(self, frame: int, camera: CameraLike = None) -> NDArray[np.uint8]:
        """Draw a frame; as `Simulation.draw`.

        Raises:
            FilesError: when the scene's picture is not the one that was run.
        """
        self._require_picture()
        return self._simulation.draw(camera, *self._at(frame))

    def labels(self, frame: int, camera: CameraLike = None) -> Labels:
        """Give what each pixel of a frame shows; as `Simulation.labels`."""
        return self._simulation.labels(camera, *self._at(frame))

    def flow(self, first: int, second: int, camera: CameraLike = None, camera_then: CameraLike = None) -> Flow:
        """Give the flow from one frame to another, before or after it, and which of its material is hidden there.

        `camera` sees the first and `camera_then` the second, which may be the same frame; None: the same camera.
        """
        then = camera if camera_then is None else camera_then
        return self._simulation.flow(self.labels(first, camera), then, *self._at(second))

    def locate(self, frame: int, coordinates: NDArray[np.floating], camera: CameraLike = None) -> Sight:
        """Find where material points are seen in a frame, and whether anything hides them; as `Simulation.locate`."""
        return self._simulation.locate(coordinates, camera, *self._at(frame))

    def close(self) -> None:
        """Free the memory."""
        self._simulation.close()

    def __enter__(self) -> Playback:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _at(self, frame: int) -> tuple[NDArray[np.floating], float]:
        """Give the positions and the time of a frame."""
        if isinstance(frame, bool) or not isinstance(frame, int | np.integer) or not 0 <= frame < len(self.time):
            raise ArgumentError(f"frame: {frame!r}; take a whole number, 0 to {len(self.time) - 1}")
        return self.positions[frame], float(self.time[frame])
