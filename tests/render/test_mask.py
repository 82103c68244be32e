"""Pictures, labels, picking, tracks and cameras of a sheet with a mask.

Where a cell is missing, nothing is drawn: the picture is that of the twin, which draws the triangles of other cells.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.model.rest import rest_of
from taichi_msm.render import tracking
from taichi_msm.render.camera import Shot, view
from taichi_msm.render.labels import LABELS, NO_FLOW, track_grid
from taichi_msm.render.notes import drawing_warnings
from taichi_msm.render.picking import pick
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.reference import labels as twin
from tests.reference.drawing import present
from tests.render.test_rasterizer import (
    NEAR,
    assert_picture_matches_twin,
    assert_same_bits_with_lanes,
    with_instruments,
)
from tests.scenes import speckle

# A hole, a slit of one cell, cells that meet only in a point, a cell that sticks out, and a corner that is cut off.
CELLS = [
    "..########",
    ".#########",
    "####..####",
    "###...###.",
    "####.#####",
    "########.#",
    "#######.##",
    "##########",
]

FISHEYE = {
    "eye": [0, -0.02, 0.25],
    "target": [0, 0, 0],
    "intrinsics": {"fx": 50, "fy": 50, "cx": 40, "cy": 30},
    "distortion": {"model": "fisheye", "k1": 0.1, "k2": 0.02},
}


@pytest.fixture
def mask_file(tmp_path: Path) -> Path:
    """A mask with one pixel per cell of `CELLS`."""
    pixels = np.array([[255 * (cell == "#") for cell in row] for row in CELLS], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "mask.png")
    return tmp_path / "mask.png"


def masked(mask_file: Path | None, surface: dict[str, Any] | None = None, **render: Any) -> Scene:
    """A sheet of `CELLS`, without a mask file whole."""
    sheet: dict[str, Any] = {"points": [9, 11], "size": [0.32, 0.4]}
    sheet |= {} if mask_file is None else {"mask": str(mask_file)}
    sheet |= {} if surface is None else {"surface": surface}
    sections = {"sheet": sheet, "tissue": {"young": 3e4, "thickness": 0.002, "density": 1000}}
    sections |= {"time": {"duration": 0.4}, "render": {"size": [80, 60], "refine": 2, **render}}
    return Scene.model_validate({**sections, "output": []})


def dented(made: Scene, seed: int = 1) -> NDArray[np.float64]:
    """Positions with a smooth dent and some noise; mass points without sheet stay at rest."""
    rest = rest_of(made.sheet)
    x, y = rest.position[..., 0], rest.position[..., 1]
    dent = np.zeros_like(rest.position)
    dent[..., 2] = -0.1 * np.exp(-((x - 0.03) ** 2 + y**2) / 0.005)
    dent += np.random.default_rng(seed).normal(0, 0.004, dent.shape)
    points = np.ones(x.shape, bool) if rest.mask is None else rest.mask.points
    return rest.position + dent * points[..., None]


PICTURES: dict[str, dict[str, Any]] = {
    "unlit": {"camera": "top", "shading": "none", "supersample": 2, "background": [10, 200, 30]},
    "headlight": {"camera": "oblique", "wireframe": True, "shading": "headlight"},
    "inside": {"camera": NEAR, "shading": "headlight"},
    "tissue": {"camera": "top", "shading": "tissue", "light": {"relief": -0.2}},
    "tissue, lens": {"camera": FISHEYE, "shading": "tissue", "supersample": 2, "wireframe": True},
}


@pytest.mark.default_cases("tissue, lens")
@pytest.mark.parametrize("name", PICTURES)
def test_pictures_match_the_twin(name: str, mask_file: Path, device: Device) -> None:
    made = masked(mask_file, **PICTURES[name])
    position, texture = dented(made), speckle(13, 17)
    picture = assert_picture_matches_twin(made, position, texture)
    assert (picture != Rasterizer(masked(None, **PICTURES[name]), texture).draw(position)).any()


def folded(made: Scene) -> NDArray[np.float64]:
    """Positions with the left third folded over the middle, 2 cm above it; no two edges are in line."""
    position = rest_of(made.sheet).position.copy()
    fold = position[0, 3, 0] + 0.0013
    position[:, :3, 0], position[:, :3, 2] = 2 * fold - position[:, :3, 0], 0.02
    return position


@pytest.mark.default_cases("top-cpu", "fisheye-gpu")
@pytest.mark.parametrize("lanes", [None, 1], ids=["cpu", "gpu"])
@pytest.mark.parametrize("camera", ["top", FISHEYE], ids=["top", "fisheye"])
def test_missing_cells_uncover_what_is_behind(camera: Any, lanes: int | None, mask_file: Path, device: Device) -> None:
    """Samples of cells that are sheet keep their bits, unless a missing cell was in front: there they are deeper."""
    shots = []
    for file in (None, mask_file):
        made = masked(file, camera=camera, shading="none", size=[160, 120])
        config = drawing_config(made, labels=LABELS)
        rasterizer = Rasterizer(made, speckle(13, 17), config if lanes is None else config._replace(lanes=lanes))
        outputs = rasterizer.render(folded(made))
        assert outputs.labels is not None
        assert outputs.picture is not None
        shots.append((outputs.picture, outputs.labels))
    (whole_picture, whole), (picture, labels) = shots
    cells = np.pad(present(made), ((0, 1), (0, 1)), "edge")
    across, down = (np.nan_to_num(each) for each in np.moveaxis(whole.coordinates, -1, 0))
    # Coordinates near an edge of a cell may round to the next one.
    in_cell = np.stack([across * 10, down * 8])
    is_clear = (np.abs(in_cell - np.round(in_cell)) > 1e-4).all(axis=0)
    is_present = cells[in_cell[1].astype(int), in_cell[0].astype(int)] & (whole.depth > 0) & is_clear
    np.testing.assert_array_equal(picture[is_present], whole_picture[is_present])
    for name in LABELS:
        np.testing.assert_array_equal(getattr(labels, name)[is_present], getattr(whole, name)[is_present])
    is_missing = ~is_present & is_clear & (whole.depth > 0)
    is_behind = is_missing & (labels.depth > 0)
    is_background = is_missing & (labels.depth == 0)
    assert is_present.sum() > 1000
    assert is_behind.sum() > 50
    assert is_background.sum() > 100
    assert (labels.depth[is_behind] > whole.depth[is_behind]).all()
    assert np.isnan(labels.coordinates[is_background]).all()
    assert np.isnan(labels.normals[is_background]).all()
    assert (picture[is_background] == made.render.background).all()


@pytest.mark.default_cases("tissue, lens")
@pytest.mark.parametrize(
    "render",
    [
        {"shading": "headlight", "wireframe": True, "size": [31, 57]},
        {"shading": "tissue", "light": {"relief": 1}, "camera": FISHEYE, "supersample": 2},
    ],
    ids=["headlight", "tissue, lens"],
)
def test_gpu_form_has_the_same_bits(render: dict[str, Any], mask_file: Path, device: Device) -> None:
    made = with_instruments(masked(mask_file, **render))
    assert_same_bits_with_lanes(made, speckle(300, 200), dented(made), 1)


def test_normals_at_the_outline_are_those_of_the_sheet(mask_file: Path, device: Device) -> None:
    """Mass points without sheet may be anywhere: no bit of the picture changes."""
    made = masked(mask_file, shading="tissue", camera="oblique", light={"relief": 0.5}, wireframe=True)
    mask, position, texture = rest_of(made.sheet).mask, dented(made), speckle(13, 17)
    assert mask is not None
    expected = Rasterizer(made, texture).draw(position)
    for lost in ([0.0, 0.0, 0.3], [np.nan, 0.0, 1e9]):
        position[~mask.points] = lost
        np.testing.assert_array_equal(Rasterizer(made, texture).draw(position), expected)
    assert (~mask.points).sum() == 4


@pytest.mark.parametrize("camera", ["oblique", FISHEYE], ids=["oblique", "fisheye"])
def test_tracks_and_flow(camera: Any, mask_file: Path, device: Device) -> None:
    made = masked(mask_file, camera=camera)
    position, shot = folded(made), Shot(folded(made), view(made))
    coordinates = np.random.default_rng(3).random((600, 2)).astype(np.float32)
    sight = tracking.locate_points(made, coordinates, shot)
    column, row = (coordinates * [10, 8]).astype(int).T
    on_sheet = present(made)[row, column]
    pixels, hidden = twin.project(made, coordinates.astype(float), position)
    np.testing.assert_allclose(sight.pixels[on_sheet], pixels[on_sheet], rtol=0, atol=1e-4)
    np.testing.assert_array_equal(sight.hidden[on_sheet], hidden[on_sheet])
    assert np.isnan(sight.pixels[~on_sheet]).all()
    assert sight.hidden[~on_sheet].all()
    # Through the missing cells of the upper layer, points of the lower one are visible.
    _, hidden_by_all = twin.project(masked(None, camera=camera), coordinates.astype(float), position)
    assert (hidden_by_all & ~hidden & on_sheet).sum() > 5

    labels = Rasterizer(made, speckle(8, 8), drawing_config(made, picture=False, labels=LABELS)).render(position).labels
    assert labels is not None
    flow, is_sheet = tracking.compute_flow(made, labels.coordinates, shot), labels.depth > 0
    # The same frame: no motion, and nothing is hidden; a coordinate is f32, of a picture 80 px wide.
    np.testing.assert_allclose(flow.flow[is_sheet], 0, atol=1e-3)
    assert not flow.occlusion.any()
    assert (flow.flow[~is_sheet] == np.float32(NO_FLOW)).all()


def test_picking_finds_the_visible_point(mask_file: Path) -> None:
    """The twin's coordinates at every pixel; None where the twin has background."""
    made = masked(mask_file, camera="oblique", size=[24, 18], refine=1)
    position, camera, mask = folded(made), view(made), rest_of(made.sheet).mask
    coordinates, _, _ = twin.labels(made, position)
    missed = 0
    for y, x in np.ndindex(18, 24):
        picked = pick(position, 1, camera, (x, y), mask)
        if np.isnan(coordinates[y, x, 0]):
            assert picked is None
            missed += pick(position, 1, camera, (x, y)) is not None
        else:
            assert picked == pytest.approx(tuple(coordinates[y, x]), abs=1e-9)
    assert missed > 10


def test_tracks_without_sheet_are_left_out(mask_file: Path, message: Messages) -> None:
    made = masked(mask_file).model_copy(update={"output": ("tracks",)})
    tracks = track_grid(8, rest_of(made.sheet))
    column, row = (tracks * [10, 8]).astype(int).T
    assert present(made)[row, column].all()
    assert len(tracks) < 64
    message(list(drawing_warnings(made.model_copy(update={"render": made.render.model_copy(update={"tracks": 8})}))))


def test_points_on_the_outline_belong_to_the_sheet(mask_file: Path) -> None:
    mask = rest_of(masked(mask_file).sheet).mask
    assert mask is not None
    places = np.array([[0.2, 0.05], [0.2, 0.0], [0.1, 0.125], [0.19, 0.05], [0.0, 0.0], [1.0, 1.0], [1.01, 1.0]])
    np.testing.assert_array_equal(mask.covers(places), [True, True, True, False, False, True, False])


def test_cameras(mask_file: Path) -> None:
    """Top frames the rectangle, so it is that of the whole sheet; fit and oblique frame the sheet alone."""
    cells = np.zeros((8, 10), np.uint8)
    cells[2:5, 5:9] = 255
    Image.fromarray(cells).save(mask_file)
    for surface in (None, {"tube": {"radius": 0.1}}):
        whole, small = (view(masked(file, surface, camera="top")) for file in (None, mask_file))
        np.testing.assert_array_equal(small.matrix, whole.matrix)
        for camera in ("fit", "oblique"):
            made = masked(mask_file, surface, camera=camera)
            pixels = view(made).pixels(rest_of(made.sheet).present_positions)
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            assert (low >= 0).all()
            assert (high <= (80, 60)).all()
            # One direction is filled, except for a margin of 4 % in distance and what perspective takes.
            assert ((high - low) / (80, 60)).max() > 0.85
    made = masked(mask_file, camera="fit")
    low, high = (f(view(made).pixels(rest_of(made.sheet).present_positions), axis=0) for f in (np.min, np.max))
    filled = ((high - low) / (80, 60)).argmax()
    np.testing.assert_allclose([low[filled], high[filled]], np.array([0.02, 0.98]) * (80, 60)[filled], rtol=1e-9)


def test_invisible_sheet(mask_file: Path, message: Messages) -> None:
    """A camera that sees a part of the rectangle without sheet shows nothing; a cell is visible without its corners."""
    close = {"target": [-0.18, 0.15, 0], "eye": [-0.18, 0.15, 0.01], "fov": 60}
    made = masked(mask_file, camera=close).model_copy(update={"output": ("depth",)})
    message(list(drawing_warnings(made)))
    for at in ([-0.1, -0.14], [0.06, -0.1]):
        seen = masked(mask_file, camera={"target": [*at, 0], "eye": [*at, 0.01], "fov": 60})
        assert not list(drawing_warnings(seen.model_copy(update={"output": ("depth",)})))
