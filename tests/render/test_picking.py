"""From the picture back to the sheet: what is picked at a pixel is what is drawn there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.camera import extrinsics, orbit_camera, pinhole, view
from taichi_msm.render.picking import intersect_rest_plane, pick
from taichi_msm.render.rasterizer import Rasterizer
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.render.test_labels import folded
from tests.render.test_rasterizer import drawable

# Amid the sheet, of which half is behind it, and as wide as to see above the horizon.
NEAR_EYE = {"eye": [0.02, -0.02, 0.05], "target": [0, 0.15, 0.02], "up": [0, 0, 1], "fov": 90}
CAMERAS = pytest.mark.parametrize("camera", ["top", "oblique", NEAR_EYE], ids=["top", "oblique", "near"])


def sheet(camera: Any, refine: int = 2) -> Scene:
    return drawable((7, 9), size=[96, 80], camera=camera, refine=refine, shading="none")


@pytest.mark.default_cases("oblique-2")
@pytest.mark.parametrize("refine", [0, 2])
@CAMERAS
def test_what_is_picked_is_what_is_drawn(camera: Any, refine: int, device: Device) -> None:
    shown = sheet(camera, refine)
    position = folded(shown)
    # Red is the column of 256, green the row, and blue that it is the sheet.
    texture = np.full((256, 256, 3), 255, np.uint8)
    texture[..., 0], texture[..., 1] = np.arange(256), np.arange(256)[:, None]
    picture = Rasterizer(shown, texture).draw(position).astype(int)
    pixels = [(x, y) for y in range(0, 80, 3) for x in range(0, 96, 3)]
    covered, missed = 0, 0
    for x, y in pixels:
        place = pick(position, refine, view(shown), (x, y))
        column, row, blue = picture[y, x]
        if (place is None) != (blue == 0):
            missed += 1
        elif place is not None:
            covered += 1
            # Half a level by rounding, and what f32 makes of a place.
            assert place[0] * 256 - 0.5 == pytest.approx(column, abs=0.6 + 0.02 * (column in (0, 255)) * 25)
            assert place[1] * 256 - 0.5 == pytest.approx(row, abs=0.6 + 0.02 * (row in (0, 255)) * 25)
    assert covered > 0.15 * len(pixels)
    assert missed <= 2, "outlines are exact but for the pixels that rounding decides"


@CAMERAS
def test_on_the_rest_plane_is_where_the_sheet_at_rest_is_picked(camera: Any) -> None:
    shown = sheet(camera)
    height, width = shown.sheet.size
    found = 0
    for pixel in [(30, 40), (48, 44), (60.5, 50.25)]:
        place = pick(rest_positions(shown.sheet), 2, view(shown), pixel)
        if place is not None:
            found += 1
            point = intersect_rest_plane(view(shown), pixel)
            assert point == pytest.approx([(place[0] - 0.5) * width, (0.5 - place[1]) * height], abs=1e-12)
    assert found >= 2


def test_above_the_horizon_there_is_no_rest_plane() -> None:
    camera = {"eye": [0, -1, 0.1], "target": [0, 0, 0.1], "up": [0, 0, 1], "fov": 60}
    assert intersect_rest_plane(view(sheet(camera)), (48, 10)) is None
    assert intersect_rest_plane(view(sheet(camera)), (48, 39.5)) is None, "the line of sight never gets there"
    assert intersect_rest_plane(view(sheet(camera)), (48, 70)) is not None


def test_a_camera_turned_keeps_its_target_and_distance() -> None:
    camera = pinhole(sheet("oblique"))
    moved = orbit_camera(camera, 0.4, -0.2)
    apart = extrinsics(camera, 0).eye - camera.target
    assert np.linalg.norm(extrinsics(moved, 0).eye - moved.target) == pytest.approx(np.linalg.norm(apart))
    assert moved.target == camera.target
    back = orbit_camera(orbit_camera(camera, 0.4, 0), -0.4, 0)
    assert extrinsics(back, 0).eye == pytest.approx(extrinsics(camera, 0).eye)
    # Over the sheet: higher.
    assert extrinsics(orbit_camera(camera, 0, 0.2), 0).eye[2] > extrinsics(camera, 0).eye[2]
    # About the normal: as high as it was, and counter-clockwise seen from above.
    assert extrinsics(orbit_camera(camera, 0.2, 0), 0).eye[2] == pytest.approx(extrinsics(camera, 0).eye[2])
    assert extrinsics(orbit_camera(camera, 0.2, 0), 0).eye[0] > extrinsics(camera, 0).eye[0]


def test_the_pinhole_above_shows_the_sheet_as_large_as_from_the_top() -> None:
    shown = sheet("top")
    above = shown.model_copy(update={"render": shown.render.model_copy(update={"camera": pinhole(shown)})})
    rest = rest_positions(shown.sheet)
    for camera in (shown, above):
        x, y, w, _ = view(camera).matrix @ [*rest[0, 0], 1]
        assert (x / w, y / w) == pytest.approx((0.0, 4.0)), camera.render.camera
