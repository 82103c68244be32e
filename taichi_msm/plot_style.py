"""Style of plots: colours, widths of figures and settings of Matplotlib."""

from __future__ import annotations

# The palette of Okabe and Ito, safe for colour-blind readers.
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
INK, GREY, SILVER, PALE = "#222222", "#767676", "#A0A0A0", "#E6E6E6"

STYLE = {
    "font.size": 8,
    "text.color": INK,
    "figure.titlesize": 11,
    "figure.titleweight": "bold",
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.grid": True,
    **dict.fromkeys(("axes.spines.top", "axes.spines.right"), False),
    "grid.color": PALE,
    "grid.linewidth": 0.5,
    **dict.fromkeys(("xtick.color", "ytick.color"), GREY),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("xtick.minor.width", "ytick.minor.width"), 0.4),
    "lines.linewidth": 1.2,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    **dict.fromkeys(("legend.fontsize", "legend.title_fontsize"), 7.5),
}

DPI = 200

# Widths of figures [in].
TWO_COLUMN_WIDTH, ONE_COLUMN_WIDTH = 9.0, 6.0
