"""Reports of a sweep: table, description of the data set, plots, summary; and its cost estimate."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.accuracy.companions import MESH_DOUBT, MESH_REMEDY
from taichi_msm.errors import SceneError, StageProgressCallback
from taichi_msm.load import cost
from taichi_msm.load.scene_file import plan_file
from taichi_msm.model.plan import Plan
from taichi_msm.runs.directory import MAX_RECORD_BYTES, replacing
from taichi_msm.scene.outputs import RUN_RECORD, is_formula
from taichi_msm.sweeps import plots
from taichi_msm.sweeps.expressions import replace_expressions
from taichi_msm.sweeps.runs import REPORT_FILES, STATUSES, Outcome, SweepState
from taichi_msm.sweeps.spec import Sweep, format_override, spread
from taichi_msm.system.compiler import versions
from taichi_msm.system.files import read_regular
from taichi_msm.system.process import available_memory, available_threads
from taichi_msm.version import commit


def write_reports(
    state: SweepState, executor: Executor, progress: StageProgressCallback
) -> tuple[list[str], list[str]]:
    """Write the reports of a sweep, each atomically, and remove outdated ones.

    Return the names of the written files, and warnings, such as the failure of a report other than the table.
    """
    writers: dict[str, Callable[[SweepState, list[str]], list[str]]] = {
        "table.parquet": write_parquet,
        "dataset.json": write_dataset,
        "contact.jpg": partial(plots.write_contact_sheet, executor=executor, progress=progress),
        "sweep.png": _write_plots,
    }
    written, notes = ["table.csv"], list[str]()
    write_table(state)
    for name, write in writers.items():
        try:
            notes += write(state, written)
        except Exception as error:
            # A failing report must not discard hours of runs.
            notes.append(f"{name} could not be written: {type(error).__name__}: {error}")
    for path in (state.directory / name for name in REPORT_FILES if name not in written):
        if not path.is_dir():
            path.unlink(missing_ok=True)
    return written, notes


def _write_plots(state: SweepState, written: list[str]) -> list[str]:
    """Write sensitivity.csv if runs suffice, and sweep.png if complete runs differ; return warnings."""
    # More runs would slow down the plots without visible change.
    runs = spread(len(state.outcomes), 4096)
    varied, columns = plots.varied_parameters(state, runs), plots.varied_results(state, runs)
    if not (varied and columns):
        return ["no sweep.png: it needs complete runs with results that differ"]
    notes, indices = [], list[plots.SensitivityIndex]()
    failed = np.array([state.outcomes[run].status != "complete" for run in runs])
    try:
        indices = plots.estimate_sensitivity(varied, columns)
    except ImportError:
        notes.append("sensitivity.csv needs SALib: pip install SALib")
    if indices:
        _write_csv(state.directory / "sensitivity.csv", [indices[0]._fields, *indices])
        written.append("sensitivity.csv")
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return [*notes, "sweep.png needs matplotlib: pip install matplotlib"]
    complete = count_statuses(state.outcomes)["complete"]
    subset = f", {len(runs)} of them shown" if len(runs) < len(state.outcomes) else ""
    title = f"{state.sweep.scene.name}: {complete} of {len(state.outcomes)} runs complete{subset}"
    with replacing(state.directory / "sweep.png") as file:
        plots.plot(plots.PlotData(title, varied, columns, failed, indices), file)
    written.append("sweep.png")
    return notes


def write_table(state: SweepState) -> None:
    """Write table.csv, with a row for each run."""
    columns = _columns(state)
    for name in state.sweep.keys:
        columns[name] = list(map(format_cell, columns[name]))
    columns["error"] = [f"'{error}" if is_formula(error) else error for error in columns["error"]]
    _write_csv(state.directory / "table.csv", [list(columns), *zip(*columns.values(), strict=True)])


def format_cell(value: Any) -> str:
    """Format a value for `--set`, a text in quotes if a spreadsheet would take it for a formula."""
    text = format_override(value)
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) and is_formula(text) else text


def write_parquet(state: SweepState, written: list[str]) -> list[str]:
    """Write table.parquet if pyarrow is installed, and append it to the written reports; return no warnings."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return []
    columns: dict[str, Any] = _columns(state)
    for name in state.sweep.keys:
        # A column of mixed types, such as numbers and lists, becomes text.
        try:
            pyarrow.array(columns[name])
        except pyarrow.ArrowException:
            columns[name] = list(map(format_override, columns[name]))
    for name in state.columns():  # explicit types, for columns without values
        kind = pyarrow.string() if name in ("status", "error") else pyarrow.float64()
        columns[name] = pyarrow.array(columns[name], kind)
    with replacing(state.directory / "table.parquet") as file:
        parquet.write_table(pyarrow.table(columns), file)
    written.append("table.parquet")
    return []


def _columns(state: SweepState) -> dict[str, list[Any]]:
    values = map(list, zip(*state.values, strict=True))
    runs = [outcome.run for outcome in state.outcomes]
    return {"run": runs, **dict(zip(state.sweep.keys, values, strict=True)), **state.columns()}


def _write_csv(path: Path, rows: Iterable[Iterable[Any]]) -> None:
    with replacing(path) as file:
        for row in rows:
            file.write(f"{csv_line(row)}\n".encode("utf-8", "backslashreplace"))


def csv_line(row: Iterable[Any]) -> str:
    """Format a row of a CSV file, without the line break."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(row)
    return text.getvalue()


def write_dataset(state: SweepState, written: list[str]) -> list[str]:
    """Write dataset.json, with a line for each complete run, and append it to the written reports; no warnings."""
    sweep, complete = state.sweep, [outcome.run for outcome in state.outcomes if outcome.status == "complete"]
    common = _output_format(state.run_directory(complete[0])) if complete else {}
    settings = sweep.settings
    expressions = (key for key, value in settings.set.items() if replace_expressions(value, lambda *_: None) != value)
    # These sections of the scene determine the format of a run.
    differ = any(key.split(".")[0] in ("output", "render", "time") for key in (*settings.distributions, *expressions))
    splits = assign_splits(len(state.outcomes), settings.seed)
    head = {"scene": settings.scene, **sweep.description(), "versions": versions(), "commit": commit(), **common}
    with replacing(state.directory / "dataset.json") as file:
        file.write(b"{\n")
        for name, value in head.items():
            file.write(f'"{name}": '.encode() + _json(value) + b",\n")
        file.write(b'"runs": [')
        for run in complete:
            directory = state.run_directory(run)
            folder = directory.relative_to(state.directory).as_posix()
            values = dict(zip(sweep.keys, state.values[run], strict=True))
            outputs = _output_format(directory) if differ else {}
            row = {"run": run, "folder": folder, "part": splits[run], "values": values, **outputs}
            file.write((b"" if run == complete[0] else b",") + b"\n" + _json(row))
        file.write(b"\n]\n}\n")
    written.append("dataset.json")
    return []


def assign_splits(runs: int, seed: int) -> list[str]:
    """Return the split of every run: "train", "val" or "test".

    In the order of the SHA-256 of "SEED RUN", the first tenth of the runs is the test split, and the second tenth the
    validation split. So the split of a run depends only on the seed, its number and the number of runs.
    """
    order = sorted(range(runs), key=lambda run: hashlib.sha256(f"{seed} {run}".encode()).digest())
    tenth = (runs + 5) // 10
    splits = ["train"] * runs
    for rank, run in enumerate(order[: 2 * tenth]):
        splits[run] = "test" if rank < tenth else "val"
    return splits


def _output_format(directory: Path) -> dict[str, Any]:
    """Read the outputs, number of frames, frame size [px] and frame rate of a run."""
    record = json.loads(read_regular(directory / RUN_RECORD, MAX_RECORD_BYTES))
    scene = record["scene"]
    return {
        "outputs": record["outputs"],
        "frames": record["frames"],
        "size": scene["render"]["size"],
        "frames_per_second": scene["time"]["frames_per_second"],
    }


def _json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False).encode("utf-8", "backslashreplace")


def cost_line(runs: int, expected: SweepCost, workers: WorkerCount | None) -> str:
    """Return the estimated cost of runs as text; `workers` is None for a cluster."""
    location = "if they were run here"
    if workers is not None:
        processes = f"{workers.number} {'process' if workers.number == 1 else 'processes'}"
        location = f"in {processes} ({workers.cores} cores; memory for {workers.memory_limit})"
    line = f"{_runs(runs)}: about {cost.format_rough_time(expected.seconds)} {location}"
    line += f", at most {expected.disk_bytes / 2**20:.1f} MiB on disk"
    if expected.refused:
        line += f"; of {expected.looked_at} that were checked, {expected.refused} will be refused"
        line += f", for example: {expected.example}"
    return line


def summary_lines(
    directory: Path, outcomes: Sequence[Outcome], shard: tuple[int, int] | None, files: list[str], notes: list[str]
) -> list[str]:
    """Summarise a sweep: the number of runs with each status, an example of each failure, and the reports.

    The shard is (I, N), or None for the whole sweep; `files` and `notes` are those of `write_reports`.
    """
    part = f" of part {shard[0]} of {shard[1]}" if shard else ""
    counts = ", ".join(f"{number} {status}" for status, number in count_statuses(outcomes).items() if number)
    lines = [f"{directory}: {_runs(len(outcomes))}{part}: {counts}"]
    for status in STATUSES:
        example = next((outcome for outcome in outcomes if outcome.status == status), None)
        if example and example.error:
            lines.append(f"{status}, for example run {example.run:06}: {example.error}")
    for name, cause in (("error_estimate", "the time step"), ("mesh_error", "the mesh")):
        errors = [(getattr(outcome, name), outcome.run) for outcome in outcomes if getattr(outcome, name) is not None]
        if errors:
            largest, run = max(errors)
            statistics = f"median {median(error for error, _ in errors):.2g}, largest {largest:.2g} (run {run:06})"
            lines.append(f"error, as a fraction of the largest displacement, due to {cause}: {statistics}")
    # All runs have nearly the same warnings of the mesh: those of the run with the largest error stand for all.
    of_mesh = [outcome for outcome in outcomes if any(map(_is_of_mesh, outcome.notes))]
    if of_mesh:
        worst = max(of_mesh, key=lambda outcome: outcome.mesh_error or 0)
        warnings = "; ".join(filter(_is_of_mesh, worst.notes))
        lines.append(f"{_runs(len(of_mesh))} with a warning of the mesh, for example run {worst.run:06}: {warnings}")
        lines.append(
            "labels follow the simulated surface, so they agree with the pictures; the error is of the physics"
        )
    # Warnings that differ only in numbers are a group; the five largest groups have an example each.
    groups: dict[str, list[str]] = {}
    for outcome in outcomes:
        for note in itertools.filterfalse(_is_of_mesh, outcome.notes):
            groups.setdefault(re.sub(r"[0-9.e+-]+", "", note), []).append(f"run {outcome.run:06}: {note}")
    for group in sorted(groups.values(), key=len, reverse=True)[:5]:
        lines.append(f"{_runs(len(group))} with a warning, for example {group[0]}")
    return [*lines, "without --shard, the same command writes the table" if shard else ", ".join(files), *notes]


def _is_of_mesh(note: str) -> bool:
    return note.startswith((MESH_DOUBT, MESH_REMEDY))


def _runs(number: int) -> str:
    return "1 run" if number == 1 else f"{number} runs"


def count_statuses(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Count the runs with each status."""
    counts = Counter(outcome.status for outcome in outcomes)
    return {status: counts[status] for status in STATUSES}


# Memory of a process for Python, compiler and kernels, without its run [bytes].
PROCESS_BYTES = 400 << 20

# Overhead of a run and of a frame [s], for directories, files and calls; measured on Zen 4.
RUN_OVERHEAD_S, FRAME_OVERHEAD_S = 0.04, 0.003


class SweepCost(NamedTuple):
    """Estimated cost of the runs of a sweep; its fields are keys in the JSON of --dry-run."""

    seconds: float  # on all cores of this machine
    disk_bytes: int  # upper bound
    memory_bytes: int  # of one process
    looked_at: int  # number of checked runs
    refused: int  # number of checked runs with invalid values
    example: str  # error of a refused run

    def scaled(self, fraction: float) -> SweepCost:
        """Return the cost of a fraction of the runs."""
        return self._replace(seconds=fraction * self.seconds, disk_bytes=round(fraction * self.disk_bytes))


class WorkerCount(NamedTuple):
    """Number of processes, and its limits."""

    number: int
    cores: int  # available to this program
    memory_limit: int  # number of processes that the free memory allows


def estimate_cost(sweep: Sweep) -> SweepCost:
    """Estimate the cost of a sweep from up to 64 of its runs."""
    plans, errors = list[Plan](), list[str]()
    for values in sweep.values(64):
        try:
            plans.append(plan_file(sweep.scene, sweep.overrides(values)))
        except SceneError as error:
            errors.append(error.lines[0])
    durations, budgets = list(map(cost.estimate_duration, plans)), list(map(cost.estimate_budget, plans))
    looked_at = len(plans) + len(errors)
    scale, cores = sweep.runs / looked_at, available_threads()
    seconds = sum(duration.seconds - duration.start for duration in durations)
    seconds += sum(RUN_OVERHEAD_S + FRAME_OVERHEAD_S * budget.frames for budget in budgets) / cores
    return SweepCost(
        # The start of a process counts once.
        seconds=max((duration.start for duration in durations), default=0.0) + scale * seconds,
        disk_bytes=round(scale * sum(budget.disk_bytes for budget in budgets)),
        memory_bytes=PROCESS_BYTES + max((budget.memory_bytes for budget in budgets), default=0),
        looked_at=looked_at,
        refused=len(errors),
        example=errors[0] if errors else "",
    )


def choose_worker_count(expected: SweepCost, runs: int, requested: int | None = None) -> WorkerCount:
    """Choose the number of processes: one per core, limited by the free memory and the number of runs.

    A requested number is not limited.
    """
    cores, memory_limit = available_threads(), available_memory() // expected.memory_bytes
    return WorkerCount(requested or max(1, min(cores, memory_limit, runs)), cores, memory_limit)
