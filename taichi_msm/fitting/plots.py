"""Figure of a fit: observations against predictions, residuals, profiles of parameters, and panels of a map."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial, singledispatch
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
from taichi_msm.fitting.forces import ToolForces
from taichi_msm.fitting.machine_model import MachineForces
from taichi_msm.fitting.machine_plots import MACHINE_PANELS
from taichi_msm.fitting.observation import Observation
from taichi_msm.fitting.points import PointObservation
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
    pairs = zip(result.observations, result.fitted, strict=True)
    plots = [plot_panel for observed, fitted in pairs for plot_panel in observation_panels(observed, fitted, result)]
    count = len(plots) + len(result.parameters) + 3 * (result.map is not None)
    rows = math.ceil(count / COLUMN_COUNT)
    engine = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
    figure = Figure(figsize=(TWO_COLUMN_WIDTH, 2.7 * rows + 0.5), dpi=DPI, layout=engine)
    FigureCanvasAgg(figure)
    figure.suptitle(f"Fit to {printable(result.observations[0].name)}", x=0.01, ha="left", parse_math=False)
    panels = list(figure.subplots(rows, COLUMN_COUNT, squeeze=False).ravel())
    if result.map is not None:
        plot_map(panels[:COLUMN_COUNT], result.map, result.scene.sheet)
        panels, count = panels[COLUMN_COUNT:], count - COLUMN_COUNT
    for axes, plot_panel in zip(panels, plots, strict=False):
        plot_panel(axes)
    for axes, key in zip(panels[len(plots) :], result.parameters, strict=False):
        _plot_parameter(axes, result, key)
    for axes in panels[count:]:
        axes.set_axis_off()
    return figure


Panel = Callable[[Axes], None]


@singledispatch
def observation_panels(observed: Observation, fitted: Array, result: FitResult) -> list[Panel]:
    """Return functions that plot the panels of an observation.

    Args:
        observed: the observation.
        fitted: its values in the fitted scene.
        result: of the fit.
    """
    raise NotImplementedError(type(observed).__name__)


@observation_panels.register
def _point_panels(observed: PointObservation, fitted: Array, result: FitResult) -> list[Panel]:
    point_count, time_count = (int(observed.is_observed.any(axis=axis).sum()) for axis in (1, 0))
    # A single time shows no motion, a single point no map of residuals.
    panels = [_plot_motion, _plot_match] * (time_count > 1)
    panels += [partial(_plot_residuals, sheet=result.scene.sheet)] * (point_count > 1)
    return [partial(panel, observed=observed, fitted=fitted) for panel in panels]


@observation_panels.register
def _force_panels(observed: ToolForces, fitted: Array, _result: FitResult) -> list[Panel]:
    return [partial(_plot_forces, observed=observed, fitted=fitted)]


@observation_panels.register
def _machine_panels(_observed: MachineForces, _fitted: Array, result: FitResult) -> list[Panel]:
    several = len(result.tests) > 1
    return [partial(panel, fitted=test, several=several) for test in result.tests for panel in MACHINE_PANELS]


def _unit(observed: PointObservation) -> tuple[float, str]:
    return (1000.0, "mm") if observed.unit == "m" else (1.0, "px")


def _plot_motion(axes: Axes, observed: PointObservation, fitted: Array) -> None:
    """Plot the three points of largest motion over time, along their principal direction."""
    scale, unit = _unit(observed)
    order, centre = np.argsort(observed.time), np.nanmean(fitted, axis=1, keepdims=True)
    motion = np.nan_to_num(fitted - centre)
    for number, n in enumerate(np.argsort(-np.linalg.norm(motion, axis=(1, 2)))[:3]):
        along = np.linalg.svd(motion[n], full_matrices=False).Vh[0]
        along = along if along[np.argmax(np.abs(along))] > 0 else -along
        line, points = (scale * (values[n] - centre[n]) @ along for values in (fitted, observed.values))
        axes.plot(observed.time[order], line[order], color=BLUE, label="fitted" if number == 0 else None)
        label = "observed" if number == 0 else None
        axes.plot(observed.time, points, ".", color=VERMILION, markersize=3, label=label)
    axes.set(title="The points that move most", xlabel="time [s]", ylabel=f"place along the motion [{unit}]")
    axes.legend()


def _plot_match(axes: Axes, observed: PointObservation, fitted: Array) -> None:
    """Plot observed against fitted values, both relative to the mean fitted position."""
    scale, unit = _unit(observed)
    centre = np.nanmean(fitted, axis=1, keepdims=True)
    x, y = (scale * (values - centre)[observed.known] for values in (fitted, observed.values))
    subset = slice(None, None, math.ceil(len(x) / 20000) or 1)
    axes.scatter(x[subset], y[subset], 2, color=BLUE, alpha=0.4, linewidths=0)
    if len(x):
        ends = [float(x.min()), float(x.max())]
        axes.plot(ends, ends, color=GREY, linewidth=0.8)
    axes.set(title="Observed against fitted", xlabel=f"fitted, from the mean [{unit}]", ylabel=f"observed [{unit}]")


def _plot_residuals(axes: Axes, observed: PointObservation, fitted: Array, sheet: Sheet) -> None:
    """Plot the residual of every point on the sheet."""
    scale, unit = _unit(observed)
    residuals = scale * np.sqrt(np.nanmean((fitted - observed.values) ** 2, axis=(1, 2)))
    across, down = observed.coordinates.T
    dots = axes.scatter(across, down, 14, c=residuals, cmap="viridis", vmin=0)
    height, width = sheet.size
    axes.set(title="Residual", xlim=(0, 1), ylim=(1, 0), xlabel="across", ylabel="down", aspect=height / width)
    assert isinstance(axes.figure, Figure)
    axes.figure.colorbar(dots, ax=axes, label=f"root mean square [{unit}]", shrink=0.8)


def _plot_forces(axes: Axes, observed: ToolForces, fitted: Array) -> None:
    """Plot the force of every tool over time."""
    for probe in np.unique(observed.probe):
        rows = np.flatnonzero(observed.probe == probe)
        rows = rows[np.argsort(observed.time[rows])]
        is_first = len(axes.lines) == 0
        for component in np.flatnonzero(np.isfinite(observed.values[rows]).any(axis=0)):
            line, points = (force[rows, component] for force in (fitted, observed.values))
            axes.plot(observed.time[rows], line, color=BLUE, label="fitted" if is_first else None)
            label = "observed" if is_first else None
            axes.plot(observed.time[rows], points, ".", color=VERMILION, markersize=3, label=label)
            largest = np.argmax(np.abs(line))
            if abs(line[largest]) > 0.1 * np.abs(fitted).max():
                axes.text(observed.time[rows[largest]], line[largest], f"  {'xyz'[component]}")
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
