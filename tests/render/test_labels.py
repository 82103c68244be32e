"""Labels, tracks and flow: against the twin, which tests every triangle, and closed forms."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import Solid, place_instruments
from taichi_msm.render import tracking
from taichi_msm.render.camera import Shot, view
from taichi_msm.render.labels import NO_FLOW, Labels, requested_labels
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.renderer import Renderer
from taichi_msm.render.tracking import compute_flow, locate_points
from taichi_msm.scene.scene import Scene
from taichi_msm.system import launches
from taichi_msm.system.runtime import Device
from tests.reference import labels as twin
from tests.render.test_rasterizer import NEAR, dented, drawable, with_instruments

Array = NDArray[np.float64]
CAMERAS = pytest.mark.parametrize("camera", ["top", "oblique", NEAR], ids=["top", "oblique", "near"])


def draw_labels(
    made: Scene,
    position: Array,
    names: Collection[str] = requested_labels(()),
    instruments: Sequence[Solid] | None = None,
) -> Labels:
    """Labels of these names, with the instruments of the scene by default."""
    config = drawing_config(made, picture=False, labels=names)
    placed = place_instruments(made, position, 0) if instruments is None else instruments
    labels = Rasterizer(made, np.zeros((1, 1, 3), np.uint8), config).render(position, instruments=placed).labels
    assert labels is not None
    return labels


def folded(made: Scene, seed: int = 3) -> Array:
    """A rough sheet whose right third lies over the middle."""
    position = rest_positions(made.sheet)
    right = position[..., 0] > 0.05
    rough = np.random.default_rng(seed).uniform(-0.006, 0.006, position.shape)
    position[..., 2] += np.where(right, 0.06, 0)
    position[..., 0] = np.where(right, 0.1 - position[..., 0], position[..., 0])
    return position + rough


def crumpled(made: Scene) -> Array:
    """Mass points moved by more than a cell, so that many cells are folded."""
    return rest_positions(made.sheet) + np.random.default_rng(5).normal(0, 0.03, (*made.sheet.points, 3))


def assert_labels_match_twin(made: Scene, position: Array) -> Labels:
    """Compare labels with the twin; they are on the pixels' lines of sight, and flow to themselves."""
    placed = place_instruments(made, position, 0)
    labels, (coordinates, depth, instrument) = draw_labels(made, position), twin.labels(made, position, placed)
    # Rounding moves an outline, or a fold, past a pixel's centre now and then; there is no other difference.
    equal = (np.isnan(labels.coordinates[..., 0]) == np.isnan(coordinates[..., 0])) & (
        np.abs(labels.depth - depth) < 1e-4 * depth.max()
    )
    assert equal.mean() > 0.997
    assert ((labels.instrument == 255) == instrument)[equal].all()
    sheet = equal & ~np.isnan(coordinates[..., 0])
    assert sheet.mean() > 0.2
    pixels, _ = twin.project(made, labels.coordinates[sheet].astype(float), position)
    assert np.abs(pixels - np.argwhere(sheet)[:, ::-1] - 0.5).max() < 0.01
    flow, occlusion = compute_flow(made, labels.coordinates, Shot(position, view(made), placed))
    sheet = ~np.isnan(labels.coordinates[..., 0])
    assert np.abs(flow[sheet]).max() < (1e-3 if view(made).lens is None else 0.01)
    assert (flow[~sheet] == NO_FLOW).all()
    assert not occlusion[~sheet].any()
    # Samples that an outline passes through within rounding.
    assert (occlusion > 0).sum() <= 3
    return labels


@pytest.mark.default_cases("dented-oblique", "folded-near")
@CAMERAS
@pytest.mark.parametrize("shape", [dented, folded])
def test_labels_match_the_twin(shape: Any, camera: Any, device: Device) -> None:
    made = with_instruments(drawable(camera=camera))
    assert assert_labels_match_twin(made, shape(made)).instrument.any()


def assert_tracks_match_twin(made: Scene, position: Array) -> NDArray[np.bool_]:
    """Compare pixels and occlusion of 2,000 points with the twin; return the occlusion."""
    coordinates = np.random.default_rng(9).uniform(0, 1, (2000, 2)).astype(np.float32)
    tracks = locate_points(made, coordinates, Shot(position, view(made)))
    pixels, hidden = twin.project(made, coordinates.astype(float), position)
    np.testing.assert_array_equal(np.isnan(tracks.pixels), np.isnan(pixels))
    near = np.abs(pixels).max(axis=1) < 1e4
    np.testing.assert_allclose(tracks.pixels[near], pixels[near], atol=1e-4)
    # Beyond rounding: a point that is on an edge to 1e-9 of the sheet may be on either side.
    np.testing.assert_array_equal(tracks.hidden, hidden)
    return tracks.hidden


@CAMERAS
@pytest.mark.parametrize("refine", [0, 2])
@pytest.mark.parametrize("shape", [dented, folded, crumpled])
def test_tracks_match_the_twin(shape: Any, refine: int, camera: Any, device: Device) -> None:
    made = drawable(camera=camera, refine=refine)
    assert 0 < assert_tracks_match_twin(made, shape(made)).mean() < 1 or shape is dented


@pytest.mark.parametrize("shape", [dented, folded, crumpled])
def test_tracks_of_the_gpu_kernels(shape: Any, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """GPU kernels on the CPU, with the lists in one launch and in many, have the bits of those for the CPU."""
    made = with_instruments(drawable(camera="oblique", refine=2))
    position, coordinates = shape(made), np.random.default_rng(9).uniform(0, 1, (1000, 2)).astype(np.float32)
    shot = Shot(position, view(made), place_instruments(made, position, 0))
    expected = locate_points(made, coordinates, shot)
    monkeypatch.setattr(tracking, "lanes", lambda precision: 1)
    assert locate_points(made, coordinates[:0], shot).pixels.shape == (0, 2)
    tracks = [locate_points(made, coordinates, shot)]
    # Two cells in a launch.
    monkeypatch.setattr(launches, "MAX_ROUNDS", launches.RESERVED_ROUNDS + 2 * (1 + 2 * 3**2))
    monkeypatch.setattr(launches, "VULKAN_THREADS", 100)
    tracks.append(locate_points(made, coordinates, shot))
    for found in tracks:
        np.testing.assert_array_equal(found.pixels, expected.pixels)
        np.testing.assert_array_equal(found.hidden, expected.hidden)


def test_occlusion_by_instruments(device: Device) -> None:
    made = with_instruments(drawable(camera="top"))
    position = rest_positions(made.sheet)
    # At rest, from the top, 80 x 60 pixels show the 0.4 m x 0.3 m of the sheet.
    down, across = np.meshgrid((np.arange(60) + 0.5) / 60, (np.arange(80) + 0.5) / 80, indexing="ij")
    points = np.stack([across, down], axis=-1).reshape(-1, 2)
    tracks = locate_points(made, points, Shot(position, view(made), place_instruments(made, position, 0)))
    np.testing.assert_allclose(tracks.pixels, points * [80, 60], atol=1e-4)
    np.testing.assert_array_equal(tracks.hidden, (draw_labels(made, position).instrument == 255).ravel())


def test_depth_of_a_flat_sheet(device: Device) -> None:
    made = drawable(camera="top")
    position = rest_positions(made.sheet)
    # From the plane that is the larger side, 0.4 m, above the sheet at rest.
    assert draw_labels(made, position).depth == pytest.approx(0.4, rel=1e-6)
    position[..., 2] = 0.05
    assert draw_labels(made, position).depth == pytest.approx(0.35, rel=1e-6)
    pinhole = drawable(camera={"eye": [0, 0, 0.25], "fov": 30})
    assert draw_labels(pinhole, position).depth == pytest.approx(0.2, rel=1e-6), "along the optical axis"


def test_flow_of_a_shifted_sheet(device: Device) -> None:
    made = drawable(camera="top")
    rest = rest_positions(made.sheet)
    coordinates = draw_labels(made, rest).coordinates
    # 200 px/m.
    flow, occlusion = compute_flow(made, coordinates, Shot(rest + np.array([0.01, 0.02, -0.1]), view(made)))
    np.testing.assert_allclose(flow, np.tile([2.0, -4.0], (60, 80, 1)), atol=1e-3)
    # The right two columns and the upper four rows leave the picture.
    outside = np.zeros((60, 80), bool)
    outside[:, 78:] = outside[:4] = True
    np.testing.assert_array_equal(occlusion, outside * 255)


def test_coordinates_at_an_edge(device: Device) -> None:
    made = drawable(camera="top")
    down, across = np.meshgrid(*(np.linspace(0, 0.14, n) for n in made.sheet.points), indexing="ij")
    # Two edges go through the centres of pixels, which are 5 mm wide; there f32 yields down to -3e-8.
    position = np.stack([0.0025 + across - down, 0.1275 - across - down, 0 * across], axis=-1)
    labels = draw_labels(made, position)
    assert np.nanmin(labels.coordinates) == 0
    flow = Renderer(made).flow(labels, Shot(position, view(made))).flow
    np.testing.assert_allclose(flow[~np.isnan(labels.coordinates[..., 0])], 0, atol=1e-3)


def test_tracks_behind_the_eye(device: Device) -> None:
    made = drawable(camera={"eye": [0, 0, 0.02], "target": [0, 1, 0.02], "up": [0, 0, 1], "fov": 90})
    tracks = locate_points(made, np.array([[0.5, 0.9], [0.5, 0.1]]), Shot(rest_positions(made.sheet), view(made)))
    np.testing.assert_array_equal(np.isnan(tracks.pixels[:, 0]), [True, False])
    assert tracks.hidden[0]
