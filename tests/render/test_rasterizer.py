"""Pictures of kernel 2: against the twin, closed forms and invariants."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import Solid, place_instruments
from taichi_msm.render import bins, gpu, tracking
from taichi_msm.render.camera import Shot, view
from taichi_msm.render.cpu import Bands
from taichi_msm.render.labels import LABELS, track_grid
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.scene.scene import Scene
from taichi_msm.system import launches
from taichi_msm.system.runtime import Device
from tests import reference
from tests.scenes import SHEET, scene, speckle

NEAR = {"eye": [0, -0.1, 0.1], "target": [0, 0.1, 0], "fov": 80}
BELOW = {"eye": [0.1, 0.2, -0.4], "up": [1, 0, 0]}


def drawable(points: tuple[int, int] = (9, 11), **render: Any) -> Scene:
    return scene(sheet={**SHEET, "points": list(points)}, render={"size": [80, 60], "refine": 2, **render})


def draw(made: Scene, position: NDArray[Any], texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return Rasterizer(made, texture).draw(position)


def dented(made: Scene, seed: int = 1) -> NDArray[np.float64]:
    """Positions with a smooth dent and some noise."""
    position = rest_positions(made.sheet)
    x, y = position[..., 0], position[..., 1]
    position[..., 2] = -0.1 * np.exp(-((x - 0.03) ** 2 + y**2) / 0.005)
    return position + np.random.default_rng(seed).normal(0, 0.004, position.shape)


def with_instruments(made: Scene) -> Scene:
    """Two instruments, one of which lies almost along the view from the top."""
    probes = [
        {"force": [0, 0, -1], "at": [0.4, 0.4], "instrument": {"radius": 0.02, "shaft": [1, -0.4, 0.7], "length": 0.2}},
        {"force": [0, 0, -1], "at": [0.7, 0.8], "instrument": {"radius": 0.03, "shaft": [0, 0.01, 1], "length": 0.05}},
    ]
    return made.model_copy(update={"probes": probes})


def difference(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int_]:
    """Largest difference of the three channels, shape (height, width)."""
    return np.abs(a.astype(int) - b.astype(int)).max(axis=-1)


def assert_picture_matches_twin(
    made: Scene, position: NDArray[Any], texture: NDArray[np.uint8], instruments: Sequence[Solid] = ()
) -> NDArray[np.uint8]:
    """Compare a picture with the twin's, and return it.

    A vertex is off by 1/512 px where it is snapped, which moves a silhouette past few pixel centres; elsewhere f32 puts
    a vertex of a 97-pixel picture at 97 x 2^-24 px, and the speckle changes by at most 255 in 2 px.
    """
    picture = Rasterizer(made, texture).draw(position, instruments=instruments)
    error = difference(picture, reference.draw(made, position, texture, instruments))
    assert (error > 1).mean() < 0.005
    assert (error == 1).mean() < 0.01
    return picture


def test_projection_precedes_coverage(device: Device) -> None:
    """Three rows for two workers: a worker that has projected a single row must wait for the second worker.

    The last row is projected to the top, where drawing begins. The remains of an earlier picture are below the picture.
    """
    made = scene(sheet={**SHEET, "points": [3, 4000]}, render={"size": [8, 32], "refine": 0})
    texture = speckle(16, 16)
    parallel, sequential = Rasterizer(made, texture), Rasterizer(made, texture)
    assert isinstance(parallel._backend, Bands)
    assert isinstance(sequential._backend, Bands)
    sequential._backend._workers = 1
    assert parallel._backend._workers == 2
    position = rest_positions(made.sheet) * [1, -1, 1]
    for _ in range(40):
        parallel.draw(position - 1)
        assert (parallel.draw(position) == sequential.draw(position)).all()


# Settings of rendering, and whether there are instruments.
PICTURES: dict[str, tuple[dict[str, Any], bool]] = {
    "unlit": ({"camera": "top", "shading": "none", "supersample": 2, "background": [10, 200, 30]}, False),
    "oblique": ({"camera": "oblique", "wireframe": True, "refine": 3}, False),
    "fine": ({"camera": "oblique", "wireframe": True, "supersample": 3, "refine": 0}, False),
    "inside": ({"camera": NEAR, "refine": 1}, False),
    "tissue": ({"camera": "top", "shading": "tissue", "light": {"relief": -0.2, "vignette": 0.3}}, False),
    "tissue inside": ({"camera": NEAR, "shading": "tissue", "supersample": 2, "wireframe": True}, False),
    "tissue below": ({"camera": BELOW, "size": [31, 97], "shading": "tissue"}, False),
    "instruments": ({"camera": "top", "shading": "none"}, True),
    "instruments, headlight": ({"camera": "oblique", "shading": "headlight"}, True),
    "instruments, tissue": ({"camera": NEAR, "shading": "tissue"}, True),
}


@pytest.mark.default_cases("oblique", "inside", "tissue below", "instruments, headlight")
@pytest.mark.parametrize("name", PICTURES)
def test_pictures_match_the_twin(name: str, device: Device) -> None:
    render, has_instruments = PICTURES[name]
    made = drawable(**render)
    position = dented(made)
    if not has_instruments:
        assert_picture_matches_twin(made, position, speckle(13, 17))
        return
    made, texture = with_instruments(made), np.full((9, 9, 3), 120, np.uint8)
    picture = assert_picture_matches_twin(made, position, texture, place_instruments(made, position, 0))
    assert (difference(picture, reference.draw(made, position, texture)) > 30).mean() > 0.02, "instruments are visible"


@pytest.mark.slow
def test_cells_beyond_an_edge_of_the_picture_are_in_no_bin(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some of these cells cross the camera's plane; in every bin, they would be tested at every sample."""
    lengths: list[NDArray[np.int32]] = []

    def record_lengths(*arguments: Any) -> bins.Bins:
        built = bins.build_bins(*arguments)
        lengths.append(built.lengths)
        return built

    monkeypatch.setattr(gpu, "build_bins", record_lengths)
    monkeypatch.setattr(tracking, "build_bins", record_lengths)
    made = drawable((40, 40), camera={"eye": [0, 0, 0.1], "target": [0, 1, 0.1], "up": [0, 0, 1], "fov": 40})
    position = rest_positions(made.sheet)
    Rasterizer(made, speckle(13, 17), drawing_config(made)._replace(lanes=1)).draw(position)
    tracking.locate_points(made, track_grid(2), Shot(position, view(made)))
    assert not any(length.any() for length in lengths)
    assert len(lengths) == 2


def assert_same_bits_with_lanes(made: Scene, texture: NDArray[np.uint8], position: NDArray[Any], lanes: int) -> None:
    """Compare pictures and labels in tiles of `lanes` samples; labels need one sample per pixel."""
    config = drawing_config(made, labels=LABELS if made.render.supersample == 1 else ())
    placed = place_instruments(made, position, 0)
    expected, found = (
        Rasterizer(made, texture, config._replace(lanes=count)).render(position, instruments=placed)
        for count in (config.lanes, lanes)
    )
    np.testing.assert_array_equal(found.picture, expected.picture)
    for label, expected_label in zip(found.labels or (), expected.labels or (), strict=True):
        np.testing.assert_array_equal(label, expected_label)


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 4, 8])
def test_lanes_do_not_change_the_bits(lanes: int, device: Device) -> None:
    # One lane is the form for GPUs; 31 x 57 pixels are whole tiles of no shape.
    renders: list[dict[str, Any]] = [
        {"size": [31, 57], "wireframe": True},
        {"supersample": 3, "camera": "oblique"},
        {"size": [31, 57], "shading": "tissue", "light": {"relief": 1}},
    ]
    for render in renders:
        made, texture = with_instruments(drawable(**render)), speckle(300, 200)
        assert_same_bits_with_lanes(made, texture, dented(made), lanes)


def test_lanes_do_not_change_the_bits_of_distant_points(device: Device) -> None:
    # Cells beyond the range in which f32 can outline them are drawn triangle by triangle, where rounding may cover any
    # sample.
    made, texture = drawable((5, 4), size=[40, 40], refine=3), speckle(20, 30)
    scalar, vector = (Rasterizer(made, texture, drawing_config(made)._replace(lanes=lanes)) for lanes in (1, 8))
    for distance in (1e3, 1e5, 1e7, 1e30, np.nan, np.inf):
        for point in ((0, 0), (2, 1), (4, 3)):
            position = rest_positions(made.sheet)
            position[point] = distance
            np.testing.assert_array_equal(vector.draw(position), scalar.draw(position))


@pytest.mark.slow
@pytest.mark.parametrize("parts", [gpu.MAX_PARTS, 100])
def test_launches_do_not_change_the_bits(parts: int, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU: many strips, many launches for the lists of a strip, several triangles in a part, shuffled lists.

    The sheet is crumpled in its plane, so that all of it has the same depth.
    """
    made = with_instruments(drawable((9, 11), size=[60, 50], refine=2, camera="top", supersample=2))
    rng = np.random.default_rng(6)
    position = rest_positions(made.sheet) + rng.normal(0, 0.03, (9, 11, 3)) * [1, 1, 0]
    placed, texture = place_instruments(made, position, 0), speckle(30, 20)
    config = drawing_config(made)._replace(lanes=1)
    rounds_of_launches: list[int] = []
    launch = launches.Launches.launch

    def record_launch(self: launches.Launches, kernel: Any, total: int, *arguments: Any, rounds: int) -> None:
        rounds_of_launches.append(rounds)
        launch(self, kernel, total, *arguments, rounds=rounds)

    def build_shuffled(device_launches: launches.Launches, *arguments: Any) -> bins.Bins:
        built = bins.build_bins(device_launches, *arguments)
        entries, starts = device_launches.download(built.entries), device_launches.download(built.starts)
        for first, end in pairwise(starts):
            rng.shuffle(entries[first:end])
        return built._replace(entries=device_launches.upload(entries))

    monkeypatch.setattr(launches.Launches, "launch", record_launch)
    monkeypatch.setattr(gpu, "build_bins", build_shuffled)
    pictures = [Rasterizer(made, texture, config).draw(position, instruments=placed)]
    few = len(rounds_of_launches)
    monkeypatch.setattr(launches, "MAX_ROUNDS", launches.RESERVED_ROUNDS + 250)
    monkeypatch.setattr(launches, "VULKAN_THREADS", 700)
    monkeypatch.setattr(gpu, "VULKAN_THREADS", 700)
    monkeypatch.setattr(gpu, "MAX_PARTS", parts)
    pictures += [Rasterizer(made, texture, config).draw(position, instruments=placed) for _ in range(3)]
    assert len(rounds_of_launches) > 30 * few
    expected = Rasterizer(made, texture).draw(position, instruments=placed)
    for picture in pictures:
        np.testing.assert_array_equal(picture, expected)


@pytest.mark.slow
def test_bound_of_a_thread(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The finest cells, folded, with all triangles of a cell in one part, and many instruments."""
    made = with_instruments(drawable((4, 4), size=[9, 7], refine=64, camera="oblique", supersample=4))
    made = made.model_copy(update={"probes": made.probes * 8})
    position = np.random.default_rng(4).normal(0, 0.2, (4, 4, 3))
    rasterizer = Rasterizer(made, speckle(8, 8), drawing_config(made)._replace(lanes=1))
    monkeypatch.setattr(gpu, "MAX_PARTS", 1)
    rasterizer.draw(position, instruments=place_instruments(made, position, 0))
    monkeypatch.setattr(launches, "MAX_ROUNDS", launches.RESERVED_ROUNDS + 3 * 2 * 65**2)
    with pytest.raises(AssertionError):
        rasterizer.draw(position, instruments=place_instruments(made, position, 0))


def test_instruments_touch_the_sheet_at_the_control_point(device: Device) -> None:
    made = with_instruments(drawable(refine=4))
    position = dented(made)
    for placed, (across, down) in zip(place_instruments(made, position, 0), ((0.4, 0.4), (0.7, 0.8)), strict=True):
        rows, cols = made.sheet.points
        # These points are vertices of the refined surface.
        near = reference.refine(position, 4)[round(down * (rows - 1) * 5), round(across * (cols - 1) * 5)]
        assert np.linalg.norm(placed.tip - near) == pytest.approx(placed.radius, rel=1e-9)
        assert (placed.tip - near) @ placed.axis > 0, "on the side of the shaft"


def test_distant_tissue_has_the_mean_colour_of_its_texels(device: Device) -> None:
    # A fine checkerboard: without filtering its pixels are black or white.
    board = (np.indices((660, 880)).sum(axis=0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, axis=-1)
    made = drawable(shading="tissue", light={"ambient": 1, "gloss": 0})
    # Eleven texels a pixel: between the levels of 8 and of 16, where the mean 127.5 was rounded once.
    assert np.abs(draw(made, rest_positions(made.sheet), board).astype(int) - 128).max() <= 1
    assert np.abs(draw(drawable(shading="none"), rest_positions(made.sheet), board).astype(int) - 128).max() > 100


def test_brightness_of_tissue_at_a_fold(device: Device) -> None:
    # Ridges of steep sides: there, interpolated normals may lean away from the camera where the face does not.
    made = drawable((41, 41), size=[200, 150], refine=1, camera="oblique", shading="tissue", light={"gloss": 0})
    position = rest_positions(made.sheet)
    position[..., 2] = 0.03 * np.sin(position[..., 1] * 100)
    picture = draw(made, position, np.full((4, 4, 3), 255, np.uint8))[..., 0].astype(int)
    inner = picture[1:-1, 1:-1]
    around = [picture[1 + i : 149 + i, 1 + j : 199 + j] for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    assert not ((inner > 0) & (inner < 0.5 * np.min(around, axis=0))).any(), "no dark pixel in a bright face"


def test_least_brightness_of_tissue(device: Device) -> None:
    made = drawable(shading="tissue", light={"gloss": 0})
    position = rest_positions(made.sheet)
    position[..., 2] = position[..., 0] * np.tan(np.radians(85))  # away from the light
    picture = draw(made, position, np.full((4, 4, 3), 200, np.uint8))
    assert picture[picture.any(axis=-1)].min() >= 0.2 * 200 - 1, "the ambient share"


@pytest.mark.parametrize("size", [(17, 13), (64, 64), (1021, 509)])
@pytest.mark.parametrize("refine", [0, 10])
def test_picture_at_rest_is_the_texture(size: tuple[int, int], refine: int, device: Device) -> None:
    width, height = size
    made = scene(
        sheet={"points": [5, 7], "size": [height / 1000, width / 1000], "mass": 1},
        render={"size": [width, height], "refine": refine, "shading": "none"},
    )
    texture = speckle(height, width)
    np.testing.assert_array_equal(draw(made, rest_positions(made.sheet), texture), texture)


def test_headlight_falls_with_the_cosine_of_the_slope(device: Device) -> None:
    texture = speckle(60, 80)
    camera = {"eye": [0, 0, 0.5], "target": [0, 0, 0], "fov": 2 * np.degrees(np.arctan(0.3))}
    made = drawable(shading="headlight")
    position = rest_positions(made.sheet)
    lit, unlit = Rasterizer(made, texture), Rasterizer(drawable(shading="none"), texture)
    for facing in (view(drawable()), view(drawable(camera=camera))):
        np.testing.assert_array_equal(lit.draw(position, facing), unlit.draw(position, facing))
    position[..., 2] = position[..., 0] * np.tan(np.radians(60))
    assert (draw(made, position, np.full((4, 4, 3), 200, np.uint8)) == 100).all()


@pytest.mark.parametrize("refine", [0, 2])
def test_no_gaps_between_cells(refine: int, device: Device) -> None:
    # Inner points are moved at random, in some cases onto pixel centres, and in some so much that cells fold over.
    made = drawable((7, 9), size=[48, 36], refine=refine, shading="none")
    rasterizer = Rasterizer(made, np.full((4, 4, 3), 255, np.uint8))
    rest, pixel = rest_positions(made.sheet), 0.4 / 48
    for seed in range(8):
        shift = np.random.default_rng(seed).uniform(-1, 1, (5, 7, 2)) * (0.04 if seed % 3 else 0.01)
        position = rest.copy()
        position[1:-1, 1:-1, :2] += shift
        if seed < 4:
            inner = position[1:-1, 1:-1, :2]
            inner[:] = np.round(inner / pixel - 0.5) * pixel + pixel / 2
        assert rasterizer.draw(position).all(), seed


def test_no_gaps_between_triangles_of_a_crumpled_sheet(device: Device) -> None:
    # Every cell is moved by more than its size; the border stays, so the sheet covers the picture.
    made = drawable((9, 9), size=[1000, 750], refine=32, shading="none")
    position = rest_positions(made.sheet)
    position[1:-1, 1:-1, :2] += np.random.default_rng(6).normal(0, 0.04, (7, 7, 2))
    assert draw(made, position, np.full((4, 4, 3), 255, np.uint8)).all()


@pytest.mark.slow
def test_sheet_through_the_eye(device: Device) -> None:
    texture = np.full((4, 4, 3), 255, np.uint8)
    rasterizer = None
    for y in (0.0, 1e-9, 3e-9, 1e-8, 1e-6, 3e-6):
        camera = {"eye": [0.0123, y, 0.03], "target": [0.0123, y - 1, 0.03], "up": [0, 0, 1], "fov": 90}
        made = drawable((5, 5), size=[200, 150], refine=1, shading="none", camera=camera)
        rasterizer = rasterizer or Rasterizer(made, texture)
        position = rest_positions(made.sheet)
        error = difference(rasterizer.draw(position, view(made)), reference.draw(made, position, texture))
        assert (error > 1).mean() < 0.002, y


def test_configuration_has_only_necessary_planes(device: Device) -> None:
    assert drawing_config(drawable(shading="none")).plane._fields == ("depth", "texel_x", "texel_y")
    assert drawing_config(drawable()) == drawing_config(
        drawable((5, 6), camera="oblique", background=[1, 1, 1], size=[9, 9])
    )
