"""Parameter estimation from a scene and observations, with confidence intervals."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import Unpack

from taichi_msm.accuracy.mesh import CONTACT_ORDER
from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError, StageProgressCallback, writing
from taichi_msm.fitting import rejection
from taichi_msm.fitting.archive import read_observations
from taichi_msm.fitting.checks import faults, faults_at_start, opposed, unit_faults
from taichi_msm.fitting.forces import read_forces
from taichi_msm.fitting.least_squares import Misfit, Search, Solution
from taichi_msm.fitting.machine_curve import CurveRuns, has_curve, search_by_curve
from taichi_msm.fitting.machine_fit import FittedTest, contact_notes, explanations, fitted_tests, unknown_notes
from taichi_msm.fitting.machine_model import TABLE_OPTIONS, MachineProblem, read_machine_problem, table_paths
from taichi_msm.fitting.machine_units import unit_notes
from taichi_msm.fitting.observation import ErrorCorrelation, Observation
from taichi_msm.fitting.outliers import LeftOut, leave_out, outlier_notes
from taichi_msm.fitting.parameters import (
    Bounds,
    Method,
    Parameter,
    Request,
    as_data,
    make_parameters,
    require_types,
    rounded,
)
from taichi_msm.fitting.predict import FitProblem, Prediction, Runs, without_outputs
from taichi_msm.fitting.profiles import Profile, Profiler, quadratic_profile
from taichi_msm.fitting.report import publication, write_report
from taichi_msm.fitting.result import Estimate, FitResult, FittedMap
from taichi_msm.fitting.stiffness_map import KEY, MapSettings, fit_map, map_settings
from taichi_msm.fitting.uncertainty import (
    MAX_CORRELATION,
    MAX_RELATIVE_ERROR,
    Uncertainty,
    UnidentifiedGroup,
    uncertainty,
    unidentified_groups,
)
from taichi_msm.load.check import check_scene
from taichi_msm.load.scene_file import load_scene
from taichi_msm.scene.scene import Scene


def fit(
    scene: str | Path | Scene | Mapping[str, Any],
    observed: str | Path | Mapping[str, Any] | Sequence[str | Path],
    free: Sequence[str],
    *,
    bounds: Mapping[str, Bounds] | None = None,
    forces: tuple[str | Path, float] | None = None,
    directory: str | Path | None = None,
    workers: int | None = None,
    progress: StageProgressCallback = lambda stage, done, total: None,
    report: Callable[[str], None] = lambda note: None,
    **method: Unpack[Method],
) -> FitResult:
    """Estimate parameters of a scene from observations, with confidence intervals.

    Args:
        scene: a scene file, a `Scene`, or its data as a mapping, with the initial values.
        observed: an .npz file, or a mapping of arrays: `time` [s], shape (T,); `coordinates` of points, across and
            down, shape (N, 2); `position` [m], shape (N, T, 3), or `pixel` [px] of the scene's camera, shape (N, T, 2),
            NaN where not observed; optionally `sigma`, the standard deviation of their errors. Or a run's
            trajectory.npz or tracks.npz. Or one or more tables of a testing machine, .csv, .tsv, .txt, .dat, .lvm or
            .xlsx, with time, depth and force, which the scene's only position-controlled tool follows.
        free: keys of the parameters, dotted paths such as tissue.young or probes.0.total.2. tissue.map is a map of
            R x R cells; with it one component of a force may be free, and its factor then scales all forces. contact,
            or contact.0, ... of several tables, is the depth of contact [m of the table].
        bounds: smallest and largest value by key; for tissue.map the smallest and largest factor.
        forces: a forces.csv of the same motion, and the standard deviation of its forces [N].
        directory: directory for fit.json, scene.yaml, fit.png and a map's pictures; by default none is written.
        workers: number of worker processes; by default chosen by the duration of the first run.
        progress: callback for the stage, the number of finished runs and the expected number; an exception from it
            ends the fit without files.
        report: callback for the warnings that are known before the search.
        **method: options. Of all fits of numbers: `robust` (without outliers), `profile` (profile-likelihood
            intervals of all parameters). Of points: `sigma` (standard deviation of the errors, replaces that of the
            file), `correlation` (correlation length of the errors of tracks [px]), `drift` (correlation time of the
            errors of a track [s]), `resolution` (R of a map). Of tables: `columns` (selected columns, such as
            ["depth=Traverse, mm"]), `sheet` and `block` of a file, `window` (first and last time [s]), `rate` (frames
            per second), `contact` (depths of contact [m of the table], one for all tables or one each),
            `force_offset` (exact forces without contact [N], likewise, positive along the largest force).

    Returns:
        The estimates; `identifiable` is False if the data do not determine a parameter.

    Raises:
        ArgumentError: when an argument has a wrong type.
        SceneError: when the scene, the keys or the observations are invalid, with a remedy for each.
        DivergedError: when the scene with its initial values diverges.
        FilesError: when the directory cannot be written.

    Example:
        >>> from taichi_msm import fit, load_scene
        >>> scene = load_scene("scenes/press.yaml", {"sheet.points": [41, 41], "tissue.young": 6e4})
        >>> result = fit(scene, "output/press/trajectory.npz", ["tissue.young"])
        >>> f"{result.parameters['tissue.young'].value:.4g} Pa", result.identifiable
        ('3e+04 Pa', True)
    """
    start = time.perf_counter()
    require_types(observed, free, method, bounds=bounds, forces=forces, directory=directory, workers=workers)
    initial = load_scene(scene) if isinstance(scene, (str, Path)) else check_scene(scene).scene
    for section in ("sheet", "time"):
        if (tolerance := getattr(initial, section).tolerance) is not None:
            fault = "is for single runs, but a fit compares many; remove it, and take the value chosen by `run`"
            raise SceneError([f"{section}.tolerance: {tolerance:g} {fault}"])
    if repeated := [key for n, key in enumerate(free) if key in free[:n]]:
        raise SceneError([f"--free {repeated[0]}: given twice; leave one of them out"])
    request, settings = Request(initial, free, bounds or {}, forces, method), None
    if tables := table_paths(observed):
        problem: FitProblem = read_machine_problem(tables, request)
        for note in (note for loading in problem.tests for note in loading.test.notes):
            report(note)
    else:
        problem, settings = _read_problem(observed, request)
    with ExitStack() as stack:
        if directory is not None:
            # From here on an interruption is an exception, which removes the unfinished files.
            progress("fit", 0, 1)
            stack.enter_context(writing(directory))
            publisher = stack.enter_context(publication(Path(directory)))
        if settings is not None:
            name = str(Path(directory or "", FittedMap.FILE))
            result = fit_map(initial, problem, settings, name, progress)
        else:
            kind = CurveRuns if has_curve(problem) else Runs
            runs = stack.enter_context(kind(problem, workers, progress))
            result = _fit(runs, initial, method, report)
        result = replace(result, seconds=time.perf_counter() - start)
        if directory is not None:
            progress("write", 0, 0)
            write_report(result, publisher)
    return result


def _read_problem(observed: Any, request: Request) -> tuple[FitProblem, MapSettings | None]:
    """Return the problem of a fit to points and forces, and the settings of its map, None for a fit of numbers."""
    initial, free, bounds, forces, method = request
    points = read_observations(observed, initial.time.frames_per_second, initial.sheet)
    points = points.with_sigma(method.get("sigma"))
    points = points.on_sheet(initial)
    if unused := [name for name in TABLE_OPTIONS if method.get(name)]:
        raise SceneError([f"--{unused[0].replace('_', '-')}: only for tables of a testing machine; leave it out"])
    settings = map_settings(request)
    options = {"forces": forces, **{name: method.get(name) for name in ("robust", "profile", "correlation", "drift")}}
    if settings is not None and (conflicting := [name for name, value in options.items() if value]):
        raise SceneError([f"--free {KEY}: --{conflicting[0]} is only for fits of numbers; leave it out"])
    parameters = () if settings is not None else make_parameters(initial, free, bounds)
    measured = [] if forces is None else [read_forces(*forces, len(initial.probes))]
    observations: tuple[Observation, ...] = (points, *measured)
    if (correlation := method.get("correlation")) is not None:
        if not 0 < correlation < math.inf:
            raise SceneError([f"--correlation {correlation:g}: take a number of pixels above 0"])
        if not points.correlation_remedy:
            raise SceneError([f"{points.name}: --correlation is in pixels, and these are positions; leave it out"])
    if (drift := method.get("drift")) is not None and not 0 < drift < math.inf:
        raise SceneError([f"--drift {drift:g}: take a number of seconds above 0"])
    if settings is None and (messages := list(faults(observations, initial, len(parameters)))):
        raise SceneError(messages)
    return FitProblem(without_outputs(initial), parameters, observations), settings


def _fit(runs: Runs, scene: Scene, method: Method, report: Callable[[str], None]) -> FitResult:
    parameters, observations = runs.problem.parameters, runs.problem.observations
    error_correlation = ErrorCorrelation(method.get("correlation"), method.get("drift"))
    start = np.zeros(len(parameters))
    runs.expected = 8 * len(start) + 4
    initial = runs.predict_initial(start)
    machine = runs.problem if isinstance(runs.problem, MachineProblem) else None
    messages: list[str] = []
    if machine is None:
        messages += faults_at_start(runs.problem, scene, initial)
    if not any(probe.moved for probe in scene.probes):
        # Without position-controlled tools no tissue changes the forces, so a wrong unit is certain before the search.
        messages += unit_faults(observations, initial)
    if messages:
        raise SceneError(messages)
    early_notes = list(unit_notes(machine, initial.values[0])) if machine else []
    for note in early_notes:
        report(note)
    signals = [observed.signal(scene) or 1.0 for observed in observations]
    misfit = Misfit(observations, signals, robust=method.get("robust", False))
    if isinstance(runs, CurveRuns):
        search, solution = search_by_curve(runs, misfit, start, initial)
    else:
        search = Search(runs, misfit)
        if machine:
            search.remember(start, initial)
        solution = search.best(start)
    left_out: list[LeftOut] = []
    if misfit.robust and machine is None:
        solution, left_out = leave_out(search, solution)
        misfit, observations = search.misfit, tuple(search.misfit.observations)
    # A wrong sign or unit contradicts both the initial and the fitted scene.
    both = initial, solution.predicted
    if messages := [*opposed(observations, scene, *both), *unit_faults(observations, *both)]:
        raise SceneError(messages)
    derivatives = search.jacobian(solution)
    uncertainties = uncertainty(misfit, solution, derivatives, error_correlation)
    if isinstance(runs, CurveRuns):
        runs.by_tangent = False  # Profiles are those of curves.
    is_profiled = uncertainties.is_correlated | method.get("profile", False)
    profiles = Profiler(runs, misfit, solution, uncertainties).profiles(np.flatnonzero(is_profiled).tolist())
    mesh_error, shifts = _mesh_effect(runs, misfit, solution, uncertainties)
    estimates, curves = {}, {}
    pairs = zip(solution.x.tolist(), uncertainties.deviations.tolist(), strict=True)
    for n, (parameter, (x, deviation)) in enumerate(zip(parameters, pairs, strict=True)):
        profile = profiles.get(n) or quadratic_profile(x, deviation, uncertainties.quantile)
        estimates[parameter.key] = _estimate(parameter, x, deviation, profile, float(shifts[n]))
        curves[parameter.key] = [point._replace(x=parameter.value(point.x)) for point in profile.points]
    values = {key: estimate.value for key, estimate in estimates.items()}
    measures_forces = any(observed.noun == "forces" for observed in observations)
    unidentified = unidentified_groups(parameters, solution.x, uncertainties, forces=measures_forces)
    rejection_reason = _rejection(scene, misfit, solution, uncertainties, error_correlation)
    tests: tuple[FittedTest, ...] = ()
    if machine:
        tests = fitted_tests(machine, values, solution.predicted.values[0], derivatives, uncertainties)
        measured = np.concatenate([fitted.loading.force for fitted in tests])
        observations = (replace(observations[0], values=measured[:, None]),)
    summaries: dict[str, Any] = {}
    for observed, predicted, sigma in zip(observations, solution.predicted.values, uncertainties.scales, strict=True):
        summaries |= observed.summary((predicted - observed.values)[observed.known], sigma)
    has_sigma = all(observed.sigma is not None for observed in observations)
    notes = [*unit_faults(observations, initial), *(note for fitted in tests for note in fitted.loading.test.notes)]
    notes += early_notes
    notes += search_notes(solution, parameters, fits_well=search.fits_well(solution))
    notes += uncertainty_notes(parameters, solution.x, uncertainties, shifts, unidentified)
    if isinstance(runs, CurveRuns):
        slopes = misfit.scaled(runs.contact_slopes(solution.x), uncertainties.scales)
        notes += contact_notes(parameters, solution.x, uncertainties, slopes)
    notes += unknown_notes(tests, {key: values[key] for key, each in estimates.items() if not each.identifiable})
    if rejection_reason:
        notes += explanations(tests, fits_contact=any(key.startswith("contact") for key in values))
    if not misfit.robust and not left_out:
        notes += outlier_notes(uncertainties.residuals)
    if uncertainties.factor > 1.5:
        factor = rounded(math.sqrt(uncertainties.factor))
        notes.append(f"the residual is {factor} times sigma, and the intervals are widened by this factor")
    for observed, predicted, signal in zip(observations, solution.predicted.values, signals, strict=True):
        notes += observed.residual_notes(predicted, signal, error_correlation)
    return FitResult(
        **summaries,
        parameters=estimates,
        correlation=uncertainties.correlation.tolist(),
        rejection=rejection_reason,
        chi_square=float(uncertainties.residuals @ uncertainties.residuals) if has_sigma else None,
        degrees_of_freedom=uncertainties.freedom,
        identifiable=all(estimate.identifiable for estimate in estimates.values()),
        unseen=unidentified,
        mesh_error=mesh_error,
        runs=runs.count,
        notes=notes,
        scene=Scene(**runs.problem.fitted_data(as_data(scene), values)),
        other_scenes=[Scene(**runs.problem.fitted_data(as_data(scene), values, n)) for n in range(1, len(tests))],
        observations=observations,
        left_out=left_out,
        fitted=solution.predicted.values,
        tests=tests,
        curves=curves,
    )


def search_notes(solution: Solution, parameters: Sequence[Parameter], *, fits_well: bool) -> Iterator[str]:
    """Yield warnings about the search."""
    if not solution.converged:
        yield "the search did not converge; take closer initial values by --set, or give --bounds"
    if not fits_well:
        fault = "the residual is large: no values of these parameters reproduce the observations"
        yield f"{fault}; free more of them, or check the scene"
    for parameter, x in zip(parameters, solution.x.tolist(), strict=True):
        low, high = parameter.limits
        if min(x - low, high - x) < 1e-3:
            end, remedy = "a factor of 1000 from the initial value", "take a closer one by --set"
            if math.isfinite(parameter.low) or math.isfinite(parameter.high):
                end, remedy = "a bound", "widen --bounds, or fix it"
            ended = f"{parameter.key}: ended at {parameter.value(x):.4g}, {end}"
            yield f"{ended}, so its interval is not reliable; {remedy}"


def uncertainty_notes(
    parameters: Sequence[Parameter],
    x: Array,
    uncertainties: Uncertainty,
    shifts: Array,
    unidentified: Sequence[UnidentifiedGroup],
) -> Iterator[str]:
    """Yield warnings about mesh errors beyond the intervals, and about correlated, but identified parameters.

    The mesh errors `shifts`, in units of x, have shape (n,), NaN if unknown.
    """
    half_widths = uncertainties.quantile * uncertainties.deviations
    if moved := np.flatnonzero(shifts > half_widths).tolist():
        changes = [(parameters[n].key, parameters[n].format_error(x[n], float(shifts[n]))) for n in moved]
        shown = ", ".join(f"{key} by about {change}" for key, change in changes)
        yield f"the mesh changes {shown}, more than the interval; take more sheet.points"
    for n, m in zip(*np.nonzero(np.triu(np.abs(uncertainties.correlation) > MAX_CORRELATION, 1)), strict=True):
        keys = parameters[n].key, parameters[m].key
        if not any({*keys} <= {*group.parameters} for group in unidentified):
            fault = f"{keys[0]} and {keys[1]} correlate by {uncertainties.correlation[n, m]:.3f}"
            yield f"{fault}: the data hardly distinguish them, so that small model errors shift both; fix one if known"


def _rejection(
    scene: Scene, misfit: Misfit, solution: Solution, uncertainties: Uncertainty, error_correlation: ErrorCorrelation
) -> str | None:
    """Return the reason for rejecting the model, or None."""
    observations, parts = misfit.observations, misfit.split(uncertainties.residuals)
    predictions, reason = solution.predicted.values, None
    # Residuals have full weight here, even those of a robust fit of machine tests.
    if all(observed.sigma is not None for observed in observations):
        total = float(uncertainties.residuals @ uncertainties.residuals)
        reason = rejection.by_chi_square(total, uncertainties.freedom, uncertainties.independent)
    for observed, values, part, signal in zip(observations, predictions, parts, misfit.signals, strict=True):
        if reason is None and observed.sigma is None:
            reason = observed.pattern(scene, values, signal, error_correlation)
        elif reason is None and observed.is_independent:
            squares = float(part @ part)
            reason = rejection.by_chi_square(squares, len(part), len(part), f"chi-square of the {observed.noun}")
    return None if reason is None else reason + _larger_part(observations, parts, predictions)


def _larger_part(observations: Sequence[Observation], parts: Sequence[Array], predictions: Sequence[Array]) -> str:
    """Name the observation with the largest residuals [sigma], and the ratio to its prediction; "" if all are alike."""
    squares = [float(np.mean(part**2)) for part in parts]
    if len(parts) == 1 or max(squares) < 2.0 * min(squares):
        return ""
    largest = int(np.argmax(squares))
    return f", mostly of the {observations[largest].noun}{observations[largest].factor_note(predictions[largest])}"


def _mesh_effect(
    runs: Runs, misfit: Misfit, solution: Solution, uncertainties: Uncertainty
) -> tuple[float | None, Array]:
    """Return the mesh error, None without coarse meshes, and the shift of x that it causes, shape (n,), NaN if unknown.

    Richardson extrapolation, with the order of convergence of three meshes, at most the expected order. The two finer
    meshes may agree by chance: a shift is at least the coarser one, reduced by the expected order.
    """
    error = runs.mesh_error(solution.x)
    if error is None or (half_mesh := runs.predict_coarse(solution.x, 1)) is None:
        return None, np.full(len(solution.x), np.nan)
    expected_order = CONTACT_ORDER if any(probe.moved for probe in runs.problem.scene.probes) else 2.0

    def shift_between(coarse: Prediction, fine: Prediction) -> Array:
        rows = misfit.vector(coarse) - misfit.vector(fine)
        return np.abs(uncertainties.shift(misfit.scaled(rows, uncertainties.scales)))

    shifts, order = shift_between(half_mesh, solution.predicted), np.full(len(solution.x), expected_order)
    if (quarter_mesh := runs.predict_coarse(solution.x, 2)) is not None:
        coarse_shifts = shift_between(quarter_mesh, half_mesh)
        order = np.clip(np.log2(np.maximum(coarse_shifts, 1e-300) / np.maximum(shifts, 1e-300)), 1.0, expected_order)
        shifts = np.maximum(shifts, coarse_shifts / 2**expected_order)
    return error, np.where(uncertainties.unidentified, np.nan, shifts / (2**order - 1))


def _estimate(parameter: Parameter, x: float, deviation: float, profile: Profile, mesh_shift: float) -> Estimate:
    """Return an estimate; `mesh_shift`: shift of x by the mesh, NaN if unknown."""
    low, high = parameter.limits
    interval = [None if end is None or not low <= end <= high else parameter.value(end) for end in profile[1:]]
    if parameter.start < 0 and parameter.is_log:
        interval.reverse()
    value, error = parameter.value(x), parameter.error(x, deviation)
    identifiable = parameter.relative_error(x, deviation) <= MAX_RELATIVE_ERROR
    mesh_error = None if math.isnan(mesh_shift) else parameter.error(x, mesh_shift)
    return Estimate(value, error, (interval[0], interval[1]), parameter.start, identifiable, mesh_error)
