"""The shipped scene of a frame with its depth."""

from pathlib import Path

import numpy as np
from PIL import Image

from taichi_msm import Simulation, load_scene
from taichi_msm.system.runtime import Device

PRESSED, DEPTH = 0.4, 0.007  # when the probe is deepest [s], and its depth below the wall [m]


def test_frame_at_rest_is_the_picture(device: Device, root: Path) -> None:
    scene = load_scene(root / "scenes" / "frame.yaml", {"probes": [], "time.duration": 0.04})
    assert scene.image is not None
    with Simulation(scene) as simulation, Image.open(scene.image) as picture:
        drawn, expected = simulation.draw().astype(int), np.asarray(picture.convert("RGB")).astype(int)
    assert drawn.shape == expected.shape == (384, 480, 3)
    # One level: the place of a texel is rounded to f32, and its colour to an integer.
    assert np.abs(drawn - expected).max() <= 1


def test_probe_presses_the_wall(device: Device, root: Path) -> None:
    scene = load_scene(root / "scenes" / "frame.yaml", {"time.duration": PRESSED, "output": ["trajectory"]})
    with Simulation(scene) as simulation:
        rest = simulation.positions()
        simulation.advance(round(PRESSED * scene.time.frames_per_second))
        moved = np.linalg.norm(simulation.positions() - rest, axis=-1)
        probe, grasper = simulation.forces()
    # Mass points are 1.5 mm apart: next to the deepest point of the round tip of 4 mm radius the wall is up to 1.06 mm
    # from a mass point, where the tip is 4 - (4^2 - 1.06^2)^(1/2) = 0.15 mm higher.
    assert DEPTH - 0.00015 < moved.max() < DEPTH + 0.00015
    assert np.linalg.norm(probe.force) > 0.1
    assert np.linalg.norm(grasper.force) == 0
