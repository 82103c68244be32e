"""The order of the method, by regression over four halvings of the step, and an absolute bound of its error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.system.runtime import Device
from tests.motion import dynamics_of
from tests.scenes import plan_of, scene

FRAME = 0.04
# 50 (1 - cos) in pieces of 5 ms, which every step divides: its kinks fall on steps.
SMOOTH = [[0.005 * n, 50 - 50 * float(np.cos(np.pi * n / 40))] for n in range(81)]
RELEASE = [[0, 0], [0.2, 100], [0.24, 100], [0.24, 0]]


def final(device: Device, load: Any, cut: int, difference: str) -> NDArray[Any]:
    """Displacements at 0.4 s, with frames cut into so many steps."""
    made = scene(
        springs={"structural": 20, "shear": 10, "virtual": 5},
        damping=0.01,
        probes=[{"force": [0, 100, -300], "load": load, "falloff": 20, "at": [0.4, 0.6]}],
        time={"duration": 0.4, "step": FRAME / cut, "damping_difference": difference},
    )
    dynamics = dynamics_of(made, device)
    dynamics.advance(plan_of(made).grid.steps)
    displacement = dynamics.displacement()
    dynamics.close()
    return displacement


@pytest.mark.parametrize(
    ("load", "difference", "order", "bound"),
    [
        (SMOOTH, "central", 2, 2e-4),
        (RELEASE, "central", 2, 2e-3),
        (SMOOTH, "backward", 1, 4e-3),
        (RELEASE, "backward", 1, 1e-2),
    ],
    ids=["smooth-central", "release-central", "smooth-backward", "release-backward"],
)
def test_order(load: Any, difference: str, order: int, bound: float, device: Device) -> None:
    # Richardson's extrapolation of central differences is of order 4: at 1/16 of the finest step measured its error
    # is below theirs by more than 10^4.
    coarse, fine = (final(device, load, cut, "central") for cut in (10240, 20480))
    exact = (4 * fine - coarse) / 3
    cuts = [80, 160, 320, 640, 1280]
    errors = [np.abs(final(device, load, cut, difference) - exact).max() / np.abs(exact).max() for cut in cuts]
    slope = np.polyfit(np.log(cuts), np.log(errors), 1)[0]
    assert abs(-slope - order) < 0.1, errors
    assert errors[0] < bound
