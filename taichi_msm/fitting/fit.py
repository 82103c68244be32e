"""From a scene and what was seen to the values of its parameters, with their uncertainty."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict, Unpack

from taichi_msm.arguments import require_path
from taichi_msm.errors import ArgumentError, DivergedError, SceneError, writing
from taichi_msm.fitting.estimation import Misfit, Search, Solution
from taichi_msm.fitting.identifiability import Unseen, shares, unseen
from taichi_msm.fitting.observations import read_forces, read_observations, with_sigma
from taichi_msm.fitting.parameters import Bounds, Parameter, as_data, make_parameters, with_values
from taichi_msm.fitting.prediction import Job, runnable, seen_at_rest
from taichi_msm.fitting.profiles import Place, Profile, Profiler
from taichi_msm.fitting.report import publication, write_report
from taichi_msm.fitting.result import Estimate, FitResult, finite
from taichi_msm.fitting.runs import Runs
from taichi_msm.fitting.suspicions import faults, faults_beside, moved, notes_beside
from taichi_msm.fitting.uncertainty import Uncertainty, likeness, uncertainty
from taichi_msm.physics.mesh_error import WITH_CONTACT
from taichi_msm.progress import Progress
from taichi_msm.scene import Scene
from taichi_msm.scenefile.load import load_scene
from taichi_msm.scenefile.validation import checked

Array = NDArray[np.float64]

# Notes are made of correlations of parameters above the first number, and of what is left above the second.
TIED, ALIKE = 0.95, 0.3

# What is left is too small to say anything of below this share of the motion.
NOTHING_LEFT = 1e-6

# A parameter this close to a bound, in units of x, has ended there.
AT_BOUND = 1e-3

# Points of the curve of a parameter's curvature.
CURVE = np.linspace(-3, 3, 25)


class Method(TypedDict, total=False):
    """How a fit is made."""

    sigma: float | None  # standard deviation of what was seen, in place of that in the file [m] or [px]
    robust: bool  # whether what is far off counts less
    profile: bool  # whether the intervals are found by profiles
    correlation: float | None  # how far in the picture errors of tracks are alike [px]


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
        free: the keys that are fitted, by their dotted paths, such as tissue.young or probes.0.total.2.
        bounds: smallest and largest values of keys.
        forces: a forces.csv of the same motion, and the standard deviation of its forces [N].
        directory: where fit.json, scene.yaml and fit.png go; None: nothing is written.
        workers: processes that take runs side by side; None: as many as pay.
        progress: called often, with the stage, the runs done and about how many there will be; what it raises stops the
            fit, and nothing is written.
        **method: sigma, in place of the file's; robust: whether numbers that are far off count less; profile: whether
            the intervals are found by going there; correlation: how far apart in the picture errors of tracks are alike
            [px].

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
    _require_arguments(free, bounds, workers, method)
    given = load_scene(scene) if isinstance(scene, (str, Path)) else checked(scene).scene
    for section in ("sheet", "time"):
        if (tolerance := getattr(given, section).tolerance) is not None:
            said = "is for one run, and a fit compares many; remove it, and take what `run` chose for it"
            raise SceneError([f"{section}.tolerance: {tolerance:g} {said}"])
    seen = with_sigma(read_observations(observed, given.time.frames_per_second), method.get("sigma"))
    parameters = make_parameters(given, free, bounds or {})
    if forces is not None:
        seen = replace(seen, forces=read_forces(forces[0], forces[1], len(given.probes)))
    if method.get("correlation") is not None and seen.kind != "pixel":
        raise SceneError([f"{seen.name}: --correlation is in pixels, and these are positions; leave it out"])
    if wrong := list(faults(seen, given, len(parameters))):
        raise SceneError(wrong)
    with ExitStack() as opened:
        if directory is not None:
            require_path(directory)
            opened.enter_context(writing(directory))
            published = opened.enter_context(publication(Path(directory)))
        job = Job(secrets.token_hex(8), runnable(given), parameters, seen)
        runs = opened.enter_context(Runs(job, workers, progress))
        result = _Fit(runs, given, method).result(begun)
        if directory is not None:
            progress("write", 0, 0)
            write_report(result, published)
    return result


class _Fit:
    """A fit under way."""

    def __init__(self, runs: Runs, given: Scene, method: Method) -> None:
        self._runs, self._given, self._seen = runs, given, runs.job.observations
        self._robust, self._profiled = method.get("robust", False), method.get("profile", False)
        self._correlation = method.get("correlation")
        self._notes: list[str] = []

    def result(self, begun: float) -> FitResult:
        """Search, and say how well the best values are known."""
        runs, seen, given, job = self._runs, self._seen, self._given, self._runs.job
        start = np.zeros(len(job.parameters))
        runs.expected = 8 * len(start) + 4
        first = runs.first(start)
        if wrong := list(faults_beside(seen, given, first)):
            raise SceneError(wrong)
        self._notes += notes_beside(seen, given, first)
        motion = moved(seen, given) or 1.0
        search = Search(runs, motion, robust=self._robust)
        solution = search.best(start)
        alike = None if self._correlation is None else likeness(seen_at_rest(given, seen)[:, 0], self._correlation)
        uncertain = uncertainty(search.misfit, seen, solution, search.derivatives(solution), alike, robust=self._robust)
        profiles = (
            Profiler(search.misfit, solution, uncertain, robust=self._robust).profiles(runs) if self._profiled else None
        )
        if not solution.converged:
            self._notes.append("the search ended before it came to rest; start nearer by --set, or give --bounds")
        if not search.fits(solution):
            self._notes.append("what is left is large: the scene does not move as was seen with any of these values")
        mesh, shifts = self._mesh(solution, uncertain, search.misfit)
        self._note_mesh(solution.x, uncertain, shifts)
        found = [self._estimate(n, solution.x, uncertain, profiles, shifts) for n in range(len(job.parameters))]
        blind = unseen(job.parameters, solution.x, uncertain, forces=seen.forces is not None)
        self._note_what_is_left(solution, uncertain, blind, motion)
        values = [one.value for one in found]
        numbers = search.misfit.of(solution.predicted)[: search.misfit.count[0]]
        chi_square = float(uncertain.left @ uncertain.left) if seen.sigma is not None else None
        keys = [one.key for one in job.parameters]
        return FitResult(
            parameters=dict(zip(keys, found, strict=True)),
            correlation=uncertain.correlation.tolist(),
            residual=float(np.sqrt(np.mean(numbers**2))) if len(numbers) else 0.0,
            sigma=uncertain.scales.values,
            unit=seen.unit,
            chi_square=chi_square,
            degrees_of_freedom=uncertain.freedom,
            identifiable=all(one.identifiable for one in found),
            unseen=blind,
            mesh_error=mesh,
            runs=runs.count,
            seconds=time.perf_counter() - begun,
            notes=self._notes,
            scene=_with_values(given, job, values),
            observations=seen,
            fitted=solution.predicted.values,
            curves={one.key: _curve(one, n, solution.x, uncertain, profiles) for n, one in enumerate(job.parameters)},
        )

    def _mesh(self, solution: Solution, uncertain: Uncertainty, misfit: Misfit) -> tuple[float | None, Array | None]:
        """Estimate the error of the points, and how far it moves every parameter, in units of x."""
        try:
            estimate = self._runs.mesh_error(solution.x)
            if estimate is None or not math.isfinite(estimate.error):
                return None, None
            coarse = self._runs.coarse(solution.x)
        except (DivergedError, SceneError):  # with fewer points
            return None, None
        order = WITH_CONTACT if any(probe.moved for probe in self._given.probes) else 2.0
        rows = misfit.row(coarse) - misfit.row(solution.predicted)
        return estimate.error, np.abs(uncertain.shift(misfit.divided(rows, uncertain.scales))) / (2**order - 1)

    def _estimate(
        self, n: int, x: Array, uncertain: Uncertainty, profiles: list[Profile] | None, shifts: Array | None
    ) -> Estimate:
        """Put together what is known of a parameter."""
        one, deviation = self._runs.job.parameters[n], float(uncertain.deviations[n])
        share = shares(self._runs.job.parameters, x, uncertain)[n]
        low, high = one.limits
        if min(x[n] - low, high - x[n]) < AT_BOUND:
            bound = (
                "a bound" if math.isfinite(one.low) or math.isfinite(one.high) else "1000 times from where it starts"
            )
            self._notes.append(f"{one.key}: ended at {one.value(x[n]):.4g}, {bound}: its interval says little")
        ends: tuple[float | None, float | None]
        if profiles is not None:
            ends = profiles[n].low, profiles[n].high
        else:
            ends = x[n] - uncertain.quantile * deviation, x[n] + uncertain.quantile * deviation
        interval = [None if end is None else finite(one.value(end)) for end in ends]
        if one.is_log:  # Nothing is known of an end that underflows.
            interval = [end or None for end in interval]
        if one.start < 0 and one.is_log:
            interval.reverse()
        shift = None if shifts is None else one.error(x[n], float(shifts[n]))
        return Estimate(
            value=one.value(x[n]),
            standard_error=finite(one.error(x[n], deviation)),
            interval=(interval[0], interval[1]),
            start=one.start,
            identifiable=bool(share <= 1),
            mesh_error=None if shift is None else finite(shift),
        )

    def _note_mesh(self, x: Array, uncertain: Uncertainty, shifts: Array | None) -> None:
        """Note the parameters that the number of points moves farther than what was seen leaves open."""
        parameters = self._runs.job.parameters
        wide = uncertain.quantile * uncertain.deviations
        if moved_far := [
            f"{one.key} by about {100 * one.share(x[n], float(shifts[n])):.2g} %"
            for n, one in enumerate(parameters)
            if shifts is not None and shifts[n] > wide[n]
        ]:
            said = "more than what was seen leaves open; take more sheet.points"
            self._notes.append(f"the number of points moves {', '.join(moved_far)}: {said}")

    def _note_what_is_left(
        self, solution: Solution, uncertain: Uncertainty, blind: list[Unseen], motion: float
    ) -> None:
        """Note parameters that are tied together, and errors that are not independent."""
        keys = [one.key for one in self._runs.job.parameters]
        correlation = uncertain.correlation
        for n, m in zip(*np.nonzero(np.triu(np.abs(correlation) > TIED, 1)), strict=True):
            if not any({keys[n], keys[m]} <= set(one.parameters) for one in blind):
                tied = f"{keys[n]} and {keys[m]} correlate by {correlation[n, m]:.3f}"
                self._notes.append(f"{tied}: they are known best together")
        if uncertain.factor > 1.5:
            times = math.sqrt(uncertain.factor)
            self._notes.append(f"what is left is {times:.2g} times sigma, and the intervals are widened by as much")
        left = np.where(self._seen.known, solution.predicted.values - self._seen.values, np.nan)
        if np.sqrt(np.nanmean(left**2)) < NOTHING_LEFT * motion:
            return
        beside, after = _alike(left, self._seen.coordinates)
        if beside > ALIKE and self._correlation is None:
            remedy = "; give --correlation PX" if self._seen.kind == "pixel" else ""
            said = f"what is left of neighbouring points is alike (correlation {beside:.2f})"
            self._notes.append(f"{said}, so that the intervals are too narrow{remedy}")
        elif after > ALIKE:
            said = f"what is left of a point is alike from one time to the next (correlation {after:.2f})"
            self._notes.append(f"{said}, so that the intervals are too narrow")


def _alike(left: Array, coordinates: Array) -> tuple[float, float]:
    """Correlate what is left of points, shape (N, T, numbers), with that of their nearest neighbours, and in time."""
    from scipy.spatial import KDTree

    def likeness_of(one: Array, other: Array) -> float:
        product, square = one * other, one**2 + other**2
        there = np.isfinite(product)
        return 2 * float(product[there].sum()) / max(float(square[there].sum()), 1e-300) if there.any() else 0.0

    # The nearest to a point but for itself.
    beside = likeness_of(left, left[KDTree(coordinates).query(coordinates, 2)[1][:, 1]]) if len(left) > 1 else 0.0
    return beside, likeness_of(left[:, 1:], left[:, :-1])


def _curve(one: Parameter, n: int, x: Array, uncertain: Uncertainty, profiles: list[Profile] | None) -> list[Place]:
    """Give the profile of a parameter, or what its curvature tells, at values."""
    if profiles is not None:
        return [Place(one.value(place.x), place.deviations) for place in profiles[n].places]
    deviation = min(float(uncertain.deviations[n]), 3.0)
    return [Place(one.value(x[n] + share * deviation), float(share)) for share in CURVE]


def _with_values(given: Scene, job: Job, values: list[float]) -> Scene:
    """Give the scene with the values that were found."""
    return Scene(**with_values(as_data(given), job.parameters, values))


def _require_arguments(
    free: Sequence[str], bounds: Mapping[str, Bounds] | None, workers: int | None, method: Method
) -> None:
    """Check the arguments of a call."""
    if isinstance(free, str) or not all(isinstance(key, str) for key in free):
        raise ArgumentError(f'free: {free!r}; take a list of keys, such as ["tissue.young"]')
    for key, pair in (bounds or {}).items():
        if not (isinstance(pair, Sequence) and len(pair) == 2 and all(isinstance(end, (int, float)) for end in pair)):
            raise ArgumentError(f"bounds: {key}: {pair!r}; take (low, high)")
    if workers is not None and not (type(workers) is int and workers > 0):
        raise ArgumentError(f"workers: {workers!r}; take a whole number, 1 or more, or None")
    if unknown := set(method) - set(Method.__annotations__):
        raise ArgumentError(f"{unknown.pop()}: unknown; take {', '.join(Method.__annotations__)}")
    correlation = cast("Any", method.get("correlation"))
    if correlation is not None and not 0 < correlation < math.inf:
        raise ArgumentError(f"correlation: {correlation!r}; take a number of pixels above 0, or None")
