"""The time grid of a run: frames, steps and precision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

Precision = Literal["f32", "f64"]

# Types of NumPy by precision.
DTYPES: dict[str, np.dtype[Any]] = {"f32": np.dtype(np.float32), "f64": np.dtype(np.float64)}


@dataclass(frozen=True)
class TimeGrid:
    """The steps of a run, chosen for a scene by `solver.planning`.

    Times are quotients of numbers of steps, never sums of steps, so that rounding does not accumulate.
    """

    frames_per_second: float  # [1/s]
    frames: int  # number of intervals between frames; a run has one frame more
    steps_per_frame: int  # 1 or more
    precision: Precision  # of the positions and forces

    @property
    def steps(self) -> int:
        """Number of steps of the run."""
        return self.frames * self.steps_per_frame

    @property
    def steps_per_second(self) -> float:
        """Number of steps per second of simulated time [1/s]."""
        return self.frames_per_second * self.steps_per_frame

    @property
    def step(self) -> float:
        """The time step h [s]."""
        return 1 / self.steps_per_second

    def time(self, steps: int) -> float:
        """Return the time after a number of steps [s]."""
        return steps / self.steps_per_second
