"""A study in the terminal, and the wording that its report and its picture share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from taichi_msm.scene import MAX_POINTS
from taichi_msm.study.result import Drawn, Peer, Points, Stepping, Study, Timing

UNITS = ((1, "s"), (1e3, "ms"), (1e6, "us"))

MARKS = {"*": "recommended", "!": "above the tolerance", "<": "at most about"}

Point = TypeVar("Point", Stepping, Peer)


def number(value: float) -> str:
    """Write a measured value with three significant digits."""
    return f"{value:.0f}" if 999.5 <= abs(value) < 1e6 else f"{value:#.3g}".rstrip(".")


def unit(seconds: float) -> tuple[float, str]:
    """Choose a readable unit for a time; returns how many of it make a second, and its name."""
    return next(((scale, name) for scale, name in UNITS if seconds * scale >= 0.9995), UNITS[-1])


def duration(seconds: float) -> str:
    """Write a time with its unit."""
    scale, name = unit(seconds)
    return f"{number(seconds * scale)} {name}"


def timing(seconds: Timing) -> str:
    """Write a median and, in the same unit, the range."""
    scale, _ = unit(seconds.median)
    spread = f"{number(seconds.fastest * scale)} to {number(seconds.slowest * scale)}" if seconds.runs > 1 else "once"
    return f"{duration(seconds.median)} ({spread})"


def wrong(point: Stepping | Peer | Points) -> str:
    """Write an error; if it is not known exactly, its bound."""
    size = _size(point)
    return f"{'' if point.known else '< '}{number(size)}" if size < math.inf else "diverged"


def estimated(points: Points) -> str:
    """Write the error that `run` estimates."""
    return "not known" if points.estimate is None else number(points.estimate)


def shown(text: str) -> str:
    """Make a file name printable even if it is not UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def where(study: Study) -> str:
    """Name the machine."""
    threads = study.machine["threads"]
    used = f"{threads} thread{'' if threads == 1 else 's'}, vectors of {study.machine['vectors']} bits"
    return f"{study.machine['cpu']}, {used if study.machine['arch'] == 'cpu' else study.machine['arch']}"


def shortfall(study: Study) -> str | None:
    """Say why no step is recommended, and what to do about it; None if one is."""
    if study.best_stepping is not None:
        return None
    if not study.stepping:
        return "No step is recommended: none was measured."
    said = f"No step that was measured is within the tolerance of {study.tolerance:g}"
    closest = _best(study.stepping, study.tolerance)
    if closest is None or _size(closest) == math.inf:
        said += ": all diverged."
    else:
        said += f"; the closest is {closest.method} at {duration(closest.step)}, with an error of {wrong(closest)}."
    return (
        f"{said} Set time.tolerance, with which a run searches for a finer step itself, and time.precision: f64; "
        "or allow a larger error with --tolerance."
    )


def remarks(study: Study) -> Iterator[str]:
    """Say what the recommendation leaves open, and what the points make of the error."""
    own, more = study.own_points, study.more_points
    if more is None and (reason := shortfall(study)) is not None:
        yield reason
    if own is None:
        return
    size = f"{'' if own.known else 'at most about '}{number(own.error or 0.0)}"
    if more is None:
        step = study.best_stepping
        beside = "" if step is None else f", the recommended step one of {number(step.error or 0.0)}"
        yield f"{own.name} points make an error of {size}{beside}; the tolerance is {study.points_tolerance:g}."
        return
    said = (
        f"{own.name} points make an error of {size}, which no step can mend; the tolerance is "
        f"{study.points_tolerance:g}."
    )
    rows, cols = more
    if max(more) > MAX_POINTS:
        yield (
            f"{said} About {rows} x {cols} would be within it, and a scene may have {MAX_POINTS} a side: take a wider "
            "tool (probes.N.radius, a smaller falloff), or allow a larger error with --tolerance."
        )
    elif any((one.rows, one.cols) == more for one in study.points):
        yield f"{said} {rows} x {cols} are within it; with time.tolerance a run finds the step for them."
    else:
        yield (
            f"{said} Take about {rows} x {cols} (extrapolated, not measured); with time.tolerance a run finds the step "
            "for them."
        )


def print_summary(study: Study, console: Console) -> None:
    """Print the most important results of a study, and last the lines to put in the scene."""

    def say(text: str) -> None:
        # Without markup and line breaks, so that lines can be copied.
        console.print(Text(text), soft_wrap=True, highlight=False)

    say(f"{shown(study.scene)} on {where(study)}")
    if study.reference is not None:
        say(
            f"error: the largest of any point at any frame, as a fraction of {number(study.reference.largest)} m; "
            f"tolerance {study.tolerance:g}"
        )
    if study.stepping or study.peers:
        console.print(_stepping_table(study))
    if study.drawing:
        console.print(_drawing_table(study))
    if study.points:
        console.print(_points_table(study))
    for note in study.notes:
        say(f"note: {shown(note)}")
    for remark in remarks(study):
        say(remark)
    if lines := study.recommendation():
        say("To put in the scene:\n")
        say("\n".join(lines) + "\n")


def _stepping_table(study: Study) -> Table:
    table = _table("method", "step", "error", "time (spread)", "order")
    recommended = study.best_stepping
    for method in dict.fromkeys(point.method for point in study.stepping):
        best = _best([point for point in study.stepping if point.method == method], study.tolerance)
        if best is not None:
            order = study.orders.get(method)
            is_it = best is recommended
            _add(
                table,
                is_it,
                _starred(method, is_it),
                duration(best.step),
                _error(best, study.tolerance),
                timing(best.seconds),
                "" if order is None else f"{order:.2f}",
            )
    peer = _best(study.peers, study.tolerance)
    if peer is not None:
        error = _error(peer, study.tolerance)
        _add(table, False, _starred("DOP853", False), f"rtol {peer.rtol:g}", error, timing(peer.seconds), "")
    text = "".join(str(cell) for column in table.columns for cell in column.cells)
    table.caption = "   ".join(f"{mark} {meaning}" for mark, meaning in MARKS.items() if mark in text)
    table.caption_justify = "left"
    return table


def _drawing_table(study: Study) -> Table:
    table = _table("refine", "supersample", "PSNR", "largest error", "time (spread)")
    for drawn in _drawings(study):
        is_it = drawn is study.best_drawing
        _add(
            table,
            is_it,
            _starred(str(drawn.refine), is_it),
            str(drawn.supersample),
            decibels(drawn),
            str(drawn.largest_error),
            timing(drawn.seconds),
        )
    return table


def _points_table(study: Study) -> Table:
    table = _table("points", "steps/frame", "error", "estimate", "time (spread)")
    for points in study.points:
        is_it = (points.rows, points.cols) == study.more_points
        cells = str(points.steps_per_frame), wrong(points), estimated(points), timing(points.seconds)
        _add(table, is_it, _starred(points.name, is_it), *cells)
    return table


def decibels(drawn: Drawn) -> str:
    """Write the PSNR of a picture."""
    return "equal" if drawn.psnr is None else f"{drawn.psnr:.1f} dB"


def _drawings(study: Study) -> Iterator[Drawn]:
    """Choose for every supersampling the refinement that would be recommended if the scene had that supersampling."""
    for supersample in sorted({drawn.supersample for drawn in study.drawing}):
        render = {**study.settings["render"], "supersample": supersample}
        best = replace(study, settings={**study.settings, "render": render}).best_drawing
        if best is not None:
            yield best


def _best(points: Sequence[Point], tolerance: float) -> Point | None:
    """Find the fastest point within the tolerance, or else the most exact one."""
    good = [point for point in points if _size(point) <= tolerance]
    if good:
        return min(good, key=lambda point: point.seconds.median)
    return min(points, key=_size, default=None)


def _size(point: Stepping | Peer | Points) -> float:
    return math.inf if point.error is None or math.isnan(point.error) else point.error


def _error(point: Stepping | Peer, tolerance: float) -> str:
    return f"{wrong(point)} !" if tolerance < _size(point) < math.inf else wrong(point)


def _starred(text: str, recommended: bool) -> str:
    return f"{'*' if recommended else ' '} {text}"


def _table(*columns: str) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, no_wrap=True)
    return table


def _add(table: Table, recommended: bool, *cells: str) -> None:
    table.add_row(*(Text(cell) for cell in cells), style="bold" if recommended else "")


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[int] = ()) -> str:
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
