"""What a scene with certain numbers lets one see: where the observed points are at the observed times, and the forces.

All runs are in f64 on one compiled kernel.

The runs of a fit: one after another in this process, or side by side in processes of their own.
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

from taichi_msm.accuracy.mesh import coarser, estimate_points
from taichi_msm.errors import DivergedError, ExecutorError, Pause, Progress, SceneError
from taichi_msm.fitting.observations import Observations, Sight, between, in_frames
from taichi_msm.fitting.parameters import Parameter, as_data, with_values
from taichi_msm.load import cost
from taichi_msm.load.check import checked
from taichi_msm.model.plan import Plan
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.sweeps.pool import DiedError, Pool
from taichi_msm.sweeps.tables import PROCESS_BYTES
from taichi_msm.system import runtime
from taichi_msm.system.process import available_memory, available_threads

Array = NDArray[np.float64]

# By how much a parameter is changed for a difference.
SMOOTH, ROUGH = 1e-5, 1e-2


class Predicted(NamedTuple):
    """What would be seen."""

    values: Array  # as in the observations, shape (N, T, 3 or 2); NaN: not seen by the camera
    forces: Array  # shape (rows, 3)
    steps: int  # of a frame
    motion: Array  # the farthest that any of the points is from rest, at every frame that was simulated [m]


@dataclass(frozen=True, eq=False)
class Job:
    """What is predicted; each process that is given it keeps its own kernel."""

    token: str  # tells jobs apart
    scene: Scene  # of which only the parameters change
    parameters: tuple[Parameter, ...]
    observations: Observations


def runnable(scene: Scene) -> Scene:
    """Give the scene that is run for a fit: in f64, and without anything that is drawn or written."""
    time = scene.time.model_copy(update={"precision": "f64"})
    return scene.model_copy(update={"image": None, "region": None, "output": (), "time": time})


class Predictor:
    """A simulation that is restarted for every prediction.

    Attributes:
        job: what it predicts.
    """

    def __init__(self, job: Job, threads: int | None) -> None:
        self.job, self._data = job, as_data(job.scene)
        plan = checked(job.scene)
        self._maps, self._threads = plan.maps, threads
        self._simulation: Simulation | None = None
        seen = job.observations
        times = seen.time if seen.forces is None else np.concatenate([seen.time, seen.forces.time])
        self._frames = max(2, math.ceil(in_frames(job.scene, times).max()) + 1)

    def predict(
        self,
        x: Array,
        steps: int | None = None,
        *,
        coarse: int = 0,
        whole: bool = False,
        pause: Pause = lambda: None,
    ) -> Predicted:
        """Run the scene with the parameters at x.

        Args:
            x: of every parameter.
            steps: of a frame, as of a run that this one is compared with, if it needs no more; None: so many that
                runs with neighbouring values can have them too.
            coarse: how many times to halve the cells a side; a SceneError where `mesh.coarser` gives None.
            whole: go on to the last frame, even if nothing was seen there.
            pause: called some times a second; what it raises stops it.

        Raises:
            SceneError: when the values make no valid scene.
            DivergedError: when the run diverges.
        """
        plan = self.plan(x)
        for _ in range(coarse):
            if (half := coarser(plan)) is None:
                raise SceneError(["sheet.points: too few to take half of them"])
            plan = half
        if plan.scene.time.step == "auto" and not plan.scene.time.at_rest:
            plan = plan.with_grid(steps_per_frame=max(steps or _with_margin(plan), plan.grid.steps_per_frame))
        if self._simulation is None:
            self._simulation = Simulation(plan, threads=self._threads)
        else:
            self._simulation.restart(plan)
        return self._run(self._simulation, plan, whole, pause)

    def compile(self, x: Array, pause: Pause = lambda: None) -> None:
        """Compile now what the first run would compile; raises a SceneError as `predict` does."""
        self._simulation = Simulation(self.plan(x), threads=self._threads)
        self._simulation.compile(pause)

    def attempt(self, x: Array, steps: int | None = None, **how: Any) -> Predicted | None:
        """Predict; None where the values give no run, or a point that was seen would be behind the eye."""
        try:
            predicted = self.predict(x, steps, **how)
        except (SceneError, DivergedError):
            return None
        return predicted if np.isfinite(predicted.values[self.job.observations.known]).all() else None

    def plan(self, x: Array) -> Plan:
        """Plan the scene with the parameters at x; SceneError: it is not valid."""
        values = [one.value(each) for one, each in zip(self.job.parameters, x.tolist(), strict=True)]
        if not np.isfinite(values).all():
            raise SceneError(["the values are out of range"])
        data = with_values(self._data, self.job.parameters, values)
        return checked(Scene(**data), self._maps)

    def _run(self, simulation: Simulation, plan: Plan, whole: bool, pause: Pause) -> Predicted:
        seen, scene = self.job.observations, plan.scene
        # A coarse run has other points than the others.
        sight, points, forces = Sight(scene, seen, self._frames), [], []
        for frame in range(max(self._frames, plan.grid.frames + 1) if whole else self._frames):
            simulation.advance(min(frame, 1), pause)
            points.append(sight.on_sheet(simulation.positions()))
            if seen.forces is not None:
                forces.append([one.force for one in simulation.forces()])
        values, felt = sight.seen(sight.at_times(np.array(points[: self._frames]))), np.empty((0, 3))
        if seen.forces is not None:
            rows, shares = len(seen.forces.time), between(scene, seen.forces.time, self._frames)
            every = shares @ np.array(forces[: self._frames]).reshape(self._frames, -1)
            felt = every.reshape(rows, -1, 3)[np.arange(rows), seen.forces.probe]
        return Predicted(values, felt, plan.grid.steps_per_frame, sight.motion(np.array(points)))

    def close(self) -> None:
        """Free the memory."""
        if self._simulation is not None:
            self._simulation.close()


def difference(scene: Scene) -> float:
    """Give by how much a parameter is changed for a difference, in units of x.

    At rest the shape is known to about 1e-6, and with contact it changes in small jumps.
    """
    return ROUGH if scene.time.at_rest or any(probe.moved for probe in scene.probes) else SMOOTH


def _with_margin(plan: Plan) -> int:
    """Count the steps of a frame for this scene and for those with slightly other values."""
    frame = 1 / plan.grid.frames_per_second
    return math.ceil(2 * frame / plan.stable_step * (1 + difference(plan.scene)))


# The predictor of the job that this process was given last.
_kept: dict[str, Predictor] = {}


def predict(job: Job, x: Array, steps: int | None) -> Predicted | None:
    """Predict in a process of its own, on one thread; None where the values give no run."""
    if job.token not in _kept:
        for other in _kept.values():
            other.close()
        _kept.clear()
        _kept[job.token] = Predictor(job, threads=1)
    return _kept[job.token].attempt(x, steps)


# Processes are started where so many runs for each parameter take longer than this [s]; to start them takes a few.
RUNS_EACH, WORTHWHILE = 8, 8.0

# How long until the progress is told again while processes work [s].
PATIENCE = 0.1


def points_error(plan: Plan, pause: Pause) -> float | None:
    """Estimate the error that the number of points makes, as a fraction of the largest displacement.

    None: no tissue, too few points to tell, or no run with fewer points.
    """
    if coarser(plan) is None:
        return None
    try:
        error = estimate_points(plan, runtime.started(), lambda done, total: pause()).error
    except (DivergedError, SceneError):
        return None
    return error if math.isfinite(error) else None


class Runs:
    """Predicts, and counts the runs. Usable in a with statement, which ends the processes.

    Args:
        job: what is predicted.
        workers: how many processes take runs side by side; 1: none; None: chosen by how long the first run takes.
        progress: called often, with the stage, the runs done and those that are expected; what it raises stops.
    """

    def __init__(self, job: Job, workers: int | None, progress: Progress) -> None:
        self.job, self.count, self.expected = job, 0, 0
        self._workers, self._progress = workers, progress
        self._predictor = Predictor(job, threads=None)
        self._pool: Pool | None = None
        self._seconds = 0.0

    def first(self, x: Array) -> Predicted:
        """Run the scene to its end; raises as `Predictor.predict` does."""
        self._predictor.compile(x, self._tell)
        begun = time.perf_counter()
        predicted = self._predictor.predict(x, whole=True, pause=self._tell)
        self._seconds, self.count = time.perf_counter() - begun, self.count + 1
        return predicted

    def coarse(self, x: Array, halvings: int) -> Predicted | None:
        """Predict with half the cells a side, or half of those; None where that gives no run."""
        self.count += 1
        return self._predictor.attempt(x, coarse=halvings, pause=self._tell)

    def mesh_error(self, x: Array) -> float | None:
        """Estimate the error that the number of points makes, as `points_error`."""
        return points_error(self._predictor.plan(x), self._tell)

    def one(self, x: Array, steps: int | None = None) -> Predicted | None:
        """Predict; None where the parameters give no run."""
        self._tell()
        predicted = self._predictor.attempt(x, steps, pause=self._tell)
        self.count += 1
        return predicted

    def several(self, places: Sequence[Array], steps: int | None = None) -> list[Predicted | None]:
        """Predict at several x, side by side where that pays."""
        if self._pool is None and (workers := self._choose()) > 1:
            self._pool = Pool(workers)
        if self._pool is None or len(places) < 2:
            return [self.one(x, steps) for x in places]
        return self._side_by_side(self._pool, places, steps)

    def _choose(self) -> int:
        if self._workers is not None:
            return self._workers
        parameters = len(self.job.parameters)
        if RUNS_EACH * parameters * self._seconds < WORTHWHILE:
            return 1
        needed = PROCESS_BYTES + cost.estimate_memory(checked(self.job.scene)).memory_bytes
        return max(1, min(available_threads(), available_memory() // needed, 2 * parameters))

    def _side_by_side(self, pool: Pool, places: Sequence[Array], steps: int | None) -> list[Predicted | None]:
        futures: list[Future[Any]] = [pool.submit(predict, self.job, x, steps) for x in places]
        waiting = set(futures)
        while waiting:
            self._tell()
            done, waiting = wait(waiting, PATIENCE)
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
