"""Draw the convergence of curved sheets to closed forms and finite elements, docs/images/surfaces.png.

PYTHONPATH=. python docs/make_surfaces.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

from taichi_msm.plot_style import BLUE, DPI, GREEN, ONE_COLUMN_WIDTH, SILVER, STYLE, VERMILION
from tests.test_reference_surface import conformal_cap, dome_errors, pressurised, slanted_tube

mpl.use("Agg")
import matplotlib.pyplot as plt

FIGURE = Path(__file__).parent / "images" / "surfaces.png"
COUNTS = (9, 17, 33, 65)


def main() -> None:
    """Compute the errors, print them, and draw them."""
    errors = {
        "tube of rhombi under pressure, closed form": np.array([pressurised(*slanted_tube(n), -1) for n in COUNTS]),
        "spherical cap under pressure, closed form": np.array([pressurised(*conformal_cap(n), 1) for n in COUNTS]),
        "dome pressed off centre on a foundation, finite elements": np.abs(dome_errors(COUNTS)),
    }
    with plt.style.context(STYLE):
        figure, axes = plt.subplots(figsize=(ONE_COLUMN_WIDTH, 3.4), layout="constrained")
        for (name, values), colour, marker in zip(errors.items(), (BLUE, VERMILION, GREEN), "osD", strict=True):
            axes.loglog(COUNTS, 100 * values, color=colour, marker=marker, label=name)
            print(name, *(f"{100 * value:.3g} %" for value in values), sep=", ")
        square = 100 * errors["spherical cap under pressure, closed form"][0] * (COUNTS[0] / np.array(COUNTS)) ** 2 / 2
        axes.loglog(COUNTS, square, color=SILVER, linestyle="--", label="second order")
        axes.set(xlabel="points a side", ylabel="error (%)", xticks=COUNTS, xticklabels=map(str, COUNTS))
        axes.minorticks_off()
        axes.legend()
        figure.savefig(FIGURE, dpi=DPI)


if __name__ == "__main__":
    main()
