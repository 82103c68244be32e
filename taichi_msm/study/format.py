"""Formatting of measurements for the report of a study: numbers, times, errors and tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from taichi_msm.study.result import MeshMeasurement, SteppingMeasurement, Study, Timing

# Units of time: number per second, and name.
TIME_UNITS = ((1, "s"), (1e3, "ms"), (1e6, "us"))

Columns = Mapping[str, Callable[[Any], str]]

# Measurements that have an error.
ErrorMeasurement = SteppingMeasurement | MeshMeasurement


def format_number(value: float) -> str:
    """Format a measured value with three significant digits; from 1000 to a million as a whole number."""
    return f"{value:.0f}" if 999.5 <= abs(value) < 1e6 else f"{value:#.3g}".rstrip(".")


def time_unit(seconds: float) -> tuple[float, str]:
    """Choose the unit of time for a duration [s]; return the number of units per second, and the name of the unit."""
    return next(((scale, name) for scale, name in TIME_UNITS if seconds * scale >= 0.9995), TIME_UNITS[-1])


def format_duration(seconds: float) -> str:
    """Format a time [s] with its unit."""
    scale, name = time_unit(seconds)
    return f"{format_number(seconds * scale)} {name}"


def format_timing(timing: Timing) -> str:
    """Format the median of times, and their range in the same unit."""
    scale, _ = time_unit(timing.median)
    range_text = "once"
    if timing.runs > 1:
        range_text = f"{format_number(timing.fastest * scale)} to {format_number(timing.slowest * scale)}"
    return f"{format_duration(timing.median)} ({range_text})"


def comparable_error(measurement: ErrorMeasurement) -> float:
    """Return the error for comparisons; infinite if the simulation diverged."""
    return math.inf if measurement.error is None or math.isnan(measurement.error) else measurement.error


def format_error(measurement: ErrorMeasurement) -> str:
    """Format the error; with < if it is an upper bound."""
    error = comparable_error(measurement)
    return f"{'' if measurement.known else '< '}{format_number(error)}" if error < math.inf else "diverged"


def machine_summary(study: Study) -> str:
    """Describe the machine of a study in a line."""
    threads = study.machine["threads"]
    cpu_use = f"{threads} thread{'' if threads == 1 else 's'}, vectors of {study.machine['vectors']} bits"
    return f"{study.machine['cpu']}, {cpu_use if study.machine['arch'] == 'cpu' else study.machine['arch']}"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], left_columns: Sequence[int] = ()) -> str:
    """Format a Markdown table, without a final line break; columns other than `left_columns` are right-aligned."""
    columns = range(len(head))
    widths = [max(len(row[column]) for row in [head, *rows]) for column in columns]
    pad = [str.ljust if column in left_columns else str.rjust for column in columns]
    separator = ["" if column in left_columns else ":" for column in columns]
    lines = [[pad[column](row[column], widths[column]) for column in columns] for row in [head, *rows]]
    lines.insert(1, [text.rjust(width, "-") for text, width in zip(separator, widths, strict=True)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def format_table(measurements: Sequence[Any], columns: Columns, remark: Callable[[Any], str] | None = None) -> str:
    """Format measurements as the rows of a Markdown table; the remarks, if any, are an unnamed last column."""
    if remark and any(map(remark, measurements)):
        columns = {**columns, "": remark}
    rows = [[cell(measurement) for cell in columns.values()] for measurement in measurements]
    text_columns = [n for n, name in enumerate(columns) if name in ("method", "")]
    return markdown_table(list(columns), rows, text_columns)
