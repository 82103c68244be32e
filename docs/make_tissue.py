"""Compare the laws of tissue with those of solids, and draw stretching and relaxation, for docs/tissue-models.md.

    PYTHONPATH=. python docs/make_tissue.py

Writes two pictures, and prints the numbers of the page. Takes some seconds.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, root

from taichi_msm.arithmetic import NUMPY
from taichi_msm.laws.locking import Locking
from taichi_msm.plot_style import (
    BLUE,
    DPI,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    SILVER,
    STYLE,
    TWO_COLUMN_WIDTH,
    VERMILION,
)
from taichi_msm.terms.law import build_law

Floats = NDArray[np.float64]

IMAGES = Path(__file__).parent / "images"

# Springs of a square cell of side 1, for E t = 1: direction at rest, and stiffness.
SPRINGS = (((1, 0), 3 / 4), ((0, 1), 3 / 4), ((1, 1), 3 / 8), ((1, -1), 3 / 8))

# The law of the figure, and one that locks so strongly that the lattice collapses off its rows.
LOCK, STRONG = (0.5, 10.0), (0.3, 30.0)
FIT_RANGE = 1.3
STRETCHES = np.linspace(1, 1.4, 81)

# Loss factors with their colours, and the frequencies [Hz] over which three branches hold them.
LOSS_FACTORS, BAND = {0.1: GREEN, 0.2: BLUE, 0.3: VERMILION}, (0.1, 10.0)


def lattice_stress(a: float, b: float, g: float = 0.0, angle: float = 0.0, law: tuple[float, float] = LOCK) -> Floats:
    """Return the derivatives of the lattice's energy by a, b and g, over E and the thickness at rest.

    Args:
        a: stretch along x.
        b: stretch along y.
        g: shear; a bond (x, y) becomes (a x + g y, b y).
        angle: of the rows of springs to x [rad].
        law: `lock` and `factor` of `stiffening`.
    """
    secant, shape = build_law(Locking(), NUMPY).secant, Locking().shape(law[1])
    stress = np.zeros(3)
    for (column, row), k in SPRINGS:
        x = column * np.cos(angle) - row * np.sin(angle)
        y = column * np.sin(angle) + row * np.cos(angle)
        now, rest = np.array([a * x + g * y, b * y]), np.hypot(column, row)
        length = np.hypot(*now)
        pull = k * (length - rest) * secant((length / rest - 1) / law[0], shape) / length
        stress += pull * np.array([now[0] * x, now[1] * y, now[0] * y])
    return stress


def stretch_lattice(angle: float, law: tuple[float, float] = LOCK) -> tuple[Floats, Floats]:
    """Return stress and width at STRETCHES along an angle to the rows, with free sides."""
    stress, width, free = [], [], np.array([1.0, 0.0])
    for a in STRETCHES:
        free = root(lambda free, a=a: lattice_stress(a, free[0], free[1], angle, law)[1:], free).x
        stress.append(lattice_stress(a, free[0], free[1], angle, law)[0])
        width.append(free[0])
    return np.array(stress), np.array(width)


def solid_stress(law: str, shape: float, stretch: Floats, *, both: bool) -> Floats:
    """Return the nominal stress over E of an incompressible solid.

    Args:
        law: "exponential", W = mu / (2 shape) (exp(shape (I1 - 3)) - 1), or "Ogden", of one term with this exponent.
        shape: 0 with "exponential", or 2 with "Ogden", is the neo-Hookean solid.
        stretch: any shape.
        both: stretched equally in both directions, rather than in one.
    """
    third = stretch**-2 if both else stretch**-0.5
    if law == "Ogden":
        return 2 / 3 / shape * (stretch**shape - third**shape) / stretch
    invariant = (2 * stretch**2 + third**2 if both else stretch**2 + 2 * third**2) - 3
    return np.exp(shape * invariant) / 3 * (stretch - third**2 / stretch)


def fit_shape(law: str, stress: Floats) -> float:
    """Return the shape with which a solid has the stress, with free sides, up to FIT_RANGE."""
    near = STRETCHES <= FIT_RANGE
    solution = least_squares(lambda s: solid_stress(law, s[0], STRETCHES[near], both=False) - stress[near], [4.0])
    return float(solution.x[0])


def draw_stretching() -> None:
    """Draw stress and width of the lattice and of solids."""
    angles = {"along the rows": 0.0, "at 22.5° to them": np.pi / 8}
    lattice = {name: stretch_lattice(angle) for name, angle in angles.items()}
    uniaxial = lattice["along the rows"][0]
    equal = np.array([lattice_stress(a, a)[0] for a in STRETCHES])
    solids = {
        "neo-Hookean": ("exponential", 0.0, SILVER),
        "exponential (Fung)": ("exponential", fit_shape("exponential", uniaxial), VERMILION),
        "Ogden, one term": ("Ogden", fit_shape("Ogden", uniaxial), ORANGE),
    }
    with plt.style.context(STYLE, after_reset=True):
        figure, (uniaxial_axes, biaxial_axes, width_axes) = plt.subplots(
            1, 3, figsize=(TWO_COLUMN_WIDTH, 3.1), layout="constrained"
        )
        for name, (law, shape, colour) in solids.items():
            for axes, both in ((uniaxial_axes, False), (biaxial_axes, True)):
                axes.plot(STRETCHES, solid_stress(law, shape, STRETCHES, both=both), color=colour, label=name)
            print(name, f"shape {shape:.3g}")
        for (name, (stress, width)), style in zip(lattice.items(), ("-", "--"), strict=True):
            uniaxial_axes.plot(STRETCHES, stress, style, color=BLUE, linewidth=1.8, label=f"sheet, {name}")
            width_axes.plot(STRETCHES, width, style, color=BLUE, linewidth=1.8, label=f"sheet, {name}")
            for label, values in (("width", width), ("stress", stress)):
                print(
                    label,
                    name,
                    dict(zip(STRETCHES[::20].round(2).tolist(), values[::20].round(3).tolist(), strict=True)),
                )
        biaxial_axes.plot(STRETCHES, equal, color=BLUE, linewidth=1.8)
        strong = stretch_lattice(np.pi / 8, STRONG)[1]
        width_axes.plot(STRETCHES, strong, ":", color=PURPLE, linewidth=1.8, label="the same, lock 0.3, factor 30")
        for numbers in ((0.3, 10.0), STRONG, (0.3, 100.0)):
            ends = [stretch_lattice(angle, numbers)[1][-1] for angle in angles.values()]
            print(f"width at {STRETCHES[-1]}, lock and factor {numbers}: {ends[0]:.3f}, off the rows {ends[1]:.3f}")
        width_axes.plot(STRETCHES, STRETCHES**-0.5, color=INK, linewidth=0.8, label="incompressible solids")
        for stretch in (1.1, 1.15, 1.2, 1.3):
            at = np.argmin(abs(STRETCHES - stretch))
            ratios = {
                name: float(equal[at] / solid_stress(law, shape, STRETCHES[at], both=True))
                for name, (law, shape, _) in solids.items()
            }
            print(f"equibiaxial at {stretch}: sheet {equal[at]:.3g}, over solids", ratios)
        uniaxial_axes.set(title="One direction", ylabel="force / (E · section at rest)", ylim=(0, 1.5))
        biaxial_axes.set(title="Both directions equally", ylabel="force / (E · section at rest)", ylim=(0, 3))
        width_axes.set(title="Width, one direction", ylabel="width / width at rest", ylim=(0.4, 1))
        for axes in (uniaxial_axes, biaxial_axes, width_axes):
            axes.set(xlabel="stretch", xlim=(1, 1.4))
        uniaxial_axes.legend(loc="upper left")
        width_axes.legend(loc="lower left")
        figure.savefig(IMAGES / "tissue-stretch.png", dpi=DPI)
        plt.close(figure)


def loss_factor(shares: Floats, times: Floats, frequency: Floats) -> Floats:
    """Return the ratio of lost to stored modulus at frequencies [Hz], for shares and times [s] of `relaxation`."""
    x = 2 * np.pi * np.outer(frequency, times)
    stored = 1 - shares.sum() + (shares * x**2 / (1 + x**2)).sum(axis=1)
    return np.asarray((shares * x / (1 + x**2)).sum(axis=1) / stored)


def fit_branches(wanted: float) -> tuple[Floats, Floats]:
    """Return three shares and times [s] that hold a loss factor over BAND; the largest deviation is made small."""
    frequency = np.geomspace(*BAND, 101)

    def split(logs: Floats) -> tuple[Floats, Floats]:
        return np.exp(logs[:3]), np.exp(logs[3:])

    logs = np.log([wanted, wanted / 2, wanted / 2, 0.012, 0.16, 2.0])
    # Rising powers approach the largest deviation.
    for power in (1, 2, 4, 8):
        logs = least_squares(lambda p, n=power: (8 * (loss_factor(*split(p), frequency) / wanted - 1)) ** n, logs).x
    shares, times = split(logs)
    order = np.argsort(times)
    return shares[order], times[order]


def held_force(shares: Floats, times: Floats, ramp: float, t: Floats) -> Floats:
    """Return the force over that of a sudden load, after t [s] of a linear ramp that is then held."""
    rising = np.minimum(t, ramp)[:, None]
    memory = shares * times / ramp * (np.exp((rising - t[:, None]) / times) - np.exp(-t[:, None] / times))
    return np.asarray((1 - shares.sum()) * rising[:, 0] / ramp + memory.sum(axis=1))


def draw_relaxation() -> None:
    """Draw loss factors over frequency, and the force of ramps of several durations."""
    frequency = np.geomspace(BAND[0] / 10, BAND[1] * 10, 401)
    with plt.style.context(STYLE, after_reset=True):
        figure, (left, right) = plt.subplots(1, 2, figsize=(TWO_COLUMN_WIDTH, 3.1), layout="constrained")
        left.axvspan(*BAND, color=SILVER, alpha=0.18, linewidth=0)
        for wanted, colour in LOSS_FACTORS.items():
            shares, times = fit_branches(wanted)
            achieved = loss_factor(shares, times, frequency)
            inside = (frequency >= BAND[0]) & (frequency <= BAND[1])
            worst = abs(achieved[inside] / wanted - 1).max()
            print(
                f"loss factor {wanted}: shares {shares.round(3)}, times {times.round(4)} s, within {100 * worst:.2g} %"
            )
            left.plot(frequency, achieved, color=colour)
            left.plot(BAND, [wanted, wanted], color=INK, linewidth=0.6, linestyle=":")
            left.text(1, wanted * 1.07, f"{wanted:g}", color=colour, ha="center", va="bottom", fontweight="bold")
        left.set(title="Loss factor of three branches", xlabel="frequency [Hz]", ylabel="lost / stored modulus")
        left.set(xscale="log", xlim=frequency[[0, -1]], ylim=(0, 0.4))
        left.xaxis.set_major_formatter("{x:g}")
        shares, times = fit_branches(0.2)
        t = np.geomspace(1e-3, 100, 1201)
        for ramp, colour in ((1e-6, INK), (0.1, PURPLE), (1.0, BLUE), (10.0, GREEN)):
            force = held_force(shares, times, ramp, t)
            name = "sudden" if ramp < t[0] else f"{ramp:g} s"
            right.plot(t, force, color=colour, label=name)
            print(f"ramp of {ramp} s: peak {force.max():.3f}, at last {force[-1]:.3f}")
        for time in times:
            right.axvline(time, color=SILVER, linewidth=0.6, linestyle="--")
        right.set(title="A ramp, then held", xlabel="time [s]", ylabel="force / that of a sudden load")
        right.set(xscale="log", xlim=t[[0, -1]], ylim=(0, 1.05))
        right.xaxis.set_major_formatter("{x:g}")
        right.text(times[2] * 1.1, 0.98, "times of the branches", color=GREY, fontsize=7.5)
        right.legend(title="ramp", loc="center right", bbox_to_anchor=(1, 0.72))
        figure.savefig(IMAGES / "tissue-relaxation.png", dpi=DPI)
        plt.close(figure)


if __name__ == "__main__":
    draw_stretching()
    draw_relaxation()
