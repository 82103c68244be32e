"""The folder of a sweep: what it is of, and which of its runs are done."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taichi_msm.errors import FilesError, ForeignError, SceneError, writing
from taichi_msm.outputs.table import RECORD, RUNS, SWEEP
from taichi_msm.progress import Pause
from taichi_msm.results.entries import FILE, FOLDER, kind, require
from taichi_msm.results.publication import MAX_RECORD
from taichi_msm.results.whole import give_name, lock, staged
from taichi_msm.sweeps.outcome import Outcome, outcome_of
from taichi_msm.sweeps.result import FILES
from taichi_msm.sweeps.sweepfile import Sweep
from taichi_msm.sweeps.task import Task
from taichi_msm.system.compiler import what_decides_bits
from taichi_msm.system.versions import versions

# Runs that ended so need not be taken again.
ENDED = ("complete", "diverged")

# A record is not read further than this, or twice the bytes of its values where these are more.
MAX_BYTES = 1 << 28

# How often a folder that another command has is tried again [s].
PATIENCE = 0.1


def values_in(directory: Path, sweep: Sweep) -> list[list[Any]]:
    """Compute the values of all runs, which the folder keeps, after making sure that it holds no other sweep.

    Raises:
        SceneError: when the folder holds another sweep, or the same of versions that give other bits.
        FilesError: when it cannot be read or written, something is in the way, or it keeps other values.
    """
    record = require(directory / SWEEP, FILE)
    require(directory / RUNS, FOLDER)
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
        with writing(directory), staged(directory) as hidden:
            (hidden / SWEEP).write_text(json.dumps(content) + "\n", encoding="utf-8", errors="backslashreplace")
            give_name(hidden / SWEEP, record)  # unless another shard has just done so
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
        require(task.directory, FOLDER)
        if outcome := ended(task, sweep):
            done.append(outcome)
        else:
            missing.append(task)
    return UnderWay(directory, sweep, values, done, missing, len(done) + len(missing))


def ended(task: Task, sweep: Sweep) -> Outcome | None:
    """Find the outcome of a run that has ended; None: it is missing, was interrupted, or is another task's."""
    # A record that no run has written is as none.
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        if kind(task.directory / RECORD) == FILE:
            with (task.directory / RECORD).open("rb") as file:
                record = json.loads(file.read(MAX_RECORD))
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
                opened.enter_context(lock(directory / SWEEP))
                break
            except BlockingIOError:
                pause()
                time.sleep(PATIENCE)
        yield
