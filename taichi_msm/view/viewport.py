"""Interactive camera, light and mesh display of a session."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.view import View
from taichi_msm.model.surface import Solid
from taichi_msm.render.camera import Shot, frozen_camera, orbit_camera, pinhole, view
from taichi_msm.render.renderer import Renderer
from taichi_msm.runs.media import Picture
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.render import AnyCamera, Render
from taichi_msm.scene.scene import Scene


class Viewport:
    """Camera, light and mesh display of a session; with `play`, a moving camera of the scene moves."""

    def __init__(self, renderer: Renderer, *, play: bool = False) -> None:
        self._renderer, self._plays, self._time = renderer, play, 0.0
        self.render: Render = renderer.scene.render
        self.view: View = renderer.view
        self.set_camera(self.render.main_camera)

    @property
    def is_compiled(self) -> bool:
        """Whether the next picture can be drawn without compiling a kernel."""
        return self._renderer.is_compiled(self.render, self.view)

    def set_camera(self, camera: AnyCamera) -> None:
        """Set the main camera; the other cameras of the rig move with it."""
        if isinstance(camera, Camera) and not self._plays:
            camera = frozen_camera(camera, self._renderer.scene, 0.0)
        self.render = self.render.with_main(camera)
        self.view = view(self._scene().model_copy(update={"output": ()}), self._time)

    def set_time(self, time: float) -> bool:
        """Move the camera to its pose at a time [s]; return whether it is a moving camera."""
        self._time = time
        camera = self.render.main_camera
        moving = isinstance(camera, Camera) and camera.moves
        if moving:
            self.view = self._renderer.resolve_camera(None, time)
        return moving

    def recorded_render(self, duration: float) -> Render:
        """Return the drawing settings for a recorded scene of a duration [s]; the camera keeps its last pose."""
        camera = self.render.main_camera
        if isinstance(camera, Camera) and isinstance(camera.poses, tuple) and camera.poses[-1][0] < duration:
            last = (duration, *camera.poses[-1][1:])
            return self.render.with_main(camera.model_copy(update={"poses": (*camera.poses, last)}))
        return self.render

    def turn(self, right: float, down: float) -> None:
        """Orbit the camera as if the near side of the tissue were dragged [px]; the picture's height is half a turn."""
        angle = math.pi / self.render.size[1]
        self.set_camera(orbit_camera(pinhole(self._scene(), self._time), -right * angle, down * angle))

    def _scene(self) -> Scene:
        """Return the scene with the current camera, which does not change its surface."""
        scene = self._renderer.scene
        return scene.model_copy(update={"render": self.render, "sheet": scene.sheet.with_kept_frame()})

    def toggle_light(self) -> None:
        """Toggle the shading of the scene, or a headlight if the scene has no shading."""
        scene_shading = self._renderer.scene.render.shading
        shading = scene_shading if scene_shading != "none" else "headlight"
        update = {"shading": "none" if self.render.shading != "none" else shading}
        self.render = self.render.model_copy(update=update)

    def toggle_mesh(self) -> None:
        """Show or hide the mesh."""
        self.render = self.render.model_copy(update={"wireframe": not self.render.wireframe})

    def draw(
        self, positions: NDArray[Any], instruments: Sequence[Solid] = (), size: tuple[int, int] | None = None
    ) -> Picture:
        """Draw the sheet, with positions of the mass points [m], shape (rows, cols, 3), and the instruments.

        `size` is width and height of the picture [px], by default those of the scene.
        """
        view, render = self.view, self.render
        if size is not None and size != render.size:
            view, render = view.cropped((0, 0, *render.size), size), render.model_copy(update={"size": size})
        return self._renderer.draw(Shot(positions, view, instruments), render)

    def project(self, point: NDArray[np.floating]) -> tuple[float, float] | None:
        """Project a point [m], shape (3,), to a pixel (x, y); None behind the camera."""
        x, y = self.view.pixels(point.astype(float)).tolist()
        return (x, y) if math.isfinite(x) else None
