"""Projections of cameras against closed forms, and cameras that are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.camera import camera_problems, view
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.scenes import scene


def project(made: Scene, point: Any) -> tuple[NDArray[Any], float]:
    """Pixel and depth of a point."""
    x, y, w, depth = view(made).matrix @ [*point, 1]
    return np.array([x / w, y / w]), depth


def with_camera(camera: Any, size: tuple[int, int] = (100, 60)) -> Scene:
    return scene(render={"camera": camera, "size": list(size)})


def test_top_projection() -> None:
    # 0.3 m x 0.4 m in 100 x 60 pixels: 200 px/m.
    made = with_camera("top")
    np.testing.assert_allclose(project(made, [0.1, 0.05, 0])[0], [70, 20])
    assert project(made, [0, 0, 0.1])[1] < project(made, [0, 0, 0])[1]


def test_pinhole_projection() -> None:
    eye, target = np.array([0.2, -0.5, 0.7]), np.array([0.05, 0.1, 0])
    made = with_camera({"eye": eye.tolist(), "target": target.tolist(), "fov": 50})
    np.testing.assert_allclose(project(made, target)[0], [50, 30], atol=1e-12)
    # At the target's depth, half the picture's height up and to the right; pixels are square.
    toward, distance = view(made).axes[2], np.linalg.norm(eye - target)
    right = np.cross([0, 1, 0], toward) / np.linalg.norm(np.cross([0, 1, 0], toward))
    for direction, expected in ((np.cross(toward, right), [50, 0]), (right, [80, 30])):
        pixel, depth = project(made, target + direction * distance * np.tan(np.radians(25)))
        np.testing.assert_allclose(pixel, expected, atol=1e-12)
        assert depth == pytest.approx(distance)


@pytest.mark.parametrize("sheet_size", [(0.3, 0.4), (2.0, 0.1), (1e-3, 0.5)])
@pytest.mark.parametrize("size", [(100, 60), (40, 90), (640, 8), (1, 1)])
def test_margin_of_the_fit_preset(sheet_size: tuple[float, float], size: tuple[int, int]) -> None:
    render = {"camera": "fit", "size": list(size)}
    made = scene(sheet={"points": [3, 3], "size": list(sheet_size), "mass": 1e-3}, render=render)
    pixels = np.array([project(made, point)[0] for point in rest_positions(made.sheet).reshape(-1, 3)])
    x, y = pixels.T / np.reshape(size, (2, 1))
    bounds = np.array([x.min(), 1 - x.max(), y.min(), 1 - y.max()])
    # Rounding of numbers of about 1.
    np.testing.assert_allclose(bounds[::2], bounds[1::2], atol=1e-12, err_msg="the sheet is centred")
    assert bounds.min() == pytest.approx(0.02, abs=1e-12), "it touches the margin on two sides"
    lower, upper = (project(made, [0, sign * sheet_size[0] / 2, 0])[1] for sign in (-1, 1))
    assert lower < upper, "the lower edge is nearer"


@pytest.mark.parametrize("size", [(80, 60), (40, 90), (200, 30)])
def test_oblique_preset_shows_the_whole_sheet(size: tuple[int, int]) -> None:
    made = with_camera("oblique", size)
    for corner in rest_positions(made.sheet)[[0, 0, -1, -1], [0, -1, 0, -1]]:
        pixel, _ = project(made, corner)
        assert ((pixel > 0) & (pixel < size)).all()


@pytest.mark.parametrize(("length", "distance"), [(5e-324, 1e-3), (1e30, 1e6)])
def test_invariance_to_the_length_of_up_and_the_distance_of_the_target(length: float, distance: float) -> None:
    expected, up, target = (
        view(with_camera({"eye": [0, 0, 0.3], **camera}))
        for camera in ({}, {"up": [0, length, 0]}, {"target": [0, 0, 0.3 - distance]})
    )
    # Some roundings, of numbers up to 1.
    np.testing.assert_allclose(up.axes, expected.axes, rtol=0, atol=4 * np.finfo(float).eps)
    np.testing.assert_allclose(target.matrix, expected.matrix, atol=1e-9)
    assert target.near == expected.near < 1e-6


@pytest.mark.parametrize(
    ("key", "camera"),
    [
        ("eye", {"eye": [0.1, 0.2, 1e-31], "target": [0.1, 0.2, 0]}),
        ("up", {"eye": [0, 2, 0]}),
        ("up", {"eye": [0, 0, 1], "up": [0, 0, 0]}),
        # Kernels have the camera's matrix in f32, where 1e30 m times 4.7e8 px, for the smallest angle, overflows.
        ("eye", {"eye": [0, 0, 1e30], "target": [1e30, 0, 0], "fov": 1e-3}),
    ],
    ids=["eye at the target", "up along the line of sight", "up of length 0", "eye too far away"],
)
def test_invalid_extrinsics(key: str, camera: dict[str, Any], message: Messages) -> None:
    made = with_camera(camera, size=(100, 8192))
    with message.raises(SceneError, f"render.camera.{key}") as caught:
        view(made)
    assert [str(problem) for problem in camera_problems(made)] == [str(caught.value)]


@pytest.mark.parametrize("fov", [9.99e-4, 180])
def test_invalid_fov(fov: float, message: Messages) -> None:
    with message.raises(SceneError, f"fov: {fov}"):
        Camera(eye=(0, 0, 1), fov=fov)


@pytest.mark.parametrize("distance", [1e-30, 1e-15, 1.0, 1e15, 1e30])
@pytest.mark.parametrize("fov", [1e-3, 40, 179.9999999999999])
@pytest.mark.parametrize("size", [1e-30, 0.1, 1e30])
def test_extreme_cameras(distance: float, fov: float, size: float, device: Device) -> None:
    """They are refused, or draw without a warning, which would be an error in tests."""
    camera = {"eye": [0, -distance, distance], "fov": fov}
    instrument = {"radius": max(size / 9, 1e-30), "shaft": [0, 0, 1], "length": size}
    made = scene(
        sheet={"points": [3, 3], "size": [size, size], "mass": 1e-3},
        render={"camera": camera, "size": [8, 8], "shading": "tissue", "supersample": 1},
        probes=[{"force": [0, 0, 0], "instrument": instrument}],
    )
    if list(camera_problems(made)):
        return
    with Simulation(made, threads=device.threads, texture=np.zeros((2, 2, 3), np.uint8)) as simulation:
        assert simulation.draw().shape == (8, 8, 3)
        simulation.flow(simulation.labels())
