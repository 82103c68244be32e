"""Fit the map of a tissue's stiffness: from a scene and what was seen to a picture of factors, and of their errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.mesh import coarser_plan
from taichi_msm.errors import SceneError, StageProgressCallback
from taichi_msm.fitting.checks import faults, faults_beside
from taichi_msm.fitting.observations import Observations, Sight
from taichi_msm.fitting.parameters import Bounds, rounded
from taichi_msm.fitting.predict import Predicted, points_error, runnable
from taichi_msm.fitting.rejection import by_chi_square
from taichi_msm.fitting.result import FitResult, FittedMap
from taichi_msm.fitting.tikhonov import Fields, Search, Solution, centres
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

# The factors of a map without bounds.
LOW, HIGH = 0.1, 10.0

# Bounds are no wider, up or down.
WIDEST = 1e6

# A factor stays so far above the one with which a spring would have no length without its pretension.
TAUT = 1.05

# What half the cells a side make different is so many times the error of the cells: 2^2 - 1.
RICHARDSON = 3.0

# How many runs a search takes, about: for the progress.
USUAL = 150

# Errors are smaller than sigma if what is left is less than this share of it.
LITTLE = 0.5

# A field has ended at a bound if its log is as near.
AT_BOUND = 1e-3


@dataclass(frozen=True)
class MapTask:
    """What map is asked for."""

    resolution: int
    limits: Bounds  # of the factors


def map_task(scene: Scene, free: Sequence[str], bounds: Mapping[str, Bounds], resolution: int | None) -> MapTask | None:
    """Say what map is to be fitted; None: numbers are; SceneError: what was asked for cannot be."""
    if KEY not in free:
        if resolution is not None:
            raise SceneError([f"--resolution {resolution}: is that of a map; add --free {KEY}"])
        return None
    named = f"--free {KEY}"
    if others := [key for key in free if key != KEY]:
        raise SceneError(
            [f"{named}: a map is found alone, as its level and {others[0]} can look alike; leave that out"]
        )
    if scene.tissue is None:
        raise SceneError([f"{named}: the scene has springs; describe them as tissue"])
    cells = min(scene.sheet.points) - 1
    if resolution is None:
        raise SceneError([f"{named}: add --resolution R, the fields along a side, such as {min(16, cells)}"])
    if not 2 <= resolution <= cells:
        said = f"take 2 to {cells}, as the sheet has {cells} cells along a side, or more sheet.points"
        raise SceneError([f"--resolution {resolution}: {said}"])
    if wrong := [key for key in bounds if key != KEY]:
        raise SceneError([f"--bounds {wrong[0]}: not among --free; take {KEY}=LOW,HIGH, factors of young"])
    low, high = bounds.get(KEY, (LOW, HIGH))
    low, high = (LOW if low == -math.inf else low), (HIGH if high == math.inf else high)
    if not 0 < low < high:
        raise SceneError([f"--bounds {KEY}={low:g},{high:g}: take factors of young above 0, the smaller one first"])
    if low < 1 / WIDEST or high > WIDEST:
        said = f"take factors of young from {1 / WIDEST:g} to {WIDEST:g}"
        raise SceneError([f"--bounds {KEY}={low:g},{high:g}: {said}"])
    return MapTask(resolution, (low, high))


def fit_map(given: Scene, seen: Observations, task: MapTask, image: str, progress: StageProgressCallback) -> FitResult:
    """Find a map; image: the path of its picture in the scene that is given back.

    Raises:
        SceneError: when the scene or what was seen cannot be used.
        DivergedError: when a run diverges.
    """
    plan = _for_factors(check_scene(runnable(given)), task.limits[1])
    require_differentiable(plan)
    if wrong := list(_unusable(seen, given, task)):
        raise SceneError(wrong)
    assert seen.sigma is not None
    low = max(task.limits[0], TAUT * plan.material.tension)
    if low >= task.limits[1]:
        said = f"{given.kind}.pretension leaves springs no length below {plan.material.tension:.3g}"
        remedy = f"take a HIGH well above {low:.3g}, or less pretension"
        raise SceneError([f"--bounds {KEY}={task.limits[0]:g},{task.limits[1]:g}: {said}; {remedy}"])
    limits = math.log(low), math.log(task.limits[1])
    fields = Fields(task.resolution, _cells(plan))
    start = np.clip(np.log(_start(plan, task.resolution)), *limits).ravel()
    device = runtime.start("cpu")
    adjoint, sight = Adjoint(plan, device), Sight(plan.scene, seen, plan.grid.frames + 1)

    def tell() -> None:
        done = search.runs if search is not None else 0
        progress("fit", done, max(USUAL + 2 * len(start), done + 1))

    search: Search | None = None
    tell()
    position = adjoint.run(fields.factors(start), tell)
    points = _first(position, sight, seen, given)
    by_points = 0.0
    if (half := coarser_plan(plan)) is not None:
        few = Fields(task.resolution, _cells(half)).factors(start)
        other = Sight(half.scene, seen, half.grid.frames + 1)
        moved = other.points(Adjoint(half, device).run(few, tell))
        apart = (other.seen(moved) - sight.seen(points))[seen.known] / RICHARDSON
        by_points = float(np.sqrt(np.nanmean(apart**2)))
    sigma = math.hypot(seen.sigma, by_points)
    search = Search(adjoint, sight, seen, sigma, fields, limits, tell)
    solution = search.best(start)
    factors, errors = (each.reshape(task.resolution, -1) for each in (np.exp(solution.x), solution.errors))
    found = FittedMap(factors, errors, solution.choice, sigma)
    fitted = search.predict(solution.x)[1]
    left = (fitted - seen.values)[seen.known]
    assert given.tissue is not None
    drawn = {"map": StiffnessMap(image=image, range=found.range)}
    scene = given.model_copy(update={"tissue": given.tissue.model_copy(update=drawn)})
    mapped = check_scene(runnable(scene), {**plan.maps, "map": MapImage(found.grey, "")})
    chi_square = float(np.sum((left / seen.sigma) ** 2))
    return FitResult(
        residual=float(np.sqrt(np.mean(left**2))),
        sigma=seen.sigma,
        unit=seen.unit,
        chi_square=chi_square,
        rejection=by_chi_square(chi_square, left.size, left.size),
        degrees_of_freedom=left.size,
        identifiable=not found.unknown.any(),
        mesh_error=points_error(mapped, tell),
        runs=search.runs + 1,
        notes=list(_notes(seen, solution, found, by_points, limits, left)),
        scene=scene,
        observations=seen,
        fitted=fitted,
        map=found,
    )


def _unusable(seen: Observations, scene: Scene, task: MapTask) -> Iterator[str]:
    """Say why a map cannot be found from what was seen, before anything is run."""
    if seen.sigma is None:
        said = "a map is found as smooth as the errors of what was seen allow; give their standard deviation by --sigma"
        yield f"{seen.name}: sigma: missing: {said}"
        return
    if (known := int(seen.known.sum())) <= (needed := task.resolution**2):
        said = f"{known} numbers were seen, too few for {needed} fields; observe more points, or take fewer fields"
        yield f"{seen.name}: {said}: --resolution {max(2, math.isqrt(max(known - 1, 0)))}"
        return
    # What each field does to each number that was seen, twice while it is multiplied.
    if (size := 16 * known * needed) > (free := available_memory()):
        said = f"{needed} fields by {known} numbers that were seen take {size / 2**30:.3g} GiB of memory"
        yield f"--resolution {task.resolution}: {said}, and {free / 2**30:.3g} GiB is free; take fewer fields or points"
        return
    yield from faults(seen, scene, task.resolution**2)


def _first(position: Array, sight: Sight, seen: Observations, given: Scene) -> Array:
    """Give where the points are at the start [m], shape (N, T, 3); SceneError: what was seen is beside that."""
    at_frames = np.array([sight.on_sheet(frame) for frame in position])
    points = sight.at_times(at_frames)
    first = Predicted(sight.seen(points), np.empty((0, 3)), 0, sight.motion(at_frames))
    if wrong := list(faults_beside(seen, given, first)):
        raise SceneError(wrong)
    return points


def _for_factors(plan: Plan, high: float) -> Plan:
    """Take steps that the largest factor allows; SceneError: the scene's own step does not."""
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
    """Give the factors of the fields where the search begins: those of the scene's map, else 1."""
    tissue, image = plan.scene.tissue, plan.maps.get("map")
    if tissue is None or tissue.map is None or image is None:
        return np.ones((resolution, resolution))
    return map_factors(tissue.map, image, centres(resolution), centres(resolution))


def _cells(plan: Plan) -> tuple[int, int]:
    rows, cols = plan.scene.sheet.points
    return rows - 1, cols - 1


def _notes(
    seen: Observations,
    solution: Solution,
    found: FittedMap,
    by_points: float,
    limits: tuple[float, float],
    left: Array,
) -> Iterator[str]:
    """Tell what the user should know; left: predicted minus seen."""
    assert seen.sigma is not None
    if (unknown := int(found.unknown.sum())) > 0:
        yield f"{unknown} of {found.factors.size} fields are unknown: nothing moves there that would tell; press there"
    if by_points > seen.sigma / 2:
        said = f"about {rounded(by_points)} {seen.unit}, and sigma is {rounded(seen.sigma)}"
        remedy = "the map is as smooth as both require; take more sheet.points"
        yield f"the number of points changes what is seen by {said}: {remedy}"
    if (share := float(np.sqrt(np.mean(left**2))) / seen.sigma) < LITTLE:
        yield f"what is left is only {rounded(share)} times sigma: with a smaller one the map shows more"
    if solution.excess > 1.5:
        times = rounded(math.sqrt(solution.excess))
        yield f"what is left is {times} times what is expected with any map, and the errors are widened by as much"
    if bound := int((np.minimum(solution.x - limits[0], limits[1] - solution.x) < AT_BOUND).sum()):
        yield f"{bound} fields ended at a bound, {math.exp(limits[0]):.3g} or {math.exp(limits[1]):.3g}; see --bounds"
