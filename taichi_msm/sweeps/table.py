"""The table of a sweep: a row for each run."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from taichi_msm.results.whole import replacing
from taichi_msm.sweeps.outcome import COLUMNS
from taichi_msm.sweeps.result import SweepResult
from taichi_msm.sweeps.sweepfile import cell

CSV, PARQUET = "table.csv", "table.parquet"


def write_table(result: SweepResult) -> list[str]:
    """Write table.csv, and table.parquet where pyarrow is installed; returns their names."""
    names = ["run", *result.sweep.keys, *COLUMNS]
    with replacing(result.directory / CSV) as file:
        for row in [names, *_rows(result, cell)]:
            file.write(f"{csv_line(row)}\n".encode("utf-8", "backslashreplace"))
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return [CSV]
    columns = dict(zip(names, map(list, zip(*_rows(result, lambda value: value), strict=True)), strict=True))
    for name in result.sweep.keys:
        # Values of several types, such as a number and none, have no common one.
        try:
            pyarrow.array(columns[name])
        except pyarrow.ArrowInvalid:
            columns[name] = list(map(cell, columns[name]))
    with replacing(result.directory / PARQUET) as file:
        parquet.write_table(pyarrow.table(columns), file)
    return [CSV, PARQUET]


def csv_line(row: Iterable[Any]) -> str:
    """Write a row of a table as a line of a CSV file."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(row)
    return text.getvalue()


def _rows(result: SweepResult, write: Callable[[Any], Any]) -> Iterator[list[Any]]:
    """Give the entries of every row, in which the values of keys are written somehow."""
    for values, outcome in zip(result.values, result.outcomes, strict=True):
        yield [outcome.run, *map(write, values), *(getattr(outcome, name) for name in COLUMNS)]
