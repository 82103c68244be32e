"""Closed form of the force of a ball on a foundation that locks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from taichi_msm import run
from taichi_msm.palpation.law import FACTOR, BallLaw
from taichi_msm.system.runtime import Device

RADIUS = 4e-3
DEPTHS = np.array([1e-6, 4e-5, 1e-4, 1e-3, 2e-3, 3.9e-3, 4.1e-3, 9e-3])
END = 1 - FACTOR**-0.5


def pressure(w: float, lock: float) -> float:
    """Force per area over K [m] of a foundation that is pressed in by w [m]."""
    if math.isinf(lock):
        return w
    x = min(w / lock, END)
    return x / (1 - x) * lock + FACTOR * max(w - END * lock, 0.0)


@pytest.mark.parametrize("lock", [math.inf, 2e-3, 4e-3, 9e-3])
def test_force_is_that_of_the_rings(lock: float) -> None:
    def integral(depth: float) -> float:
        top, bend = min(depth, RADIUS), depth - END * lock
        points = [bend] if 0 < bend < top else None

        def ring(s: float) -> float:
            return 2 * math.pi * (RADIUS - s) * pressure(depth - s, lock)

        return float(quad(ring, 0, top, points=points, epsabs=0, epsrel=1e-11)[0])

    # The accuracy of the quadrature.
    np.testing.assert_allclose(BallLaw(RADIUS, lock).force(DEPTHS), list(map(integral, DEPTHS)), rtol=1e-10)


@pytest.mark.parametrize("lock", [math.inf, 2e-3, 9e-3])
def test_slope_is_the_derivative_of_the_force(lock: float) -> None:
    law, step = BallLaw(RADIUS, lock), 1e-4 * DEPTHS
    difference = (law.force(DEPTHS + step) - law.force(DEPTHS - step)) / (2 * step)
    # Central differences are accurate to step^2 times the relative third derivative, of the order of 1 / depth^2 or,
    # near the lock, 40 / lock^2.
    np.testing.assert_allclose(law.slope(DEPTHS), difference, rtol=2e-6)


def test_no_force_without_contact() -> None:
    assert not BallLaw(RADIUS, 3e-3).force(np.array([-1e-3, 0.0])).any()
    assert not BallLaw(RADIUS, 3e-3).slope(np.array([-1e-3, 0.0])).any()


def test_wide_lock_is_linear() -> None:
    # lock(w) = w + w^2 / m to first order.
    np.testing.assert_allclose(BallLaw(RADIUS, 1e3).force(DEPTHS), BallLaw(RADIUS).force(DEPTHS), rtol=1e-5)


def test_rough_press_of_the_program(device: Device, tmp_path: Path) -> None:
    stiffness, lock, depth, side, points = 2e6, 4e-3, 2.5e-3, 0.012, 81
    instrument = {"radius": RADIUS, "shaft": [0, 0, 1], "length": 0.02}
    path = [[0, 0.5, 0.5, 0], [1, 0.5, 0.5, -depth]]
    scene = {
        "sheet": {"points": [points, points], "size": [side, side]},
        # Young's modulus times thickness is 3e-6 K R^2.
        "tissue": {
            "young": 0.1,
            "thickness": 1e-3,
            "foundation": {"young": stiffness * 0.01, "depth": 0.01, "lock": lock},
            "foundation_active": "always",
        },
        "probes": [{"path": path, "instrument": instrument, "friction": "rough"}],
        "time": {"duration": 1, "frames_per_second": 10, "motion": "quasistatic"},
        "output": ["forces"],
    }
    run(scene, tmp_path / "run", threads=device.threads, estimate_error=False)
    last = (tmp_path / "run" / "forces.csv").read_text().splitlines()[-1]
    expected = stiffness * float(BallLaw(RADIUS, lock).force(np.array([depth]))[0])
    # Mass points are squares of side h = R / 27. The pressure is 0 at the border of the contact, so the error of the
    # sum over squares is of second order: h^2 / 12 times the curvature of the dent over its depth, 1 / (R depth) each
    # way, 3.7e-4, and some more where the foundation locks.
    assert -float(last.split(",")[-1]) == pytest.approx(expected, rel=1e-3)
