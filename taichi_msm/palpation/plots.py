"""Figures of a palpation: the map with its uncertainty, and curves of three presses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from scipy.spatial import cKDTree

from taichi_msm.arithmetic import Array
from taichi_msm.errors import printable
from taichi_msm.palpation.plane import Plane, find_plane
from taichi_msm.palpation.result import Palpation
from taichi_msm.plot_style import BLUE, DPI, INK, SKY, STYLE, TWO_COLUMN_WIDTH, VERMILION, add_colour_bar

# Pixels along the longer side of a map.
PIXELS = 120

# Colour of tissue that is farther than a length from every press.
UNKNOWN = "#D0D0D0"

# Least ratio of the ends of the colours.
MIN_RATIO = 1.1

# Largest number of letters of a label of a press.
MAX_LABEL_LENGTH = 20

MM, N_PER_CM3 = 1e3, 1e-6


def plot_map(result: Palpation, file: BinaryIO) -> None:
    """Write map.png."""
    radius = result.map.fit.law.radius
    plane = find_plane(result.presses.position, result.normal, radius)
    width, height = plane.size
    tall = 0.38 * TWO_COLUMN_WIDTH * height / width
    _save(lambda figure: _draw_map(figure, result, plane), max(2.2, min(tall, 8.0)) + 1.2, file)


def plot_curves(result: Palpation, file: BinaryIO) -> None:
    """Write curves.png."""
    _save(lambda figure: _draw_curves(figure, result), 3.2, file)


def _save(draw: Callable[[Figure], None], height: float, file: BinaryIO) -> None:
    with style.context(STYLE, after_reset=True):
        engine = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
        figure = Figure(figsize=(TWO_COLUMN_WIDTH, height), dpi=DPI, layout=engine)
        draw(figure)
        # The default metadata contains the version of Matplotlib.
        figure.savefig(file, format="png", metadata={"Software": None})


def _draw_map(figure: Figure, result: Palpation, plane: Plane) -> None:
    cols, rows = (max(2, round(PIXELS * side / max(plane.size))) for side in plane.size)
    points = plane.pixels(rows, cols).reshape(-1, 3)
    stiffness, low, high = result.map.stiffness(points)
    length = result.map.process.length
    is_unknown = cKDTree(result.presses.position).query(points)[0] > length
    stiffness, width = (
        np.where(is_unknown, np.nan, values).reshape(rows, cols)
        for values in (N_PER_CM3 * stiffness, 100 * (np.sqrt(high / low) - 1))
    )
    measured = N_PER_CM3 * result.map.fit.mean_stiffness
    ends = np.nanmin([np.nanmin(stiffness), measured.min()]), np.nanmax([np.nanmax(stiffness), measured.max()])
    centre, ratio = np.sqrt(ends[0] * ends[1]), np.sqrt(max(ends[1] / ends[0], MIN_RATIO))
    norm = LogNorm(centre / ratio, centre * ratio)
    figure.suptitle(f"Stiffness of {printable(Path(result.name).name)}", x=0.01, ha="left", parse_math=False)
    left, right = figure.subplots(1, 2, sharey=True)
    grey = f"\ngrey: over {MM * length:.2g} mm from every press" if is_unknown.any() else ""
    _draw_panel(left, plane, stiffness, norm, "viridis", "stiffness [N/cm³]: dark soft, bright stiff")
    left.set_title("Map; dots: each press")
    left.scatter(
        *MM * plane.places[:, :2].T, c=measured, cmap="viridis", norm=norm, s=16, edgecolors="white", linewidths=0.7
    )
    _draw_panel(right, plane, width, Normalize(0, float(np.nanmax(width))), "cividis", f"95 % interval, ± [%]{grey}")
    right.set_title("Uncertainty")
    right.plot(*MM * plane.places[:, :2].T, ".", color="white", markersize=2)
    left.set_ylabel("across [mm]")
    for n, name, marker in ((measured.argmax(), "stiffest", "^"), (measured.argmin(), "softest", "v")):
        label = f"{name}: place {printable(result.presses.places[n])[:MAX_LABEL_LENGTH]}"
        style_of_extreme = {"markersize": 12, "color": "none", "markeredgecolor": VERMILION, "markeredgewidth": 1.5}
        left.plot(*MM * plane.places[n, :2], marker, label=label, **style_of_extreme)
    for text in figure.legend(loc="upper right", ncols=2, frameon=False).get_texts():
        text.set_parse_math(False)


def _draw_panel(axes: Axes, plane: Plane, values: Array, norm: Normalize, colours: str, label: str) -> None:
    (x, y), (width, height) = MM * plane.low, plane.size
    extent = (x, x + MM * width, y, y + MM * height)
    axes.set_facecolor(UNKNOWN)
    image = axes.imshow(values, colours, norm=norm, extent=extent, interpolation="bilinear")
    axes.set(xlabel="along the longest side [mm]", aspect="equal")
    axes.grid(visible=False)
    add_colour_bar(axes, image, label, "bottom", 0.9)


def _draw_curves(figure: Figure, result: Palpation) -> None:
    presses, fit, scores = result.presses, result.map.fit, result.scores
    order = np.argsort(scores.map)
    titles = ("Best", "Median", "Worst")
    chosen = order[0], order[len(order) // 2], order[-1]
    for axes, title, n in zip(figure.subplots(1, 3), titles, chosen, strict=True):
        rows = np.flatnonzero(presses.index == n)
        rows = rows[np.argsort(presses.depth[rows])]
        depth = MM * presses.depth[rows]
        axes.fill_between(
            depth,
            scores.forces.low[rows],
            scores.forces.high[rows],
            color=SKY,
            alpha=0.3,
            linewidth=0,
            label="90 % of new presses",
        )
        axes.plot(depth, scores.forces.force[rows], color=BLUE, linestyle=(0, (4, 2)), label="predicted, left out")
        fine = np.linspace(presses.depth[rows].min(), presses.depth[rows].max(), 100)
        axes.plot(MM * fine, fit.stiffness[n] * fit.law.force(fine + fit.offset[n]), color=INK, label="fitted")
        axes.plot(depth, presses.force[rows], "o", color=VERMILION, label="measured")
        error = f"{100 * scores.map[n]:.2g} % off"
        label = printable(presses.places[n])[:MAX_LABEL_LENGTH]
        axes.set_title(f"{title}: place {label}, {error}", parse_math=False)
        axes.set(xlabel="depth of the table [mm]")
    figure.axes[0].set_ylabel("force [N]")
    figure.axes[0].legend(loc="upper left")
