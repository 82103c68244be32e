"""Discretisation error of the mesh in a run of tissue, estimated by companion runs on coarser meshes.

If u_c is the displacement with cells r times as long, Richardson's extrapolation estimates the error of u as
|u - u_c| / (r^p - 1). The lattice has order p = 2 in the cell length where the displacement is smooth, and a lower one
at the rim of a tool's flat end, at an edge in a map, at a fixed edge without tension, and in wrinkles. Hence p is
measured with three runs: the run, and two with half and a quarter of its cells per side. An order above 2 shows that
the coarsest run is too coarse, and counts as somewhat less than 2. An order below 1 counts as 1, and so does the
unknown order of a mesh that is too small for a third run.

Each of the three runs has steps twice as long as the previous one, so the time-step error decreases together with the
mesh error. A coarse time-step companion, if any, replaces the run as the first of the three. The estimate includes up
to four times the time-step error, which is usually far smaller than the mesh error.

The estimate is doubled and reported as "at least" if the error may be larger: if the three runs do not converge, or if
tissue without bending is compressed, which wrinkles more on finer meshes.

With a mask the outline follows the cells. Its distance from the picture's outline is of order 1 in the cell length, and
varies from mesh to mesh as if by chance, so one difference may be small. Hence the order counts as 1, and the larger of
both differences counts, the second one scaled to the run with MASK_ORDER. On coarser meshes slits may close and bridges
vanish; the error is then "at least" the estimate, doubled (docs/decisions/0037).

The force of a tool that is hardly wider than a cell differs from its total, depending on the positions of the mass
points. The coarser runs have the same force as the run, and its difference from the total is added to the error.

Position-controlled tools touch one mass point after another, and few or none on a much coarser mesh. Hence there is one
companion run with 1 / sqrt(2) of the cells per side and half the steps. It is compared with the run itself, because a
coarse time-step companion may have other contacts, and the estimate is CONTACT_ERROR_FACTOR times the difference. A
difference above SECOND_RUN_DIFFERENCE is unreliable, because the tool may have left one of the two sheets earlier. A
second companion run with SECOND_CELL_RATIO of the cells per side then follows (docs/decisions/0027), and with a mask
always; the estimate is then CONTACT_ERROR_FACTOR times the larger difference.

With `springs`, a sheet with another mesh is a different sheet, so its error is undefined.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.companions import SECOND_CELL_RATIO
from taichi_msm.accuracy.interpolation import difference, same_outline
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.errors import DivergedError, Pause, ProgressCallback, SceneError
from taichi_msm.model.mask import Mask
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import MAX_CELL_ASPECT, Maps, cell_aspect_ratio
from taichi_msm.model.surface_checks import surface_problems
from taichi_msm.model.tool_force import sum_probe_forces
from taichi_msm.model.tools import overlap, solid_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import choose_precision, min_stable_steps, plan_variant
from taichi_msm.solver.rest import build_solver
from taichi_msm.system.runtime import Device

# Order p of the mesh error with position-controlled tools.
CONTACT_ORDER = 1.5

# Companion runs with position-controlled tools; differences are relative to the largest displacement.
CONTACT_CELL_RATIO = 1 / math.sqrt(2)  # cells per side of the first companion run, relative to the run
CONTACT_ERROR_FACTOR = 1.2  # estimated error, as a multiple of the difference
SECOND_RUN_DIFFERENCE = 0.3  # difference above which a second companion run follows, if affordable
UNRELIABLE_DIFFERENCE = 0.4  # difference above which the error is unknown without the second one
MAX_DIFFERENCE_RATIO = 8.0  # largest meaningful difference of the first companion run, relative to the second's
# Estimated error, as a multiple of the geometric mean of both differences. Grips hold other points on every mesh, and
# have the factor of a single difference.
SECOND_ERROR_FACTOR, SECOND_GRIP_ERROR_FACTOR = 0.8, 1.2
MAX_DIFFERENCE = 1.0  # largest meaningful difference from the last companion run
MIN_RADIUS_CELLS = 0.8  # smallest meaningful radius of a tool, in cells of the run

# Order of the difference between coarser runs with a mask: between 1 at the outline and 2 elsewhere.
MASK_ORDER = 1.5

# Largest refinement of the cells from one trial run of a search to the next.
MAX_CELL_REFINEMENT = 2.0

# Smallest number of mass points per side for which a sheet with half the cells is comparable.
MIN_POINTS_PER_SIDE = 7

# Reasons for an unknown or underestimated error.
NO_CONTACT = "a tool on a path meets no point"
NARROW_TIP = "the radius of a tool on a path is below 0.8 of a cell, so it touches hardly any point"
LARGE_STEP_ERROR = "the error of the time step is larger than the largest displacement"
NOT_CONVERGED = "runs with fewer points do not approach this run"
NO_COARSER_MESH = "there is no run with fewer points"
OUTLINE = "with fewer points slits of the mask close or bridges vanish; take more sheet.points"
SINGLE_RUN = "at an outline, one run with fewer points may agree by chance; --estimate-error adds a second one"
OVERLAP = "the instruments of two tools run through each other, so the solution is not unique"
WRINKLING = "tissue without bending wrinkles under compression, and more so with more points"


@dataclass(frozen=True)
class MeshEstimate:
    """Estimated discretisation error of the mesh."""

    error: float  # largest error, as a fraction of the largest displacement; infinite if unknown
    doubt: str = ""  # reason for a larger or unknown error; empty if the estimate is reliable
    at_most: bool = False  # whether the error may be much smaller, because of contact


def coarser_plan(plan: Plan, ratio: float = 0.5) -> Plan | None:
    """Plan the scene on a mesh with a ratio of the cells per side, and with the same total forces.

    Return None without tissue, with too few mass points, without a cell that is sheet, or with cells that are not
    allowed.
    """
    scene = plan.scene
    if scene.tissue is None or min(scene.sheet.points) < MIN_POINTS_PER_SIDE:
        return None
    cells = [ratio * (count - 1) for count in scene.sheet.points]
    if ratio == SECOND_CELL_RATIO:
        # Numbers of cells with the parity of the plan's, so that both meshes have a mass point in the middle, under a
        # tool, or neither has.
        pairs = zip(scene.sheet.points, cells, strict=True)
        cells = [count - 1 - 2 * round((count - 1 - few) / 2) for count, few in pairs]
    # Numbers of cells are rounded up or down, to keep the aspect ratio of the cells below its limit.
    options = product(*({math.ceil(count) + 1, math.floor(count) + 1} for count in cells))
    scenes = [with_points(scene, (rows, cols)) for rows, cols in options]
    valid = [option for option in scenes if _allows_cells(option)]
    if not valid:
        return None

    def deviation(option: Scene) -> tuple[bool, float]:
        cell_counts = (count - 1 for count in option.sheet.points)
        distance = sum(abs(count - cell) for count, cell in zip(cell_counts, cells, strict=True))
        return not same_outline(scene.sheet, option.sheet), distance

    coarse = min(valid, key=lambda option: (deviation(option), option.sheet.points))
    probes = tuple(_with_equal_force(probe, scene.sheet, coarse.sheet) for probe in scene.probes)
    return plan_variant(plan, coarse.model_copy(update={"probes": probes}))


def _allows_cells(scene: Scene) -> bool:
    mask = scene.sheet.mask
    if mask is not None and not Mask.at_cells(mask.pixels.is_sheet, scene.sheet.points).cells.any():
        return False
    if scene.sheet.surface:
        return not any(surface_problems(scene))
    return cell_aspect_ratio(scene.sheet) <= MAX_CELL_ASPECT


def mesh_companion_plan(plan: Plan) -> Plan | None:
    """Plan the first companion run on a coarser mesh; None where `coarser_plan` returns None."""
    return coarser_plan(plan, CONTACT_CELL_RATIO) if plan.has_contact else coarser_plan(plan)


def _with_equal_force(probe: Probe, sheet: Sheet, coarse: Sheet) -> Probe:
    """Scale the total of a probe, by 1/2 to 2, so that its force is the same on both meshes."""
    if probe.total is None:
        return probe
    force, coarse_force = sum_probe_forces(probe, sheet)[0], sum_probe_forces(probe, coarse)[0]
    if not 0.5 * coarse_force < force < 2 * coarse_force:
        return probe
    return probe.with_force(force / coarse_force)


def _sampling_force_error(probes: Sequence[Probe], sheet: Sheet) -> float:
    """Return the largest relative difference between a tool's force on the mesh and on a much finer mesh."""
    # The force of a tool is summed over at most 4 million mass points, of a curved sheet, which is kept, over fewer.
    max_points = 4_000_000 if sheet.surface is None else 250_000
    refinement = min(8, math.isqrt(max_points // math.prod(sheet.points)))
    if refinement < 2:
        return 0.0  # With cells this small, no tool is as narrow as a cell.
    pushing = [probe for probe in probes if probe.total is not None]
    pairs = [(sum_probe_forces(probe, sheet)[0], sum_probe_forces(probe, sheet, refinement)[0]) for probe in pushing]
    return max((abs(force / fine_force - 1) for force, fine_force in pairs if fine_force > 0), default=0.0)


class MeshCompanion:
    """Companion runs in f64 on coarser meshes, compared with a run frame by frame.

    The first one has the plan of `mesh_companion_plan`, or SECOND_CELL_RATIO. Without position-controlled tools, a
    second one has half of its cells per side. With contact, `step_ratio` is the number of steps relative to the run. A
    device without f64 raises a DeviceError.
    """

    def __init__(
        self, plan: Plan, coarse: Plan, device: Device, cores: int | None = None, step_ratio: float = 0.5
    ) -> None:
        self._sheet, self._material, steps = plan.scene.sheet, plan.material, plan.grid.steps_per_frame
        coarsest = None if plan.has_contact else coarser_plan(coarse)
        plans = [coarse] if coarsest is None else [coarse, coarsest]
        self._solvers = []
        for companion in plans:
            # With contact, steps are limited in length, because a tool must not move too far in a step.
            min_steps = math.ceil(plan.grid.steps_per_frame * step_ratio) if plan.has_contact else 1
            steps = 1 if plan.scene.time.at_rest else max(math.ceil(steps / 2), min_stable_steps(companion), min_steps)
            in_f64 = companion.with_grid(precision="f64", steps_per_frame=steps)
            self._solvers.append(build_solver(in_f64, device, cores=cores))
        sheets = [plan.scene.sheet, *(companion.scene.sheet for companion in plans)]
        self._masked = plan.scene.sheet.mask is not None
        self._same_outline = all(same_outline(*pair) for pair in pairwise(sheets))
        points = zip(plan.scene.sheet.points, coarse.scene.sheet.points, strict=True)
        # Cells of the run per cell of the first companion run, along a side.
        self._ratio = min((count - 1) / (fewer - 1) for count, fewer in points)
        self._differences = [0.0 for _ in plans]
        self._sampling_error = _sampling_force_error(plan.scene.probes, plan.scene.sheet)
        self._contact, self._grips = plan.has_contact, any(tool.grips for tool in plan.tools)
        cell = rest_of(plan.scene.sheet).longest_side
        narrow = [tool for tool in solid_tools(plan.tools).values() if tool.radius < MIN_RADIUS_CELLS * cell]
        overlaps = overlap(plan.tools, plan.scene.time.duration) is not None
        # Reason for an unknown error that does not depend on the companion runs.
        is_narrow = any(tool.reaches(plan.scene) for tool in narrow)
        self._unknown = NARROW_TIP if is_narrow else OVERLAP if overlaps else ""
        self._largest, self._shortest_spring = 0.0, 1.0
        self._second_run: MeshCompanion | None = None

    def compile(self) -> None:
        """Compile the kernels before the first frame."""
        self._solvers[0].compile()

    def compare_frame(self, displacement: NDArray[Any], pause: Pause) -> None:
        """Step to the next frame and compare it with the displacements of the run [m], shape (rows, cols, 3).

        After an exception from `pause`, the companion runs cannot continue.
        """
        self._largest = max(self._largest, max_norm(displacement))
        finer, sheet = displacement, self._sheet
        for n, solver in enumerate(self._solvers):
            if self._differences[n] == math.inf:
                return
            try:
                solver.advance(solver.plan.grid.steps_per_frame, pause)
            except DivergedError:  # Without an equilibrium the error is unknown.
                self._differences[n] = math.inf
                return
            reading = solver.read()
            with np.errstate(all="ignore"):
                coarse = solver.plan.scene.sheet
                largest = max_norm(difference(finer, reading.displacement, sheet, coarse))
                self._differences[n] = max(self._differences[n], largest)
            finer, sheet = reading.displacement, coarse
            self._shortest_spring = min(self._shortest_spring, reading.shortest_spring)

    def tool_forces(self) -> NDArray[np.float64]:
        """Return the mean tool forces of the first companion run since the previous frame [N], shape (tools, 3)."""
        return self._solvers[0].tool_forces()

    def build_second_run(self, plan: Plan, device: Device, cores: int | None = None) -> MeshCompanion | None:
        """Return the second companion run, which begins at the first frame; None if the first one suffices."""
        if self._contact and not self._unknown and self._needs_second_run:
            coarse = coarser_plan(plan, SECOND_CELL_RATIO)
            if coarse is not None:
                self._second_run = MeshCompanion(plan, coarse, device, cores, SECOND_CELL_RATIO)
        return self._second_run

    @property
    def _needs_second_run(self) -> bool:
        return self._masked or self._relative_difference > SECOND_RUN_DIFFERENCE

    @property
    def _relative_difference(self) -> float:
        """Largest difference of the first companion run, relative to the largest displacement so far."""
        return self._differences[0] / self._largest if self._largest > 0 else 0.0

    @property
    def estimate(self) -> MeshEstimate:
        """Estimate from the frames so far."""
        if self._largest == 0:
            return MeshEstimate(math.inf, NO_CONTACT) if self._contact else MeshEstimate(0.0)
        first, *others = self._differences
        if not first / self._largest < math.inf and self._second_run is None:
            return MeshEstimate(math.inf, "the run with fewer points diverged")
        if self._contact:
            return self._contact_estimate(first / self._largest)
        order = 1.0
        if others and first > 0:
            order = math.log(others[0] / first) / math.log(self._ratio) if others[0] > 0 else -math.inf
        converges = order >= 0 if self._masked else 1 <= order <= 3
        doubt = self._doubt if converges else "runs with fewer points do not converge"
        if self._masked:
            first, order = max([first, *(other / self._ratio**MASK_ORDER for other in others)]), 1.0
        # An order above 2 counts as 2 minus a quarter of the excess (docs/decisions/0022).
        assumed_order = max(1.0, min(order, 2 - (order - 2) / 4))
        relative = first / (self._ratio**assumed_order - 1) / self._largest
        # Order 1 already includes wrinkles.
        certain = not doubt or (self._masked and doubt == WRINKLING)
        return MeshEstimate((1 if certain else 2) * relative + self._sampling_error, doubt)

    @property
    def _doubt(self) -> str:
        """Reason for a larger error than that of converging runs; empty without one."""
        second = self._second_run
        if not (self._same_outline and (second is None or second._same_outline)):
            return OUTLINE
        if self._masked and self._contact and second is None:
            return SINGLE_RUN
        # The shortest spring is compressed by more than 1e-4 of its rest length.
        compressed = self._shortest_spring < 1 - self._material.tension - 1e-4
        return WRINKLING if self._material.bending == 0 and compressed else ""

    def _contact_estimate(self, difference: float) -> MeshEstimate:
        """Estimate the error from the relative difference of the first companion run."""
        if self._unknown:
            return MeshEstimate(math.inf, self._unknown)
        error = CONTACT_ERROR_FACTOR * difference
        if self._needs_second_run:
            second = math.inf if self._second_run is None else self._second_run._relative_difference
            factor = SECOND_GRIP_ERROR_FACTOR if self._grips else SECOND_ERROR_FACTOR
            limited = min(difference, MAX_DIFFERENCE_RATIO * second)
            if second <= MAX_DIFFERENCE and self._masked:
                error = CONTACT_ERROR_FACTOR * max(limited, second)
            elif second <= MAX_DIFFERENCE:
                error = factor * math.sqrt(limited * second)
            elif self._second_run is not None or difference > UNRELIABLE_DIFFERENCE:
                return MeshEstimate(math.inf, NOT_CONVERGED)
        return MeshEstimate(error + self._sampling_error, self._doubt, at_most=True)


def with_points(scene: Scene, points: tuple[int, int]) -> Scene:
    """Return a copy of a scene with another mesh, (rows, cols), and without `sheet.tolerance`."""
    sheet = scene.sheet.model_copy(update={"points": points, "tolerance": None})
    return scene.model_copy(update={"sheet": sheet.with_kept_frame()})


def choose_points(
    plan: Plan,
    device: Device,
    check: Callable[[Scene, Maps | None], Plan],
    progress: ProgressCallback = lambda done, total: None,
) -> tuple[Plan, MeshEstimate]:
    """Return a plan with about the coarsest mesh whose error is within the sheet's tolerance, and the estimated error.

    The search begins with the plan's mesh, and keeps the shape of the cells; `check` validates a scene with given maps
    and plans it. Raise a SceneError when no mesh within the limits meets the tolerance, or a mesh of the search is
    invalid.
    """
    tolerance, given = plan.scene.sheet.tolerance, plan.scene.sheet.points
    assert tolerance is not None
    refinement = max(1.0, (MIN_POINTS_PER_SIDE - 1) / (min(given) - 1))
    max_refinement = (MAX_POINTS - 1) / (max(given) - 1)
    for _ in range(10):
        rows, cols = (round((count - 1) * refinement) + 1 for count in given)
        try:
            trial = choose_precision(check(with_points(plan.scene, (rows, cols)), plan.maps), device.arch)
        except SceneError as error:
            reason = f"with the {rows} x {cols} points that sheet.tolerance: {tolerance:g} requires"
            raise SceneError([f"{line} ({reason})" for line in error.lines]) from None
        estimate = estimate_mesh_error(trial, device, progress)
        if estimate.error <= tolerance:
            return trial, estimate
        # The error decreases at most with the square of the cell length. A target of 0.8 of the tolerance leads to
        # nearly the coarsest mesh.
        needed = refinement * math.sqrt(estimate.error / (0.8 * tolerance))
        if estimate.doubt in (NARROW_TIP, NOT_CONVERGED, NO_COARSER_MESH) and needed == math.inf:
            needed = MAX_CELL_REFINEMENT * refinement  # On a finer mesh the error is known.
        if needed > max_refinement:
            break
        refinement *= min(MAX_CELL_REFINEMENT, max(1.1, needed / refinement))
    reached = f"sheet.tolerance: {tolerance:g} is out of reach: with {rows} x {cols} points the error is "
    if estimate.error == math.inf:
        raise SceneError([f"{reached}not known: {estimate.doubt}; change the paths, or leave out sheet.tolerance"])
    raise SceneError(
        [
            f"{reached}{estimate.error:.2g}, and no sheet has more than {MAX_POINTS} points a side; take a wider tool "
            "(probes.N.radius, a smaller falloff) or a larger tolerance, or prevent wrinkles by tissue.pretension, or "
            "bending of a flat sheet, with every side fixed"
        ]
    )


def estimate_mesh_error(plan: Plan, device: Device, progress: ProgressCallback) -> MeshEstimate:
    """Return the mesh error of a scene, by a run and its companion runs, all in f64."""
    in_f64, coarse, grid = plan.with_grid(precision="f64"), mesh_companion_plan(plan), plan.grid
    if coarse is None:
        return MeshEstimate(math.inf, NO_COARSER_MESH)
    first = MeshCompanion(in_f64, coarse, device)
    companion: MeshCompanion | None = first
    while companion is not None:
        dynamics = build_solver(in_f64, device)
        for frame in range(grid.frames):
            pause = partial(progress, frame, grid.frames)
            pause()
            dynamics.advance(grid.steps_per_frame, pause)
            companion.compare_frame(dynamics.displacement(), pause)
        companion = first.build_second_run(in_f64, device) if companion is first else None
    return first.estimate
