"""The sheet of a plan in the memory of a device: its arrays, the load table of its steps, and readings of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError
from taichi_msm.model.loads import Schedule, average_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import area_shares, axes, spacing
from taichi_msm.model.verlet import step_gains
from taichi_msm.solver.arrays import InitialData, SheetKernel, SheetLayout
from taichi_msm.solver.state import Reading, State
from taichi_msm.terms import build_terms
from taichi_msm.terms.base import (
    AREA_SHARE,
    COLUMN_ROWS,
    GAIN,
    HAS_LEFT,
    HAS_RIGHT,
    MOBILITY,
    REST_X,
    SQUARED_MOTION,
)
from taichi_msm.terms.loads import ProbeTerm, decay_parameters
from taichi_msm.terms.springs import MAX_STRAIN, MIN_STRAIN, SpringTerm

Kernel = TypeVar("Kernel", bound=SheetKernel)


class PlannedSheet(Generic[Kernel]):
    """The sheet of a plan in the memory of a device.

    Args:
        plan: the plan.
        layout: memory layout of the sheet, and configuration of its kernels.
        build: builds the kernel of a layout from initial values.
        state: state to continue from; None for the sheet at rest.

    Attributes:
        plan: the current plan.
        layout: the memory layout.
        kernel: the arrays of the sheet, with the kernels that move and read it.
    """

    def __init__(
        self,
        plan: Plan,
        layout: SheetLayout,
        build: Callable[[SheetLayout, InitialData], Kernel],
        state: State | None = None,
    ) -> None:
        self.plan, self.layout = plan, layout
        self._real = np.dtype(np.float32 if layout.config.precision == "f32" else np.float64)
        self.kernel = build(layout, _initial_data(plan, layout, state))

    def steer(self, plan: Plan) -> None:
        """Continue with other probes, with the same kernels.

        Args:
            plan: a plan that differs in its probes only.

        Raises:
            ArgumentError: when the new probes require other kernels.
        """
        config, terms = self.layout.config, build_terms(plan)
        probes = next(term for term in terms if isinstance(term, ProbeTerm))
        if [tool.probe for tool in plan.tools] != [tool.probe for tool in self.plan.tools]:
            raise ArgumentError("probes: which of them have a path cannot change; restart with the new scene")
        for term in terms:
            compiled = config.get(type(term))
            if compiled and (reason := term.supports(compiled)):
                raise ArgumentError(f"probes: {reason}")
        if decay_parameters(plan) != decay_parameters(self.plan):
            self.kernel.arrays.set_fields(self.layout.config.first_field(ProbeTerm), probes.fields(plan))
        self.plan = plan

    def step_table(self, first: int, count: int) -> NDArray[Any]:
        """Compute the load table of steps first, ..., first + count - 1, shape (count, columns)."""
        table = self.load_table(average_loads(self.plan, first, count), first)
        table[:, GAIN] = step_gains(self.plan, first, count)
        return table

    def load_table(self, loads: Schedule, first: int) -> NDArray[Any]:
        """Compute the load table from step `first` on, with a gain of 0, shape (steps, columns)."""
        config = self.layout.config
        table = np.zeros((len(loads.active), config.first_column(None)))
        for term in config.terms:
            first_column = config.first_column(type(term))
            table[:, first_column : first_column + term.column_count] = term.columns(self.plan, loads, first)
        # Loads too large for f32 become infinite; the next reading of the sheet detects it.
        with np.errstate(over="ignore"):
            return table.astype(self._real)

    def read(self, steps: int, *, moving: bool) -> Reading:
        """Read the displacements and measure the sheet, in the scene's precision.

        Args:
            steps: number of steps taken.
            moving: whether the energy includes the kinetic energy.
        """
        displacement, measures = self.read_arrays(differences=False)
        config, plan = self.layout.config, self.plan
        springs = measures[:, config.first_measure(SpringTerm) :]
        # The measures are (L^2 - L0^2) / L0^2.
        extremes = springs[:, MIN_STRAIN].min(), springs[:, MAX_STRAIN].max()
        shortest, longest = (math.sqrt(max(0.0, 1.0 + float(extreme))) for extreme in extremes)
        sums = measures.sum(axis=0, dtype=np.float64)
        energy = plan.material.mass * float(sums[SQUARED_MOTION]) / plan.grid.step**2 if moving else 0.0
        for term in config.terms:
            first = config.first_measure(type(term))
            energy += term.energy(sums[first : first + len(term.reductions)], plan)
        return Reading(steps, displacement, shortest, longest, energy / 2)

    def read_arrays(self, *, differences: bool) -> tuple[NDArray[Any], NDArray[Any]]:
        """Read displacements or last differences [m], shape (rows, cols, 3), and the measures of every row."""
        rows, cols, config = self.layout.rows, self.layout.cols, self.layout.config
        values, measures = (
            np.empty((rows, cols, 3), self._real),
            np.empty((rows, config.first_measure(None)), self._real),
        )
        self.kernel.read(differences, values, measures)
        return values, measures

    def read_memory(self) -> NDArray[Any]:
        """Read the numbers that terms remember, shape (numbers, rows, cols)."""
        fields = [self.kernel.arrays.get_fields(n, 1) for n in self.layout.config.memory_fields]
        # Only some kernels step fixed mass points, whose memory has no effect.
        fields = [np.where(self.plan.fixed, 0, field).astype(self._real) for field in fields]
        return np.concatenate([np.empty((0, self.layout.rows, self.layout.cols), self._real), *fields])


def _initial_data(plan: Plan, layout: SheetLayout, state: State | None) -> InitialData:
    """Compute the initial values of the arrays of a sheet."""
    sheet = plan.scene.sheet
    moves, column, areas = ~plan.fixed, np.arange(layout.cols), area_shares(sheet)
    # One row of each kind: first, middle, last.
    kinds = [0, layout.rows // 2, -1]
    shares = areas[kinds] if layout.config.by_area else np.ones((3, layout.cols))
    by_column = np.empty((COLUMN_ROWS, layout.cols))
    by_column[MOBILITY : MOBILITY + 3] = moves[kinds] / shares
    # Springs along columns read the shares of a middle row even in a sheet of two rows.
    by_column[AREA_SHARE : AREA_SHARE + 3] = areas[0], 2 * areas[0], areas[-1]
    by_column[REST_X] = axes(sheet)[0]
    by_column[HAS_LEFT] = column > 0
    by_column[HAS_RIGHT] = column < layout.cols - 1
    constants = (
        *spacing(sheet),
        sheet.size[0] / 2,
        *(n for term in layout.config.terms for n in term.constants(plan)),
    )
    fields = np.concatenate([term.fields(plan) for term in layout.config.terms])
    if state is not None and len(state.memory):
        fields[layout.config.memory_fields] = state.memory
    stiffness = layout.config.require(SpringTerm).stiffness_array(plan)
    return InitialData(np.array(constants), by_column, fields, stiffness, state)
