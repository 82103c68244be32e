"""Sheets that are compiled once and used by many tests: compiling takes longer than most of them."""

from __future__ import annotations

from collections import defaultdict

from taichi_msm.dynamics import Dynamics, structure
from taichi_msm.forces import Structure
from taichi_msm.runtime import Device
from taichi_msm.scene import Scene


class Pool:
    """Sheets compiled once for each structure and lent to whoever asks for a Dynamics."""

    def __init__(self) -> None:
        self._idle: dict[Structure, list[Dynamics]] = defaultdict(list)

    def lend(self, scene: Scene, device: Device, cores: int | None = None) -> Dynamics:
        idle = self._idle[structure(scene, device, cores)]
        if not idle:
            return Lent(scene, device, idle, cores)
        idle[-1].restart(scene)
        return idle.pop()

    def close(self) -> None:
        for idle in self._idle.values():
            for dynamics in idle:
                Dynamics.close(dynamics)


class Lent(Dynamics):
    """A Dynamics that goes back to its pool when it is closed."""

    def __init__(self, scene: Scene, device: Device, idle: list[Dynamics], cores: int | None) -> None:
        super().__init__(scene, device, cores=cores)
        self._idle = idle

    def close(self) -> None:
        self._idle.append(self)
