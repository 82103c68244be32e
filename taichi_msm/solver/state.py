"""The state of a sheet, readings of it, and the progress of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.scene.tools import Probe


class LargestDisplacement(NamedTuple):
    """The largest displacement of a mass point; NaN and infinity count as the largest."""

    row: int  # row of the mass point
    column: int  # column of the mass point
    distance: float  # of the mass point from its rest position [m]
    reach: float  # Euclidean norm of the displacements of all mass points [m]


def largest_displacement(displacement: NDArray[np.floating]) -> LargestDisplacement:
    """Find the largest of the displacements x - X [m], shape (rows, cols, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        square = np.einsum("ijk,ijk->ij", displacement, displacement, dtype=np.float64)
        # If any value is NaN, argmax returns its index.
        row, column = (int(index) for index in np.unravel_index(square.argmax(), square.shape))
        distance = float(np.linalg.norm(displacement[row, column].astype(float)))
        return LargestDisplacement(row, column, distance, math.sqrt(square.sum()))


class State(NamedTuple):
    """The state on which the next steps depend."""

    steps: int  # number of steps taken, n
    displacement: NDArray[Any]  # u_n [m], shape (rows, cols, 3)
    difference: NDArray[Any]  # d_n = u_n - u_{n-1} [m], shape (rows, cols, 3)
    memory: NDArray[Any] = np.empty((0, 0, 0))  # `Term.memory` of all terms, shape (numbers, rows, cols)


class Reading(NamedTuple):
    """Displacements and measures of a sheet at a step."""

    steps: int  # number of steps taken, n
    displacement: NDArray[Any]  # u_n = x - X [m], shape (rows, cols, 3)
    shortest_spring: float  # smallest ratio of a spring's length to its rest length
    longest_spring: float  # largest ratio of a spring's length to its rest length
    energy: float  # kinetic energy and energy of springs and bending, without virtual springs [J]
    residual: float = 0.0  # quasi-static: largest residual force, relative to the largest force
    evaluations: int = 0  # quasi-static: number of evaluations of the forces


@dataclass(frozen=True)
class RunProgress:
    """Measures of a run up to a frame, without the positions."""

    frame: int = 0  # number of the frame
    max_displacement: float = 0.0  # largest displacement at any frame so far [m]
    shortest_spring: float = 1.0  # as in a `Reading`, at any frame so far
    longest_spring: float = 1.0  # as in a `Reading`, at any frame so far
    energy: float = 0.0  # as in a `Reading`, at this frame [J]
    reach: float = 0.0  # Euclidean norm of the displacements of all mass points at this frame [m]
    # Largest depth and height of a mass point at any frame so far, along its normal at rest [m].
    deepest: float = 0.0
    highest: float = 0.0
    peak: float = 0.0  # largest energy at any frame so far [J]
    residual: float = 0.0  # as in a `Reading`, the largest of all frames so far
    evaluations: int = 0  # as in a `Reading`, the sum over all frames so far
    least_energy: float = 0.0  # smallest energy at a frame after the last load [J]; 0 until then
    energy_growth: float = 0.0  # largest factor of growth from this smallest energy to a later one
    pierced_by: int = 0  # index of the first probe that pierced the sheet, plus 1; 0 if none did
    pierced_frame: int = 0  # the first frame at which it did; 0 if none
    max_displacement_frame: int = 0  # the first frame with the largest displacement


Vector = tuple[float, float, float]


class TipForce(NamedTuple):
    """Position and force of a probe at a frame.

    Attributes:
        probe: index of the probe in the scene.
        tip: position [m]: the lowest point of an instrument on a path, the mean position of the mass points of a clamp,
            or the control point of a force-controlled tool on the deformed sheet.
        force: force on the mass points that are not fixed [N]; in motion, the force of a position-controlled tool is
            the mean over the steps since the previous frame, and 0 at the first frame.
    """

    probe: int
    tip: Vector
    force: Vector


class PeakForce(NamedTuple):
    """The largest force of a probe at any frame so far."""

    time: float  # of the frame [s]
    force: Vector  # as in a `TipForce` [N]


class ProbeForces(NamedTuple):
    """The forces of all probes at a frame and their maxima so far."""

    forces: tuple[TipForce, ...]  # at this frame
    greatest: tuple[PeakForce, ...]  # at any frame so far


class Snapshot(NamedTuple):
    """The data from which a run can continue."""

    state: State  # at a step, which can lie between two frames
    progress: RunProgress  # at the last frame up to this step
    probe_forces: ProbeForces  # at the last frame up to this step
    probes: tuple[Probe, ...] = ()  # with the paths followed so far; empty if equal to the scene's probes
