"""The files that a sweep ends with."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial

import numpy as np

from taichi_msm.errors import writing
from taichi_msm.progress import Progress
from taichi_msm.results.whole import replacing
from taichi_msm.sweeps.contact import write_contact
from taichi_msm.sweeps.dataset import write_dataset
from taichi_msm.sweeps.parameters import parameters, results
from taichi_msm.sweeps.result import CONTACT, DATASET, FILES, PARQUET, PLOT, SENSITIVITY, TABLE, SweepResult
from taichi_msm.sweeps.sensitivity import sensitivity
from taichi_msm.sweeps.table import csv_line, write_parquet, write_table

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
        from taichi_msm.sweeps.plot import Content, plot
    except ImportError:
        return names, [*notes, WITHOUT_MATPLOTLIB]
    complete = sum(outcome.status == "complete" for outcome in result.outcomes)
    some = f", {len(runs)} of them shown" if len(runs) < len(result.outcomes) else ""
    title = f"{result.sweep.scene.name}: {complete} of {len(result.outcomes)} runs complete{some}"
    with replacing(result.directory / PLOT) as file:
        plot(Content(title, varied, columns, failed, indices), file)
    return [*names, PLOT], notes
