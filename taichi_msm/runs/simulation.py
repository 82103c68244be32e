"""Interactive simulation of a scene: advance, steer, draw and label its frames, and play them in a notebook."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy import divergence
from taichi_msm.accuracy.diagnosis import Diagnosis, diagnose
from taichi_msm.accuracy.divergence import DivergenceMonitor
from taichi_msm.errors import (
    ArgumentError,
    DivergedError,
    MsmError,
    Pause,
    as_array,
    is_real_array,
    require_frame_count,
    require_type,
)
from taichi_msm.load.check import check_scene
from taichi_msm.load.resolve import resolve
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import Surface, place_instruments, refine_surface, to_positions
from taichi_msm.render.camera import Shot
from taichi_msm.render.labels import Flow, FrameOutputs, Labels, Sight
from taichi_msm.render.picking import pick, place_on_sheet
from taichi_msm.render.renderer import Array, CameraLike, Renderer
from taichi_msm.render.texture import require_texture
from taichi_msm.runs.player import Player, jpeg_data_url
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_MAGNITUDE
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.dynamics import ForceRecorder
from taichi_msm.solver.planning import steer_plan, with_current_paths
from taichi_msm.solver.rest import build_solver
from taichi_msm.solver.state import ProbeForces, Reading, RunProgress, Snapshot, TipForce, largest_displacement
from taichi_msm.system import runtime

# Drawing kernels that `Simulation.compile` has compiled in this process.
_compiled_kernels: set[tuple[object, ...]] = set()


class Simulation(AbstractContextManager["Simulation"]):
    """Simulation of a scene, frame by frame. As a context manager, it frees its memory at exit.

    Args:
        scene: the scene, from `load_scene` or as a mapping with the keys of a scene file. If it has a tolerance, trial
            runs first choose the mesh or the step.
        arch: cpu, cuda or vulkan.
        threads: number of CPU threads; None for all cores.
        texture: the picture on the sheet, shape (height, width, 3); None for the scene's, read at the first drawing.
        cores: number of cores for stepping; None for all. Other programs on these cores slow down stepping, because its
            threads wait for each other by spinning.

    Raises:
        MsmError: here and in all methods, when called in another thread than that of the first simulation or in a
            forked process; in most methods also after `close`.
        ArgumentError: here and in all methods, when an argument is invalid.
        DeviceError: when the arch is not available, or the compiler already runs on another arch in this process.
        SceneError: when the scene cannot be run, or no step meets its tolerance.

    Attributes:
        renderer: draws and labels the sheet.

    Example:
        >>> from taichi_msm import Simulation, load_scene
        >>> with Simulation(load_scene("scenes/press.yaml")) as simulation:
        ...     simulation.advance(10)
        ...     picture = simulation.draw("oblique")
        >>> simulation.positions().shape, picture.shape
        ((61, 61, 3), (512, 512, 3))
    """

    def __init__(
        self,
        scene: Plan | Scene | Mapping[str, Any],
        arch: str = "cpu",
        threads: int | None = None,
        texture: NDArray[np.uint8] | None = None,
        cores: int | None = None,
    ) -> None:
        require_type(cores, int | None, "cores", "a whole number, 1 or more, or None")
        plan = check_scene(scene)
        texture = None if texture is None else require_texture(texture)
        self.device = runtime.start(arch, threads)
        self._plan = resolve(plan, self.device).plan
        self._original_probes = self.scene.probes  # before `steer`
        self._closed, self._cores = False, cores
        self._dynamics = build_solver(self._plan, self.device, cores=cores)
        self._reset()
        self.renderer = Renderer(self.scene, texture)

    def _reset(self) -> None:
        """Return to the flat sheet. The first frame of a quasi-static scene is solved when it is needed."""
        self._divergence: DivergedError | None = None
        self._monitor, self._force_recorder = DivergenceMonitor(self._plan), ForceRecorder(self._plan)
        self._probe_forces = self._force_recorder.at_start()
        flat = to_positions(self._dynamics.displacement(), self.scene.sheet)
        self._frame_positions: Array | None = None if self.scene.time.at_rest else flat

    @property
    def scene(self) -> Scene:
        """The scene, with resolved mesh, step and precision."""
        return self._plan.scene

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
    def inconsistent(self) -> bool:
        """Whether an interruption within a step left the state inconsistent; `restore` and `restart` repair it."""
        return self._dynamics.inconsistent

    @property
    def lanes(self) -> int:
        """Number of SIMD lanes used for stepping; 1 on a GPU."""
        return self._dynamics.layout.config.lanes

    @property
    def workers(self) -> int:
        """Number of threads used for stepping; 0 on a GPU. One thread steps while other programs use the cores."""
        return self._dynamics.layout.workers

    @property
    def progress(self) -> RunProgress:
        """Progress and extrema of the run up to the last frame."""
        return self._monitor.progress

    def advance(self, frames: int = 1, pause: Pause = lambda: None) -> None:
        """Simulate a number of frames under the loads of the scene.

        Args:
            frames: number of frames, 0 or more; 0 only solves the first equilibrium of a quasi-static scene.
            pause: called several times a second between steps. An exception from it stops the simulation; the next call
                of `advance` continues.

        Raises:
            DivergedError: when a position is not finite or exceeds its bounds, or the equilibrium solver does not
                converge. `positions` and `draw` then return the last valid frame.
        """
        require_frame_count(frames)
        require_type(pause, Callable, "pause", "a function")
        self._require_open()
        self._solve_first_frame(pause)
        for _ in range(frames):
            self._advance_to(self.frame + 1, pause)

    def steer(self, probes: Sequence[Probe | Mapping[str, Any] | None]) -> None:
        """Replace the loads and tool paths from the current time on.

        Args:
            probes: one entry per probe of the scene: the probe with new values, or None for no change.
                Force-controlled tools: a fixed control point stays fixed, a moving one moving, and a jumping one
                jumping. To move one later, give it keyframes in `at` in the scene.
                Position-controlled tools: `{"path": [[t, across, down, height], ...]}` with times after `time`. The
                tool moves straight from its current position to the first keyframe. Instrument, friction and grips are
                kept by default. A grip in progress continues if the new grips have one with the same start.

        Raises:
            ArgumentError: when the compiled kernel does not support these probes.
            SceneError: when an entry is not a valid probe, or a tool would jump, or falls on no sheet.
        """
        self._require_open()
        require_type(probes, Sequence, "probes", "a list of them")
        self._solve_first_frame()
        plan = steer_plan(self._plan, probes, self._plan.grid.time(self.steps))
        self._dynamics.steer(plan)
        self._monitor.change_loads(plan)
        self._replace_plan(plan)

    def restart(self, scene: Plan | Scene | Mapping[str, Any] | None = None) -> None:
        """Return to the initial state; kernels are reused if the terms of the model and the precision are unchanged.

        Args:
            scene: a new scene; None for the same.

        Raises:
            SceneError: as for `Simulation`.
        """
        self._require_open()
        motion = self.scene.time.motion
        if scene is not None:
            self._plan = resolve(check_scene(scene), self.device).plan
            self._original_probes = self.scene.probes
            self.renderer.restart(self.scene)
        else:
            self._replace_plan(with_current_paths(self._plan, self._original_probes))
        if self.scene.time.motion == motion:
            self._dynamics.restart(self._plan)
        else:
            self._dynamics.close()
            self._dynamics = build_solver(self._plan, self.device, cores=self._cores)
        self._reset()

    def change_material(self, scene: Plan | Scene | Mapping[str, Any]) -> None:
        """Continue from the last frame with another material; shape, velocities, time and probes stay.

        Args:
            scene: the current scene with other values of `tissue`, `springs` and `damping`.

        Raises:
            SceneError: as for `Simulation`.
        """
        self._require_open()
        before, state = self._plan, self.save().state
        plan = resolve(check_scene(scene), self.device).plan.with_probes(self.scene.probes)
        steps = self.frame * plan.grid.steps_per_frame
        # A difference is a displacement per step, and the step may follow from the new stability limit.
        difference = state.difference * state.difference.dtype.type(plan.grid.step / before.grid.step)
        self._dynamics.restart(plan, state._replace(steps=steps, difference=difference))
        self._replace_plan(plan)
        progress = replace(self.progress, energy=self._dynamics.read().energy)
        self._monitor = DivergenceMonitor(plan, progress)

    def save(self) -> Snapshot:
        """Return the state from which another simulation of the scene can continue.

        Raises:
            DivergedError: as for `advance`.
        """
        self._require_open()
        self._solve_first_frame()
        reading = self._dynamics.read()
        self._require_no_fault(reading, self._monitor.check(reading))
        return self._snapshot()

    def restore(self, saved: Snapshot) -> None:
        """Continue from a saved state of the same scene, with the same bits as an uninterrupted simulation.

        Args:
            saved: state from `save`; it may lie between two frames.

        Raises:
            ArgumentError: when the state has another mesh, precision, step or number of probes.
        """
        self._require_open()
        if not isinstance(saved, Snapshot):
            raise ArgumentError(f"{type(saved).__name__} is not a Snapshot; take one from `save`")
        state, per_frame = saved.state, self._plan.grid.steps_per_frame
        steps_in_frame = state.steps - saved.progress.frame * per_frame
        current = self._dynamics.displacement()
        same_mesh = (state.displacement.shape, state.displacement.dtype) == (current.shape, current.dtype)
        same_probes = len(saved.probe_forces.forces) == len(self.scene.probes)
        if not (same_mesh and same_probes and 0 <= steps_in_frame <= per_frame):
            raise ArgumentError(
                f"saved at step {state.steps}, frame {saved.progress.frame}, {state.displacement.dtype} of shape "
                f"{state.displacement.shape}; take a state saved with this scene's points, probes, precision and step"
            )
        if saved.probes:
            self._replace_plan(with_current_paths(self._plan, saved.probes))
        self._divergence = None
        self._dynamics.restart(self._plan, saved.state)
        self._frame_positions = to_positions(self._dynamics.displacement(), self.scene.sheet)
        self._monitor.progress, self._probe_forces = saved.progress, saved.probe_forces

    def positions(self) -> Array:
        """Return the positions of the mass points [m], shape (rows, cols, 3), in the scene's precision; read-only."""
        self._solve_first_frame()
        assert self._frame_positions is not None
        return self._frame_positions

    def forces(self) -> list[TipForce]:
        """Return the tip position and the force on the sheet of every probe at the last frame."""
        self._solve_first_frame()
        return list(self._probe_forces.forces)

    @property
    def felt(self) -> ProbeForces:
        """Forces of all probes at the last frame, and the greatest so far."""
        return self._probe_forces

    def velocities(self) -> Array:
        """Return the velocities of the mass points, averaged over the last step.

        Returns:
            Velocities half a step before `time` [m/s], shape (rows, cols, 3), in the scene's precision; 0 at the start.
        """
        self._require_open()
        return self._dynamics.state().difference / self.positions().dtype.type(self._plan.grid.step)

    def surface(self) -> Surface:
        """Return the refined surface as a triangle mesh with texture coordinates."""
        return refine_surface(self.positions(), self.scene.render.refine, rest_of(self.scene.sheet))

    def diagnose(self, start: Snapshot | None = None, pause: Pause = lambda: None) -> Diagnosis:
        """Find the cause of a divergence in `advance`. The simulation needs `restore` before the next `advance`.

        Args:
            start: an earlier state from `save`, from which the simulation is repeated; None for the initial state.
            pause: called several times a second; an exception from it stops the search.

        Returns:
            The cause with its remedy, and the last valid state.

        Raises:
            MsmError: when the simulation has not diverged.
        """
        self._require_open()
        if self._divergence is None:
            raise MsmError("this simulation has not diverged; there is nothing to diagnose")
        if self.scene.time.at_rest:
            last_state = None if self._frame_positions is None else self._snapshot()
            return Diagnosis(str(self._divergence), last_state)
        return diagnose(self._dynamics, start, pause)

    def draw(
        self, camera: CameraLike = None, positions: Array | None = None, time: float | None = None
    ) -> NDArray[np.uint8]:
        """Draw the sheet and the instruments of the probes.

        Args:
            camera: name of a camera of the scene, "top", "oblique", "fit", a `Camera` or a mapping of its keys; None
                for the scene's main camera.
            positions: positions of the mass points [m], shape (rows, cols, 3); None for the current ones.
            time: time of these positions [s], for instruments and moving cameras; None for the current time.

        Returns:
            Colours, shape (height, width, 3).

        Raises:
            SceneError: when the scene's picture cannot be read, or the camera is not valid.
            DeviceError: when the driver of a GPU aborted part of the work.
        """
        return self.renderer.draw(self._shot(camera, positions, time))

    def labels(self, camera: CameraLike = None, positions: Array | None = None, time: float | None = None) -> Labels:
        """Compute the ground-truth labels of each pixel centre: material point, depth, normal and instrument mask.

        Args:
            camera: as for `draw`.
            positions: as for `draw`.
            time: as for `draw`.

        Returns:
            A value or vector per pixel: arrays of shape (height, width) or (height, width, components).

        Raises:
            SceneError: as for `draw`.
            DeviceError: as for `draw`.
        """
        return self.renderer.labels(self._shot(camera, positions, time))

    def flow(
        self, before: Labels, camera: CameraLike = None, positions: Array | None = None, time: float | None = None
    ) -> Flow:
        """Compute the optical flow from another frame to this one, and the occlusion of the other frame's pixels.

        Args:
            before: labels of the other frame, earlier or later, with the same picture size. If they are of another
                camera, the flow leads from its picture to that of `camera`.
            camera: as for `draw`.
            positions: as for `draw`.
            time: as for `draw`.

        Returns:
            Displacement of each pixel to the right and down [px], shape (height, width, 2), and its occlusion, shape
            (height, width).
        """
        return self.renderer.flow(before, self._shot(camera, positions, time))

    def locate(
        self, coordinates: Array, camera: CameraLike = None, positions: Array | None = None, time: float | None = None
    ) -> Sight:
        """Project material points into the picture, and determine their occlusion; the inverse of `pick`.

        Args:
            coordinates: material points, shape (n, 2): fractions of the sheet's width from the left and of its height
                from the top.
            camera: as for `draw`.
            positions: as for `draw`.
            time: as for `draw`.

        Returns:
            Pixel coordinates, x to the right and y down, shape (n, 2), and occlusion, shape (n,).
        """
        return self.renderer.locate(coordinates, self._shot(camera, positions, time))

    def pick(self, pixel: tuple[float, float], camera: CameraLike = None) -> tuple[float, float] | None:
        """Return the material point visible at the centre of a pixel.

        Args:
            pixel: x to the right and y down, counted from the picture's top-left pixel (0, 0).
            camera: as for `draw`.

        Returns:
            Fractions of the sheet's width from the left and height from the top, as in `at` of a probe; None for the
            background.

        Raises:
            ArgumentError: when `pixel` is not a pair of finite numbers.
        """
        point = as_array(pixel, "pixel")
        if not (is_real_array(point, (2,)) and np.isfinite(point).all()):
            raise ArgumentError(f"pixel: {pixel!r}; take two numbers, x to the right and y down")
        x, y = point.tolist()
        view, rest = self.renderer.resolve_camera(camera, self.time), rest_of(self.scene.sheet)
        return place_on_sheet(rest, pick(self.positions(), self.scene.render.refine, view, (x, y), rest.mask))

    def observe(
        self,
        before: Labels | None,
        camera: CameraLike = None,
        positions: Array | None = None,
        time: float | None = None,
    ) -> FrameOutputs:
        """Compute all pictures and labels that the scene's `output` requests for a frame.

        Args:
            before: labels of the previous frame, for the optical flow; None for the first frame.
            camera: as for `draw`.
            positions: as for `draw`.
            time: as for `draw`.

        Returns:
            The outputs; None in place of those that are not requested.
        """
        return self.renderer.observe(before, self._shot(camera, positions, time))

    def play(self, frames: int, camera: CameraLike = None) -> Player:
        """Simulate and draw frames for playback in a notebook.

        Args:
            frames: number of frames to simulate after the current one, which is also shown.
            camera: as for `draw`.

        Returns:
            A player with `frames` + 1 pictures, which a notebook displays.
        """
        require_frame_count(frames)
        pictures = [self.draw(camera)]
        for _ in range(frames):
            self.advance()
            pictures.append(self.draw(camera))
        return Player(pictures, self.scene.time.frames_per_second)

    def _repr_html_(self) -> str | None:
        """Render the current frame for a notebook."""
        if self._closed:
            return None
        rows, cols = self.scene.sheet.points
        largest = 1000 * self.progress.max_displacement
        caption = f"{self.time:g} s, {rows} × {cols} points, largest displacement so far {largest:.1f} mm"
        return f'<figure><img alt="" src="{jpeg_data_url(self.draw())}"><figcaption>{caption}</figcaption></figure>'

    def compile(self, pause: Pause = lambda: None) -> None:
        """Compile all kernels now instead of at the first frame.

        Args:
            pause: called between kernels; an exception from it stops the compilation.
        """
        self._require_open()
        self._dynamics.compile()
        pause()
        if self.scene.renders and (kernels := self.renderer.kernels()) not in _compiled_kernels:
            position = to_positions(self._dynamics.displacement(), self.scene.sheet)
            for camera in self.scene.render.all_cameras:  # twice, as optical flow needs a previous frame
                first = self.observe(None, camera, position)
                self.observe(first.labels, camera, position)
            _compiled_kernels.add(kernels)

    def close(self) -> None:
        """Free the memory. `positions` still returns the last frame."""
        runtime.require_start_thread()
        self._closed = True
        self._dynamics.close()
        self.renderer.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> Any:
        remedy = "keep its `scene` and the Snapshot of `save`, and `restore` it in a new one"
        raise MsmError(f"a Simulation cannot be pickled or copied; {remedy}")

    def _solve_first_frame(self, pause: Pause = lambda: None) -> None:
        """Solve the equilibrium of the first frame, if it is still missing."""
        if self._frame_positions is None:
            self._require_open()
            self._advance_to(0, pause)

    def _advance_to(self, frame: int, pause: Pause) -> None:
        try:
            self._dynamics.advance(frame * self._plan.grid.steps_per_frame - self.steps, pause)
        except DivergedError as error:
            self._divergence = error
            raise
        reading = self._dynamics.read()
        self._require_no_fault(reading, self._monitor.check_frame(reading))
        position, forces = to_positions(reading.displacement, self.scene.sheet), self._dynamics.tool_forces()
        self._probe_forces = self._force_recorder.at_frame(self._probe_forces, self.frame, position, forces)
        self._frame_positions = position

    def _snapshot(self) -> Snapshot:
        return Snapshot(self._dynamics.state(), self.progress, self._probe_forces, self.scene.probes)

    def _require_open(self) -> None:
        """Raise an MsmError in another thread, or after `close`, when kernels would write to freed memory."""
        if self._closed:
            raise MsmError("this simulation is closed; build a new one")
        runtime.require_start_thread()

    def _shot(self, camera: CameraLike, positions: Array | None, time: float | None) -> Shot:
        """Validate positions and time, place the instruments, and set up the camera."""
        self._require_open()
        current = self.positions()
        positions = current if positions is None else as_array(positions, "positions")
        if not is_real_array(positions, current.shape):
            fault = f"positions: {positions.dtype} of shape {positions.shape}"
            raise ArgumentError(f"{fault}; take numbers of shape {current.shape}")
        # Beyond it, kernels overflow. The minimum is NaN if any value is.
        if not (positions.min() >= -MAX_MAGNITUDE and positions.max() <= MAX_MAGNITUDE):
            place = tuple(np.argwhere(~(np.abs(positions) <= MAX_MAGNITUDE))[0].tolist())
            raise ArgumentError(
                f"positions{list(place)}: {positions[place]:g}; take numbers of at most {MAX_MAGNITUDE:g}, in metres"
            )
        if time is None:
            time = self.time
        elif not (is_real_array(as_array(time, "time"), ()) and math.isfinite(time)):
            raise ArgumentError(f"time: {time!r}; take a number, in seconds, or None for now")
        instruments = place_instruments(self.scene, positions, time)
        return Shot(positions, self.renderer.resolve_camera(camera, time), instruments)

    def _require_no_fault(self, reading: Reading, fault: str) -> None:
        """Raise a DivergedError if `fault` is not empty."""
        if fault:
            steps, time = reading.steps, self._plan.grid.time(reading.steps)
            message = divergence.format_message(time, steps, fault, exact=False)
            self._divergence = DivergedError(message, steps, time, largest_displacement(reading.displacement)[:2])
            raise self._divergence

    def _replace_plan(self, plan: Plan) -> None:
        self._plan, self.renderer.scene, self._force_recorder = plan, plan.scene, ForceRecorder(plan)
