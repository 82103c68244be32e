"""A fitted map as panels: the stiffness, how well it is known, and how its smoothness was chosen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, ScalarFormatter
from numpy.typing import NDArray

from taichi_msm.fitting.result import FittedMap
from taichi_msm.fitting.tikhonov import Choice
from taichi_msm.plot_style import BLUE, GREY, SILVER, VERMILION
from taichi_msm.scene import Sheet

Array = NDArray[np.float64]

# The colours of stiffness and of errors are spread over so much at least.
LEAST_SPREAD = 1.05


def plot_map(panels: Sequence[Axes], found: FittedMap, sheet: Sheet) -> None:
    """Draw a map on three panels."""
    low, high = found.range
    spread = max(high / low, LEAST_SPREAD)
    middle = np.sqrt(low * high)
    norm = LogNorm(middle / np.sqrt(spread), middle * np.sqrt(spread))
    _plot_fields(panels[0], found, found.factors, sheet, norm, ("Stiffness", "factor of young", "viridis"))
    errors = 100 * found.errors
    top = float(np.nanmax(errors)) if not found.unknown.all() else 100.0
    _plot_fields(panels[1], found, errors, sheet, Normalize(0, top), ("How well it is known", "error [%]", "cividis"))
    _plot_choice(panels[2], found.choice)


def _plot_fields(
    axes: Axes, found: FittedMap, values: Array, sheet: Sheet, norm: Normalize, words: tuple[str, str, str]
) -> None:
    """Draw a number of every field where it is on the sheet, and hatch the unknown ones."""
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


def _plot_choice(axes: Axes, choice: Choice) -> None:
    """Draw what is left above the least, and what is expected, against the weight of the smoothness."""
    axes.plot(choice.weights, choice.left, color=BLUE, label="left above the least")
    axes.plot(choice.weights, choice.expected, color=GREY, linestyle=(0, (4, 2)), label="expected")
    taken = np.abs(np.log(choice.weights / choice.weight)).argmin()
    axes.plot(choice.weights[taken], choice.left[taken], "o", color=VERMILION, label="taken")
    axes.set(title="How smooth it is", xlabel="weight of the smoothness", ylabel="chi-square")
    axes.set(xscale="log", yscale="log")
    axes.legend(loc="upper left")
