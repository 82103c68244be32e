"""fit.png: observations against the fit, residuals, profiles of parameters, and the panels of a map."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import BinaryIO

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, ScalarFormatter
from numpy.typing import NDArray

from taichi_msm.errors import printable
from taichi_msm.fitting.result import FitResult, FittedMap
from taichi_msm.fitting.tikhonov import SmoothnessWeight
from taichi_msm.plot_style import BLUE, DPI, GREY, ORANGE, SILVER, STYLE, TWO_COLUMN_WIDTH, VERMILION
from taichi_msm.scene.sheet import Sheet

COLUMN_COUNT, PANEL_HEIGHT_IN, MAX_DRAWN_POINTS, MAX_DOTS = 3, 2.7, 3, 20000


def plot(result: FitResult, file: BinaryIO) -> None:
    """Write fit.png to a file."""
    with style.context(STYLE, after_reset=True), warnings.catch_warnings():
        # A name may contain characters that the font lacks; a point without observations has no mean.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        warnings.filterwarnings("ignore", "Mean of empty slice")
        # Without the version of Matplotlib.
        _figure(result).savefig(file, format="png", metadata={"Software": None})


def _figure(result: FitResult) -> Figure:
    forces = result.observations.forces is not None
    points, times = result.observations.there.any(axis=1).sum(), result.observations.there.any(axis=0).sum()
    # A single time has no motion, a single point no map of residuals.
    drawn = [
        draw
        for draw, some in ((_plot_motion, times > 1), (_plot_match, times > 1), (_plot_residuals, points > 1))
        if some
    ]
    drawn += [_plot_forces] if forces else []
    count = len(drawn) + len(result.parameters) + 3 * (result.map is not None)
    rows = math.ceil(count / COLUMN_COUNT)
    engine = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
    figure = Figure(figsize=(TWO_COLUMN_WIDTH, PANEL_HEIGHT_IN * rows + 0.5), dpi=DPI, layout=engine)
    FigureCanvasAgg(figure)
    figure.suptitle(f"Fit to {printable(result.observations.name)}", x=0.01, ha="left", parse_math=False)
    panels = list(figure.subplots(rows, COLUMN_COUNT, squeeze=False).ravel())
    if result.map is not None:
        plot_map(panels[:COLUMN_COUNT], result.map, result.scene.sheet)
        panels, count = panels[COLUMN_COUNT:], count - COLUMN_COUNT
    for axes, draw in zip(panels, drawn, strict=False):
        draw(axes, result)
    for axes, key in zip(panels[len(drawn) :], result.parameters, strict=False):
        _plot_parameter(axes, result, key)
    for axes in panels[count:]:
        axes.set_axis_off()
    return figure


def _unit(result: FitResult) -> tuple[float, str]:
    return (1000.0, "mm") if result.unit == "m" else (1.0, "px")


def _plot_motion(axes: Axes, result: FitResult) -> None:
    """Plot the points of largest motion in time, along their principal direction."""
    observations, (scale, unit) = result.observations, _unit(result)
    order, centre = np.argsort(observations.time), np.nanmean(result.fitted, axis=1, keepdims=True)
    motion = np.nan_to_num(result.fitted - centre)
    for number, n in enumerate(np.argsort(-np.linalg.norm(motion, axis=(1, 2)))[:MAX_DRAWN_POINTS]):
        along = np.linalg.svd(motion[n], full_matrices=False).Vh[0]
        along = along if along[np.argmax(np.abs(along))] > 0 else -along
        fitted, points = (scale * (values[n] - centre[n]) @ along for values in (result.fitted, observations.values))
        axes.plot(observations.time[order], fitted[order], color=BLUE, label="fitted" if number == 0 else None)
        label = "observed" if number == 0 else None
        axes.plot(observations.time, points, ".", color=VERMILION, markersize=3, label=label)
    axes.set(title="The points that move most", xlabel="time [s]", ylabel=f"place along the motion [{unit}]")
    axes.legend()


def _plot_match(axes: Axes, result: FitResult) -> None:
    """Plot observed against fitted numbers, both from their means."""
    observations, (scale, unit) = result.observations, _unit(result)
    middle = np.nanmean(result.fitted, axis=1, keepdims=True)
    one, other = (scale * (values - middle)[observations.known] for values in (result.fitted, observations.values))
    thinned = slice(None, None, math.ceil(len(one) / MAX_DOTS) or 1)
    axes.scatter(one[thinned], other[thinned], 2, color=BLUE, alpha=0.4, linewidths=0)
    if len(one):
        ends = [float(one.min()), float(one.max())]
        axes.plot(ends, ends, color=GREY, linewidth=0.8)
    axes.set(title="Observed against fitted", xlabel=f"fitted, from the mean [{unit}]", ylabel=f"observed [{unit}]")


def _plot_residuals(axes: Axes, result: FitResult) -> None:
    """Plot the residual of every point on the sheet."""
    observations, (scale, unit) = result.observations, _unit(result)
    left = scale * np.sqrt(
        np.nanmean(np.where(observations.known, result.fitted - observations.values, np.nan) ** 2, axis=(1, 2))
    )
    across, down = observations.coordinates.T
    dots = axes.scatter(across, down, 14, c=left, cmap="viridis", vmin=0)
    height, width = result.scene.sheet.size
    axes.set(title="Residual", xlim=(0, 1), ylim=(1, 0), xlabel="across", ylabel="down", aspect=height / width)
    assert isinstance(axes.figure, Figure)
    axes.figure.colorbar(dots, ax=axes, label=f"root mean square [{unit}]", shrink=0.8)


def _plot_forces(axes: Axes, result: FitResult) -> None:
    """Plot the force of every tool in time."""
    observations = result.observations.forces
    assert observations is not None
    for probe in np.unique(observations.probe):
        rows = np.flatnonzero(observations.probe == probe)
        rows = rows[np.argsort(observations.time[rows])]
        label = len(axes.lines) == 0
        for component in np.flatnonzero(np.isfinite(observations.force[rows]).any(axis=0)):
            fitted, points = (force[rows, component] for force in (result.fitted_forces, observations.force))
            axes.plot(observations.time[rows], fitted, color=BLUE, label="fitted" if label else None)
            axes.plot(
                observations.time[rows], points, ".", color=VERMILION, markersize=3, label="observed" if label else None
            )
            largest = np.argmax(np.abs(fitted))
            if abs(fitted[largest]) > 0.1 * np.abs(result.fitted_forces).max():
                axes.text(observations.time[rows[largest]], fitted[largest], f"  {'xyz'[component]}")
            label = False
    axes.set(title="Forces on the sheet", xlabel="time [s]", ylabel="force [N]")
    axes.legend()


def _plot_parameter(axes: Axes, result: FitResult, key: str) -> None:
    """Plot the profile of a parameter and its interval."""
    one, places = result.parameters[key], result.curves[key]
    axes.plot([place.x for place in places], [place.deviations**2 for place in places], ".-", color=BLUE)
    ends = [end for end in one.interval if end is not None]
    axes.axvline(one.value, color=GREY, linewidth=0.8)
    for end in ends:
        axes.axvline(end, color=ORANGE, linewidth=0.8, linestyle=(0, (4, 2)))
    axes.set_xlim(min(place.x for place in places), max(place.x for place in places))
    axes.set_ylim(0, 9)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_title(printable(key), parse_math=False)
    axes.set(xlabel="value; dashed: 95 %", ylabel="rise of chi-square")


Array = NDArray[np.float64]

# Smallest ratio of the ends of the colour scale.
MIN_COLOUR_RATIO = 1.05


def plot_map(panels: Sequence[Axes], found: FittedMap, sheet: Sheet) -> None:
    """Plot a map, its errors and the choice of its smoothness on three panels."""
    low, high = found.range
    spread = max(high / low, MIN_COLOUR_RATIO)
    middle = np.sqrt(low * high)
    norm = LogNorm(middle / np.sqrt(spread), middle * np.sqrt(spread))
    _plot_cells(panels[0], found, found.factors, sheet, norm, ("Stiffness", "factor of young", "viridis"))
    errors = 100 * found.errors
    top = float(np.nanmax(errors)) if not found.unknown.all() else 100.0
    _plot_cells(panels[1], found, errors, sheet, Normalize(0, top), ("Standard error", "error [%]", "cividis"))
    _plot_weight(panels[2], found.choice)


def _plot_cells(
    axes: Axes, found: FittedMap, values: Array, sheet: Sheet, norm: Normalize, words: tuple[str, str, str]
) -> None:
    """Plot a number of every map cell on the sheet, unknown ones hatched."""
    title, label, colours = words
    image = axes.imshow(
        np.where(found.unknown, np.nan, values), colours, norm=norm, extent=(0, 1, 1, 0), interpolation="nearest"
    )
    side = 1 / len(values)
    for row, col in np.argwhere(found.unknown) * side:
        axes.add_patch(Rectangle((col, row), side, side, facecolor="none", edgecolor=SILVER, hatch="////", linewidth=0))
    height, width = sheet.size
    across = "across; hatched: unknown" if found.unknown.any() else "across"
    axes.set(title=title, xlabel=across, ylabel="down", aspect=height / width)
    axes.grid(visible=False)
    assert isinstance(axes.figure, Figure)
    bar = axes.figure.colorbar(image, ax=axes, label=label, shrink=0.8)
    if isinstance(norm, LogNorm):
        bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
        bar.ax.yaxis.set_major_formatter(ScalarFormatter())
        bar.ax.yaxis.set_minor_formatter(NullFormatter())
    else:
        bar.locator = MaxNLocator(5)
        bar.update_ticks()


def _plot_weight(axes: Axes, choice: SmoothnessWeight) -> None:
    """Plot the excess of chi-square and its expectation against the weight of the smoothness."""
    axes.plot(choice.weights, choice.left, color=BLUE, label="excess")
    axes.plot(choice.weights, choice.expected, color=GREY, linestyle=(0, (4, 2)), label="expected")
    taken = np.abs(np.log(choice.weights / choice.weight)).argmin()
    axes.plot(choice.weights[taken], choice.left[taken], "o", color=VERMILION, label="taken")
    axes.set(title="Smoothness", xlabel="weight of the smoothness", ylabel="chi-square")
    axes.set(xscale="log", yscale="log")
    axes.legend(loc="upper left")
