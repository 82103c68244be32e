"""The state of a sheet, what is read from it, and how far a run has come."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.scene.tools import Probe


class LargestDisplacement(NamedTuple):
    """The point that is farthest from its rest position, or not finite."""

    # row, column: of the point
    row: int
    column: int
    distance: float  # from its rest position [m]
    reach: float  # root of the sum of the squared displacements of all points [m]


def largest_displacement(displacement: NDArray[np.floating]) -> LargestDisplacement:
    """Find the point that is farthest from rest; displacement [m] of shape (rows, cols, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        square = np.einsum("ijk,ijk->ij", displacement, displacement, dtype=np.float64)
        # Where there is a NaN, argmax gives its index.
        row, column = (int(index) for index in np.unravel_index(square.argmax(), square.shape))
        distance = float(np.linalg.norm(displacement[row, column].astype(float)))
        return LargestDisplacement(row, column, distance, math.sqrt(square.sum()))


class State(NamedTuple):
    """Everything that the next steps depend on."""

    steps: int  # number of steps taken, n
    displacement: NDArray[Any]  # u_n [m], shape (rows, cols, 3)
    difference: NDArray[Any]  # d_n = u_n - u_{n-1} [m], shape (rows, cols, 3)
    contact: NDArray[Any] = np.empty((0, 0, 0))  # fields of `terms.contact`, shape (fields, rows, cols)


class Reading(NamedTuple):
    """What is read from a sheet at a step."""

    steps: int  # number of steps taken, n
    displacement: NDArray[Any]  # u_n = x - X [m], shape (rows, cols, 3)
    # shortest_spring, longest_spring: smallest and largest ratio of a spring's length to its rest length
    shortest_spring: float
    longest_spring: float
    energy: float  # kinetic energy and that of springs and bending, without the virtual springs [J]
    # At rest: the largest force left on a point, as a share of the largest force; evaluations of the forces for it.
    residual: float = 0.0
    evaluations: int = 0


@dataclass(frozen=True)
class RunProgress:
    """What is known about a run at a frame, apart from the positions."""

    frame: int = 0  # number of the frame
    max_displacement: float = 0.0  # largest displacement at any frame so far [m]
    # shortest_spring, longest_spring: as in a `Reading`, at any frame so far
    shortest_spring: float = 1.0
    longest_spring: float = 1.0
    energy: float = 0.0  # as in a `Reading`, at this frame [J]
    reach: float = 0.0  # root of the sum of all squared displacements at this frame [m]
    deepest: float = 0.0  # how far any point was below its place at rest at any frame so far [m]
    peak: float = 0.0  # largest energy at any frame so far [J]
    # residual, evaluations: as in a `Reading`; the largest residual of any frame so far, and all evaluations
    residual: float = 0.0
    evaluations: int = 0
    # least_energy, energy_growth: as `EnergyGrowth.follow` returns them
    least_energy: float = 0.0
    energy_growth: float = 0.0
    # pierced_by, pierced_frame: probe, counted from 1, that `piercing` found first, and at which frame; 0: none so far
    pierced_by: int = 0
    pierced_frame: int = 0


Numbers = tuple[float, float, float]


class TipForce(NamedTuple):
    """What a probe does at a frame.

    Attributes:
        probe: its index in the scene.
        tip: the lowest point of the round end of a tool that is moved, or where the control point is on the deformed
            sheet [m].
        force: on the points of the sheet that are not fixed [N]; of a tool that is moved the mean over the steps since
            the frame before, 0 at the first frame; or where the sheet is at rest, that at the frame.
    """

    probe: int
    tip: Numbers
    force: Numbers


class PeakForce(NamedTuple):
    """The force of a probe at the frame at which it is greatest."""

    time: float  # of that frame [s]
    force: Numbers  # as in a `TipForce` [N]


class ProbeForces(NamedTuple):
    """What is known of the forces at a frame, for every probe."""

    forces: tuple[TipForce, ...]  # at this frame
    greatest: tuple[PeakForce, ...]  # at any frame so far


class Snapshot(NamedTuple):
    """A point of a run from which it can continue."""

    state: State  # at a step, which may lie between two frames
    # progress, felt: at the last frame up to that step
    progress: RunProgress
    felt: ProbeForces
    probes: tuple[Probe, ...] = ()  # with the paths that the tools followed; none: those of the scene
