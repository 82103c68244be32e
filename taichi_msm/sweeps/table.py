"""The table of a sweep: a row for each run."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from taichi_msm.results.whole import replacing
from taichi_msm.sweeps.result import PARQUET, TABLE, SweepResult
from taichi_msm.sweeps.sweepfile import cell


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
