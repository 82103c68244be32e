from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.render.camera import problems, view
from taichi_msm.scene import Scene
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
    toward = view(made).toward
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


def test_right_is_right_and_up_is_up() -> None:
    for camera in ("top", "oblique", {"eye": [0, 0, 1]}):
        made = with_camera(camera)
        centre = pixel(made, [0, 0, 0])[0]
        assert pixel(made, [0.01, 0, 0])[0][0] > centre[0]
        assert pixel(made, [0, 0.01, 0])[0][1] < centre[1]
        assert pixel(made, [0, 0, 0.01])[1] < pixel(made, [0, 0, 0])[1]


@pytest.mark.parametrize("away", [1e-3, 1.0, 1e6])
def test_the_distance_of_the_target_does_not_matter(away: float) -> None:
    near, far = with_camera({"eye": [0, 0, 0.3]}), with_camera({"eye": [0, 0, 0.3], "target": [0, 0, 0.3 - away]})
    np.testing.assert_allclose(view(far).matrix, view(near).matrix, atol=1e-9)
    assert view(far).near == view(near).near < 1e-6


def test_cameras_that_see_nothing_are_refused() -> None:
    assert [str(p) for p in problems(with_camera({"eye": [0, 0, 0]}))] == [
        "render.camera.eye: [0.0, 0.0, 0.0] is also the target; move one of them"
    ]
    assert [str(p) for p in problems(with_camera({"eye": [0, 2, 0]}))] == [
        "render.camera.up: [0.0, 1.0, 0.0] is zero or along the line of sight; take a direction across it"
    ]
    assert not list(problems(with_camera({"eye": [0, 0, 1]})))
