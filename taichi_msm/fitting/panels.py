"""Panels of fit.png that compare observed with fitted values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.plot_style import BLUE, GREY, VERMILION

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Function that plots a panel.
Panel = Callable[["Axes"], None]

# Factors from units of values to plotted ones, with their names.
PLOTTED_UNITS = {"m": (1000.0, "mm")}

MAX_DOTS = 20000


def plot_over_time(axes: Axes, time: Array, fitted: Array, observed: Array) -> None:
    """Plot a fitted line and observed dots, with labels for the first line of the panel."""
    labels = (None, None) if axes.lines else ("fitted", "observed")
    axes.plot(time, fitted, color=BLUE, label=labels[0])
    axes.plot(time, observed, ".", color=VERMILION, markersize=3, label=labels[1])


def plot_match(axes: Axes, fitted: Array, observed: Array, unit: str, origin: str = "0") -> None:
    """Plot observed against fitted values [unit], shape (n,), both from an origin."""
    scale, name = PLOTTED_UNITS.get(unit, (1.0, unit))
    subset = slice(None, None, math.ceil(len(fitted) / MAX_DOTS))
    x, y = scale * fitted, scale * observed
    axes.scatter(x[subset], y[subset], 2, color=BLUE, alpha=0.4, linewidths=0)
    ends = [float(x.min()), float(x.max())]
    axes.plot(ends, ends, color=GREY, linewidth=0.8)
    axes.set(title="Observed against fitted", xlabel=f"fitted, from {origin} [{name}]", ylabel=f"observed [{name}]")


def plot_motion(axes: Axes, time: Array, fitted: Array, observed: Array, unit: str) -> None:
    """Plot the three points of largest motion along their principal direction; values [unit]: shape (N, T, 2 or 3)."""
    scale, name = PLOTTED_UNITS.get(unit, (1.0, unit))
    order, centre = np.argsort(time), np.nanmean(fitted, axis=1, keepdims=True)
    motion = np.nan_to_num(fitted - centre)
    for n in np.argsort(-np.linalg.norm(motion, axis=(1, 2)))[:3]:
        along = np.linalg.svd(motion[n], full_matrices=False).Vh[0]
        along = along if along[np.argmax(np.abs(along))] > 0 else -along
        line, points = (scale * (values[n] - centre[n]) @ along for values in (fitted, observed))
        plot_over_time(axes, time[order], line[order], points[order])
    axes.set(title="The points that move most", xlabel="time [s]", ylabel=f"place along the motion [{name}]")
    axes.legend()


def plot_on_sheet(axes: Axes, coordinates: Array, residuals: Array, unit: str, size: tuple[float, float]) -> None:
    """Plot residuals [unit], shape (N,), at their coordinates, shape (N, 2), on a sheet of height and width `size`."""
    scale, name = PLOTTED_UNITS.get(unit, (1.0, unit))
    dots = axes.scatter(coordinates[:, 0], coordinates[:, 1], 14, c=scale * residuals, cmap="viridis", vmin=0)
    height, width = size
    axes.set(title="Residual", xlim=(0, 1), ylim=(1, 0), xlabel="across", ylabel="down", aspect=height / width)
    axes.figure.colorbar(dots, ax=axes, label=f"root mean square [{name}]", shrink=0.8)


def plot_forces(axes: Axes, time: Array, probe: NDArray[np.intp], fitted: Array, observed: Array) -> None:
    """Plot the forces [N] of tools over time, in rows of a time and the index of a tool each, shape (rows, 3)."""
    for each in np.unique(probe):
        rows = np.flatnonzero(probe == each)
        rows = rows[np.argsort(time[rows])]
        for component in np.flatnonzero(np.isfinite(observed[rows]).any(axis=0)):
            line = fitted[rows, component]
            plot_over_time(axes, time[rows], line, observed[rows, component])
            largest = np.argmax(np.abs(line))
            if abs(line[largest]) > 0.1 * np.abs(fitted).max():
                axes.text(time[rows[largest]], line[largest], f"  {'xyz'[component]}")
    axes.set(title="Forces on the sheet", xlabel="time [s]", ylabel="force [N]")
    axes.legend()
