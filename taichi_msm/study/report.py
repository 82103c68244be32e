"""The files of a study: everything as JSON, one flat table, tables in Markdown, a picture."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from taichi_msm.errors import writing
from taichi_msm.results.whole import staged
from taichi_msm.study.result import Peer, Points, Stepping, Study, Timing
from taichi_msm.study.table import (
    decibels,
    duration,
    estimated,
    markdown,
    number,
    remarks,
    shown,
    timing,
    where,
    wrong,
)
from taichi_msm.system.compiler import named

PICTURE, FLAT, PAGE, RECORD = "study.png", "study.csv", "study.md", "study.json"

WITHOUT_MATPLOTLIB = "study.png needs matplotlib: pip install matplotlib"

COLUMNS = (
    "part",
    "method",
    "precision",
    "damping_difference",
    "steps_per_frame",
    "step",
    "rtol",
    "evaluations",
    "refine",
    "supersample",
    "rows",
    "cols",
    "without",
    "error",
    "rounding",
    "known",
    "estimate",
    "psnr",
    "largest_error",
    "seconds_median",
    "seconds_fastest",
    "seconds_slowest",
    "runs",
)

Row = dict[str, Any]


def require_writable(directory: Path) -> None:
    """Check before a long measurement that its report can be written.

    Raises:
        FilesError: when it cannot.
    """
    with writing(directory), staged(directory):
        pass


def write_report(study: Study, directory: Path) -> list[str]:
    """Write the report of a study, replacing an earlier one.

    Every file is written as a whole or not at all; study.json is the last.

    Args:
        study: complete or not; a note is added to it if the picture cannot be drawn.
        directory: created if it does not exist. Its other files stay.

    Returns:
        The names of the files written, study.json last.

    Raises:
        FilesError: when the directory cannot be written.
    """
    with writing(directory), staged(directory) as hidden:
        outputs = [PICTURE] if _draw(study, hidden / PICTURE) else []
        outputs += [FLAT, PAGE, RECORD]
        _write(hidden / FLAT, _flat(study))
        _write(hidden / PAGE, _page(study))
        record = {**as_record(study), "outputs": outputs}
        _write(hidden / RECORD, json.dumps(record, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
        if PICTURE not in outputs:
            (directory / PICTURE).unlink(missing_ok=True)
        for output in outputs:
            (hidden / output).replace(directory / output)
    return outputs


def as_record(study: Study) -> Row:
    """Give the whole study as data for JSON; numbers that are not finite become null."""
    methods = [{"method": one.method, **asdict(one)} for one in study.stepping]
    return _finite({**asdict(study), "stepping": methods, "recommendation": study.recommendation()})


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _draw(study: Study, path: Path) -> bool:
    """Draw the picture, if there is something to draw and Matplotlib is installed; returns whether it was drawn."""
    try:
        from taichi_msm.study.plot import panels, plot
    except ImportError:
        if WITHOUT_MATPLOTLIB not in study.notes:
            study.notes.append(WITHOUT_MATPLOTLIB)
        return False
    if not any(panels(study)):
        return False
    try:
        plot(study, path)
    except Exception as error:
        # Minutes of measurement must not be lost because their picture fails.
        study.notes.append(f"study.png could not be drawn: {type(error).__name__}: {error}")
        return False
    return True


def _write(path: Path, text: str) -> None:
    # A file name that is not UTF-8 contains surrogates; written with backslashes they are valid in JSON too.
    path.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


def _flat(study: Study) -> str:
    """Write all measurements as CSV, one line each, with the columns of all parts."""
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    table.writeheader()
    table.writerows(_rows(study))
    return text.getvalue()


def _rows(study: Study) -> Iterator[Row]:
    record = as_record(study)
    parts = {"stepping": "stepping", "peers": "dop853", "drawing": "drawing", "points": "points", "terms": "term"}
    for key, part in parts.items():
        for found in record[key]:
            seconds = found.pop("seconds")
            times = {f"seconds_{each}": seconds[each] for each in ("median", "fastest", "slowest")}
            method = {"method": "DOP853"} if part == "dop853" else {}
            yield {"part": part, **method, **found, **times, "runs": seconds["runs"]}


def _page(study: Study) -> str:
    """Write the page in Markdown."""
    versions = study.machine["versions"]
    state = "" if study.status == "complete" else f" ({study.status})"
    blocks = [
        f"# {shown(study.scene)}: speed against error{state}",
        f"Measured on {where(study)}, with taichi-msm {versions['taichi-msm']}, {named(versions)}, "
        f"NumPy {versions['numpy']} and Python {versions['python']} ({versions['platform']}). "
        "Times are medians, with the fastest and the slowest in brackets.",
        *_stepping(study),
        *_drawing(study),
        *_points(study),
        *_terms(study),
    ]
    if study.notes:
        blocks += ["## Notes", "\n".join(f"- {note}" for note in study.notes)]
    blocks.append("## Recommendation")
    blocks += remarks(study)
    if lines := study.recommendation():
        blocks.append("\n".join(["```yaml", *lines, "```"]))
    return "\n\n".join(blocks) + "\n"


def _stepping(study: Study) -> Iterator[str]:
    if not study.stepping and not study.peers:
        return
    yield "## Stepping"
    if (reference := study.reference) is not None:
        yield (
            "An error is the largest of any point at any frame, as a fraction of the largest displacement, "
            f"{number(reference.largest)} m. The reference is central differences in f64, extrapolated, with up to "
            f"{reference.steps_per_frame} steps a frame; its own error is about {number(reference.error)}. "
            f"The tolerance is {study.tolerance:g}."
        )
    best = study.best_stepping
    rows = [
        (
            one.method,
            duration(one.step),
            str(one.steps_per_frame),
            wrong(one),
            "" if one.rounding is None else number(one.rounding),
            timing(one.seconds),
            "recommended" if one is best else "",
        )
        for one in study.stepping
    ]
    yield markdown(
        ("method", "step", "steps/frame", "error", "of it rounding", "time of the scene", ""), rows, left=(0, 6)
    )
    orders = [f"{method} {order:.2f}" for method, order in study.orders.items() if order is not None]
    if orders:
        yield f"Observed orders: {', '.join(orders)}."
    if study.peers:
        yield "SciPy's DOP853 on the same equations:"
        peers = [(f"{one.rtol:g}", wrong(one), str(one.evaluations), timing(one.seconds)) for one in study.peers]
        yield markdown(("rtol", "error", "evaluations", "time of the scene"), peers)
    yield from _bounds([*study.stepping, *study.peers])


def _bounds(points: Sequence[Stepping | Peer | Points]) -> Iterator[str]:
    """Explain errors that are upper bounds, if there are any."""
    if any(wrong(one).startswith("<") for one in points):
        yield "An error with < is an approximate upper bound; the reference is not exact enough to know the error."


def _drawing(study: Study) -> Iterator[str]:
    if not study.drawing:
        return
    yield "## Drawing"
    yield (
        "The most deformed frame, against a picture of high refinement and supersampling. The largest error is of any "
        "colour of any pixel, from 0 to 255."
    )
    best = study.best_drawing
    rows = [
        (
            str(one.refine),
            str(one.supersample),
            decibels(one),
            str(one.largest_error),
            timing(one.seconds),
            "recommended" if one is best else "",
        )
        for one in study.drawing
    ]
    yield markdown(("refine", "supersample", "PSNR", "largest error", "time of a frame", ""), rows, left=(5,))


def _points(study: Study) -> Iterator[str]:
    if not study.points:
        return
    yield "## Points"
    yield (
        "The error is that made by the number of points, at the points and between them, where the displacement is "
        "interpolated by cubics: the largest anywhere at any frame, as a fraction of the largest displacement. The "
        "reference is the extrapolation, of order 2, of the two finest sheets. All are stepped in f64 with the same "
        "step. The estimate is that of `run`, by a sheet beside it with half the cells a side. "
        "Times are those of each sheet's automatic step."
    )
    own = tuple(study.settings["sheet"]["points"])
    rows = [
        (
            one.name,
            str(one.steps_per_frame),
            wrong(one),
            estimated(one),
            timing(one.seconds),
            "of the scene"
            if (one.rows, one.cols) == own
            else "recommended" * ((one.rows, one.cols) == study.more_points),
        )
        for one in study.points
    ]
    yield markdown(("points", "steps/frame", "error", "estimate", "time of the scene", ""), rows, left=(5,))
    yield from _bounds(study.points)


def _terms(study: Study) -> Iterator[str]:
    if not study.terms:
        return
    yield "## Terms"
    whole = study.terms[0].seconds.median
    rows = [(one.without or "nothing", timing(one.seconds), _share(one.seconds, whole)) for one in study.terms]
    yield markdown(("without", "time of a step", "of the whole step"), rows, left=(0,))


def _share(seconds: Timing, whole: float) -> str:
    return f"{100 * seconds.median / whole:.0f} %"
