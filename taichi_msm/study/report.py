"""The files of a study: everything as JSON, tables in Markdown, a picture.

A study in words: its page in Markdown, and the shorter form that the terminal shows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

from taichi_msm.errors import printable, writing
from taichi_msm.runs.directory import hidden_folder
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.study.format import Columns, duration, number, size, table, timing, where, wrong
from taichi_msm.study.result import Drawn, Measured, Peer, Points, Reference, Stepping, Study
from taichi_msm.system.compiler import named

pass  # REMOVED

PICTURE, PAGE, RECORD = "study.png", "study.md", "study.json"

WITHOUT_MATPLOTLIB = "study.png needs matplotlib: pip install matplotlib"


def require_writable(directory: Path) -> None:
    """Check before a long measurement that its report can be written; raises FilesError."""
    with writing(directory), hidden_folder(directory):
        pass


def write_report(study: Study, directory: Path) -> list[str]:
    """Write the report of a study, replacing an earlier one; other files in the directory stay.

    Every file is written as a whole or not at all, study.json last. A note is added to the study if its picture cannot
    be drawn.

    Returns:
        The names of the files, study.json last.

    Raises:
        FilesError: when the directory cannot be written.
    """
    with writing(directory), hidden_folder(directory) as hidden:
        outputs = [*([PICTURE] if _draw(study, hidden / PICTURE) else []), PAGE, RECORD]
        record = json.dumps({**as_record(study), "outputs": outputs}, indent=2, ensure_ascii=False, allow_nan=False)
        for file, text in ((PAGE, page(study)), (RECORD, record + "\n")):
            # A file name that is not UTF-8 has surrogates; written with backslashes they are valid in JSON too.
            (hidden / file).write_text(text, encoding="utf-8", errors="backslashreplace", newline="")
        if PICTURE not in outputs:
            (directory / PICTURE).unlink(missing_ok=True)
        for output in outputs:
            (hidden / output).replace(directory / output)
    return outputs


def as_record(study: Study) -> dict[str, Any]:
    """Give the whole study as data for JSON; numbers that are not finite become null."""
    return {**_as_data(vars(study)), "recommendation": study.recommendation()}


def _as_data(value: Any) -> Any:
    if isinstance(value, Measured):
        method = {"method": value.method} if isinstance(value, Stepping) else {}
        return {**method, **{key: _as_data(inner) for key, inner in vars(value).items() if key != "samples"}} | {
            "seconds": asdict(value.seconds)
        }
    if isinstance(value, Reference):
        return _as_data(asdict(value))
    if isinstance(value, dict):
        return {key: _as_data(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_data(inner) for inner in value]
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


METHODS: Columns = {
    "method": lambda point: point.method,
    "step": lambda point: duration(point.step),
    "steps/frame": lambda point: str(point.steps_per_frame),
    "error": wrong,
    "of it rounding": lambda point: "" if point.rounding is None else number(point.rounding),
    "time of the scene": lambda point: timing(point.seconds),
}
PEERS: Columns = {
    "rtol": lambda peer: f"{peer.rtol:g}",
    "error": wrong,
    "evaluations": lambda peer: str(peer.evaluations),
    "time of the scene": lambda peer: timing(peer.seconds),
}
DRAWINGS: Columns = {
    "refine": lambda drawn: str(drawn.refine),
    "supersample": lambda drawn: str(drawn.supersample),
    "PSNR": lambda drawn: "equal" if drawn.psnr is None else f"{drawn.psnr:.1f} dB",
    "largest error": lambda drawn: str(drawn.largest_error),
    "time of a frame": lambda drawn: timing(drawn.seconds),
}
SHEETS: Columns = {
    "points": lambda points: points.name,
    "steps/frame": lambda points: str(points.steps_per_frame),
    "error": wrong,
    "estimate": lambda points: "not known" if points.estimate is None else number(points.estimate),
    "time of the scene": lambda points: timing(points.seconds),
}
TERMS: Columns = {
    "without": lambda term: term.without or "nothing",
    "time of a step": lambda term: timing(term.seconds),
}
# The columns of stepping that the terminal shows.
BRIEF = ("method", "step", "error", "time of the scene")

Point = TypeVar("Point", Stepping, Peer)


def page(study: Study) -> str:
    """Write the page."""
    versions = study.machine["versions"]
    state = "" if study.status == "complete" else f" ({study.status})"
    blocks = [
        f"# {printable(study.scene)}: speed against error{state}",
        f"Measured on {where(study)}, with taichi-msm {versions['taichi-msm']}, {named(versions)}, "
        f"NumPy {versions['numpy']} and Python {versions['python']} ({versions['platform']}). "
        "Times are medians, with the fastest and the slowest in brackets.",
        *(_stepping(study) if study.stepping or study.peers else ()),
    ]
    if study.drawing:
        blocks += [
            "## Drawing",
            "The most deformed frame, against a picture of high refinement and supersampling. The largest error is of "
            "any colour of any pixel, from 0 to 255.",
            _drawings_table(study, study.drawing),
        ]
    if study.points:
        blocks += _points(study)
    if study.terms:
        whole = study.terms[0].seconds.median
        share: Columns = {"of the whole step": lambda term: f"{100 * term.seconds.median / whole:.0f} %"}
        blocks += ["## Terms", table(study.terms, {**TERMS, **share})]
    if study.notes:
        blocks += ["## Notes", "\n".join(f"- {note}" for note in study.notes)]
    blocks += ["## Recommendation", *remarks(study)]
    if lines := study.recommendation():
        blocks.append("\n".join(["```yaml", *lines, "```"]))
    return "\n\n".join(blocks) + "\n"


def summary(study: Study) -> str:
    """Write the most important results for the terminal, and last the lines to put in the scene."""
    lines = [f"{printable(study.scene)} on {where(study)}"]
    if study.reference is not None:
        lines.append(
            f"error: the largest of any point at any frame, as a fraction of {number(study.reference.largest)} m; "
            f"tolerance {study.tolerance:g}"
        )
    methods = dict.fromkeys(point.method for point in study.stepping)
    every = (_best([one for one in study.stepping if one.method == method], study.tolerance) for method in methods)
    fastest = [one for one in every if one]
    blocks = ["\n".join(lines)]
    if fastest:
        blocks.append(_methods_table(study, fastest, {name: METHODS[name] for name in BRIEF}))
    if peer := _best(study.peers, study.tolerance):
        blocks.append(f"SciPy's DOP853 at rtol {peer.rtol:g}: error {wrong(peer)}, {timing(peer.seconds)}")
    if study.drawing:
        blocks.append(_drawings_table(study, list(_drawings(study))))
    if study.points:
        blocks.append(_sheets_table(study))
    notes = [f"note: {printable(note)}" for note in study.notes]
    if said := [*notes, *_bounds([*fastest, *study.points]), *remarks(study)]:
        blocks.append("\n".join(said))
    if recommended := study.recommendation():
        blocks += ["To put in the scene:", "\n".join(recommended)]
    return "\n\n".join(blocks)


def remarks(study: Study) -> Iterator[str]:
    """Say what the recommendation leaves open, and what the points make of the error."""
    own, more = study.own_points, study.more_points
    if more is None and study.best_stepping is None:
        yield _shortfall(study)
    if own is None:
        return
    bound = f"{'' if own.known else 'at most about '}{number(own.error or 0.0)}"
    if more is None:
        step = study.best_stepping
        beside = "" if step is None else f", the recommended step one of {number(step.error or 0.0)}"
        yield f"{own.name} points make an error of {bound}{beside}; the tolerance is {study.points_tolerance:g}."
        return
    rows, cols = more
    points = f"{rows} x {cols}"
    if max(more) > MAX_POINTS:
        advice = (
            f"About {points} would be within it, and a scene may have {MAX_POINTS} a side: take a wider "
            "tool (probes.N.radius, a smaller falloff), or allow a larger error with --tolerance."
        )
    else:
        measured = any((one.rows, one.cols) == more for one in study.points)
        enough = f"{points} are within it" if measured else f"Take about {points} (extrapolated, not measured)"
        advice = f"{enough}; with time.tolerance a run finds the step for them."
    yield (
        f"{own.name} points make an error of {bound}, which no step can mend; the tolerance is "
        f"{study.points_tolerance:g}. {advice}"
    )


def _shortfall(study: Study) -> str:
    """Say why no step is recommended, and what to do about it."""
    closest = _best(study.stepping, study.tolerance)
    if closest is None:
        return "No step is recommended: none was measured."
    said = f"No step that was measured is within the tolerance of {study.tolerance:g}"
    if closest.error is None:
        said += ": all diverged."
    else:
        said += f"; the closest is {closest.method} at {duration(closest.step)}, with an error of {wrong(closest)}."
    return (
        f"{said} Set time.tolerance, with which a run searches for a finer step itself, and time.precision: f64; "
        "or allow a larger error with --tolerance."
    )


def _stepping(study: Study) -> Iterator[str]:
    yield "## Stepping"
    if (reference := study.reference) is not None:
        extrapolated = ", not extrapolated as contact is of order 1," if study.touches else ", extrapolated,"
        yield (
            "An error is the largest of any point at any frame, as a fraction of the largest displacement, "
            f"{number(reference.largest)} m. The reference is central differences in f64{extrapolated} with up to "
            f"{reference.steps_per_frame} steps a frame; its own error is about {number(reference.error)}. "
            f"The tolerance is {study.tolerance:g}."
        )
    yield _methods_table(study, study.stepping, METHODS)
    orders = [f"{method} {order:.2f}" for method, order in study.orders.items() if order is not None]
    if orders:
        yield f"Observed orders: {', '.join(orders)}."
    if study.peers:
        yield "SciPy's DOP853 on the same equations:"
        yield table(study.peers, PEERS)
    yield from _bounds([*study.stepping, *study.peers])


def _points(study: Study) -> Iterator[str]:
    yield "## Points"
    reference = "the finest sheet" if study.touches else "the extrapolation, of order 2, of the two finest sheets"
    yield (
        "The error is that made by the number of points, at the points and between them, where the displacement is "
        "interpolated by cubics: the largest anywhere at any frame, as a fraction of the largest displacement. The "
        f"reference is {reference}. All are stepped in f64 with the same "
        "step. The estimate is that of `run`, by a sheet beside it with half the cells a side. "
        "Times are those of each sheet's automatic step."
    )
    yield _sheets_table(study)
    yield from _bounds(study.points)


def _bounds(points: Sequence[Stepping | Peer | Points]) -> Iterator[str]:
    """Explain errors that are upper bounds, if there are any."""
    if any(wrong(one).startswith("<") for one in points):
        yield "An error with < is an approximate upper bound; the reference is not exact enough to know the error."


def _methods_table(study: Study, points: Sequence[Stepping], columns: Columns) -> str:
    best = study.best_stepping
    return table(points, columns, lambda one: "recommended" if one is best else "")


def _drawings_table(study: Study, drawings: Sequence[Drawn]) -> str:
    best = study.best_drawing
    return table(drawings, DRAWINGS, lambda one: "recommended" if one is best else "")


def _sheets_table(study: Study) -> str:
    roles = {tuple(study.settings["sheet"]["points"]): "of the scene", study.more_points: "recommended"}
    return table(study.points, SHEETS, lambda one: roles.get((one.rows, one.cols), ""))


def _drawings(study: Study) -> Iterator[Drawn]:
    """Choose for every supersampling the refinement that would be recommended if the scene had that supersampling."""
    for supersample in sorted({drawn.supersample for drawn in study.drawing}):
        render = {**study.settings["render"], "supersample": supersample}
        best = replace(study, settings={**study.settings, "render": render}).best_drawing
        if best is not None:
            yield best


def _best(points: Sequence[Point], tolerance: float) -> Point | None:
    """Find the fastest point within the tolerance, or else the most exact one."""
    good = [point for point in points if size(point) <= tolerance]
    if good:
        return min(good, key=lambda point: point.seconds.median)
    return min(points, key=size, default=None)
