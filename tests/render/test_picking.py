"""Picking, the inverse of projection, and cameras that a user orbits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm.cameras.extrinsics import extrinsics
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.camera import orbit_camera, pinhole, view
from taichi_msm.render.picking import intersect_rest_plane, pick
from taichi_msm.render.rasterizer import Rasterizer
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.render.test_labels import folded
from tests.render.test_rasterizer import drawable

# In the middle of the sheet, half of which is behind the eye; the picture extends above the horizon.
NEAR_EYE = {"eye": [0.02, -0.02, 0.05], "target": [0, 0.15, 0.02], "up": [0, 0, 1], "fov": 90}
CAMERAS = pytest.mark.parametrize("camera", ["top", "oblique", NEAR_EYE], ids=["top", "oblique", "near"])


def sheet(camera: Any, refine: int = 2) -> Scene:
    return drawable((7, 9), size=[96, 80], camera=camera, refine=refine, shading="none")


@pytest.mark.default_cases("oblique-2")
@pytest.mark.parametrize("refine", [0, 2])
@CAMERAS
def test_picked_point_is_the_drawn_point(camera: Any, refine: int, device: Device) -> None:
    made = sheet(camera, refine)
    position = folded(made)
    # Red is the column of 256, green the row; blue marks the sheet.
    texture = np.full((256, 256, 3), 255, np.uint8)
    texture[..., 0], texture[..., 1] = np.arange(256), np.arange(256)[:, None]
    picture = Rasterizer(made, texture).draw(position).astype(int)
    pixels = [(x, y) for y in range(0, 80, 3) for x in range(0, 96, 3)]
    covered, mismatches = 0, 0
    for x, y in pixels:
        picked = pick(position, refine, view(made), (x, y))
        *drawn, blue = picture[y, x]
        mismatches += (picked is None) != (blue == 0)
        if picked is not None and blue:
            covered += 1
            for fraction, level in zip(picked, drawn, strict=True):
                # Half a level by rounding, and the resolution of f32; beyond the outermost texels colours are constant.
                assert fraction * 256 - 0.5 == pytest.approx(level, abs=1.1 if level in (0, 255) else 0.6)
    assert covered > 0.15 * len(pixels)
    assert mismatches <= 2, "outlines are exact but for rounding"


@CAMERAS
def test_rest_plane_is_the_sheet_at_rest(camera: Any) -> None:
    made = sheet(camera)
    height, width = made.sheet.size
    count = 0
    for pixel in [(30, 40), (48, 44), (60.5, 50.25)]:
        if picked := pick(rest_positions(made.sheet), 2, view(made), pixel):
            count += 1
            expected = [(picked[0] - 0.5) * width, (0.5 - picked[1]) * height]
            assert intersect_rest_plane(view(made), pixel) == pytest.approx(expected, abs=1e-12)
    assert count >= 2


def test_no_rest_plane_above_the_horizon() -> None:
    camera = view(sheet({"eye": [0, -1, 0.1], "target": [0, 0, 0.1], "up": [0, 0, 1], "fov": 60}))
    # The horizon is row 39.5.
    assert [intersect_rest_plane(camera, (48, row)) is None for row in (10, 39.5, 70)] == [True, True, False]


def test_no_rest_plane_outside_the_image_of_a_lens() -> None:
    # The distorted radius r - 0.5 r^3 is at most 0.54 focal lengths, 32 pixels.
    lens = {"intrinsics": {"fx": 60, "fy": 60, "cx": 48, "cy": 40}, "distortion": {"k1": -0.5}}
    camera = view(sheet({"eye": [0, 0, 0.5], "target": [0, 0, 0], "up": [0, 1, 0], "outside": "background", **lens}))
    assert [intersect_rest_plane(camera, (x, 40)) is None for x in (48, 78, 82, 1e12)] == [False, False, True, True]


def test_orbit_keeps_target_and_distance() -> None:
    camera = pinhole(sheet("oblique"))
    eye = extrinsics(camera, 0).eye
    orbited = orbit_camera(camera, 0.4, -0.2)
    assert orbited.target == camera.target
    assert extrinsics(orbited, 0).distance == pytest.approx(extrinsics(camera, 0).distance)
    assert extrinsics(orbit_camera(orbit_camera(camera, 0.4, 0), -0.4, 0), 0).eye == pytest.approx(eye)
    # Over the sheet: higher.
    assert extrinsics(orbit_camera(camera, 0, 0.2), 0).eye[2] > eye[2]
    # About the normal: at the same height, and counter-clockwise from above.
    x, _, z = extrinsics(orbit_camera(camera, 0.2, 0), 0).eye
    assert z == pytest.approx(eye[2])
    assert x > eye[0]


def test_pinhole_camera_has_the_scale_of_top() -> None:
    made = sheet("top")
    above = made.model_copy(update={"render": made.render.model_copy(update={"camera": pinhole(made)})})
    for camera in (made, above):
        assert view(camera).pixels(rest_positions(made.sheet)[0, 0]) == pytest.approx((0.0, 4.0), abs=1e-9)
