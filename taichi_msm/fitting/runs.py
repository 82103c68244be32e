"""The runs of a fit: one after another in this process, or side by side in processes of their own."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import Future, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DivergedError, ExecutorError, SceneError
from taichi_msm.fitting.prediction import Job, Predicted, Predictor, predict
from taichi_msm.physics.mesh_error import coarser, estimate_points
from taichi_msm.physics.plan import Plan
from taichi_msm.progress import Pause, Progress
from taichi_msm.scenefile import budget
from taichi_msm.scenefile.validation import checked
from taichi_msm.sweeps.cost import PROCESS_BYTES
from taichi_msm.sweeps.pool import DiedError, Pool
from taichi_msm.system import runtime
from taichi_msm.system.resources import available_memory, available_threads

Array = NDArray[np.float64]

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
        needed = PROCESS_BYTES + budget.estimate(checked(self.job.scene)).memory_bytes
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
