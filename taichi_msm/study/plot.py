"""Figure of a study: work-precision diagrams of stepping, drawing and meshes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, TypeVar

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import offset_copy

from taichi_msm.errors import printable
from taichi_msm.integrators import INTEGRATORS
from taichi_msm.plot_style import (
    BLUE,
    DPI,
    GREEN,
    GREY,
    INK,
    ONE_COLUMN_WIDTH,
    ORANGE,
    PURPLE,
    SKY,
    STYLE,
    TWO_COLUMN_WIDTH,
    VERMILION,
)
from taichi_msm.study.format import ErrorMeasurement, format_number, machine_summary
from taichi_msm.study.result import DrawingMeasurement, Measurement, Study
from taichi_msm.system.compiler import compiler_label

# Colours encode the damping difference, dashes and markers the precision.
DIFFERENCE_COLOURS = dict(zip(INTEGRATORS, (BLUE, VERMILION, GREEN, PURPLE), strict=False))
PRECISION_LINES: dict[str, dict[str, Any]] = {
    "f32": {"linestyle": "-", "marker": "o"},
    "f64": {"linestyle": (0, (3.5, 1.8)), "marker": "s"},
}
TOLERANCE_LINE: dict[str, Any] = {"color": GREY, "linewidth": 0.8, "linestyle": (0, (6, 3))}
RECOMMENDED_MARKER: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 11, "mfc": "none", "mec": INK, "zorder": 5}
BOUND_MARKER: dict[str, Any] = {"mfc": "white"}
LEGEND_MARKER: dict[str, Any] = {"linestyle": "none", "marker": "o", "color": GREY}
SUPERSAMPLE_COLOURS = (SKY, BLUE, GREEN, ORANGE, PURPLE, VERMILION)
MARKERS = "osD^vPX"

# Mosaic by the number of panels.
PANEL_MOSAICS = {1: "A", 2: "AB", 3: "AB;AC"}

Panel = Callable[[Axes, Study], None]
AnyMeasurement = ErrorMeasurement | DrawingMeasurement
M = TypeVar("M", bound=AnyMeasurement)


def plot(study: Study, path: Path) -> None:
    """Plot the measured parts of a study, at least one panel, as a PNG."""
    with style.context(STYLE, after_reset=True), warnings.catch_warnings():
        # The name of a scene may contain characters that the font lacks.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        _figure(study).savefig(path, format="png")


def panels(study: Study) -> list[Panel]:
    """Return the plot function of each panel that has data to plot."""
    candidates = (_plot_stepping, study.stepping), (_plot_drawing, study.drawing), (_plot_meshes, study.points)
    return [panel for panel, points in candidates if any(0 < _coordinates(point)[0] < math.inf for point in points)]


def _coordinates(point: AnyMeasurement) -> tuple[float, float]:
    """Return the error and the time [s] of a measurement, or for drawing the PSNR [dB] and the time [ms]."""
    if isinstance(point, DrawingMeasurement):
        return point.psnr or 0.0, 1e3 * point.seconds.median
    return point.error or 0.0, point.seconds.median


def _drawable(points: Iterable[M | None]) -> list[M]:
    """Return the measurements whose error or PSNR is on a logarithmic axis."""
    return [point for point in points if point is not None and 0 < _coordinates(point)[0] < math.inf]


def _figure(study: Study) -> Figure:
    study_panels = panels(study)
    layout = PANEL_MOSAICS[len(study_panels)]
    width = TWO_COLUMN_WIDTH if len(study_panels) > 1 else ONE_COLUMN_WIDTH
    size = width, 4.2 * (layout.count(";") + 1) + 0.5
    figure = Figure(figsize=size, dpi=DPI, layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1, wspace=0.05))
    state = " (interrupted)" if study.status == "interrupted" else ""
    figure.suptitle(f"{printable(study.scene)}: speed against error{state}", x=0.01, ha="left", parse_math=False)
    versions = study.machine["versions"]
    machine = f"{machine_summary(study)}; taichi-msm {versions['taichi-msm']}, {compiler_label(versions)}"
    figure.supxlabel(
        f"{_recommendation_line(study)}\n{machine}", x=0.01, ha="left", size=8, parse_math=False, wrap=True
    )
    axes = figure.subplot_mosaic(layout)
    for name, panel in zip("ABC", study_panels, strict=False):
        panel(axes[name], study)
    return figure


def _recommendation_line(study: Study) -> str:
    settings = [line.strip() for line in study.recommendation() if not line.endswith(":")]
    if study.recommended_points is None and study.best_stepping is None:
        settings.append(f"no measured step is within the tolerance of {study.tolerance:g}")
    return f"Recommended (ringed where measured): {'; '.join(settings)}" if study.stepping else ""


def _plot_stepping(axes: Axes, study: Study) -> None:
    largest = "" if study.reference is None else f" ({format_number(study.reference.largest)} m)"
    axes.set(title="Stepping", ylabel="time to step through the scene [s]")
    axes.set_xlabel(f"error, as a fraction of the largest displacement{largest}")
    handles = []
    for method in dict.fromkeys(point.method for point in study.stepping):
        points = [point for point in study.stepping if point.method == method]
        line = PRECISION_LINES[points[0].precision] | {"color": DIFFERENCE_COLOURS[points[0].damping_difference]}
        order = study.orders.get(method)
        handles.append(_plot_line(axes, points, line, method if order is None else f"{method}, order {order:.2f}"))
        diverged = [point.seconds.median for point in points if point.error is None]
        right = axes.get_yaxis_transform()
        axes.plot([0.985] * len(diverged), diverged, "x", color=line["color"], transform=right)
    for best in _drawable([study.best_stepping]):
        axes.plot(*_coordinates(best), **RECOMMENDED_MARKER)
    _scale_errors(axes, study.stepping, study.tolerance)
    _legend(axes, [*handles, *_marker_legend(study)])


def _plot_line(axes: Axes, points: Sequence[ErrorMeasurement], line: dict[str, Any], label: str) -> Line2D:
    """Plot a line through measurements; return its legend handle."""
    points = _drawable(points)
    _plot_times(axes, points, line)
    for point in points:
        if not point.known:
            axes.plot(*_coordinates(point), **line | BOUND_MARKER, zorder=4)
    return Line2D([], [], **line, label=label)


def _marker_legend(study: Study) -> Iterator[Line2D]:
    """Yield a legend handle for each kind of marker in the panel of stepping."""
    yield Line2D([], [], **TOLERANCE_LINE, label="tolerance")
    if study.best_stepping is not None:
        yield Line2D([], [], **RECOMMENDED_MARKER | {"ms": 8}, label="recommended")
    if any(not point.known for point in _drawable(study.stepping)):
        yield Line2D([], [], **LEGEND_MARKER | BOUND_MARKER, label="at most this error")
    if any(point.error is None for point in study.stepping):
        yield Line2D([], [], **LEGEND_MARKER | {"marker": "x"}, label="diverged")


def _plot_drawing(axes: Axes, study: Study) -> None:
    drawings = _drawable(study.drawing)
    axes.set(title="Drawing", xlabel="PSNR of the most deformed frame [dB]", ylabel="time of a frame [ms]")
    axes.margins(x=0.1)
    colours = dict(zip(sorted({drawing.supersample for drawing in drawings}), cycle(SUPERSAMPLE_COLOURS)))
    markers = dict(zip(sorted({drawing.refine for drawing in drawings}), cycle(MARKERS)))
    for supersample, colour in colours.items():
        series = [drawing for drawing in drawings if drawing.supersample == supersample]
        line = {"color": colour, "linewidth": 0.8}
        _plot_times(axes, series, line, 1e3)
    for drawing in drawings:
        marker = {"color": colours[drawing.supersample], "marker": markers[drawing.refine], **BOUND_MARKER}
        axes.plot(*_coordinates(drawing), **marker, zorder=3)
    for best in _drawable([study.best_drawing]):
        axes.plot(*_coordinates(best), **RECOMMENDED_MARKER)
    _scale(axes, "y", [1e3 * seconds for seconds in _extremes(drawings)], 0.8)
    handles = [Line2D([], [], color=colour, label=f"supersample {n}") for n, colour in colours.items()]
    handles += [
        Line2D([], [], **LEGEND_MARKER | BOUND_MARKER | {"marker": m}, label=f"refine {n}") for n, m in markers.items()
    ]
    _legend(axes, handles, 3)


def _plot_meshes(axes: Axes, study: Study) -> None:
    meshes = _drawable(study.points)
    axes.set(title="Points", ylabel="time of the scene [s]")
    axes.set_xlabel("error, as a fraction of the largest displacement")
    axes.plot(*zip(*map(_coordinates, meshes), strict=True), color=BLUE)
    handles = []
    for mesh, marker in zip(meshes, cycle(MARKERS)):
        line = {"color": BLUE, "linestyle": "none", "marker": marker} | ({} if mesh.known else BOUND_MARKER)
        role, bound = " (the scene)" if mesh is study.scene_mesh else "", "" if mesh.known else ", at most"
        handles.append(_plot_line(axes, [mesh], line, f"{mesh.name}{role}{bound}"))
        if (mesh.rows, mesh.cols) == study.recommended_points:
            axes.plot(*_coordinates(mesh), **RECOMMENDED_MARKER)
    _scale_errors(axes, meshes, study.mesh_tolerance)
    _legend(axes, [*handles, Line2D([], [], **TOLERANCE_LINE, label="tolerance")])


def _plot_times(axes: Axes, points: Sequence[AnyMeasurement], line: dict[str, Any], scale: float = 1) -> None:
    """Plot a line through the medians of the times, and thin bars from the fastest to the slowest time."""
    x, times = [_coordinates(point)[0] for point in points], [point.seconds for point in points]
    axes.plot(x, [scale * each.median for each in times], **line, zorder=3)
    fastest, slowest = [scale * each.fastest for each in times], [scale * each.slowest for each in times]
    axes.vlines(x, fastest, slowest, color=line["color"], linewidth=0.7, alpha=0.6)


def _extremes(points: Iterable[Measurement]) -> Iterator[float]:
    for point in points:
        yield from (point.seconds.fastest, point.seconds.slowest)


def _scale_errors(axes: Axes, points: Sequence[ErrorMeasurement], tolerance: float) -> None:
    """Scale the axes to times and errors, and mark the tolerance."""
    axes.axvline(tolerance, **TOLERANCE_LINE)
    _scale(axes, "x", [*(point.error or 0.0 for point in points), tolerance], 2)
    _scale(axes, "y", _extremes(points), 1)


def _scale(axes: Axes, axis: str, values: Iterable[float], min_decades: float) -> None:
    """Set a logarithmic scale of an axis, with a margin around the values and at least `min_decades` decades."""
    exponents = [math.log10(value) for value in values if 0 < value < math.inf]
    low, high = min(exponents), max(exponents)
    margin = max(0.07 * (high - low), (min_decades - (high - low)) / 2)
    axes.set(**{f"{axis}scale": "log", f"{axis}lim": (10 ** (low - margin), 10 ** (high + margin))})
    ticks: Axis = getattr(axes, f"{axis}axis")
    if axis == "y":
        # Format 0.05, not 5 x 10^-2.
        ticks.set_major_locator(LogLocator(subs=(1, 2, 5) if high - low + 2 * margin < 2.5 else (1,)))
        ticks.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ticks.set_minor_formatter(NullFormatter())


def _legend(axes: Axes, handles: Sequence[Line2D], columns: int = 2) -> None:
    """Add a legend below the panel and its label, as wide as the panel."""
    figure = axes.figure
    assert isinstance(figure, Figure)
    axes.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0, 0, 1, 0),
        bbox_transform=offset_copy(axes.transAxes, figure, 0, -42, units="points"),
        mode="expand",
        borderaxespad=0,
        ncols=columns,
        handlelength=2.2,
    )
