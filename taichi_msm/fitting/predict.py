"""Forward model of a fit: predictions of observations, in this process or in a pool.

Runs are in f64, and every process compiles its kernels once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from typing_extensions import Self

from taichi_msm.accuracy.mesh import coarser_plan, estimate_mesh_error
from taichi_msm.arithmetic import Array
from taichi_msm.errors import DivergedError, ExecutorError, Pause, SceneError, StageProgressCallback
from taichi_msm.fitting.observation import Observation, ObservationModel, time_in_frames
from taichi_msm.fitting.parameters import Parameter, as_data, with_values
from taichi_msm.load import cost
from taichi_msm.load.check import check_scene
from taichi_msm.machines.loading import Loading
from taichi_msm.model.plan import Plan
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.sweeps.pool import DiedError, Pool
from taichi_msm.sweeps.tables import PROCESS_BYTES
from taichi_msm.system import runtime
from taichi_msm.system.process import available_memory, available_threads


class Prediction(NamedTuple):
    """Predicted observations."""

    # Predicted values of every observation, with its shape; NaN where a point is behind the camera.
    values: tuple[Array, ...]
    steps: int  # per frame
    motion: Array  # largest displacement of the observed points at every simulated frame [m], shape (frames,)


@dataclass(frozen=True, eq=False)
class FitProblem:
    """Scene, parameters and observations of a fit."""

    # Sides of the finite differences at the solution: (1, -1) central, (1,) forward.
    signs: ClassVar[tuple[int, ...]] = (1, -1)

    scene: Scene  # with its initial values
    parameters: tuple[Parameter, ...]
    observations: tuple[Observation, ...]
    tests: tuple[Loading, ...] = ()  # of testing machines

    @property
    def limits(self) -> tuple[Array, Array]:
        """Smallest and largest coordinates of the parameters, each of shape (n,)."""
        low, high = np.array([parameter.limits for parameter in self.parameters]).T
        return low, high

    @property
    def difference_step(self) -> float:
        """Step of finite differences, in units of x, large enough for all observations."""
        return max(observed.difference_step(self.scene) for observed in self.observations)

    def build_model(self, threads: int | None, pause: Pause = lambda: None) -> ForwardModel:
        """Build the forward model on a number of threads, by default on all cores."""
        return ForwardModel(self, threads, pause)

    def fitted_data(self, data: dict[str, Any], values: Mapping[str, float], n: int = 0) -> dict[str, Any]:  # noqa: ARG002
        """Return a scene's data, from `as_data`, with parameter values by key; `n`: index of a machine test."""
        return with_values(data, values)


def without_outputs(scene: Scene) -> Scene:
    """Return a scene in f64, without outputs, and without image unless its surface is that of a picture."""
    time = scene.time.model_copy(update={"precision": "f64"})
    is_framed = scene.sheet.surface is not None and scene.sheet.surface.frame_key is not None
    unused = {} if is_framed else {"image": None, "region": None}
    return scene.model_copy(update={**unused, "output": (), "time": time})


class ForwardModel:
    """Forward model of a fit: a simulation that is restarted for every prediction."""

    def __init__(self, problem: FitProblem, threads: int | None, pause: Pause = lambda: None) -> None:
        self.problem, self.data = problem, as_data(problem.scene)
        self.maps, self._threads, self._pause = check_scene(problem.scene).maps, threads, pause
        self._simulation: Simulation | None = None
        times = np.concatenate([observed.time for observed in problem.observations])
        self._frames = max(2, math.ceil(time_in_frames(problem.scene, times).max()) + 1)

    def predict(self, x: Array, steps: int | None = None, *, halvings: int = 0, to_end: bool = False) -> Prediction:
        """Return the prediction of a run with the parameters at x, shape (n,).

        `steps` is the smallest number per frame, by default enough for finite differences around x; `halvings` is that
        of the cells per side; `to_end` simulates to the last frame, beyond the last observation. Raise a SceneError for
        an invalid scene or too few mass points to be coarsened, a DivergedError for a diverging run.
        """
        simulation, plan = self.start(self.plan(x), steps, halvings)
        # The mesh of a coarse run differs.
        models = [observed.build_model(plan.scene, self._frames) for observed in self.problem.observations]
        frames = max(self._frames, plan.grid.frames + 1) if to_end else self._frames
        pairs = list(zip(models, self.record(models, simulation, frames), strict=True))
        values = tuple(model.predict(recorded[: self._frames]) for model, recorded in pairs)
        motion = np.fmax.reduce([model.motion(recorded) for model, recorded in pairs])
        return Prediction(values, plan.grid.steps_per_frame, motion)

    def start(self, plan: Plan, steps: int | None, halvings: int) -> tuple[Simulation, Plan]:
        """Restart the simulation; return it, and its plan with the cells and steps, as for `predict`."""
        for _ in range(halvings):
            if (coarser := coarser_plan(plan)) is None:
                raise SceneError(["sheet.points: too few to take half of them"])
            plan = coarser
        if plan.scene.time.step == "auto" and not plan.scene.time.at_rest:
            if steps is None:
                # Stable for finite differences around these parameters.
                frame = 1 / plan.grid.frames_per_second
                steps = math.ceil(2 * frame / plan.stable_step * (1 + self.problem.difference_step))
            plan = plan.with_grid(steps_per_frame=max(steps, plan.grid.steps_per_frame))
        if self._simulation is None:
            self._simulation = Simulation(plan, threads=self._threads)
        else:
            self._simulation.restart(plan)
        return self._simulation, plan

    def compile(self, x: Array) -> None:
        """Compile the kernels; raise a SceneError if the scene at x is invalid."""
        self._simulation = Simulation(self.plan(x), threads=self._threads)
        self._simulation.compile(self._pause)

    def try_predict(self, x: Array, steps: int | None = None, **options: Any) -> Prediction | None:
        """Return the prediction at x, or None if the run fails or an observed point is behind the camera."""
        try:
            predicted = self.predict(x, steps, **options)
        except (SceneError, DivergedError):
            return None
        pairs = zip(predicted.values, self.problem.observations, strict=True)
        return predicted if all(np.isfinite(values[observed.known]).all() for values, observed in pairs) else None

    def values(self, x: Array) -> dict[str, float]:
        """Return the parameter values by key at x; raise a SceneError if they are out of range."""
        pairs = zip(self.problem.parameters, x.tolist(), strict=True)
        values = {parameter.key: parameter.value(coordinate) for parameter, coordinate in pairs}
        if not np.isfinite(list(values.values())).all():
            raise SceneError(["the values are out of range"])
        return values

    def plan(self, x: Array) -> Plan:
        """Plan the scene with the parameters at x; raise a SceneError if it is not valid."""
        return check_scene(Scene(**self.problem.fitted_data(self.data, self.values(x))), self.maps)

    def record(self, models: Sequence[ObservationModel], simulation: Simulation, frames: int) -> list[Array]:
        """Return the records of a run from its first frame: for each model those of all frames, stacked."""
        records: list[list[Array]] = [[] for _ in models]
        for frame in range(frames):
            simulation.advance(min(frame, 1), self._pause)
            for model, of_model in zip(models, records, strict=True):
                of_model.append(model.record(simulation))
        return [np.array(of_model) for of_model in records]

    def close(self) -> None:
        """Release the simulation."""
        if self._simulation is not None:
            self._simulation.close()


# Forward model of a worker process, which serves a single fit, after the first prediction.
_models: list[ForwardModel] = []


def predict_in_worker(problem: FitProblem, x: Array, steps: int | None) -> Prediction | None:
    """Return the result of `ForwardModel.try_predict` on one thread, in a worker process."""
    if not _models:
        _models.append(problem.build_model(threads=1))
    return _models[0].try_predict(x, steps)


def mesh_error(plan: Plan, pause: Pause) -> float | None:
    """Return the estimated mesh error, as a fraction of the largest displacement.

    Return None for springs, with too few mass points, or if a coarser run fails.
    """
    if coarser_plan(plan) is None:
        return None
    try:
        error = estimate_mesh_error(plan, runtime.current_device(), lambda done, total: pause()).error
    except (DivergedError, SceneError):
        return None
    return error if math.isfinite(error) else None


class Runs:
    """Execution of the runs of a fit, in this process or in a pool; a context manager, which ends the pool.

    One worker is no pool; by default their number is chosen by the duration of the first run. An exception from
    `progress` ends the fit.
    """

    def __init__(self, problem: FitProblem, workers: int | None, progress: StageProgressCallback) -> None:
        self.problem = problem
        self.count = self.expected = 0  # number of finished runs, and the expected number
        self._workers, self._progress = workers, progress
        self._model = problem.build_model(None, self._report_progress)
        self._pool: Pool | None = None
        self._seconds = 0.0

    def predict_initial(self, x: Array) -> Prediction:
        """Compile, and return the prediction at x to the last frame; raise the errors of `ForwardModel.predict`."""
        self._model.compile(x)
        start = time.perf_counter()
        predicted = self._model.predict(x, to_end=True)
        self._seconds, self.count = time.perf_counter() - start, self.count + 1
        return predicted

    def predict_coarse(self, x: Array, halvings: int) -> Prediction | None:
        """Return the prediction of a coarser mesh, or None if it fails."""
        self.count += 1
        return self._model.try_predict(x, halvings=halvings)

    def mesh_error(self, x: Array) -> float | None:
        """Return the estimated mesh error at x, as the function `mesh_error` does."""
        return mesh_error(self._model.plan(x), self._report_progress)

    def predict_one(self, x: Array, steps: int | None = None) -> Prediction | None:
        """Return the prediction at x, or None if it fails."""
        self._report_progress()
        self.count += 1
        return self._model.try_predict(x, steps)

    def predict_many(self, coordinates: Sequence[Array], steps: int | None = None) -> list[Prediction | None]:
        """Return predictions in parallel if that pays off, each None if it fails. A dead process is an error."""
        if self._pool is None and (workers := self._choose_workers()) > 1:
            self._pool = Pool(workers)
        if self._pool is None or len(coordinates) < 2:
            return [self.predict_one(x, steps) for x in coordinates]
        futures: list[Future[Any]] = [self._pool.submit(predict_in_worker, self.problem, x, steps) for x in coordinates]
        waiting = set(futures)
        while waiting:
            self._report_progress()
            done, waiting = wait(waiting, 0.1)
            self.count += len(done)
        try:
            return [future.result() for future in futures]
        except DiedError as error:
            raise ExecutorError(f"a run of the fit ended early: {error}") from None

    def _choose_workers(self) -> int:
        if self._workers is not None:
            return self._workers
        parameters = len(self.problem.parameters)
        # A pool starts within seconds; it pays off if eight runs per parameter take more than eight seconds.
        if 8 * parameters * self._seconds < 8.0:
            return 1
        process_bytes = PROCESS_BYTES + cost.estimate_budget(check_scene(self.problem.scene)).memory_bytes
        return max(1, min(available_threads(), available_memory() // process_bytes, 2 * parameters))

    def _report_progress(self) -> None:
        self._progress("fit", self.count, max(self.expected, self.count + 1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=kind is not None)
        self._model.close()
