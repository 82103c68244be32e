"""The common part of both solvers of a sheet: in motion (`dynamics`) and in quasi-static equilibrium (`rest`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Pause
from taichi_msm.model.plan import Plan
from taichi_msm.solver.arrays import InitialData, SheetLayout
from taichi_msm.solver.planned_sheet import Kernel, PlannedSheet
from taichi_msm.solver.state import Reading, State
from taichi_msm.system.runtime import Device


class SheetSolver(ABC, Generic[Kernel]):
    """A sheet that advances by steps; in quasi-static motion a frame counts as a step.

    Args:
        plan: plan of the run.
        device: device of the arrays; for quasi-static motion a CPU.
        layout: replaces the layout chosen by `choose_layout`, for tests.
        cores: largest number of CPU cores; by default all available cores.

    Attributes:
        sheet: the sheet in the memory of the device.
        steps_done: number of steps taken.
    """

    def __init__(self, plan: Plan, device: Device, layout: SheetLayout | None = None, cores: int | None = None) -> None:
        self.sheet = PlannedSheet(plan, self._build_kernel, device, layout, cores)
        self._begin(None)

    @staticmethod
    @abstractmethod
    def _build_kernel(plan: Plan, layout: SheetLayout, start: InitialData) -> Kernel:
        """Build the arrays of the sheet, with the kernels that move and read it."""

    def _begin(self, state: State | None) -> None:
        """Begin at a state, or at the sheet at rest."""
        self.steps_done = 0 if state is None else state.steps

    @property
    def plan(self) -> Plan:
        """The current plan."""
        return self.sheet.plan

    @property
    def layout(self) -> SheetLayout:
        """The memory layout, and the configuration of the kernels."""
        return self.sheet.layout

    @property
    def inconsistent(self) -> bool:
        """Whether an interruption left the arrays inconsistent; all methods but `restart` then raise MsmError."""
        return self.sheet.inconsistent

    def restart(self, plan: Plan, state: State | None = None) -> None:
        """Restart with the same or another plan, without compilation if only coefficients differ.

        Args:
            plan: the plan.
            state: state to continue from, of a sheet with the same mass points and steps; by default the sheet at rest.
        """
        self._begin(state)
        self.sheet.restart(plan, state)

    def steer(self, plan: Plan) -> None:
        """Continue with other probes, with the same kernels and the same steps.

        Args:
            plan: a plan that differs in its probes only.

        Raises:
            ArgumentError: when the new probes require other kernels.
        """
        self.sheet.steer(plan)

    @abstractmethod
    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        """Advance by a number of steps.

        Args:
            steps: number of steps.
            pause: called between launches; an exception from it interrupts, and another call of `advance` continues.
        """

    @abstractmethod
    def compile(self) -> None:
        """Compile all kernels without moving a mass point."""

    @abstractmethod
    def state(self) -> State:
        """Return the state on which the next steps depend."""

    @abstractmethod
    def read(self) -> Reading:
        """Read the displacements and measure the sheet, in the scene's precision."""

    def displacement(self) -> NDArray[Any]:
        """Read the displacements x - X [m], shape (rows, cols, 3), in the scene's precision."""
        return self.read().displacement

    @abstractmethod
    def tool_forces(self) -> NDArray[np.float64]:
        """Compute the forces of the position-controlled tools on the sheet at a frame [N], shape (tools, 3)."""

    def close(self) -> None:
        """Release the memory of the device."""
        self.sheet.close()
