"""What is known of every pixel, against the twin that tries every triangle, and closed forms."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import Solid, place_instruments
from taichi_msm.render import tracking
from taichi_msm.render.camera import view
from taichi_msm.render.labels import Labels, requested_labels
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.renderer import Renderer, Shot
from taichi_msm.render.tracking import compute_flow, locate_points
from taichi_msm.scene.scene import Scene
from taichi_msm.system import launches
from taichi_msm.system.runtime import Device
from tests.reference import labels as twin
from tests.render.test_rasterizer import NEAR, dented, drawable, with_instruments

Array = NDArray[np.float64]
CAMERAS = pytest.mark.parametrize("camera", ["top", "oblique", NEAR], ids=["top", "oblique", "near"])


def look(
    made: Scene, position: Array, names: Collection[str] = requested_labels(()), rods: Sequence[Solid] | None = None
) -> Labels:
    """Labels of these names, with the instruments of the scene by default."""
    config = drawing_config(made, picture=False, labels=names)
    placed = place_instruments(made, position, 0) if rods is None else rods
    found = Rasterizer(made, np.zeros((1, 1, 3), np.uint8), config).look(position, rods=placed).labels
    assert found is not None
    return found


def folded(made: Scene, seed: int = 3) -> Array:
    """A rough sheet whose right third lies over the middle."""
    position = rest_positions(made.sheet)
    right = position[..., 0] > 0.05
    rough = np.random.default_rng(seed).uniform(-0.006, 0.006, position.shape)
    position[..., 2] += np.where(right, 0.06, 0)
    position[..., 0] = np.where(right, 0.1 - position[..., 0], position[..., 0])
    return position + rough


def crumpled(made: Scene) -> Array:
    """Points that are moved by more than a cell, so that many cells are folded."""
    return rest_positions(made.sheet) + np.random.default_rng(5).normal(0, 0.03, (*made.sheet.points, 3))


def seen_as_by_the_twin(made: Scene, position: Array) -> Labels:
    """Labels that are those of the twin, and on the line of sight of each pixel."""
    placed = place_instruments(made, position, 0)
    found, (coordinates, depth, instrument) = look(made, position), twin.labels(made, position, placed)
    # Rounding moves an outline, or a fold, past a pixel's centre now and then; there is no other difference.
    alike = (np.isnan(found.coordinates[..., 0]) == np.isnan(coordinates[..., 0])) & (
        np.abs(found.depth - depth) < 1e-4 * depth.max()
    )
    assert alike.mean() > 0.997
    assert ((found.instrument == 255) == instrument)[alike].all()
    sheet = alike & ~np.isnan(coordinates[..., 0])
    assert sheet.mean() > 0.2
    pixels, _ = twin.project(made, found.coordinates[sheet].astype(float), position)
    assert np.abs(pixels - np.argwhere(sheet)[:, ::-1] - 0.5).max() < 0.01
    return found


@pytest.mark.default_cases("dented-oblique", "folded-near")
@CAMERAS
@pytest.mark.parametrize("shape", [dented, folded])
def test_coordinates_and_depth_are_those_of_the_twin(shape: Any, camera: Any, device: Device) -> None:
    made = with_instruments(drawable(camera=camera))
    assert seen_as_by_the_twin(made, shape(made)).instrument.any()


def hidden_as_by_the_twin(made: Scene, position: Array) -> NDArray[np.bool_]:
    """Which of many points are hidden; all are where the twin finds them."""
    coordinates = np.random.default_rng(9).uniform(0, 1, (2000, 2)).astype(np.float32)
    found = locate_points(made, coordinates, position, view(made))
    pixels, hidden = twin.project(made, coordinates.astype(float), position)
    np.testing.assert_array_equal(np.isnan(found.pixels), np.isnan(pixels))
    near = np.abs(pixels).max(axis=1) < 1e4
    np.testing.assert_allclose(found.pixels[near], pixels[near], atol=1e-4)
    # Beyond rounding: a point that is on an edge to 1e-9 of the sheet may be on either side.
    np.testing.assert_array_equal(found.hidden, hidden)
    return found.hidden


@CAMERAS
@pytest.mark.parametrize("refine", [0, 2])
@pytest.mark.parametrize("shape", [dented, folded, crumpled])
def test_points_are_found_and_hidden_as_the_twin_says(shape: Any, refine: int, camera: Any, device: Device) -> None:
    made = drawable(camera=camera, refine=refine)
    assert 0 < hidden_as_by_the_twin(made, shape(made)).mean() < 1 or shape is dented


@pytest.mark.parametrize("shape", [dented, folded, crumpled])
def test_on_a_gpu_the_same_points_are_found(shape: Any, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The form for a GPU, on the CPU: with the lists in one launch, and in many."""
    made = with_instruments(drawable(camera="oblique", refine=2))
    position, coordinates = shape(made), np.random.default_rng(9).uniform(0, 1, (1000, 2)).astype(np.float32)
    placed = place_instruments(made, position, 0)
    expected = locate_points(made, coordinates, position, view(made), placed)
    monkeypatch.setattr(tracking, "lanes", lambda precision: 1)
    assert locate_points(made, coordinates[:0], position, view(made), placed).pixels.shape == (0, 2)
    found = [locate_points(made, coordinates, position, view(made), placed)]
    # Two cells in a launch.
    monkeypatch.setattr(launches, "MAX_ROUNDS", launches.RESERVED_ROUNDS + 2 * (1 + 2 * 3**2))
    monkeypatch.setattr(launches, "VULKAN_THREADS", 100)
    found.append(locate_points(made, coordinates, position, view(made), placed))
    for sight in found:
        np.testing.assert_array_equal(sight.pixels, expected.pixels)
        np.testing.assert_array_equal(sight.hidden, expected.hidden)


def test_what_is_seen_is_not_hidden_in_the_same_frame(device: Device) -> None:
    for shape in (dented, folded):
        made = with_instruments(drawable(camera="oblique"))
        position = shape(made)
        seen = look(made, position).coordinates
        found = compute_flow(made, seen, position, view(made), place_instruments(made, position, 0))
        sheet = ~np.isnan(seen[..., 0])
        assert np.abs(found.flow[sheet]).max() < 1e-3
        assert (found.flow[~sheet] == 1e10).all()
        assert not found.occlusion[~sheet].any()
        # A sample that an outline passes through within rounding.
        assert (found.occlusion > 0).sum() <= 2


def test_an_instrument_hides_what_is_behind_it(device: Device) -> None:
    made = with_instruments(drawable(camera="top"))
    position = rest_positions(made.sheet)
    placed = place_instruments(made, position, 0)
    labels = look(made, position)
    down, across = np.meshgrid((np.arange(60) + 0.5) / 60, (np.arange(80) + 0.5) / 80, indexing="ij")
    points = np.stack([across, down], axis=-1).reshape(-1, 2)
    found = locate_points(made, points, position, view(made), placed)
    # At rest, from the top, a point is seen where it is: 80 x 60 pixels of 0.4 m x 0.3 m.
    np.testing.assert_allclose(found.pixels, points * [80, 60], atol=1e-4)
    np.testing.assert_array_equal(found.hidden, (labels.instrument == 255).ravel())


def test_a_flat_sheet_has_the_depth_of_its_camera(device: Device) -> None:
    made = drawable(camera="top")
    position = rest_positions(made.sheet)
    # From the plane that is the larger side, 0.4 m, above the sheet at rest.
    assert look(made, position).depth == pytest.approx(0.4, rel=1e-6)
    position[..., 2] = 0.05
    assert look(made, position).depth == pytest.approx(0.35, rel=1e-6)
    eye = drawable(camera={"eye": [0, 0, 0.25], "fov": 30})
    assert look(eye, position).depth == pytest.approx(0.2, rel=1e-6), "along the direction of view"


def test_a_sheet_that_is_shifted_flows_by_its_shift(device: Device) -> None:
    made = drawable(camera="top")
    rest = rest_positions(made.sheet)
    seen = look(made, rest).coordinates
    # 200 px a metre.
    found = compute_flow(made, seen, rest + np.array([0.01, 0.02, -0.1]), view(made))
    np.testing.assert_allclose(found.flow, np.tile([2.0, -4.0], (60, 80, 1)), atol=1e-3)
    # The right two columns and the upper four rows leave the picture.
    gone = np.zeros((60, 80), bool)
    gone[:, 78:] = True
    gone[:4] = True
    np.testing.assert_array_equal(found.occlusion, gone * 255)


def test_coordinates_at_an_edge_are_on_the_sheet(device: Device) -> None:
    made = drawable(camera="top")
    down, across = np.meshgrid(*(np.linspace(0, 0.14, n) for n in made.sheet.points), indexing="ij")
    # Two edges go through the centres of pixels, which are 5 mm wide; there f32 gives down to -3e-8.
    position = np.stack([0.0025 + across - down, 0.1275 - across - down, 0 * across], axis=-1)
    seen = look(made, position)
    assert np.nanmin(seen.coordinates) == 0
    flow = Renderer(made).flow(seen, Shot(position, view(made))).flow
    np.testing.assert_allclose(flow[~np.isnan(seen.coordinates[..., 0])], 0, atol=1e-3)


def test_points_behind_the_eye_are_nowhere(device: Device) -> None:
    made = drawable(camera={"eye": [0, 0, 0.02], "target": [0, 1, 0.02], "up": [0, 0, 1], "fov": 90})
    found = locate_points(made, np.array([[0.5, 0.9], [0.5, 0.1]]), rest_positions(made.sheet), view(made))
    assert np.isnan(found.pixels[0]).all()
    assert np.isfinite(found.pixels[1]).all()
    assert found.hidden[0]
