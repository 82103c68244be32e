"""Style of plots: colours, widths of figures and settings of Matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

# The palette of Okabe and Ito, safe for colour-blind readers.
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
INK, GREY, SILVER, PALE = "#222222", "#767676", "#A0A0A0", "#E6E6E6"

# Settings of Matplotlib, for `matplotlib.style.context`.
STYLE = Path(__file__).with_name("plots.mplstyle")

DPI = 200

# Widths of figures [in].
TWO_COLUMN_WIDTH, ONE_COLUMN_WIDTH = 9.0, 6.0


def add_colour_bar(axes: Axes, image: AxesImage, label: str, location: str, shrink: float) -> None:
    """Add a colour bar to axes, with few numbers in decimal notation."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, ScalarFormatter

    assert isinstance(axes.figure, Figure)
    bar = axes.figure.colorbar(image, ax=axes, label=label, location=location, shrink=shrink)
    if isinstance(image.norm, LogNorm):
        bar.locator, bar.formatter = LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)), ScalarFormatter()
        bar.minorformatter = NullFormatter()
    else:
        bar.locator = MaxNLocator(5)
    bar.update_ticks()
