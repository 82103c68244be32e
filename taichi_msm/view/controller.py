"""The pointer over the picture of a simulation, which moves the tool in the hand.

How the tissue is shown: the camera, the light and the mesh, which a person may change while it moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Capsule
from taichi_msm.render.camera import View, frozen_camera, orbit_camera, pinhole, view
from taichi_msm.render.picking import intersect_rest_plane
from taichi_msm.render.renderer import Renderer, Shot
from taichi_msm.runs.media import Picture
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.render import AnyCamera, Render
from taichi_msm.view.tools import HeldTool, MovedTool, Place

pass  # REMOVED


class Controller:
    """Moves a tool with a pointer over the picture of a simulation.

    A tool that is held by force acts on the material that is seen under the pointer. One that is held by position is in
    space: above the point of the sheet at rest that is under the pointer, or as deep below it.

    Attributes:
        tool: the tool; may be replaced by another one while nothing is held.
    """

    def __init__(self, tool: HeldTool | MovedTool, viewport: Viewport, simulation: Simulation) -> None:
        self.tool = tool
        self._viewport = viewport
        self._simulation = simulation
        # Where a drag begins: the place of the tool, and the point of the rest plane that was then under the pointer.
        self._held: tuple[Place, NDArray[np.floating] | None] | None = None
        self._pointer = (0.0, 0.0)
        self._hovering: tuple[float, float] | None = None

    def press(self, x: float, y: float, direction: int) -> bool:
        """Press (1), or pull or grip (-1), what is seen at a pixel; returns whether there is anything."""
        place = self._simulation.pick((x, y), self._viewport.view)
        if place is None:
            return False
        if isinstance(self.tool, MovedTool):
            place = self._at_rest(x, y) or self.tool.goal
        self.tool.press(place, direction)
        self._pointer = x, y
        self._held = place, intersect_rest_plane(self._viewport.view, self._pointer)
        return True

    def over(self) -> Place | None:
        """Find the place on the sheet where a tool held by force would press; None if there is none, or it presses."""
        if isinstance(self.tool, MovedTool) or self.tool.held or self.tool.percent != 0 or self._hovering is None:
            return None
        return self._simulation.pick(self._hovering, self._viewport.view)

    def hover(self, x: float, y: float) -> None:
        """Note where a pointer is that presses nothing; a tool held by position goes there."""
        self._hovering = x, y
        if isinstance(self.tool, MovedTool) and (place := self._at_rest(x, y)):
            self.tool.move(place)

    def drag(self, x: float, y: float) -> None:
        """Move the control point as far over the sheet at rest as the pointer moved.

        The deformed sheet cannot serve for this: it gives way to the tool, so each move would cause another.
        """
        if self._held is None:
            return
        self._pointer = x, y
        ((across, down), begun), here = self._held, intersect_rest_plane(self._viewport.view, self._pointer)
        if begun is None or here is None:
            return
        (right, up), (height, width) = here - begun, self._simulation.scene.sheet.size
        self.tool.move((across + right / width, down - up / height))

    def release(self) -> None:
        """Let go."""
        self._held = self._hovering = None
        if self.tool.held:
            self.tool.release()

    def hold_on(self) -> None:
        """Keep the tool where it is after the camera moved; a drag goes on from there."""
        if self._held is not None:
            self._held = self.tool.goal, intersect_rest_plane(self._viewport.view, self._pointer)

    def forget(self) -> None:
        """Put the tool at rest."""
        self.tool.rest()
        self._held = self._hovering = None

    def _at_rest(self, x: float, y: float) -> Place | None:
        """Find the place of the sheet at rest that a pixel shows; None if it shows none of its plane."""
        if (point := intersect_rest_plane(self._viewport.view, (x, y))) is None:
            return None
        height, width = self._simulation.scene.sheet.size
        return float(point[0]) / width + 0.5, 0.5 - float(point[1]) / height


class Viewport:
    """Shows what a renderer draws in the way chosen now, at first as its scene says.

    Of a scene that is played, a camera that moves is followed; otherwise it stays where it is at first.

    Attributes:
        render: how the sheet is drawn now.
        view: the camera now.
    """

    def __init__(self, renderer: Renderer, *, play: bool = False) -> None:
        self._renderer, self._plays, self._time = renderer, play, 0.0
        self.render: Render = renderer.scene.render
        self.view: View = renderer.view
        self.look(self.render.main_camera)

    @property
    def compiled(self) -> bool:
        """Whether the next picture can be drawn without compiling a kernel."""
        return self._renderer.is_compiled(self.render, self.view)

    def look(self, camera: AnyCamera) -> None:
        """Choose another camera; those beside it follow."""
        if isinstance(camera, Camera) and not self._plays:
            camera = frozen_camera(camera, 0.0)
        self.render = self.render.with_main(camera)
        self.view = view(self._renderer.scene.model_copy(update={"render": self.render, "output": ()}), self._time)

    def follow(self, time: float) -> bool:
        """Go where a moving camera is at a time [s]; returns whether it moves."""
        self._time = time
        camera = self.render.main_camera
        moving = isinstance(camera, Camera) and camera.moves
        if moving:
            self.view = self._renderer.resolve_camera(None, time)
        return moving

    def recorded(self, duration: float) -> Render:
        """Give how it is drawn for a scene of some duration [s], to the end of which the last pose is held."""
        camera = self.render.main_camera
        if isinstance(camera, Camera) and isinstance(camera.poses, tuple) and camera.poses[-1][0] < duration:
            last = (duration, *camera.poses[-1][1:])
            return self.render.with_main(camera.model_copy(update={"poses": (*camera.poses, last)}))
        return self.render

    def turn(self, right: float, down: float) -> None:
        """Turn the picture as if its nearest side were pushed by this many pixels; its height is half a turn."""
        angle = math.pi / self.render.size[1]
        seen = self._renderer.scene.model_copy(update={"render": self.render})
        self.look(orbit_camera(pinhole(seen, self._time), -right * angle, down * angle))

    def light(self) -> None:
        """Switch the light off or on; on is the scene's shading if it has one, else the headlight."""
        own = self._renderer.scene.render.shading
        lit = own if own != "none" else "headlight"
        self._change(shading="none" if self.render.shading != "none" else lit)

    def mesh(self) -> None:
        """Show the mesh, or hide it."""
        self._change(wireframe=not self.render.wireframe)

    def draw(self, positions: NDArray[Any], rods: Sequence[Capsule] = ()) -> Picture:
        """Draw the sheet with some instruments; positions and picture as those of `Simulation`."""
        return self._renderer.draw(Shot(positions, self.view, rods), self.render)

    def pixel(self, point: NDArray[np.floating]) -> tuple[float, float] | None:
        """Find where a point [m] is seen; None if it is behind the camera."""
        x, y = self.view.pixels(point.astype(float)).tolist()
        return (x, y) if math.isfinite(x) else None

    def _change(self, **changes: Any) -> None:
        self.render = self.render.model_copy(update=changes)
