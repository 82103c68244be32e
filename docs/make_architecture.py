"""Draw the packages in the order of their imports, from the source.

    PYTHONPATH=. python docs/make_architecture.py

Writes docs/images/architecture.png.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from taichi_msm.plot_style import BLUE, DPI, GREY, PALE, STYLE
from tests.test_architecture import LAYER, MODULES

# Packages by purpose. Modules without a package are those that several import, and have no boxes.
ROWS = {
    "command line": ("cli",),
    "measurements": ("fitting", "palpation", "machines"),
    "uses of runs": ("study", "sweeps", "view", "exports"),
    "a run": ("runs", "gradients", "load", "render"),
    "numerics": ("accuracy", "solver", "terms"),
    "scene and sheet": ("model", "cameras", "scene"),
    "files": ("camera_files", "surfaces"),
    "formulas": ("laws", "lenses", "shapes"),
    "machine": ("system",),
}
WIDTH, HEIGHT, PITCH, STEP, LABEL = 1.5, 0.44, 1.65, 0.62, 1.75


def check() -> None:
    """Refuse a table that lacks a package, or whose order is not that of the imports."""
    order = [name for row in ROWS.values() for name in row]
    packages = {path.parent.name for path in MODULES if path.name == "__init__.py"} - {"taichi_msm"}
    levels = [[LAYER[name] for name in row] for row in ROWS.values()]
    assert set(order) == packages, set(order) ^ packages
    assert all(min(upper) >= max(lower) for upper, lower in pairwise(levels)), "rows are not in order"
    assert all(row == sorted(row, reverse=True) for row in levels), "packages of a row are not in order"


def main() -> None:
    """Write the diagram."""
    check()
    width = LABEL + PITCH * max(map(len, ROWS.values()))
    with style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(width, STEP * len(ROWS)), dpi=DPI)
        FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set(xlim=(0, width), ylim=(STEP * len(ROWS), 0))
        for row, (title, names) in enumerate(ROWS.items()):
            middle = STEP * (row + 0.5)
            axes.text(LABEL - 0.2, middle, title, ha="right", va="center", color=GREY, fontsize=11)
            axes.axhspan(STEP * row, STEP * (row + 1), color=PALE if row % 2 else "white", alpha=0.5, zorder=0)
            for column, name in enumerate(names):
                left = LABEL + PITCH * column
                box = FancyBboxPatch(
                    (left, middle - HEIGHT / 2),
                    WIDTH,
                    HEIGHT,
                    boxstyle="round,pad=0,rounding_size=0.08",
                    facecolor=BLUE,
                    edgecolor="none",
                )
                axes.add_patch(box)
                axes.text(left + WIDTH / 2, middle, f"{name}/", ha="center", va="center", color="white", fontsize=12)
        figure.savefig(Path(__file__).parent / "images" / "architecture.png", format="png")


if __name__ == "__main__":
    main()
