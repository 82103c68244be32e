"""CSV export: a table of forces and a table of tracks, each for all runs.

forces.csv has the columns of a run's forces.csv. tracks.csv has a row per run, frame and track: the coordinates on the
sheet, the projected position [px], whether the track is occluded (1 or 0), and its position [m]. The first column of
both is the number of the run in index.csv. Missing values are empty.
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
from taichi_msm.exports.inputs import FLOAT32_FORMAT, read_track_positions, read_tracks
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun, damaged_result, reading
from taichi_msm.scene.outputs import FORCES_HEADER, zero_padded

TRACKS_HEADER = ("time", "point", "across", "down", "x", "y", "occluded", "position_x", "position_y", "position_z")


def write(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
    """Write the forces and tracks of runs; a run without both raises a FilesError."""
    writers = {"forces": (FORCES_HEADER, _write_forces), "tracks": (TRACKS_HEADER, _write_tracks)}
    with ExitStack() as opened:
        tables: dict[str, TextIO] = {}
        for run, name, _ in sources:
            available = [key for key in writers if run.has_output(key)]
            if not available:
                raise FilesError(f"{run.directory / run.camera}: csv needs forces or tracks; {run.remedy(*writers)}")
            for key in available:
                header, write_rows = writers[key]
                if key not in tables:
                    file = io.TextIOWrapper(create_file(folder / f"{key}.csv"), "ascii", newline="")
                    tables[key] = opened.enter_context(file)
                    tables[key].write(f"run,{','.join(header)}\n")
                write_rows(run, name or zero_padded(0), tables[key])
            missing = [key for key in writers if key not in available]
            yield [f"the results have no {key}; {run.remedy(key)}" for key in missing]


def _write_forces(run: FinishedRun, number: str, file: TextIO) -> None:
    path = run.result_path("forces")
    with reading(path), path.open(encoding="ascii", newline="") as source:
        # A run writes lines of less than 4096 characters; the limit bounds the memory that an untrusted file takes.
        rows = csv.reader(iter(partial(source.readline, 4096), ""))
        if tuple(next(rows)) != FORCES_HEADER:
            raise damaged_result(path)
        for row in rows:
            if len([float(value) for value in row]) != len(FORCES_HEADER):
                raise damaged_result(path)
            file.write(f"{number},{','.join(row)}\n")


def _write_tracks(run: FinishedRun, number: str, file: TextIO) -> None:
    (pixels, occluded), (coordinates, position) = read_tracks(run), read_track_positions(run)
    count, formats = len(pixels), ["%d", *[FLOAT32_FORMAT] * 4, "%d", *[FLOAT32_FORMAT] * 3]
    for frame, time in enumerate(run.time.tolist()):
        line = f"{number},{time!r},{','.join(formats)}\n"
        moving = pixels[:, frame], occluded[:, frame], position[:, frame]
        rows = np.column_stack([np.arange(count), coordinates, *moving])
        file.write(((line * count) % tuple(rows.ravel().tolist())).replace("nan", ""))
