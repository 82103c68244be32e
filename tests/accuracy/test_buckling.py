"""Warnings about strips that a clamp compresses along their plane."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm.accuracy.buckling import buckling_warnings
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.scenes import scene

FOUNDATION: dict[str, Any] = {"foundation": 1e4, "foundation_active": "always"}


def strip(motion: str, shift: float, across: float = 0.0, **tissue: Any) -> Scene:
    """A strip of 60 mm whose right end is moved by a distance [m], under a force across it [N]."""
    probes: list[dict[str, Any]] = [{"clamp": "right", "path": [[0, 0, 0, 0], [1, shift, 0, 0]]}]
    if across:
        probes.append({"at": [0.5, 0.5], "total": [0, 0, across], "radius": 0.004, "load": [[0, 100]]})
    return scene(
        sheet={"points": [7, 19], "size": [0.02, 0.06], "fixed": ["left"]},
        tissue={"young": 5e4, "thickness": 2e-3, "density": 1050, "damping": 20, **tissue},
        springs=None,
        damping=0,
        probes=probes,
        time={"motion": motion, "duration": 1, "frames_per_second": 5, "precision": "auto"},
    )


def simulate(made: Scene, device: Device) -> tuple[list[str], Any]:
    """Return the warnings of a run and the heights of its last frame [m]."""
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(5)
        return list(buckling_warnings(simulation._plan, simulation.progress)), simulation.positions()[..., 2]


@pytest.mark.parametrize(("motion", "tissue"), [("quasistatic", FOUNDATION), ("dynamic", {})])
def test_side_of_a_compressed_strip_is_not_determined(
    motion: str, tissue: dict[str, Any], device: Device, message: Messages
) -> None:
    """By symmetry forces within the plane are balanced on either side; in motion nothing moves the strip out of it."""
    (warning,), heights = simulate(strip(motion, -0.006, **tissue), device)
    message(warning)
    assert heights.any() == (motion == "quasistatic")


@pytest.mark.parametrize("across", [2e-6, -2e-6])
def test_small_force_across_a_strip_selects_its_side(across: float, device: Device) -> None:
    """A thousandth of the force of the clamp, 2 mN, exceeds the random perturbation of the solver."""
    warnings, heights = simulate(strip("quasistatic", -0.006, across, **FOUNDATION), device)
    assert not warnings
    assert np.sign(heights.flat[np.abs(heights).argmax()]) == np.sign(across)


@pytest.mark.parametrize("motion", ["quasistatic", "dynamic"])
def test_stretched_strip_remains_flat(motion: str, device: Device) -> None:
    warnings, heights = simulate(strip(motion, 0.006, **FOUNDATION), device)
    assert not warnings
    assert np.abs(heights).max() < 1e-9
