"""A scene in motion: the two kernels behind a handful of methods."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm import runtime
from taichi_msm.accuracy import choose_step
from taichi_msm.camera import View
from taichi_msm.dynamics import Dynamics
from taichi_msm.errors import DivergedError, MsmError
from taichi_msm.lattice import axes
from taichi_msm.loads import farthest_displacement
from taichi_msm.scene import Scene
from taichi_msm.stability import stable_step, step, steps_per_frame
from taichi_msm.texture import load_texture

if TYPE_CHECKING:
    from taichi_msm.drawing import Drawing


class Simulation:
    """A sheet that moves by frames and can be drawn. Usable in a with statement, which frees its memory.

    Args:
        scene: what `load_scene` returned; where it has a tolerance, pilot runs choose the step first.
        arch: cpu or cuda.
        threads: number of CPU threads; None takes every core.
        texture: the picture on the sheet, shape (height, width, 3); None: the scene's own, read when it is drawn.
        cores: how many cores are free for stepping; None: all. Its threads wait for each other by spinning, and one
            that has no core holds all of them up.

    Raises:
        DeviceError: when the arch is not there, or Taichi already runs on another one in this process.
        SceneError: when no step meets the scene's tolerance.

    Attributes:
        scene: the scene, with the step that was chosen.
        frame: number of frames simulated so far.
        max_displacement: largest displacement of any frame so far [m].
        shortest_spring: smallest length of a spring over its rest length at any frame so far.
    """

    def __init__(
        self,
        scene: Scene,
        arch: str = "cpu",
        threads: int | None = None,
        texture: NDArray[np.uint8] | None = None,
        cores: int | None = None,
    ) -> None:
        self.device = runtime.start(arch, threads)
        if scene.time.tolerance is not None:
            scene, _ = choose_step(scene, self.device)
        self.scene = scene
        self.frame = 0
        self.max_displacement = 0.0
        self.shortest_spring = 1.0
        self._closed = False
        self._dynamics = Dynamics(scene, self.device, cores=cores)
        self._position = self._read()
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

        Args:
            frames: how many, 0 or more.

        Raises:
            MsmError: when the simulation is closed.
            DivergedError: when a point is no longer finite or has left every bound. `positions` and `draw` then give
                the last frame that was good.
        """
        if not (isinstance(frames, int) and frames >= 0):
            raise ValueError(f"{frames!r} frames cannot be simulated; take a whole number, 0 or more")
        self._require_open()
        for _ in range(frames):
            self._dynamics.advance(steps_per_frame(self.scene))
            self._position = self._read()
            self.frame += 1

    def positions(self) -> NDArray[Any]:
        """Give where the points are.

        Returns:
            Positions [m], shape (rows, cols, 3), in the scene's precision; not to be written to.
        """
        return self._position

    def draw(self, camera: View | None = None) -> NDArray[np.uint8]:
        """Draw the sheet as it is now.

        Args:
            camera: another view than the scene's.

        Returns:
            Colours, shape (height, width, 3).

        Raises:
            SceneError: when the scene's picture cannot be read.
        """
        self._require_open()
        return self._drawn().draw(self._position, camera)

    def compile(self) -> None:
        """Compile now what would be compiled by the first frame."""
        self._dynamics.compile()
        if self.scene.draws:
            self.draw()

    def close(self) -> None:
        """Free the memory of the fields. `positions` still gives the last frame."""
        self._closed = True
        self._dynamics.close()
        if self._drawing is not None:
            self._drawing.close()

    def __enter__(self) -> Simulation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _require_open(self) -> None:
        # The kernels would write to memory that is freed.
        if self._closed:
            raise MsmError("this simulation is closed; make another")

    def _drawn(self) -> Drawing:
        if self._drawing is None:
            from taichi_msm.drawing import Drawing

            texture = load_texture(self.scene) if self._texture is None else self._texture
            self._drawing = Drawing(self.scene, texture)
        return self._drawing

    def _read(self) -> NDArray[Any]:
        """Read where the points are, if the simulation has not gone wrong."""
        displacement = self._dynamics.displacement()
        self._watch(displacement)
        self.shortest_spring = min(self.shortest_spring, self._dynamics.shortest_spring)
        position, (x, y) = displacement, axes(self.scene.sheet)
        # Summed in float64 and rounded once, without a copy of the sheet.
        np.add(position[..., 0], x, out=position[..., 0], casting="same_kind")
        np.add(position[..., 1], y, out=position[..., 1], casting="same_kind")
        position.flags.writeable = False
        return position

    def _watch(self, displacement: NDArray[Any]) -> None:
        """Stop a simulation that has gone wrong."""
        with np.errstate(over="ignore", invalid="ignore"):
            square = np.einsum("ijk,ijk->ij", displacement, displacement, dtype=np.float64)
        i, j = (int(index) for index in np.unravel_index(square.argmax(), square.shape))
        largest = float(np.linalg.norm(displacement[i, j].astype(float)))
        size = max(self.scene.sheet.size)
        # Written so that NaN is found as well: argmax points at it, and it is not below anything.
        time = self.steps * step(self.scene)
        if not largest <= farthest_displacement(self.scene, time):
            raise DivergedError(
                f"diverged before {time:g} s, step {self.steps}: point ({i}, {j}) is {largest:g} m from its rest "
                f"position, and the sheet is {size:g} m long; the step is {step(self.scene):g} s of at most "
                f"{stable_step(self.scene):g} s; try a weaker probes.N.force or a smaller time.step"
            )
        self.max_displacement = max(self.max_displacement, largest)
