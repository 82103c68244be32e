"""Quasi-static motion: each frame is the static equilibrium under its loads and tools, found from the previous frame.

A frame has converged when the largest residual force on a mass point is at most FORCE_TOLERANCE of the largest force of
a spring, a load or the foundation. FIRE (`kernel_rest`) minimises the energy from the previous frame with fictitious
masses, so a buckled sheet stays on its branch. If position-controlled tools move by more than half a radius between two
frames, or clamps by more than half the shortest spring, intermediate shapes are found first, with a larger tolerance.

An equilibrium can be unstable: a flat sheet compressed in its plane stays flat without a perturbation. Each frame is
therefore perturbed once, when the residual reaches PERTURBATION_TOLERANCE: every mass point is displaced at random, at
most by the displacement that the residual force would cause. In a stable equilibrium the perturbation decays. In an
unstable one it grows, and FIRE converges to the buckled shape. Only a sheet with compressed springs or in contact with
a tool can be unstable. For such a sheet the iteration continues to STABILITY_TOLERANCE, for up to four times the
evaluations. Weak instabilities can remain undetected, for example 1 % but not 3 % above a critical load
(tests/solver/test_rest.py).

A sheet without load and contact is set to the flat shape. Without tension the flat sheet has no stiffness out of its
plane, so the iteration would not converge to it.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import DivergedError, Pause
from taichi_msm.model.loads import evaluate_frame_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import clamps, solid_tools
from taichi_msm.scene.section import MIN_MAGNITUDE
from taichi_msm.solver.arrays import InitialData, SheetLayout
from taichi_msm.solver.dynamics import POINT_STEPS_PER_LAUNCH, Dynamics
from taichi_msm.solver.kernel_rest import Relaxation
from taichi_msm.solver.sheet_solver import SheetSolver
from taichi_msm.solver.state import Reading, State, largest_displacement
from taichi_msm.system.runtime import Device
from taichi_msm.terms import contact_rest, fictitious_masses
from taichi_msm.terms.contact import ContactTerm

# Residual forces, relative to the largest force: at convergence, at the perturbation, and at convergence of a sheet
# that can be unstable.
FORCE_TOLERANCE, PERTURBATION_TOLERANCE, STABILITY_TOLERANCE = 1e-7, 1e-3, 1e-9

# Smaller forces count as 0 [N].
MIN_FORCE_N = 1e-30

# Largest number of evaluations per mass point along the longer side, for a law without stiffening; a sheet that buckles
# takes up to 200. The fictitious masses are those of the locked sheet, which multiplies the evaluations by up to
# sqrt(factor).
MAX_EVALUATIONS = 2000


class QuasiStatics(SheetSolver[Relaxation]):
    """The sheet in quasi-static motion, solved by a single worker of a CPU.

    For the last frame it has the number of `evaluations` of the forces, and the largest `residual` force, relative to
    the largest force.
    """

    @staticmethod
    def _build_kernel(plan: Plan, layout: SheetLayout, start: InitialData) -> Relaxation:
        # A mass point without stiffness would have mass 0.
        return Relaxation(layout, start, np.maximum(fictitious_masses(plan.material, plan.scene.sheet), MIN_MAGNITUDE))

    def _begin(self, state: State | None) -> None:
        super()._begin(state)
        self.evaluations, self.residual = 0, 0.0
        # Without a state the first call of `advance` also finds the first frame.
        self._last_frame, self._interrupted = state, False

    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        """Find the equilibria of the next frames, and of the first frame if it is still missing.

        After an exception from `pause`, called between launches, another call continues from the last frame. A
        DivergedError reports an iteration that does not converge.
        """
        end = self.steps_done + steps
        while self._last_frame is None or self.steps_done < end:
            frame = self.steps_done + (self._last_frame is not None)
            self._settle(frame, pause)
            self.steps_done = frame
            displacement = self._read_arrays(differences=False)[0]
            self._last_frame = State(frame, displacement, np.zeros_like(displacement), self._read_memory())

    def compile(self) -> None:
        row = self._load_table(evaluate_frame_loads(self.plan, 0), 0)
        self.kernel.relax(0, 0.0, row)
        self.kernel.scale(row)
        self.displacement()

    def state(self) -> State:
        """Return the state of the last frame found; before the first one, the flat sheet."""
        if self._last_frame is not None:
            return self._last_frame
        shape = self.layout.rows, self.layout.cols
        memory = np.zeros((len(self.layout.config.memory_fields), *shape))
        return State(0, np.zeros((*shape, 3)), np.zeros((*shape, 3)), memory)

    def read(self) -> Reading:
        reading = self._measure(moving=False)
        return reading._replace(residual=self.residual, evaluations=self.evaluations)

    def tool_forces(self) -> Array:
        touched, force = self._touched().astype(float), self._read_arrays(differences=True)[0]
        # Subtraction from 0 avoids -0.
        return 0.0 - np.einsum("tij,ijk->tk", touched, force)

    def _touched(self) -> NDArray[np.bool_]:
        return contact_rest.touched_points(len(self.plan.tools), self._read_contact())

    def _read_contact(self) -> Array:
        return self._read_memory()[self.layout.config.memory(ContactTerm).all]

    def _write_contact(self, memory: Array) -> None:
        self.kernel.arrays.set_fields(self.layout.config.fields(ContactTerm).first, memory)

    def _settle(self, frame: int, pause: Pause) -> None:
        """Find the equilibrium of a frame from that of the previous frame, through intermediate shapes."""
        self.evaluations = 0
        before, loads = self.state(), evaluate_frame_loads(self.plan, frame)
        config, tools = self.layout.config, self.plan.tools
        contact_before = before.memory[config.memory(ContactTerm).all]
        contact = contact_rest.memory_after_grips(self.plan, frame, before.displacement, contact_before)
        gripped_before, grips = (contact_rest.is_gripping(tools, memory) for memory in (contact_before, contact))
        if tools:
            self._write_contact(contact)
        if self._interrupted:
            self.kernel.place(before.displacement)
        self._interrupted, residual, rough = True, 0.0, any(tool.rough for tool in tools)
        times = self._shape_times(frame)
        for start, time in pairwise(times):
            row = self._load_table(loads, frame)
            contact_rest.set_tools(self.plan, frame, time, row[0], config.columns(ContactTerm))
            # After the end of a grip the flat shape is tried even if a tool touches the sheet.
            free = not (loads.strength.any() or grips or self._is_clamp_displaced(time))
            free = free and (gripped_before or not self._meets_tool(time))
            tolerance = FORCE_TOLERANCE if time == times[-1] else PERTURBATION_TOLERANCE
            if rough:
                self._stick(frame, (start, time), row, pause)
            pull = math.inf
            while pull > tolerance:
                residual = self._balance(frame, row, tolerance, pause, free=free)
                pull = self._release(time, row, tolerance) if rough else 0.0
            residual = max(residual, pull)
        self._update_memory(row)
        self._interrupted, self.residual = False, residual

    def _update_memory(self, row: NDArray[Any]) -> None:
        """Evaluate the forces once more, if they change what terms remember."""
        config = self.layout.config
        changing = [term for term in config.terms if term.mark_update(row[0, config.columns(type(term)).all])]
        if changing:
            self.kernel.relax(1, math.inf, row)

    def _stick(self, frame: int, times: tuple[float, float], row: NDArray[Any], pause: Pause) -> None:
        """Stick mass points to the rough tools that reach them between the current shape and the next one."""
        plan, memory, start = self.plan, self._read_contact(), self._read_arrays(differences=False)[0]
        after = contact_rest.stick(plan, memory, start, start, times)
        if contact_rest.stuck_points(plan, memory).any() and (after != memory).any():
            # Until they stick, mass points move like a sheet without further contact, with an error of second order.
            smooth = contact_rest.without_rough_tools(plan, row, self.layout.config.columns(ContactTerm))
            self._relax(frame, smooth, PERTURBATION_TOLERANCE, pause)
            after = contact_rest.stick(plan, memory, start, self._read_arrays(differences=False)[0], times)
        self._write_contact(after)

    def _balance(self, frame: int, row: NDArray[Any], tolerance: float, pause: Pause, *, free: bool) -> float:
        """Find the shape in which all forces balance, the flat one if `free`; return the relative residual."""
        if free and not contact_rest.stuck_points(self.plan, self._read_contact()).any() and self._try_flat(row):
            return 0.0
        return self._relax(frame, row, tolerance, pause)

    def _release(self, time: float, row: NDArray[Any], tolerance: float) -> float:
        """Release mass points on which rough tools pull by more than a tolerance; return the largest relative pull."""
        memory = self._read_contact()
        shape, force = (self._read_arrays(differences=forces)[0] for forces in (False, True))
        pulls = contact_rest.compute_pulls(self.plan, memory, shape, force, time)
        largest = float(pulls.max()) / max(MIN_FORCE_N, self.kernel.scale(row))
        if largest > tolerance:
            self._write_contact(contact_rest.release(self.plan, memory, pulls))
        return largest

    def _meets_tool(self, time: float) -> bool:
        position = rest_positions(self.plan.scene.sheet) + self._read_arrays(differences=False)[0]
        free = position[~self.plan.fixed]
        return any(tool.touches(free, time) for tool in solid_tools(self.plan.tools).values())

    def _is_clamp_displaced(self, time: float) -> bool:
        return any(clamp.path_at(np.array([time])).any() for clamp in clamps(self.plan.tools).values())

    def _try_flat(self, row: NDArray[Any]) -> bool:
        """Set the flat shape if it is an equilibrium, and return whether it is."""
        relaxation, shape = self.kernel, self._read_arrays(differences=False)[0]
        relaxation.place(np.zeros_like(shape))
        count, force = relaxation.relax(1, 0.0, row)
        self.evaluations += count
        if force > 0:
            relaxation.place(shape)
        return force == 0

    def _shape_times(self, frame: int) -> list[float]:
        """Return the times of the previous frame, of the intermediate shapes and of a frame [s]."""
        rate = self.plan.grid.frames_per_second
        begin, end = max(0, frame - 1) / rate, frame / rate
        times = {float(time) for tool in self.plan.tools for time in tool.substep_times(begin, end)}
        return [begin, *sorted({end, *times})]

    def _relax(self, frame: int, row: NDArray[Any], tolerance: float, pause: Pause) -> float:
        """Iterate until the residual is below a tolerance; return it, both relative to the largest force."""
        relaxation, rows, cols = self.kernel, self.layout.rows, self.layout.cols
        relaxation.stop()
        per_launch = max(1, min(64, POINT_STEPS_PER_LAUNCH // (rows * cols)))
        laws = self.plan.material.stiffening, self.plan.material.virtual_stiffening
        steepest = max(law.largest_slope if law else 1.0 for law in laws)
        limit = math.ceil(MAX_EVALUATIONS * max(rows, cols) * math.sqrt(steepest))
        max_evaluations, evaluations = limit, 0
        perturbed, stability_evaluations = tolerance >= PERTURBATION_TOLERANCE, math.inf
        scale = max(MIN_FORCE_N, relaxation.scale(row))
        while True:
            # The first evaluation shows whether the sheet is already in equilibrium.
            is_first = evaluations == 0
            target = (tolerance if is_first or perturbed else PERTURBATION_TOLERANCE) * scale
            launched = 1 if is_first else min(per_launch, max_evaluations - evaluations)
            count, force = relaxation.relax(launched, target, row)
            evaluations += count
            scale = max(MIN_FORCE_N, relaxation.scale(row))
            if force <= min(target, tolerance * scale):
                converged = tolerance == FORCE_TOLERANCE
                if converged and not is_first and evaluations < stability_evaluations and self._may_be_unstable():
                    # An instability shows within these evaluations. A buckled shape has the same limit once more.
                    tolerance, stability_evaluations = STABILITY_TOLERANCE, min(4 * evaluations, limit)
                    max_evaluations = 2 * limit
                    continue
                self.evaluations += evaluations
                return force / scale
            if tolerance == STABILITY_TOLERANCE and (
                force > 10 * FORCE_TOLERANCE * scale or evaluations >= stability_evaluations
            ):
                tolerance = FORCE_TOLERANCE
            if not (force < np.inf and scale < np.inf) or evaluations >= max_evaluations:
                raise self._diverged(frame, force / scale, evaluations)
            if force <= target and not perturbed:
                self._perturb(force)
                perturbed = True
            pause()

    def _may_be_unstable(self) -> bool:
        """Return whether the equilibrium can be unstable, because of compressed springs or contact with a tool."""
        material = self.plan.material
        stiffest = 1.0 if material.factors is None else float(material.factors.max())
        # Rounding may shorten a spring by 1e-9.
        compressed = self.read().shortest_spring < 1 - material.tension / stiffest - 1e-9
        return compressed or bool(self._touched()[list(solid_tools(self.plan.tools))].any())

    def _perturb(self, force: float) -> None:
        """Displace every mass point at random, reproducibly, at most by the displacement due to a force [N]."""
        rows, cols = self.layout.rows, self.layout.cols
        # This generator returns the same numbers in every version of NumPy.
        noise = 2 * np.random.RandomState(0).random_sample((rows, cols, 3)) - 1
        moves = (~self.plan.fixed / self.kernel.masses)[..., None]
        self.kernel.place(self._read_arrays(differences=False)[0] + force * noise * moves)

    def _diverged(self, frame: int, residual: float, evaluations: int) -> DivergedError:
        plan, time = self.plan, frame / self.plan.grid.frames_per_second
        row, column, *_ = largest_displacement(self._read_arrays(differences=True)[0])
        support = "a foundation, pretension or, if it is flat, bending"
        remedy = f"the sheet may hang slack, fold or wrinkle; give it {support}, or take less load"
        if not (plan.is_held or plan.material.virtual > 0):
            sheet = "a part of the sheet" if plan.loose_parts else "the sheet"
            remedy = f"nothing holds {sheet}; fix a side, or give it a foundation"
        elif (self._touched().sum(axis=0) > 1).any():
            remedy = "two tools press on one point; keep them apart"
        message = (
            f"diverged at {time:.6g} s, frame {frame}: no equilibrium was found: after {evaluations} evaluations, "
            f"{residual:.2g} of the largest force remains as residual at point ({row}, {column}), above the tolerance "
            f"of {FORCE_TOLERANCE:g}; {remedy}"
        )
        return DivergedError(message, frame, time, (row, column))


def build_solver(
    plan: Plan, device: Device, layout: SheetLayout | None = None, cores: int | None = None
) -> SheetSolver[Any]:
    """Build the solver of a plan, dynamic or quasi-static, with the sheet at rest.

    A quasi-static one finds the first frame in its first call of `advance`.
    """
    return (QuasiStatics if plan.scene.time.at_rest else Dynamics)(plan, device, layout, cores)
