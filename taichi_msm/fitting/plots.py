"""Figure of a fit: observations against predictions, residuals, profiles of parameters, and panels of a map."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
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
from taichi_msm.fitting.machine_plots import MACHINE_PANELS
from taichi_msm.fitting.result import FitResult, FittedMap
from taichi_msm.fitting.tikhonov import SmoothnessWeight
from taichi_msm.plot_style import BLUE, DPI, GREY, ORANGE, SILVER, STYLE, TWO_COLUMN_WIDTH, VERMILION
from taichi_msm.scene.sheet import Sheet

Array = NDArray[np.float64]

COLUMN_COUNT = 3


def plot(result: FitResult, file: BinaryIO) -> None:
    """Write fit.png to a file."""
    with style.context(STYLE, after_reset=True), warnings.catch_warnings():
        # A name may contain characters that the font lacks, and a point may have no observations.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        warnings.filterwarnings("ignore", "Mean of empty slice")
        # The default metadata contains the version of Matplotlib.
        _figure(result).savefig(file, format="png", metadata={"Software": None})


def _figure(result: FitResult) -> Figure:
    forces = result.observations.forces is not None
    point_count, time_count = (
        result.observations.is_observed.any(axis=1).sum(),
        result.observations.is_observed.any(axis=0).sum(),
    )
    # A single time shows no motion, a single point no map of residuals.
    plots: list[Callable[[Axes, FitResult], None]] = [
        plot_panel
        for plot_panel, is_shown in (
            (_plot_motion, time_count > 1),
            (_plot_match, time_count > 1),
            (_plot_residuals, point_count > 1),
        )
        if is_shown
    ]
    if result.tests:
        plots = [partial(plot_panel, fitted=fitted) for fitted in result.tests for plot_panel in MACHINE_PANELS]
    elif forces:
        plots.append(_plot_forces)
    count = len(plots) + len(result.parameters) + 3 * (result.map is not None)
    rows = math.ceil(count / COLUMN_COUNT)
    engine = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
    figure = Figure(figsize=(TWO_COLUMN_WIDTH, 2.7 * rows + 0.5), dpi=DPI, layout=engine)
    FigureCanvasAgg(figure)
    figure.suptitle(f"Fit to {printable(result.observations.name)}", x=0.01, ha="left", parse_math=False)
    panels = list(figure.subplots(rows, COLUMN_COUNT, squeeze=False).ravel())
    if result.map is not None:
        plot_map(panels[:COLUMN_COUNT], result.map, result.scene.sheet)
        panels, count = panels[COLUMN_COUNT:], count - COLUMN_COUNT
    for axes, plot_panel in zip(panels, plots, strict=False):
        plot_panel(axes, result)
    for axes, key in zip(panels[len(plots) :], result.parameters, strict=False):
        _plot_parameter(axes, result, key)
    for axes in panels[count:]:
        axes.set_axis_off()
    return figure


def _unit(result: FitResult) -> tuple[float, str]:
    return (1000.0, "mm") if result.unit == "m" else (1.0, "px")


def _plot_motion(axes: Axes, result: FitResult) -> None:
    """Plot the three points of largest motion over time, along their principal direction."""
    observations, (scale, unit) = result.observations, _unit(result)
    order, centre = np.argsort(observations.time), np.nanmean(result.fitted, axis=1, keepdims=True)
    motion = np.nan_to_num(result.fitted - centre)
    for number, n in enumerate(np.argsort(-np.linalg.norm(motion, axis=(1, 2)))[:3]):
        along = np.linalg.svd(motion[n], full_matrices=False).Vh[0]
        along = along if along[np.argmax(np.abs(along))] > 0 else -along
        fitted, points = (scale * (values[n] - centre[n]) @ along for values in (result.fitted, observations.values))
        axes.plot(observations.time[order], fitted[order], color=BLUE, label="fitted" if number == 0 else None)
        label = "observed" if number == 0 else None
        axes.plot(observations.time, points, ".", color=VERMILION, markersize=3, label=label)
    axes.set(title="The points that move most", xlabel="time [s]", ylabel=f"place along the motion [{unit}]")
    axes.legend()


def _plot_match(axes: Axes, result: FitResult) -> None:
    """Plot observed against fitted values, both relative to the mean fitted position."""
    observations, (scale, unit) = result.observations, _unit(result)
    centre = np.nanmean(result.fitted, axis=1, keepdims=True)
    fitted, observed = (
        scale * (values - centre)[observations.known] for values in (result.fitted, observations.values)
    )
    subset = slice(None, None, math.ceil(len(fitted) / 20000) or 1)
    axes.scatter(fitted[subset], observed[subset], 2, color=BLUE, alpha=0.4, linewidths=0)
    if len(fitted):
        ends = [float(fitted.min()), float(fitted.max())]
        axes.plot(ends, ends, color=GREY, linewidth=0.8)
    axes.set(title="Observed against fitted", xlabel=f"fitted, from the mean [{unit}]", ylabel=f"observed [{unit}]")


def _plot_residuals(axes: Axes, result: FitResult) -> None:
    """Plot the residual of every point on the sheet."""
    observations, (scale, unit) = result.observations, _unit(result)
    residuals = scale * np.sqrt(
        np.nanmean(np.where(observations.known, result.fitted - observations.values, np.nan) ** 2, axis=(1, 2))
    )
    across, down = observations.coordinates.T
    dots = axes.scatter(across, down, 14, c=residuals, cmap="viridis", vmin=0)
    height, width = result.scene.sheet.size
    axes.set(title="Residual", xlim=(0, 1), ylim=(1, 0), xlabel="across", ylabel="down", aspect=height / width)
    assert isinstance(axes.figure, Figure)
    axes.figure.colorbar(dots, ax=axes, label=f"root mean square [{unit}]", shrink=0.8)


def _plot_forces(axes: Axes, result: FitResult) -> None:
    """Plot the force of every tool over time."""
    forces = result.observations.forces
    assert forces is not None
    for probe in np.unique(forces.probe):
        rows = np.flatnonzero(forces.probe == probe)
        rows = rows[np.argsort(forces.time[rows])]
        is_first = len(axes.lines) == 0
        for component in np.flatnonzero(np.isfinite(forces.force[rows]).any(axis=0)):
            fitted, observed = (force[rows, component] for force in (result.fitted_forces, forces.force))
            axes.plot(forces.time[rows], fitted, color=BLUE, label="fitted" if is_first else None)
            axes.plot(
                forces.time[rows], observed, ".", color=VERMILION, markersize=3, label="observed" if is_first else None
            )
            largest = np.argmax(np.abs(fitted))
            if abs(fitted[largest]) > 0.1 * np.abs(result.fitted_forces).max():
                axes.text(forces.time[rows[largest]], fitted[largest], f"  {'xyz'[component]}")
            is_first = False
    axes.set(title="Forces on the sheet", xlabel="time [s]", ylabel="force [N]")
    axes.legend()


def _plot_parameter(axes: Axes, result: FitResult, key: str) -> None:
    """Plot the profile of a parameter and its interval."""
    estimate, curve = result.parameters[key], result.curves[key]
    axes.plot([point.x for point in curve], [point.deviations**2 for point in curve], ".-", color=BLUE)
    ends = [end for end in estimate.interval if end is not None]
    axes.axvline(estimate.value, color=GREY, linewidth=0.8)
    for end in ends:
        axes.axvline(end, color=ORANGE, linewidth=0.8, linestyle=(0, (4, 2)))
    axes.set_xlim(min(point.x for point in curve), max(point.x for point in curve))
    axes.set_ylim(0, 9)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_title(printable(key), parse_math=False)
    axes.set(xlabel="value; dashed: 95 %", ylabel="rise of chi-square")


def plot_map(panels: Sequence[Axes], fitted_map: FittedMap, sheet: Sheet) -> None:
    """Plot a map, its errors, and the weight of its smoothness on three panels."""
    low, high = fitted_map.range
    ratio = max(high / low, 1.05)
    centre = np.sqrt(low * high)
    norm = LogNorm(centre / np.sqrt(ratio), centre * np.sqrt(ratio))
    _plot_cells(panels[0], fitted_map, fitted_map.factors, sheet, norm, ("Stiffness", "factor of young", "viridis"))
    errors = 100 * fitted_map.errors
    max_error = float(np.nanmax(errors)) if not fitted_map.unknown.all() else 100.0
    _plot_cells(
        panels[1], fitted_map, errors, sheet, Normalize(0, max_error), ("Standard error", "error [%]", "cividis")
    )
    _plot_weight(panels[2], fitted_map.choice)


def _plot_cells(
    axes: Axes, fitted_map: FittedMap, values: Array, sheet: Sheet, norm: Normalize, texts: tuple[str, str, str]
) -> None:
    """Plot values of the map cells on the sheet, with unknown cells hatched."""
    title, label, colours = texts
    image = axes.imshow(
        np.where(fitted_map.unknown, np.nan, values), colours, norm=norm, extent=(0, 1, 1, 0), interpolation="nearest"
    )
    side = 1 / len(values)
    for row, col in np.argwhere(fitted_map.unknown) * side:
        axes.add_patch(Rectangle((col, row), side, side, facecolor="none", edgecolor=SILVER, hatch="////", linewidth=0))
    height, width = sheet.size
    across = "across; hatched: unknown" if fitted_map.unknown.any() else "across"
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
    chosen = np.abs(np.log(choice.weights / choice.weight)).argmin()
    axes.plot(choice.weights[chosen], choice.left[chosen], "o", color=VERMILION, label="taken")
    axes.set(title="Smoothness", xlabel="weight of the smoothness", ylabel="chi-square")
    axes.set(xscale="log", yscale="log")
    axes.legend(loc="upper left")
