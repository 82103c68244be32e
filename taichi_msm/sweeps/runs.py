"""The folder of a sweep: what it is of, and which of its runs are done.

Hand the runs of a sweep to an executor, and take their outcomes as they come.

One run of a sweep, as a worker takes it.

What is known of a run of a sweep: a row of the table.

A sweep whose runs have ended.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, ClassVar, Literal, NamedTuple, get_args

from pydantic import ConfigDict, TypeAdapter

from taichi_msm.errors import (
    ExecutorError,
    FilesError,
    ForeignError,
    LostExecutorError,
    MsmError,
    Pause,
    Progress,
    SceneError,
    writing,
)
from taichi_msm.load.scene_file import File, plan_file
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
from taichi_msm.scene.outputs import RECORD, RUNS, SWEEP, numbered
from taichi_msm.sweeps.pool import DiedError
from taichi_msm.sweeps.spec import Sweep
from taichi_msm.system.compiler import versions, what_decides_bits

pass  # REMOVED
pass  # REMOVED
pass  # REMOVED

# Runs that ended so need not be taken again.
ENDED = ("complete", "diverged")

# A record is not read further than this, or twice the bytes of its values where these are more.
MAX_BYTES = 1 << 28

# How often a folder that another command has is tried again [s].
LOCK_POLL_S = 0.1


def values_in(directory: Path, sweep: Sweep) -> list[list[Any]]:
    """Compute the values of all runs, which the folder keeps, after making sure that it holds no other sweep.

    Raises:
        SceneError: when the folder holds another sweep, or the same of versions that give other bits.
        FilesError: when it cannot be read or written, something is in the way, or it keeps other values.
    """
    record = require_kind(directory / SWEEP, FILE)
    require_kind(directory / RUNS, FOLDER)
    description, values = sweep.description(), sweep.values()
    if not record.exists():
        for name in (RUNS, *FILES, RECORD):
            if (directory / name).exists():
                raise ForeignError.at(directory / name, "something")
        content = {
            "scene": sweep.settings.scene,
            **description,
            "keys": sweep.keys,
            "versions": versions(),
            "values": values,
        }
        with writing(directory), hidden_folder(directory) as hidden:
            (hidden / SWEEP).write_text(json.dumps(content) + "\n", encoding="utf-8", errors="backslashreplace")
            link_without_replacing(hidden / SWEEP, record)  # unless another shard has just done so
    # As a text, in which no number equals another one, and NaN itself.
    own_values = json.dumps(values)
    try:
        with record.open("rb") as file:
            kept = json.loads(file.read(max(MAX_BYTES, 2 * len(own_values))))
        earlier = {name: kept.get(name) for name in description}
        kept_values, began = json.dumps(kept["values"]), what_decides_bits(kept["versions"], "cpu")
    except OSError as error:
        raise FilesError(f"{record}: {(error.strerror or str(error)).lower()}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise FilesError(f"{record}: damaged; choose another --out") from None
    if other := [name for name, value in json.loads(json.dumps(description)).items() if value != earlier[name]]:
        what = {"digest": "the scene file", "files": _changed(description["files"], earlier["files"])}
        said = f"holds the runs of another sweep: {what.get(other[0], other[0])} differs"
        raise SceneError([f"{directory}: {said}; choose another --out"])
    here = what_decides_bits(versions(), "cpu")
    if others := [f"{name} {version}" for name, version in began.items() if version != here.get(name)]:
        raise SceneError([f"{directory}: the sweep began with {', '.join(others)}; use these, or choose another --out"])
    if kept_values != own_values:
        said = "its values are not those of the sweep file, as it is damaged or of another SciPy"
        raise FilesError(f"{record}: {said}; choose another --out")
    return values


def _changed(files: dict[str, str], earlier: Any) -> str:
    """Name a file whose digest is not what it was."""
    known = earlier if isinstance(earlier, dict) else files
    return next((path for path, digest in files.items() if known.get(path) != digest), "a file")


@dataclass
class UnderWay:
    """A sweep in its folder, of which some runs may have ended."""

    directory: Path
    sweep: Sweep
    values: list[list[Any]]  # of the varied keys, for each run
    done: list[Outcome]  # of the runs that have ended, which grows
    missing: list[Task]  # those that had not when it began
    total: int  # of runs, of all or of a shard


def begin_sweep(sweep: Sweep, directory: Path, shard: tuple[int, int] = (1, 1)) -> UnderWay:
    """Begin a sweep in a folder, or a shard of it, or go on; errors as for `values_in`."""
    values = values_in(directory, sweep)
    part, parts = shard
    home = Path.cwd()
    done, missing = [], []
    for run in range(part - 1, len(values), parts):
        task = Task(run, sweep.scene, sweep.overrides(values[run]), directory, home)
        require_kind(task.directory, FOLDER)
        if outcome := ended(task, sweep):
            done.append(outcome)
        else:
            missing.append(task)
    return UnderWay(directory, sweep, values, done, missing, len(done) + len(missing))


def ended(task: Task, sweep: Sweep) -> Outcome | None:
    """Find the outcome of a run that has ended; None: it is missing, was interrupted, or is another task's."""
    # A record that no run has written is as none.
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        if entry_kind(task.directory / RECORD) == FILE:
            with (task.directory / RECORD).open("rb") as file:
                record = json.loads(file.read(MAX_RECORD_BYTES))
            is_own = tuple(record["overrides"]) == task.overrides
            has_same_files = sweep.digests.issuperset(record["sha256"].values())
            if record["status"] in ENDED and is_own and has_same_files:
                return outcome_of(task.run, record)
    return None


@contextmanager
def alone(directory: Path, pause: Pause) -> Iterator[None]:
    """Wait until no other command writes the files that a sweep ends with; `pause` is called meanwhile."""
    with ExitStack() as opened:
        while True:
            try:
                opened.enter_context(lock_file(directory / SWEEP))
                break
            except BlockingIOError:
                pause()
                time.sleep(LOCK_POLL_S)
        yield


pass  # REMOVED
pass  # REMOVED

# The most runs that an executor is given at a time.
WINDOW = 4096

# While all workers are busy, this is how long until `pause` is called again [s].
POLL_INTERVAL_S = 0.1


def outcomes(tasks: Iterable[Task], executor: Executor, pause: Pause) -> Iterator[Outcome]:
    """Take runs; one whose process in our own pool ended before it was done is taken once more.

    `pause` is called some times a second; what it raises ends the sweep.

    Raises:
        LostExecutorError: when the executor takes no more runs.
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
            future = done.get(timeout=POLL_INTERVAL_S)
        except Empty:
            continue
        task = waiting.pop(future)
        try:
            outcome = future.result()
        except ExecutorError as error:
            raise LostExecutorError(str(error)) from error
        except (BrokenExecutor, CancelledError) as error:
            raise _ended(executor, error) from error
        except DiedError as error:
            if task.run not in died:
                died.add(task.run)
                submit(task)
                continue
            outcome = Outcome(task.run, "died", f"{error}, twice")
        except Exception as error:
            # `take` raises nothing, so this is its worker's end; other executors try as often as they were told.
            outcome = Outcome(task.run, "died", " ".join(str(error).split()))
        yield outcome
        for following in islice(rest, 1):
            submit(following)


def _ended(executor: Executor, error: Exception) -> LostExecutorError:
    """Make the error for an executor that takes no more runs."""
    return LostExecutorError(f"{type(executor).__name__} takes no more runs: {error}; start the sweep again")


pass  # REMOVED


class Task(NamedTuple):
    """A run that is to be taken."""

    run: int  # its number
    scene: File
    overrides: tuple[str, ...]
    folder: Path  # of the sweep
    home: Path  # from which its paths start

    @property
    def directory(self) -> Path:
        """Where its results go."""
        return self.folder / RUNS / numbered(self.run)


def take(task: Task, progress: Progress = lambda stage, done, total: None) -> Outcome:
    """Run a scene with its overrides on one thread, as `run --set` does; whatever fails is in the outcome.

    `progress` is called some times a second; it may raise a KeyboardInterrupt, as from `runs.run.run`.
    """
    os.chdir(task.home)
    try:
        plan = plan_file(task.scene, task.overrides)
    except SceneError as error:
        return _without_results(task, "refused", "; ".join(error.lines))

    from taichi_msm.load import cost
    from taichi_msm.runs import run as run_module

    try:
        cost.require_disk(plan, task.directory)
    except SceneError as error:
        return _without_results(task, "failed", str(error))
    try:
        record = run_module.run(
            plan, task.directory, threads=1, overrides=task.overrides, started=time.perf_counter(), progress=progress
        )
    except SceneError as error:  # found only now, such as a picture that cannot be decoded
        return _without_results(task, "refused", "; ".join(error.lines))
    except MsmError as error:
        return _without_results(task, "failed", str(error))
    except Exception as error:
        return _without_results(task, "failed", f"a bug, please report it: {type(error).__name__}: {error}")
    return outcome_of(task.run, record)


def _without_results(task: Task, status: Status, reason: str) -> Outcome:
    """Make the outcome of a run without results; its reason names neither the folder of the sweep nor the scene's."""
    said = " ".join(reason.split()).replace(str(task.directory), task.directory.name)
    # The path of a picture follows a blank.
    return Outcome(task.run, status, said.replace(f" {task.scene.folder / '_'}"[:-1], " "))


# How a run ended. Refused: its values are not valid; failed: by an error; died: its process ended twice before it did.
Status = Literal["complete", "diverged", "refused", "failed", "died"]
STATUSES: tuple[Status, ...] = get_args(Status)


@dataclass(frozen=True)
class Outcome:
    """How a run of a sweep ended, and its results; None: it has none."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(allow_inf_nan=False)

    run: int  # its number, from 0
    status: Status
    error: str = ""  # why, if it is not complete
    max_displacement: float | None = None  # [m]
    shortest_spring: float | None = None  # smallest ratio of a spring's length to its rest length
    error_estimate: float | None = None  # as a fraction of the largest displacement
    mesh_error: float | None = None  # likewise
    forces: tuple[float | None, ...] = ()  # the greatest force of every probe at any frame [N]
    notes: tuple[str, ...] = ()  # what to know before trusting the results, besides the errors
    seconds: float | None = field(default=None, compare=False)  # the time that it took [s]


_OUTCOME = TypeAdapter(Outcome)

# The columns of the table after those of the keys, in their order; then come the forces of the probes, and seconds.
COLUMNS = ("status", "error", "max_displacement", "shortest_spring", "error_estimate", "mesh_error")


def outcome_of(run: int, record: Mapping[str, Any]) -> Outcome:
    """Take from the record of a run that has ended what the table shows; ValueError: no run has written that."""
    estimate = record["error_estimate"] or {}
    return _OUTCOME.validate_python(
        {
            "run": run,
            "status": record["status"],
            "error": record.get("error", ""),
            "max_displacement": record["max_displacement"],
            "shortest_spring": record["shortest_spring"],
            "error_estimate": estimate.get("error"),
            "mesh_error": estimate.get("mesh_error"),
            "forces": tuple(probe.get("greatest_force") for probe in record["probes"]),
            "notes": tuple(record["notes"][1:]),  # The first one is of the errors.
            "seconds": record["timings"]["total"],
        }
    )


pass  # REMOVED

# The files that a sweep ends with.
FILES = TABLE, PARQUET, DATASET, CONTACT, PLOT, SENSITIVITY = (
    "table.csv",
    "table.parquet",
    "dataset.json",
    "contact.jpg",
    "sweep.png",
    "sensitivity.csv",
)


@dataclass(frozen=True)
class SweepResult:
    """What came out of all runs of a sweep."""

    directory: Path
    sweep: Sweep
    values: list[list[Any]]  # of the varied keys, for each run
    outcomes: list[Outcome]  # one for each run, in the order of their numbers

    def columns(self) -> dict[str, list[Any]]:
        """Give the columns of the table after those of the keys, by their names: a value for each run."""
        runs = self.outcomes
        columns = {name: [getattr(one, name) for one in runs] for name in COLUMNS}
        for n in range(max((len(one.forces) for one in runs), default=0)):
            name = f"probes.{n}.force"
            # Which is a key of a scene, too.
            name += ".greatest" if name in self.sweep.keys else ""
            columns[name] = [one.forces[n] if n < len(one.forces) else None for one in runs]
        return columns | {"seconds": [one.seconds for one in runs]}

    def run_directory(self, run: int) -> Path:
        """Name the folder of a run."""
        return self.directory / RUNS / numbered(run)

    def some(self, most: int) -> list[int]:
        """Give the numbers of at most so many runs, evenly spread over all."""
        total, count = len(self.outcomes), min(len(self.outcomes), most)
        return [(2 * n + 1) * total // (2 * count) for n in range(count)]
