"""Sheets and drawings that are compiled once and used by many tests: compiling takes longer than most of them."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from taichi_msm import drawing
from taichi_msm.drawing import Drawing
from taichi_msm.dynamics import Dynamics, structure
from taichi_msm.forces import Structure
from taichi_msm.runtime import Device
from taichi_msm.scene import Scene


class Pool:
    """Sheets compiled once for each structure and lent to whoever asks for a Dynamics; and so with drawings."""

    def __init__(self) -> None:
        self._idle: dict[Structure, list[Dynamics]] = defaultdict(list)
        self._drawings: dict[drawing.Structure, LentDrawing] = {}

    def lend(self, scene: Scene, device: Device, cores: int | None = None) -> Dynamics:
        idle = self._idle[structure(scene, device, cores)]
        if not idle:
            return Lent(scene, device, idle, cores)
        idle[-1].restart(scene)
        return idle.pop()

    def lend_drawing(self, scene: Scene, texture: NDArray[np.uint8]) -> Drawing:
        """Lend one to who draws with cameras of his own; all scenes have one picture and one background."""
        found = drawing.structure(scene, texture)
        if found not in self._drawings:
            self._drawings[found] = LentDrawing(scene, texture)
        return self._drawings[found]

    def close(self) -> None:
        for idle in self._idle.values():
            for dynamics in idle:
                Dynamics.close(dynamics)
        for lent in self._drawings.values():
            Drawing.close(lent)


class LentDrawing(Drawing):
    """A Drawing that stays with its pool."""

    def close(self) -> None:
        pass


class Lent(Dynamics):
    """A Dynamics that goes back to its pool when it is closed."""

    def __init__(self, scene: Scene, device: Device, idle: list[Dynamics], cores: int | None) -> None:
        super().__init__(scene, device, cores=cores)
        self._idle = idle

    def close(self) -> None:
        self._idle.append(self)
