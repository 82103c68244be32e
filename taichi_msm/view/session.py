"""Interactive session: event handling, simulation and picture, independent of a page and a clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DivergedError, FilesError, SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.load.resolve import resolve
from taichi_msm.load.yaml_reader import MAX_NODES
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import place_instrument, place_instruments, surface_point
from taichi_msm.model.tool_force import probe_directions
from taichi_msm.model.tools import path_problems, path_warnings
from taichi_msm.render.picking import pick_at_rest
from taichi_msm.render.texture import load_texture
from taichi_msm.runs.media import Picture
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.framing import keep_picture_camera
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PROBES
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import plan_variant, with_time
from taichi_msm.system import runtime
from taichi_msm.system.process import available_threads
from taichi_msm.view import events, overlay
from taichi_msm.view.material import MAX_FACTOR, material_values, with_value
from taichi_msm.view.recording import Captures, Film, count_probe_values
from taichi_msm.view.tools import ForceControlledTool, PositionControlledTool, SheetPosition, clear_start
from taichi_msm.view.viewport import Viewport

# Largest frame rate of a session, that of a common screen [1/s].
MAX_FRAME_RATE = 60.0

NOTICE_DURATION_S = 3.0


def divide_frames(plan: Plan) -> tuple[Plan, int]:
    """Divide every frame of a plan into the largest number of subframes within `MAX_FRAME_RATE`; return both.

    In motion, `precision: auto` without a tolerance becomes f32, which takes half the time of f64.
    """
    scene = plan.scene
    subframes = max(1, int(MAX_FRAME_RATE / scene.time.frames_per_second * (1 + 1e-9)))
    if scene.time.step != "auto":
        steps = plan.grid.steps_per_frame
        while steps % subframes:
            subframes -= 1
    changes: dict[str, Any] = {"frames_per_second": scene.time.frames_per_second * subframes}
    if scene.time.precision == "auto" and scene.time.tolerance is None and not scene.time.at_rest:
        changes["precision"] = "f32"
    return plan_variant(plan, with_time(scene, **changes)), subframes


class Session(AbstractContextManager["Session"]):
    """Interactive simulation of a scene with a tool; a context manager that saves a running film on exit.

    There are up to two tools. The force-controlled one has the force, falloff and offset of the first probe with a
    force. The position-controlled one has the instrument and friction of the first probe with a path, otherwise of the
    first probe with an instrument. The first probe that is not a clamp decides which one is used first. Clamps always
    hold the sheet; with `play`, the scene's other probes act in addition to the tool.

    `progress` is called often with the stage; an exception from it stops the construction.
    """

    def __init__(
        self,
        scene: Scene,
        captures: Captures,
        arch: str = "cpu",
        threads: int | None = None,
        *,
        play: bool = False,
        progress: Callable[[str], None] = lambda stage: None,
    ) -> None:
        _require_usable(scene, play=play)
        progress("start")
        device = runtime.start(arch, threads)
        texture = load_texture(scene)
        # Frames of the session per frame of the given scene; `self.scene` has those of the session.
        live, self.subframes = divide_frames(check_scene(scene))
        plan = resolve(live, device, lambda done, total: progress("pilot")).plan
        scene = plan.scene
        self.captures = captures
        self._film: Film | None = None
        self._film_path: Path | None = None
        self._scene_probes = tuple(probe for probe in scene.probes if play or probe.clamp is not None)
        # Without outputs, whose kernels would be compiled.
        self._plan = replace(plan, scene=scene.model_copy(update={"output": ()}))
        self._force_tool = _force_tool(plan, self._scene_probes)
        self._position_tool = _position_tool(plan, self._scene_probes)
        first = next(probe for probe in scene.probes if probe.clamp is None)
        tool = self._position_tool if first.moved else self._force_tool
        assert tool is not None
        self.tool = tool
        plan = self._with_tool(tool)
        self.scene = scene.model_copy(update={"probes": plan.scene.probes})
        self.frame_rate = scene.time.frames_per_second  # of the session [1/s]
        self._show_readings, self._show_keys, self.paused = True, False, False
        # Elapsed frames, including those of pauses.
        self._elapsed = 0
        self._notice, self._notice_until = "", 0
        # Moving average of the time to simulate a frame [s].
        self._frame_time_s = 0.0
        self._reset_status()
        progress("compile")
        # One core is left for the browser: workers spin while they wait for each other.
        self._simulation = Simulation(plan, arch, threads, texture, max(1, available_threads() - 1))
        self._simulation.compile(lambda: progress("compile"))
        self._scene_material = material_values(scene)
        self.viewport = Viewport(self._simulation.renderer, play=play)
        self._pointer = (0.0, 0.0)
        self._hover_pixel: tuple[float, float] | None = None
        # Start of a drag: position of the tool, and that of the sheet at rest under the pointer.
        self._drag_start: tuple[SheetPosition, SheetPosition | None] | None = None
        self._draw()

    def _reset_status(self) -> None:
        self._single_step = self._has_warned_of_length = self._material_changed = False
        self._max_felt_force = 0.0  # since the last reset [N]
        self.divergence_error = ""  # message of the divergence that stopped the simulation

    @property
    def frame(self) -> int:
        """Number of frames simulated since the last reset."""
        return self._simulation.frame

    def positions(self) -> NDArray[np.floating]:
        """Return the positions of the mass points [m], shape (rows, cols, 3)."""
        return self._simulation.positions()

    def displacement(self) -> float:
        """Return the displacement of the tissue at the tool [m]."""
        return float(np.linalg.norm(self._motion_at_tool()))

    def depth(self) -> float:
        """Return the depth of the tissue at the tool, below the sheet at rest [m]; negative above it."""
        return -float(self._motion_at_tool() @ self._normal())

    def tool_force(self) -> float:
        """Return the force between tool and tissue in the last frame [N]."""
        return float(np.linalg.norm(self._simulation.forces()[-1].force))

    def felt_force(self) -> float:
        """Return the force on a position-controlled tool in the last frame [N]; 0 for the force-controlled one."""
        return 0.0 if isinstance(self.tool, ForceControlledTool) else self.tool_force()

    def material(self) -> dict[str, tuple[float, float]]:
        """Return the current and the initial value by key that an event `Material` can change."""
        current = material_values(self.scene)
        return {key: (current[key], initial) for key, initial in self._scene_material.items()}

    def recorded_scene(self) -> Scene:
        """Return the session as a scene; its run is bit-identical to the session."""
        # The frame of a divergence is included, so that the run diverges too.
        frames = max(1, self.frame + bool(self.divergence_error))
        time = self.scene.time.model_copy(update={"duration": frames / self.frame_rate, "tolerance": None})
        probes = (*self._scene_probes, self.tool.recorded_probe(frames))
        sheet, render = keep_picture_camera(
            self.scene.sheet, self.scene.render, self.viewport.recorded_render(time.duration)
        )
        return self.scene.model_copy(update={"probes": probes, "time": time, "render": render, "sheet": sheet})

    def handle(self, event: events.Event) -> None:
        """Process an event, with effect from the next frame on; raise a FilesError if a file cannot be saved."""
        try:
            self._process(event)
        except (SceneError, DivergedError) as error:
            self.show_notice(str(error))

    def _process(self, event: events.Event) -> None:
        """Process an event; a SceneError or DivergedError is the reason why it has no effect."""
        match event:
            case events.Hover(x, y):
                self._hover_pixel = x, y
                if isinstance(self.tool, PositionControlledTool) and (position := self._rest_position(x, y)):
                    self.tool.move(position)
            case events.Press(x, y, pull):
                self._press(x, y, -1 if pull else 1)
            case events.Drag(x, y):
                self._drag(x, y)
            case events.Release():
                self._forget_pointer()
                if self.tool.engaged:
                    self.tool.release()
            case events.Turn(right, down):
                self.viewport.turn(right, down)
                self._rebase_drag()
            case events.Strength(percent):
                self.tool.set_strength(percent)
            case events.StrengthChange(percent):
                self.tool.set_strength(self.tool.strength + percent)
            case events.Key(name):
                self._handle_key(name)
            case events.Material(key, value):
                self._change_material(key, value)

    def advance(self) -> None:
        """Advance by a frame; simulate it unless the session is paused or has diverged."""
        self._elapsed += 1
        if (self.paused and not self._single_step) or self.divergence_error:
            return
        self._single_step = False
        # The warning comes at three quarters of the limit of a scene file.
        if self.frame % 200 == 0 and not self._has_warned_of_length:
            self._has_warned_of_length = count_probe_values(self.recorded_scene()) > 0.75 * MAX_NODES
            if self._has_warned_of_length:
                self.show_notice("this session will soon be too long for a scene: save it now (w), then reset it (r)")
        start = time.perf_counter()
        try:
            self._simulation.steer((*self._scene_probes, self.tool.advance(self.frame)))
            self._simulation.advance()
            self._max_felt_force = max(self._max_felt_force, self.felt_force())
            if self.viewport.set_time(self._simulation.time):
                self._rebase_drag()
        except DivergedError as error:
            self.divergence_error = str(error)
        duration = time.perf_counter() - start
        # Exponential moving average over about 20 frames.
        weight = 1 / 20 if self._frame_time_s else 1.0
        self._frame_time_s += weight * (duration - self._frame_time_s)

    @property
    def load(self) -> float:
        """Time of stepping per simulated time."""
        return self._frame_time_s * self.frame_rate

    @property
    def filming(self) -> bool:
        """Whether a film is running."""
        return self._film is not None

    def start_film(self, path: Path | None = None) -> None:
        """Start a film, which is saved when it ends, by default under a free name in the folder of captures."""
        file, option = (self.captures.folder / "film.gif", "--out") if path is None else (path, "--record")
        self._film = Film(file, option, self.scene.render, self.frame_rate, self.subframes, self._elapsed)
        self._film_path = path
        if path is not None:
            # So a session that ends at once has a film.
            self._film.add_frame(self._draw(), self._elapsed)

    def picture(self) -> Picture:
        """Draw a picture with the overlay, shape (height, width, 3); a running film gets it without text."""
        picture = self.bare_picture()
        above = self._reading_lines() if self._show_readings else ["paused"] if self.paused else []
        keys, bar = (events.POINTER | events.KEYS if self._show_keys else None), None
        # A small picture has no space for both.
        if self._show_readings and self._max_felt_force > 0 and keys is None:
            bar = overlay.ValueBar(self.felt_force(), self._max_felt_force, "N")
        overlay.write_text(picture, above, self.notice, keys, bar)
        return picture

    def bare_picture(self, size: tuple[int, int] | None = None) -> Picture:
        """Draw a picture with a ring at a tool without an instrument; a running film gets it, too.

        Without a film, the picture may have another size of the same aspect, (width, height) [px].
        """
        picture = self._draw(None if self.filming else size)
        tool = self.tool
        has_ring = isinstance(tool, ForceControlledTool) and tool.percent != 0 and tool.probe.instrument is None
        if has_ring and (pixel := self.viewport.project(self._touched_point())):
            factor = picture.shape[0] / self.scene.render.size[1]
            overlay.mark_tool(picture, (factor * pixel[0], factor * pixel[1]), pulls=self._pulls)
        if self._film is not None:
            try:
                self._film.add_frame(picture, self._elapsed)
            except FilesError as error:
                self._film.close()
                self._film = None
                self.show_notice(str(error))
        return picture

    def show_notice(self, notice: str) -> None:
        """Show a notice for `NOTICE_DURATION_S`."""
        self._notice, self._notice_until = notice, self._elapsed + round(NOTICE_DURATION_S * self.frame_rate)

    @property
    def notice(self) -> str:
        """Current notice; without one, the message of a divergence, or empty."""
        return self._notice if self._elapsed < self._notice_until else self.divergence_error

    def close(self) -> None:
        """Save a running film, and release the memory."""
        self._simulation.close()
        self._end_film()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _draw(self, size: tuple[int, int] | None = None) -> Picture:
        """Draw the tissue and the instruments; an idle force-controlled tool is drawn at the pointer.

        `size` is width and height of the picture [px], by default those of the scene.
        """
        positions, scene = self.positions(), self._simulation.scene
        instruments = place_instruments(scene, positions, self._simulation.time)
        instrument = scene.probes[-1].instrument
        if instrument is not None and (position := self._hover_position()):
            instruments[-1] = place_instrument(instrument, scene, positions, self._coordinates(position))
        return self.viewport.draw(positions, instruments, size)

    def _coordinates(self, position: SheetPosition) -> NDArray[np.float64]:
        """Return the coordinates at rest of a position, see `Rest`, shape (2,)."""
        return rest_of(self.scene.sheet).coordinates(np.array(position))

    def _touched_point(self) -> NDArray[np.float64]:
        """Return the point of the sheet at which the tool acts [m], shape (3,)."""
        at = self._coordinates(self.tool.position)
        return surface_point(self.positions(), self.scene.render.refine, self.scene.sheet, at)[0]

    def _motion_at_tool(self) -> NDArray[np.float64]:
        """Return the displacement of the point at which the tool acts [m], shape (3,)."""
        at = self._coordinates(self.tool.position)
        return self._touched_point() - rest_of(self.scene.sheet).place(at[None])[0]

    def _normal(self) -> NDArray[np.float64]:
        """Return the unit normal of the sheet at rest at the tool, shape (3,)."""
        return rest_of(self.scene.sheet).normals(self._coordinates(self.tool.position)[None])[0]

    def _press(self, x: float, y: float, direction: int) -> None:
        """Press the tissue at a pixel; with direction -1 instead of 1, pull or grip it.

        A force-controlled tool acts at the material point that is visible there, a position-controlled one at the point
        of the sheet at rest.
        """
        position = self._simulation.pick((x, y), self.viewport.view)
        if position is None:
            raise SceneError([f"no tissue at pixel {x:g}, {y:g}"])
        if isinstance(self.tool, PositionControlledTool):
            position = self._rest_position(x, y) or self.tool.target
        self.tool.press(position, direction)
        self._pointer = x, y
        self._drag_start = position, self._rest_position(x, y)
        self._notice_until = 0

    def _drag(self, x: float, y: float) -> None:
        """Move the pressing tool by the displacement of the pointer on the sheet at rest.

        On the deformed sheet, which moves with the tool, there would be feedback.
        """
        if self._drag_start is None:
            return
        self._pointer = x, y
        ((across, down), start), end = self._drag_start, self._rest_position(x, y)
        if start is not None and end is not None:
            self.tool.move((across + (end[0] - start[0]), down + (end[1] - start[1])))

    def _rebase_drag(self) -> None:
        """Restart a drag at the current position of the tool, after the camera has moved."""
        if self._drag_start is not None:
            self._drag_start = self.tool.target, self._rest_position(*self._pointer)

    def _forget_pointer(self) -> None:
        self._drag_start = self._hover_pixel = None

    def _hover_position(self) -> SheetPosition | None:
        """Return the position under the pointer, for an idle force-controlled tool; None for other tools."""
        if isinstance(self.tool, PositionControlledTool) or self.tool.engaged or self.tool.percent != 0:
            return None
        return None if self._hover_pixel is None else self._simulation.pick(self._hover_pixel, self.viewport.view)

    def _rest_position(self, x: float, y: float) -> SheetPosition | None:
        """Return the position on the sheet at rest at a pixel; None if it is not visible there."""
        return pick_at_rest(self.scene.sheet, self.scene.render.refine, self.viewport.view, (x, y))

    def _handle_key(self, key: str) -> None:
        match key:
            case "up" | "down":
                step = events.STRENGTH_STEP if key == "up" else -events.STRENGTH_STEP
                self.tool.set_strength(self.tool.strength + step)
            case "c" | "t" | "o":
                self.viewport.set_camera({"c": self.scene.render.main_camera, "t": "top", "o": "oblique"}[key])
                self._rebase_drag()
            case "m":
                self.viewport.toggle_mesh()
            case "l":
                self.viewport.toggle_light()
            case "space":
                self.paused, self._single_step = not self.paused, False
            case ".":
                self._single_step = self.paused
            case "r":
                self.tool.reset()
                self._forget_pointer()
                self._simulation.restart(self._with_tool(self.tool))
                self.viewport.set_time(0.0)
                self._reset_status()
            case "f":
                self._switch()
            case "p":
                self.show_notice(f"saved {self.captures.save_picture(self._draw())}")
            case "g":
                if self._film is None:
                    self.start_film()
                else:
                    self._end_film()
            case "w" if self._material_changed:
                raise SceneError(["a scene cannot contain a changed material: reset (r) and repeat the session"])
            case "w":
                self.show_notice(f"saved {self.captures.save_scene(self.recorded_scene())}")
            case "i":
                self._show_readings = not self._show_readings
            case "h":
                self._show_keys = not self._show_keys

    def _with_tool(self, tool: ForceControlledTool | PositionControlledTool) -> Plan:
        """Plan the scene with an idle tool; raise a SceneError if the tool cannot be position-controlled."""
        plan = self._plan.with_probes((*self._scene_probes, tool.recorded_probe(0)))
        session_tools = [tool for tool in plan.tools if tool.probe == len(self._scene_probes)]
        if any(path_problems(plan.scene, session_tools, plan.grid)):
            fault = "this tool cannot be position-controlled: its shaft points down into the sheet; turn it up"
            raise SceneError([fault])
        return plan

    def _switch(self) -> None:
        by_force = isinstance(self.tool, ForceControlledTool)
        tool = self._position_tool if by_force else self._force_tool
        if tool is None:
            needs = "position needs an instrument" if by_force else "force needs a force"
            raise SceneError([f"control by {needs}; add it to a probe of the scene"])
        plan = self._with_tool(tool)
        self.tool.reset()
        self._forget_pointer()
        self._simulation.restart(plan)
        self._simulation.compile()
        self.tool = tool
        self._frame_time_s = 0.0
        self._reset_status()
        session_tools = [tool for tool in plan.tools if tool.probe == len(self._scene_probes)]
        self.show_notice("; ".join(path_warnings(plan.scene, session_tools)))

    def _change_material(self, key: str, value: float) -> None:
        """Change a value of the material; later resets keep it."""
        if (initial := self._scene_material.get(key)) is None:
            raise SceneError([f"{key}: missing or 0 in this scene"])
        # The margin allows for rounding.
        if not initial / MAX_FACTOR * 0.999 <= value <= initial * MAX_FACTOR * 1.001:
            raise SceneError([f"{key}: {value:g} is not from {initial / MAX_FACTOR:g} to {initial * MAX_FACTOR:g}"])
        if self.divergence_error:
            raise SceneError(["the simulation diverged: reset it (r) first"])
        plan = check_scene(with_value(self._plan.scene, key, value), self._plan.maps)
        self._simulation.change_material(plan)
        self._plan, self._material_changed = plan, True
        self.scene = with_value(self.scene, key, value)
        if self._position_tool is not None:
            self._position_tool.grid = plan.grid

    def _end_film(self) -> None:
        film, self._film = self._film, None
        if film is None:
            return
        if film.pictures > 0:
            self.show_notice(f"saved {self.captures.save_film(film, self._film_path)}")
        else:
            film.close()
            self.show_notice("no film was saved: it had no picture yet")

    @property
    def _pulls(self) -> bool:
        """Whether the tool pulls, by its direction or the sign of the probe's force."""
        if not isinstance(self.tool, ForceControlledTool):
            return False
        at = self._coordinates(self.tool.position)
        (force,) = probe_directions(self.tool.probe, self.scene.sheet, at[None])
        return bool(self.tool.percent * (force @ self._normal()) > 0)

    def _reading_lines(self) -> list[str]:
        speed = f"steps {1 / self.load:.2g} x real time" if self.load > 0 else ""
        state = [speed, "paused" if self.paused else "", "film" if self.filming else ""]
        return ["  ·  ".join(filter(None, line)) for line in (self._tool_readings(), state)]

    def _tool_readings(self) -> list[str]:
        tool = self.tool
        if isinstance(tool, PositionControlledTool):
            height = tool.height if tool.engaged else -tool.depth
            action = "grip" if tool.gripping else "press" if tool.engaged else "next press"
            direction = "up" if height > 0 else "deep"
            return [f"{action} {format_length(abs(height))} {direction}", format_force(self.felt_force())]
        action = "pull" if self._pulls else "push"
        percent = f"{action} {abs(tool.percent):.0f} %" if tool.percent else f"tool {tool.strength:.0f} %"
        displacement = self.displacement()
        # Smaller displacements are rounding errors of f32.
        return [percent, format_length(displacement if displacement > 1e-6 * rest_of(self.scene.sheet).extent else 0.0)]


def _require_usable(scene: Scene, *, play: bool) -> None:
    errors = {
        "image: missing; a session needs a picture, set it here or with --image": scene.image is None,
        "probes: empty; the tool takes its force from the first probe, add one": not scene.probes,
        "probes: a clamp is not a tool of a session; add a probe with a force": bool(scene.probes)
        and all(probe.clamp is not None for probe in scene.probes),
        f"probes: {MAX_PROBES} leave no room for the tool; remove one, or leave out --play": play
        and len(scene.probes) == MAX_PROBES,
    }
    if any(errors.values()):
        raise SceneError([message for message, applies in errors.items() if applies])


def _force_tool(plan: Plan, scene_probes: Sequence[Probe]) -> ForceControlledTool | None:
    """Build the force-controlled tool; None if no probe has a force."""
    probe = next((probe for probe in plan.scene.probes if not probe.moved), None)
    if probe is None:
        return None
    start = clear_start(probe, scene_probes, plan.scene)
    return ForceControlledTool(probe, plan.grid.frames_per_second, start, rest_of(plan.scene.sheet))


def _position_tool(plan: Plan, scene_probes: Sequence[Probe]) -> PositionControlledTool | None:
    """Build the position-controlled tool; None if no probe has an instrument."""
    probes = sorted(plan.scene.probes, key=lambda probe: not probe.moved)
    probe = next((probe for probe in probes if probe.instrument is not None), None)
    return None if probe is None else PositionControlledTool(probe, plan, clear_start(probe, scene_probes, plan.scene))


def format_force(force: float) -> str:
    """Format a force [N] with at least two digits."""
    return f"{force:.2g} N" if force < 10 else f"{force:.0f} N"


def format_length(metres: float) -> str:
    """Format a length [m] with three digits in um, mm or m."""
    if 0 < metres < 0.9995e-5:
        return f"{1e6 * metres:.3g} um"
    return f"{metres:.3g} m" if metres >= 0.9995 else f"{1e3 * metres:.3g} mm"
