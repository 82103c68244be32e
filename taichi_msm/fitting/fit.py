"""Parameter estimation: from a scene and observations to parameter values with confidence intervals."""

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

from taichi_msm.accuracy.mesh import CONTACT_ORDER
from taichi_msm.errors import SceneError, StageProgressCallback, writing
from taichi_msm.fitting import rejection
from taichi_msm.fitting import result as result_module
from taichi_msm.fitting.checks import faults, faults_at_solution, faults_at_start, largest_motion
from taichi_msm.fitting.conventions import force_unit
from taichi_msm.fitting.force_table import read_forces
from taichi_msm.fitting.least_squares import (
    MAX_RELATIVE_ERROR,
    ErrorCorrelation,
    Misfit,
    Profile,
    ProfilePoint,
    Profiler,
    Search,
    Solution,
    Uncertainty,
    uncertainty,
    unseen,
)
from taichi_msm.fitting.observations import Forces, read_observations, with_sigma
from taichi_msm.fitting.parameters import (
    Bounds,
    Method,
    Parameter,
    as_data,
    make_parameters,
    require_types,
    with_values,
)
from taichi_msm.fitting.predict import FitProblem, Prediction, Runs, without_outputs
from taichi_msm.fitting.report import publication, write_report
from taichi_msm.fitting.result import Estimate, FitResult, FittedMap
from taichi_msm.fitting.stiffness_map import KEY, fit_map, map_settings
from taichi_msm.load.check import check_scene
from taichi_msm.load.scene_file import load_scene
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]

# Ratio of the mean squares of two kinds of residuals at which the larger kind is named, and the smallest deviation of a
# common factor of the forces.
MIN_PART_RATIO, MIN_COMMON_SHARE = 2.0, 0.02

# Standard deviations at which the quadratic approximation of a profile is drawn; the largest one, in units of x.
CURVE_DEVIATIONS, MAX_CURVE_DEVIATION = np.linspace(-3, 3, 25), 3.0


def fit(
    scene: str | Path | Scene | Mapping[str, Any],
    observed: str | Path | Mapping[str, Any],
    free: Sequence[str],
    *,
    bounds: Mapping[str, Bounds] | None = None,
    forces: tuple[str | Path, float] | None = None,
    directory: str | Path | None = None,
    workers: int | None = None,
    progress: StageProgressCallback = lambda stage, done, total: None,
    **method: Unpack[Method],
) -> FitResult:
    """Estimate parameters of a scene from observations, with confidence intervals.

    Args:
        scene: a scene file, a `Scene`, or the same as a mapping. Its numbers are the initial values.
        observed: an .npz file, or a mapping of arrays: `time` [s], shape (T,); `coordinates` of points, across and
            down, shape (N, 2); `position` [m], shape (N, T, 3), or `pixel` [px] of the scene's camera, shape (N, T, 2);
            NaN where not observed; optionally `sigma`, the standard deviation of their errors. Or a run's
            trajectory.npz or tracks.npz.
        free: keys of the parameters, as dotted paths such as tissue.young or probes.0.total.2; or tissue.map, a map
            of R x R cells, alone or with a component of a force, whose factor all forces share.
        bounds: smallest and largest values by key; of tissue.map, of the factors.
        forces: a forces.csv of the same motion, and the standard deviation of its forces [N].
        directory: directory of fit.json, scene.yaml, fit.png and a map's pictures; None: nothing is written.
        workers: number of worker processes; None: by the duration of the first run.
        progress: called often, with the stage, the runs done and expected; its exceptions end the fit, and nothing is
            written.
        **method: sigma: standard deviation instead of the file's; robust: whether outliers are weighted down; profile:
            whether to compute profile intervals; correlation: correlation length of the errors of tracks [px]; drift:
            correlation time of the errors of one track [s]; resolution: R of a map.

    Returns:
        The estimates; `identifiable` is False if the data do not determine a parameter.

    Raises:
        ArgumentError: when an argument is of another type.
        SceneError: when the scene, the keys or the observations cannot be used, each with the remedy.
        DivergedError: when the scene with its initial values diverges.
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
    given = load_scene(scene) if isinstance(scene, (str, Path)) else check_scene(scene).scene
    for section in ("sheet", "time"):
        if (tolerance := getattr(given, section).tolerance) is not None:
            said = "is for one run, and a fit compares many; remove it, and take what `run` chose for it"
            raise SceneError([f"{section}.tolerance: {tolerance:g} {said}"])
    observations = with_sigma(read_observations(observed, given.time.frames_per_second), method.get("sigma"))
    if twice := [key for n, key in enumerate(free) if key in free[:n]]:
        raise SceneError([f"--free {twice[0]}: given twice; leave one of them out"])
    task = map_settings(given, free, bounds or {}, method.get("resolution"))
    other = {"forces": forces, **{name: method.get(name) for name in ("robust", "profile", "correlation", "drift")}}
    if task is not None and (given_too := [name for name, value in other.items() if value]):
        raise SceneError([f"--free {KEY}: --{given_too[0]} is of fits of numbers; leave it out"])
    parameters = () if task is not None else make_parameters(given, free, bounds or {})
    if forces is not None:
        observations = replace(observations, forces=read_forces(forces[0], forces[1], len(given.probes)))
    if (correlation := method.get("correlation")) is not None:
        if not 0 < correlation < math.inf:
            raise SceneError([f"--correlation {correlation:g}: take a number of pixels above 0"])
        if observations.kind != "pixel":
            raise SceneError(
                [f"{observations.name}: --correlation is in pixels, and these are positions; leave it out"]
            )
    if (drift := method.get("drift")) is not None and not 0 < drift < math.inf:
        raise SceneError([f"--drift {drift:g}: take a number of seconds above 0"])
    if task is None and (wrong := list(faults(observations, given, len(parameters)))):
        raise SceneError(wrong)
    with ExitStack() as opened:
        if directory is not None:
            opened.enter_context(writing(directory))
            published = opened.enter_context(publication(Path(directory)))
        if task is not None:
            result = fit_map(given, observations, task, str(Path(directory or "", FittedMap.FILE)), progress)
        else:
            job = FitProblem(secrets.token_hex(8), without_outputs(given), parameters, observations)
            runs = opened.enter_context(Runs(job, workers, progress))
            result = _fit(runs, given, method)
        result = replace(result, seconds=time.perf_counter() - begun)
        if directory is not None:
            progress("write", 0, 0)
            write_report(result, published)
    return result


def _fit(runs: Runs, given: Scene, method: Method) -> FitResult:
    """Minimise, and compute the uncertainty of the solution."""
    parameters, observations = runs.job.parameters, runs.job.observations
    error_correlation, start = (
        ErrorCorrelation(method.get("correlation"), method.get("drift")),
        np.zeros(len(parameters)),
    )
    runs.expected = 8 * len(start) + 4
    first = runs.first(start)
    same_camera = not any(one.key.startswith("render.") for one in parameters)
    same_signs = all(one.is_log for one in parameters)
    wrong = list(faults_at_start(observations, given, first, same_camera=same_camera, same_signs=same_signs))
    if not any(probe.moved for probe in given.probes):
        # A tool with a force acts with that force whatever the tissue is.
        wrong += force_unit(observations, first)
    if wrong:
        raise SceneError(wrong)
    motion = largest_motion(observations, given) or 1.0
    misfit = Misfit(observations, motion, robust=method.get("robust", False))
    search = Search(runs, misfit)
    solution = search.best(start)
    if wrong := list(faults_at_solution(observations, given, first, solution.predicted)):
        raise SceneError(wrong)
    uncertainties = uncertainty(misfit, solution, search.jacobian(solution), error_correlation)
    profiles = Profiler(parameters, misfit, solution, uncertainties).profiles(runs) if method.get("profile") else None
    mesh, shifts = _mesh(runs, misfit, solution, uncertainties)
    places = enumerate(solution.x.tolist())
    estimates = [_estimate(parameters[n], x, n, uncertainties, profiles, shifts) for n, x in places]
    blind = unseen(parameters, solution.x, uncertainties, forces=observations.forces is not None)
    values, forces = np.split(misfit.of(solution.predicted), misfit.count[:1])
    return FitResult(
        parameters={one.key: estimate for one, estimate in zip(parameters, estimates, strict=True)},
        correlation=uncertainties.correlation.tolist(),
        residual=float(np.sqrt(np.mean(values**2))),
        residual_force=float(np.sqrt(np.mean(forces**2))) if len(forces) else None,
        sigma=uncertainties.scales.values,
        unit=observations.unit,
        sigma_force=None if observations.forces is None else observations.forces.sigma,
        rejection=_rejection(misfit, solution, uncertainties, error_correlation),
        chi_square=float(uncertainties.left @ uncertainties.left) if observations.sigma is not None else None,
        degrees_of_freedom=uncertainties.freedom,
        identifiable=all(one.identifiable for one in estimates),
        unseen=blind,
        mesh_error=mesh,
        runs=runs.count,
        notes=[
            *force_unit(observations, first),
            *result_module.search_notes(solution, parameters, fits_well=search.fits_well(solution)),
            *result_module.mesh_notes(parameters, solution.x, uncertainties, shifts),
            *result_module.correlation_notes(parameters, uncertainties, blind),
            *result_module.residual_notes(observations, solution, uncertainties, motion, error_correlation),
        ],
        scene=Scene(**with_values(as_data(given), parameters, [one.value for one in estimates])),
        observations=observations,
        fitted=solution.predicted.values,
        fitted_forces=solution.predicted.forces,
        curves={one.key: _curve(one, n, solution.x, uncertainties, profiles) for n, one in enumerate(parameters)},
    )


def _rejection(
    misfit: Misfit, solution: Solution, uncertainties: Uncertainty, error_correlation: ErrorCorrelation
) -> str | None:
    """Return the reason for rejecting the model, or None."""
    observations, forces = misfit.observations, uncertainties.left[misfit.count[0] :]
    # Outliers have full weight here, also in a robust fit.
    plain = " of the plain residuals" if misfit.robust else ""
    if observations.sigma is not None:
        total = float(uncertainties.left @ uncertainties.left)
        said = rejection.by_chi_square(total, uncertainties.freedom, uncertainties.independent, f"chi-square{plain}")
    else:
        said = rejection.by_pattern(
            observations, solution.predicted.values - observations.values, misfit.motion, error_correlation
        )
    if said is None and len(forces):
        what = f"chi-square{plain} of the forces"
        said = rejection.by_chi_square(float(forces @ forces), len(forces), len(forces), what)
    if said is not None and observations.forces is not None:
        said += _larger_part(
            uncertainties.left[: misfit.count[0]], forces, observations.forces, solution.predicted.forces
        )
    return said


def _larger_part(values: Array, forces: Array, measured: Forces, predicted: Array) -> str:
    """Name the larger residuals [sigma], those of coordinates or of forces, and a common factor of the forces."""
    of_values, of_forces = (float(np.mean(residuals**2)) for residuals in (values, forces))
    if max(of_values, of_forces) < MIN_PART_RATIO * min(of_values, of_forces):
        return ""
    if of_values > of_forces:
        return ", mostly of the coordinates"
    square = float(np.nansum(predicted**2 * np.isfinite(measured.force)))
    factor = float(np.nansum(predicted * measured.force)) / square if square else 1.0
    common = f", which are {factor:.3g} times the predicted ones" if abs(factor - 1) > MIN_COMMON_SHARE else ""
    return f", mostly of the forces{common}"


def _mesh(
    runs: Runs, misfit: Misfit, solution: Solution, uncertainties: Uncertainty
) -> tuple[float | None, Array | None]:
    """Estimate the mesh error, and the errors of the parameters by the mesh, in units of x; NaN: not known.

    Three meshes show the order of convergence, which is used if it is below the expected one. A difference that is
    small by chance is replaced by the expectation from the coarser meshes.
    """
    error = runs.mesh_error(solution.x)
    if error is None or (half := runs.predict_coarse(solution.x, 1)) is None:
        return None, None
    most = CONTACT_ORDER if any(probe.moved for probe in runs.job.scene.probes) else 2.0

    def moved_by(coarse: Prediction, fine: Prediction) -> Array:
        rows = misfit.row(coarse) - misfit.row(fine)
        return np.abs(uncertainties.shift(misfit.scaled(rows, uncertainties.scales)))

    shifts, order = moved_by(half, solution.predicted), np.full(len(solution.x), most)
    if (quarter := runs.predict_coarse(solution.x, 2)) is not None:
        before = moved_by(quarter, half)
        order = np.clip(np.log2(np.maximum(before, 1e-300) / np.maximum(shifts, 1e-300)), 1.0, most)
        shifts = np.maximum(shifts, before / 2**most)
    return error, np.where(uncertainties.unidentified, np.nan, shifts / (2**order - 1))


def _estimate(
    one: Parameter, x: float, n: int, uncertainties: Uncertainty, profiles: list[Profile] | None, shifts: Array | None
) -> Estimate:
    """Build the estimate of parameter n."""
    deviation = float(uncertainties.deviations[n])
    away = uncertainties.quantile * deviation
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
        identifiable=one.share(x, deviation) <= MAX_RELATIVE_ERROR,
        mesh_error=None if shifts is None or math.isnan(shifts[n]) else one.error(x, float(shifts[n])),
    )


def _curve(
    one: Parameter, n: int, x: Array, uncertainties: Uncertainty, profiles: list[Profile] | None
) -> list[ProfilePoint]:
    """Return the profile of a parameter, or its quadratic approximation."""
    if profiles is not None:
        return [ProfilePoint(one.value(place.x), place.deviations) for place in profiles[n].places]
    deviation = min(float(uncertainties.deviations[n]), MAX_CURVE_DEVIATION)
    return [ProfilePoint(one.value(x[n] + share * deviation), float(share)) for share in CURVE_DEVIATIONS]
