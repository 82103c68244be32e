"""Shapes of tools: intersections of rays, and the resistance and the picture of a plate."""

from __future__ import annotations

import math

import numpy as np
import pytest

from taichi_msm.arithmetic import NUMPY
from taichi_msm.errors import SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.shapes import SHAPES
from taichi_msm.system.runtime import Device
from tests.golden import Messages

K, SIDE, POINTS, RADIUS = 4e5, 0.1, 41, 0.0205


@pytest.mark.parametrize("name", SHAPES)
def test_ray_meets_the_surface_of_the_depth(name: str) -> None:
    rng = np.random.default_rng(1)
    axis = np.array([0.6, -0.48, 0.64])
    numbers = *axis, 0.3, 0.1
    depth, intersect = (build(NUMPY) for build in (SHAPES[name].build_depth, SHAPES[name].build_ray))
    origin = rng.normal(size=(1000, 3))
    origin *= 2 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = rng.uniform(-0.2, 0.4, (1000, 3)) - origin
    products = ((direction**2).sum(axis=1), direction @ axis, origin @ axis, (origin * direction).sum(axis=1))
    t, is_hit, foot, end = intersect(*products, (origin**2).sum(axis=1), *numbers[3:])
    along = np.linspace(0, 2, 2001)[:, None]
    inside = depth(*(o + along * d for o, d in zip(origin.T, direction.T, strict=True)), *numbers)[0] > 0
    assert 0.1 < inside.any(axis=0).mean() < 0.95
    # Rays that only graze the shape may slip between samples.
    assert (is_hit >= inside.any(axis=0)).all()
    assert (is_hit != inside.any(axis=0)).mean() < 0.01
    hits = is_hit & inside.any(axis=0)
    points = origin + t[:, None] * direction
    depth_at_hit, *outward = depth(*points.T, *numbers)
    np.testing.assert_allclose(depth_at_hit[hits], 0, atol=1e-9)
    first = along[inside.argmax(axis=0), 0]
    assert ((first - t)[hits] >= -1e-9).all()
    assert ((first - t)[hits] <= 1e-3 + 1e-9).mean() > 0.98
    normal = np.where(end[:, None] != 0, end[:, None] * axis, points - foot[:, None] * axis)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert np.linalg.norm(normal.T - outward, axis=0)[hits].max() < 1e-6


def plate_scene() -> Scene:
    rod = {"plate": RADIUS, "shaft": [0, 0, 1], "length": 0.05}
    return Scene(
        sheet={"points": [POINTS, POINTS], "size": [SIDE, SIDE]},
        tissue={"young": 1e-6, "thickness": 1e-3, "foundation": K, "foundation_active": "always"},
        probes=[{"path": [[0, 0.5, 0.5, 0], [1, 0.5, 0.5, -4e-4]], "instrument": rod}],
        time={"motion": "quasistatic", "frames_per_second": 1, "duration": 1},
        render={"size": [100, 100], "supersample": 1},
        output=[],
    )


def test_plate_force_and_picture(device: Device) -> None:
    # The foundation K under the mass points within the radius: F = K A w.
    cell = SIDE / (POINTS - 1)
    points = sum(math.hypot(i, j) * cell < RADIUS for i in range(-20, 21) for j in range(-20, 21))
    assert points * cell**2 == pytest.approx(math.pi * RADIUS**2, rel=0.02)
    with Simulation(plate_scene(), threads=device.threads) as simulation:
        simulation.advance()
        (on_tool,) = simulation.forces()
        np.testing.assert_allclose(on_tool.force, [0, 0, -K * points * cell**2 * 4e-4], rtol=1e-6, atol=1e-9)
        coverage = simulation.labels().instrument
        assert simulation.progress.pierced_by == 0
    pixels = np.hypot(*np.meshgrid(*2 * [(np.arange(100) - 49.5) * SIDE / 100]))
    np.testing.assert_array_equal(coverage == 255, pixels < RADIUS)


def test_invalid_plates_are_rejected(message: Messages) -> None:
    made = plate_scene().model_dump(mode="json")
    made["probes"][0]["path"][0][3] = -1e-3
    with message.raises(SceneError, "probes.0.path"):
        check_scene(made)
    made["probes"][0]["instrument"]["radius"] = 0.01
    with message.raises(SceneError, "probes.0.instrument.plate"):
        check_scene(made)
    made["probes"][0]["instrument"] = {"shaft": [0, 0, 1], "length": 0.05}
    with message.raises(SceneError, "probes.0.instrument.radius"):
        check_scene(made)
