"""Draw the layers of the package and the imports between them (transitive reduction), from the source.

    PYTHONPATH=. python docs/make_architecture.py

Writes docs/images/architecture.png.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from taichi_msm.plot_style import BLUE, DPI, GREY, INK
from tests.test_architecture import LAYERS, MODULES, imports, module_name

# Without __init__ and __main__, which only lead to the others.
SHOWN = [[name for name in sorted(layer) if not name.startswith("__")] for layer in LAYERS]
WIDTH, HEIGHT, GAP, PITCH = 1.7, 0.62, 1.12, 2.3


def arrows() -> Counter[tuple[str, str]]:
    """Count the imports from a module or package to another."""
    edges: Counter[tuple[str, str]] = Counter()
    for path in MODULES:
        upper = module_name(path).split(".")[0]
        edges.update((upper, lower) for name in imports(path) if (lower := name.split(".")[0]) != upper)
    return edges


def direct(edges: Counter[tuple[str, str]]) -> Counter[tuple[str, str]]:
    """Return the edges of the transitive reduction."""

    def leads(start: str, end: str) -> bool:
        return any(lower == end or leads(lower, end) for upper, lower in edges if upper == start)

    return Counter(
        {
            (upper, lower): count
            for (upper, lower), count in edges.items()
            if not any(leads(middle, lower) for start, middle in edges if start == upper and middle != lower)
        }
    )


def main() -> None:
    """Write the diagram."""
    layers = [layer for layer in SHOWN if layer]
    centres = {
        name: (PITCH * (column - (len(layer) - 1) / 2), GAP * level)
        for level, layer in enumerate(layers)
        for column, name in enumerate(layer)
    }
    reach = (PITCH * (max(map(len, layers)) - 1) + WIDTH) / 2 + 0.1
    figure = Figure(figsize=(2.12 * reach, 8.4), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-0.6, GAP * (len(layers) - 1) + 0.6)
    for (upper, lower), count in direct(arrows()).items():
        if upper in centres and lower in centres:
            (x, y), (to_x, to_y) = centres[upper], centres[lower]
            bend = 0.0 if abs(x - to_x) > 0.1 or y - to_y < 1.5 * GAP else 0.45
            arrow = FancyArrowPatch(
                (x, y - HEIGHT / 2),
                (to_x, to_y + HEIGHT / 2),
                connectionstyle=f"arc3,rad={bend}",
                arrowstyle="-|>",
                mutation_scale=9,
                linewidth=0.6 + 0.12 * min(count, 12),
                color=GREY,
                alpha=0.75,
            )
            axes.add_patch(arrow)
    packages = {path.parent.name for path in MODULES if path.name == "__init__.py"}
    for name, (x, y) in centres.items():
        filled = name in packages
        box = FancyBboxPatch(
            (x - WIDTH / 2, y - HEIGHT / 2),
            WIDTH,
            HEIGHT,
            boxstyle="round,pad=0,rounding_size=0.08",
            facecolor=BLUE if filled else "white",
            edgecolor=BLUE,
            linewidth=1.2,
            zorder=3,
        )
        axes.add_patch(box)
        text = f"{name}/" if filled else f"{name}.py"
        axes.text(x, y, text, ha="center", va="center", color="white" if filled else INK, fontsize=10, zorder=4)
    figure.savefig(Path(__file__).parent / "images" / "architecture.png", format="png")


if __name__ == "__main__":
    main()
