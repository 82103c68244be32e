"""A study as a picture: work against precision of stepping, drawing and points, and the cost of every term."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, cycle, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox, offset_copy
from numpy.typing import NDArray

from taichi_msm.study.result import Drawn, Peer, Points, Stepping, Study, Timing
from taichi_msm.study.table import duration, number, shown, unit, where
from taichi_msm.system.compiler import named

# The colours of Okabe and Ito, which the colour-blind can tell apart too.
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
INK, GREY, SILVER, PALE = "#222222", "#767676", "#A0A0A0", "#E6E6E6"

# Colour shows the damping difference, dashes and markers the precision.
COLOURS = {"central": BLUE, "backward": VERMILION}
LINES: dict[str, dict[str, Any]] = {
    "f32": {"linestyle": "-", "marker": "o", "markersize": 4.5},
    "f64": {"linestyle": (0, (3.5, 1.8)), "marker": "s", "markersize": 4},
}
PEER_LINE: dict[str, Any] = {"color": INK, "linestyle": ":", "marker": "D", "markersize": 3.8}
RING: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 11,
    "markerfacecolor": "none",
    "markeredgecolor": INK,
    "markeredgewidth": 1,
    "zorder": 5,
}
POINTS_LINE: dict[str, Any] = {"color": BLUE, "linestyle": "-", "marker": "o", "markersize": 4.5}
ESTIMATE: dict[str, Any] = {"color": ORANGE, "linestyle": "none", "marker": "D", "markersize": 3.8}
HOLLOW: dict[str, Any] = {"markerfacecolor": "white"}
HALF: dict[str, Any] = {"fillstyle": "bottom", "markerfacecoloralt": "white"}
SUPERSAMPLES = (SKY, BLUE, GREEN, ORANGE, PURPLE, VERMILION)

STYLE = {
    "font.size": 8,
    "text.color": INK,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": PALE,
    "grid.linewidth": 0.5,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "legend.title_fontsize": 7.5,
}

DPI = 200
WIDE, NARROW, HEADER = 9.0, 6.0, 0.72  # [in]: with two columns, with one, the lines above them

BLANK: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 1}
LABEL: dict[str, Any] = {"textcoords": "offset points", "size": 7, "color": GREY}

AT_MOST = "at most this error"

Panel = Callable[[Axes, Study], None]
Point = Stepping | Peer | Points


def plot(study: Study, path: Path) -> None:
    """Draw the parts that a study has measured.

    Args:
        study: with at least one of the `panels`.
        path: of the PNG.
    """
    with style.context(STYLE, after_reset=True), warnings.catch_warnings():
        # The name of a scene may contain characters that the font lacks.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        _figure(study).savefig(path, format="png")


def panels(study: Study) -> Iterator[tuple[str, Panel]]:
    """List the parts that have something to draw."""
    if any(_drawable(point.error) for point in study.stepping):
        yield "stepping", _plot_stepping
    if any(_drawable(drawn.psnr) for drawn in study.drawing):
        yield "drawing", _plot_drawing
    if any(_drawable(points.error) for points in study.points):
        yield "points", _plot_points
    if study.terms:
        yield "terms", _plot_terms


def _drawable(value: float | None) -> bool:
    """Tell whether a value can be shown on a logarithmic axis."""
    return value is not None and 0 < value < math.inf


def _figure(study: Study) -> Figure:
    shown = dict(panels(study))
    names = list(shown)
    bars = 1.0 + 0.2 * len(study.terms)
    last = bars if names[-1] == "terms" else 0.0
    if len(names) == 4:
        layout: list[Any] = [names[:2], names[2:]]
        rows = [4.4, max(3.0, last)]
    elif len(names) == 3:
        layout = [[names[0], names[1]], [names[0], names[2]]]
        rows = [3.0, last or 3.0]
    else:
        layout = [names]
        rows = [max(4.4 if "stepping" in names else 3.4, last)]
    width, height = WIDE if len(names) > 1 else NARROW, sum(rows) + HEADER
    layout_engine = ConstrainedLayoutEngine(rect=(0.01, 0.01, 0.98, 0.99 - HEADER / height), wspace=0.06, hspace=0.06)
    figure = Figure(figsize=(width, height), dpi=DPI, layout=layout_engine)
    FigureCanvasAgg(figure)
    _write_header(figure, study)
    columns = [1.25, 1] if names[0] == "stepping" and len(names) > 1 else None
    axes = figure.subplot_mosaic(layout, width_ratios=columns, height_ratios=rows)
    for name, panel in shown.items():
        panel(axes[name], study)
    # Labels depend on the sizes of the panels, which are known only now.
    layout_engine.execute(figure)
    figure.set_layout_engine("none")
    if "drawing" in axes:
        _label_refinements(axes["drawing"], study)
    if "points" in axes:
        _label_points(axes["points"], study)
    return figure


def _write_header(figure: Figure, study: Study) -> None:
    """Write above the panels what was studied, on which machine, and with what result."""
    versions = study.machine["versions"]
    machine = f"{where(study)}; taichi-msm {versions['taichi-msm']}, {named(versions)}"
    title = f"{shown(study.scene)}: speed against error"
    step, drawn, own, more = study.best_stepping, study.best_drawing, study.own_points, study.more_points
    advice = []
    if step is not None:
        advice.append(f"step {_duration(step.step)}, {step.damping_difference} damping difference, {step.precision}")
    if drawn is not None:
        advice.append(f"refine {drawn.refine}, supersample {drawn.supersample}")
    said = f"Recommended (ringed): {'; '.join(advice)}. " if advice else ""
    if own is not None and more is not None:
        much = f"{'at most about ' if not own.known else ''}{number(own.error or 0.0)}"
        said += f"{own.name} points make an error of {much}; about {more[0]} x {more[1]} are needed."
    elif study.stepping and step is None:
        said += f"No step measured is within the tolerance of {study.tolerance:g}."
    lines = [
        (title + (" (interrupted)" if study.status == "interrupted" else ""), 11, "bold", INK),
        (machine, 8, "normal", GREY),
        (said, 8, "normal", INK),
    ]
    width, height = figure.get_size_inches()
    for line, (text, size, weight, colour) in enumerate(lines):
        at = 0.12 / width, 1 - (0.1, 0.34, 0.5)[line] / height
        figure.text(*at, text, size=size, weight=weight, color=colour, va="top", parse_math=False)


def _plot_stepping(axes: Axes, study: Study) -> None:
    points = [point for point in study.stepping if _drawable(point.error)]
    peers = [peer for peer in study.peers if _drawable(peer.error)]
    shown: list[Point] = [*points, *peers]
    largest = "" if study.reference is None else f" ({number(study.reference.largest)} m)"
    axes.set(title="Stepping", xscale="log", yscale="log", ylabel="time to step through the scene [s]")
    axes.set_xlabel(f"error, as a fraction of the largest displacement{largest}")
    guides = list(_guides(points, study.orders))
    _span(axes.set_xlim, [*(point.error or 0.0 for point in shown), study.tolerance], 2)
    _span(axes.set_ylim, [*_extremes([*study.stepping, *peers]), *(y for _, line in guides for _, y in line)], 1)
    axes.xaxis.set_minor_formatter(NullFormatter())
    _tick_plainly(axes.yaxis)
    for order, line in guides:
        axes.plot(*zip(*line, strict=True), color=GREY, linewidth=0.7)
        (error, seconds), (other_error, other_seconds) = line
        middle = math.sqrt(error * other_error), math.sqrt(seconds * other_seconds)
        text = f"order {order}"
        if order == 1:
            axes.annotate(text, middle, (3, 3), **LABEL, ha="left", va="bottom", bbox=BLANK)
        else:
            axes.annotate(text, middle, (-3, -3), **LABEL, ha="right", va="top", bbox=BLANK)
    _mark_tolerance(axes, study.tolerance)
    methods = dict.fromkeys(point.method for point in study.stepping)
    handles = [_plot_method(axes, study, method) for method in methods]
    if peers:
        handles.append(_plot_series(axes, peers, PEER_LINE, "SciPy DOP853"))
    best = study.best_stepping
    if best is not None and _drawable(best.error):
        axes.plot([best.error or 0.0], [best.seconds.median], **RING)
    figure = axes.figure
    assert isinstance(figure, Figure)
    axes.legend(
        handles=[*handles, *_marks(study)],
        loc="upper left",
        bbox_to_anchor=(0.0, 0.0),
        bbox_transform=offset_copy(axes.transAxes, figure, 0, -34, units="points"),
        borderaxespad=0,
        ncols=2,
        columnspacing=3,
        handlelength=2.8,
    )


def _mark_tolerance(axes: Axes, tolerance: float) -> None:
    axes.axvline(tolerance, color=GREY, linewidth=0.8, linestyle=(0, (6, 3)))
    top = axes.get_xaxis_transform()
    axes.annotate("tolerance", (tolerance, 1), (-3, 0), xycoords=top, **LABEL, ha="right", va="top", rotation=90)


def _plot_method(axes: Axes, study: Study, method: str) -> Line2D:
    """Draw one method; returns its entry in the legend."""
    points = [point for point in study.stepping if point.method == method]
    line = {**LINES[points[0].precision], "color": COLOURS[points[0].damping_difference]}
    diverged = [point.seconds.median for point in points if point.error is None]
    right = axes.get_yaxis_transform()
    axes.plot([0.985] * len(diverged), diverged, "x", color=line["color"], markersize=4.5, transform=right)
    order = study.orders.get(method)
    label = method if order is None else f"{method}, order {order:.2f}"
    return _plot_series(axes, [point for point in points if _drawable(point.error)], line, label)


def _plot_series(axes: Axes, points: Sequence[Point], line: dict[str, Any], label: str) -> Line2D:
    """Draw a line through points; markers are hollow for upper bounds, and half filled where rounding dominates."""
    errors = [point.error or 0.0 for point in points]
    _plot_spread(axes, errors, [point.seconds for point in points], line["color"], 1)
    axes.plot(errors, [point.seconds.median for point in points], **line, zorder=3)
    for point, error in zip(points, errors, strict=True):
        if not point.known or _mostly_rounding(point):
            axes.plot([error], [point.seconds.median], **line | (HALF if point.known else HOLLOW), zorder=4)
    return Line2D([], [], **line, label=label)


def _mostly_rounding(point: Point) -> bool:
    return isinstance(point, Stepping) and (point.rounding or 0) > (point.error or 0) / 2


def _marks(study: Study) -> Iterator[Line2D]:
    """Give legend entries for the kinds of markers in the picture."""
    every: list[Point] = [*study.stepping, *study.peers]
    points = [point for point in every if _drawable(point.error)]
    dot: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 4.5, "color": GREY}
    if study.best_stepping is not None:
        yield Line2D([], [], **RING | {"markersize": 8}, label="recommended")
    if any(point.known and _mostly_rounding(point) for point in points):
        yield Line2D([], [], **dot, **HALF, label="mostly rounding")
    if not all(point.known for point in points):
        yield Line2D([], [], **dot, **HOLLOW, label=AT_MOST)
    if any(point.error is None for point in study.stepping):
        yield Line2D([], [], **dot | {"marker": "x"}, label="diverged")


def _guides(
    points: Sequence[Stepping], orders: dict[str, float | None]
) -> Iterator[tuple[int, list[tuple[float, float]]]]:
    """Give lines of error ~ step^order beside the points of that order: above them for order 1, below for order 2."""
    # The order in f64 also stands for that in f32, which rounding may hide.
    found = {method.split()[1]: round(order) for method, order in orders.items() if order is not None}
    for order in (1, 2):
        own = [
            (point.error, point.seconds.median)
            for point in points
            if point.error
            and point.known
            and not _mostly_rounding(point)
            and found.get(point.damping_difference) == order
        ]
        if own:
            levels = [seconds * error ** (1 / order) for error, seconds in own]
            level = 1.5 * max(levels) if order == 1 else min(levels) / 1.5
            ends = max(error for error, _ in own), min(error for error, _ in own)
            yield order, [(error, level * error ** (-1 / order)) for error in ends]


def _plot_drawing(axes: Axes, study: Study) -> None:
    drawings = [drawn for drawn in study.drawing if _drawable(drawn.psnr)]
    axes.set(
        title="Drawing", yscale="log", xlabel="PSNR of the most deformed frame [dB]", ylabel="time of a frame [ms]"
    )
    axes.margins(x=0.1)
    _span(axes.set_ylim, [1e3 * seconds for seconds in _extremes(drawings)], 0.8)
    _tick_plainly(axes.yaxis)
    for own, colour in zip(_by_supersample(study), cycle(SUPERSAMPLES)):
        _plot_spread(axes, [drawn.psnr or 0.0 for drawn in own], [drawn.seconds for drawn in own], colour, 1e3)
        places = zip(*map(_place, own), strict=True)
        axes.plot(*places, color=colour, marker="o", markersize=4, zorder=3, label=str(own[0].supersample))
    best = study.best_drawing
    if best is not None and _drawable(best.psnr):
        axes.plot(*_place(best), **RING)
    axes.legend(title="supersample", loc="lower right", ncols=2, columnspacing=1.4)


def _by_supersample(study: Study) -> list[list[Drawn]]:
    """Group the drawings into one line for each supersampling."""
    drawings = [drawn for drawn in study.drawing if _drawable(drawn.psnr)]
    supersamples = sorted({drawn.supersample for drawn in drawings})
    return [[drawn for drawn in drawings if drawn.supersample == supersample] for supersample in supersamples]


def _label_refinements(axes: Axes, study: Study) -> None:
    """Label each point with its refinement, where there is room; the recommended one first."""
    lines, best = _by_supersample(study), study.best_drawing
    # Lengths are in typographic points.
    paths = [axes.transData.transform([_place(drawn) for drawn in line]) * 72 / DPI for line in lines]
    taken = [_legend(axes), *(Bbox.from_bounds(x - 2, y - 2, 4, 4) for path in paths for x, y in _dots(path))]
    points = zip(chain(*lines), chain(*paths), strict=True)
    for drawn, (x, y) in sorted(points, key=lambda point: point[0] is not best):
        text = f"refine {drawn.refine}" if drawn is best else str(drawn.refine)
        away = 9 if drawn is best else 5
        width = 4.3 * len(text)
        for side, left in (("right", -away - width), ("left", away)):
            box = Bbox.from_bounds(x + left, y - 3, width, 6)
            if _has_room(axes, box, taken):
                axes.annotate(text, _place(drawn), (-away if left < 0 else away, 0), **LABEL, ha=side, va="center")
                taken.append(box)
                break
        if drawn is best:
            taken.append(Bbox.from_bounds(x - 6, y - 6, 12, 12))


def _legend(axes: Axes) -> Bbox:
    """Give the place of a panel's legend, in typographic points."""
    legend = axes.get_legend()
    assert legend is not None
    return Bbox(legend.get_window_extent().get_points() * 72 / DPI)


def _has_room(axes: Axes, box: Bbox, taken: Sequence[Bbox]) -> bool:
    """Tell whether a label is within its panel, so that it covers no ticks, and covers nothing that is drawn there."""
    panel = Bbox(axes.bbox.get_points() * 72 / DPI)
    return all(panel.contains(*corner) for corner in (box.p0, box.p1)) and not box.count_overlaps(taken)


def _place(drawn: Drawn) -> tuple[float, float]:
    return drawn.psnr or 0.0, 1e3 * drawn.seconds.median


def _dots(path: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Give positions along a line, about every two typographic points."""
    yield path[0]
    for start, end in pairwise(path):
        yield from np.linspace(start, end, 2 + int(np.linalg.norm(end - start) / 2))


def _plot_points(axes: Axes, study: Study) -> None:
    points = [one for one in study.points if _drawable(one.error)]
    estimated = [one for one in points if _drawable(one.estimate)]
    axes.set(title="Points", xscale="log", yscale="log", ylabel="time of the scene [s]")
    axes.set_xlabel("error, as a fraction of the largest displacement")
    errors = [*(one.error or 0.0 for one in points), *(one.estimate or 0.0 for one in estimated)]
    _span(axes.set_xlim, [*errors, study.points_tolerance], 2)
    _span(axes.set_ylim, _extremes(points), 1)
    axes.xaxis.set_minor_formatter(NullFormatter())
    _tick_plainly(axes.yaxis)
    _mark_tolerance(axes, study.points_tolerance)
    handles = [_plot_series(axes, points, POINTS_LINE, "error")]
    for one in points:
        if (one.rows, one.cols) == study.more_points:
            axes.plot([one.error or 0.0], [one.seconds.median], **RING)
    for one in estimated:
        height = one.seconds.median
        axes.plot([one.error or 0.0, one.estimate or 0.0], [height] * 2, color=ORANGE, linewidth=0.7)
        axes.plot([one.estimate or 0.0], [height], **ESTIMATE)
    if estimated:
        handles.append(Line2D([], [], **ESTIMATE, label="estimated by run"))
    if not all(one.known for one in points):
        handles.append(Line2D([], [], **POINTS_LINE | {"color": GREY, "linestyle": "none"} | HOLLOW, label=AT_MOST))
    axes.legend(handles=handles, loc="upper right", handlelength=2.2)


def _label_points(axes: Axes, study: Study) -> None:
    """Label each sheet with its number of points, where there is room; the scene's own in bold."""
    points = [one for one in study.points if _drawable(one.error)]
    places = [(one.error or 0.0, one.seconds.median) for one in points]
    estimates = [(one.estimate or error, height) for one, (error, height) in zip(points, places, strict=True)]
    # Lengths are in typographic points.
    spreads = [(error, time) for (error, _), one in zip(places, points, strict=True) for time in _extremes([one])]
    path, ends, spread = (axes.transData.transform(each) * 72 / DPI for each in (places, estimates, spreads))
    strokes = [*zip(path, ends, strict=True), *zip(spread[::2], spread[1::2], strict=True)]
    dots = chain(_dots(path), *(_dots(np.array(stroke)) for stroke in strokes))
    taken = [_legend(axes), *(Bbox.from_bounds(x - 2.5, y - 2.5, 5, 5) for x, y in dots)]
    for one, place, (x, y), (end, _) in zip(points, places, path, ends, strict=True):
        own = [one.rows, one.cols] == list(study.settings["sheet"]["points"])
        width = (4.3 if own else 4.0) * len(one.name)
        right, left = max(x, end) - x + 6, min(x, end) - x - 6
        sides = [(right, 0, "left"), (4, 8, "left"), (-4, -8, "right"), (left, 0, "right")]
        for across, up, side in sides:
            box = Bbox.from_bounds(x + across - (width if side == "right" else 0), y + up - 3.5, width, 7)
            if _has_room(axes, box, taken):
                look = {**LABEL, "weight": "bold", "color": INK} if own else LABEL
                axes.annotate(one.name, place, (across, up), **look, ha=side, va="center")
                taken.append(box)
                break


def _plot_terms(axes: Axes, study: Study) -> None:
    scale, name = unit(study.terms[0].seconds.median)
    rows = range(len(study.terms))
    times = [scale * term.seconds.median for term in study.terms]
    colours = [SKY if term.without else SILVER for term in study.terms]
    axes.barh(rows, times, height=0.6, color=colours)
    for row, term in zip(rows, study.terms, strict=True):
        fastest, slowest = scale * term.seconds.fastest, scale * term.seconds.slowest
        axes.plot([fastest, slowest], [row, row], color=INK, linewidth=0.8)
        axes.annotate(number(times[row]), (slowest, row), (3, 0), **LABEL, va="center", bbox=BLANK)
    axes.axvline(times[0], color=GREY, linewidth=0.7, linestyle=(0, (6, 3)), zorder=0)
    names = [f"without {term.without}" if term.without else "whole step" for term in study.terms]
    axes.set_yticks(rows, names)
    axes.set(title="Terms", xlabel=f"time of a step [{name.replace('us', 'µs')}]")
    axes.set_xlim(0, 1.12 * scale * max(term.seconds.slowest for term in study.terms))
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)


def _plot_spread(axes: Axes, at: Sequence[float], times: Sequence[Timing], colour: str, scale: float) -> None:
    """Draw a thin line from the fastest to the slowest run of every point."""
    lows, highs = [scale * time.fastest for time in times], [scale * time.slowest for time in times]
    axes.vlines(at, lows, highs, color=colour, linewidth=0.7, alpha=0.6)


def _extremes(points: Iterable[Point | Drawn]) -> Iterator[float]:
    """List the fastest and slowest times [s]."""
    for point in points:
        yield from (point.seconds.fastest, point.seconds.slowest)


def _span(set_limits: Callable[[float, float], object], values: Iterable[float], least: float) -> None:
    """Make a logarithmic axis span the values with a margin, and at least `least` decades."""
    exponents = [math.log10(value) for value in values if value > 0]
    low, high = min(exponents), max(exponents)
    room = max(0.07 * (high - low), (least - (high - low)) / 2)
    set_limits(10 ** (low - room), 10 ** (high + room))


def _tick_plainly(axis: Axis) -> None:
    """Label an axis with 0.05 rather than 5 x 10^-2."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 300 else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _duration(seconds: float) -> str:
    """Write a time with its unit in typeset form."""
    return duration(seconds).replace("us", "µs")
