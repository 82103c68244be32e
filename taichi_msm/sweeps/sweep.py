"""Run a scene many times with varied values, on all cores or on any executor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from taichi_msm.errors import (
    MAX_WORKERS,
    ArgumentError,
    NotInstalledError,
    StageProgressCallback,
    require_path,
    writing,
)
from taichi_msm.sweeps.pool import Pool
from taichi_msm.sweeps.runs import ENDED, Outcome, SweepResult, UnderWay, alone, begin_sweep, ended, outcomes
from taichi_msm.sweeps.spec import make_sweep
from taichi_msm.sweeps.tables import choose_workers, estimate, write_reports


def sweep(
    scene: str | Path,
    vary: Mapping[str, Mapping[str, Any]],
    directory: str | Path,
    *,
    samples: int | None = None,
    seed: int = 1,
    overrides: Mapping[str, Any] | None = None,
    executor: Executor | str | None = None,
    workers: int | None = None,
    progress: StageProgressCallback = lambda stage, done, total: None,
) -> Iterator[Outcome]:
    """Run a scene many times with varied values.

    Runs are taken while the outcomes are iterated over, which come in the order in which runs end; after the last one
    the table and the other files of the sweep are written. The same call goes on with the runs that are missing.

    Args:
        scene: the scene file.
        vary: keys of the scene by their dotted paths, and how each varies, as in a sweep file. Files are relative
            to the scene file, and below its folder.
        directory: where runs/, table.csv and the other files go.
        samples: number of runs; None: every combination of the keys' grids.
        seed: what the samples are chosen by.
        overrides: values of keys in all runs, by their dotted paths.
        executor: takes the runs; each of its workers must be a process, of one thread, that finds scene and directory
            where they are here. The address of a scheduler of dask.distributed: its workers. None: processes here.
        workers: how many of these; None: one for each core, as far as memory goes.
        progress: called often, with the stage, the runs done and the runs in all; what it raises stops the sweep there.

    Returns:
        An iterator over the outcomes of all runs.

    Raises:
        ArgumentError: when the directory cannot be a path.
        SceneError: with everything that is wrong with the arguments; when the directory holds another sweep.
        FilesError: when the directory cannot be written.
        NotInstalledError: while iterating, when dask.distributed is needed and not installed.
        MsmError: while iterating, when there is no such scheduler, or the executor takes no more runs.

    Example:
        >>> from taichi_msm import sweep
        >>> young = {"tissue.young": {"log_uniform": [5e3, 8e4]}}
        >>> rows = list(sweep("scenes/press.yaml", young, "output/young", samples=8, overrides={"output": []}))
        >>> len(rows), {row.status for row in rows}
        (8, {'complete'})
    """
    require_path(directory)
    if not isinstance(scene, (str, Path)):
        raise ArgumentError(f"scene: {scene!r}; take the path of a scene file")
    if workers is not None and not (type(workers) is int and 1 <= workers <= MAX_WORKERS):
        raise ArgumentError(f"workers: {workers!r}; take a whole number, 1 to {MAX_WORKERS}, or None")
    settings = {"vary": vary, "seed": seed, "set": overrides or {}} | ({} if samples is None else {"samples": samples})
    described = make_sweep(scene, settings)
    # The caller may change the current directory meanwhile.
    folder = Path(directory).absolute()
    under_way = begin_sweep(described, folder)
    count = choose_workers(estimate(described), len(under_way.missing), workers).number

    def go_through() -> Iterator[Outcome]:
        with opened(executor, count, under_way, progress) as taking:
            yield from list(under_way.done)
            yield from go_on(under_way, taking, progress)
            finish(under_way, taking, progress)

    return go_through()


@contextmanager
def opened(
    executor: Executor | str | None, workers: int, under_way: UnderWay, progress: StageProgressCallback
) -> Iterator[Executor]:
    """Use an executor, a cluster, or else a pool of processes here, which end with the block, at once if it raises."""
    if isinstance(executor, str):
        try:
            from taichi_msm.sweeps.cluster import connected
        except ImportError:
            said = "a cluster needs dask.distributed, which is not installed; pip install distributed"
            raise NotInstalledError(said) from None
        with connected(executor, under_way.sweep, under_way.directory, progress) as cluster:
            yield cluster
        return
    if executor is not None:
        yield executor
        return
    pool = Pool(workers)
    try:
        yield pool
    except BaseException:
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


def go_on(under_way: UnderWay, executor: Executor, progress: StageProgressCallback) -> Iterator[Outcome]:
    """Take the runs that are missing, and give their outcomes as they come; errors as for `outcomes`."""
    done = under_way.done
    for outcome in outcomes(under_way.missing, executor, lambda: progress("runs", len(done), under_way.total)):
        done.append(outcome)
        yield outcome


def finish(under_way: UnderWay, executor: Executor, progress: StageProgressCallback) -> tuple[list[str], list[str]]:
    """Write the table and the other files of a sweep; gives their names, and what the user should know."""
    directory, total, sweep = under_way.directory, under_way.total, under_way.sweep
    with writing(directory), alone(directory, lambda: progress("runs", total, total)):
        # Another command may have taken a run that it kept from us.
        tasks = {task.run: task for task in under_way.missing}
        rows = [
            (None if row.status in ENDED else ended(tasks[row.run], sweep)) or row
            for row in sorted(under_way.done, key=lambda row: row.run)
        ]
        return write_reports(SweepResult(directory, sweep, under_way.values, rows), executor, progress)
