"""Kernel 2 against its twin, and against what must hold of any picture."""

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
from taichi_msm.render.camera import view
from taichi_msm.render.cpu import Bands
from taichi_msm.render.labels import LABELS, track_grid
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.scene.scene import Scene
from taichi_msm.system import launches
from taichi_msm.system.runtime import Device
from tests import reference
from tests.scenes import SHEET, scene, speckle

NEAR = {"eye": [0, -0.1, 0.1], "target": [0, 0.1, 0], "fov": 80}


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


def drawn_as_by_the_twin(
    made: Scene, position: NDArray[Any], texture: NDArray[np.uint8], instruments: Sequence[Solid] = ()
) -> NDArray[np.uint8]:
    """The picture, which is the twin's.

    A vertex is off by 1/512 px where it is snapped, which moves a silhouette past few pixel centres; elsewhere f32 puts
    a vertex of a 97-pixel picture at 97 x 2^-24 px, and the speckle changes by at most 255 in 2 px.
    """
    drawn = Rasterizer(made, texture).draw(position, instruments=instruments)
    apart = difference(drawn, reference.draw(made, position, texture, instruments))
    assert (apart > 1).mean() < 0.005
    assert (apart == 1).mean() < 0.01
    return drawn


def test_nothing_is_drawn_before_every_mass_point_is_projected(device: Device) -> None:
    """Three rows for two workers: the one that has projected a single row must wait for the other.

    The last row is seen at the top, where drawing begins. What an earlier picture has left is below the picture.
    """
    made = scene(sheet={**SHEET, "points": [3, 4000]}, render={"size": [8, 32], "refine": 0})
    texture = speckle(16, 16)
    together, alone = Rasterizer(made, texture), Rasterizer(made, texture)
    assert isinstance(together._backend, Bands)
    assert isinstance(alone._backend, Bands)
    alone._backend._workers = 1
    assert together._backend._workers == 2
    position = rest_positions(made.sheet) * [1, -1, 1]
    for _ in range(40):
        together.draw(position - 1)
        assert (together.draw(position) == alone.draw(position)).all()


@pytest.mark.default_cases("oblique", "tissue below", "inside")
@pytest.mark.parametrize(
    "render",
    [
        {"camera": "top"},
        {"camera": "top", "shading": "none", "supersample": 2, "background": [10, 200, 30]},
        {"camera": "oblique", "wireframe": True, "refine": 3},
        {"camera": "oblique", "wireframe": True, "supersample": 3, "refine": 0},
        {"camera": NEAR, "refine": 1},
        {"camera": {"eye": [0.1, 0.2, -0.4], "up": [1, 0, 0]}, "size": [31, 97]},
        {"camera": "top", "shading": "tissue", "light": {"relief": -0.2, "vignette": 0.3}},
        pytest.param(
            {"camera": NEAR, "shading": "tissue", "supersample": 2, "wireframe": True}, marks=pytest.mark.slow
        ),
        {"camera": {"eye": [0.1, 0.2, -0.4], "up": [1, 0, 0]}, "size": [31, 97], "shading": "tissue"},
    ],
    ids=["top", "unlit", "oblique", "fine", "inside", "below", "tissue", "tissue inside", "tissue below"],
)
def test_picture_is_like_the_twin(render: dict[str, Any], device: Device) -> None:
    made = drawable(**render)
    drawn_as_by_the_twin(made, dented(made), speckle(13, 17))


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [None, {"k1": -0.1}])
def test_what_passes_behind_the_camera_is_looked_for_only_where_it_may_be_seen(
    distortion: Any, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    lists: list[float] = []

    def counted(*arguments: Any) -> bins.Bins:
        found = bins.build_bins(*arguments)
        lists.append(found.lengths.mean())
        return found

    monkeypatch.setattr(gpu, "build_bins", counted)
    monkeypatch.setattr(tracking, "build_bins", counted)
    for eye in ([0, 0, 0.1], [0, -0.9, 0.1]):
        camera = {"eye": eye, "target": [eye[0], eye[1] + 0.1, 0], "fov": 60, "distortion": distortion}
        made = drawable((40, 40), camera=camera)
        position = rest_positions(made.sheet)
        Rasterizer(made, speckle(13, 17), drawing_config(made)._replace(lanes=1)).draw(position)
        tracking.locate_points(made, track_grid(2), position, view(made))
    # The first stands over the sheet, so that a row of cells crosses the camera's plane. 2 x 3^2 triangles of each of
    # the 39 would be everywhere. All that the second could see is above the picture.
    assert max(lists) < 39
    assert lists[2:] == [0, 0]


def assert_alike_in_other_tiles(made: Scene, texture: NDArray[np.uint8], position: NDArray[Any], lanes: int) -> None:
    """Pictures and labels have the same bits if so many pixels are drawn at a time; labels have one sample a pixel."""
    config = drawing_config(made, labels=LABELS if made.render.supersample == 1 else ())
    placed = place_instruments(made, position, 0)
    expected = Rasterizer(made, texture, config).look(position, instruments=placed)
    other = Rasterizer(made, texture, config._replace(lanes=lanes)).look(position, instruments=placed)
    np.testing.assert_array_equal(other.picture, expected.picture)
    for label, same in zip(other.labels or (), expected.labels or (), strict=True):
        np.testing.assert_array_equal(label, same)


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [*(pytest.param(lanes, marks=pytest.mark.slow) for lanes in (1, 4)), 8])
def test_the_shape_of_a_tile_does_not_change_the_bits(lanes: int, device: Device) -> None:
    # One lane is the form for GPUs; 31 x 57 pixels are whole tiles of no shape.
    renders: list[dict[str, Any]] = [
        {"size": [31, 57], "wireframe": True},
        {"supersample": 3, "camera": "oblique"},
        {"size": [31, 57], "shading": "tissue", "light": {"relief": 1}},
    ]
    for render in renders:
        made, texture = with_instruments(drawable(**render)), speckle(300, 200)
        assert_alike_in_other_tiles(made, texture, dented(made), lanes)


@pytest.mark.slow
@pytest.mark.parametrize("parts", [gpu.MAX_PARTS, 100])
def test_launches_do_not_change_the_bits(parts: int, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU, many strips, many launches for the lists of a strip, several triangles taken together, shuffled lists.

    The sheet is crumpled in its plane, so that all of it is equally far.
    """
    made = with_instruments(drawable((9, 11), size=[60, 50], refine=2, camera="top", supersample=2))
    rng = np.random.default_rng(6)
    position = rest_positions(made.sheet) + rng.normal(0, 0.03, (9, 11, 3)) * [1, 1, 0]
    placed, texture = place_instruments(made, position, 0), speckle(30, 20)
    config = drawing_config(made)._replace(lanes=1)
    begun: list[int] = []
    launch = launches.Launches.launch

    def counted(self: launches.Launches, kernel: Any, total: int, *arguments: Any, rounds: int) -> None:
        begun.append(rounds)
        launch(self, kernel, total, *arguments, rounds=rounds)

    def shuffled(of: launches.Launches, *arguments: Any) -> bins.Bins:
        found = bins.build_bins(of, *arguments)
        entries, starts = of.download(found.entries), of.download(found.starts)
        for first, end in pairwise(starts):
            rng.shuffle(entries[first:end])
        return found._replace(entries=of.upload(entries))

    monkeypatch.setattr(launches.Launches, "launch", counted)
    monkeypatch.setattr(gpu, "build_bins", shuffled)
    pictures = [Rasterizer(made, texture, config).draw(position, instruments=placed)]
    few = len(begun)
    monkeypatch.setattr(launches, "MAX_ROUNDS", launches.RESERVED_ROUNDS + 250)
    monkeypatch.setattr(launches, "VULKAN_THREADS", 700)
    monkeypatch.setattr(gpu, "VULKAN_THREADS", 700)
    monkeypatch.setattr(gpu, "MAX_PARTS", parts)
    pictures += [Rasterizer(made, texture, config).draw(position, instruments=placed) for _ in range(3)]
    assert len(begun) > 30 * few
    expected = Rasterizer(made, texture).draw(position, instruments=placed)
    for picture in pictures:
        np.testing.assert_array_equal(picture, expected)


@pytest.mark.slow
def test_the_bound_of_a_thread_is_asserted(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The finest cells, folded, with so many that all triangles of a cell are taken together, and all instruments."""
    made = with_instruments(drawable((4, 4), size=[9, 7], refine=64, camera="oblique", supersample=4))
    made = made.model_copy(update={"probes": made.probes * 8})
    position = np.random.default_rng(4).normal(0, 0.2, (4, 4, 3))
    drawing = Rasterizer(made, speckle(8, 8), drawing_config(made)._replace(lanes=1))
    monkeypatch.setattr(gpu, "MAX_PARTS", 1)
    drawing.draw(position, instruments=place_instruments(made, position, 0))
    monkeypatch.setattr(launches, "MAX_ROUNDS", launches.RESERVED_ROUNDS + 3 * 2 * 65**2)
    with pytest.raises(AssertionError):
        drawing.draw(position, instruments=place_instruments(made, position, 0))


@pytest.mark.default_cases("headlight-oblique")
@pytest.mark.parametrize(
    ("shading", "camera"),
    [
        pytest.param(shading, camera, marks=() if m == n else pytest.mark.slow)
        for m, shading in enumerate(("none", "headlight", "tissue"))
        for n, camera in enumerate(("top", "oblique", NEAR))
    ],
)
def test_instruments_are_like_the_twin(shading: str, camera: Any, device: Device) -> None:
    made = with_instruments(drawable(camera=camera, shading=shading))
    position, texture = dented(made), np.full((9, 9, 3), 120, np.uint8)
    drawn = drawn_as_by_the_twin(made, position, texture, place_instruments(made, position, 0))
    bare = reference.draw(made, position, texture)
    assert (difference(drawn, bare) > 30).mean() > 0.02, "instruments are seen"


def test_an_instrument_touches_the_sheet_at_the_control_point(device: Device) -> None:
    made = with_instruments(drawable(refine=4))
    position = dented(made)
    for placed, (across, down) in zip(place_instruments(made, position, 0), ((0.4, 0.4), (0.7, 0.8)), strict=True):
        rows, cols = made.sheet.points
        patch = reference.refine(position, 4)
        near = patch[round(down * (rows - 1) * 5), round(across * (cols - 1) * 5)]
        # These places are vertices of the refined surface.
        assert np.linalg.norm(placed.tip - near) == pytest.approx(placed.radius, rel=1e-9)
        assert (placed.tip - near) @ placed.axis > 0, "on the side from which it comes"


def test_tissue_far_away_shows_the_mean_of_its_texels(device: Device) -> None:
    # A fine checkerboard: without filtering its pixels are black or white.
    board = (np.indices((660, 880)).sum(axis=0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, axis=-1)
    made = drawable(shading="tissue", light={"ambient": 1, "gloss": 0})
    picture = draw(made, rest_positions(made.sheet), board)
    # Eleven texels a pixel: between the levels of 8 and of 16, where the mean 127.5 was rounded once.
    assert np.abs(picture.astype(int) - 128).max() <= 1
    assert np.abs(draw(drawable(shading="none"), rest_positions(made.sheet), board).astype(int) - 128).max() > 100


def test_tissue_is_as_bright_as_its_faces_at_a_fold(device: Device) -> None:
    # Ridges of steep sides: there, interpolated normals may lean away from the camera where the face does not.
    made = drawable((41, 41), size=[200, 150], refine=1, camera="oblique", shading="tissue", light={"gloss": 0})
    position = rest_positions(made.sheet)
    position[..., 2] = 0.03 * np.sin(position[..., 1] * 100)
    picture = draw(made, position, np.full((4, 4, 3), 255, np.uint8))[..., 0].astype(int)
    inner = picture[1:-1, 1:-1]
    around = [picture[1 + i : 149 + i, 1 + j : 199 + j] for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    assert not ((inner > 0) & (inner < 0.5 * np.min(around, axis=0))).any(), "no dark pixel in a bright face"


def test_tissue_is_nowhere_black(device: Device) -> None:
    made = drawable(shading="tissue", light={"gloss": 0})
    position = rest_positions(made.sheet)
    position[..., 2] = position[..., 0] * np.tan(np.radians(85))  # away from the light
    picture = draw(made, position, np.full((4, 4, 3), 200, np.uint8))
    assert picture[picture.any(axis=-1)].min() >= 0.2 * 200 - 1, "the ambient share is left"


@pytest.mark.parametrize("lanes", [8, *(pytest.param(lanes, marks=pytest.mark.slow) for lanes in (4, 16))])
def test_points_thrown_far_away_do_not_make_bits_depend_on_tiles(lanes: int, device: Device) -> None:
    # Cells beyond what f32 can outline are drawn triangle by triangle, where rounding may put any sample.
    made, texture = drawable((5, 4), size=[40, 40], refine=3), speckle(20, 30)
    one, other = (Rasterizer(made, texture, drawing_config(made)._replace(lanes=count)) for count in (1, lanes))
    for far in (1e3, 1e5, 1e7, 1e30, np.nan, np.inf):
        for point in ((0, 0), (2, 1), (4, 3)):
            position = rest_positions(made.sheet)
            position[point] = far
            np.testing.assert_array_equal(other.draw(position), one.draw(position))


@pytest.mark.parametrize("size", [(17, 13), (64, 64), (331, 331), (1021, 509)])
@pytest.mark.parametrize("refine", [0, 10])
def test_at_rest_the_picture_is_the_texture(size: tuple[int, int], refine: int, device: Device) -> None:
    width, height = size
    made = scene(
        sheet={"points": [5, 7], "size": [height / 1000, width / 1000], "mass": 1},
        render={"size": [width, height], "refine": refine, "shading": "none"},
    )
    texture = speckle(height, width)
    np.testing.assert_array_equal(draw(made, rest_positions(made.sheet), texture), texture)


def test_light_falls_with_the_cosine_of_the_slope(device: Device) -> None:
    texture = speckle(60, 80)
    camera = {"eye": [0, 0, 0.5], "target": [0, 0, 0], "fov": 2 * np.degrees(np.arctan(0.3))}
    made = drawable(shading="headlight")
    position = rest_positions(made.sheet)
    lit, plain = Rasterizer(made, texture), Rasterizer(drawable(shading="none"), texture)
    for seen in (view(drawable()), view(drawable(camera=camera))):
        np.testing.assert_array_equal(lit.draw(position, seen), plain.draw(position, seen))
    position[..., 2] = position[..., 0] * np.tan(np.radians(60))
    assert (draw(made, position, np.full((4, 4, 3), 200, np.uint8)) == 100).all()


@pytest.mark.parametrize("refine", [0, 2])
def test_there_are_no_gaps_between_cells(refine: int, device: Device) -> None:
    # Inner points are moved at random, in some cases onto pixel centres, and in some so far that cells fold over.
    made = drawable((7, 9), size=[48, 36], refine=refine, shading="none")
    drawing = Rasterizer(made, np.full((4, 4, 3), 255, np.uint8))
    rest, pixel = rest_positions(made.sheet), 0.4 / 48
    for seed in range(8):
        shift = np.random.default_rng(seed).uniform(-1, 1, (5, 7, 2)) * (0.04 if seed % 3 else 0.01)
        position = rest.copy()
        position[1:-1, 1:-1, :2] += shift
        if seed < 4:
            inner = position[1:-1, 1:-1, :2]
            inner[:] = np.round(inner / pixel - 0.5) * pixel + pixel / 2
        assert drawing.draw(position).all(), seed


def test_there_are_no_gaps_between_the_triangles_of_a_crumpled_sheet(device: Device) -> None:
    # Every cell is moved by more than its size; the border stays, so the sheet covers the picture somehow.
    made = drawable((9, 9), size=[1000, 750], refine=32, shading="none")
    position = rest_positions(made.sheet)
    position[1:-1, 1:-1, :2] += np.random.default_rng(6).normal(0, 0.04, (7, 7, 2))
    assert draw(made, position, np.full((4, 4, 3), 255, np.uint8)).all()


@pytest.mark.slow
def test_a_sheet_that_passes_through_the_eye_is_seen_in_part(device: Device) -> None:
    texture = np.full((4, 4, 3), 255, np.uint8)
    drawing = None
    for y in (0.0, 1e-9, 3e-9, 1e-8, 1e-6, 3e-6):
        camera = {"eye": [0.0123, y, 0.03], "target": [0.0123, y - 1, 0.03], "up": [0, 0, 1], "fov": 90}
        made = drawable((5, 5), size=[200, 150], refine=1, shading="none", camera=camera)
        drawing = drawing or Rasterizer(made, texture)
        position = rest_positions(made.sheet)
        apart = difference(drawing.draw(position, view(made)), reference.draw(made, position, texture))
        assert (apart > 1).mean() < 0.002, y


def test_oblique_shows_the_whole_sheet(device: Device) -> None:
    for size in ([80, 60], [40, 90], [200, 30]):
        made = drawable(size=size, camera="oblique")
        corners = rest_positions(made.sheet)[[0, 0, -1, -1], [0, -1, 0, -1]]
        x, y, w, _ = view(made).matrix @ np.c_[corners, np.ones(4)].T
        assert ((x / w > 0) & (x / w < size[0]) & (y / w > 0) & (y / w < size[1])).all()


def test_only_what_the_picture_needs_is_compiled(device: Device) -> None:
    assert drawing_config(drawable(shading="none")).plane._fields == ("depth", "texel_x", "texel_y")
    assert drawing_config(drawable()) == drawing_config(
        drawable((5, 6), camera="oblique", background=[1, 1, 1], size=[9, 9])
    )
