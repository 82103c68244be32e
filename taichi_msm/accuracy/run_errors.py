"""Error estimates of a run from its companion runs, and all warnings about the run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.buckling import buckling_warnings
from taichi_msm.accuracy.companions import (
    MESH_DOUBT,
    MESH_REMEDY,
    NEGLIGIBLE_ERROR,
    QUASISTATIC_REASON,
    CompanionRuns,
)
from taichi_msm.accuracy.contact_warnings import tool_contact_warnings
from taichi_msm.accuracy.divergence import energy_growth_warnings
from taichi_msm.accuracy.mask import mask_notes
from taichi_msm.accuracy.mesh import (
    LARGE_STEP_ERROR,
    MAX_DIFFERENCE,
    NO_CONTACT,
    NOT_CONVERGED,
    WRINKLING,
    MeshCompanion,
    MeshEstimate,
    mesh_companion_plan,
    with_points,
)
from taichi_msm.accuracy.surface import surface_notes
from taichi_msm.accuracy.time_step import TimeStepCompanion, TimeStepEstimate, combine_estimates
from taichi_msm.errors import Pause, ProgressCallback
from taichi_msm.model import tool_force
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tool_force import ProbeRecord
from taichi_msm.model.tools import COARSE_TIP_PHRASE, MAX_POINTS_RATIO, path_warnings, solid_tools
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.scene.sheet import Foundation
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import plan_variant
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device

# Error of a tool's force, as a multiple of its root-mean-square difference from the companion run over the frames with
# contact (docs/decisions/0027).
FORCE_ERROR_FACTOR = 1.15

# Smallest relative error of a tool's force, as a multiple of the mesh error of the displacement, because the forces of
# both runs may be equal by chance. The largest one, with contact, is the error of the displacement
# (docs/decisions/0027).
MIN_FORCE_ERROR_FACTOR = 0.4

# The same with a mask, because at an outline the forces depend on its position as much as the displacement does
# (docs/decisions/0037).
MIN_MASK_FORCE_ERROR_FACTOR = 0.7

# Smallest relative error of the force of a grip, as a multiple of the cell's side over the radius of the tool: the edge
# of the held points is uncertain by a part of a cell, and in a pull along the sheet the displacement far more.
GRIP_FORCE_ERROR_FACTOR = 0.15

# Smallest ratio of a spring's length to its rest length for which the stability limit holds, see
# `SpringTerm.stiffness_bound`.
MIN_SPRING_RATIO = 0.5

# Smallest error for which a remedy is suggested, relative to the largest displacement.
REMEDY_THRESHOLD = 0.01


class ForceEstimate(NamedTuple):
    """Estimated error of the forces of position-controlled tools."""

    error: float | None  # largest of any tool at any frame, as a fraction of the greatest force; None if unknown
    doubt: str = ""  # reason for an unknown error


class RunErrorEstimates(NamedTuple):
    """Estimated errors of a run."""

    time_step: TimeStepEstimate | None = None  # error of the time step and of rounding; None if not estimated
    reason: str = ""  # reason for the missing estimate
    mesh: MeshEstimate | None = None  # discretisation error of the mesh; None if not estimated
    force: ForceEstimate | None = None  # error of the forces of position-controlled tools; None without such tools


class RunErrorEstimator:
    """Companion runs of a run, and the errors that they estimate.

    Errors known from the searches for a step and a mesh before the run are not estimated again. A device without f64
    raises a DeviceError.
    """

    def __init__(
        self, plan: Plan, companions: CompanionRuns, known: RunErrorEstimates, device: Device, cores: int
    ) -> None:
        self._plan, self._companions, self._known = plan, companions, known
        self._device, self._cores = device, cores
        steps = companions.concurrent_steps
        self._coarse = known.time_step is None and 0 < steps < plan.grid.steps_per_frame
        estimates_step = known.time_step is None and not companions.reason
        self._time_step = TimeStepCompanion(plan, steps, device, cores) if estimates_step else None
        coarse = mesh_companion_plan(plan) if companions.mesh and known.mesh is None else None
        # Without contact, coarser meshes are compared with the coarse time-step companion, if any.
        self._mesh_follows_coarse = self._coarse and not plan.has_contact
        reference = plan.with_grid(steps_per_frame=steps) if self._mesh_follows_coarse else plan
        self._mesh = None if coarse is None else MeshCompanion(reference, coarse, device, cores)
        self._squared_errors, self._contact_frames, self._max_force = np.zeros((3, len(plan.tools)))
        self._forces: list[NDArray[np.float64]] = []  # of the tools at every frame, with a mask

    def compile(self) -> None:
        """Compile the kernels before the first frame."""
        for companion in (self._time_step, self._mesh):
            if companion is not None:
                companion.compile()

    def compare_frame(self, displacement: NDArray[Any], pause: Pause, forces: NDArray[np.float64]) -> None:
        """Step to the next frame and compare it with the displacements of the run [m], shape (rows, cols, 3).

        The forces of the position-controlled tools [N], shape (tools, 3), are means since the previous frame. After an
        exception from `pause`, the companion runs cannot continue.
        """
        if self._time_step is not None:
            self._time_step.compare_frame(displacement, pause)
        if self._mesh is not None:
            coarse = self._time_step if self._mesh_follows_coarse else None
            self._mesh.compare_frame(coarse.displacement if coarse else displacement, pause)
        if self._plan.tools and self._mesh is not None:
            coarse_forces = self._mesh.tool_forces()
            if self._plan.scene.sheet.mask is not None:
                self._forces.append(forces)
            error = FORCE_ERROR_FACTOR * np.abs(forces - coarse_forces)
            if self._time_step is not None:
                error = np.maximum(error, self._time_step.force_error(forces))
            self._squared_errors += (error**2).sum(axis=1)
            self._contact_frames += forces.any(axis=1) | coarse_forces.any(axis=1)
            self._max_force = np.maximum(self._max_force, np.linalg.norm(forces, axis=1))

    def finish(self, displacements: Iterator[NDArray[Any]] | None, progress: ProgressCallback) -> None:
        """Run the subsequent companion runs after the last frame, if the first ones require any.

        Displacements of the run [m], shape (rows, cols, 3), are those of all frames but the first; None to repeat the
        run.
        """
        first = self._time_step
        fine_steps, fine, second_mesh = self._companions.subsequent_steps, None, None
        if first is not None and fine_steps and first.estimate.error >= NEGLIGIBLE_ERROR:
            fine = TimeStepCompanion(self._plan, fine_steps, self._device, self._cores)
        if self._mesh is not None and self._companions.second_mesh:
            second_mesh = self._mesh.build_second_run(self._plan, self._device, self._cores)
        companions = [companion for companion in (fine, second_mesh) if companion is not None]
        if not companions:
            return
        frames, squared_errors = self._plan.grid.frames, np.zeros(len(self._plan.tools))
        for frame, displacement in enumerate(displacements or self._repeated(), 1):
            for companion in companions:
                companion.compare_frame(displacement, partial(progress, frame, frames))
            # At an outline the forces of one companion run may agree by chance.
            if second_mesh is not None and self._plan.scene.sheet.mask is not None:
                error = FORCE_ERROR_FACTOR * (self._forces[frame - 1] - second_mesh.tool_forces())
                squared_errors += (error**2).sum(axis=1)
        self._squared_errors = np.maximum(self._squared_errors, squared_errors)
        if first is not None and fine is not None:
            self._known = self._known._replace(time_step=combine_estimates(first.estimate, fine.estimate))

    def _repeated(self) -> Iterator[NDArray[Any]]:
        dynamics = Dynamics(self._plan, self._device, cores=self._cores)
        for _ in range(self._plan.grid.frames):
            dynamics.advance(self._plan.grid.steps_per_frame)
            yield dynamics.displacement()

    @property
    def estimates(self) -> RunErrorEstimates:
        """Estimates from the frames so far."""
        known = self._known
        if known.time_step is None and self._time_step is not None:
            estimate = self._time_step.estimate
            # After a coarse companion run the error may be larger; in f32 the estimate is already an upper bound.
            if self._coarse and estimate.separate and NEGLIGIBLE_ERROR <= estimate.error < math.inf:
                estimate = replace(estimate, at_least=True)
            known = known._replace(time_step=estimate)
        if self._mesh is not None:
            known = known._replace(mesh=self._mesh.estimate)
            # A tool that passes between the mass points, and not one that stays clear of the sheet.
            idle = [tool for n, tool in solid_tools(self._plan.tools).items() if not self._max_force[n]]
            if any(tool.reaches(self._plan.scene) for tool in idle):
                known = known._replace(mesh=MeshEstimate(math.inf, NO_CONTACT))
            elif self._plan.has_contact and known.time_step is not None and known.time_step.error > MAX_DIFFERENCE:
                known = known._replace(mesh=MeshEstimate(math.inf, LARGE_STEP_ERROR))
        return known._replace(force=self._force_estimate(known)) if self._plan.tools else known

    def _force_estimate(self, known: RunErrorEstimates) -> ForceEstimate:
        mesh = known.mesh
        if self._mesh is None or mesh is None:
            reason = "there is no run with fewer points"
            return ForceEstimate(None, reason if mesh is None else "the search for sheet.tolerance compares no forces")
        if mesh.error == math.inf:
            return ForceEstimate(None, mesh.doubt)
        if not self._max_force.any():
            return ForceEstimate(0.0)
        root_mean_square = np.sqrt(self._squared_errors / np.maximum(self._contact_frames, 1)).max()
        relative = float(root_mean_square / self._max_force.max())
        if relative > FORCE_ERROR_FACTOR * MAX_DIFFERENCE:
            return ForceEstimate(None, NOT_CONVERGED)
        masked = self._plan.scene.sheet.mask is not None and self._plan.has_contact
        smallest = (MIN_MASK_FORCE_ERROR_FACTOR if masked else MIN_FORCE_ERROR_FACTOR) * mesh.error
        if radii := [tool.radius for tool in solid_tools(self._plan.tools).values() if tool.grips]:
            smallest = min(
                smallest, GRIP_FORCE_ERROR_FACTOR * rest_of(self._plan.scene.sheet).longest_side / min(radii)
            )
        relative = max(relative, smallest)
        if not self._plan.has_contact:
            return ForceEstimate(relative)
        displacement_error = max(mesh.error, known.time_step.error if known.time_step is not None else 0.0)
        return ForceEstimate(min(relative, displacement_error))


def run_warnings(
    plan: Plan,
    probes: Sequence[ProbeRecord],
    progress: RunProgress,
    errors: RunErrorEstimates,
    affords: Callable[[Plan], bool] = lambda plan: True,
    scale: float | None = None,
) -> Iterator[str]:
    """Yield the error estimates and warnings of a run up to its last frame, a line of text each.

    `affords`: whether a plan runs within an hour; `scale`: pixels per metre at the middle of the sheet, None without a
    picture.
    """
    scene, grid = plan.scene, plan.grid
    time_step, reason, mesh, force = errors
    if time_step is not None or mesh is not None:
        unknown = "; mesh error unknown: another number of points is another sheet" if scene.tissue is None else ""
        yield _error_line(time_step, mesh, progress.max_displacement, scale) + unknown
    if time_step is not None:
        if REMEDY_THRESHOLD < time_step.error < math.inf and not time_step.separate:
            yield "--estimate-error separates the errors of the time step and of rounding"
        elif REMEDY_THRESHOLD < time_step.error < math.inf:
            source = "the time step" if time_step.in_f64 > REMEDY_THRESHOLD / 2 else "rounding"
            yield f"for a smaller error of {source}, {_step_remedy(plan, time_step, affords)}"
    elif reason == QUASISTATIC_REASON:
        if mesh is None:
            yield "error not estimated: a quasi-static scene has no time step"
    elif reason:
        yield f"error {'of the time step ' if mesh is not None else ''}not estimated: {reason}"
    if force is not None:
        if force.error is None:
            yield f"force error not known: {force.doubt}"
        else:
            yield f"force error at most about {_percent(force.error, 2)} % of the greatest force"
    yield from surface_notes(scene)
    yield from mask_notes(plan)
    yield from tool_force.force_warnings(scene, probes)
    tool_warnings = list(path_warnings(scene, plan.tools))
    yield from tool_warnings
    yield from tool_contact_warnings(plan, progress)
    yield from buckling_warnings(plan, progress)
    yield from energy_growth_warnings(plan, progress)
    if mesh is not None and mesh.doubt and mesh.error < math.inf:
        yield f"{MESH_DOUBT}: {mesh.doubt}"
    # The warning about a mesh that is too coarse for a tool already contains the remedy.
    too_coarse_for_tool = any(COARSE_TIP_PHRASE in warning for warning in tool_warnings)
    if mesh is not None and REMEDY_THRESHOLD < mesh.error < math.inf and not too_coarse_for_tool:
        yield f"{MESH_REMEDY}, {_mesh_remedy(plan, mesh, affords)}"
    if progress.max_displacement == 0 and progress.frame > 0:
        yield "nothing moved: check at, load or path of the probes"
    foundation = scene.tissue.foundation if scene.tissue is not None else None
    if isinstance(foundation, Foundation) and not foundation.lock and progress.deepest > foundation.depth / 3:
        yield (
            f"the sheet was pressed {1000 * progress.deepest:.3g} mm into the {1000 * foundation.depth:.3g} mm of "
            "tissue.foundation.depth: beyond a third, tissue is much stiffer than this foundation, so true dents by a "
            "force are less deep, and true forces along a path larger; press less"
        )
    if progress.longest_spring > 2:
        yield (
            f"a spring was stretched to {progress.longest_spring:.2g} times its rest length, which no tissue "
            "withstands: press less, or with a wider tool"
        )
    if progress.shortest_spring < MIN_SPRING_RATIO:
        yield (
            f"a spring was pressed to {progress.shortest_spring:.2g} of its rest length: below {MIN_SPRING_RATIO} the "
            "sheet folds over itself and small errors grow; press less"
        )
    damping_ratio, resolved = plan.material.drag * grid.step, scene.time.integrator.resolved_damping
    if damping_ratio > resolved:
        yield (
            f"the time step is {damping_ratio:.3g} times the time constant of the damping, so velocities change their "
            f"sign at every step; take a time.step of at most {resolved * grid.step / damping_ratio:.2g} s"
        )


def _error_line(
    estimate: TimeStepEstimate | None, mesh: MeshEstimate | None, max_displacement: float, scale: float | None
) -> str:
    """Format the estimated errors of a run; for the arguments see `run_warnings`."""
    if estimate is not None and estimate.error == math.inf:
        return "error not known: a companion run diverged, or steps do not resolve the damping"
    parts, errors, sentences = [], [], []
    if estimate is not None:
        bound = _bound_words(estimate.at_most or not estimate.separate, estimate.at_least)
        name = "time step" if estimate.separate else "time step and rounding"
        parts.append(f"{name} {bound}{_percent(estimate.in_f64 if estimate.separate else estimate.error, 1)} %")
        if estimate.separate and estimate.rounding:
            parts.append(f"rounding {_percent(estimate.rounding, 1)} %")
        errors.append(estimate.error)
    if mesh is not None and mesh.error < math.inf:
        parts.append(f"mesh {_bound_words(mesh.at_most, bool(mesh.doubt))}{_percent(mesh.error, 2)} %")
        errors.append(mesh.error)
    if errors:
        distance = max(errors) * max_displacement
        pixels = f", {_digits(distance * scale)} px" if scale is not None else ""
        size = f"{_digits(1000 * max_displacement, 2)} mm ({_digits(1000 * distance)} mm{pixels})"
        sentences.append(f"estimated error: {', '.join(parts)} of {size}")
    if mesh is not None and mesh.error == math.inf:
        sentences.append(f"mesh error not known: {mesh.doubt}")
    return "; ".join(sentences)


def _bound_words(at_most: bool, at_least: bool) -> str:
    """Return the qualifier of an error that may be smaller, larger or both."""
    return ("roughly " if at_least else "at most about ") if at_most else "at least " if at_least else ""


def _percent(fraction: float, digits: int) -> str:
    return _digits(100 * fraction, digits)


def _digits(number: float, digits: int = 1) -> str:
    """Format a number with significant digits, and without an exponent unless it is tiny or huge."""
    rounded = float(f"{number:.{digits}g}")
    return np.format_float_positional(rounded, trim="-") if 1e-6 <= rounded < 1e6 or not rounded else f"{rounded:g}"


def _mesh_remedy(plan: Plan, mesh: MeshEstimate, affords: Callable[[Plan], bool]) -> str:
    """Suggest a remedy for the mesh error: a finer mesh with at most `MAX_POINTS_RATIO` times the mass points."""
    if mesh.doubt == WRINKLING:
        # A curved sheet has no bending.
        remedies = "tissue.pretension" if plan.scene.sheet.surface else "tissue.bending or tissue.pretension"
        edge = "the outline" if plan.scene.sheet.mask else "every side"
        return f"hold {edge} and set {remedies}; otherwise a finer mesh has finer wrinkles"
    refinement = min(math.sqrt(mesh.error / (REMEDY_THRESHOLD / 2)), math.sqrt(MAX_POINTS_RATIO))
    rows, cols = (math.ceil((count - 1) * refinement) + 1 for count in plan.scene.sheet.points)
    if max(rows, cols) < MAX_POINTS and affords(plan_variant(plan, with_points(plan.scene, (rows, cols)))):
        return f"try sheet.points: {[rows, cols]}"
    return "take a wider tip or a smaller sheet; more sheet.points would take more than an hour"


def _step_remedy(plan: Plan, estimate: TimeStepEstimate, affords: Callable[[Plan], bool]) -> str:
    remedies = []
    if estimate.rounding > REMEDY_THRESHOLD / 2:
        remedies.append("time.precision: f64")
    if estimate.in_f64 > REMEDY_THRESHOLD / 2:
        steps = plan.grid.steps_per_frame * (estimate.in_f64 / (REMEDY_THRESHOLD / 2)) ** (1 / estimate.order)
        finer = replace(plan.grid, steps_per_frame=math.ceil(steps))
        if not affords(replace(plan, grid=finer)):
            return "take fewer sheet.points: with these, the required steps take more than an hour"
        remedies.insert(0, f"time.step: {finer.step:.9g}")
    return f"try {', or '.join(remedies)}"
