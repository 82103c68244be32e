"""A scene in motion: a class whose methods run the two kernels.

Show frames in a notebook.
"""

from __future__ import annotations

import io
import math
from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from itertools import count
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

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
)
from taichi_msm.load.check import check_scene
from taichi_msm.load.resolve import resolve
from taichi_msm.model.plan import Plan
from taichi_msm.model.surface import Surface, place_capsules, refine_surface, to_positions
from taichi_msm.render.labels import Flow, FrameOutputs, Labels, Sight
from taichi_msm.render.picking import pick
from taichi_msm.render.renderer import Array, CameraLike, Renderer, Shot
from taichi_msm.render.texture import require_texture
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.dynamics import ForceRecorder
from taichi_msm.solver.planning import steer_plan, with_current_paths
from taichi_msm.solver.rest import build_dynamics
from taichi_msm.solver.state import ProbeForces, Reading, RunProgress, Snapshot, TipForce, largest_displacement
from taichi_msm.system import runtime

if TYPE_CHECKING:
    pass  # REMOVED


# The kernels for drawing that were compiled in this process; to compile them by drawing takes as long as two frames.
_compiled: set[tuple[object, ...]] = set()


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
            forked after it; in most methods also when it is closed.
        ArgumentError: here and in all methods, when an argument is not what it must be.
        DeviceError: when the arch is not available, or the compiler already runs on another one in this process.
        SceneError: when the scene cannot be run, or no step meets its tolerance.

    Attributes:
        renderer: what draws and labels it.

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
        plan = check_scene(scene)
        texture = None if texture is None else require_texture(texture)
        self.device = runtime.start(arch, threads)
        self._plan = resolve(plan, self.device).plan
        # As they are before they are steered.
        self._probes = self.scene.probes
        self._watch: DivergenceMonitor
        self._gauge: ForceRecorder
        self._felt: ProbeForces
        self._placed: Array | None
        self._divergence: DivergedError | None
        self._closed, self._cores = False, cores
        self._dynamics = build_dynamics(self._plan, self.device, cores=cores)
        self._begin()
        self.renderer = Renderer(self.scene, texture)

    @property
    def scene(self) -> Scene:
        """The scene, with the points, the step and the precision that were chosen."""
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
        """Whether it was interrupted while steps were taken, so that only `restore` or `restart` make it whole."""
        return self._dynamics.inconsistent

    @property
    def lanes(self) -> int:
        """Lanes of the vectors that the steps are computed in; 1 on a GPU."""
        return self._dynamics.layout.config.lanes

    @property
    def workers(self) -> int:
        """Number of threads that share the steps while the cores are free; 0 on a GPU."""
        return self._dynamics.layout.workers

    @property
    def progress(self) -> RunProgress:
        """What is known of the run up to the last frame."""
        return self._watch.progress

    def advance(self, frames: int = 1, pause: Pause = lambda: None) -> None:
        """Simulate a number of frames, with the loads of the scene's keys.

        Args:
            frames: how many, 0 or more; 0 finds the shape of the first frame, where that is at rest under a load.
            pause: called some times a second, between steps; what it raises stops the simulation there, and the next
                call goes on from there.

        Raises:
            DivergedError: when the simulation diverges: a position is no longer finite, or exceeds every bound; or no
                shape is found in which the forces balance. `positions` and `draw` then give the last good frame.
        """
        require_frame_count(frames)
        self._require_open()
        self._find_first(pause)
        for _ in range(frames):
            self._go_to(self.frame + 1, pause)

    def steer(self, probes: Sequence[Probe | Mapping[str, Any] | None]) -> None:
        """Replace the loads, and where tools are moved to, from here on.

        Args:
            probes: the scene's probes with other numbers, or None for one that stays as it is. Each control point must
                move, jump or stand as before; for a tool that is to move later, give `at` as keys from the start, be it
                a single one. Of a tool that has a path take `{"path": [[t, across, down, height], ...]}` with times
                after `time`: it goes straight from where it is to the first of them. Its instrument, friction and grips
                stay, unless they are given too; a grip that has begun goes on if its beginning is among them.

        Raises:
            ArgumentError: when the kernel was not compiled for such probes.
            SceneError: when one of them is not a probe, or a tool would jump.
        """
        self._require_open()
        if not isinstance(probes, Sequence):
            raise ArgumentError(f"probes: {probes!r}; take a list of them")
        self._find_first()
        plan = steer_plan(self._plan, probes, self._plan.grid.time(self.steps))
        self._dynamics.steer(plan)
        self._watch.change_loads(plan)
        self._gauge = ForceRecorder(plan)
        self._plan, self.renderer.scene = plan, plan.scene

    def restart(self, scene: Plan | Scene | Mapping[str, Any] | None = None) -> None:
        """Begin again at rest. Nothing is compiled if the terms of the model and the precision stay the same.

        Args:
            scene: another one; None: the same.

        Raises:
            SceneError: as for `Simulation`.
        """
        self._require_open()
        motion = self.scene.time.motion
        if scene is not None:
            self._plan = resolve(check_scene(scene), self.device).plan
            self._probes = self.scene.probes
            self.renderer.restart(self.scene)
        else:
            self._follow_paths(self._probes)
        if self.scene.time.motion == motion:
            self._dynamics.restart(self._plan)
        else:
            self._dynamics.close()
            self._dynamics = build_dynamics(self._plan, self.device, cores=self._cores)
        self._begin()

    def save(self) -> Snapshot:
        """Save all that another simulation needs to continue from here.

        Raises:
            DivergedError: as for `advance`.
        """
        self._require_open()
        self._find_first()
        reading = self._dynamics.read()
        self._require_good(reading, self._watch.check(reading))
        return Snapshot(self._dynamics.state(), self.progress, self._felt, self.scene.probes)

    def restore(self, saved: Snapshot) -> None:
        """Continue from where a simulation of the same scene was saved, also between two frames; to the same bits.

        Raises:
            ArgumentError: when it was saved with other points or probes, another precision or another step.
        """
        self._require_open()
        if not isinstance(saved, Snapshot):
            raise ArgumentError(f"{type(saved).__name__} is not what `save` returns")
        state, per_frame = saved.state, self._plan.grid.steps_per_frame
        since = state.steps - saved.progress.frame * per_frame
        here = self._dynamics.displacement()
        alike = (state.displacement.shape, state.displacement.dtype) == (here.shape, here.dtype)
        if not (alike and len(saved.felt.forces) == len(self.scene.probes) and 0 <= since <= per_frame):
            raise ArgumentError(
                f"saved at step {state.steps}, frame {saved.progress.frame}, {state.displacement.dtype} of shape "
                f"{state.displacement.shape}; take what was saved with this scene's points, probes, precision and step"
            )
        if saved.probes:
            self._follow_paths(saved.probes)
        self._divergence = None
        self._dynamics.restart(self._plan, saved.state)
        self._placed = to_positions(self._dynamics.displacement(), self.scene.sheet)
        self._watch.progress, self._felt = saved.progress, saved.felt

    def positions(self) -> Array:
        """Give where the points are.

        Returns:
            Positions [m], shape (rows, cols, 3), in the scene's precision; not to be written to.
        """
        return self._position

    def forces(self) -> list[TipForce]:
        """Give what every probe does at the last frame: where its tip is, and its force on the sheet."""
        self._find_first()
        return list(self._felt.forces)

    @property
    def felt(self) -> ProbeForces:
        """The forces at the last frame that was found, and the greatest so far, as in `progress`."""
        return self._felt

    def velocities(self) -> Array:
        """Give the velocities of the points: the mean over the last step, so those half a step before `time`.

        Returns:
            Velocities [m/s], shape (rows, cols, 3), in the scene's precision; 0 at the start.
        """
        self._require_open()
        return self._dynamics.state().difference / self._position.dtype.type(self._plan.grid.step)

    def surface(self) -> Surface:
        """Give the refined surface as textured triangles: vertices, triangles, texture coordinates."""
        return refine_surface(self._position, self.scene.render.refine)

    def diagnose(self, start: Snapshot | None = None, pause: Pause = lambda: None) -> Diagnosis:
        """Find out why the simulation diverged in `advance`. Afterwards it can advance only after `restore`.

        Args:
            start: what `save` returned before; the simulation is repeated from there. None: from rest.
            pause: called some times a second; what it raises stops the search.

        Raises:
            MsmError: when the simulation has not diverged.
        """
        self._require_open()
        if self._divergence is None:
            raise MsmError("this simulation has not diverged; there is nothing to find out")
        if self.scene.time.at_rest:
            good = (
                None
                if self._placed is None
                else Snapshot(self._dynamics.state(), self.progress, self._felt, self.scene.probes)
            )
            return Diagnosis(str(self._divergence), good)
        return diagnose(self._dynamics, start, pause)

    def draw(
        self, camera: CameraLike = None, positions: Array | None = None, time: float | None = None
    ) -> NDArray[np.uint8]:
        """Draw the sheet as it is now, and the probes' instruments.

        Args:
            camera: the name of one of the scene's cameras, "top", "oblique", a `Camera` or its keys; None: the scene's,
                of several the main one.
            positions: other positions of the points [m], such as those of an earlier frame, shape (rows, cols, 3).
            time: time of these positions [s], for control points that move; None: now.

        Returns:
            Colours, shape (height, width, 3).

        Raises:
            SceneError: when the scene's picture cannot be read, or the camera is not valid.
            DeviceError: when the driver of a GPU ended part of the work early.
        """
        return self.renderer.draw(self._shot(camera, positions, time))

    def labels(self, camera: CameraLike = None, positions: Array | None = None, time: float | None = None) -> Labels:
        """Give what each pixel shows at its centre: the material point, depth, normal, whether it is an instrument.

        `camera`, `positions` and `time` are as for `draw`, here and in the methods below, and so are the errors.
        """
        return self.renderer.labels(self._shot(camera, positions, time))

    def flow(
        self, before: Labels, camera: CameraLike = None, positions: Array | None = None, time: float | None = None
    ) -> Flow:
        """Give the optical flow from an earlier or later frame to this one, and which of its material is now hidden.

        `before` is what `labels` returned for the other frame, with the same size of the picture; if another `camera`
        saw it, the flow is from that one's picture to this one's.
        """
        return self.renderer.flow(before, self._shot(camera, positions, time))

    def locate(
        self, coordinates: Array, camera: CameraLike = None, positions: Array | None = None, time: float | None = None
    ) -> Sight:
        """Find where material points are seen, and whether anything hides them; the inverse of `pick`.

        `coordinates` are fractions of the sheet's width from its left and of its height from its top, shape (n, 2).
        """
        return self.renderer.locate(coordinates, self._shot(camera, positions, time))

    def pick(self, pixel: tuple[float, float], camera: CameraLike = None) -> tuple[float, float] | None:
        """Find the material point that is seen at the centre of a pixel.

        `pixel` is x to the right and y down from the picture's top-left pixel, which is (0, 0).

        Returns:
            Fractions of the sheet's width from its left and of its height from its top, as in a probe's `at`;
            None if no surface is there.
        """
        point = as_array(pixel, "pixel")
        if not (is_real_array(point, (2,)) and np.isfinite(point).all()):
            raise ArgumentError(f"pixel: {pixel!r}; take two numbers, x to the right and y down")
        x, y = point.tolist()
        return pick(self._position, self.scene.render.refine, self.renderer.resolve_camera(camera, self.time), (x, y))

    def observe(
        self,
        before: Labels | None,
        camera: CameraLike = None,
        positions: Array | None = None,
        time: float | None = None,
    ) -> FrameOutputs:
        """Give all that the scene's output asks for of a frame; `before`: the labels of the frame before, if any."""
        return self.renderer.observe(before, self._shot(camera, positions, time))

    def play(self, frames: int, camera: CameraLike = None) -> Player:
        """Draw the present frame, simulate and draw that many more, and show them in a notebook."""
        pass  # REMOVED

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
        pass  # REMOVED

        rows, cols = self.scene.sheet.points
        largest = 1000 * self.progress.max_displacement
        caption = f"{self.time:g} s, {rows} × {cols} points, largest displacement so far {largest:.1f} mm"
        return captioned(self.draw(), caption)

    def compile(self, pause: Pause = lambda: None) -> None:
        """Compile the kernels now that would otherwise be compiled at the first frame.

        `pause` is called between kernels; what it raises stops here.
        """
        self._require_open()
        self._dynamics.compile()
        pause()
        if self.scene.renders and (kernels := self.renderer.kernels()) not in _compiled:
            position = to_positions(self._dynamics.displacement(), self.scene.sheet)
            for camera in self.scene.render.all_cameras:
                first = self.observe(None, camera, position)
                self.observe(first.labels, camera, position)
            _compiled.add(kernels)

    def close(self) -> None:
        """Free the memory. `positions` still gives the last frame."""
        runtime.require_start_thread()
        self._closed = True
        self._dynamics.close()
        self.renderer.close()

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> Any:
        remedy = "keep its `scene` and what `save` returns, and `restore` that in a new one"
        raise MsmError(f"a Simulation cannot be pickled or copied; {remedy}")

    @property
    def _position(self) -> Array:
        """Positions of the last frame [m], which is found first where it is at rest under a load."""
        self._find_first()
        assert self._placed is not None
        return self._placed

    def _find_first(self, pause: Pause = lambda: None) -> None:
        """Find the first frame, where it is at rest and that is yet to be done."""
        if self._placed is None:
            self._require_open()
            self._go_to(0, pause)

    def _go_to(self, frame: int, pause: Pause) -> None:
        """Simulate up to a frame."""
        try:
            self._dynamics.advance(frame * self._plan.grid.steps_per_frame - self.steps, pause)
        except DivergedError as error:
            self._divergence = error
            raise
        reading = self._dynamics.read()
        self._require_good(reading, self._watch.check_frame(reading))
        position = to_positions(reading.displacement, self.scene.sheet)
        self._felt = self._gauge.follow(self._felt, self.frame, position, self._dynamics.tool_forces())
        self._placed = position

    def _require_open(self) -> None:
        # The kernels would write to memory that was freed.
        if self._closed:
            raise MsmError("this simulation is closed; make another")
        runtime.require_start_thread()

    def _shot(self, camera: CameraLike, positions: Array | None, time: float | None) -> Shot:
        """Check positions and a time, place the instruments on the sheet, and set up the camera."""
        self._require_open()
        if positions is None:
            positions = self._position
        else:
            positions, shape = as_array(positions, "positions"), self._position.shape
            if not is_real_array(positions, shape):
                raise ArgumentError(
                    f"positions: {positions.dtype} of shape {positions.shape}; take numbers of shape {shape}"
                )
        if time is None:
            time = self.time
        elif not (is_real_array(as_array(time, "time"), ()) and math.isfinite(time)):
            raise ArgumentError(f"time: {time!r}; take a number, in seconds, or None for now")
        return Shot(positions, self.renderer.resolve_camera(camera, time), place_capsules(self.scene, positions, time))

    def _require_good(self, reading: Reading, fault: str) -> None:
        """Raise the error of a divergence, if there is a fault."""
        if fault:
            steps, time = reading.steps, self._plan.grid.time(reading.steps)
            point = largest_displacement(reading.displacement)[:2]
            self._divergence = DivergedError(
                divergence.format_message(time, steps, fault, exact=False), steps, time, point
            )
            raise self._divergence

    def _begin(self) -> None:
        """Begin with the flat sheet; at rest, the first frame is yet to be found."""
        self._divergence = None
        self._watch, self._gauge = DivergenceMonitor(self._plan), ForceRecorder(self._plan)
        self._felt = self._gauge.at_rest()
        flat = to_positions(self._dynamics.displacement(), self.scene.sheet)
        self._placed = None if self.scene.time.at_rest else flat

    def _follow_paths(self, probes: Sequence[Probe]) -> None:
        """Move tools along the paths that these probes have, in place of those that they were steered along."""
        self._plan = with_current_paths(self._plan, probes)
        self._gauge, self.renderer.scene = ForceRecorder(self._plan), self.scene


# The quality of JPEGs: some hundred frames fit into a notebook, and no difference from the picture is visible.
QUALITY = 92

_PAGE = Template("""\
<div id="$name">
  <img alt="frame" style="display: block; max-width: 100%" src="$first">
  <button type="button">Play</button>
  <input type="range" min="0" max="$last" value="0" style="vertical-align: middle; width: 20em">
  <output>0 s</output>
  <script>
    (() => {
      const root = document.getElementById("$name"), frames = $frames, rate = $rate;
      const [image, button, range, time] = ["img", "button", "input", "output"].map(tag => root.querySelector(tag));
      const show = () => {
        image.src = frames[range.value];
        time.value = (range.value / rate).toFixed(2) + " s";
      };
      let timer = null;
      range.oninput = show;
      button.onclick = () => {
        if (timer) {
          clearInterval(timer);
          timer = null;
        } else {
          timer = setInterval(() => { range.value = (+range.value + 1) % frames.length; show(); }, 1000 / rate);
        }
        button.textContent = timer ? "Pause" : "Play";
      };
    })();
  </script>
</div>""")

_names = count()


class Player:
    """Frames with a button and a slider, which a notebook shows as the value of a cell.

    At least one picture, all of one size, shape (height, width, 3), at a rate of frames per second.
    """

    def __init__(self, frames: Sequence[NDArray[np.uint8]], rate: float) -> None:
        self.frames = tuple(frames)
        if not self.frames:
            raise ArgumentError("frames: none; take at least one")
        self.rate = rate

    def _repr_html_(self) -> str:
        sources = [source(frame) for frame in self.frames]
        return _PAGE.substitute(
            name=f"taichi-msm-{next(_names)}",
            first=sources[0],
            last=len(sources) - 1,
            frames=sources,
            rate=f"{self.rate:g}",
        )


def source(picture: NDArray[np.uint8]) -> str:
    """Write a picture as a data URL."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{b64encode(file.getvalue()).decode()}"


def captioned(picture: NDArray[np.uint8], caption: str) -> str:
    """Write the HTML of a picture with a caption below it."""
    return f'<figure><img alt="" src="{source(picture)}"><figcaption>{escape(caption)}</figcaption></figure>'
