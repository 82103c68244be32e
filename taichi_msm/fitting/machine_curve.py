"""Fast approximation of quasi-static machine tests: one curve of elastic force over travel, relaxed in time.

All elastic forces relax alike, so that the equilibrium of the tissue depends on the travel of the tool only. With f,
the elastic force over the travel, computed at few travels and interpolated, the force of every test at frame n is

    F_n = (1 - G) f_n + sum of (s_i + share_i phi_i f_n)

with shares, phi and the memory s_i of `terms/viscoelasticity.py`. Depths of contact, shares and times need no further
curve, and log f is nearly linear in the logarithms of the other parameters, or in the reciprocal of a lock, with slopes
from a curve each. This model is minimised within a trust region, and compared with a curve at its minimum, until it
does not improve.

It neglects the memory of mass points that leave the tool, and of those that slide along it. Therefore it is finally
compared with runs of the tests, whose difference from the model is added to it. The Jacobian is that of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from taichi_msm.errors import DivergedError, SceneError, StageProgressCallback
from taichi_msm.fitting.least_squares import Misfit, Search, Solution
from taichi_msm.fitting.machine_model import MachineModel, MachineProblem
from taichi_msm.fitting.observation import Array
from taichi_msm.fitting.predict import FitProblem, Prediction, Runs, difference_step, mesh_error
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene

# Number of travels of a curve above 0, and its reach beyond the greatest travel if depths of contact are free.
TRAVELS, CONTACT_MARGIN = 24, 0.05

# Share of branches in the runs of a curve, with which the tissue does not relax, but has the kernels of the tests.
NO_SHARE = 1e-12

# Largest sum of the shares in the model.
MAX_SHARES = 0.999


def has_curve(problem: object) -> bool:
    """Return whether the tests of a fit are quasi-static, and of a scene with one tool, which grips nothing."""
    if not isinstance(problem, MachineProblem):
        return False
    return problem.scene.time.at_rest and len(problem.scene.probes) == 1 and not problem.scene.probes[0].grip


def relax(elastic: Array, branches: Sequence[tuple[float, float]], h: float) -> Array:
    """Return the force of relaxing tissue [N], shape (frames,).

    Args:
        elastic: elastic force at every frame [N], shape (frames,).
        branches: share and time [s] of every branch.
        h: time between frames [s].
    """
    if not branches:
        return elastic
    shares, times = np.array(branches).T
    decay = np.exp(-h / times)
    phi = -np.expm1(-h / times) * times / h
    force, memory = elastic.copy(), shares * (decay - phi) * elastic[0]
    for n in range(1, len(elastic)):
        force[n] = (1 - shares.sum() + shares @ phi) * elastic[n] + memory.sum()
        memory = decay * memory - shares * phi * (1 - decay) * elastic[n]
    return force


class _Tangent(NamedTuple):
    """A curve, and its dependence on the parameters."""

    x: Array  # coordinates of the parameters, shape (n,)
    reach: float  # greatest travel [m]
    forces: Array  # forces at x [N], shape (TRAVELS + 1,)
    slopes: Array  # derivatives of their logarithms by x, shape (n, TRAVELS + 1)


class CurveRuns(Runs):
    """Predictions of machine tests by a tangent, or by curves, with a correction of every frame.

    Args:
        problem: the fit.
        workers: ignored, as a curve is a single run.
        progress: called often, as of `Runs`.

    Attributes:
        by_tangent: whether predictions are by the tangent; otherwise by curves.
        of_curve: mask of the parameters on which a curve depends, shape (n,).
        of_contact: mask of the depths of contact, shape (n,).
    """

    problem: MachineProblem
    _predictor: MachineModel
    _tangent: _Tangent

    def __init__(self, problem: FitProblem, workers: int | None, progress: StageProgressCallback) -> None:
        super().__init__(problem, 1, progress)
        self._curves: dict[tuple[object, ...], Array] = {}
        self._correction: Array | float = 0.0
        self.by_tangent = True
        keys = [parameter.key for parameter in self.problem.parameters]
        self.of_curve = np.array([not key.startswith(("contact", "tissue.relaxation.")) for key in keys])
        self.of_contact = np.array([key.startswith("contact") for key in keys])
        self._of_lock = np.array([key.endswith(".lock") for key in keys])

    def first(self, x: Array) -> Prediction:
        self._predictor.compile(x, self._report_progress)
        return self.run_curve(x)

    def predict_one(self, x: Array, steps: int | None = None) -> Prediction | None:
        if not self.by_tangent:
            return self.predict_coarse(x, 0)
        tangent = self._tangent
        try:
            values = self._predictor.values(x)
        except SceneError:
            return None
        distance = x - tangent.x
        distance = np.where(self._of_lock, -np.expm1(-distance), distance)
        return self._predict(values, tangent.reach, tangent.forces * np.exp(distance @ tangent.slopes))

    def predict_coarse(self, x: Array, halvings: int) -> Prediction | None:
        try:
            return self.run_curve(x, halvings)
        except (SceneError, DivergedError):
            return None

    def mesh_error(self, x: Array) -> float | None:
        # That of the run of a curve.
        values = self._predictor.values(x)
        return mesh_error(self._plan_curve(values, self._reach(values)), self._report_progress)

    def run_curve(self, x: Array, halvings: int = 0) -> Prediction:
        """Return the prediction by a curve; raises as `ForwardModel.predict` does.

        Args:
            x: coordinates of the parameters, shape (n,).
            halvings: number of halvings of the cells per side.
        """
        values = self._predictor.values(x)
        reach = self._reach(values)
        return self._predict(values, reach, self._forces(values, reach, halvings))

    def run_tests(self, x: Array) -> Prediction:
        """Return the prediction by runs of the tests at x; raises as `ForwardModel.predict` does."""
        self.count += len(self.problem.tests)
        return self._predictor.predict(x, pause=self._report_progress)

    def correct(self, x: Array, predicted: Prediction) -> None:
        """Correct all further predictions by the error of the tangent at a place.

        Args:
            x: coordinates of the parameters, shape (n,).
            predicted: prediction at x without this error.
        """
        if (by_tangent := self.predict_one(x)) is not None:
            self._correction = self._correction + predicted.values[0] - by_tangent.values[0]

    def with_valid_shares(self, x: Array) -> Array:
        """Return x with free shares reduced, if the sum of all shares is too large."""
        values = self._predictor.values(x)
        branches = self._branches(values)
        free = [key for n in range(len(branches)) if (key := f"tissue.relaxation.{n}.share") in values]
        total = sum(share for share, _ in branches)
        if total <= MAX_SHARES or not free:
            return x
        of_free = sum(values[key] for key in free)
        # They are reduced to a sum of 0.98, with a margin for differences.
        reduction = np.log(max(0.98 - (total - of_free), NO_SHARE) / of_free)
        return x + reduction * np.array([parameter.key in free for parameter in self.problem.parameters])

    def set_tangent(self, x: Array) -> None:
        """Set the tangent to the curve at x; raises as `ForwardModel.predict` does."""
        values = self._predictor.values(x)
        reach = self._reach(values)
        forces, slopes = self._forces(values, reach), np.zeros((len(x), TRAVELS + 1))
        for n in np.flatnonzero(self.of_curve):
            shifted, delta = x.copy(), difference_step(self.problem.scene)
            delta = delta if x[n] + delta <= self.problem.parameters[n].limits[1] else -delta
            shifted[n] += delta
            moved = self._forces(self._predictor.values(shifted), reach)
            is_pressed = (forces > 0) & (moved > 0)
            slopes[n] = np.log(np.where(is_pressed, moved, 1.0) / np.where(is_pressed, forces, 1.0)) / delta
        self._tangent = _Tangent(x, reach, forces, slopes)

    @property
    def reach(self) -> float:
        """Greatest travel of the tangent's curve [m]."""
        return self._tangent.reach

    def _reach(self, values: dict[str, float]) -> float:
        """Return the greatest travel of a curve [m]; raise a SceneError if no test has any."""
        if not (reach := self.problem.reach(values)):
            raise SceneError(["contact: no test goes deeper; take a smaller depth"])
        return reach * (1 + CONTACT_MARGIN * self.of_contact.any())

    def _branches(self, values: dict[str, float]) -> list[tuple[float, float]]:
        """Return share and time [s] of every branch of relaxation."""
        branches = []
        for n, branch in enumerate(self._predictor.data.get("tissue", {}).get("relaxation", ())):
            key = f"tissue.relaxation.{n}"
            branches.append((values.get(f"{key}.share", branch["share"]), values.get(f"{key}.time", branch["time"])))
        return branches

    def _predict(self, values: dict[str, float], reach: float, forces: Array) -> Prediction:
        """Predict the tests by a curve."""
        from scipy.interpolate import PchipInterpolator

        curve = PchipInterpolator(np.linspace(0, reach, TRAVELS + 1), forces)
        branches = self._branches(values)
        # Larger shares are scaled, as the search would not leave a wall there.
        scale = min(1.0, MAX_SHARES / max(sum(share for share, _ in branches), NO_SHARE))
        branches = [(scale * share, time) for share, time in branches]
        of_tests = [
            relax(curve(loading.travel(values.get(key))), branches, 1 / loading.rate)
            for loading, key in zip(self.problem.tests, self.problem.contact_keys, strict=True)
        ]
        return Prediction((np.concatenate(of_tests)[:, None] + self._correction,), 1, np.zeros(1))

    def _forces(self, values: dict[str, float], reach: float, halvings: int = 0) -> Array:
        """Run a curve; return its forces at equidistant travels [N], shape (TRAVELS + 1,)."""
        of_curve = [value for value, matters in zip(values.values(), self.of_curve, strict=True) if matters]
        key = (halvings, reach, *of_curve)
        if key not in self._curves:
            self._report_progress()
            simulation, plan = self._predictor.start(self._plan_curve(values, reach), None, halvings)
            self._curves[key] = self._predictor.forces(simulation, plan, self._report_progress)[:, 0]
            self.count += 1
        return self._curves[key]

    def _plan_curve(self, values: dict[str, float], reach: float) -> Plan:
        """Plan a run with equidistant travels up to `reach` [m], without relaxation."""
        data = self.problem.with_scene_values(self._predictor.data, values)
        if branches := data.get("tissue", {}).get("relaxation"):
            no_branches = [{**branch, "share": NO_SHARE} for branch in branches]
            data = {**data, "tissue": {**data["tissue"], "relaxation": no_branches}}
        placed = self.problem.approach.place(data, np.linspace(0, reach, TRAVELS + 1), 1.0)
        return check_scene(Scene(**placed), self._predictor.maps)


def search_by_curve(runs: CurveRuns, misfit: Misfit, start: Array, first: Prediction) -> tuple[Search, Solution]:
    """Minimise from a start by tangents, curves, and runs of the tests.

    Args:
        runs: predictions.
        misfit: residuals.
        start: initial coordinates of the parameters, shape (n,).
        first: prediction at the start.

    Returns:
        The search by the last tangent, and the solution with the forces of the tests.

    Raises:
        SceneError: when the scene of a curve next to an estimate is not valid.
        DivergedError: when the run of a curve diverges.
    """
    search = Search(runs, misfit)
    solution = _descend(runs, misfit, _scaled(runs, misfit, start, first), by_tests=False)
    starts = []
    if not search.fits_well(solution):
        costs = []
        for x in search.alternative_starts():
            if (predicted := runs.predict_coarse(x, 0)) is not None:
                costs.append((misfit.cost(misfit.residuals(predicted, solution.scales)), x.tolist()))
        starts = [np.array(x) for _, x in sorted(costs)[:2]]
    # A lock or factor beyond the measured forces has no effect, but may fit better at a smaller value, which has one.
    # Then the forces change by less than 3 sigma per unit of x.
    information = np.linalg.norm(misfit.scaled(search.jacobian(solution), solution.scales), axis=0)
    for n in np.flatnonzero(runs.of_curve & (information < 3.0)):
        starts.append(solution.x.copy())
        starts[-1][n] = max(start[n] - 1, runs.problem.parameters[n].limits[0])
    for x in starts:
        with suppress(SceneError, DivergedError):
            solution = min(solution, _descend(runs, misfit, x, by_tests=False), key=lambda each: each.cost)
    runs.set_tangent(solution.x)
    solution = _descend(runs, misfit, solution.x, by_tests=True)
    runs.correct(solution.x, solution.predicted)
    return Search(runs, misfit), solution


def _scaled(runs: CurveRuns, misfit: Misfit, x: Array, initial: Prediction) -> Array:
    """Scale the stiffnesses so that the `initial` forces have the size of the measured ones."""
    predicted = misfit.row(initial)
    measured = predicted - misfit.of(initial)
    ratio = np.linalg.norm(measured) / max(float(np.linalg.norm(predicted)), 1e-300)
    names = ("young", "foundation", "structural")
    is_stiffness = [parameter.is_log and parameter.path[-1] in names for parameter in runs.problem.parameters]
    return np.clip(np.where(is_stiffness, x + np.log(ratio), x), *runs.problem.limits)


def _descend(runs: CurveRuns, misfit: Misfit, start: Array, *, by_tests: bool) -> Solution:
    """Minimise the tangent within a trust region, and evaluate its minimum by a curve or the tests, repeatedly."""
    scales = misfit.scales(misfit.signals)

    def evaluate(x: Array) -> Solution:
        predicted = runs.run_tests(x) if by_tests else runs.run_curve(x)
        return Solution(x, predicted, scales, misfit.cost(misfit.residuals(predicted, scales)), converged=False)

    def is_at_end(cost: float, current: float) -> bool:
        # A change of the cost of 0.05 is that by a third of a standard deviation of a parameter.
        return abs(current - cost) <= max(1e-3 * current, 0.05)

    current = evaluate(start)
    # The trust region of the parameters of a curve is at first 0.5, and at most 2, in units of x.
    trial, region = current, np.where(runs.of_curve, 0.5, np.inf)
    for step in range(20):
        if step and is_at_end(trial.cost, current.cost):
            return replace(min(trial, current, key=lambda each: each.cost), converged=True)
        if trial.cost <= current.cost:
            if not by_tests:
                runs.set_tangent(trial.x)
            runs.correct(trial.x, trial.predicted)
            current, region = trial, np.minimum(2 * region, np.where(runs.of_curve, 2.0, np.inf))
        else:
            shrunk = np.minimum(region, np.abs(trial.x - current.x)) / 4
            region = shrunk if by_tests else np.where(runs.of_curve, shrunk.max(where=runs.of_curve, initial=0), region)
        limits = _limits(runs, current.x, region)
        starts = [current.x] if by_tests or step else [current.x, *_relaxation_starts(runs, misfit, current, limits)]
        minimum = min((Search(runs, misfit, limits).refine(x) for x in starts), key=lambda each: each.cost)
        if is_at_end(minimum.cost, current.cost):
            return replace(current, converged=True)
        try:
            trial = evaluate(runs.with_valid_shares(minimum.x))
        except (SceneError, DivergedError):
            trial = replace(minimum, cost=np.inf)
    return current


def _limits(runs: CurveRuns, x: Array, region: Array) -> tuple[Array, Array]:
    """Return the bounds of x within the trust region, and of depths of contact within the reach of the curve."""
    low, high = runs.problem.limits
    margin = np.array([CONTACT_MARGIN * runs.reach / (parameter.scale or 1) for parameter in runs.problem.parameters])
    below = np.where(runs.of_contact, np.minimum(region, margin), region)
    return np.maximum(low, x - below), np.minimum(high, x + region)


def _relaxation_starts(runs: CurveRuns, misfit: Misfit, current: Solution, limits: tuple[Array, Array]) -> list[Array]:
    """Return the two best of 64 starts of the parameters that need no curve, within a factor of 10."""
    free = np.flatnonzero(~runs.of_curve)
    if not len(free):
        return []
    from scipy.stats import qmc

    max_log = np.log(10.0)
    low, high = (np.clip(limit[free], current.x[free] - max_log, current.x[free] + max_log) for limit in limits)
    costs = []
    for shares in qmc.Sobol(len(free), seed=1).random(64):
        x = current.x.copy()
        x[free] = low + shares * (high - low)
        if (predicted := runs.predict_one(x)) is not None:
            costs.append((misfit.cost(misfit.residuals(predicted, current.scales)), x.tolist()))
    return [np.array(x) for _, x in sorted(costs)[:2]]
