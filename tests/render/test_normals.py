"""Normal labels: against the twin and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import Solid, place_instruments
from taichi_msm.render.camera import view
from taichi_msm.render.labels import LABELS
from taichi_msm.scene.scene import Scene
from taichi_msm.shapes import SHAPES
from taichi_msm.system.runtime import Device
from tests.lenses.test_lenses import INTRINSICS, LENSES
from tests.reference import labels as twin
from tests.render.test_labels import crumpled, draw_labels, folded
from tests.render.test_rasterizer import NEAR, dented, drawable, with_instruments

Array = NDArray[np.float64]

CALIBRATED = {"eye": [0.05, -0.2, 0.3], "target": [0, 0, 0], "intrinsics": INTRINSICS}
CAMERAS: dict[str, Any] = {
    "top": "top",
    "pinhole": NEAR,
    "calibrated": CALIBRATED,
    **{lens: {**CALIBRATED, **LENSES[lens]} for lens in ("endoscope", "rational", "fisheye")},
}


def angle(a: Any, b: Any) -> Array:
    """Small angles between unit vectors [rad]."""
    return np.asarray(np.linalg.norm(np.subtract(a, b, dtype=float), axis=-1))


def points(made: Scene, depth: NDArray[np.float32]) -> Array:
    """Visible points of pixels [m], in OpenCV's axes of the camera, shape (height, width, 3)."""
    camera, (width, height) = view(made), made.render.size
    y, x = np.mgrid[:height, :width] + 0.5
    offset = (camera.undistort(np.stack([x, y], axis=-1)) - camera.centre) / camera.scale
    z = depth[..., None].astype(float)
    return np.concatenate([offset * z if camera.pinhole else offset, z], axis=-1)


def axes(made: Scene) -> Array:
    """OpenCV's axes of the camera, as columns."""
    return view(made).axes.T * [1, -1, -1]


@pytest.mark.default_cases("folded-top")
@pytest.mark.parametrize(("shape", "camera"), [(folded, "top"), (dented, "pinhole"), (crumpled, "endoscope")])
def test_normals_match_the_twin(shape: Any, camera: str, device: Device) -> None:
    made = with_instruments(drawable(camera=CAMERAS[camera]))
    position = shape(made)
    labels, without = draw_labels(made, position, LABELS), draw_labels(made, position)
    assert without.normals.shape == (0, 0, 3)
    for label, expected_label in zip(labels[:3], without[:3], strict=True):
        np.testing.assert_array_equal(label, expected_label)
    expected = twin.normals(made, position, place_instruments(made, position, 0))
    np.testing.assert_array_equal(np.isnan(labels.normals), np.isnan(expected))
    visible = ~np.isnan(expected[..., 0])
    normals, error = labels.normals[visible], angle(labels.normals, expected)[visible]
    # As with other labels, rounding moves an edge past a pixel's centre now and then. Elsewhere the error is that of
    # the sides of a small quad in f32 and, where an instrument is edge-on, of a root.
    assert (error < 3e-4).mean() > 0.998
    assert np.median(error) < 1e-6
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    sight = points(made, np.ones_like(labels.depth))[visible] if view(made).pinhole else np.array([0, 0, 1])
    assert ((sight * normals).sum(axis=-1) < 1e-6).all(), "toward the camera"


@pytest.mark.default_cases("top", "calibrated")
@pytest.mark.parametrize("camera", CAMERAS)
def test_normals_of_a_plane_and_a_capsule(camera: str, device: Device) -> None:
    made = with_instruments(drawable(camera=CAMERAS[camera]))
    rest, (a, b) = rest_positions(made.sheet), np.radians([30, 20])
    tilt = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    tilt = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]]) @ tilt
    for side in (1, -1):  # The front, then the back.
        normals = draw_labels(made, rest * [side, 1, 1] @ tilt.T, LABELS, ()).normals
        normals = normals[~np.isnan(normals[..., 0])]
        assert len(normals) > 0.15 * 80 * 60
        # 2^-24 of a coordinate of the picture, some hundred, over the sides of a small quad, a few pixels long.
        np.testing.assert_allclose(normals, np.tile(tilt[:, 2] @ axes(made), (len(normals), 1)), atol=2e-5)

    capsule = Solid(np.array([-0.03, 0.02, 0.03]), np.array([0.96, 0.0, 0.28]), 0.05, 0.03, SHAPES["capsule"])
    labels = draw_labels(made, rest, LABELS, [capsule])
    tip, axis = (capsule.tip - view(made).eye) @ axes(made), capsule.axis @ axes(made)
    offset = points(made, labels.depth) - tip
    along = offset @ axis
    outward = (offset - np.clip(along, 0, capsule.length)[..., None] * axis) / capsule.radius
    visible = labels.instrument == 255
    for part in (along < 0, (along > 0) & (along < capsule.length), along > capsule.length):
        assert (visible & part).sum() > 10
    # Edge-on, the root of the intersection has half of f32's digits.
    np.testing.assert_allclose(np.linalg.norm(outward[visible], axis=-1), 1, atol=1e-4)
    error = angle(labels.normals[visible], outward[visible])
    assert np.median(error) < 1e-6
    assert error.max() < 1e-4
