"""How the tissue is shown: the camera, the light and the mesh, which a person may change while it moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.outputs.gif import Picture
from taichi_msm.render.camera import View, held, pinhole, turned, view
from taichi_msm.render.renderer import Renderer, Shot
from taichi_msm.render.surface import Rod
from taichi_msm.scene import AnyCamera, Camera, Render


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
            camera = held(camera, 0.0)
        self.render = self.render.with_main(camera)
        self.view = view(self._renderer.scene.model_copy(update={"render": self.render, "output": ()}), self._time)

    def follow(self, time: float) -> bool:
        """Go where a moving camera is at a time [s]; returns whether it moves."""
        self._time = time
        camera = self.render.main_camera
        moving = isinstance(camera, Camera) and camera.moves
        if moving:
            self.view = self._renderer.set_up(None, time)
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
        self.look(turned(pinhole(seen, self._time), -right * angle, down * angle))

    def light(self) -> None:
        """Switch the light off or on; on is the scene's shading if it has one, else the headlight."""
        own = self._renderer.scene.render.shading
        lit = own if own != "none" else "headlight"
        self._change(shading="none" if self.render.shading != "none" else lit)

    def mesh(self) -> None:
        """Show the mesh, or hide it."""
        self._change(wireframe=not self.render.wireframe)

    def draw(self, positions: NDArray[Any], rods: Sequence[Rod] = ()) -> Picture:
        """Draw the sheet with some instruments; positions and picture as those of `Simulation`."""
        return self._renderer.draw(Shot(positions, self.view, rods), self.render)

    def pixel(self, point: NDArray[np.floating]) -> tuple[float, float] | None:
        """Find where a point [m] is seen; None if it is behind the camera."""
        x, y = self.view.pixels(point.astype(float)).tolist()
        return (x, y) if math.isfinite(x) else None

    def _change(self, **changes: Any) -> None:
        self.render = self.render.model_copy(update=changes)
