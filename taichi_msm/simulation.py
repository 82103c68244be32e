"""A scene in motion: a class whose methods run the two kernels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arguments import as_array, require_frame_count
from taichi_msm.errors import ArgumentError, DivergedError, MsmError
from taichi_msm.physics import divergence
from taichi_msm.physics.diagnosis import Diagnosis, diagnose
from taichi_msm.physics.divergence import Watch, farthest
from taichi_msm.physics.error_control import choose_step
from taichi_msm.physics.lattice import axes
from taichi_msm.physics.mesh_error import choose_points
from taichi_msm.physics.run_progress import RunProgress, Saved
from taichi_msm.physics.solver import Dynamics
from taichi_msm.physics.state import Reading
from taichi_msm.physics.timestep import time_grid, with_grid
from taichi_msm.progress import Pause
from taichi_msm.render.camera import View, view
from taichi_msm.render.instrument import Rod, rods
from taichi_msm.render.labels import Flow, Labels, Observed, Sight, track_grid
from taichi_msm.render.picking import pick
from taichi_msm.render.surface import Surface, surface
from taichi_msm.render.texture import load_texture, require_texture
from taichi_msm.scene import UNTIL_NEXT, Camera, Probe, Scene
from taichi_msm.scenefile.validation import checked
from taichi_msm.system import runtime
from taichi_msm.timegrid import TimeGrid

if TYPE_CHECKING:
    from taichi_msm.notebook import Player
    from taichi_msm.render.rasterizer import Drawing, Drawn

# A camera in one of the forms that a scene may have; or a `View`, which was set up already; None: the scene's own.
CameraLike = str | Mapping[str, Any] | Camera | View | None


class Simulation:
    """A sheet that moves by frames and can be drawn. Usable in a with statement, which frees its memory.

    Args:
        scene: what `load_scene` returned, or the same as a mapping; if it has a tolerance, pilot runs first choose the
            points or the step.
        arch: cpu, cuda or vulkan.
        threads: number of CPU threads; None takes every core.
        texture: the picture on the sheet, shape (height, width, 3); None: the scene's own, read when it is drawn.
        cores: how many cores are free for stepping; None: all. The threads spin while they wait for each other, so a
            thread without a core delays all of them.

    Raises:
        MsmError: here and in all methods, in any thread but that of the first simulation, or in a process that was
            forked after it.
        ArgumentError: here and in all methods, when an argument is not what it must be.
        DeviceError: when the arch is not available, or the compiler already runs on another one in this process.
        SceneError: when the scene cannot be run, or no step meets its tolerance.

    Attributes:
        scene: the scene, with the step and the precision that were chosen.
    """

    def __init__(
        self,
        scene: Scene | Mapping[str, Any],
        arch: str = "cpu",
        threads: int | None = None,
        texture: NDArray[np.uint8] | None = None,
        cores: int | None = None,
    ) -> None:
        scene = checked(scene)
        texture = None if texture is None else require_texture(texture)
        self.device = runtime.start(arch, threads)
        self.scene, self._grid = self._resolved(scene)
        self._watch = Watch(self.scene, self._grid)
        self._closed = self._diverged = False
        self._dynamics = Dynamics(self.scene, self._grid, self.device, cores=cores)
        self._position = self._place(self._dynamics.displacement())
        self._texture = texture
        self._own_texture = texture is None
        # The keys tell whether a drawing gives a picture, and whether it gives labels.
        self._drawings: dict[tuple[bool, bool], Drawing] = {}

    def _resolved(self, scene: Scene) -> tuple[Scene, TimeGrid]:
        """Choose what the scene leaves open: the points and the step for a tolerance, and the precision."""
        if scene.sheet.tolerance is not None:
            scene, _ = choose_points(scene, self.device, checked)
        grid = time_grid(scene, self.device.arch)
        if scene.time.tolerance is not None:
            grid, _ = choose_step(scene, grid, self.device)
        return with_grid(scene, grid), grid

    @property
    def frame(self) -> int:
        """Number of frames simulated so far."""
        return self.progress.frame

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.frame / self.scene.time.frames_per_second

    @property
    def steps(self) -> int:
        """Number of steps taken so far."""
        return self._dynamics.steps_done

    @property
    def torn(self) -> bool:
        """Whether it was interrupted while steps were taken, so that only `restore` or `restart` make it whole."""
        return self._dynamics.torn

    @property
    def lanes(self) -> int:
        """Lanes of the vectors that the steps are computed in; 1 on a GPU."""
        return self._dynamics.structure.code.lanes

    @property
    def workers(self) -> int:
        """Number of threads that share the steps while the cores are free; 0 on a GPU."""
        return self._dynamics.structure.workers

    @property
    def progress(self) -> RunProgress:
        """What is known of the run up to the last frame."""
        return self._watch.progress

    def advance(self, frames: int = 1, pause: Pause = lambda: None) -> None:
        """Simulate a number of frames, with the loads of the scene's keys.

        Args:
            frames: how many, 0 or more.
            pause: called some times a second, between steps; what it raises stops the simulation there, and the next
                call goes on from there.

        Raises:
            MsmError: when the simulation is closed.
            DivergedError: when the simulation diverges: a position is no longer finite, or exceeds every bound.
                `positions` and `draw` then give the last good frame.
        """
        require_frame_count(frames)
        self._require_open()
        for _ in range(frames):
            end = (self.frame + 1) * self._grid.steps_per_frame
            self._dynamics.advance(end - self.steps, pause)
            self._position = self._read()

    def steer(self, probes: Sequence[Probe | Mapping[str, Any]]) -> None:
        """Replace the loads from here on.

        Args:
            probes: the scene's probes with other numbers. Each control point must move, jump or stand as before; for a
                tool that is to move later, give `at` as keys from the start, be it a single one.

        Raises:
            MsmError: when the simulation is closed.
            ArgumentError: when the kernel was not compiled for such probes.
            SceneError: when one of them is not a probe.
        """
        self._require_open()
        if not isinstance(probes, Sequence):
            raise ArgumentError(f"probes: {probes!r}; take a list of them")
        scene = self.scene.model_copy(update={"probes": tuple(probes)})
        self._dynamics.steer(scene)
        self._watch.steer(scene)
        self.scene = scene

    def restart(self, scene: Scene | Mapping[str, Any] | None = None) -> None:
        """Begin again at rest. Nothing is compiled if the terms of the model and the precision stay the same.

        Args:
            scene: another one; None: the same.

        Raises:
            MsmError: when the simulation is closed.
            SceneError: as for `Simulation`.
        """
        self._require_open()
        if scene is not None:
            scene, grid = self._resolved(checked(scene))
            if self._own_texture and (scene.image, scene.region) != (self.scene.image, self.scene.region):
                self._texture = None
            self.scene, self._grid = scene, grid
        self._watch = Watch(self.scene, self._grid)
        self._diverged = False
        self._dynamics.restart(self.scene, self._grid)
        self._drawings.clear()
        self._position = self._place(self._dynamics.displacement())

    def save(self) -> Saved:
        """Save all that another simulation needs to continue from here.

        Raises:
            MsmError: when the simulation is closed.
            DivergedError: as for `advance`.
        """
        self._require_open()
        reading = self._dynamics.read()
        self._require_good(reading, self._watch.judge(reading))
        return Saved(self._dynamics.state(), self.progress)

    def restore(self, saved: Saved) -> None:
        """Continue from where a simulation of the same scene was saved, also between two frames; to the same bits.

        Raises:
            MsmError: when the simulation is closed.
            ArgumentError: when it was saved with other points, another precision or another step.
        """
        self._require_open()
        if not isinstance(saved, Saved):
            raise ArgumentError(f"{type(saved).__name__} is not what `save` returns")
        state, per_frame = saved.state, self._grid.steps_per_frame
        since = state.steps - saved.progress.frame * per_frame
        alike = (state.displacement.shape, state.displacement.dtype) == (self._position.shape, self._position.dtype)
        if not (alike and 0 <= since <= per_frame):
            raise ArgumentError(
                f"saved at step {state.steps}, frame {saved.progress.frame}, {state.displacement.dtype} of shape "
                f"{state.displacement.shape}; take what was saved with this scene's points, precision and step"
            )
        self._diverged = False
        self._dynamics.restart(self.scene, self._grid, saved.state)
        self._position = self._place(self._dynamics.displacement())
        self._watch.progress = saved.progress

    def positions(self) -> NDArray[Any]:
        """Give where the points are.

        Returns:
            Positions [m], shape (rows, cols, 3), in the scene's precision; not to be written to.
        """
        return self._position

    def velocities(self) -> NDArray[Any]:
        """Give the velocities of the points: the mean over the last step, so those half a step before `time`.

        Returns:
            Velocities [m/s], shape (rows, cols, 3), in the scene's precision; 0 at the start.
        """
        self._require_open()
        return self._dynamics.state().difference / self._position.dtype.type(self._grid.step)

    def surface(self) -> Surface:
        """Give the refined surface as textured triangles: vertices, triangles, texture coordinates."""
        return surface(self._position, self.scene.render.refine)

    def pick(self, pixel: tuple[float, float], camera: CameraLike = None) -> tuple[float, float] | None:
        """Find the material point that is seen at the centre of a pixel.

        Args:
            pixel: x to the right and y down from the picture's top-left pixel, which is (0, 0).
            camera: as for `draw`.

        Returns:
            Fractions of the sheet's width from its left and of its height from its top, as in a probe's `at`;
            None if no surface is there.

        Raises:
            ArgumentError: when the pixel is not two numbers.
            SceneError: as for `draw`.
        """
        seen = as_array(pixel, "pixel")
        if seen.shape != (2,) or seen.dtype.kind not in "fiu" or not np.isfinite(seen).all():
            raise ArgumentError(f"pixel: {pixel!r}; take two numbers, x to the right and y down")
        x, y = (float(number) for number in seen)
        return pick(self._position, self.scene.render.refine, self._view(camera), (x, y))

    def diagnose(self, start: Saved | None = None, pause: Pause = lambda: None) -> Diagnosis:
        """Find out why the simulation diverged in `advance`. Afterwards it can advance only after `restore`.

        Args:
            start: what `save` returned before; the simulation is repeated from there. None: from rest.
            pause: called some times a second; what it raises stops the search.

        Raises:
            MsmError: when the simulation is closed, or has not diverged.
        """
        self._require_open()
        if not self._diverged:
            raise MsmError("this simulation has not diverged; there is nothing to find out")
        return diagnose(self._dynamics, start, pause)

    def draw(
        self, camera: CameraLike = None, positions: NDArray[Any] | None = None, time: float | None = None
    ) -> NDArray[np.uint8]:
        """Draw the sheet as it is now, and the probes' instruments.

        Args:
            camera: "top", "oblique", a `Camera` or its keys; None: the scene's.
            positions: other positions of the points [m], such as those of an earlier frame, shape (rows, cols, 3).
            time: time of these positions [s], for control points that move; None: now.

        Returns:
            Colours, shape (height, width, 3).

        Raises:
            ArgumentError: when the positions are of another shape.
            SceneError: when the scene's picture cannot be read, or the camera is not valid.
            DeviceError: when the driver of a GPU ended part of the work early.
        """
        picture = self._look(camera, positions, time, picture=True, labels=False).picture
        assert picture is not None
        return picture

    def labels(
        self, camera: CameraLike = None, positions: NDArray[Any] | None = None, time: float | None = None
    ) -> Labels:
        """Give what each pixel shows at its centre: the material point, the depth, whether it is an instrument.

        Args:
            camera: as for `draw`.
            positions: as for `draw`.
            time: as for `draw`.

        Raises:
            ArgumentError, DeviceError: as for `draw`.
            SceneError: when the camera is not valid.
        """
        labels = self._look(camera, positions, time, picture=False, labels=True).labels
        assert labels is not None
        return labels

    def flow(
        self,
        before: Labels,
        camera: CameraLike = None,
        positions: NDArray[Any] | None = None,
        time: float | None = None,
    ) -> Flow:
        """Give the optical flow from an earlier or later frame to this one, and which of its material is now hidden.

        Args:
            before: what `labels` returned for the other frame, with the same size of the picture.
            camera: as for `draw`.
            positions: as for `draw`.
            time: as for `draw`.

        Raises:
            ArgumentError: as for `draw`, and when `before` is of another size.
            SceneError: when the camera is not valid.
            DeviceError: as for `draw`.
        """
        width, height = self.scene.render.size
        points = as_array(before.coordinates, "before") if isinstance(before, Labels) else np.empty(0)
        on_sheet = points.dtype.kind == "f" and not ((points < 0) | (points > 1)).any()
        if points.shape != (height, width, 2) or not on_sheet:
            raise ArgumentError(f"before: take what `labels` gave for a picture of {width} x {height} pixels")
        from taichi_msm.render.tracking import find_flow

        positions, rods = self._placed(positions, time)
        return find_flow(self.scene, points, positions, self._view(camera), rods)

    def locate(
        self,
        coordinates: NDArray[Any],
        camera: CameraLike = None,
        positions: NDArray[Any] | None = None,
        time: float | None = None,
    ) -> Sight:
        """Find where material points are seen, and whether anything hides them; the inverse of `pick`.

        Args:
            coordinates: fractions of the sheet's width from its left and of its height from its top, 0 to 1, shape
                (n, 2).
            camera: as for `draw`.
            positions: as for `draw`.
            time: as for `draw`.

        Raises:
            ArgumentError: as for `draw`, and when the coordinates are not numbers of that shape from 0 to 1.
            SceneError: when the camera is not valid.
            DeviceError: as for `draw`.
        """
        found = as_array(coordinates, "coordinates")
        numbers = found.dtype.kind in "fiu" and found.ndim == 2 and found.shape[1] == 2
        if not numbers or not ((found >= 0) & (found <= 1)).all():
            raise ArgumentError(
                f"coordinates: {found.dtype} of shape {found.shape}; take numbers from 0 to 1 of shape (n, 2)"
            )
        from taichi_msm.render.tracking import find

        positions, rods = self._placed(positions, time)
        return find(self.scene, found, positions, self._view(camera), rods)

    def observe(self, before: Labels | None, positions: NDArray[Any], time: float) -> Observed:
        """Give everything that the scene's output asks for of one frame.

        Args:
            before: the labels of the frame before; None: there was none.
            positions: of the points [m], shape (rows, cols, 3).
            time: of the frame [s].
        """
        scene = self.scene
        # Labels need one sample, at the pixel's centre; with several samples per pixel, none is there.
        together = scene.render.supersample == 1
        picture = labels = flow = tracks = None
        if scene.draws:
            picture, labels = self._look(None, positions, time, picture=True, labels=scene.labels_pixels and together)
        if scene.labels_pixels and labels is None:
            labels = self.labels(None, positions, time)
        if before is not None and any(kind in UNTIL_NEXT for kind in scene.output):
            flow = self.flow(before, None, positions, time)
        if "tracks" in scene.output:
            tracks = self.locate(track_grid(scene.render.tracks), None, positions, time)
        return Observed(picture, labels, flow, tracks)

    def play(self, frames: int, camera: CameraLike = None) -> Player:
        """Draw the present frame, simulate and draw more of them, and show them in a notebook.

        Args:
            frames: how many, 0 or more.
            camera: as for `draw`.

        Raises:
            MsmError: as for `advance` and `draw`.
        """
        from taichi_msm.notebook import Player

        require_frame_count(frames)
        pictures = [self.draw(camera)]
        for _ in range(frames):
            self.advance()
            pictures.append(self.draw(camera))
        return Player(pictures, self.scene.time.frames_per_second)

    def _repr_html_(self) -> str | None:
        """Show the sheet as it is now, in a notebook."""
        if self._closed:
            return None
        from taichi_msm.notebook import captioned

        rows, cols = self.scene.sheet.points
        largest = 1000 * self.progress.max_displacement
        caption = f"{self.time:g} s, {rows} × {cols} points, largest displacement so far {largest:.1f} mm"
        return captioned(self.draw(), caption)

    def compile(self, pause: Pause = lambda: None) -> None:
        """Compile the kernels now that would otherwise be compiled at the first frame.

        Args:
            pause: called between kernels; what it raises stops here.

        Raises:
            MsmError: when the simulation is closed.
        """
        self._require_open()
        self._dynamics.compile()
        pause()
        if self.scene.renders:
            first = self.observe(None, self._position, self.time)
            self.observe(first.labels, self._position, self.time)

    def close(self) -> None:
        """Free the memory. `positions` still gives the last frame."""
        runtime.require_here()
        self._closed = True
        self._dynamics.close()
        self._drawings.clear()

    def __enter__(self) -> Simulation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> Any:
        remedy = "keep its `scene` and what `save` returns, and `restore` that in a new one"
        raise MsmError(f"a Simulation cannot be pickled or copied; {remedy}")

    def _require_open(self) -> None:
        # The kernels would write to memory that was freed.
        if self._closed:
            raise MsmError("this simulation is closed; make another")
        runtime.require_here()

    def _view(self, camera: CameraLike) -> View:
        if isinstance(camera, View):
            return camera
        if camera is None:
            return view(self.scene)
        # The scene is checked as a whole, so that an error names the key as a scene has it.
        render = {**dict(self.scene.render), "camera": camera}
        return view(self.scene.model_copy(update={"render": render}))

    def _look(
        self, camera: CameraLike, positions: NDArray[Any] | None, time: float | None, *, picture: bool, labels: bool
    ) -> Drawn:
        from taichi_msm.render.rasterizer import Drawing, drawing_config

        positions, rods = self._placed(positions, time)
        view = None if camera is None else self._view(camera)
        if (picture, labels) not in self._drawings:
            config = drawing_config(self.scene, picture=picture, labels=labels)
            self._drawings[picture, labels] = Drawing(self.scene, self._require_texture(picture=picture), config)
        return self._drawings[picture, labels].look(positions, view, rods)

    def _placed(self, positions: NDArray[Any] | None, time: float | None) -> tuple[NDArray[Any], list[Rod]]:
        """Check positions, and place the instruments on the sheet."""
        self._require_open()
        if positions is None:
            positions = self._position
        else:
            positions = as_array(positions, "positions")
            found, expected = positions.shape, self._position.shape
            if found != expected or positions.dtype.kind not in "fiu":
                raise ArgumentError(f"positions: {positions.dtype} of shape {found}; take numbers of shape {expected}")
        if time is not None and not _is_finite(time):
            raise ArgumentError(f"time: {time!r}; take a number, in seconds, or None for now")
        return positions, rods(self.scene, positions, self.time if time is None else time)

    def _require_texture(self, *, picture: bool) -> NDArray[np.uint8]:
        """Give the picture on the sheet; a single texel if it is not seen."""
        if not picture:
            return np.zeros((1, 1, 3), np.uint8)
        if self._texture is None:
            self._texture = load_texture(self.scene)
        return self._texture

    def _read(self) -> NDArray[Any]:
        """Read where the points are, after checking that the simulation has not diverged since the last frame."""
        reading = self._dynamics.read()
        self._require_good(reading, self._watch.follow(reading))
        return self._place(reading.displacement)

    def _require_good(self, reading: Reading, wrong: str) -> None:
        if wrong:
            self._diverged = True
            steps, time = reading.steps, self._grid.time(reading.steps)
            point = farthest(reading.displacement)[:2]
            raise DivergedError(divergence.message(time, steps, wrong, exact=False), steps, time, point)

    def _place(self, displacement: NDArray[Any]) -> NDArray[Any]:
        """Turn displacements into positions."""
        position, (x, y) = displacement, axes(self.scene.sheet)
        # The sum is computed in float64 and rounded once, without a float64 copy of the sheet.
        np.add(position[..., 0], x, out=position[..., 0], casting="same_kind")
        np.add(position[..., 1], y, out=position[..., 1], casting="same_kind")
        position.flags.writeable = False
        return position


def _is_finite(number: Any) -> bool:
    """Tell whether a value is a number that a float can hold."""
    if isinstance(number, bool) or not isinstance(number, int | float | np.integer | np.floating):
        return False
    try:
        return math.isfinite(number)
    except OverflowError:
        return False
