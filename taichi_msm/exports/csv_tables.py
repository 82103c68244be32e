"""Forces and tracks as tables that spreadsheets, R and pandas read: one each for all runs.

forces.csv has the columns of the run's own, tracks.csv a row for each run, frame and point: its coordinates on the
sheet, where it is seen [px], whether it is hidden (1 or 0), and where it is [m]. The first column of both is the number
of the run in index.csv. What has no value is empty.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np

from taichi_msm.errors import FilesError
from taichi_msm.exports.formats import ExportSource
from taichi_msm.exports.inputs import read_track_positions, read_tracks
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun, damaged_result, reading
from taichi_msm.scene.outputs import FORCES_HEADER, numbered

TRACKS_HEADER = ("time", "point", "across", "down", "x", "y", "occluded", "position_x", "position_y", "position_z")

# As many digits as distinguish any two numbers of single precision.
FLOAT32_FORMAT = "%.9g"


# The longest line of forces.csv that is read [characters]; a run writes no longer one.
MAX_LINE_CHARACTERS = 4096


def write(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
    """Write the forces and the tracks of the runs that have them; a FilesError names a run that has neither."""
    writers = {"forces": (FORCES_HEADER, _write_forces), "tracks": (TRACKS_HEADER, _write_tracks)}
    with ExitStack() as opened:
        tables: dict[str, TextIO] = {}
        for run, name, _ in sources:
            written = [key for key in writers if run.has_output(key)]
            if not written:
                raise FilesError(f"{run.directory / run.camera}: csv needs forces or tracks; {run.remedy(*writers)}")
            for key in written:
                header, write_rows = writers[key]
                if key not in tables:
                    file = io.TextIOWrapper(create_file(folder / f"{key}.csv"), "ascii", newline="")
                    tables[key] = opened.enter_context(file)
                    tables[key].write(f"run,{','.join(header)}\n")
                write_rows(run, name or numbered(0), tables[key])
            lacking = [key for key in writers if key not in written]
            yield [f"without {key}, which are not among the results; {run.remedy(key)}" for key in lacking]


def _write_forces(run: FinishedRun, number: str, file: TextIO) -> None:
    """Copy the rows of a run, whose every value is a number."""
    path = run.result_path("forces")
    with reading(path), path.open(encoding="ascii", newline="") as source:
        rows = csv.reader(iter(partial(source.readline, MAX_LINE_CHARACTERS), ""))
        if tuple(next(rows)) != FORCES_HEADER:
            raise damaged_result(path)
        for row in rows:
            if len([float(value) for value in row]) != len(FORCES_HEADER):
                raise damaged_result(path)
            file.write(f"{number},{','.join(row)}\n")


def _write_tracks(run: FinishedRun, number: str, file: TextIO) -> None:
    """Write a row for each frame and point of a run."""
    (points, occluded), (coordinates, position) = read_tracks(run), read_track_positions(run)
    count = len(points)
    for frame, time in enumerate(run.time.tolist()):
        line = f"{number},{time!r},%d,{FLOAT32_FORMAT},{FLOAT32_FORMAT},{FLOAT32_FORMAT},{FLOAT32_FORMAT},%d,{FLOAT32_FORMAT},{FLOAT32_FORMAT},{FLOAT32_FORMAT}\n"
        rows = np.column_stack(
            [np.arange(count), coordinates, points[:, frame], occluded[:, frame], position[:, frame]]
        )
        file.write(((line * count) % tuple(rows.ravel().tolist())).replace("nan", ""))
