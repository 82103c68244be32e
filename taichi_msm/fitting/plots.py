"""Figure of a fit: observations against predictions, residuals, profiles of parameters, and panels of a map."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import printable
from taichi_msm.fitting.machine_fit import FittedTest
from taichi_msm.fitting.panels import Panel
from taichi_msm.fitting.result import FitResult, FittedMap
from taichi_msm.fitting.tikhonov import SmoothnessWeight
from taichi_msm.plot_style import BLUE, DPI, GREY, ORANGE, SILVER, STYLE, TWO_COLUMN_WIDTH, VERMILION, add_colour_bar
from taichi_msm.scene.sheet import Sheet

COLUMN_COUNT = 3

DASHED = (0, (4, 2))


def plot(result: FitResult, file: BinaryIO) -> None:
    """Write fit.png."""
    with style.context(STYLE, after_reset=True), warnings.catch_warnings():
        # A name may contain characters that the font lacks, and a point may have no observations.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        warnings.filterwarnings("ignore", "Mean of empty slice")
        # The default metadata contains the version of Matplotlib.
        _figure(result).savefig(file, format="png", metadata={"Software": None})


def _figure(result: FitResult) -> Figure:
    panels = [] if result.map is None else _map_panels(result.map, result.scene.sheet)
    for observed, fitted in zip(result.observations, result.fitted, strict=True):
        panels += observed.panels(result.scene, fitted)
    panels += _test_panels(result.tests)
    panels += [partial(_plot_parameter, result=result, key=key) for key in result.parameters]
    rows = math.ceil(len(panels) / COLUMN_COUNT)
    engine = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
    figure = Figure(figsize=(TWO_COLUMN_WIDTH, 2.7 * rows + 0.5), dpi=DPI, layout=engine)
    figure.suptitle(f"Fit to {printable(result.observations[0].name)}", x=0.01, ha="left", parse_math=False)
    subplots = figure.subplots(rows, COLUMN_COUNT, squeeze=False).ravel()
    for axes, panel in zip(subplots, panels, strict=False):
        panel(axes)
    for axes in subplots[len(panels) :]:
        axes.set_axis_off()
    return figure


def _test_panels(tests: Sequence[FittedTest]) -> list[Panel]:
    """Return the panels of machine tests: force over time and over depth, and the residual."""
    # The file of a single test is in the title of the figure.
    titles = [printable(Path(test.loading.test.name).name) for test in tests] if len(tests) > 1 else ["Force over time"]
    panels: list[Panel] = []
    for test, title in zip(tests, titles, strict=False):
        panels.append(partial(_plot_test, fitted=test, title=title))
        panels.append(partial(_plot_test, fitted=test, title="Force over depth", over_depth=True))
        panels.append(partial(_plot_test_residual, fitted=test))
    return panels


def _plot_test(axes: Axes, fitted: FittedTest, title: str, *, over_depth: bool = False) -> None:
    """Plot the forces of a machine test over time, or over depth: all rows of the table, frames, and the fit."""
    loading = fitted.loading
    row_x, x, label = loading.test.time, loading.time, "time [s]"
    if over_depth:
        row_x, x, label = 1000 * loading.test.depth, 1000 * loading.depth, "depth of the table [mm]"
    axes.plot(row_x, loading.test.force, ".", color=SILVER, markersize=2, label="table")
    axes.plot(x, loading.force, ".", color=VERMILION, markersize=3, label="measured, of a frame")
    axes.plot(x, fitted.force, color=BLUE, label="fitted")
    if over_depth:
        axes.axvline(1000 * fitted.contact, color=GREY, linewidth=0.8, linestyle=DASHED, label="contact")
    axes.set_title(title, parse_math=False)
    axes.set(xlabel=label, ylabel="force [N]")
    axes.legend(handles=axes.lines[3:] if over_depth else axes.lines)


def _plot_test_residual(axes: Axes, fitted: FittedTest) -> None:
    """Plot fitted minus measured force of a machine test over time, with two standard deviations on either side."""
    loading, residual = fitted.loading, fitted.force - fitted.loading.force
    band = 2 * loading.sigma
    axes.fill_between(loading.time, -band, band, color=SILVER, alpha=0.4, linewidth=0, label="2 sigma")
    axes.plot(loading.time, residual, color=BLUE, linewidth=0.8)
    limit = 1.1 * float(np.abs(residual).max())
    axes.set(xlabel="time [s]", ylabel="fitted minus measured [N]", ylim=(-limit, limit))
    axes.set_title(f"Residual, {100 * fitted.residual / loading.peak:.2g} % rms of peak")
    axes.legend()


def _plot_parameter(axes: Axes, result: FitResult, key: str) -> None:
    estimate, (x, deviations) = result.parameters[key], np.array(result.curves[key]).T
    axes.plot(x, deviations**2, ".-", color=BLUE)
    axes.axvline(estimate.value, color=GREY, linewidth=0.8)
    for end in estimate.interval:
        if end is not None:
            axes.axvline(end, color=ORANGE, linewidth=0.8, linestyle=DASHED)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_title(printable(key), parse_math=False)
    axes.set(xlim=(x.min(), x.max()), ylim=(0, 9), xlabel="value; dashed: 95 %", ylabel="rise of chi-square")


def _map_panels(fitted_map: FittedMap, sheet: Sheet) -> list[Panel]:
    """Return the panels of a map: the map, its errors, and the weight of its smoothness."""
    low, high = fitted_map.range
    # The colours span a factor of at least 1.05.
    ratio, centre = np.sqrt(max(high / low, 1.05)), np.sqrt(low * high)
    norm, errors = LogNorm(centre / ratio, centre * ratio), 100 * fitted_map.errors
    error_norm = Normalize(0, float(np.nanmax(errors)) if not fitted_map.unknown.all() else 100.0)
    plot_cells = partial(_plot_cells, unknown=fitted_map.unknown, sheet=sheet)
    return [
        partial(plot_cells, values=fitted_map.factors, norm=norm, title="Stiffness", label="factor of young"),
        partial(plot_cells, values=errors, norm=error_norm, title="Standard error", label="error [%]"),
        partial(_plot_weight, choice=fitted_map.choice),
    ]


def _plot_cells(
    axes: Axes, values: Array, unknown: NDArray[np.bool_], sheet: Sheet, norm: Normalize, title: str, label: str
) -> None:
    """Plot values of the map cells on the sheet, with unknown cells hatched."""
    known, colours = np.where(unknown, np.nan, values), "viridis" if isinstance(norm, LogNorm) else "cividis"
    image = axes.imshow(known, colours, norm=norm, extent=(0, 1, 1, 0), interpolation="nearest")
    side = 1 / len(values)
    for row, col in np.argwhere(unknown) * side:
        axes.add_patch(Rectangle((col, row), side, side, facecolor="none", edgecolor=SILVER, hatch="////", linewidth=0))
    height, width = sheet.size
    across = "across; hatched: unknown" if unknown.any() else "across"
    axes.set(title=title, xlabel=across, ylabel="down", aspect=height / width)
    axes.grid(visible=False)
    add_colour_bar(axes, image, label, "right", 0.8)


def _plot_weight(axes: Axes, choice: SmoothnessWeight) -> None:
    """Plot the excess of chi-square and its expectation against the weight of the smoothness."""
    axes.plot(choice.weights, choice.excess, color=BLUE, label="excess")
    axes.plot(choice.weights, choice.expected, color=GREY, linestyle=DASHED, label="expected")
    chosen = np.abs(np.log(choice.weights / choice.weight)).argmin()
    axes.plot(choice.weights[chosen], choice.excess[chosen], "o", color=VERMILION, label="taken")
    axes.set(title="Smoothness", xlabel="weight of the smoothness", ylabel="chi-square")
    axes.set(xscale="log", yscale="log")
    axes.legend(loc="upper left")
