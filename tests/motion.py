"""How a scene moves, and how far that is from the truth; for tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.error_control import longest
from taichi_msm.physics.kernel import Structure
from taichi_msm.physics.solver import Dynamics, structure
from taichi_msm.physics.timestep import time_grid
from taichi_msm.scene import Scene
from taichi_msm.system.runtime import Device
from taichi_msm.timegrid import TimeGrid


def structure_of(made: Scene, device: Device, cores: int | None = None) -> Structure:
    """What the kernel of a scene's own steps is compiled for."""
    return structure(made, time_grid(made), device, cores)


def dynamics_of(made: Scene, device: Device, layout: Structure | None = None) -> Dynamics:
    """The sheet of a scene, with the scene's own steps."""
    return Dynamics(made, time_grid(made), device, layout)


def frames(made: Scene, device: Device, cut: int | None = None) -> NDArray[np.float64]:
    """Displacements at every frame [m], shape (frames, rows, cols, 3); cut: steps in a frame, None: the scene's own."""
    grid = time_grid(made)
    return frames_on(made, grid if cut is None else replace(grid, steps_per_frame=cut), device)


def frames_on(made: Scene, grid: TimeGrid, device: Device) -> NDArray[np.float64]:
    """Displacements at every frame with the steps of a grid [m], shape (frames, rows, cols, 3)."""
    dynamics = Dynamics(made, grid, device)
    found = []
    for _ in range(grid.frames):
        dynamics.advance(grid.steps_per_frame)
        found.append(dynamics.displacement().astype(np.float64))
    dynamics.close()
    return np.array(found)


def true_error(made: Scene, grid: TimeGrid, device: Device, fine: int) -> float:
    """Error of the steps and the precision of a grid, by a run in f64 that takes `fine` times as many steps.

    The error of that run itself is about 1 / fine² of the one found.
    """
    finer = replace(grid, precision="f64", steps_per_frame=fine * grid.steps_per_frame)
    reference = frames_on(made, finer, device)
    return longest(frames_on(made, grid, device) - reference) / longest(reference)
