"""A session: it takes events, and gives the state of the tissue and its picture. It has no window and no clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DivergedError, FilesError, SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.load.resolve import resolve
from taichi_msm.load.yaml_reader import MAX_NODES
from taichi_msm.model.plan import Plan
from taichi_msm.model.surface import rod, rods, touched
from taichi_msm.model.tool_force import probe_force
from taichi_msm.model.tools import path_notes, path_problems
from taichi_msm.render.texture import load_texture
from taichi_msm.runs.media import Picture
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PROBES
from taichi_msm.solver.planning import variant, with_time
from taichi_msm.system import runtime
from taichi_msm.view import events, overlay
from taichi_msm.view.controller import Controller, Viewport
from taichi_msm.view.recording import Captures, Film, probe_values
from taichi_msm.view.tools import HeldTool, MovedTool, Place

# A session has at most this many frames per second, what a screen shows; each is a whole part of a frame of the scene.
MOST_FRAMES = 60.0

# A displacement below this share of the sheet's larger side is shown as 0.
AT_REST = 1e-6

# What stands between two figures.
SEPARATOR = "  ·  "

# How long a notice is shown [s].
NOTICE = 3.0

# The length of the recorded scene is checked once in this many frames; a warning comes at this share of the limit.
CHECKED = 200
NEARLY = 0.75

# The time of stepping is averaged over about this many frames.
AVERAGED = 20


def with_live_frames(plan: Plan) -> tuple[Plan, int]:
    """Divide a scene's frames into as many equal parts as a screen shows; give that plan, and the parts of a frame."""
    scene = plan.scene
    parts = max(1, int(MOST_FRAMES / scene.time.frames_per_second * (1 + 1e-9)))
    if scene.time.step != "auto":
        steps = plan.grid.steps_per_frame
        while steps % parts:
            parts -= 1
    return variant(plan, with_time(scene, frames_per_second=scene.time.frames_per_second * parts)), parts


class Session:
    """A person presses the tissue of a scene with a tool. Usable in a with statement, which saves a film that is on.

    The tool has the force, the falloff and the offset of the scene's first probe with a force. Held by position, it has
    the instrument and the friction of the first probe with a path, or else the first instrument. At first it is held as
    the scene's first probe is. If it is to `play`, the scene's own probes act as well. `progress` is called often with
    the name of the stage; what it raises stops the work there.

    Raises:
        SceneError: when the scene has no picture, no probe, or no room for another probe.
        DeviceError: when the arch is not available.

    Attributes:
        scene: the scene, with the frames and the step of the session.
        tool: the tool in the person's hand.
        viewport: how the tissue is shown.
        parts: how many frames of the session make one of the given scene's.
        paused: whether time stands still.
        fault: why the tissue no longer moves; empty while it does.
        seconds_a_frame: how long the steps of a frame take [s].
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
        live, self.parts = with_live_frames(check_scene(scene))
        plan = resolve(live, device, lambda done, total: progress("pilot")).plan
        scene = plan.scene
        self._captures = captures
        self._film: Film | None = None
        self._others = scene.probes if play else ()
        # Without outputs nothing is compiled for them.
        self._plan = replace(plan, scene=scene.model_copy(update={"output": ()}))
        self._by_force, self._by_position = _by_force(plan), _by_position(plan)
        tool = self._by_position if scene.probes[0].moved else self._by_force
        assert tool is not None
        self.tool = tool
        plan = self._with_tool(tool)
        self.scene = scene.model_copy(update={"probes": plan.scene.probes})
        self._figures, self._keys = True, False
        self._once = self._warned = self.paused = False
        # Frames that have passed, including those while it was paused.
        self._elapsed = 0
        self._notice, self._notice_until = "", 0
        self.fault = ""
        self.seconds_a_frame = 0.0
        # The largest force that the hand has felt since the tissue was at rest [N].
        self._hardest = 0.0
        progress("compile")
        self._simulation = Simulation(plan, arch, threads, texture)
        self._simulation.compile(lambda: progress("compile"))
        self._beginning = self._simulation.save()
        self.viewport = Viewport(self._simulation.renderer, play=play)
        self._controller = Controller(self.tool, self.viewport, self._simulation)
        self._draw()

    @property
    def rate(self) -> float:
        """Frames per second of the session."""
        return self.scene.time.frames_per_second

    @property
    def frame(self) -> int:
        """Frames simulated since the tissue was at rest."""
        return self._simulation.frame

    def positions(self) -> NDArray[np.floating]:
        """Positions of the points [m], shape (rows, cols, 3)."""
        return self._simulation.positions()

    def displacement(self) -> float:
        """Tell how far the tissue at the tool is from rest [m]."""
        return float(np.linalg.norm(self._touched() - [*self._rest_point(self.tool.place), 0.0]))

    def felt(self) -> float:
        """Tell the force that a hand feels which holds the tool by position, the mean over the last frame [N]."""
        if isinstance(self.tool, HeldTool):
            return 0.0
        return float(np.linalg.norm(self._simulation.forces()[-1].force))

    def recorded(self) -> Scene:
        """Give what was done as a scene; a run of it has the same bits."""
        # After a divergence, the frame in which it happened is part of the scene, whose run diverges as well.
        frames = max(1, self.frame + bool(self.fault))
        time = self.scene.time.model_copy(update={"duration": frames / self.rate, "tolerance": None})
        probes = (*self._others, self.tool.recorded(frames))
        return self.scene.model_copy(
            update={"probes": probes, "time": time, "render": self.viewport.recorded(time.duration)}
        )

    def handle(self, event: events.Event) -> None:
        """Do what an event asks for, from the next frame on; raises a FilesError when a file cannot be saved."""
        match event:
            case events.Hover(x, y):
                self._controller.hover(x, y)
            case events.Press(x, y, pull):
                if self._controller.press(x, y, -1 if pull else 1):
                    self._notice_until = 0
                else:
                    self.say(f"no tissue at pixel {x:g}, {y:g}")
            case events.Drag(x, y):
                self._controller.drag(x, y)
            case events.Release():
                self._controller.release()
            case events.Turn(right, down):
                self.viewport.turn(right, down)
                self._controller.hold_on()
            case events.Percent(percent):
                self.tool.ask(percent)
            case events.Harder(percent):
                self.handle(events.Percent(self.tool.strength + percent))
            case events.Key(name):
                self._do(name)

    def advance(self) -> None:
        """Let a frame's time pass: the tissue moves, unless it is paused."""
        self._elapsed += 1
        if (self.paused and not self._once) or self.fault:
            return
        self._once = False
        if self.frame % CHECKED == 0 and not self._warned and probe_values(self.recorded()) > NEARLY * MAX_NODES:
            self._warned = True
            self.say("this session will soon be too long for a scene: save it now (w), then reset it (r)")
        begun = time.perf_counter()
        try:
            if probe := self.tool.follow(self.frame):
                self._simulation.steer((*self._others, probe))
            self._simulation.advance()
            self._hardest = max(self._hardest, self.felt())
            if self.viewport.follow(self._simulation.time):
                self._controller.hold_on()
        except DivergedError as error:
            self.fault = str(error)
        spent = time.perf_counter() - begun
        share = 1 / AVERAGED if self.seconds_a_frame else 1.0
        self.seconds_a_frame += share * (spent - self.seconds_a_frame)

    def picture(self, pacing: str = "") -> Picture:
        """Draw the tissue, and write the texts over it, `pacing` among them: how fast pictures come.

        A film that is on takes the picture without texts; if it cannot, the film ends.
        """
        picture = self._draw()
        tool = self.tool
        hidden = isinstance(tool, MovedTool) or tool.percent == 0 or tool.probe.instrument is not None
        if not hidden and (pixel := self.viewport.pixel(self._touched())):
            overlay.mark(picture, pixel, pulls=self._pulls)
        if self._film is not None:
            try:
                self._film.show(picture, self._elapsed)
            except FilesError as error:
                self._film.close()
                self._film = None
                self.say(str(error))
        above = self._figure_lines(pacing) if self._figures else ["paused"] if self.paused else []
        keys, bar = (events.POINTER | events.KEYS if self._keys else None), None
        # A small picture has no room for both.
        if self._figures and self._hardest > 0 and keys is None:
            bar = overlay.Bar(self.felt(), self._hardest, "N")
        overlay.write(picture, above, self.notice, keys, bar)
        return picture

    def say(self, notice: str) -> None:
        """Show a notice for a few seconds."""
        self._notice, self._notice_until = notice, self._elapsed + round(NOTICE * self.rate)

    @property
    def notice(self) -> str:
        """The notice that is shown now."""
        return self._notice if self._elapsed < self._notice_until else self.fault

    def close(self) -> None:
        """Save the film that is on, and free the memory."""
        self._simulation.close()
        self._end_film()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _draw(self) -> Picture:
        """Draw the tissue and the instruments; the tool's is where the tool acts, or would if it were pressed."""
        positions, scene = self.positions(), self._simulation.scene
        instruments = rods(scene, positions, self._simulation.time)
        instrument = scene.probes[-1].instrument
        if instrument is not None and (place := self._controller.over()):
            instruments[-1] = rod(instrument, scene, positions, self._rest_point(place))
        return self.viewport.draw(positions, instruments)

    def _rest_point(self, place: Place) -> NDArray[np.float64]:
        """Give x and y of a place on the sheet at rest [m]."""
        (across, down), (height, width) = place, self.scene.sheet.size
        return np.array([(across - 0.5) * width, (0.5 - down) * height])

    def _touched(self) -> NDArray[np.float64]:
        """Find the point of the sheet at which the tool acts [m]."""
        rest = self._rest_point(self.tool.place)
        return touched(self.positions(), self.scene.render.refine, self.scene.sheet, rest)[0]

    def _do(self, key: str) -> None:
        match key:
            case "up":
                self.handle(events.Harder(events.NOTCH))
            case "down":
                self.handle(events.Harder(-events.NOTCH))
            case "c" | "t" | "o":
                self.viewport.look({"c": self.scene.render.main_camera, "t": "top", "o": "oblique"}[key])
                self._controller.hold_on()
            case "m":
                self.viewport.mesh()
            case "l":
                self.viewport.light()
            case "space":
                self.paused, self._once = not self.paused, False
            case ".":
                self._once = self.paused
            case "r":
                self._controller.forget()
                self._simulation.restore(self._beginning)
                self._simulation.steer((*self._others, self.tool.recorded(0)))
                self.viewport.follow(0.0)
                self._begin()
            case "f":
                self._switch()
            case "p":
                self.say(f"saved {self._captures.save_picture(self._draw())}")
            case "g":
                if self._film is None:
                    rate = self.rate / self.parts
                    self._film = Film(self._captures.folder, self.scene.render, rate, self.parts, self._elapsed)
                else:
                    self._end_film()
            case "w":
                self.say(f"saved {self._captures.save_scene(self.recorded())}")
            case "i":
                self._figures = not self._figures
            case "h":
                self._keys = not self._keys

    def _with_tool(self, tool: HeldTool | MovedTool) -> Plan:
        """Plan the scene with a tool at rest; SceneError: it cannot be held by position."""
        plan = self._plan.with_probes((*self._others, tool.recorded(0)))
        mine = [own for own in plan.tools if own.probe == len(self._others)]
        if any(path_problems(plan.scene, mine, plan.grid)):
            raise SceneError(
                ["this tool cannot be held by position: its shaft leads down into the sheet; let it lead up"]
            )
        return plan

    def _switch(self) -> None:
        """Hold the other tool, with the tissue at rest again."""
        tool = self._by_position if isinstance(self.tool, HeldTool) else self._by_force
        if tool is None:
            needs = "an instrument" if isinstance(self.tool, HeldTool) else "a force"
            self.say(f"a tool that is held so needs {needs}; give a probe of the scene one")
            return
        try:
            plan = self._with_tool(tool)
        except SceneError as error:
            self.say(error.lines[0])
            return
        self._controller.forget()
        self._simulation.restart(plan)
        self._simulation.compile()
        self._beginning = self._simulation.save()
        self.tool = self._controller.tool = tool
        self.seconds_a_frame = 0.0
        self._begin()
        mine = [own for own in plan.tools if own.probe == len(self._others)]
        self.say("; ".join(path_notes(plan.scene, mine)))

    def _begin(self) -> None:
        """Forget what was said and felt of the session so far."""
        self._once = self._warned = False
        self._hardest, self.fault = 0.0, ""

    def _end_film(self) -> None:
        """End the film that is on, and save it if it has a picture."""
        film, self._film = self._film, None
        if film is None:
            return
        if film.pictures > 0:
            self.say(f"saved {self._captures.save_film(film)}")
        else:
            film.close()
            self.say("no film was saved: it had no picture yet")

    @property
    def _pulls(self) -> bool:
        """Whether the force of the tool points away from the sheet; a scene's force may do so by itself."""
        tool = self.tool
        return isinstance(tool, HeldTool) and tool.percent * probe_force(tool.probe, self.scene.sheet).force[2] > 0

    def _figure_lines(self, pacing: str) -> list[str]:
        speed = ""
        if self.seconds_a_frame > 0:
            speed = f"steps {1 / self.rate / self.seconds_a_frame:.2g} x real time"
        state = [word for word, on in (("paused", self.paused), ("film", self._film is not None)) if on]
        lines = self._of_tool(), [pacing, speed, *state]
        return [SEPARATOR.join(part for part in line if part) for line in lines]

    def _of_tool(self) -> list[str]:
        """Tell what the tool does."""
        tool = self.tool
        if isinstance(tool, MovedTool):
            height = tool.height if tool.held else -tool.depth
            does = "grip" if tool.grips else "press" if tool.held else "next press"
            return [f"{does} {length(abs(height))} {'up' if height > 0 else 'deep'}", newtons(self.felt())]
        does = "pull" if self._pulls else "push"
        percent = f"{does} {abs(tool.percent):.0f} %" if tool.percent else f"tool {tool.strength:.0f} %"
        moved = self.displacement()
        # Smaller displacements are rounding errors of positions in f32.
        return [percent, length(moved if moved > AT_REST * max(self.scene.sheet.size) else 0.0)]


def _require_usable(scene: Scene, *, play: bool) -> None:
    faults = {
        "image: missing; a session needs one, name it here or with --image": scene.image is None,
        "probes: empty; the tool takes its force from the first probe, add one": not scene.probes,
        f"probes: {MAX_PROBES} leave no room for the tool; remove one, or leave out --play": play
        and len(scene.probes) == MAX_PROBES,
    }
    if any(faults.values()):
        raise SceneError([message for message, is_so in faults.items() if is_so])


def _by_force(plan: Plan) -> HeldTool | None:
    """Make the tool that is held by force, if a probe has one."""
    probe = next((probe for probe in plan.scene.probes if not probe.moved), None)
    return HeldTool(probe, plan.grid.frames_per_second) if probe else None


def _by_position(plan: Plan) -> MovedTool | None:
    """Make the tool that is held by position, if a probe has an instrument; one that is moved comes first."""
    probes = sorted(plan.scene.probes, key=lambda probe: not probe.moved)
    probe = next((probe for probe in probes if probe.instrument is not None), None)
    return MovedTool(probe, plan) if probe else None


def newtons(force: float) -> str:
    """Write a force [N] with two digits, or all before the point."""
    return f"{force:.2g} N" if force < 10 else f"{force:.0f} N"


def length(metres: float) -> str:
    """Write a length in a readable unit."""
    if metres == 0 or 1e-7 <= metres < 1:
        return f"{1e3 * metres:.3g} mm"
    return f"{metres:.3g} m"
