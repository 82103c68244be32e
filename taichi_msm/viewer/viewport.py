"""How the tissue is shown: the camera, the light and the mesh, which a person may change while it moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.outputs.gif import Picture
from taichi_msm.render.camera import View, pinhole, turned, view
from taichi_msm.render.instrument import Rod
from taichi_msm.render.rasterizer import Drawing
from taichi_msm.scene import Camera, Render, Scene


class Viewport:
    """Draws a sheet in the way chosen now; call `runtime.start` first.

    Args:
        scene: a checked scene, whose `render` and camera come first.
        texture: the picture on the sheet, shape (height, width, 3).

    Attributes:
        render: how the sheet is drawn now.
        view: the camera now.
    """

    def __init__(self, scene: Scene, texture: NDArray[np.uint8]) -> None:
        self._scene = scene
        self._texture = texture
        self._drawings: dict[tuple[str, bool], Drawing] = {}
        self.render: Render = scene.render
        self.view: View = view(scene)

    @property
    def compiled(self) -> bool:
        """Whether the next picture can be drawn without compiling a kernel."""
        return (self.render.shading, self.render.wireframe) in self._drawings

    def look(self, camera: str | Camera) -> None:
        """Choose another camera."""
        self._change(camera=camera)
        self.view = view(self._seen())

    def turn(self, right: float, down: float) -> None:
        """Turn the picture as if its nearest side were pushed by this many pixels; its height is half a turn."""
        angle = math.pi / self.render.size[1]
        self.look(turned(pinhole(self._seen()), -right * angle, down * angle))

    def light(self) -> None:
        """Switch the light off or on; on is the scene's shading if it has one, else the headlight."""
        lit = self._scene.render.shading if self._scene.render.shading != "none" else "headlight"
        self._change(shading="none" if self.render.shading != "none" else lit)

    def mesh(self) -> None:
        """Show the mesh, or hide it."""
        self._change(wireframe=not self.render.wireframe)

    def draw(self, position: NDArray[Any], rods: Sequence[Rod] = ()) -> Picture:
        """Draw the sheet; a kernel is compiled when it is first needed.

        Args:
            position: positions of the mass points [m], shape (rows, cols, 3).
            rods: the instruments.

        Returns:
            Colours, shape (height, width, 3).
        """
        wanted = self.render.shading, self.render.wireframe
        if not self.compiled:
            self._drawings[wanted] = Drawing(self._seen(), self._texture)
        return self._drawings[wanted].draw(position, self.view, rods)

    def pixel(self, point: NDArray[np.floating]) -> tuple[float, float] | None:
        """Find where a point [m] is seen; None if it is behind the camera."""
        x, y, w, _ = self.view.matrix @ [*point, 1.0]
        return (x / w, y / w) if w > self.view.near else None

    def close(self) -> None:
        """Free the memory."""
        self._drawings.clear()

    def _change(self, **changes: Any) -> None:
        self.render = self.render.model_copy(update=changes)

    def _seen(self) -> Scene:
        return self._scene.model_copy(update={"render": self.render})
