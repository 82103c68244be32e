"""A scene in motion: the two kernels behind a handful of methods."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm import runtime
from taichi_msm.camera import View
from taichi_msm.dynamics import Dynamics
from taichi_msm.errors import DivergedError
from taichi_msm.lattice import rest_positions
from taichi_msm.scene import Scene
from taichi_msm.stability import stable_step, step, steps_per_frame
from taichi_msm.texture import load_texture

if TYPE_CHECKING:
    from taichi_msm.drawing import Drawing

# Farther from rest than this many sheet sizes is no deformation any more.
MOST_SHEET_SIZES = 10.0


class Simulation:
    """A sheet that moves by frames and can be drawn. Usable in a with statement, which frees its memory.

    Args:
        scene: what `load_scene` returned.
        arch: cpu or cuda.
        threads: number of CPU threads; None takes every core.
        texture: the picture on the sheet, shape (height, width, 3); None: the scene's own, read when it is drawn.

    Raises:
        DeviceError: when the arch is not there, or Taichi already runs on another one in this process.

    Attributes:
        frame: number of frames simulated so far.
        max_displacement: largest displacement of any frame so far [m].
    """

    def __init__(
        self,
        scene: Scene,
        arch: str = "cpu",
        threads: int | None = None,
        texture: NDArray[np.uint8] | None = None,
    ) -> None:
        self.scene = scene
        self.device = runtime.start(arch, threads)
        self.frame = 0
        self.max_displacement = 0.0
        self._rest = rest_positions(scene.sheet)
        self._dynamics = Dynamics(scene, self.device)
        self._texture = texture
        self._drawing: Drawing | None = None

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.frame / self.scene.time.frames_per_second

    @property
    def steps(self) -> int:
        """Number of steps taken so far."""
        return self._dynamics.steps_done

    def advance(self, frames: int = 1) -> None:
        """Simulate a number of frames; the scene's loads go on as its keys say.

        Raises:
            DivergedError: when a point is no longer finite or has left every bound. `positions` is then worthless.
        """
        for _ in range(frames):
            self._dynamics.advance(steps_per_frame(self.scene))
            self.frame += 1
            self._watch()

    def positions(self) -> NDArray[Any]:
        """Read where the points are.

        Returns:
            Positions [m], shape (rows, cols, 3), in the scene's precision.
        """
        displacement = self._dynamics.displacement()
        return (self._rest + displacement).astype(displacement.dtype)

    def draw(self, camera: View | None = None) -> NDArray[np.uint8]:
        """Draw the sheet as it is now.

        Args:
            camera: another view than the scene's.

        Returns:
            Colours, shape (height, width, 3).

        Raises:
            SceneError: when the scene's picture cannot be read.
        """
        return self._drawn().draw(self.positions(), camera)

    def compile(self) -> None:
        """Compile now what would be compiled by the first frame."""
        self._dynamics.compile()
        if self.scene.draws:
            self.draw()

    def close(self) -> None:
        """Free the memory of the fields."""
        self._dynamics.close()
        if self._drawing is not None:
            self._drawing.close()

    def __enter__(self) -> Simulation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _drawn(self) -> Drawing:
        if self._drawing is None:
            from taichi_msm.drawing import Drawing

            texture = load_texture(self.scene) if self._texture is None else self._texture
            self._drawing = Drawing(self.scene, texture)
        return self._drawing

    def _watch(self) -> None:
        """Stop a simulation that has gone wrong."""
        displacement = self._dynamics.displacement()
        distance = np.sqrt(np.square(displacement, dtype=np.float64).sum(axis=-1))
        bound = MOST_SHEET_SIZES * max(self.scene.sheet.size)
        worst = int(np.argmax(np.where(np.isfinite(distance), distance, np.inf)))
        i, j = np.unravel_index(worst, distance.shape)
        largest = float(distance[i, j])
        if not largest <= bound:
            raise DivergedError(
                f"diverged before {self.time:g} s, step {self._dynamics.steps_done}: point ({i}, {j}) is {largest:g} m "
                f"from its rest position, the sheet {max(self.scene.sheet.size):g} m long; the step is "
                f"{step(self.scene):g} s of at most {stable_step(self.scene):g} s; "
                "try a weaker probes.N.force or a smaller time.step"
            )
        self.max_displacement = max(self.max_displacement, largest)
