"""Style of plots: colours, widths of figures and settings of Matplotlib."""

from __future__ import annotations

from pathlib import Path

# The palette of Okabe and Ito, safe for colour-blind readers.
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
INK, GREY, SILVER, PALE = "#222222", "#767676", "#A0A0A0", "#E6E6E6"

# Settings of Matplotlib, for `matplotlib.style.context`.
STYLE = Path(__file__).with_name("plots.mplstyle")

DPI = 200

# Widths of figures [in].
TWO_COLUMN_WIDTH, ONE_COLUMN_WIDTH = 9.0, 6.0
