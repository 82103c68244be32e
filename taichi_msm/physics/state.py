"""The state of a sheet, what is read from it, and how far a run has come."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import NDArray


class State(NamedTuple):
    """Everything that the next steps depend on.

    Attributes:
        steps: number of steps taken, n.
        displacement: u_n [m], shape (rows, cols, 3).
        difference: d_n = u_n - u_{n-1} [m], shape (rows, cols, 3).
    """

    steps: int
    displacement: NDArray[Any]
    difference: NDArray[Any]


class Reading(NamedTuple):
    """What is read from a sheet at a step.

    Attributes:
        steps: number of steps taken, n.
        displacement: u_n = x - X [m], shape (rows, cols, 3).
        shortest_spring, longest_spring: smallest and largest ratio of a spring's length to its rest length.
        energy: kinetic energy and that of springs and bending, without the virtual springs [J].
    """

    steps: int
    displacement: NDArray[Any]
    shortest_spring: float
    longest_spring: float
    energy: float


@dataclass(frozen=True)
class RunProgress:
    """What is known about a run at a frame, apart from the positions.

    Attributes:
        frame: number of the frame.
        max_displacement: largest displacement at any frame so far [m].
        shortest_spring, longest_spring: as in a `Reading`, at any frame so far.
        energy: as in a `Reading`, at this frame [J].
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
