"""The pointer over the picture of a simulation, which moves the tool in the hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.picking import on_rest_plane
from taichi_msm.simulation import Simulation
from taichi_msm.viewer.held_tool import HeldTool, Place
from taichi_msm.viewer.moved_tool import MovedTool
from taichi_msm.viewer.viewport import Viewport


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
        self._held = place, on_rest_plane(self._viewport.view, self._pointer)
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
        ((across, down), begun), here = self._held, on_rest_plane(self._viewport.view, self._pointer)
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
            self._held = self.tool.goal, on_rest_plane(self._viewport.view, self._pointer)

    def forget(self) -> None:
        """Put the tool at rest."""
        self.tool.rest()
        self._held = self._hovering = None

    def _at_rest(self, x: float, y: float) -> Place | None:
        """Find the place of the sheet at rest that a pixel shows; None if it shows none of its plane."""
        if (point := on_rest_plane(self._viewport.view, (x, y))) is None:
            return None
        height, width = self._simulation.scene.sheet.size
        return float(point[0]) / width + 0.5, 0.5 - float(point[1]) / height
