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
from taichi_msm.scene.section import MAX_SUPERSAMPLE
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.scenes import scene


def pixel(made: Scene, point: list[float]) -> tuple[NDArray[Any], float]:
    """Pixel and depth of a point."""
    x, y, w, depth = view(made).matrix @ [*point, 1]
    return np.array([x / w, y / w]), depth


def with_camera(camera: Any, size: tuple[int, int] = (100, 60)) -> Scene:
    return scene(render={"camera": camera, "size": list(size)})


def test_top_is_to_scale_and_the_higher_is_nearer() -> None:
    # 0.3 m x 0.4 m in 100 x 60 pixels: 200 pixels a metre.
    made = with_camera("top")
    np.testing.assert_allclose(pixel(made, [0.1, 0.05, 0])[0], [70, 20])
    assert pixel(made, [0, 0, 0.1])[1] < pixel(made, [0, 0, 0])[1]


def test_pinhole_looks_at_its_target_with_its_angle() -> None:
    made = with_camera({"eye": [0.2, -0.5, 0.7], "target": [0.05, 0.1, 0], "fov": 50})
    np.testing.assert_allclose(pixel(made, [0.05, 0.1, 0])[0], [50, 30], atol=1e-12)
    # A point at the target's depth, half the picture's height up.
    toward = view(made).axes[2]
    right = np.cross([0, 1, 0], toward)
    right /= np.linalg.norm(right)
    up = np.cross(toward, right)
    distance = np.linalg.norm(np.subtract([0.2, -0.5, 0.7], [0.05, 0.1, 0]))
    edge = np.add([0.05, 0.1, 0], up * distance * np.tan(np.radians(25)))
    at, depth = pixel(made, list(edge))
    np.testing.assert_allclose(at, [50, 0], atol=1e-12)
    assert depth == pytest.approx(distance)
    # Pixels are square: as far to the right, as many of them.
    edge = np.add([0.05, 0.1, 0], right * distance * np.tan(np.radians(25)))
    np.testing.assert_allclose(pixel(made, list(edge))[0], [80, 30], atol=1e-12)


@pytest.mark.parametrize("sheet_size", [(0.3, 0.4), (2.0, 0.1), (1e-3, 0.5)])
@pytest.mark.parametrize("size", [(100, 60), (40, 90), (640, 8), (1, 1)])
def test_fit_fills_the_picture_up_to_its_margin(sheet_size: tuple[float, float], size: tuple[int, int]) -> None:
    render = {"camera": "fit", "size": list(size)}
    made = scene(sheet={"points": [3, 3], "size": list(sheet_size), "mass": 1e-3}, render=render)
    pixels = np.array([pixel(made, list(point))[0] for point in rest_positions(made.sheet).reshape(-1, 3)])
    x, y = pixels.T / np.reshape(size, (2, 1))
    bounds = np.array([x.min(), 1 - x.max(), y.min(), 1 - y.max()])
    # Rounding of numbers of about 1.
    np.testing.assert_allclose(bounds[::2], bounds[1::2], atol=1e-12, err_msg="the sheet is in the middle")
    assert bounds.min() == pytest.approx(0.02, abs=1e-12), "it touches the margin on two sides"
    assert view(made).matrix[3] @ [0, -sheet_size[0] / 2, 0, 1] < view(made).matrix[3] @ [0, sheet_size[0] / 2, 0, 1]


@pytest.mark.parametrize("away", [1e-3, 1.0, 1e6])
def test_the_distance_of_the_target_does_not_matter(away: float) -> None:
    near, far = with_camera({"eye": [0, 0, 0.3]}), with_camera({"eye": [0, 0, 0.3], "target": [0, 0, 0.3 - away]})
    np.testing.assert_allclose(view(far).matrix, view(near).matrix, atol=1e-9)
    assert view(far).near == view(near).near < 1e-6


@pytest.mark.parametrize(
    ("key", "camera"),
    [
        *(("eye", {"eye": [0.1, 0.2, away], "target": [0.1, 0.2, 0]}) for away in (0, 1e-300, 1e-31)),
        ("up", {"eye": [0, 2, 0]}),
        *(("up", {"eye": [0, 0, 1], "up": zero}) for zero in ([0, 0, 0], [0, 0, 1e-300])),
        # Kernels have the camera's matrix in f32, where 1e30 m times 4.7e8 px, for the smallest angle, overflows.
        ("eye", {"eye": [0, 0, 1e30], "target": [1e30, 0, 0], "fov": 1e-3}),
    ],
    ids=["at the target", "near the target", "nearer", "up along the view", "no up", "tiny up", "far"],
)
def test_cameras_that_see_nothing_are_refused(key: str, camera: dict[str, Any], message: Messages) -> None:
    made = with_camera(camera, size=(100, 8192))
    with message.raises(SceneError, f"render.camera.{key}") as caught:
        view(made)
    assert [str(problem) for problem in camera_problems(made)] == [str(caught.value)]


@pytest.mark.parametrize("fov", [0, 1e-300, 9.99e-4, 180])
def test_an_angle_that_no_picture_can_have_is_refused(fov: float, message: Messages) -> None:
    with message.raises(SceneError, f"fov: {fov}"):
        Camera(eye=(0, 0, 1), fov=fov)


@pytest.mark.parametrize("length", [5e-324, 1e-300, 1e-160, 1e-30, 1e30])
def test_the_length_of_up_does_not_matter(length: float) -> None:
    expected = view(with_camera({"eye": [0.1, -0.3, 0.4]})).axes
    found = view(with_camera({"eye": [0.1, -0.3, 0.4], "up": [0, length, 0]})).axes
    # Some roundings, of numbers up to 1.
    np.testing.assert_allclose(found, expected, rtol=0, atol=4 * np.finfo(float).eps)


def test_a_far_eye_of_a_wide_angle_has_a_finite_matrix() -> None:
    made = with_camera({"eye": [0, 0, 1e30], "target": [1e30, 0, 0], "fov": 40}, size=(100, 8192))
    assert not list(camera_problems(made))
    assert np.isfinite((view(made).matrix * MAX_SUPERSAMPLE).astype(np.float32)).all()


@pytest.mark.parametrize("distance", [1e-30, 1e-15, 1.0, 1e15, 1e30])
@pytest.mark.parametrize("fov", [1e-3, 40, 179.9999999999999])
@pytest.mark.parametrize("size", [1e-30, 0.1, 1e30])
def test_extreme_cameras_draw_without_a_warning_or_are_refused(
    distance: float, fov: float, size: float, device: Device
) -> None:
    """Tests turn every warning into an error."""
    camera = {"eye": [0, -distance, distance], "fov": fov}
    rod = {"radius": max(size / 9, 1e-30), "shaft": [0, 0, 1], "length": size}
    made = scene(
        sheet={"points": [3, 3], "size": [size, size], "mass": 1e-3},
        render={"camera": camera, "size": [8, 8], "shading": "tissue", "supersample": 1},
        probes=[{"force": [0, 0, 0], "instrument": rod}],
    )
    if list(camera_problems(made)):
        return
    with Simulation(made, threads=device.threads, texture=np.zeros((2, 2, 3), np.uint8)) as simulation:
        assert simulation.draw().shape == (8, 8, 3)
        simulation.flow(simulation.labels())
