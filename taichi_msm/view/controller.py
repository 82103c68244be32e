"""The pointer and the camera of a session: the controller of the tool, and the viewport."""

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
from taichi_msm.view.tools import ForceControlledTool, PositionControlledTool, SheetPosition


class Controller:
    """Controller of a tool with a pointer over the picture of a simulation.

    A force-controlled tool acts on the material that is visible under the pointer. A position-controlled tool acts in
    space: its tip is above or below the position of the sheet at rest that is under the pointer.

    Args:
        tool: the initial tool.
        viewport: has the camera of the picture.
        simulation: has the sheet.

    Attributes:
        tool: the tool; may be replaced while it does not press.
    """

    def __init__(
        self, tool: ForceControlledTool | PositionControlledTool, viewport: Viewport, simulation: Simulation
    ) -> None:
        self.tool = tool
        self._viewport = viewport
        self._simulation = simulation
        # Start of a drag: position of the tool, and the point of the rest plane under the pointer [m].
        self._drag_start: tuple[SheetPosition, NDArray[np.floating] | None] | None = None
        self._pointer = (0.0, 0.0)
        self._hover_pixel: tuple[float, float] | None = None

    def press(self, x: float, y: float, direction: int) -> bool:
        """Press the tissue that is visible at a pixel.

        Args:
            x: column of the pixel.
            y: row of the pixel.
            direction: 1 to press, -1 to pull or grip.

        Returns:
            Whether tissue is visible there.
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
        """Return the position at which a force-controlled tool would press, or None if there is none or it presses."""
        if isinstance(self.tool, PositionControlledTool) or self.tool.engaged or self.tool.percent != 0:
            return None
        return None if self._hover_pixel is None else self._simulation.pick(self._hover_pixel, self._viewport.view)

    def hover(self, x: float, y: float) -> None:
        """Move the pointer without pressing; the tip of a position-controlled tool follows.

        Args:
            x: column of the pixel.
            y: row of the pixel.
        """
        self._hover_pixel = x, y
        if isinstance(self.tool, PositionControlledTool) and (position := self._rest_position(x, y)):
            self.tool.move(position)

    def drag(self, x: float, y: float) -> None:
        """Move the pressing tool over the sheet at rest by the movement of the pointer.

        The deformed sheet cannot be used: it moves with the tool, so each movement would cause another one.

        Args:
            x: column of the pixel under the pointer.
            y: row of that pixel.
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
        """Keep the position of the tool after the camera has moved; a drag continues from there."""
        if self._drag_start is not None:
            self._drag_start = self.tool.target, intersect_rest_plane(self._viewport.view, self._pointer)

    def reset(self) -> None:
        """Reset the tool and the pointer."""
        self.tool.reset()
        self._drag_start = self._hover_pixel = None

    def _rest_position(self, x: float, y: float) -> SheetPosition | None:
        """Return the position of the sheet at rest at a pixel, or None if the pixel does not show its plane."""
        if (point := intersect_rest_plane(self._viewport.view, (x, y))) is None:
            return None
        height, width = self._simulation.scene.sheet.size
        return float(point[0]) / width + 0.5, 0.5 - float(point[1]) / height


class Viewport:
    """Camera, light and mesh display of a session, which the user can change.

    Args:
        renderer: draws the sheet; its scene has the initial settings.
        play: whether to follow a moving camera of the scene, which otherwise stays at its initial pose.

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
        """Move a moving camera to its pose at a time [s]; returns whether the camera moves."""
        self._time = time
        camera = self.render.main_camera
        moving = isinstance(camera, Camera) and camera.moves
        if moving:
            self.view = self._renderer.resolve_camera(None, time)
        return moving

    def recorded_render(self, duration: float) -> Render:
        """Return the drawing settings for a scene of a duration [s]; the camera's last pose is held until its end."""
        camera = self.render.main_camera
        if isinstance(camera, Camera) and isinstance(camera.poses, tuple) and camera.poses[-1][0] < duration:
            last = (duration, *camera.poses[-1][1:])
            return self.render.with_main(camera.model_copy(update={"poses": (*camera.poses, last)}))
        return self.render

    def turn(self, right: float, down: float) -> None:
        """Orbit the camera as if the nearest side of the tissue were dragged.

        Args:
            right: horizontal distance of the drag [px]; the height of the picture is half a turn.
            down: vertical distance of the drag [px].
        """
        angle = math.pi / self.render.size[1]
        scene = self._renderer.scene.model_copy(update={"render": self.render})
        self.set_camera(orbit_camera(pinhole(scene, self._time), -right * angle, down * angle))

    def toggle_light(self) -> None:
        """Switch between no shading and that of the scene, or the headlight if the scene has none."""
        scene_shading = self._renderer.scene.render.shading
        lit = scene_shading if scene_shading != "none" else "headlight"
        self._change(shading="none" if self.render.shading != "none" else lit)

    def toggle_mesh(self) -> None:
        """Show or hide the mesh."""
        self._change(wireframe=not self.render.wireframe)

    def draw(self, positions: NDArray[Any], rods: Sequence[Capsule] = ()) -> Picture:
        """Draw the sheet and instruments.

        Args:
            positions: of the mass points [m], shape (rows, cols, 3).
            rods: capsules of the instruments.

        Returns:
            The picture, shape (height, width, 3).
        """
        return self._renderer.draw(Shot(positions, self.view, rods), self.render)

    def project(self, point: NDArray[np.floating]) -> tuple[float, float] | None:
        """Project a point [m], shape (3,), to a pixel (x, y), or to None if it is behind the camera."""
        x, y = self.view.pixels(point.astype(float)).tolist()
        return (x, y) if math.isfinite(x) else None

    def _change(self, **changes: Any) -> None:
        self.render = self.render.model_copy(update=changes)
