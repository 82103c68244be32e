"""Fast fit of quasi-static machine tests by a force curve, the elastic force over the travel of the tool.

All elastic forces relax alike, so the equilibrium of the tissue depends only on the travel. One run gives the elastic
force f at `TRAVELS` travels, and interpolation between them the force of any test at frame n,

    F_n = (1 - G) f_n + sum over i of (s_i + share_i phi_i f_n)

with G, share_i, phi_i and memory s_i as in `terms/viscoelasticity.py`.

- Depths of contact, shares and times change F_n, but not the curve.
- Other parameters change the curve. Its tangent is linear: log f over the log of each parameter, or over the reciprocal
  of a lock, from one more curve per parameter. The search minimises the cost of the tangent within a trust region,
  computes the curve at the minimum, and repeats both until the cost stops falling.
- A curve neglects the memory of mass points that leave the tool or slide along it. The last steps of the search
  therefore run the tests, and add the error of the tangent to it. The Jacobian is that of the tangent.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import DivergedError, SceneError, StageProgressCallback
from taichi_msm.fitting.least_squares import Misfit, Search, Solution
from taichi_msm.fitting.machine_model import MachineModel, MachineProblem
from taichi_msm.fitting.parameters import with_values
from taichi_msm.fitting.predict import FitProblem, Prediction, Runs, mesh_error
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene

# Number of travels of a curve above 0; extension of the curve for free depths of contact [share of its reach].
TRAVELS, CONTACT_MARGIN = 24, 0.05

# Share of every branch in the run of a curve: no relaxation, but the compiled kernels of the tests.
NO_SHARE = 1e-12

# Largest sum of the shares in a prediction.
MAX_SHARES = 0.999


def has_curve(problem: object) -> bool:
    """Return whether a force curve applies: quasi-static machine tests, with a single tool that does not grip."""
    if not isinstance(problem, MachineProblem):
        return False
    return problem.scene.time.at_rest and len(problem.scene.probes) == 1 and not problem.scene.probes[0].grip


def relax(elastic: Array, branches: Sequence[tuple[float, float]], h: float) -> Array:
    """Return the forces F_n of relaxing tissue [N], shape (frames,), from elastic ones f_n [N] at intervals of `h` [s].

    Each branch is its share and time [s].
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
    """Linearisation of a curve at x."""

    x: Array  # coordinates of the parameters, shape (n,)
    reach: float  # greatest travel [m]
    forces: Array  # elastic forces at equidistant travels [N], shape (TRAVELS + 1,)
    slopes: Array  # derivatives of log(forces) by x, shape (n, TRAVELS + 1)


class CurveRuns(Runs):
    """Predictions of machine tests by curves or by a tangent, both plus one correction of every frame.

    `workers` are ignored, as a curve is a single run.
    """

    problem: MachineProblem
    _model: MachineModel
    _tangent: _Tangent

    def __init__(self, problem: FitProblem, workers: int | None, progress: StageProgressCallback) -> None:
        super().__init__(problem, 1, progress)
        self._curves: dict[tuple[object, ...], Array] = {}
        self._correction: Array | float = 0.0
        self.by_tangent = True  # whether `predict_one` uses the tangent; otherwise it computes a curve
        keys = [parameter.key for parameter in self.problem.parameters]
        # Mask of the parameters that change the curve, shape (n,).
        self.changes_curve = np.array([not key.startswith(("contact", "tissue.relaxation.")) for key in keys])
        self._is_contact = np.array([key.startswith("contact") for key in keys])
        self._is_lock = np.array([key.endswith(".lock") for key in keys])

    def predict_initial(self, x: Array) -> Prediction:
        self._model.compile(x)
        return self.run_curve(x)

    def predict_one(self, x: Array, steps: int | None = None) -> Prediction | None:
        if not self.by_tangent:
            return self.predict_coarse(x, 0)
        tangent = self._tangent
        try:
            values = self._model.values(x)
        except SceneError:
            return None
        distance = x - tangent.x
        distance = np.where(self._is_lock, -np.expm1(-distance), distance)
        return self._predict(values, tangent.reach, tangent.forces * np.exp(distance @ tangent.slopes))

    def predict_coarse(self, x: Array, halvings: int) -> Prediction | None:
        with suppress(SceneError, DivergedError):
            return self.run_curve(x, halvings)
        return None

    def mesh_error(self, x: Array) -> float | None:
        # The run of the curve has the mesh error of the tests.
        values = self._model.values(x)
        return mesh_error(self._plan_curve(values, self._reach(values)), self._report_progress)

    def run_curve(self, x: Array, halvings: int = 0) -> Prediction:
        """Return the prediction by a curve at x, shape (n,); raise the errors of `ForwardModel.predict`."""
        return self._predict(*self._curve(x, halvings))

    def run_tests(self, x: Array) -> Prediction:
        """Return the prediction by runs of the tests at x; raise the errors of `ForwardModel.predict`."""
        self.count += len(self.problem.tests)
        return self._model.predict(x)

    def correct(self, x: Array, predicted: Prediction) -> None:
        """Add the error of the tangent at x to all further predictions; `predicted` is by a curve, or by the tests."""
        if (by_tangent := self.predict_one(x)) is not None:
            self._correction = self._correction + predicted.values[0] - by_tangent.values[0]

    def with_valid_shares(self, x: Array) -> Array:
        """Return x, with the free shares scaled down, within bounds, if all shares sum to more than `MAX_SHARES`."""
        keys, low = [parameter.key for parameter in self.problem.parameters], self.problem.limits[0]
        while True:
            values = self._model.values(x)
            branches = self._branches(values)
            names = [f"tissue.relaxation.{n}.share" for n in range(len(branches))]
            is_scaled = np.array([key in names for key in keys]) & (x > low)
            total = sum(share for share, _ in branches)
            scaled = sum(value for value, changes in zip(values.values(), is_scaled, strict=True) if changes)
            if total <= MAX_SHARES:
                return x
            # A sum of 0.98 leaves a margin for finite differences. Shares at their bounds leave the next pass.
            if (rest := 0.98 - (total - scaled)) <= 0:
                return np.where(is_scaled, low, x)
            x = np.maximum(x + np.log(rest / scaled) * is_scaled, low)

    def set_tangent(self, x: Array) -> None:
        """Linearise the curve at x; raise the errors of `ForwardModel.predict`."""
        (_, reach, forces), slopes = self._curve(x), np.zeros((len(x), TRAVELS + 1))
        for n in np.flatnonzero(self.changes_curve):
            shifted, delta = x.copy(), self.problem.difference_step
            delta = delta if x[n] + delta <= self.problem.parameters[n].limits[1] else -delta
            shifted[n] += delta
            moved = self._forces(self._model.values(shifted), reach)
            is_pressed = (forces > 0) & (moved > 0)
            slopes[n] = np.log(np.where(is_pressed, moved, 1.0) / np.where(is_pressed, forces, 1.0)) / delta
        self._tangent = _Tangent(x, reach, forces, slopes)

    def trust_region(self, x: Array, region: Array) -> tuple[Array, Array]:
        """Return the smallest and largest coordinates within bounds and within the reach of the curve, shape (n,) each.

        `region`: half width around x in every coordinate, shape (n,).
        """
        low, high = self.problem.limits
        # A parameter without effect does not move, which shrinks its region to 0.
        region = np.maximum(region, 1e-6)
        scales = np.array([parameter.scale or 1 for parameter in self.problem.parameters])
        margin = CONTACT_MARGIN * self._tangent.reach / scales
        below = np.where(self._is_contact, np.minimum(region, margin), region)
        return np.maximum(low, x - below), np.minimum(high, x + region)

    def contact_slopes(self, x: Array) -> Array:
        """Return the derivatives of the forces by the estimated depths of contact, shape (frames of all tests, m).

        Depths of contact that are given, or parameters, have no column.
        """
        values, reach, forces = self._curve(x)
        step, columns = 1e-3 * reach, []
        for loading, key in zip(self.problem.tests, self.problem.contact_keys, strict=True):
            if loading.finds_contact and key not in values:
                moved = [self._predict(values | {key: loading.contact + end}, reach, forces) for end in (step, -step)]
                columns.append((moved[0].values[0] - moved[1].values[0]) / (2 * step))
        return np.hstack([np.empty((sum(len(loading.force) for loading in self.problem.tests), 0)), *columns])

    def _curve(self, x: Array, halvings: int = 0) -> tuple[dict[str, float], float, Array]:
        """Return the parameter values by key at x, the greatest travel [m], and the forces of a curve."""
        values = self._model.values(x)
        reach = self._reach(values)
        return values, reach, self._forces(values, reach, halvings)

    def _reach(self, values: dict[str, float]) -> float:
        """Return the greatest travel of a curve [m]; raise a SceneError if it is 0 in all tests."""
        if not (reach := self.problem.reach(values)):
            raise SceneError(["contact: no test is deeper; take a smaller depth"])
        return reach * (1 + CONTACT_MARGIN * self._is_contact.any())

    def _branches(self, values: dict[str, float]) -> list[tuple[float, float]]:
        """Return share and time [s] of every branch of relaxation."""
        branches = []
        for n, branch in enumerate(self._model.data.get("tissue", {}).get("relaxation", ())):
            key = f"tissue.relaxation.{n}"
            branches.append((values.get(f"{key}.share", branch["share"]), values.get(f"{key}.time", branch["time"])))
        return branches

    def _predict(self, values: dict[str, float], reach: float, forces: Array) -> Prediction:
        """Predict the tests by a curve of `forces`, at equidistant travels up to `reach` [m]."""
        from scipy.interpolate import PchipInterpolator

        curve = PchipInterpolator(np.linspace(0, reach, TRAVELS + 1), forces)
        branches = self._branches(values)
        # Too large shares are scaled down: an error instead would be a wall that the search cannot leave.
        scale = min(1.0, MAX_SHARES / max(sum(share for share, _ in branches), NO_SHARE))
        branches = [(scale * share, time) for share, time in branches]
        pairs = zip(self.problem.tests, self.problem.contact_keys, strict=True)
        of_tests = [relax(curve(test.travel(values.get(key))), branches, 1 / test.rate) for test, key in pairs]
        return Prediction((np.concatenate(of_tests)[:, None] + self._correction,), 1, np.zeros(1))

    def _forces(self, values: dict[str, float], reach: float, halvings: int = 0) -> Array:
        """Return the forces of a curve at equidistant travels [N], shape (TRAVELS + 1,), with a cache."""
        curve_values = [value for value, changes in zip(values.values(), self.changes_curve, strict=True) if changes]
        key = (halvings, reach, *curve_values)
        if key not in self._curves:
            self._report_progress()
            simulation, plan = self._model.start(self._plan_curve(values, reach), None, halvings)
            self._curves[key] = self._model.forces(simulation, plan)[:, 0]
            self.count += 1
        return self._curves[key]

    def _plan_curve(self, values: dict[str, float], reach: float) -> Plan:
        """Plan a run with equidistant travels up to `reach` [m], without relaxation."""
        data = with_values(self._model.data, values)
        if branches := data.get("tissue", {}).get("relaxation"):
            still_branches = [{**branch, "share": NO_SHARE} for branch in branches]
            data = {**data, "tissue": {**data["tissue"], "relaxation": still_branches}}
        placed = self.problem.approach.place(data, np.linspace(0, reach, TRAVELS + 1), 1.0)
        return check_scene(Scene(**placed), self._model.maps)


def search_by_curve(runs: CurveRuns, misfit: Misfit, start: Array, initial: Prediction) -> tuple[Search, Solution]:
    """Minimise the misfit by tangents, then by curves, then by runs of the tests.

    Return the search, whose Jacobian is that of the last tangent, and the solution, with the forces of runs of the
    tests.
    """
    search = Search(runs, misfit)
    solution = _descend(runs, misfit, _scale_stiffnesses(runs, misfit, start, initial), by_tests=False)
    starts = []
    if not search.fits_well(solution):
        predictions = ((x, runs.predict_coarse(x, 0)) for x in search.alternative_starts())
        starts = misfit.two_best(predictions, solution.scales)
    # A parameter with an effect below 3 sigma per unit of x, such as a lock beyond the measured range, may fit better
    # at a smaller value.
    effect = np.linalg.norm(misfit.scaled(search.jacobian(solution), solution.scales), axis=0)
    for n in np.flatnonzero(runs.changes_curve & (effect < 3.0)):
        starts.append(solution.x.copy())
        starts[-1][n] = max(start[n] - 1, runs.problem.parameters[n].limits[0])
    for x in starts:
        with suppress(SceneError, DivergedError):
            solution = min(solution, _descend(runs, misfit, x, by_tests=False), key=lambda each: each.cost)
    runs.set_tangent(solution.x)
    solution = _descend(runs, misfit, solution.x, by_tests=True)
    runs.correct(solution.x, solution.predicted)
    return Search(runs, misfit), solution


def _scale_stiffnesses(runs: CurveRuns, misfit: Misfit, x: Array, initial: Prediction) -> Array:
    """Scale the stiffnesses of x by the ratio of measured to `initial` forces."""
    predicted = misfit.vector(initial)
    measured = predicted - misfit.difference(initial)
    ratio = np.linalg.norm(measured) / max(float(np.linalg.norm(predicted)), 1e-300)
    names = ("young", "foundation", "structural")
    is_stiffness = [parameter.is_log and parameter.path[-1] in names for parameter in runs.problem.parameters]
    return np.clip(np.where(is_stiffness, x + np.log(ratio), x), *runs.problem.limits)


def _descend(runs: CurveRuns, misfit: Misfit, start: Array, *, by_tests: bool) -> Solution:
    """Minimise the tangent within a trust region, evaluate its minimum by a curve or the tests, and repeat."""
    scales = misfit.scales(misfit.signals)

    def evaluate(x: Array) -> Solution:
        predicted = runs.run_tests(x) if by_tests else runs.run_curve(x)
        return Solution(x, predicted, scales, misfit.total(predicted, scales), converged=False)

    def is_converged(cost: float, previous: float) -> bool:
        # A third of a standard deviation of a parameter changes the cost by 0.05.
        return abs(previous - cost) <= max(1e-3 * previous, 0.05)

    current = evaluate(start)
    # The trust region of curve parameters starts at 0.5, and grows to 2 at most, in units of x.
    trial, region = current, np.where(runs.changes_curve, 0.5, np.inf)
    for step in range(20):
        if step and is_converged(trial.cost, current.cost):
            return replace(min(trial, current, key=lambda each: each.cost), converged=True)
        if trial.cost <= current.cost:
            if not by_tests:
                runs.set_tangent(trial.x)
            runs.correct(trial.x, trial.predicted)
            current, region = trial, np.minimum(2 * region, np.where(runs.changes_curve, 2.0, np.inf))
        else:
            shrunk = np.minimum(region, np.abs(trial.x - current.x)) / 4
            # Curves limit the parameters that change the curve, all alike; runs of the tests limit each by itself.
            if not by_tests:
                shrunk = np.where(runs.changes_curve, shrunk.max(where=runs.changes_curve, initial=0), region)
            region = shrunk
        limits = runs.trust_region(current.x, region)
        starts = [current.x] if by_tests or step else [current.x, *_relaxation_starts(runs, misfit, current, limits)]
        minimum = min((Search(runs, misfit, limits).refine(x) for x in starts), key=lambda each: each.cost)
        if is_converged(minimum.cost, current.cost):
            return replace(current, converged=True)
        try:
            trial = evaluate(runs.with_valid_shares(minimum.x))
        except (SceneError, DivergedError):
            trial = replace(minimum, cost=np.inf)
    return current


def _relaxation_starts(runs: CurveRuns, misfit: Misfit, current: Solution, limits: tuple[Array, Array]) -> list[Array]:
    """Return the two best of 64 starts, within a factor of 10 in the parameters that do not change the curve."""
    free = np.flatnonzero(~runs.changes_curve)
    if not len(free):
        return []
    from scipy.stats import qmc

    max_log = np.log(10.0)
    low, high = (np.clip(limit[free], current.x[free] - max_log, current.x[free] + max_log) for limit in limits)
    starts = np.tile(current.x, (64, 1))
    starts[:, free] = low + qmc.Sobol(len(free), seed=1).random(64) * (high - low)
    return misfit.two_best(((x, runs.predict_one(x)) for x in starts), current.scales)
