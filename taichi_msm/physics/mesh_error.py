"""How much the number of points changes a run of tissue, by a run with half the points a side beside it.

The lattice is of second order in the length of its cells where the displacement is smooth, so that with r times longer
cells the displacement u_c tells the error of u by Richardson's extrapolation: |u - u_c| / (r^2 - 1). It is not smooth
at the rim of a tool's flat end, at an edge in a map and where tissue folds; and a tool that is narrower than the longer
cells is not seen by them. The error told there is mostly too large.

With `springs` a sheet is another one with other points, and nothing can be told.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.error_control import longest
from taichi_msm.physics.solver import Dynamics
from taichi_msm.physics.timestep import steps_per_frame, with_steps, with_time
from taichi_msm.progress import Pause
from taichi_msm.scene import Scene
from taichi_msm.system.runtime import Device

# With fewer points a side than this nothing is left to compare with.
FEWEST = 5


def coarser(scene: Scene) -> Scene | None:
    """Give the scene half as many cells a side and the same steps; None where there are too few, or no tissue."""
    if scene.tissue is None or min(scene.sheet.points) < FEWEST:
        return None
    rows, cols = (round((count - 1) / 2) + 1 for count in scene.sheet.points)
    sheet = scene.sheet.model_copy(update={"points": (rows, cols)})
    return with_steps(with_time(scene.model_copy(update={"sheet": sheet}), precision="f64"), steps_per_frame(scene))


class MeshPilot:
    """Runs beside another run, in float64, with half the points a side.

    Args:
        scene: what is run, with its step.
        coarse: what `coarser` gave for it.
        device: what `runtime.start` returned.
        cores: how many cores are free for it; None: all.

    Raises:
        DeviceError: when the device cannot run it in float64.
    """

    def __init__(self, scene: Scene, coarse: Scene, device: Device, cores: int | None = None) -> None:
        self._steps = steps_per_frame(scene)
        self._dynamics = Dynamics(coarse, device, cores=cores)
        cells = [(of - 1, to - 1) for of, to in zip(scene.sheet.points, coarse.sheet.points, strict=True)]
        self._samples = [_Cubic(of, to) for of, to in cells]
        self._divisor = min(of / to for of, to in cells) ** 2 - 1
        self._difference = self._largest = 0.0

    def compile(self) -> None:
        """Compile now what would be compiled by the first frame."""
        self._dynamics.compile()

    def follow(self, displacement: NDArray[Any], pause: Pause) -> None:
        """Take the next frame, and compare.

        Args:
            displacement: of the run at that frame, shape (rows, cols, 3).
            pause: called some times a second; what it raises stops the pilot for good.
        """
        self._dynamics.advance(self._steps, pause)
        rows, cols = self._samples
        seen = cols.at(rows.at(displacement).swapaxes(0, 1)).swapaxes(0, 1)
        with np.errstate(all="ignore"):
            self._difference = max(self._difference, longest(seen - self._dynamics.displacement()))
        self._largest = max(self._largest, longest(displacement))

    @property
    def error(self) -> float:
        """What is known by the frames so far, as a fraction of the largest displacement; infinite: not known."""
        if self._largest == 0:
            return 0.0
        relative = self._difference / self._divisor / self._largest
        return relative if relative < math.inf else math.inf

    def close(self) -> None:
        """Free the memory."""
        self._dynamics.close()


class _Cubic:
    """Samples values at the ends of `of` equal cells at those of `to` others, along the first axis, by cubics."""

    def __init__(self, of: int, to: int) -> None:
        place = np.arange(to + 1) * (of / to)
        self._first = np.clip(np.floor(place).astype(int) - 1, 0, of - 3)
        t = place - self._first
        nodes = range(4)
        self._weights = np.stack(
            [math.prod((t - other) / (node - other) for other in nodes if other != node) for node in nodes]
        )

    def at(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """Sample an array."""
        shape = (-1,) + (1,) * (values.ndim - 1)
        return sum(
            (weight.reshape(shape) * values[self._first + n] for n, weight in enumerate(self._weights)),
            start=np.zeros(()),
        )
