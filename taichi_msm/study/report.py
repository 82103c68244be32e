"""Report of a study: JSON, a page in Markdown, a figure, and the summary for the terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from taichi_msm.errors import printable, writing
from taichi_msm.runs.directory import hidden_folder
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.study.format import (
    Columns,
    ErrorMeasurement,
    comparable_error,
    format_duration,
    format_error,
    format_number,
    format_table,
    format_timing,
    machine_summary,
)
from taichi_msm.study.result import Measurement, Reference, SteppingMeasurement, Study, Timing
from taichi_msm.system.compiler import compiler_label

PICTURE_FILE, PAGE_FILE, RECORD_FILE = "study.png", "study.md", "study.json"

WITHOUT_MATPLOTLIB = "study.png needs matplotlib: pip install matplotlib"


def require_writable(directory: Path) -> None:
    """Raise a FilesError if a directory cannot be written."""
    with writing(directory), hidden_folder(directory):
        pass


def write_report(study: Study, directory: Path) -> list[str]:
    """Write the report of a study, in place of an earlier one; other files in the directory remain.

    Return the names of the files, each written atomically, study.json last. The study receives a note if the figure
    cannot be plotted.
    """
    with writing(directory), hidden_folder(directory) as hidden:
        outputs = [*([PICTURE_FILE] if _draw(study, hidden / PICTURE_FILE) else []), PAGE_FILE, RECORD_FILE]
        record = json.dumps({**study_record(study), "outputs": outputs}, indent=2, ensure_ascii=False, allow_nan=False)
        for file, text in ((PAGE_FILE, format_page(study)), (RECORD_FILE, record + "\n")):
            # File names that are not UTF-8 get backslash escapes, which are also valid in JSON.
            (hidden / file).write_text(text, encoding="utf-8", errors="backslashreplace", newline="")
        if PICTURE_FILE not in outputs:
            (directory / PICTURE_FILE).unlink(missing_ok=True)
        for output in outputs:
            (hidden / output).replace(directory / output)
    return outputs


def study_record(study: Study) -> dict[str, Any]:
    """Convert a study to JSON data; non-finite numbers become null."""
    return {**_as_data(vars(study)), "recommendation": study.recommendation()}


def _as_data(value: Any) -> Any:
    if isinstance(value, Measurement):
        method = {"method": value.method} if isinstance(value, SteppingMeasurement) else {}
        fields = {key: inner for key, inner in vars(value).items() if key != "samples"}
        return _as_data({**method, **fields, "seconds": value.seconds})
    if isinstance(value, (Reference, Timing)):
        return _as_data(vars(value))
    if isinstance(value, dict):
        return {key: _as_data(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_data(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _draw(study: Study, path: Path) -> bool:
    """Plot the figure if Matplotlib is installed and there are data to plot; return whether it was plotted."""
    try:
        from taichi_msm.study.plot import panels, plot

        if panels(study):
            plot(study, path)
            return True
    except ImportError:
        if WITHOUT_MATPLOTLIB not in study.notes:
            study.notes.append(WITHOUT_MATPLOTLIB)
    except Exception as error:
        # A failing plot must not discard minutes of measurements.
        study.notes.append(f"study.png could not be drawn: {type(error).__name__}: {error}")
    return False


STEPPING_COLUMNS: Columns = {
    "method": lambda point: point.method,
    "step": lambda point: format_duration(point.step),
    "steps/frame": lambda point: str(point.steps_per_frame),
    "error": format_error,
    "of it rounding": lambda point: "" if point.rounding is None else format_number(point.rounding),
    "time of the scene": lambda point: format_timing(point.seconds),
}
DRAWING_COLUMNS: Columns = {
    "refine": lambda drawing: str(drawing.refine),
    "supersample": lambda drawing: str(drawing.supersample),
    "PSNR": lambda drawing: "equal" if drawing.psnr is None else f"{drawing.psnr:.1f} dB",
    "largest error": lambda drawing: str(drawing.largest_error),
    "time of a frame": lambda drawing: format_timing(drawing.seconds),
}
MESH_COLUMNS: Columns = {
    "points": lambda mesh: mesh.name,
    "steps/frame": lambda mesh: str(mesh.steps_per_frame),
    "error": format_error,
    "time of the scene": lambda mesh: format_timing(mesh.seconds),
}


def format_page(study: Study) -> str:
    """Format the page of a study in Markdown."""
    versions = study.machine["versions"]
    state = "" if study.status == "complete" else f" ({study.status})"
    blocks = [
        f"# {printable(study.scene)}: speed against error{state}",
        f"Measured on {machine_summary(study)}, with taichi-msm {versions['taichi-msm']}, {compiler_label(versions)}, "
        f"NumPy {versions['numpy']} and Python {versions['python']} ({versions['platform']}). "
        "Times are medians, with the fastest and the slowest in brackets.",
        *(_stepping_section(study) if study.stepping else ()),
    ]
    if study.drawing:
        blocks += [
            "## Drawing",
            "The most deformed frame, against a picture of high refinement and supersampling. The largest error is of "
            "any colour of any pixel, from 0 to 255.",
            _table(study.drawing, DRAWING_COLUMNS, study.best_drawing),
        ]
    if study.points:
        blocks += _mesh_section(study)
    if study.notes:
        blocks += ["## Notes", "\n".join(f"- {note}" for note in study.notes)]
    blocks += ["## Recommendation", *remarks(study)]
    if lines := study.recommendation():
        blocks.append("\n".join(["```yaml", *lines, "```"]))
    return "\n\n".join(blocks) + "\n"


def format_summary(study: Study) -> str:
    """Format the main results, and the recommended lines of a scene file, for the terminal."""
    lines = [f"{printable(study.scene)} on {machine_summary(study)}"]
    if study.reference is not None:
        lines.append(
            "error: the largest of any point at any frame, as a fraction of "
            f"{format_number(study.reference.largest)} m; tolerance {study.tolerance:g}"
        )
    methods = dict.fromkeys(point.method for point in study.stepping)
    best = (_best([point for point in study.stepping if point.method == method], study.tolerance) for method in methods)
    fastest = [point for point in best if point]
    blocks = ["\n".join(lines)]
    if fastest:
        names = "method", "step", "error", "time of the scene"
        blocks.append(_table(fastest, {name: STEPPING_COLUMNS[name] for name in names}, study.best_stepping))
    if study.drawing:
        best_drawings = map(study.best_refinement, sorted({drawing.supersample for drawing in study.drawing}))
        blocks.append(_table([drawing for drawing in best_drawings if drawing], DRAWING_COLUMNS, study.best_drawing))
    if study.points:
        blocks.append(_meshes_table(study))
    notes = [f"note: {printable(note)}" for note in study.notes]
    if remark_lines := [*notes, *_explain_bounds([*fastest, *study.points]), *remarks(study)]:
        blocks.append("\n".join(remark_lines))
    if recommended := study.recommendation():
        blocks += ["Recommended settings of the scene:", "\n".join(recommended)]
    return "\n\n".join(blocks)


def remarks(study: Study) -> Iterator[str]:
    """Yield remarks on a missing step and on the discretisation error of the mesh."""
    mesh, recommended = study.scene_mesh, study.recommended_points
    if recommended is None and study.best_stepping is None:
        yield _explain_shortfall(study)
    if mesh is None:
        return
    bound = f"{'' if mesh.known else 'at most about '}{format_number(mesh.error or 0.0)}"
    if recommended is None:
        step = study.best_stepping
        step_error = "" if step is None else f", and the recommended step of {format_number(step.error or 0.0)}"
        yield f"{mesh.name} points have an error of {bound}{step_error}; the tolerance is {study.mesh_tolerance:g}."
        return
    rows, cols = recommended
    points = f"{rows} x {cols}"
    if max(recommended) > MAX_POINTS:
        advice = (
            f"About {points} would be within it, more than the {MAX_POINTS} a side of a scene: take a wider "
            "tool (probes.N.radius, a smaller falloff), or allow a larger error with --tolerance."
        )
    else:
        measured = any((each.rows, each.cols) == recommended for each in study.points)
        sufficient = f"{points} are within it" if measured else f"Take about {points} (extrapolated, not measured)"
        advice = f"{sufficient}; with time.tolerance a run finds the step for them."
    yield (
        f"{mesh.name} points have an error of {bound}, which no step reduces; the tolerance is "
        f"{study.mesh_tolerance:g}. {advice}"
    )


def _explain_shortfall(study: Study) -> str:
    """Return the reason why no step is recommended, and the remedy."""
    closest = _best(study.stepping, study.tolerance)
    if closest is None:
        return "No step is recommended: none was measured."
    reason = f"No measured step is within the tolerance of {study.tolerance:g}"
    if closest.error is None:
        reason += ": all diverged."
    else:
        step, error = format_duration(closest.step), format_error(closest)
        reason += f"; the closest is {closest.method} at {step}, with an error of {error}."
    return (
        f"{reason} Set time.tolerance, with which a run searches for a finer step itself, and time.precision: f64; "
        "or allow a larger error with --tolerance."
    )


def _stepping_section(study: Study) -> Iterator[str]:
    yield "## Stepping"
    if (reference := study.reference) is not None:
        extrapolated = ", not extrapolated as contact is of order 1," if study.has_contact else ", extrapolated,"
        yield (
            "An error is the largest of any point at any frame, as a fraction of the largest displacement, "
            f"{format_number(reference.largest)} m. The reference is central differences in f64{extrapolated} with up "
            f"to {reference.steps_per_frame} steps a frame; its own error is about {format_number(reference.error)}. "
            f"The tolerance is {study.tolerance:g}."
        )
    yield _table(study.stepping, STEPPING_COLUMNS, study.best_stepping)
    orders = [f"{method} {order:.2f}" for method, order in study.orders.items() if order is not None]
    if orders:
        yield f"Observed orders: {', '.join(orders)}."
    yield from _explain_bounds(study.stepping)


def _mesh_section(study: Study) -> Iterator[str]:
    yield "## Points"
    reference = "the finest mesh" if study.has_contact else "the extrapolation, of order 2, of the two finest meshes"
    yield (
        "The error is the discretisation error of the mesh, at the points and between them, where the displacement is "
        "interpolated by cubics: the largest anywhere at any frame, as a fraction of the largest displacement. The "
        f"reference is {reference}. All are stepped in f64 with the same step. Times are those of each mesh's "
        "automatic step."
    )
    yield _meshes_table(study)
    yield from _explain_bounds(study.points)


def _explain_bounds(points: Sequence[ErrorMeasurement]) -> Iterator[str]:
    """Yield an explanation of upper bounds, if an error is one."""
    if any(format_error(point).startswith("<") for point in points):
        yield "An error with < is an approximate upper bound, as the reference is not accurate enough."


def _table(measurements: Sequence[Measurement], columns: Columns, best: Measurement | None) -> str:
    return format_table(measurements, columns, lambda each: "recommended" if each is best else "")


def _meshes_table(study: Study) -> str:
    roles = {tuple(study.settings["sheet"]["points"]): "of the scene", study.recommended_points: "recommended"}
    return format_table(study.points, MESH_COLUMNS, lambda mesh: roles.get((mesh.rows, mesh.cols), ""))


def _best(points: Sequence[SteppingMeasurement], tolerance: float) -> SteppingMeasurement | None:
    """Return the fastest measurement within the tolerance, otherwise the most accurate one."""
    sufficient = [point for point in points if comparable_error(point) <= tolerance]
    if sufficient:
        return min(sufficient, key=lambda point: point.seconds.median)
    return min(points, key=comparable_error, default=None)
