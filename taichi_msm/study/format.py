"""Tables of measurements, and how numbers, times and errors are written in them and in the picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from taichi_msm.study.result import MeshMeasurement, PeerMeasurement, SteppingMeasurement, Study, Timing

UNITS = ((1, "s"), (1e3, "ms"), (1e6, "us"))

Columns = Mapping[str, Callable[[Any], str]]


def format_number(value: float) -> str:
    """Write a measured value with three significant digits."""
    return f"{value:.0f}" if 999.5 <= abs(value) < 1e6 else f"{value:#.3g}".rstrip(".")


def time_unit(seconds: float) -> tuple[float, str]:
    """Choose a readable unit for a time; returns how many of it make a second, and its name."""
    return next(((scale, name) for scale, name in UNITS if seconds * scale >= 0.9995), UNITS[-1])


def format_duration(seconds: float) -> str:
    """Write a time with its unit."""
    scale, name = time_unit(seconds)
    return f"{format_number(seconds * scale)} {name}"


def format_timing(seconds: Timing) -> str:
    """Write a median and, in the same unit, the range."""
    scale, _ = time_unit(seconds.median)
    spread = (
        f"{format_number(seconds.fastest * scale)} to {format_number(seconds.slowest * scale)}"
        if seconds.runs > 1
        else "once"
    )
    return f"{format_duration(seconds.median)} ({spread})"


def comparable_error(point: SteppingMeasurement | PeerMeasurement | MeshMeasurement) -> float:
    """Give an error, infinite where the simulation diverged."""
    return math.inf if point.error is None or math.isnan(point.error) else point.error


def format_error(point: SteppingMeasurement | PeerMeasurement | MeshMeasurement) -> str:
    """Write an error; if it is not known exactly, its bound."""
    return (
        f"{'' if point.known else '< '}{format_number(comparable_error(point))}"
        if comparable_error(point) < math.inf
        else "diverged"
    )


def is_mostly_rounding(point: SteppingMeasurement | PeerMeasurement | MeshMeasurement) -> bool:
    """Tell whether most of an error comes from f32."""
    return isinstance(point, SteppingMeasurement) and (point.rounding or 0) > (point.error or 0) / 2


def machine_summary(study: Study) -> str:
    """Name the machine."""
    threads = study.machine["threads"]
    used = f"{threads} thread{'' if threads == 1 else 's'}, vectors of {study.machine['vectors']} bits"
    return f"{study.machine['cpu']}, {used if study.machine['arch'] == 'cpu' else study.machine['arch']}"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[int] = ()) -> str:
    """Write a Markdown table; columns are aligned right, but those in `left`, of words, left."""
    widths = [max(len(row[column]) for row in [head, *rows]) for column in range(len(head))]
    rule = ["-" * width if column in left else "-" * (width - 1) + ":" for column, width in enumerate(widths)]

    def line(cells: Sequence[str]) -> str:
        padded = [
            cell.ljust(width) if column in left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        return f"| {' | '.join(padded)} |"

    return "\n".join([line(head), line(rule), *map(line, rows)])


WORDS = ("method", "without")


def format_table(measured: Sequence[Any], columns: Columns, mark: Callable[[Any], str] | None = None) -> str:
    """Write measurements as a table, one in a row; `mark` may give more for a last column without a name."""
    if mark and any(map(mark, measured)):
        columns = {**columns, "": mark}
    rows = [[cell(one) for cell in columns.values()] for one in measured]
    return markdown_table(list(columns), rows, [n for n, name in enumerate(columns) if name in WORDS or not name])
