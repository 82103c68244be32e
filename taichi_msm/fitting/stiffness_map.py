"""Estimate the stiffness map of a tissue: an image of factors, and one of their standard errors."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.mesh import coarser_plan
from taichi_msm.errors import SceneError, StageProgressCallback
from taichi_msm.fitting.checks import faults, faults_at_start
from taichi_msm.fitting.least_squares import MAX_RELATIVE_ERROR, ProfilePoint
from taichi_msm.fitting.observations import ObservationModel, Observations
from taichi_msm.fitting.parameters import Bounds, Parameter, make_parameters, rounded
from taichi_msm.fitting.predict import Prediction, mesh_error, without_outputs
from taichi_msm.fitting.rejection import by_chi_square
from taichi_msm.fitting.result import Estimate, FitResult, FittedMap
from taichi_msm.fitting.tikhonov import MapGrid, MapSearch, MapSolution, centres, with_scaled_forces
from taichi_msm.gradients.gradient import Adjoint, require_differentiable
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import MapImage, map_factors
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import StiffnessMap
from taichi_msm.solver.planning import stable_step
from taichi_msm.system import runtime
from taichi_msm.system.process import available_memory

Array = NDArray[np.float64]

KEY = "tissue.map"

# A component of a force.
FORCE_KEY = re.compile(r"probes\.\d+\.total\.[012]")

# Standard deviations of the ends of a 95 % interval, and the standard deviation of an unknown log.
NORMAL_QUANTILE, UNKNOWN_DEVIATION = 1.96, 3.0

# Default bounds of the factors.
DEFAULT_LOW, DEFAULT_HIGH = 0.1, 10.0

# Widest bounds, up or down.
MAX_FACTOR = 1e6

# Margin of the smallest factor above that of a spring with a rest length of 0.
SLACK_MARGIN = 1.05

# Difference between meshes of half the cells per side over the error: 2^2 - 1.
RICHARDSON_DIVISOR = 3.0

# Typical number of runs of a search, for the progress.
TYPICAL_RUNS = 150

# Residuals below this share of sigma are noted.
MIN_RESIDUAL_SIGMAS = 0.5

# Distance of the log of a factor from a bound at which it has ended there.
BOUND_TOLERANCE = 1e-3


@dataclass(frozen=True)
class MapSettings:
    """Requested map."""

    resolution: int
    limits: Bounds  # of the factors
    force: Parameter | None  # component of a force whose factor all forces share; None: all forces are known


def map_settings(
    scene: Scene, free: Sequence[str], bounds: Mapping[str, Bounds], resolution: int | None
) -> MapSettings | None:
    """Return the requested map; None for a fit of numbers; SceneError: arguments that exclude each other."""
    if KEY not in free:
        if resolution is not None:
            raise SceneError([f"--resolution {resolution}: is that of a map; add --free {KEY}"])
        return None
    named = f"--free {KEY}"
    others = [key for key in free if key != KEY]
    if fixed := [key for key in others if not FORCE_KEY.fullmatch(key)] + others[1:]:
        why = f"a map is found alone, as its level and {fixed[0]} can look alike; leave that out"
        raise SceneError([f"{named}: {why}, or free one component of a force, whose factor all forces share"])
    if scene.tissue is None:
        raise SceneError([f"{named}: the scene has springs; describe them as tissue"])
    cells = min(scene.sheet.points) - 1
    if resolution is None:
        raise SceneError([f"{named}: add --resolution R, the fields along a side, such as {min(16, cells)}"])
    if not 2 <= resolution <= cells:
        said = f"take 2 to {cells}, as the sheet has {cells} cells along a side, or more sheet.points"
        raise SceneError([f"--resolution {resolution}: {said}"])
    if wrong := [key for key in bounds if key not in free]:
        raise SceneError([f"--bounds {wrong[0]}: not among --free; take {KEY}=LOW,HIGH, factors of young"])
    low, high = bounds.get(KEY, (DEFAULT_LOW, DEFAULT_HIGH))
    low, high = (DEFAULT_LOW if low == -math.inf else low), (DEFAULT_HIGH if high == math.inf else high)
    if not 0 < low < high:
        raise SceneError([f"--bounds {KEY}={low:g},{high:g}: take factors of young above 0, the smaller one first"])
    if low < 1 / MAX_FACTOR or high > MAX_FACTOR:
        said = f"take factors of young from {1 / MAX_FACTOR:g} to {MAX_FACTOR:g}"
        raise SceneError([f"--bounds {KEY}={low:g},{high:g}: {said}"])
    force = make_parameters(scene, others, {key: bounds[key] for key in others if key in bounds})[0] if others else None
    return MapSettings(resolution, (low, high), force)


def fit_map(
    given: Scene, observations: Observations, task: MapSettings, image: str, progress: StageProgressCallback
) -> FitResult:
    """Estimate a map.

    Args:
        given: the scene.
        observations: with sigma.
        task: resolution and limits.
        image: path of the map's picture in the fitted scene.
        progress: called often; its exceptions end the fit.

    Raises:
        SceneError: when the scene or the observations cannot be used.
        DivergedError: when a run diverges.
    """
    plan = _with_steps_for(check_scene(without_outputs(given)), task.limits[1])
    require_differentiable(plan)
    if wrong := list(_unusable(observations, given, task)):
        raise SceneError(wrong)
    assert observations.sigma is not None
    low = max(task.limits[0], SLACK_MARGIN * plan.material.tension)
    if low >= task.limits[1]:
        said = f"{given.kind}.pretension leaves springs no length below {plan.material.tension:.3g}"
        remedy = f"take a HIGH well above {low:.3g}, or less pretension"
        raise SceneError([f"--bounds {KEY}={task.limits[0]:g},{task.limits[1]:g}: {said}; {remedy}"])
    limits = math.log(low), math.log(task.limits[1])
    fields, cells = MapGrid(task.resolution, _cells(plan)), task.resolution**2
    start = np.clip(np.log(_start(plan, task.resolution)), *limits).ravel()
    start = np.append(start, [0.0] * (task.force is not None))
    device = runtime.start("cpu")
    adjoint, sight = Adjoint(plan, device), ObservationModel(plan.scene, observations, plan.grid.frames + 1)

    def tell() -> None:
        done = search.runs if search is not None else 0
        progress("fit", done, max(TYPICAL_RUNS + 2 * len(start), done + 1))

    search: MapSearch | None = None
    tell()
    position = adjoint.run(fields.factors(start[:cells]), tell)
    points = _first(position, sight, observations, given)
    by_points = 0.0
    if (half := coarser_plan(plan)) is not None:
        few = MapGrid(task.resolution, _cells(half)).factors(start[:cells])
        other = ObservationModel(half.scene, observations, half.grid.frames + 1)
        moved = other.points(Adjoint(half, device).run(few, tell))
        apart = (other.observe(moved) - sight.observe(points))[observations.known] / RICHARDSON_DIVISOR
        by_points = float(np.sqrt(np.nanmean(apart**2)))
    sigma = math.hypot(observations.sigma, by_points)
    search = MapSearch(
        adjoint,
        sight,
        observations,
        sigma,
        fields,
        limits,
        tell,
        force_limits=task.force.limits if task.force else None,
    )
    solution = search.best(start)
    factors, errors = (each[:cells].reshape(task.resolution, -1) for each in (np.exp(solution.x), solution.errors))
    found = FittedMap(factors, errors, solution.choice, sigma)
    fitted = search.predict(solution.x)[1]
    left = (fitted - observations.values)[observations.known]
    assert given.tissue is not None
    drawn = {"map": StiffnessMap(image=image, range=found.range)}
    scene = given.model_copy(update={"tissue": given.tissue.model_copy(update=drawn)})
    scene = with_scaled_forces(scene, *np.exp(solution.x[cells:]).tolist())
    parameters = {} if task.force is None else {task.force.key: _force(task.force, solution)}
    mapped = check_scene(without_outputs(scene), {**plan.maps, "map": MapImage(found.grey, "")})
    chi_square = float(np.sum((left / observations.sigma) ** 2))
    return FitResult(
        parameters=parameters,
        correlation=[[1.0]] * len(parameters),
        curves={key: _curve(one, solution) for key, one in parameters.items()},
        residual=float(np.sqrt(np.mean(left**2))),
        sigma=observations.sigma,
        unit=observations.unit,
        chi_square=chi_square,
        rejection=by_chi_square(chi_square, left.size, left.size),
        degrees_of_freedom=left.size,
        identifiable=not found.unknown.any() and all(one.identifiable for one in parameters.values()),
        mesh_error=mesh_error(mapped, tell),
        runs=search.runs + 1,
        notes=list(_notes(observations, solution, found, by_points, limits, left)),
        scene=scene,
        observations=observations,
        fitted=fitted,
        map=found,
    )


def _force(parameter: Parameter, solution: MapSolution) -> Estimate:
    """Return the estimate of a component of a force."""
    x, deviation = float(solution.x[-1]), float(np.nan_to_num(solution.errors[-1], nan=UNKNOWN_DEVIATION))
    ends = sorted(parameter.value(x + side * NORMAL_QUANTILE * deviation) for side in (-1, 1))
    is_identifiable = deviation <= MAX_RELATIVE_ERROR
    error = parameter.error(x, deviation)
    return Estimate(parameter.value(x), error, (ends[0], ends[1]), parameter.start, is_identifiable, None)


def _curve(estimate: Estimate, solution: MapSolution) -> list[ProfilePoint]:
    """Return the quadratic approximation of the profile of a force."""
    deviation = float(np.nan_to_num(solution.errors[-1], nan=UNKNOWN_DEVIATION))
    return [ProfilePoint(estimate.value * math.exp(n * deviation), float(n)) for n in np.linspace(-3, 3, 25)]


def _unusable(observations: Observations, scene: Scene, task: MapSettings) -> Iterator[str]:
    """Yield the faults that are known before any run."""
    if observations.sigma is None:
        said = "the errors of the observations decide how smooth a map is; give their standard deviation by --sigma"
        yield f"{observations.name}: sigma: missing: {said}"
        return
    if (known := int(observations.known.sum())) <= (needed := task.resolution**2):
        said = f"{known} numbers were observed, too few for {needed} fields; observe more points, or take fewer fields"
        yield f"{observations.name}: {said}: --resolution {max(2, math.isqrt(max(known - 1, 0)))}"
        return
    # The Jacobian, twice while it is multiplied.
    if (size := 16 * known * needed) > (free := available_memory()):
        said = f"{needed} fields by {known} observed numbers take {size / 2**30:.3g} GiB of memory"
        yield f"--resolution {task.resolution}: {said}, and {free / 2**30:.3g} GiB is free; take fewer fields or points"
        return
    yield from faults(observations, scene, task.resolution**2)


def _first(position: Array, sight: ObservationModel, observations: Observations, given: Scene) -> Array:
    """Return the points at the start [m], shape (N, T, 3); SceneError: implausible observations."""
    at_frames = np.array([sight.points_on_sheet(frame) for frame in position])
    points = sight.interpolate(at_frames)
    first = Prediction(sight.observe(points), np.empty((0, 3)), 0, sight.motion(at_frames))
    if wrong := list(faults_at_start(observations, given, first)):
        raise SceneError(wrong)
    return points


def _with_steps_for(plan: Plan, high: float) -> Plan:
    """Return the plan with steps that are stable for the largest factor; SceneError: the scene's step is not."""
    if plan.scene.time.at_rest:
        return plan
    stiff = replace(plan.material, factors=np.full(_cells(plan), high))
    limit = stable_step(stiff, plan.scene.sheet, plan.scene.time.damping_difference)
    if plan.scene.time.step == "auto":
        least = math.ceil(2 / (plan.grid.frames_per_second * limit))
        return plan.with_grid(steps_per_frame=max(plan.grid.steps_per_frame, least))
    if plan.grid.step > limit:
        said = f"{plan.grid.step:g} s is too long for a factor of {high:g}; take {limit:.3g} s or less, or auto"
        raise SceneError([f"time.step: {said}, or smaller --bounds {KEY}=LOW,HIGH"])
    return plan


def _start(plan: Plan, resolution: int) -> Array:
    """Return the initial factors: those of the scene's map, else 1."""
    tissue, image = plan.scene.tissue, plan.maps.get("map")
    if tissue is None or tissue.map is None or image is None:
        return np.ones((resolution, resolution))
    return map_factors(tissue.map, image, centres(resolution), centres(resolution))


def _cells(plan: Plan) -> tuple[int, int]:
    rows, cols = plan.scene.sheet.points
    return rows - 1, cols - 1


def _notes(
    observations: Observations,
    solution: MapSolution,
    found: FittedMap,
    by_points: float,
    limits: tuple[float, float],
    left: Array,
) -> Iterator[str]:
    """Yield notes for the user; `left`: the residuals [m] or [px]."""
    assert observations.sigma is not None
    if (unknown := int(found.unknown.sum())) > 0:
        yield f"{unknown} of {found.factors.size} fields are unknown: nothing moves there; press there"
    if by_points > observations.sigma / 2:
        said = f"about {rounded(by_points)} {observations.unit}, and sigma is {rounded(observations.sigma)}"
        remedy = "the map is as smooth as both require; take more sheet.points"
        yield f"the mesh changes the observations by {said}: {remedy}"
    if (share := float(np.sqrt(np.mean(left**2))) / observations.sigma) < MIN_RESIDUAL_SIGMAS:
        yield f"the residual is only {rounded(share)} times sigma: with a smaller sigma the map shows more"
    if solution.excess > 1.5:
        times = rounded(math.sqrt(solution.excess))
        yield f"the residual is {times} times the expected one with any map, and the errors are widened by this factor"
    x = solution.x[: found.factors.size]
    if bound := int((np.minimum(x - limits[0], limits[1] - x) < BOUND_TOLERANCE).sum()):
        yield f"{bound} fields ended at a bound, {math.exp(limits[0]):.3g} or {math.exp(limits[1]):.3g}; see --bounds"
