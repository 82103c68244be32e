"""Forward model of a fit: predicted observations and forces, in this process or in a pool of processes.

All runs are in f64 with one compiled kernel.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.mesh import coarser_plan, estimate_mesh_error
from taichi_msm.errors import DivergedError, ExecutorError, Pause, SceneError, StageProgressCallback
from taichi_msm.fitting.observations import ObservationModel, Observations, time_in_frames, time_weights
from taichi_msm.fitting.parameters import Parameter, as_data, with_values
from taichi_msm.load import cost
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.sweeps.pool import DiedError, Pool
from taichi_msm.sweeps.tables import PROCESS_BYTES
from taichi_msm.system import runtime
from taichi_msm.system.process import available_memory, available_threads

Array = NDArray[np.float64]

# Steps of finite differences, in units of x.
SMALL_STEP, LARGE_STEP = 1e-5, 1e-2


class Prediction(NamedTuple):
    """Predicted observations and forces."""

    values: Array  # as in the observations, shape (N, T, 3 or 2); NaN behind the camera
    forces: Array  # shape (rows, 3)
    steps: int  # of a frame
    motion: Array  # the farthest that any of the points is from rest, at every frame that was simulated [m]


@dataclass(frozen=True, eq=False)
class FitProblem:
    """Scene, parameters and observations of a fit; each worker process keeps a kernel for it."""

    token: str  # identifies the fit
    scene: Scene  # of which only the parameters change
    parameters: tuple[Parameter, ...]
    observations: Observations


def without_outputs(scene: Scene) -> Scene:
    """Return the scene in f64, without image and outputs."""
    time = scene.time.model_copy(update={"precision": "f64"})
    return scene.model_copy(update={"image": None, "region": None, "output": (), "time": time})


class ForwardModel:
    """Simulation that is restarted for every prediction.

    Attributes:
        job: what it predicts.
    """

    def __init__(self, job: FitProblem, threads: int | None) -> None:
        self.job, self._data = job, as_data(job.scene)
        plan = check_scene(job.scene)
        self._maps, self._threads = plan.maps, threads
        self._simulation: Simulation | None = None
        observations = job.observations
        times = (
            observations.time
            if observations.forces is None
            else np.concatenate([observations.time, observations.forces.time])
        )
        self._frames = max(2, math.ceil(time_in_frames(job.scene, times).max()) + 1)

    def predict(
        self,
        x: Array,
        steps: int | None = None,
        *,
        coarse: int = 0,
        whole: bool = False,
        pause: Pause = lambda: None,
    ) -> Prediction:
        """Run the scene with the parameters at x.

        Args:
            x: of every parameter.
            steps: steps per frame, at least; None: enough for runs with neighbouring values.
            coarse: number of halvings of the cells per side.
            whole: whether to run to the last frame, also beyond the last observation.
            pause: called several times a second; its exceptions end the run.

        Raises:
            SceneError: when the scene with these values is not valid, or too coarse.
            DivergedError: when the run diverges.
        """
        plan = self.plan(x)
        for _ in range(coarse):
            if (half := coarser_plan(plan)) is None:
                raise SceneError(["sheet.points: too few to take half of them"])
            plan = half
        if plan.scene.time.step == "auto" and not plan.scene.time.at_rest:
            plan = plan.with_grid(steps_per_frame=max(steps or _steps_with_margin(plan), plan.grid.steps_per_frame))
        if self._simulation is None:
            self._simulation = Simulation(plan, threads=self._threads)
        else:
            self._simulation.restart(plan)
        return self._run(self._simulation, plan, whole, pause)

    def compile(self, x: Array, pause: Pause = lambda: None) -> None:
        """Compile the kernels for a run with the parameters at x; raises a SceneError as `predict` does."""
        self._simulation = Simulation(self.plan(x), threads=self._threads)
        self._simulation.compile(pause)

    def try_predict(self, x: Array, steps: int | None = None, **how: Any) -> Prediction | None:
        """Predict; None if the scene is not valid, diverges, or has an observed point behind the camera."""
        try:
            predicted = self.predict(x, steps, **how)
        except (SceneError, DivergedError):
            return None
        return predicted if np.isfinite(predicted.values[self.job.observations.known]).all() else None

    def plan(self, x: Array) -> Plan:
        """Return the plan of the scene with the parameters at x; SceneError: it is not valid."""
        values = [one.value(each) for one, each in zip(self.job.parameters, x.tolist(), strict=True)]
        if not np.isfinite(values).all():
            raise SceneError(["the values are out of range"])
        data = with_values(self._data, self.job.parameters, values)
        return check_scene(Scene(**data), self._maps)

    def _run(self, simulation: Simulation, plan: Plan, whole: bool, pause: Pause) -> Prediction:
        observations, scene = self.job.observations, plan.scene
        # A coarse run has another mesh.
        sight, points, forces = ObservationModel(scene, observations, self._frames), [], []
        for frame in range(max(self._frames, plan.grid.frames + 1) if whole else self._frames):
            simulation.advance(min(frame, 1), pause)
            points.append(sight.points_on_sheet(simulation.positions()))
            if observations.forces is not None:
                forces.append([one.force for one in simulation.forces()])
        values, felt = sight.observe(sight.interpolate(np.array(points[: self._frames]))), np.empty((0, 3))
        if observations.forces is not None:
            rows, shares = len(observations.forces.time), time_weights(scene, observations.forces.time, self._frames)
            every = shares @ np.array(forces[: self._frames]).reshape(self._frames, -1)
            felt = every.reshape(rows, -1, 3)[np.arange(rows), observations.forces.probe]
        return Prediction(values, felt, plan.grid.steps_per_frame, sight.motion(np.array(points)))

    def close(self) -> None:
        """Release the simulation."""
        if self._simulation is not None:
            self._simulation.close()


def difference_step(scene: Scene) -> float:
    """Return the step of finite differences, in units of x.

    Equilibria are solved to about 1e-6, and contact changes in small jumps: both need the larger step.
    """
    return LARGE_STEP if scene.time.at_rest or any(probe.moved for probe in scene.probes) else SMALL_STEP


def _steps_with_margin(plan: Plan) -> int:
    """Return the steps per frame for a plan and its neighbours in parameter space."""
    frame = 1 / plan.grid.frames_per_second
    return math.ceil(2 * frame / plan.stable_step * (1 + difference_step(plan.scene)))


# The forward model of the last fit in this process.
_kept: dict[str, ForwardModel] = {}


def predict(job: FitProblem, x: Array, steps: int | None) -> Prediction | None:
    """Predict in a worker process, on one thread; None as `ForwardModel.try_predict`."""
    if job.token not in _kept:
        for other in _kept.values():
            other.close()
        _kept.clear()
        _kept[job.token] = ForwardModel(job, threads=1)
    return _kept[job.token].try_predict(x, steps)


# A pool is started if this number of runs for each parameter takes longer than MIN_PARALLEL_S; its start takes seconds.
RUNS_PER_PARAMETER, MIN_PARALLEL_S = 8, 8.0
PROGRESS_INTERVAL_S = 0.1


def mesh_error(plan: Plan, pause: Pause) -> float | None:
    """Estimate the mesh error, as a fraction of the largest displacement.

    Args:
        plan: of the scene.
        pause: called several times a second; its exceptions end the runs.

    Returns:
        The error; None without tissue, with too few mass points, or if a coarser run fails.
    """
    if coarser_plan(plan) is None:
        return None
    try:
        error = estimate_mesh_error(plan, runtime.current_device(), lambda done, total: pause()).error
    except (DivergedError, SceneError):
        return None
    return error if math.isfinite(error) else None


class Runs:
    """Predictions of a fit, counted, in this process or in a pool. A context manager, which ends the pool.

    Args:
        job: the fit.
        workers: number of worker processes; 1: none; None: by the duration of the first run.
        progress: called often, with the stage, the runs done and expected; its exceptions end the fit.
    """

    def __init__(self, job: FitProblem, workers: int | None, progress: StageProgressCallback) -> None:
        self.job, self.count, self.expected = job, 0, 0
        self._workers, self._progress = workers, progress
        self._predictor = ForwardModel(job, threads=None)
        self._pool: Pool | None = None
        self._seconds = 0.0

    def first(self, x: Array) -> Prediction:
        """Predict to the last frame; raises as `ForwardModel.predict` does."""
        self._predictor.compile(x, self._tell)
        begun = time.perf_counter()
        predicted = self._predictor.predict(x, whole=True, pause=self._tell)
        self._seconds, self.count = time.perf_counter() - begun, self.count + 1
        return predicted

    def predict_coarse(self, x: Array, halvings: int) -> Prediction | None:
        """Predict with the cells per side halved `halvings` times; None if that fails."""
        self.count += 1
        return self._predictor.try_predict(x, coarse=halvings, pause=self._tell)

    def mesh_error(self, x: Array) -> float | None:
        """Estimate the mesh error at x, as the function of this name."""
        return mesh_error(self._predictor.plan(x), self._tell)

    def one(self, x: Array, steps: int | None = None) -> Prediction | None:
        """Predict at x; None if that fails."""
        self._tell()
        predicted = self._predictor.try_predict(x, steps, pause=self._tell)
        self.count += 1
        return predicted

    def predict_many(self, places: Sequence[Array], steps: int | None = None) -> list[Prediction | None]:
        """Predict at several x, in parallel if that is faster."""
        if self._pool is None and (workers := self._choose()) > 1:
            self._pool = Pool(workers)
        if self._pool is None or len(places) < 2:
            return [self.one(x, steps) for x in places]
        return self._side_by_side(self._pool, places, steps)

    def _choose(self) -> int:
        if self._workers is not None:
            return self._workers
        parameters = len(self.job.parameters)
        if RUNS_PER_PARAMETER * parameters * self._seconds < MIN_PARALLEL_S:
            return 1
        needed = PROCESS_BYTES + cost.estimate_budget(check_scene(self.job.scene)).memory_bytes
        return max(1, min(available_threads(), available_memory() // needed, 2 * parameters))

    def _side_by_side(self, pool: Pool, places: Sequence[Array], steps: int | None) -> list[Prediction | None]:
        futures: list[Future[Any]] = [pool.submit(predict, self.job, x, steps) for x in places]
        waiting = set(futures)
        while waiting:
            self._tell()
            done, waiting = wait(waiting, PROGRESS_INTERVAL_S)
            self.count += len(done)
        try:
            return [future.result() for future in futures]
        except DiedError as error:
            raise ExecutorError(f"a run of the fit ended early: {error}; take fewer --workers") from None

    def _tell(self) -> None:
        self._progress("fit", self.count, max(self.expected, self.count + 1))

    def __enter__(self) -> Runs:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=kind is not None)
        self._predictor.close()
