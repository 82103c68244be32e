"""The common part of both solvers of a sheet: in motion (`dynamics`) and in quasi-static equilibrium (`rest`).

It holds the arrays of a plan on a device, computes the load table of the steps, and reads and measures the sheet.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, DeviceError, MsmError, Pause
from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import axes, rectangle_shares, spacing
from taichi_msm.model.time_grid import DTYPES
from taichi_msm.solver.arrays import InitialData, SheetKernel, SheetLayout
from taichi_msm.solver.state import Reading, State
from taichi_msm.system.process import available_threads
from taichi_msm.system.runtime import Device, lanes
from taichi_msm.terms import base, build_terms
from taichi_msm.terms.loads import ProbeTerm, decay_parameters
from taichi_msm.terms.springs import SpringTerm

Kernel = TypeVar("Kernel", bound=SheetKernel)

# Smallest number of mass points per worker; with fewer, an additional worker costs more waiting time than it saves.
POINTS_PER_WORKER = 450

# Size of a band that stays in the cache from one step to the next.
CACHED_BAND_BYTES = 384 << 10


def choose_layout(plan: Plan, device: Device, cores: int | None = None) -> SheetLayout:
    """Choose the memory layout of a sheet, its division among up to `cores` workers, and its kernels' configuration.

    By default all available cores are used. A DeviceError reports a device that does not support the scene.
    """
    (rows, cols), fixed, precision = plan.scene.sheet.points, plan.fixed, plan.grid.precision
    fixed_rows = bool(fixed[0].all()), bool(fixed[-1].all())
    if plan.scene.time.at_rest:
        if device.arch != "cpu":
            raise DeviceError(f"--arch {device.arch}: time.motion: quasistatic runs on a CPU only; take --arch cpu")
        workers = 1
    elif device.arch == "cpu":
        # Workers wait by spinning, so more workers than cores would delay each other.
        cores = min(device.threads, available_threads() if cores is None else cores)
        workers = max(1, min(cores, rows * cols // POINTS_PER_WORKER, (rows - sum(fixed_rows)) // 2))
    else:
        workers = 0
    material, inner = plan.material, fixed[1:-1]
    config = base.KernelConfig(
        precision,
        lanes(precision),
        by_area=plan.areas_vary and material.by_area,
        by_point=material.shares is not None or bool((inner != inner[:1]).any()),
        curved=material.springs is not None and material.springs.rest is not None,
        terms=build_terms(plan),
    )
    if device.arch == "vulkan" and precision == "f64" and any(slot.moves for slot in plan.slots):
        raise DeviceError(
            "--arch vulkan: control points that move need exp in f64, which Vulkan lacks; take time.precision: f32 "
            "without a tolerance or an estimate of the error, or --arch cpu"
        )
    # A pass over a larger band takes several steps while a row is in the cache. Per mass point it reads displacement,
    # last difference and carried force, with three components each.
    point_bytes = 9 * DTYPES[precision].itemsize
    fits = workers == 0 or rows // workers * cols * point_bytes <= CACHED_BAND_BYTES
    depth = 1 if fits or config.reach > 1 else 8
    return SheetLayout(rows, cols, workers, depth, fixed_rows, config)


class SheetSolver(ABC, Generic[Kernel]):
    """A sheet that advances by steps; in quasi-static motion a frame counts as a step.

    A given `layout` replaces that of `choose_layout`, for tests. After `steps_done` steps an interruption can leave the
    arrays `inconsistent`; all methods but `restart` then raise MsmError.
    """

    def __init__(self, plan: Plan, device: Device, layout: SheetLayout | None = None, cores: int | None = None) -> None:
        self._device, self._given_layout, self._cores = device, layout, cores
        self.restart(plan)

    @staticmethod
    @abstractmethod
    def _build_kernel(plan: Plan, layout: SheetLayout, start: InitialData) -> Kernel:
        """Build the arrays of the sheet, with the kernels that move and read it."""

    def _begin(self, state: State | None) -> None:
        """Begin at a state, or at the sheet at rest."""
        self.steps_done = 0 if state is None else state.steps

    @property
    def kernel(self) -> Kernel:
        """The arrays of the sheet, with the kernels that move and read it; an MsmError after an interrupted restart."""
        if self._kernel is None:
            raise MsmError("interrupted while the sheet was restarted; restart the scene")
        return self._kernel

    def restart(self, plan: Plan, state: State | None = None) -> None:
        """Restart with the same or another plan, without compilation if only coefficients differ.

        By default the sheet is at rest; a state to continue from has the same mass points and steps.
        """
        self.inconsistent = True
        self._begin(state)
        self.plan, self.layout = plan, self._given_layout or choose_layout(plan, self._device, self._cores)
        self._dtype = DTYPES[self.layout.config.precision]
        self._kernel: Kernel | None = None  # Frees its memory before the new arrays are allocated.
        self._kernel = self._build_kernel(plan, self.layout, _initial_data(plan, self.layout, state))
        self.inconsistent = False

    def steer(self, plan: Plan) -> None:
        """Continue with a plan that differs in its probes only; an ArgumentError if they require other kernels."""
        config, terms = self.layout.config, build_terms(plan)
        if [tool.probe for tool in plan.tools] != [tool.probe for tool in self.plan.tools]:
            raise ArgumentError("probes: which of them have a path cannot change; restart with the new scene")
        for term in terms:
            compiled = config.get(type(term))
            if compiled and (reason := term.supports(compiled)):
                raise ArgumentError(f"probes: {reason}")
        if decay_parameters(plan) != decay_parameters(self.plan):
            probes = config.require(ProbeTerm)
            self.kernel.arrays.set_fields(config.fields(ProbeTerm).first, probes.fields(plan))
        self.plan = plan

    @abstractmethod
    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        """Advance by a number of steps; an exception from `pause`, called between launches, interrupts.

        Another call continues.
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
        self._kernel = None

    def _load_table(self, loads: Schedule, first: int) -> NDArray[Any]:
        """Return the load table of consecutive steps from `first` on, with a gain of 0, shape (steps, columns)."""
        config = self.layout.config
        table = np.zeros((len(loads.active), config.columns().end))
        for term in config.terms:
            table[:, config.columns(type(term)).all] = term.columns(self.plan, loads, first)
        # Loads too large for f32 become infinite; the next reading of the sheet detects it.
        with np.errstate(over="ignore"):
            return table.astype(self._dtype)

    def _measure(self, *, moving: bool) -> Reading:
        """Read and measure the sheet; with `moving`, the energy includes the kinetic energy."""
        displacement, measures = self._read_arrays(differences=False)
        config, plan = self.layout.config, self.plan
        springs = config.measures(SpringTerm)
        # The measures are (L^2 - L0^2) / L0^2.
        extremes = measures[:, springs.min_strain].min(), measures[:, springs.max_strain].max()
        shortest, longest = (math.sqrt(max(0.0, 1.0 + float(extreme))) for extreme in extremes)
        sums = measures.sum(axis=0, dtype=np.float64)
        energy = plan.material.mass * float(sums[base.SQUARED_MOTION]) / plan.grid.step**2 if moving else 0.0
        for term in config.terms:
            energy += term.energy(sums[config.measures(type(term)).all], plan)
        return Reading(self.steps_done, displacement, shortest, longest, energy / 2)

    def _read_arrays(self, *, differences: bool) -> tuple[NDArray[Any], NDArray[Any]]:
        """Read displacements or last differences, and measures of every row, see `SheetKernel.read`."""
        rows, cols, count = self.layout.rows, self.layout.cols, self.layout.config.measures().end
        values, measures = np.empty((rows, cols, 3), self._dtype), np.empty((rows, count), self._dtype)
        self.kernel.read(differences, values, measures)
        return values, measures

    def _read_memory(self) -> NDArray[Any]:
        """Read the numbers that terms remember, shape (numbers, rows, cols)."""
        indices = self.layout.config.memory_fields
        memory = np.empty((len(indices), self.layout.rows, self.layout.cols), self._dtype)
        for field, index in zip(memory, indices, strict=True):
            # The memory of fixed mass points has no effect, and only some kernels change it.
            field[:] = np.where(self.plan.fixed, 0, self.kernel.arrays.get_field(index))
        return memory


def _initial_data(plan: Plan, layout: SheetLayout, state: State | None) -> InitialData:
    sheet, config = plan.scene.sheet, layout.config
    column, areas, mobility = np.arange(layout.cols), rectangle_shares(sheet), plan.mobility
    by_column, places = np.empty((base.BY_COLUMN.count, layout.cols)), base.BY_COLUMN
    # One row of each kind: first, middle, last.
    by_column[places.mobility] = mobility[[0, layout.rows // 2, -1]]
    # Springs along columns read the shares of a middle row even in a sheet of two rows.
    by_column[places.area_share] = areas[0], 2 * areas[0], areas[-1]
    by_column[places.rest_x] = axes(sheet)[0]
    by_column[places.has_left] = column > 0
    by_column[places.has_right] = column < layout.cols - 1
    of_terms = (constant for term in config.terms for constant in term.constants(plan))
    constants = *spacing(sheet), sheet.size[0] / 2, *of_terms
    fields = [term.fields(plan) for term in config.terms]
    if config.curved:
        assert plan.material.springs is not None
        assert plan.material.springs.rest is not None
        fields.insert(0, np.moveaxis(plan.material.springs.rest, -1, 0))
    if config.by_point:
        fields.insert(0, np.stack([mobility] if config.by_area else [mobility, plan.area_shares]))
    all_fields = np.concatenate(fields)
    if state is not None and len(state.memory):
        all_fields[config.memory_fields] = state.memory
    return InitialData(np.array(constants), by_column, all_fields, state)
