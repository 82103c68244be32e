"""Where a run is: what is known of its last frame, and the state from which another process can go on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from taichi_msm.physics.state import State


@dataclass(frozen=True)
class RunProgress:
    """What is known of a run at a frame, besides where the points are.

    Attributes:
        frame: its number.
        max_displacement: largest displacement of any frame so far [m].
        shortest_spring: smallest length of a spring over its rest length at any frame so far.
        longest_spring: the largest.
        energy: of motion and springs, without the virtual ones, at this frame [J].
        reach: root of the sum of all squared displacements at this frame [m].
        peak: largest energy of any frame so far [J].
    """

    frame: int = 0
    max_displacement: float = 0.0
    shortest_spring: float = 1.0
    longest_spring: float = 1.0
    energy: float = 0.0
    reach: float = 0.0
    peak: float = 0.0


class Saved(NamedTuple):
    """Where a run was.

    Attributes:
        state: at some step.
        progress: of the last frame up to it.
    """

    state: State
    progress: RunProgress
