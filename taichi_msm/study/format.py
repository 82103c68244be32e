"""Formatting of measurements: numbers, times, errors and tables, for the page, the terminal and the picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from taichi_msm.study.result import MeshMeasurement, PeerMeasurement, SteppingMeasurement, Study, Timing

# Units of time, with their number in a second.
TIME_UNITS = ((1, "s"), (1e3, "ms"), (1e6, "us"))

Columns = Mapping[str, Callable[[Any], str]]

# A measurement with an error.
ErrorMeasurement = SteppingMeasurement | PeerMeasurement | MeshMeasurement


def format_number(value: float) -> str:
    """Format a measured value with three significant digits."""
    return f"{value:.0f}" if 999.5 <= abs(value) < 1e6 else f"{value:#.3g}".rstrip(".")


def time_unit(seconds: float) -> tuple[float, str]:
    """Choose a readable unit for a time; return the number of units in a second, and its name."""
    return next(((scale, name) for scale, name in TIME_UNITS if seconds * scale >= 0.9995), TIME_UNITS[-1])


def format_duration(seconds: float) -> str:
    """Format a time with its unit."""
    scale, name = time_unit(seconds)
    return f"{format_number(seconds * scale)} {name}"


def format_timing(seconds: Timing) -> str:
    """Format a median and, in the same unit, the range."""
    scale, _ = time_unit(seconds.median)
    spread = "once"
    if seconds.runs > 1:
        spread = f"{format_number(seconds.fastest * scale)} to {format_number(seconds.slowest * scale)}"
    return f"{format_duration(seconds.median)} ({spread})"


def comparable_error(point: ErrorMeasurement) -> float:
    """Return an error, infinite where the simulation diverged."""
    return math.inf if point.error is None or math.isnan(point.error) else point.error


def format_error(point: ErrorMeasurement) -> str:
    """Format an error, or its bound if it is not known exactly."""
    error = comparable_error(point)
    return f"{'' if point.known else '< '}{format_number(error)}" if error < math.inf else "diverged"


def is_mostly_rounding(point: ErrorMeasurement) -> bool:
    """Return whether most of an error comes from f32."""
    return isinstance(point, SteppingMeasurement) and (point.rounding or 0) > (point.error or 0) / 2


def machine_summary(study: Study) -> str:
    """Describe the machine of a study in a line."""
    threads = study.machine["threads"]
    cpu_use = f"{threads} thread{'' if threads == 1 else 's'}, vectors of {study.machine['vectors']} bits"
    return f"{study.machine['cpu']}, {cpu_use if study.machine['arch'] == 'cpu' else study.machine['arch']}"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], left_columns: Sequence[int] = ()) -> str:
    """Format a Markdown table.

    Args:
        head: names of the columns.
        rows: cells of every row.
        left_columns: columns that are aligned left; all others are aligned right.

    Returns:
        The table, without a final line break.
    """
    widths = [max(len(row[column]) for row in [head, *rows]) for column in range(len(head))]
    rule = ["-" * width if column in left_columns else "-" * (width - 1) + ":" for column, width in enumerate(widths)]

    def line(cells: Sequence[str]) -> str:
        padded = [
            cell.ljust(width) if column in left_columns else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        return f"| {' | '.join(padded)} |"

    return "\n".join([line(head), line(rule), *map(line, rows)])


def format_table(measurements: Sequence[Any], columns: Columns, remark: Callable[[Any], str] | None = None) -> str:
    """Format measurements as a Markdown table, one per row.

    Args:
        measurements: measurements of one kind.
        columns: functions that format the cells of a measurement, by the names of the columns.
        remark: function that formats the remark on a measurement in a last column without a name; empty for none.

    Returns:
        The table.
    """
    if remark and any(map(remark, measurements)):
        columns = {**columns, "": remark}
    rows = [[cell(measurement) for cell in columns.values()] for measurement in measurements]
    text_columns = [n for n, name in enumerate(columns) if name in ("method", "without", "")]
    return markdown_table(list(columns), rows, text_columns)
