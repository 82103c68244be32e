"""How a scene moves, and how far that is from the truth; for tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.error_control import longest
from taichi_msm.physics.solver import Dynamics
from taichi_msm.physics.timestep import steps_per_frame, with_steps, with_time
from taichi_msm.scene import Scene
from taichi_msm.system.runtime import Device


def frames(made: Scene, device: Device, cut: int | None = None) -> NDArray[np.float64]:
    """Displacements at every frame [m], shape (frames, rows, cols, 3); cut: steps in a frame, None: the scene's own."""
    if cut is not None:
        made = with_steps(made, cut)
    dynamics = Dynamics(made, device)
    found = []
    for _ in range(made.time.frames):
        dynamics.advance(steps_per_frame(made))
        found.append(dynamics.displacement().astype(np.float64))
    dynamics.close()
    return np.array(found)


def true_error(made: Scene, device: Device, fine: int) -> float:
    """Error of a scene's step and precision, by a run in f64 that takes `fine` times as many steps.

    The error of that run itself is about 1 / fine² of the one found.
    """
    reference = frames(with_time(made, precision="f64"), device, cut=fine * steps_per_frame(made))
    return longest(frames(made, device) - reference) / longest(reference)
