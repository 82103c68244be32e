"""The files that a sweep ends with.

The table of a sweep: a row for each run.

What a sweep is as a data set: what varied, what the runs have, and which of them are for training.

A tenth of all runs is for testing and a tenth for validation, to the nearest run: the first and the next in the order
of the SHA-256 of "SEED RUN". So the part of a run follows from the seed, its number and the number of runs alone: not
from which runs failed, nor from the version of any library.

What a person reads of a sweep: what it will take, and how it ended.

What a sweep will take, from some of its runs, and how many processes to share it among.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.errors import Progress, SceneError, writing
from taichi_msm.load import cost as cost_module
from taichi_msm.load.cost import rough_time
from taichi_msm.load.scene_file import plan_file
from taichi_msm.model.plan import Plan
from taichi_msm.runs.directory import MAX_RECORD_BYTES, replacing
from taichi_msm.scene.outputs import RECORD
from taichi_msm.sweeps.plots import parameters, results, sensitivity, write_contact
from taichi_msm.sweeps.runs import (
    CONTACT,
    DATASET,
    FILES,
    PARQUET,
    PLOT,
    SENSITIVITY,
    STATUSES,
    TABLE,
    Outcome,
    SweepResult,
)
from taichi_msm.sweeps.spec import Sweep, cell
from taichi_msm.system.compiler import versions
from taichi_msm.system.files import read_regular
from taichi_msm.system.process import available_memory, available_threads

pass  # REMOVED
pass  # REMOVED

WITHOUT_MATPLOTLIB = f"{PLOT} needs matplotlib: pip install matplotlib"
WITHOUT_SALIB = f"{SENSITIVITY} needs SALib: pip install SALib"

# The most runs, evenly spread, that are plotted, and whose sensitivity is estimated.
MOST_RUNS = 4096

# Names of files that were written, and what the user should know about them.
Written = tuple[list[str], list[str]]


def write_reports(result: SweepResult, executor: Executor, progress: Progress) -> Written:
    """Write them, each whole or not at all; the executor draws what the runs have not drawn.

    Files of an earlier call that cannot be made any more are removed.

    Raises:
        FilesError: when the table cannot be written; that another file cannot is a note.
    """
    writers: dict[str, Callable[[SweepResult], Written]] = {
        PARQUET: write_parquet,
        DATASET: write_dataset,
        CONTACT: partial(write_contact, executor=executor, progress=progress),
        PLOT: _write_plots,
    }
    with writing(result.directory):
        write_table(result)
        names, notes = [TABLE], list[str]()
        for name, write in writers.items():
            try:
                more, said = write(result)
            except Exception as error:
                # Hours of runs must not end without their table because of a picture.
                more, said = [], [f"{name} could not be made: {type(error).__name__}: {error}"]
            names += more
            notes += said
        for name in set(FILES).difference(names):
            (result.directory / name).unlink(missing_ok=True)
    return names, notes


def _write_plots(result: SweepResult) -> Written:
    """Write sensitivity.csv if there are runs enough, and sweep.png if some complete runs differ."""
    runs = result.some(MOST_RUNS)
    varied, columns = parameters(result, runs), results(result, runs)
    names: list[str] = []
    notes: list[str] = []
    if not (varied and columns):
        return names, [f"no {PLOT}: it needs complete runs with results that differ"]
    failed = np.array([result.outcomes[run].status != "complete" for run in runs])
    try:
        indices = sensitivity(varied, columns)
    except ImportError:
        indices = []
        notes.append(WITHOUT_SALIB)
    if indices:
        with replacing(result.directory / SENSITIVITY) as file:
            for row in [indices[0]._fields, *indices]:
                file.write(f"{csv_line(row)}\n".encode("utf-8", "backslashreplace"))
        names.append(SENSITIVITY)
    try:
        from taichi_msm.sweeps.plots import Content, plot
    except ImportError:
        return names, [*notes, WITHOUT_MATPLOTLIB]
    complete = sum(outcome.status == "complete" for outcome in result.outcomes)
    some = f", {len(runs)} of them shown" if len(runs) < len(result.outcomes) else ""
    title = f"{result.sweep.scene.name}: {complete} of {len(result.outcomes)} runs complete{some}"
    with replacing(result.directory / PLOT) as file:
        plot(Content(title, varied, columns, failed, indices), file)
    return [*names, PLOT], notes


def write_table(result: SweepResult) -> None:
    """Write table.csv."""
    with replacing(result.directory / TABLE) as file:
        for row in [_names(result), *_rows(result, cell)]:
            file.write(f"{csv_line(row)}\n".encode("utf-8", "backslashreplace"))


def write_parquet(result: SweepResult) -> tuple[list[str], list[str]]:
    """Write table.parquet where pyarrow is installed; returns its name, and no notes."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return [], []
    rows = zip(*_rows(result, lambda value: value), strict=True)
    columns: dict[str, Any] = dict(zip(_names(result), map(list, rows), strict=True))
    for name in result.sweep.keys:
        # Values of several types, such as a number and none, have no common one.
        try:
            pyarrow.array(columns[name])
        except pyarrow.ArrowException:
            columns[name] = list(map(cell, columns[name]))
    for name in result.columns():  # also if there is no value at all
        kind = pyarrow.string() if name in ("status", "error") else pyarrow.float64()
        columns[name] = pyarrow.array(columns[name], kind)
    with replacing(result.directory / PARQUET) as file:
        parquet.write_table(pyarrow.table(columns), file)
    return [PARQUET], []


def csv_line(row: Iterable[Any]) -> str:
    """Write a row of a table as a line of a CSV file."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(row)
    return text.getvalue()


def _names(result: SweepResult) -> list[str]:
    return ["run", *result.sweep.keys, *result.columns()]


def _rows(result: SweepResult, write: Callable[[Any], Any]) -> Iterator[list[Any]]:
    """Give the entries of every row, in which the values of keys are written somehow."""
    columns = zip(*result.columns().values(), strict=True)
    for values, outcome, others in zip(result.values, result.outcomes, columns, strict=True):
        yield [outcome.run, *map(write, values), *others]


# Where the keys of a scene are that decide what a run writes.
DECIDING = ("output", "render", "time")


def write_dataset(result: SweepResult) -> tuple[list[str], list[str]]:
    """Write the data set, with a line for every complete run; returns its name, and no notes."""
    sweep, complete = result.sweep, [outcome.run for outcome in result.outcomes if outcome.status == "complete"]
    common = _facts(result.run_directory(complete[0])) if complete else {}
    differ = any(key.split(".")[0] in DECIDING for key in sweep.keys)
    parts = split(len(result.outcomes), sweep.settings.seed)
    head = {"scene": sweep.settings.scene, **sweep.description(), "versions": versions(), **common}
    with replacing(result.directory / DATASET) as file:
        file.write(b"{\n")
        for name, value in head.items():
            file.write(f'"{name}": '.encode() + _json(value) + b",\n")
        file.write(b'"runs": [')
        for run in complete:
            directory = result.run_directory(run)
            folder = directory.relative_to(result.directory).as_posix()
            values = dict(zip(sweep.keys, result.values[run], strict=True))
            own = _facts(directory) if differ else {}
            row = {"run": run, "folder": folder, "part": parts[run], "values": values, **own}
            file.write((b"" if run == complete[0] else b",") + b"\n" + _json(row))
        file.write(b"\n]\n}\n")
    return [DATASET], []


def split(runs: int, seed: int) -> list[str]:
    """Give the part of every run: train, val or test."""
    order = sorted(range(runs), key=lambda run: hashlib.sha256(f"{seed} {run}".encode()).digest())
    tenth = (runs + 5) // 10
    parts = ["train"] * runs
    for name, chosen in (("test", order[:tenth]), ("val", order[tenth : 2 * tenth])):
        for run in chosen:
            parts[run] = name
    return parts


def _facts(directory: Path) -> dict[str, Any]:
    """Give what a loader needs to know of a run: its outputs, the frames, their size [px] and how many a second."""
    record = json.loads(read_regular(directory / RECORD, MAX_RECORD_BYTES))
    scene = record["scene"]
    return {
        "outputs": record["outputs"],
        "frames": record["frames"],
        "size": scene["render"]["size"],
        "frames_per_second": scene["time"]["frames_per_second"],
    }


def _json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False).encode("utf-8", "backslashreplace")


pass  # REMOVED

# The errors that runs estimate, and what makes them.
ERRORS = {"error_estimate": "the time step", "mesh_error": "the number of points"}

# The most kinds of notes that are shown.
MOST_NOTES = 5


def cost_line(runs: int, cost: Cost, workers: Workers | None) -> str:
    """Say what a sweep takes; None: its workers are elsewhere."""
    if workers is None:
        where = "if they were run here"
    else:
        processes = f"{workers.number} {'process' if workers.number == 1 else 'processes'}"
        where = f"in {processes} ({workers.cores} cores; memory for {workers.fitting})"
    disk = f"at most {cost.disk_bytes / 2**20:.1f} MiB on disk"
    refused = f"; of {cost.looked_at} that were checked, {cost.refused} will be refused, for example: {cost.example}"
    return f"{_runs(runs)}: about {rough_time(cost.seconds)} {where}, {disk}{refused if cost.refused else ''}"


def summary_lines(
    directory: Path, outcomes: Sequence[Outcome], shard: tuple[int, int] | None, files: list[str], notes: list[str]
) -> list[str]:
    """Say in some lines how the runs of a sweep ended, with an example of each failure, and what was written."""
    of = f" of part {shard[0]} of {shard[1]}" if shard else ""
    counts = count(outcomes)
    said = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    lines = [f"{directory}: {_runs(len(outcomes))}{of}: {said}"]
    for status in STATUSES:
        example = next((outcome for outcome in outcomes if outcome.status == status), None)
        if example and example.error:
            lines.append(f"{status}, for example run {example.run:06}: {example.error}")
    for name, what in ERRORS.items():
        errors = [(getattr(outcome, name), outcome.run) for outcome in outcomes if getattr(outcome, name) is not None]
        if errors:
            largest, run = max(errors)
            said = f"median {median(error for error, _ in errors):.2g}, largest {largest:.2g} (run {run:06})"
            lines.append(f"error, as a fraction of the largest displacement, due to {what}: {said}")
    lines += _noted(outcomes)
    return [*lines, "without --shard, the same command writes the table" if shard else ", ".join(files), *notes]


def _noted(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Give an example of each note that some runs have, whatever its numbers are."""
    alike: dict[str, list[str]] = {}
    for outcome in outcomes:
        for note in outcome.notes:
            alike.setdefault(re.sub(r"[0-9.e+-]+", "", note), []).append(f"run {outcome.run:06}: {note}")
    for notes in sorted(alike.values(), key=len, reverse=True)[:MOST_NOTES]:
        yield f"{_runs(len(notes))} with a note, for example {notes[0]}"


def _runs(number: int) -> str:
    return "1 run" if number == 1 else f"{number} runs"


def count(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Count the runs that ended in each way."""
    counts = Counter(outcome.status for outcome in outcomes)
    return {status: counts[status] for status in STATUSES}


# The runs that are planned for the estimate, evenly spread over all; each takes milliseconds.
LOOKED_AT = 64

# Memory of a process besides that of its run: Python, the compiler, kernels [bytes].
PROCESS_BYTES = 400 << 20

# What a run takes besides its work, and each of its frames [s]: folders, files, calls; measured on Zen 4.
RUN_SECONDS, FRAME_SECONDS = 0.04, 0.003


class Cost(NamedTuple):
    """What all runs take, about."""

    seconds: float  # on this machine, with every core
    disk_bytes: int  # at most
    memory_bytes: int  # of one process
    looked_at: int  # how many runs this follows from
    refused: int  # how many of them are
    example: str  # why one of them is

    def of(self, share: float) -> Cost:
        """Give the cost of a share of the runs."""
        return self._replace(seconds=share * self.seconds, disk_bytes=round(share * self.disk_bytes))


class Workers(NamedTuple):
    """How many processes take runs."""

    number: int
    cores: int  # that this program may use
    fitting: int  # processes whose memory is free


def estimate(sweep: Sweep) -> Cost:
    """Estimate what the runs of a sweep take."""
    plans: list[Plan] = []
    reasons: list[str] = []
    for values in sweep.some_values(LOOKED_AT):
        try:
            plans.append(plan_file(sweep.scene, sweep.overrides(values)))
        except SceneError as error:
            reasons.append(error.lines[0])
    times, needs = list(map(cost_module.estimate_duration, plans)), list(map(cost_module.estimate_memory, plans))
    looked_at = len(plans) + len(reasons)
    share, cores = sweep.runs / looked_at, available_threads()
    seconds = sum(one.seconds - one.start for one in times)
    seconds += sum(RUN_SECONDS + FRAME_SECONDS * need.frames for need in needs) / cores
    return Cost(
        # A process starts once, for many runs.
        seconds=max((one.start for one in times), default=0.0) + share * seconds,
        disk_bytes=round(share * sum(need.disk_bytes for need in needs)),
        memory_bytes=PROCESS_BYTES + max((need.memory_bytes for need in needs), default=0),
        looked_at=looked_at,
        refused=len(reasons),
        example=next(iter(reasons), ""),
    )


def choose_workers(cost: Cost, runs: int, asked: int | None = None) -> Workers:
    """Choose a process for each core, as far as the free memory goes, or as many as are asked for."""
    cores, fitting = available_threads(), available_memory() // cost.memory_bytes
    return Workers(asked or max(1, min(cores, fitting, runs)), cores, fitting)
