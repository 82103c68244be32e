"""The times at which a scene is stepped and drawn, and the precision of the steps: decided once and passed on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Precision = Literal["f32", "f64"]


@dataclass(frozen=True)
class TimeGrid:
    """The steps of a run; `physics.planning` decides them for a scene.

    Times are quotients of whole numbers of steps, never sums of steps.
    """

    frames_per_second: float  # [1/s]
    frames: int  # F, the number of frame intervals; F + 1 frames are drawn
    steps_per_frame: int  # from one frame to the next, 1 or more
    precision: Precision  # of the steps

    @property
    def steps(self) -> int:
        """Number of steps in all."""
        return self.frames * self.steps_per_frame

    @property
    def steps_per_second(self) -> float:
        """Number of steps per simulated second [1/s]."""
        return self.frames_per_second * self.steps_per_frame

    @property
    def step(self) -> float:
        """The step h [s]."""
        return 1 / self.steps_per_second

    def time(self, steps: int) -> float:
        """Tell the time after a number of steps from rest [s]."""
        return steps / self.steps_per_second
