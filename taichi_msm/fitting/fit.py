"""From a scene and what was seen to the values of its parameters, with their uncertainty."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from taichi_msm.accuracy.mesh import WITH_CONTACT
from taichi_msm.errors import Progress, SceneError, writing
from taichi_msm.fitting import rejection
from taichi_msm.fitting import result as result_module
from taichi_msm.fitting.checks import faults, faults_beside, faults_of_best, moved
from taichi_msm.fitting.conventions import force_unit
from taichi_msm.fitting.force_table import read_forces
from taichi_msm.fitting.least_squares import (
    MOST_ERROR,
    Alike,
    Misfit,
    Place,
    Profile,
    Profiler,
    Search,
    Solution,
    Uncertainty,
    uncertainty,
    unseen,
)
from taichi_msm.fitting.observations import read_observations, with_sigma
from taichi_msm.fitting.parameters import (
    Bounds,
    Method,
    Parameter,
    as_data,
    make_parameters,
    require_types,
    with_values,
)
from taichi_msm.fitting.predict import Job, Predicted, Runs, runnable
from taichi_msm.fitting.report import publication, write_report
from taichi_msm.fitting.result import Estimate, FitResult, FittedMap
from taichi_msm.fitting.stiffness_map import KEY, fit_map, map_task
from taichi_msm.load.check import checked
from taichi_msm.load.scene_file import load_scene
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]

# Where a parameter's curvature is drawn, in standard deviations; they are at most so large, in units of x.
CURVE, WIDEST = np.linspace(-3, 3, 25), 3.0


def fit(
    scene: str | Path | Scene | Mapping[str, Any],
    observed: str | Path | Mapping[str, Any],
    free: Sequence[str],
    *,
    bounds: Mapping[str, Bounds] | None = None,
    forces: tuple[str | Path, float] | None = None,
    directory: str | Path | None = None,
    workers: int | None = None,
    progress: Progress = lambda stage, done, total: None,
    **method: Unpack[Method],
) -> FitResult:
    """Find the numbers of a scene with which it moves as was seen, and how well they are known.

    Args:
        scene: a scene file, what `load_scene` returned, or the same as a mapping. Its numbers are where the search
            begins.
        observed: an .npz file, or a mapping of such arrays: `time` [s], shape (T,); `coordinates` of points, across and
            down, shape (N, 2); `position` [m], shape (N, T, 3), or `pixel` [px] of the scene's camera, shape (N, T, 2);
            NaN where not seen; `sigma`, the standard deviation of their errors, may be left out. Or a run's
            trajectory.npz or tracks.npz.
        free: the keys that are fitted, by their dotted paths, such as tissue.young or probes.0.total.2; or tissue.map
            alone: a map of R x R fields.
        bounds: smallest and largest values of keys; of tissue.map, of the factors.
        forces: a forces.csv of the same motion, and the standard deviation of its forces [N].
        directory: where fit.json, scene.yaml, fit.png and a map's pictures go; None: nothing is written.
        workers: processes that take runs side by side; None: as many as pay.
        progress: called often, with the stage, the runs done and about how many there will be; what it raises stops the
            fit, and nothing is written.
        **method: sigma, in place of the file's; robust: whether numbers that are far off count less; profile: whether
            the intervals are found by going there; correlation: how far apart in the picture errors of tracks are alike
            [px]; drift: how long errors of one track are alike [s]; resolution: R of a map.

    Returns:
        What was found; also where the data do not tell a parameter: then `identifiable` is False.

    Raises:
        ArgumentError: when an argument is not what it must be.
        SceneError: when the scene, the keys or what was seen cannot be used, each with the remedy.
        DivergedError: when the scene diverges where it begins.
        FilesError: when the directory cannot be written.

    Example:
        >>> from taichi_msm import fit, load_scene
        >>> scene = load_scene("scenes/press.yaml", {"sheet.points": [41, 41], "tissue.young": 6e4})
        >>> found = fit(scene, "output/press/trajectory.npz", ["tissue.young"])
        >>> f"{found.parameters['tissue.young'].value:.4g} Pa", found.identifiable
        ('3e+04 Pa', True)
    """
    begun = time.perf_counter()
    require_types(observed, free, method, bounds=bounds, forces=forces, directory=directory, workers=workers)
    given = load_scene(scene) if isinstance(scene, (str, Path)) else checked(scene).scene
    for section in ("sheet", "time"):
        if (tolerance := getattr(given, section).tolerance) is not None:
            said = "is for one run, and a fit compares many; remove it, and take what `run` chose for it"
            raise SceneError([f"{section}.tolerance: {tolerance:g} {said}"])
    seen = with_sigma(read_observations(observed, given.time.frames_per_second), method.get("sigma"))
    if twice := [key for n, key in enumerate(free) if key in free[:n]]:
        raise SceneError([f"--free {twice[0]}: given twice; leave one of them out"])
    task = map_task(given, free, bounds or {}, method.get("resolution"))
    other = {"forces": forces, **{name: method.get(name) for name in ("robust", "profile", "correlation", "drift")}}
    if task is not None and (given_too := [name for name, value in other.items() if value]):
        raise SceneError([f"--free {KEY}: --{given_too[0]} is of fits of numbers; leave it out"])
    parameters = () if task is not None else make_parameters(given, free, bounds or {})
    if forces is not None:
        seen = replace(seen, forces=read_forces(forces[0], forces[1], len(given.probes)))
    if (correlation := method.get("correlation")) is not None:
        if not 0 < correlation < math.inf:
            raise SceneError([f"--correlation {correlation:g}: take a number of pixels above 0"])
        if seen.kind != "pixel":
            raise SceneError([f"{seen.name}: --correlation is in pixels, and these are positions; leave it out"])
    if (drift := method.get("drift")) is not None and not 0 < drift < math.inf:
        raise SceneError([f"--drift {drift:g}: take a number of seconds above 0"])
    if task is None and (wrong := list(faults(seen, given, len(parameters)))):
        raise SceneError(wrong)
    with ExitStack() as opened:
        if directory is not None:
            opened.enter_context(writing(directory))
            published = opened.enter_context(publication(Path(directory)))
        if task is not None:
            result = fit_map(given, seen, task, str(Path(directory or "", FittedMap.FILE)), progress)
        else:
            job = Job(secrets.token_hex(8), runnable(given), parameters, seen)
            runs = opened.enter_context(Runs(job, workers, progress))
            result = _fit(runs, given, method)
        result = replace(result, seconds=time.perf_counter() - begun)
        if directory is not None:
            progress("write", 0, 0)
            write_report(result, published)
    return result


def _fit(runs: Runs, given: Scene, method: Method) -> FitResult:
    """Search, and say how well the best values are known."""
    parameters, seen = runs.job.parameters, runs.job.observations
    alike, start = Alike(method.get("correlation"), method.get("drift")), np.zeros(len(parameters))
    runs.expected = 8 * len(start) + 4
    first = runs.first(start)
    same_camera = not any(one.key.startswith("render.") for one in parameters)
    same_signs = all(one.is_log for one in parameters)
    wrong = list(faults_beside(seen, given, first, same_camera=same_camera, same_signs=same_signs))
    if not any(probe.moved for probe in given.probes):
        # A tool with a force acts with that force whatever the tissue is.
        wrong += force_unit(seen, first)
    if wrong:
        raise SceneError(wrong)
    motion = moved(seen, given) or 1.0
    misfit = Misfit(seen, motion, robust=method.get("robust", False))
    search = Search(runs, misfit)
    solution = search.best(start)
    if wrong := list(faults_of_best(seen, given, first, solution.predicted)):
        raise SceneError(wrong)
    uncertain = uncertainty(misfit, solution, search.derivatives(solution), alike)
    profiles = Profiler(parameters, misfit, solution, uncertain).profiles(runs) if method.get("profile") else None
    mesh, shifts = _mesh(runs, misfit, solution, uncertain)
    places = enumerate(solution.x.tolist())
    estimates = [_estimate(parameters[n], x, n, uncertain, profiles, shifts) for n, x in places]
    blind = unseen(parameters, solution.x, uncertain, forces=seen.forces is not None)
    values, forces = np.split(misfit.of(solution.predicted), misfit.count[:1])
    return FitResult(
        parameters={one.key: estimate for one, estimate in zip(parameters, estimates, strict=True)},
        correlation=uncertain.correlation.tolist(),
        residual=float(np.sqrt(np.mean(values**2))),
        residual_force=float(np.sqrt(np.mean(forces**2))) if len(forces) else None,
        sigma=uncertain.scales.values,
        unit=seen.unit,
        sigma_force=None if seen.forces is None else seen.forces.sigma,
        rejection=_rejection(misfit, solution, uncertain, alike),
        chi_square=float(uncertain.left @ uncertain.left) if seen.sigma is not None else None,
        degrees_of_freedom=uncertain.freedom,
        identifiable=all(one.identifiable for one in estimates),
        unseen=blind,
        mesh_error=mesh,
        runs=runs.count,
        notes=[
            *force_unit(seen, first),
            *result_module.of_the_search(solution, parameters, fits=search.fits(solution)),
            *result_module.of_the_points(parameters, solution.x, uncertain, shifts),
            *result_module.of_ties(parameters, uncertain, blind),
            *result_module.of_what_is_left(seen, solution, uncertain, motion, alike),
        ],
        scene=Scene(**with_values(as_data(given), parameters, [one.value for one in estimates])),
        observations=seen,
        fitted=solution.predicted.values,
        fitted_forces=solution.predicted.forces,
        curves={one.key: _curve(one, n, solution.x, uncertain, profiles) for n, one in enumerate(parameters)},
    )


def _rejection(misfit: Misfit, solution: Solution, uncertain: Uncertainty, alike: Alike) -> str | None:
    """Return in words why the scene cannot move as was seen; None: it may."""
    seen, forces = misfit.seen, uncertain.left[misfit.count[0] :]
    # In a robust fit what is far off counts in full here, which is said.
    plain = " of the plain residuals" if misfit.robust else ""
    if seen.sigma is not None:
        total = float(uncertain.left @ uncertain.left)
        said = rejection.by_chi_square(total, uncertain.freedom, uncertain.independent, f"chi-square{plain}")
    else:
        said = rejection.by_pattern(seen, solution.predicted.values - seen.values, misfit.motion, alike)
    if said is None and len(forces):
        what = f"chi-square{plain} of the forces"
        said = rejection.by_chi_square(float(forces @ forces), len(forces), len(forces), what)
    if said is not None and seen.forces is not None:
        values = uncertain.left[: misfit.count[0]]
        shares = f"{np.mean(values**2):.2g} per coordinate, {np.mean(forces**2):.2g} per force component"
        product, square = (
            float(np.nansum(solution.predicted.forces * each))
            for each in (seen.forces.force, solution.predicted.forces)
        )
        said += f" ({shares}; measured forces {product / max(square, 1e-300):.3g} times predicted)"
    return said


def _mesh(runs: Runs, misfit: Misfit, solution: Solution, uncertain: Uncertainty) -> tuple[float | None, Array | None]:
    """Estimate the error of the points, and how far it moves every parameter, in units of x; NaN: not known.

    With three numbers of points the order shows; where it is less than expected, that counts. A change that is small by
    chance counts as what the coarser ones let expect.
    """
    error = runs.mesh_error(solution.x)
    if error is None or (half := runs.coarse(solution.x, 1)) is None:
        return None, None
    most = WITH_CONTACT if any(probe.moved for probe in runs.job.scene.probes) else 2.0

    def moved_by(coarse: Predicted, fine: Predicted) -> Array:
        rows = misfit.row(coarse) - misfit.row(fine)
        return np.abs(uncertain.shift(misfit.divided(rows, uncertain.scales)))

    shifts, order = moved_by(half, solution.predicted), np.full(len(solution.x), most)
    if (quarter := runs.coarse(solution.x, 2)) is not None:
        before = moved_by(quarter, half)
        order = np.clip(np.log2(np.maximum(before, 1e-300) / np.maximum(shifts, 1e-300)), 1.0, most)
        shifts = np.maximum(shifts, before / 2**most)
    return error, np.where(uncertain.dropped, np.nan, shifts / (2**order - 1))


def _estimate(
    one: Parameter, x: float, n: int, uncertain: Uncertainty, profiles: list[Profile] | None, shifts: Array | None
) -> Estimate:
    """Put together what is known of the parameter with number n."""
    deviation = float(uncertain.deviations[n])
    away = uncertain.quantile * deviation
    ends: tuple[float | None, float | None] = (x - away, x + away)
    if profiles is not None:
        ends = profiles[n].low, profiles[n].high
    low, high = one.limits
    interval = [None if end is None or not low <= end <= high else one.value(end) for end in ends]
    if one.start < 0 and one.is_log:
        interval.reverse()
    return Estimate(
        value=one.value(x),
        standard_error=one.error(x, deviation),
        interval=(interval[0], interval[1]),
        start=one.start,
        identifiable=one.share(x, deviation) <= MOST_ERROR,
        mesh_error=None if shifts is None or math.isnan(shifts[n]) else one.error(x, float(shifts[n])),
    )


def _curve(one: Parameter, n: int, x: Array, uncertain: Uncertainty, profiles: list[Profile] | None) -> list[Place]:
    """Give the profile of a parameter, or what its curvature tells, at values."""
    if profiles is not None:
        return [Place(one.value(place.x), place.deviations) for place in profiles[n].places]
    deviation = min(float(uncertain.deviations[n]), WIDEST)
    return [Place(one.value(x[n] + share * deviation), float(share)) for share in CURVE]
