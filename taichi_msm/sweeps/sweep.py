"""Python interface of sweeps, and the functions that it shares with the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from taichi_msm.errors import (
    MAX_WORKERS,
    ArgumentError,
    NotInstalledError,
    StageProgressCallback,
    require_path,
    require_type,
    writing,
)
from taichi_msm.sweeps.pool import Pool
from taichi_msm.sweeps.runs import (
    FINAL_STATUSES,
    Outcome,
    SweepState,
    begin_sweep,
    lock_reports,
    read_outcome,
    run_missing,
)
from taichi_msm.sweeps.spec import make_sweep
from taichi_msm.sweeps.tables import choose_worker_count, estimate_cost, write_reports


def sweep(
    scene: str | Path,
    vary: Mapping[str, Mapping[str, Any]],
    directory: str | Path,
    *,
    variables: Mapping[str, Mapping[str, Any]] | None = None,
    samples: int | None = None,
    seed: int = 1,
    overrides: Mapping[str, Any] | None = None,
    executor: Executor | str | None = None,
    workers: int | None = None,
    progress: StageProgressCallback = lambda stage, done, total: None,
) -> Iterator[Outcome]:
    """Run a scene many times with varied values.

    The iterator executes the runs and yields their outcomes in order of completion; after the last run it writes the
    table and the other reports. A repeated call executes only the missing runs.

    Args:
        scene: path of the scene file.
        vary: distributions by dotted key, as in a sweep file; paths are relative to the folder of the scene file, and
            within it.
        directory: directory for runs/, table.csv and the other reports.
        variables: distributions of the numbers in expressions of `overrides`, by name, as in a sweep file.
        samples: number of runs; None for all combinations of the grids.
        seed: seed of the samples.
        overrides: values of keys in all runs, by dotted key; texts that begin with = are expressions of the variables.
        executor: None for processes on this machine; the address of a dask.distributed scheduler; or an executor
            whose workers are processes with one thread and find scene and directory at the same paths.
        workers: number of processes on this machine, by default one per core, limited by the free memory.
        progress: called often with the stage, and the finished and total number of runs; an exception from it stops
            the sweep.

    Returns:
        An iterator over the outcomes of all runs.

    Raises:
        ArgumentError: when the directory is not a path.
        SceneError: when arguments are invalid, with a line for each error, or the directory contains another sweep.
        FilesError: when the directory cannot be written.
        NotInstalledError: while iterating, when dask.distributed is needed and not installed.
        MsmError: while iterating, when no scheduler answers, or the executor accepts no more runs.

    Example:
        >>> from taichi_msm import sweep
        >>> young = {"tissue.young": {"log_uniform": [5e3, 8e4]}}
        >>> rows = list(sweep("scenes/press.yaml", young, "output/young", samples=8, overrides={"output": []}))
        >>> len(rows), {row.status for row in rows}
        (8, {'complete'})
    """
    require_path(directory)
    require_type(scene, (str, Path), "scene", "the path of a scene file")
    if workers is not None and not (type(workers) is int and 1 <= workers <= MAX_WORKERS):
        raise ArgumentError(f"workers: {workers!r}; take a whole number, 1 to {MAX_WORKERS}, or None")
    if executor is not None and not isinstance(executor, str) and not hasattr(executor, "submit"):
        raise ArgumentError(f"executor: {executor!r}; take None, an address or an executor with submit")
    require_type(progress, Callable, "progress", "a function")
    settings = {"variables": variables or {}, "vary": vary, "seed": seed, "set": overrides or {}}
    settings |= {} if samples is None else {"samples": samples}
    spec = make_sweep(scene, settings)
    # Absolute, as the caller may change the current directory before iterating.
    state = begin_sweep(spec, Path(directory).absolute())
    worker_count = choose_worker_count(estimate_cost(spec), len(state.missing), workers).number

    def execute() -> Iterator[Outcome]:
        with open_executor(executor, worker_count, state, progress) as opened:
            yield from list(state.outcomes)
            yield from run_missing(state, opened, progress)
            finish_sweep(state, opened, progress)

    return execute()


def open_executor(
    executor: Executor | str | None, workers: int, state: SweepState, progress: StageProgressCallback
) -> AbstractContextManager[Executor]:
    """Return the context of a sweep's executor: an executor, the address of a dask scheduler, or None for a new `Pool`.

    Only the processes of a pool end with the context. Raise a NotInstalledError without dask.distributed; the context
    raises the errors of `cluster.cluster_connection`.
    """
    if executor is None:
        return Pool(workers)
    if not isinstance(executor, str):
        return nullcontext(executor)
    try:
        from taichi_msm.sweeps.cluster import cluster_connection
    except ImportError:
        message = "a cluster needs dask.distributed, which is not installed; pip install distributed"
        raise NotInstalledError(message) from None
    return cluster_connection(executor, state.sweep, state.directory, progress)


def finish_sweep(state: SweepState, executor: Executor, progress: StageProgressCallback) -> tuple[list[str], list[str]]:
    """Write the reports of a sweep whose runs have ended; return the names of the written files, and warnings.

    The state receives the outcomes of runs that another command has finished.
    """
    directory, total = state.directory, len(state.values)
    with writing(directory), lock_reports(directory, lambda: progress("runs", total, total)):
        # Another command may have finished a run that it had locked.
        tasks = {task.run: task for task in state.missing}
        state.outcomes[:] = [
            (None if outcome.status in FINAL_STATUSES else read_outcome(tasks[outcome.run], state.sweep)) or outcome
            for outcome in sorted(state.outcomes, key=lambda outcome: outcome.run)
        ]
        return write_reports(state, executor, progress)
