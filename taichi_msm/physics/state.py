"""The state of a sheet, and what is read from it."""

from __future__ import annotations

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
