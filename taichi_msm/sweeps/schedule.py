"""Hand the runs of a sweep to an executor, and take their outcomes as they come."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from itertools import islice
from queue import Empty, SimpleQueue

from taichi_msm.errors import MsmError
from taichi_msm.progress import Pause
from taichi_msm.sweeps.outcome import Outcome
from taichi_msm.sweeps.task import Task, take

# The most runs that an executor is given at a time.
WINDOW = 4096

# While all workers are busy, this is how long until `pause` is called again [s].
PATIENCE = 0.1


def outcomes(tasks: Iterable[Task], executor: Executor, pause: Pause) -> Iterator[Outcome]:
    """Take runs; one whose worker ended before it was done is taken once more.

    `pause` is called some times a second; what it raises ends the sweep.

    Raises:
        MsmError: when the executor takes no more runs.
    """
    done: SimpleQueue[Future[Outcome]] = SimpleQueue()
    waiting: dict[Future[Outcome], Task] = {}
    died: set[int] = set()

    def submit(task: Task) -> None:
        try:
            future = executor.submit(take, task)
        except RuntimeError as error:  # such as that of a broken executor
            raise _ended(executor, error) from error
        waiting[future] = task
        future.add_done_callback(done.put)

    rest = iter(tasks)
    for task in islice(rest, WINDOW):
        submit(task)
    while waiting:
        pause()
        try:
            future = done.get(timeout=PATIENCE)
        except Empty:
            continue
        task = waiting.pop(future)
        try:
            outcome = future.result()
        except (BrokenExecutor, CancelledError) as error:
            raise _ended(executor, error) from error
        except Exception as error:
            # `take` raises nothing, so this is its worker's end.
            if task.run not in died:
                died.add(task.run)
                submit(task)
                continue
            outcome = Outcome(task.run, "died", f"{error}, twice")
        yield outcome
        for following in islice(rest, 1):
            submit(following)


def _ended(executor: Executor, error: Exception) -> MsmError:
    """Make the error for an executor that takes no more runs."""
    return MsmError(f"{type(executor).__name__} takes no more runs: {error}; start the sweep again")
