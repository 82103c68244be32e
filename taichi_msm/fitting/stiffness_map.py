"""Fit of a stiffness map: factors of Young's modulus, and their standard errors."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from taichi_msm.accuracy.mesh import coarser_plan
from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError, StageProgressCallback
from taichi_msm.fitting.checks import faults, faults_at_start
from taichi_msm.fitting.parameters import Bounds, Parameter, Request, make_parameters, rounded
from taichi_msm.fitting.points import PointModel, PointObservation
from taichi_msm.fitting.predict import FitProblem, Prediction, mesh_error, without_outputs
from taichi_msm.fitting.profiles import ProfilePoint
from taichi_msm.fitting.rejection import by_chi_square
from taichi_msm.fitting.result import Estimate, FitResult, FittedMap
from taichi_msm.fitting.tikhonov import MapGrid, MapSearch, MapSolution, centres, with_scaled_forces
from taichi_msm.fitting.uncertainty import MAX_RELATIVE_ERROR
from taichi_msm.gradients.gradient import Adjoint, require_differentiable
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import MapImage, map_factors
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import StiffnessMap
from taichi_msm.solver.planning import stable_step
from taichi_msm.system import runtime
from taichi_msm.system.process import available_memory

KEY = "tissue.map"

# Key of a component of a force.
FORCE_KEY = re.compile(r"probes\.\d+\.total\.[012]")

# Largest bound of the factors, and the inverse of the smallest.
MAX_FACTOR = 1e6


@dataclass(frozen=True)
class MapSettings:
    """Settings of a fitted map."""

    resolution: int  # R, cells per side
    limits: Bounds  # of the factors
    force: Parameter | None  # component of a force, whose fitted factor scales all forces; None for fixed forces


def map_settings(request: Request) -> MapSettings | None:
    """Return the settings of a map, or None for a fit of numbers; raise a SceneError if they are invalid."""
    (scene, free, bounds, _, method) = request
    resolution = method.get("resolution")
    if KEY not in free:
        if resolution is not None:
            raise SceneError([f"--resolution {resolution}: only for a map; add --free {KEY}"])
        return None
    option = f"--free {KEY}"
    force_keys = [key for key in free if key != KEY]
    if conflicting := [key for key in force_keys if not FORCE_KEY.fullmatch(key)] + force_keys[1:]:
        fault = f"not with {conflicting[0]}, which can have the effect of the level of the map; leave it out"
        raise SceneError([f"{option}: {fault}, or free one component of a force, whose factor scales all forces"])
    if scene.tissue is None:
        raise SceneError([f"{option}: the scene has springs; describe them as tissue"])
    cells = min(scene.sheet.points) - 1
    if resolution is None:
        raise SceneError([f"{option}: add --resolution R, the cells along a side, such as {min(16, cells)}"])
    if not 2 <= resolution <= cells:
        remedy = f"take 2 to {cells}, as the sheet has {cells} cells along a side, or more sheet.points"
        raise SceneError([f"--resolution {resolution}: {remedy}"])
    if unknown := [key for key in bounds if key not in free]:
        raise SceneError([f"--bounds {unknown[0]}: not among --free; take {KEY}=LOW,HIGH, factors of young"])
    low, high = bounds.get(KEY, (-math.inf, math.inf))
    low, high = (0.1 if low == -math.inf else low), (10.0 if high == math.inf else high)
    interval = f"--bounds {KEY}={low:g},{high:g}"
    if not 0 < low < high:
        raise SceneError([f"{interval}: take factors of young above 0, the smaller one first"])
    if low < 1 / MAX_FACTOR or high > MAX_FACTOR:
        raise SceneError([f"{interval}: take factors of young from {1 / MAX_FACTOR:g} to {MAX_FACTOR:g}"])
    force = None
    if force_keys:
        (force,) = make_parameters(scene, force_keys, {key: bounds[key] for key in force_keys if key in bounds})
    return MapSettings(resolution, (low, high), force)


def fit_map(
    scene: Scene, problem: FitProblem, settings: MapSettings, image: str, progress: StageProgressCallback
) -> FitResult:
    """Return the fit of a map; `image`: path of the map's picture in the fitted scene."""
    (observations,) = problem.observations
    assert isinstance(observations, PointObservation)
    plan = _with_stable_steps(check_scene(without_outputs(scene)), settings.limits[1])
    require_differentiable(plan)
    if invalid := list(_faults(observations, scene, settings)):
        raise SceneError(invalid)
    assert observations.sigma is not None
    # Smaller factors leave springs no positive rest length; 1.05 is a margin.
    low = max(settings.limits[0], 1.05 * plan.material.tension)
    if low >= settings.limits[1]:
        fault = f"{scene.kind}.pretension leaves springs no length below {plan.material.tension:.3g}"
        remedy = f"take a HIGH well above {low:.3g}, or less pretension"
        raise SceneError([f"--bounds {KEY}={settings.limits[0]:g},{settings.limits[1]:g}: {fault}; {remedy}"])
    limits = math.log(low), math.log(settings.limits[1])
    grid, cell_count = MapGrid(settings.resolution, _cells(plan)), settings.resolution**2
    start = np.clip(np.log(_initial_factors(plan, settings.resolution)), *limits).ravel()
    start = np.append(start, [0.0] * (settings.force is not None))
    device = runtime.start("cpu")
    adjoint, model = Adjoint(plan, device), PointModel(plan.scene, observations, plan.grid.frames + 1)

    def report_progress() -> None:
        done = search.runs if search is not None else 0
        progress("fit", done, max(150 + 2 * len(start), done + 1))

    search: MapSearch | None = None
    report_progress()
    at_frames = model.on_sheet(adjoint.run(grid.factors(start[:cell_count]), report_progress))
    initial = model.predict(at_frames)
    if invalid := list(faults_at_start(problem, scene, Prediction((initial,), 0, model.motion(at_frames)))):
        raise SceneError(invalid)
    mesh_shift = 0.0
    if (coarse_plan := coarser_plan(plan)) is not None:
        coarse_factors = MapGrid(settings.resolution, _cells(coarse_plan)).factors(start[:cell_count])
        coarse_model = PointModel(coarse_plan.scene, observations, coarse_plan.grid.frames + 1)
        coarse_points = coarse_model.on_sheet(Adjoint(coarse_plan, device).run(coarse_factors, report_progress))
        # Richardson extrapolation of order 2, from half the cells per side.
        differences = (coarse_model.predict(coarse_points) - initial)[observations.known] / 3.0
        mesh_shift = float(np.sqrt(np.nanmean(differences**2)))
    sigma = math.hypot(observations.sigma, mesh_shift)
    force_limits = settings.force.limits if settings.force else None
    search = MapSearch(adjoint, model, observations, sigma, grid, limits, report_progress, force_limits=force_limits)
    solution = search.best(start)
    shape = settings.resolution, settings.resolution
    factors, errors = (values[:cell_count].reshape(shape) for values in (np.exp(solution.x), solution.errors))
    fitted_map = FittedMap(factors, errors, solution.choice, sigma)
    fitted = search.predict(solution.x)[1]
    residuals = (fitted - observations.values)[observations.known]
    assert scene.tissue is not None
    update = {"map": StiffnessMap(image=image, range=fitted_map.range)}
    fitted_scene = scene.model_copy(update={"tissue": scene.tissue.model_copy(update=update)})
    fitted_scene = with_scaled_forces(fitted_scene, solution.x[cell_count:])
    estimates, curves = {}, {}
    if settings.force is not None:
        key = settings.force.key
        estimates[key], curves[key] = _force_estimate(settings.force, solution)
    mapped_plan = check_scene(without_outputs(fitted_scene), {**plan.maps, "map": MapImage(fitted_map.grey, "")})
    chi_square = float(np.sum((residuals / observations.sigma) ** 2))
    return FitResult(
        parameters=estimates,
        correlation=[[1.0]] * len(estimates),
        curves=curves,
        residual=float(np.sqrt(np.mean(residuals**2))),
        sigma=observations.sigma,
        unit=observations.unit,
        chi_square=chi_square,
        rejection=by_chi_square(chi_square, residuals.size, residuals.size),
        degrees_of_freedom=residuals.size,
        identifiable=not fitted_map.unknown.any() and all(estimate.identifiable for estimate in estimates.values()),
        mesh_error=mesh_error(mapped_plan, report_progress),
        runs=search.runs + 1,
        notes=list(map_notes(observations, solution, fitted_map, mesh_shift, limits, residuals)),
        scene=fitted_scene,
        observations=(observations,),
        fitted=(fitted,),
        map=fitted_map,
    )


def _force_estimate(parameter: Parameter, solution: MapSolution) -> tuple[Estimate, list[ProfilePoint]]:
    """Return the estimate of a force, and the quadratic approximation of its profile."""
    # The log of an unknown force has a standard deviation of 3.
    x, deviation = float(solution.x[-1]), float(np.nan_to_num(solution.errors[-1], nan=3.0))
    value, error, is_identifiable = parameter.value(x), parameter.error(x, deviation), deviation <= MAX_RELATIVE_ERROR
    low, high = sorted(parameter.value(x + side * 1.96 * deviation) for side in (-1, 1))
    curve = [ProfilePoint(value * math.exp(n * deviation), float(n)) for n in np.linspace(-3, 3, 25)]
    return Estimate(value, error, (low, high), parameter.start, is_identifiable, None), curve


def _faults(observations: PointObservation, scene: Scene, settings: MapSettings) -> Iterator[str]:
    """Yield the faults that need no run."""
    if observations.sigma is None:
        fault = "the smoothness of a map follows from the errors; give their standard deviation by --sigma"
        yield f"{observations.name}: sigma: missing: {fault}"
        return
    if (count := int(observations.known.sum())) <= (cell_count := settings.resolution**2):
        fault = f"{count} observed numbers are too few for {cell_count} cells of a map"
        remedy = f"observe more points, or take fewer cells: --resolution {max(2, math.isqrt(max(count - 1, 0)))}"
        yield f"{observations.name}: {fault}; {remedy}"
        return
    # Two copies of the Jacobian, in f64.
    if (needed := 16 * count * cell_count) > (free := available_memory()):
        fault = f"{cell_count} cells of a map by {count} observed numbers take {needed / 2**30:.3g} GiB of memory"
        remedy = "take fewer cells or points"
        yield f"--resolution {settings.resolution}: {fault}, and {free / 2**30:.3g} GiB is free; {remedy}"
        return
    yield from faults([observations], scene, settings.resolution**2)


def _with_stable_steps(plan: Plan, high: float) -> Plan:
    """Return the plan with steps stable up to the factor `high`; raise a SceneError if a fixed step is not."""
    if plan.scene.time.at_rest:
        return plan
    stiffest = replace(plan.material, factors=np.full(_cells(plan), high))
    limit = stable_step(stiffest, plan.scene.sheet, plan.scene.time.damping_difference)
    if plan.scene.time.step == "auto":
        min_steps = math.ceil(2 / (plan.grid.frames_per_second * limit))
        return plan.with_grid(steps_per_frame=max(plan.grid.steps_per_frame, min_steps))
    if plan.grid.step > limit:
        remedy = f"{plan.grid.step:g} s is too long for a factor of {high:g}; take {limit:.3g} s or less, or auto"
        raise SceneError([f"time.step: {remedy}, or smaller --bounds {KEY}=LOW,HIGH"])
    return plan


def _initial_factors(plan: Plan, resolution: int) -> Array:
    """Return the initial factors, shape (R, R): those of the scene's map, otherwise 1."""
    tissue, image = plan.scene.tissue, plan.maps.get("map")
    if tissue is None or tissue.map is None or image is None:
        return np.ones((resolution, resolution))
    return map_factors(tissue.map, image, centres(resolution), centres(resolution)[:, None])


def _cells(plan: Plan) -> tuple[int, int]:
    rows, cols = plan.scene.sheet.points
    return rows - 1, cols - 1


def map_notes(
    observations: PointObservation,
    solution: MapSolution,
    fitted_map: FittedMap,
    mesh_shift: float,
    limits: tuple[float, float],
    residuals: Array,
) -> Iterator[str]:
    """Yield warnings about a map.

    `mesh_shift` [m] or [px]: root mean square change of the observations by the mesh; `limits`: bounds of the logs of
    the factors; `residuals`: predicted minus observed values [m] or [px], shape (known,).
    """
    assert observations.sigma is not None
    if (unknown_count := int(fitted_map.unknown.sum())) > 0:
        yield f"{unknown_count} of {fitted_map.factors.size} cells are unknown, as nothing moves there; press there"
    if mesh_shift > observations.sigma / 2:
        shift = f"{rounded(mesh_shift)} {observations.unit} (sigma: {rounded(observations.sigma)})"
        yield f"the mesh changes the observations by about {shift}, and smooths the map; take more sheet.points"
    if (share := float(np.sqrt(np.mean(residuals**2))) / observations.sigma) < 0.5:
        yield f"the residual is only {rounded(share)} times sigma: with a smaller sigma the map shows more"
    if solution.variance > 1.5:
        factor = rounded(math.sqrt(solution.variance))
        yield f"the residual is {factor} times the expected one with any map, and the errors are widened by this factor"
    logs = solution.x[: fitted_map.factors.size]
    if bounded := int((np.minimum(logs - limits[0], limits[1] - logs) < 1e-3).sum()):
        yield f"{bounded} cells ended at a bound, {math.exp(limits[0]):.3g} or {math.exp(limits[1]):.3g}; see --bounds"
