"""Sheets with a picture by a camera: at rest, the frame of that camera is the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.cameras.extrinsics import extrinsics
from taichi_msm.cameras.view import View, pinhole_view
from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.render.camera import view_at
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.texture import load_texture
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.framing import POSE_AT_ORIGIN
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.lenses.test_lenses import LENSES
from tests.scenes import scene, speckle

Array = NDArray[np.float64]

SIZE = WIDTH, HEIGHT = 96, 72
PINHOLE = {"intrinsics": {"fx": 80, "fy": 78, "cx": 49.2, "cy": 34.3}}
CAMERAS: dict[str, dict[str, Any]] = {
    "pinhole": PINHOLE,
    "rational": {**PINHOLE, "distortion": {"k1": -0.1, "k2": 0.02, "p1": 0.004, "p2": -0.003}},
    "fisheye": {**PINHOLE, **LENSES["fisheye"]},
    "omnidir": {"intrinsics": {"fx": 150, "fy": 148, "cx": 49.2, "cy": 34.3}, **LENSES["omnidir"]},
    "scaramuzza": {"intrinsics": {"cx": 49.2, "cy": 34.3}, **LENSES["scaramuzza"]},
}


def depth_map(camera: dict[str, Any]) -> Array:
    """Depth [m] of a tilted plane with waves at all pixels of a camera, shape (height, width)."""
    view = pinhole_view(
        Camera(**camera, pose=POSE_AT_ORIGIN), SIZE, extrinsics(Camera(**camera, pose=POSE_AT_ORIGIN), 0.0), 0.0
    )
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
    x, y = np.moveaxis((view.undistort(pixels) - view.centre) / view.scale, -1, 0)
    depth = np.full(x.shape, 0.06)
    for _ in range(60):
        depth = 0.06 + 0.3 * x * depth - 0.2 * y * depth + 0.002 * np.cos(150 * x * depth) * np.cos(120 * y * depth)
    return depth


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory with the picture."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Image.fromarray(speckle(HEIGHT, WIDTH)).save("image.png")
    return tmp_path


def pictured(camera: dict[str, Any], surface: dict[str, Any] | None = None, **sections: Any) -> Scene:
    """A sheet by a depth map of a camera, or by another surface."""
    np.save("depth.npy", depth_map(camera))
    surface = surface or {"depth": {"file": "depth.npy", "unit": "m"}, "grid": "given"}
    sheet = {"points": [10, 13], "mass": 1e-3, "surface": surface}
    render = {"camera": camera, "shading": "none", "refine": 4, **sections.pop("render", {})}
    return scene(image="image.png", sheet=sheet, render=render, **sections)


def draw_at_rest(made: Scene, view: View | None = None, **config: Any) -> NDArray[np.uint8]:
    drawing = drawing_config(made)._replace(**config)
    return Rasterizer(made, load_texture(made), drawing).draw(rest_of(made.sheet).position, view)


def assert_is_picture(frame: NDArray[np.uint8], picture: NDArray[np.uint8], least_share: float = 1.0) -> None:
    """Equal but for one level, where there is sheet: a texel is off by 1e-3 px, of 255 levels per px at most."""
    covered = (frame > 0).any(axis=-1)
    assert covered.mean() >= least_share
    difference = np.abs(frame.astype(int) - picture)[covered]
    print("share", covered.mean(), "max", difference.max(), "ones", (difference > 0).mean())
    assert difference.max() <= 1


@pytest.mark.parametrize("shading", ["none", "headlight", "tissue"])
@pytest.mark.parametrize("lens", CAMERAS)
def test_frame_at_rest_is_the_picture(lens: str, shading: str, folder: Path, device: Device) -> None:
    made = pictured(CAMERAS[lens], render={"shading": shading, "light": {"relief": 0.5}})
    assert made.render.size == SIZE
    assert_is_picture(draw_at_rest(made), load_texture(made), 1.0 if lens == "pinhole" else 0.95)
