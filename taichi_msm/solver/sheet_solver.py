"""The interface of both solvers of a sheet: in motion (`dynamics`) and in quasi-static equilibrium (`rest`)."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Pause
from taichi_msm.model.plan import Plan
from taichi_msm.solver.arrays import SheetLayout
from taichi_msm.solver.state import Reading, State


class SheetSolver(Protocol):
    """A sheet that advances by steps; in quasi-static motion a frame counts as a step.

    Attributes:
        steps_done: number of steps taken.
    """

    steps_done: int

    @property
    def plan(self) -> Plan:
        """The current plan."""

    @property
    def layout(self) -> SheetLayout:
        """The memory layout, and the configuration of the kernels."""

    @property
    def inconsistent(self) -> bool:
        """Whether an interruption left the arrays inconsistent; all methods but `restart` then raise MsmError."""

    def restart(self, plan: Plan, state: State | None = None) -> None:
        """Restart with the same or another plan, without compilation if only coefficients differ.

        Args:
            plan: the plan.
            state: state to continue from, of a sheet with the same mass points and steps; by default the sheet at rest.
        """

    def steer(self, plan: Plan) -> None:
        """Continue with other probes, with the same kernels and the same steps.

        Args:
            plan: a plan that differs in its probes only.

        Raises:
            ArgumentError: when the new probes require other kernels.
        """

    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        """Advance by a number of steps.

        Args:
            steps: number of steps.
            pause: called between launches; an exception from it interrupts, and another call of `advance` continues.
        """

    def compile(self) -> None:
        """Compile all kernels without moving a mass point."""

    def state(self) -> State:
        """Return the state on which the next steps depend."""

    def read(self) -> Reading:
        """Read the displacements and measure the sheet, in the scene's precision."""

    def displacement(self) -> NDArray[Any]:
        """Read the displacements x - X [m], shape (rows, cols, 3), in the scene's precision."""

    def tool_forces(self) -> NDArray[np.float64]:
        """Compute the forces of the position-controlled tools on the sheet at a frame [N], shape (tools, 3)."""

    def close(self) -> None:
        """Release the memory of the device."""
