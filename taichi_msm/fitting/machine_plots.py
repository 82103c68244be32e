"""Panels of a machine test: force over time and over depth, measured and fitted, and the residual."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from taichi_msm.errors import printable
from taichi_msm.fitting.machine_fit import FittedTest
from taichi_msm.plot_style import BLUE, GREY, SILVER, VERMILION


def _plot_time(axes: Axes, fitted: FittedTest, *, several: bool) -> None:
    """Plot the force over time: all rows of the table, frames, and the fitted force."""
    loading = fitted.loading
    axes.plot(loading.test.time, loading.test.force, ".", color=SILVER, markersize=2, label="table")
    axes.plot(loading.time, loading.force, ".", color=VERMILION, markersize=3, label="measured, of a frame")
    axes.plot(loading.time, fitted.force, color=BLUE, label="fitted")
    # The file is in the title of the figure if there is one test only.
    title = printable(Path(loading.test.name).name) if several else "Force over time"
    axes.set_title(title, parse_math=False)
    axes.set(xlabel="time [s]", ylabel="force [N]")
    axes.legend()


def _plot_depth(axes: Axes, fitted: FittedTest, **_: bool) -> None:
    """Plot the force over depth, with the depth of contact."""
    loading = fitted.loading
    axes.plot(1000 * loading.test.depth, loading.test.force, ".", color=SILVER, markersize=2)
    axes.plot(1000 * loading.depth, loading.force, ".", color=VERMILION, markersize=3)
    axes.plot(1000 * loading.depth, fitted.force, color=BLUE)
    axes.axvline(1000 * fitted.contact, color=GREY, linewidth=0.8, linestyle=(0, (4, 2)), label="contact")
    axes.set(title="Force over depth", xlabel="depth of the table [mm]", ylabel="force [N]")
    axes.legend()


def _plot_residual(axes: Axes, fitted: FittedTest, **_: bool) -> None:
    """Plot fitted minus measured force over time, with twice the noise on either side."""
    loading = fitted.loading
    axes.axhspan(-2 * loading.noise, 2 * loading.noise, color=SILVER, alpha=0.4, linewidth=0, label="2 x noise")
    axes.plot(loading.time, fitted.force - loading.force, color=BLUE, linewidth=0.8)
    limit = 1.1 * float(np.abs(fitted.force - loading.force).max())
    share = 100 * fitted.residual / loading.peak
    axes.set(xlabel="time [s]", ylabel="fitted minus measured [N]", ylim=(-limit, limit))
    axes.set_title(f"Residual, {share:.2g} % rms of peak")
    axes.legend()


MACHINE_PANELS = (_plot_time, _plot_depth, _plot_residual)
