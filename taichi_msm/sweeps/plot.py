"""The results of a sweep against its parameters, as a picture."""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from taichi_msm.errors import printable
from taichi_msm.plot_style import BLUE, DPI, INK, NARROW, ORANGE, PALE, STYLE, VERMILION
from taichi_msm.sweeps.parameters import Parameter, is_wide
from taichi_msm.sweeps.sensitivity import Index

MOST_COLUMNS = 8

# Of a panel, and what is beside and around all of them [in].
WIDTH, HEIGHT, BESIDE, AROUND = 1.75, 1.55, 0.9, 1.3

# Letters of a line in an inch; letters of a label, and of all labels that fit beside each other.
LETTERS, LABEL, ROOM = 17, 12, 20

# Of the dots: all their areas together [pt²], and how wide those at one label spread.
AREAS, SPREAD = 900, 0.3

# Beside the dots, as a share of the axis.
MARGIN = 0.05

UNITS = {"max_displacement": " [m]", "force": " [N]", "greatest": " [N]"}


class Content(NamedTuple):
    """What is drawn; arrays have a number for each run."""

    title: str
    parameters: Sequence[Parameter]
    results: Mapping[str, NDArray[np.float64]]
    failed: NDArray[np.bool_]
    indices: Sequence[Index]


def plot(content: Content, file: BinaryIO) -> None:
    """Draw a panel for each result and each parameter as a PNG; of more parameters, those of largest sensitivity."""
    with style.context(STYLE, after_reset=True), warnings.catch_warnings():
        # A name may contain characters that the font lacks.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        # Without the version of Matplotlib.
        _figure(content).savefig(file, format="png", metadata={"Software": None})


def _figure(content: Content) -> Figure:
    indices = {(index.result, index.parameter): index for index in content.indices}
    parameters = _most_sensitive(content)
    size = max(BESIDE + WIDTH * len(parameters), NARROW), AROUND + HEIGHT * len(content.results)
    figure = Figure(figsize=size, dpi=DPI, layout=ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06))
    FigureCanvasAgg(figure)
    figure.suptitle(printable(content.title), x=0.01, ha="left", parse_math=False)
    said = textwrap.fill(" ".join(_explanations(content, parameters)), round(LETTERS * size[0]))
    figure.supxlabel(said, x=0.01, ha="left", size=8, parse_math=False)
    panels = figure.subplots(len(content.results), len(parameters), sharex="col", sharey="row", squeeze=False)
    for row, (name, numbers) in zip(panels, content.results.items(), strict=True):
        row[0].set_ylabel(name + UNITS.get(name.rsplit(".", 1)[-1], ""))
        if is_wide(numbers):
            row[0].set_yscale("log")
        else:
            row[0].yaxis.set_major_formatter(FuncFormatter(_write))
        for axes, parameter in zip(row, parameters, strict=True):
            _plot_runs(axes, parameter, numbers, content.failed)
            if index := indices.get((name, parameter.name)):
                _plot_index(axes, index)
    for axes, parameter in zip(panels[-1], parameters, strict=True):
        _scale(axes, parameter)
    return figure


def _most_sensitive(content: Content) -> list[Parameter]:
    """Choose the parameters that are shown, in their order."""
    largest = dict.fromkeys((one.name for one in content.parameters), -math.inf)
    for index in content.indices:
        largest[index.parameter] = max(index.first_order, largest[index.parameter])
    ranked = sorted(content.parameters, key=lambda one: -largest[one.name])
    chosen = {one.name for one in ranked[:MOST_COLUMNS]}
    return [one for one in content.parameters if one.name in chosen]


def _explanations(content: Content, shown: Sequence[Parameter]) -> Iterator[str]:
    """Say what is not plain from the panels."""
    if content.indices:
        yield "Above a panel: first-order sensitivity, the share of the result's variance that follows from this"
        yield "parameter alone, with its 95 % interval (RBD-FAST)."
    if content.failed.any():
        yield "x: a run that failed."
    if rest := [one.name for one in content.parameters if one.name not in {other.name for other in shown}]:
        yield (
            f"Not shown, as less sensitive: {', '.join(rest)}." if content.indices else f"Not shown: {', '.join(rest)}."
        )


def _plot_runs(axes: Axes, parameter: Parameter, numbers: NDArray[np.float64], failed: NDArray[np.bool_]) -> None:
    """Draw a dot for each run, and crosses at the bottom edge for those that failed."""
    place = parameter.numbers
    if parameter.labels:
        place = place + SPREAD * (np.random.default_rng(0).random(len(place)) - 0.5)
    area = float(np.clip(AREAS / len(place), 1.5, 12))
    axes.scatter(place, numbers, area, color=BLUE, alpha=0.6, linewidths=0)
    crosses: dict[str, Any] = {"marker": "x", "color": VERMILION, "linewidths": 0.8, "clip_on": False, "zorder": 3}
    axes.scatter(place[failed], np.full(failed.sum(), 0.0), 12, transform=axes.get_xaxis_transform(), **crosses)


def _plot_index(axes: Axes, index: Index) -> None:
    """Draw a bar over a panel, as wide as the panel for 1."""
    low, middle, high = (
        min(max(value, 0.0), 1.0)
        for value in (index.first_order - index.confidence, index.first_order, index.first_order + index.confidence)
    )
    above: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False, "solid_capstyle": "butt"}
    for left, right, colour, width in ((0, 1, PALE, 5), (0, middle, ORANGE, 5), (low, high, INK, 0.8)):
        axes.plot([left, right], [1.06, 1.06], color=colour, linewidth=width, **above)
    text = f"{max(index.first_order, 0.0):.2f} ± {index.confidence:.2f}"
    axes.set_title(text, loc="right", fontsize=7.5, fontweight="normal", pad=10)


def _scale(axes: Axes, parameter: Parameter) -> None:
    """Fit an axis to a parameter, and name it."""
    axes.set_xlabel(textwrap.fill(printable(parameter.name), round(LETTERS * WIDTH)), parse_math=False)
    if parameter.labels:
        labels = [textwrap.shorten(printable(label), LABEL, placeholder="…") for label in parameter.labels]
        turned: dict[str, Any] = (
            {"rotation": 30, "ha": "right", "rotation_mode": "anchor"} if sum(map(len, labels)) > ROOM else {}
        )
        axes.set_xticks(range(len(labels)), labels, parse_math=False, **turned)
        return
    if parameter.is_logarithmic:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=5))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.xaxis.set_major_formatter(FuncFormatter(_write))
    # All runs, as those that failed may lie beyond the others.
    axes.set_xlim(*_with_margin(parameter))


def _with_margin(parameter: Parameter) -> tuple[float, float]:
    """Give the ends of an axis that has all numbers of a parameter well inside."""
    low, high = float(parameter.numbers.min()), float(parameter.numbers.max())
    if parameter.is_logarithmic:
        factor = (high / low) ** MARGIN
        return low / factor, high * factor
    return low - MARGIN * (high - low), high + MARGIN * (high - low)


def _write(number: float, _: int) -> str:
    """Write a number at an axis, all of it, as an exponent above the axis would meet the bar."""
    if number == 0 or 1e-3 <= abs(number) < 1e5:
        return f"{number:.10g}"
    digits, exponent = f"{number:.10e}".split("e")
    return f"{float(digits):g}e{int(exponent)}"
