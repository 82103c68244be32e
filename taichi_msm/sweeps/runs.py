"""Runs of a sweep: directory of the sweep, execution of missing runs, outcomes."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, BinaryIO, ClassVar, Literal, NamedTuple, get_args

from pydantic import ConfigDict, TypeAdapter

from taichi_msm import errors
from taichi_msm.errors import FilesError, LostExecutorError, SceneError, StageProgressCallback
from taichi_msm.load import cost
from taichi_msm.load.scene_file import ParsedFile, plan_file
from taichi_msm.runs.directory import (
    FILE,
    FOLDER,
    MAX_RECORD_BYTES,
    entry_kind,
    hidden_folder,
    link_without_replacing,
    lock_file,
    require_kind,
)
from taichi_msm.scene.outputs import RUN_RECORD, RUNS_FOLDER, SWEEP_RECORD, zero_padded
from taichi_msm.sweeps.pool import DiedError
from taichi_msm.sweeps.spec import RESULT_COLUMNS, Sweep
from taichi_msm.system.compiler import result_versions, versions
from taichi_msm.system.files import read_regular

# Reports written at the end of a sweep.
REPORT_FILES = ("table.csv", "table.parquet", "dataset.json", "contact.jpg", "sensitivity.csv", "sweep.png")

# Status of runs that are not repeated.
FINAL_STATUSES = ("complete", "diverged")


def _register(sweep: Sweep, directory: Path) -> list[list[Any]]:
    """Write the record of a sweep, or compare the sweep with an existing one; return the values of the runs."""
    record = require_kind(directory / SWEEP_RECORD, FILE)
    require_kind(directory / RUNS_FOLDER, FOLDER)
    description, values = sweep.description(), sweep.values()
    if not record.exists():
        for name in (RUNS_FOLDER, *REPORT_FILES, RUN_RECORD):
            if (directory / name).exists():
                raise errors.ForeignError.at(directory / name, "something")
        content = {"scene": sweep.settings.scene, **description, "keys": sweep.keys}
        content |= {"versions": versions(), "values": values}
        with errors.writing(directory), hidden_folder(directory) as hidden:
            (hidden / SWEEP_RECORD).write_text(json.dumps(content) + "\n", encoding="utf-8", errors="backslashreplace")
            link_without_replacing(hidden / SWEEP_RECORD, record)  # unless another shard was faster
    # Values are compared as text: 1 differs from 1.0, and NaN equals itself.
    expected_values = json.dumps(values)
    try:
        # The limit bounds the memory for a foreign file.
        stored = json.loads(read_regular(record, max(1 << 28, 2 * len(expected_values))))
        earlier = {name: stored.get(name) for name in description}
        stored_values, missing = json.dumps(stored["values"]), missing_versions(stored["versions"])
    except OSError as error:
        raise FilesError(f"{record}: {(error.strerror or str(error)).lower()}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise FilesError(f"{record}: damaged; choose another --out") from None
    if changed := [name for name, value in json.loads(json.dumps(description)).items() if value != earlier[name]]:
        noun = {"digest": "the scene file", "files": "a file"}.get(changed[0], changed[0])
        if changed[0] == "files" and isinstance(earlier["files"], dict):
            files = (path for path, digest in description["files"].items() if earlier["files"].get(path) != digest)
            noun = next(files, noun)
        message = f"holds the runs of another sweep: {noun} differs"
        raise SceneError([f"{directory}: {message}; choose another --out"])
    if missing:
        message = f"the sweep began with {', '.join(missing)}; use these, or choose another --out"
        raise SceneError([f"{directory}: {message}"])
    if stored_values != expected_values:
        message = "its values differ from those of the sweep file: damaged, or written with another SciPy"
        raise FilesError(f"{record}: {message}; choose another --out")
    return values


def missing_versions(required: Mapping[str, str]) -> list[str]:
    """List the required versions of packages that determine results, and are not installed here."""
    installed = result_versions(versions(), "cpu")
    needed = result_versions(required, "cpu").items()
    return [f"{name} {version}" for name, version in needed if version != installed.get(name)]


@dataclass
class SweepState:
    """A sweep, or a shard of it, in its directory."""

    directory: Path
    sweep: Sweep
    values: list[list[Any]]  # values of the variables and varied keys, for every run of the sweep
    outcomes: list[Outcome]  # of finished runs; grows while the sweep runs
    missing: list[RunTask] = field(default_factory=list)  # runs that were not finished when this command began

    def columns(self) -> dict[str, list[Any]]:
        """Return the result columns of the table by name."""
        columns = {name: [getattr(outcome, name) for outcome in self.outcomes] for name in RESULT_COLUMNS}
        for n in range(max((len(outcome.forces) for outcome in self.outcomes), default=0)):
            name = f"probes.{n}.force"
            # The sweep may vary this key, which has its own column.
            name += ".greatest" if name in self.sweep.keys else ""
            columns[name] = [outcome.forces[n] if n < len(outcome.forces) else None for outcome in self.outcomes]
        return columns | {"seconds": [outcome.seconds for outcome in self.outcomes]}

    def run_directory(self, run: int) -> Path:
        """Return the directory of a run."""
        return self.directory / RUNS_FOLDER / zero_padded(run)


def begin_sweep(sweep: Sweep, directory: Path, shard: tuple[int, int] = (1, 1)) -> SweepState:
    """Begin or resume a shard (I, N), 1 <= I <= N, of a sweep in a directory, with its finished and missing runs.

    Raise a SceneError when the directory contains another sweep, or runs of other versions, whose results may differ; a
    FilesError when it cannot be read or written, has foreign files, or a damaged record.
    """
    state = SweepState(directory, sweep, _register(sweep, directory), [])
    part, parts = shard
    home = Path.cwd()
    for run in range(part - 1, len(state.values), parts):
        folder = require_kind(state.run_directory(run), FOLDER)
        task = RunTask(run, sweep.scene, (), folder, home)
        try:
            task = task._replace(overrides=sweep.overrides(state.values[run]))
        except SceneError as error:
            task = task._replace(fault=str(error))
        if outcome := read_outcome(task, sweep):
            state.outcomes.append(outcome)
        else:
            state.missing.append(task)
    return state


def read_outcome(task: RunTask, sweep: Sweep) -> Outcome | None:
    """Read the outcome of a finished run.

    Return None if the record is missing, damaged, of an interrupted run, or of other overrides or files.
    """
    # A run with a damaged record is repeated.
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        if entry_kind(task.directory / RUN_RECORD) == FILE:
            record = json.loads(read_regular(task.directory / RUN_RECORD, MAX_RECORD_BYTES))
            has_same_overrides = tuple(record["overrides"]) == task.overrides
            has_same_files = sweep.digests.issuperset(record["sha256"].values())
            if record["status"] in FINAL_STATUSES and has_same_overrides and has_same_files:
                return _outcome_from_record(task.run, record)
    return None


def lock_reports(directory: Path, pause: errors.Pause) -> BinaryIO:
    """Return the locked reports of a sweep; closing the file releases the lock.

    `pause` is called while another command holds the lock; an exception from it ends the wait.
    """
    while True:
        try:
            return lock_file(directory / SWEEP_RECORD)
        except BlockingIOError:
            pause()
            time.sleep(POLL_INTERVAL_S)


# Interval between calls of `pause` or `progress` while all workers are busy [s].
POLL_INTERVAL_S = 0.1


def run_missing(state: SweepState, executor: Executor, progress: StageProgressCallback) -> Iterator[Outcome]:
    """Execute the missing runs of a sweep, and yield their outcomes in order of completion.

    A run whose process of the `Pool` died is executed once more. The state receives the outcomes; an exception from
    `progress` ends the sweep. A LostExecutorError is raised when the executor accepts no more runs.
    """
    done: SimpleQueue[Future[Outcome]] = SimpleQueue()
    pending: dict[Future[Outcome], RunTask] = {}
    died: set[int] = set()
    total = len(state.outcomes) + len(state.missing)

    def lost(error: Exception) -> LostExecutorError:
        return LostExecutorError(f"{type(executor).__name__} takes no more runs: {error}; start the sweep again")

    def submit(task: RunTask) -> None:
        try:
            future = executor.submit(execute_run, task)
        except RuntimeError as error:  # such as BrokenExecutor
            raise lost(error) from error
        pending[future] = task
        future.add_done_callback(done.put)

    remaining = iter(state.missing)
    # At most 4096 runs are submitted at a time, which bounds the memory of the executor.
    for task in islice(remaining, 4096):
        submit(task)
    while pending:
        progress("runs", len(state.outcomes), total)
        try:
            future = done.get(timeout=POLL_INTERVAL_S)
        except Empty:
            continue
        task = pending.pop(future)
        try:
            outcome = future.result()
        except errors.ExecutorError as error:
            raise LostExecutorError(str(error)) from error
        except (BrokenExecutor, CancelledError) as error:
            raise lost(error) from error
        except DiedError as error:
            if task.run not in died:
                died.add(task.run)
                submit(task)
                continue
            outcome = Outcome(task.run, "died", f"{error}, twice")
        except Exception as error:
            # As `execute_run` raises nothing, the worker died. Executors other than the pool have retried the run.
            failures = getattr(error, "allowed_failures", None)  # of dask's KilledWorker, whose text has an address
            reason = str(error) if failures is None else f"its workers died, {failures + 1} one after another"
            outcome = Outcome(task.run, "died", " ".join(reason.split()))
        state.outcomes.append(outcome)
        yield outcome
        for task in islice(remaining, 1):
            submit(task)


class RunTask(NamedTuple):
    """Run of a sweep to execute."""

    run: int  # number of the run, from 0
    scene: ParsedFile
    overrides: tuple[str, ...]
    directory: Path  # of the results
    home: Path  # current directory of the run, the base of relative paths
    fault: str = ""  # of an expression without a value, for which the run is refused


def execute_run(task: RunTask, progress: StageProgressCallback = lambda stage, done, total: None) -> Outcome:
    """Run a scene with its overrides on one thread, as `run --set` does; return the outcome, also of a failed run.

    Nothing is raised but exceptions of `progress`, which may be KeyboardInterrupt, as in `runs.run.run`.
    """
    os.chdir(task.home)
    status: Status
    try:
        return _outcome_from_record(task.run, _run_scene(task, progress))
    except SceneError as error:  # also for a picture that cannot be decoded
        status, reason = "refused", "; ".join(error.lines)
    except errors.MsmError as error:
        status, reason = "failed", str(error)
    except Exception as error:
        bug = f"a bug, please report it: {type(error).__name__}: {error}"
        status, reason = "failed", errors.out_of_memory(error) or bug
    # Absolute paths are removed from the reason: of the run, and of a picture, which follows a space.
    reason = " ".join(reason.split()).replace(str(task.directory), task.directory.name)
    return Outcome(task.run, status, reason.replace(f" {task.scene.folder / '_'}"[:-1], " "))


def _run_scene(task: RunTask, progress: StageProgressCallback) -> Mapping[str, Any]:
    if task.fault:
        raise SceneError([task.fault])
    plan = plan_file(task.scene, task.overrides)
    try:
        cost.require_disk(plan, task.directory)
    except SceneError as error:  # A full disk is a failure, not a refusal.
        raise FilesError(str(error)) from None
    from taichi_msm.runs.run import run

    return run(
        plan, task.directory, threads=1, overrides=task.overrides, started=time.perf_counter(), progress=progress
    )


# "refused": invalid values; "failed": another error; "died": its process died twice.
Status = Literal["complete", "diverged", "refused", "failed", "died"]
STATUSES: tuple[Status, ...] = get_args(Status)


@dataclass(frozen=True)
class Outcome:
    """Status and results of a run of a sweep; a missing result is None."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(allow_inf_nan=False)

    run: int  # number of the run, from 0
    status: Status
    error: str = ""  # reason, if not complete
    max_displacement: float | None = None  # [m]
    shortest_spring: float | None = None  # smallest ratio of a spring's length to its rest length
    error_estimate: float | None = None  # discretisation error (time step), as a fraction of the largest displacement
    mesh_error: float | None = None  # discretisation error (mesh), as a fraction of the largest displacement
    forces: tuple[float | None, ...] = ()  # largest force of each probe over all frames [N]
    notes: tuple[str, ...] = ()  # warnings of the run, without the first one (error estimates)
    seconds: float | None = field(default=None, compare=False)  # wall-clock time of the run [s]


_OUTCOME = TypeAdapter(Outcome)


def _outcome_from_record(run: int, record: Mapping[str, Any]) -> Outcome:
    """Extract the outcome of a run from its run.json; foreign content may raise any exception."""
    estimate = record["error_estimate"] or {}
    return _OUTCOME.validate_python(
        {
            **record,
            "run": run,
            "error_estimate": estimate.get("error"),
            "mesh_error": estimate.get("mesh_error"),
            "forces": tuple(probe.get("greatest_force") for probe in record["probes"]),
            "notes": tuple(record["notes"][1:]),  # The first is the error estimate.
            "seconds": record["timings"]["total"],
        }
    )
