"""Controller of the tool by the pointer, and viewport of a session."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Solid
from taichi_msm.render.camera import View, frozen_camera, orbit_camera, pinhole, view
from taichi_msm.render.picking import intersect_rest_plane
from taichi_msm.render.renderer import Renderer, Shot
from taichi_msm.runs.media import Picture
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.render import AnyCamera, Render
from taichi_msm.view.tools import ForceControlledTool, PositionControlledTool, SheetPosition


class Controller:
    """Controller of a tool by a pointer over the picture of a simulation.

    A force-controlled tool acts on the material that is visible under the pointer. The tip of a position-controlled
    tool is above or below the point of the rest plane under the pointer.

    Args:
        tool: the initial tool.
        viewport: has the camera.
        simulation: has the sheet.

    Attributes:
        tool: the current tool; may be replaced while it does not press.
    """

    def __init__(
        self, tool: ForceControlledTool | PositionControlledTool, viewport: Viewport, simulation: Simulation
    ) -> None:
        self.tool = tool
        self._viewport = viewport
        self._simulation = simulation
        # Start of a drag: position of the tool, and point of the rest plane under the pointer [m].
        self._drag_start: tuple[SheetPosition, NDArray[np.floating] | None] | None = None
        self._pointer = (0.0, 0.0)
        self._hover_pixel: tuple[float, float] | None = None

    def press(self, x: float, y: float, direction: int) -> bool:
        """Press the tissue that is visible at a pixel.

        Args:
            x: column [px].
            y: row [px].
            direction: 1 to press, -1 to pull or grip.

        Returns:
            Whether tissue is visible at the pixel.
        """
        position = self._simulation.pick((x, y), self._viewport.view)
        if position is None:
            return False
        if isinstance(self.tool, PositionControlledTool):
            position = self._rest_position(x, y) or self.tool.target
        self.tool.press(position, direction)
        self._pointer = x, y
        self._drag_start = position, intersect_rest_plane(self._viewport.view, self._pointer)
        return True

    def hover_position(self) -> SheetPosition | None:
        """Return the position at which a force-controlled tool would press; None if it presses, or for other tools."""
        if isinstance(self.tool, PositionControlledTool) or self.tool.engaged or self.tool.percent != 0:
            return None
        return None if self._hover_pixel is None else self._simulation.pick(self._hover_pixel, self._viewport.view)

    def hover(self, x: float, y: float) -> None:
        """Move the pointer to column x and row y [px] without pressing; a position-controlled tool follows."""
        self._hover_pixel = x, y
        if isinstance(self.tool, PositionControlledTool) and (position := self._rest_position(x, y)):
            self.tool.move(position)

    def drag(self, x: float, y: float) -> None:
        """Move the pressing tool by the displacement of the pointer to column x and row y [px], on the rest plane.

        Picking the deformed sheet would feed back, as it moves with the tool.
        """
        if self._drag_start is None:
            return
        self._pointer = x, y
        ((across, down), start), end = self._drag_start, intersect_rest_plane(self._viewport.view, self._pointer)
        if start is None or end is None:
            return
        (right, up), (height, width) = end - start, self._simulation.scene.sheet.size
        self.tool.move((across + right / width, down - up / height))

    def release(self) -> None:
        """Release the tissue."""
        self._drag_start = self._hover_pixel = None
        if self.tool.engaged:
            self.tool.release()

    def rebase_drag(self) -> None:
        """Restart a drag at the current position of the tool, after the camera has moved."""
        if self._drag_start is not None:
            self._drag_start = self.tool.target, intersect_rest_plane(self._viewport.view, self._pointer)

    def reset(self) -> None:
        """Reset the tool and the pointer."""
        self.tool.reset()
        self._drag_start = self._hover_pixel = None

    def _rest_position(self, x: float, y: float) -> SheetPosition | None:
        """Return the position on the rest plane at a pixel; None if the plane is not visible there."""
        if (point := intersect_rest_plane(self._viewport.view, (x, y))) is None:
            return None
        height, width = self._simulation.scene.sheet.size
        return float(point[0]) / width + 0.5, 0.5 - float(point[1]) / height


class Viewport:
    """Interactive camera, light and mesh display of a session.

    Args:
        renderer: has the initial settings in its scene.
        play: whether to follow a moving camera of the scene; otherwise it stays at its initial pose.

    Attributes:
        render: current drawing settings.
        view: current camera.
    """

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
            camera = frozen_camera(camera, 0.0)
        self.render = self.render.with_main(camera)
        self.view = view(self._renderer.scene.model_copy(update={"render": self.render, "output": ()}), self._time)

    def set_time(self, time: float) -> bool:
        """Move the camera to its pose at a time [s]; return whether it moves."""
        self._time = time
        camera = self.render.main_camera
        moving = isinstance(camera, Camera) and camera.moves
        if moving:
            self.view = self._renderer.resolve_camera(None, time)
        return moving

    def recorded_render(self, duration: float) -> Render:
        """Return the drawing settings for a scene of a duration [s], with the last camera pose held until its end."""
        camera = self.render.main_camera
        if isinstance(camera, Camera) and isinstance(camera.poses, tuple) and camera.poses[-1][0] < duration:
            last = (duration, *camera.poses[-1][1:])
            return self.render.with_main(camera.model_copy(update={"poses": (*camera.poses, last)}))
        return self.render

    def turn(self, right: float, down: float) -> None:
        """Orbit the camera as if the near side of the tissue were dragged.

        Args:
            right: horizontal drag [px]; the height of the picture is half a turn.
            down: vertical drag [px].
        """
        angle = math.pi / self.render.size[1]
        scene = self._renderer.scene.model_copy(update={"render": self.render})
        self.set_camera(orbit_camera(pinhole(scene, self._time), -right * angle, down * angle))

    def toggle_light(self) -> None:
        """Toggle the shading of the scene, or a headlight if the scene has none."""
        scene_shading = self._renderer.scene.render.shading
        shading = scene_shading if scene_shading != "none" else "headlight"
        self._change(shading="none" if self.render.shading != "none" else shading)

    def toggle_mesh(self) -> None:
        """Show or hide the mesh."""
        self._change(wireframe=not self.render.wireframe)

    def draw(self, positions: NDArray[Any], instruments: Sequence[Solid] = ()) -> Picture:
        """Draw the sheet and instruments.

        Args:
            positions: of the mass points [m], shape (rows, cols, 3).
            instruments: the instruments.

        Returns:
            The picture, shape (height, width, 3).
        """
        return self._renderer.draw(Shot(positions, self.view, instruments), self.render)

    def project(self, point: NDArray[np.floating]) -> tuple[float, float] | None:
        """Project a point [m], shape (3,), to a pixel (x, y); None behind the camera."""
        x, y = self.view.pixels(point.astype(float)).tolist()
        return (x, y) if math.isfinite(x) else None

    def _change(self, **changes: Any) -> None:
        self.render = self.render.model_copy(update=changes)
