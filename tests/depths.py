"""Depth maps of a wavy wall, and scenes with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.scenes import speckle

WIDTH, HEIGHT, FOCAL = 48, 36, 40.0

SCENE = """\
image: frame.png
sheet:
  points: [9, 11]
  surface:
    depth: {file: depth.npy, unit: mm}
tissue: {young: 2.0e+4, thickness: 0.002, density: 1000, foundation: 1.0e+5, damping: 30}
probes:
  - {at: [0.5, 0.5], total: -0.05, radius: 0.01, load: [[0, 0], [0.1, 100]]}
time: {duration: 0.2, frames_per_second: 50, precision: f64}
render: {camera: {intrinsics: {fx: 40, fy: 40, cx: 23.5, cy: 17.5}}}
output: [trajectory]
"""


def wall(tilt: float = 0.4, height: float = 4.0) -> NDArray[np.float64]:
    """Depths of a tilted wavy wall about 60 mm away [mm], shape (HEIGHT, WIDTH)."""
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH - 0.5, (np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5)
    return 60 / (1 - tilt * x + 0.2 * y) + height * np.cos(5 * x + 1) * np.cos(4 * y)


def write_depth_scene(folder: Path) -> None:
    """Write scene.yaml, frame.png and depth.npy into a folder."""
    Image.fromarray(speckle(HEIGHT, WIDTH)).save(folder / "frame.png")
    np.save(folder / "depth.npy", wall())
    (folder / "scene.yaml").write_text(SCENE)
