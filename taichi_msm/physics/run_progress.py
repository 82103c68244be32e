"""How far a run has come: facts about its last frame, and the state from which another process can continue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from taichi_msm.physics.state import State


@dataclass(frozen=True)
class RunProgress:
    """What is known about a run at a frame, apart from the positions.

    Attributes:
        frame: number of the frame.
        max_displacement: largest displacement at any frame so far [m].
        shortest_spring: smallest ratio of a spring's length to its rest length at any frame so far.
        longest_spring: largest such ratio.
        energy: kinetic energy and that of springs and bending, without the virtual springs, at this frame [J].
        reach: root of the sum of all squared displacements at this frame [m].
        peak: largest energy at any frame so far [J].
    """

    frame: int = 0
    max_displacement: float = 0.0
    shortest_spring: float = 1.0
    longest_spring: float = 1.0
    energy: float = 0.0
    reach: float = 0.0
    peak: float = 0.0


class Saved(NamedTuple):
    """A point of a run from which it can continue.

    Attributes:
        state: at a step, which may lie between two frames.
        progress: at the last frame up to that step.
    """

    state: State
    progress: RunProgress
