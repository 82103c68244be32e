"""Plots of time against size, refinement and resolution, in the style of `taichi-msm study`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from benchmarks.drawing.problem import POINTS
from taichi_msm.plot_style import (
    BLUE,
    DPI,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    STYLE,
    TWO_COLUMN_WIDTH,
    VERMILION,
)
from taichi_msm.study.result import Timing

COLOURS = {"taichi_msm": BLUE, "C++, OpenMP": VERMILION, "Numba": GREEN}
MARKERS = {"taichi_msm": "o", "C++, OpenMP": "s", "Numba": "D"}
OTHERS = (ORANGE, PURPLE, INK)
HEIGHT = 3.4

Results = dict[str, Any]
Series = dict[str, dict[float, Timing]]


def draw(results: Results, folder: Path) -> None:
    """Write the plots of all measured parts."""
    if "size" in results:
        _figure(results, (_per_step, _per_point), folder / "performance-size.png")
    if "refine" in results and "resolution" in results:
        _figure(results, (_refine, _resolution), folder / "performance-drawing.png")


def _figure(results: Results, panels: tuple[Callable[[Axes, Results], None], ...], path: Path) -> None:
    with style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(TWO_COLUMN_WIDTH, HEIGHT), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        for panel, axes in zip(panels, figure.subplots(1, len(panels), squeeze=False)[0], strict=True):
            panel(axes, results)
        figure.savefig(path, format="png")


def _per_step(axes: Axes, results: Results) -> None:
    axes.set(title="Time of a step", ylabel="µs")
    _plot_sizes(axes, results, lambda points: 1e6)


def _per_point(axes: Axes, results: Results) -> None:
    axes.set(title="Time of a step and a point", ylabel="ns")
    _plot_sizes(axes, results, lambda points: 1e9 / points**2)


def _plot_sizes(axes: Axes, results: Results, scale: Callable[[float], float]) -> None:
    series = _by_peer(results["size"])
    _plot(axes, series, scale)
    axes.set_xlabel("n, of n × n mass points")
    _tick_at(axes.xaxis, sorted({at for times in series.values() for at in times}))
    axes.legend(loc="best")


def _refine(axes: Axes, results: Results) -> None:
    # The axis is of vertices, as refine can be 0 on a logarithmic axis.
    cells = POINTS - 1
    series = _by_peer({str(cells * (int(refine) + 1) + 1): entries for refine, entries in results["refine"].items()})
    axes.set(title="Drawing against refinement", ylabel="ms", xlabel="refine; 512 × 512 pixels")
    _plot(axes, series, lambda n: 1e3)
    # Times are almost equal: an axis without 0 would magnify noise.
    axes.set_yscale("linear")
    axes.set_ylim(bottom=0)
    _tick_at(axes.xaxis, sorted(series["taichi_msm"]), lambda vertices: (vertices - 1) / cells - 1)


def _resolution(axes: Axes, results: Results) -> None:
    series = _by_peer(results["resolution"])
    axes.set(title="Drawing against resolution", ylabel="ms", xlabel="n, of n × n pixels; 331 × 331 vertices")
    _plot(axes, series, lambda n: 1e3)
    _tick_at(axes.xaxis, sorted(series["taichi_msm"]))


def _by_peer(measured: dict[str, list[Results]]) -> Series:
    """Return a line for every peer from the entries of every size."""
    series: Series = {}
    for at, entries in measured.items():
        for entry in entries:
            if entry["samples"]:
                series.setdefault(entry["name"], {})[float(at)] = Timing.of(entry["samples"])
    return series


def _plot(axes: Axes, series: Series, scale: Callable[[float], float]) -> None:
    """Draw a line of medians for every peer, with bars from the fastest to the slowest round."""
    for (name, times), default in zip(series.items(), OTHERS, strict=False):
        at, colour = sorted(times), COLOURS.get(name, default)
        lows, highs = ([scale(n) * getattr(times[n], end) for n in at] for end in ("fastest", "slowest"))
        axes.vlines(at, lows, highs, color=colour, linewidth=0.7, alpha=0.6)
        medians = [scale(n) * times[n].median for n in at]
        axes.plot(at, medians, color=colour, marker=MARKERS.get(name, "o"), markersize=4.5, label=name, zorder=3)
    axes.set_xscale("log")
    axes.set_yscale("log")
    _tick_plainly(axes.yaxis)


def _tick_at(axis: Axis, ticks: list[float], name: Callable[[float], float] = lambda value: value) -> None:
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{name(value):g}"))


def _tick_plainly(axis: Axis) -> None:
    """Write 0.05 rather than 5 x 10^-2."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 300 else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
