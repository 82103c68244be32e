"""The runs that an export is of, and how a format takes them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from pathlib import Path
from typing import NamedTuple

from taichi_msm.errors import FilesError
from taichi_msm.outputs.table import NUMBERED, RECORD, RUNS, SWEEP
from taichi_msm.progress import Count
from taichi_msm.results.entries import files
from taichi_msm.results.finished_run import FinishedRun, read_run, reading
from taichi_msm.results.publication import MAX_RECORD
from taichi_msm.system.files import read_regular


class Source(NamedTuple):
    """A run that is exported."""

    run: FinishedRun  # as the first camera that the format shows has seen it
    name: str  # its number among the runs; empty if it is the only one
    progress: Count  # of this run


# Writes the files of all runs into an empty folder. It is a generator: after each run it gives what the user should
# know about that run, and after the last it writes what is of all runs together.
Write = Callable[[Sequence[Source], Path], Iterator[list[str]]]


def in_folders(write: Callable[[FinishedRun, Path, Count], list[str]]) -> Write:
    """Make a format of what writes one run into an empty folder."""

    @wraps(write)
    def write_all(sources: Sequence[Source], folder: Path) -> Iterator[list[str]]:
        for source in sources:
            own = folder / source.name
            own.mkdir(exist_ok=True)
            yield write(source.run, own, source.progress)

    return write_all


def read_runs(directories: Sequence[str | Path]) -> tuple[list[FinishedRun], int]:
    """Read the records of runs in their folders and in those of sweeps; also counts the runs that are left out.

    Of a sweep these are all that are not complete.

    Raises:
        FilesError: as `read_run` does, and when no run is left.
    """
    runs, left_out = [], 0
    for directory in map(Path, directories):
        record = directory / SWEEP
        with reading(record):
            is_sweep = record.is_file() and not (directory / RECORD).is_file()
        if not is_sweep:
            runs.append(read_run(directory))
            continue
        with reading(record):
            names = files(directory, (rf"{RUNS}/{NUMBERED}/{RECORD}",), strict=False)
            folders = sorted(((directory / name).parent for name in names), key=lambda folder: int(folder.name))
            count = len(json.loads(read_regular(record, MAX_RECORD))["values"])
        complete = [run for run in map(read_run, folders) if run.status == "complete"]
        left_out += count - len(complete)
        runs += complete
    if not runs:
        raise FilesError(f"{', '.join(map(str, directories))}: no run is complete; table.csv there tells why")
    return runs, left_out
