"""Surface, texture and material in OBJ files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taichi_msm.exports.export import export
from taichi_msm.exports.inputs import unit_normals
from tests.runs.test_finished import change_scene
from tests.scenes import speckle


@pytest.fixture(scope="module")
def out(ran: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("obj")
    export(ran, "obj", out)
    return out


def rows(path: Path, key: str) -> list[list[str]]:
    """Return the words of the lines that begin with a key."""
    lines = (line.split() for line in path.read_text(encoding="ascii").splitlines())
    return [words[1:] for words in lines if words and words[0] == key]


def test_positions_and_normals_of_every_frame(ran: Path, out: Path) -> None:
    expected = np.load(ran / "trajectory.npz")["position"]
    assert sorted(path.name for path in out.glob("*.obj")) == [f"000{frame}.obj" for frame in range(5)]
    for frame, position in enumerate(expected):
        path = out / f"000{frame}.obj"
        # Nine digits.
        np.testing.assert_allclose(np.array(rows(path, "v"), float), position.reshape(-1, 3), rtol=5e-9)
        np.testing.assert_allclose(np.array(rows(path, "vn"), float), unit_normals(position), rtol=5e-9)


def test_orientation_and_texture_coordinates(out: Path) -> None:
    path = out / "0000.obj"
    corners = np.array([[corner.split("/") for corner in face] for face in rows(path, "f")], int)
    assert corners.shape == (2 * 8 * 10, 3, 3)
    assert (corners == corners[..., :1]).all(), "one number for position, texture and normal"
    places, coordinates = np.array(rows(path, "v"), float), np.array(rows(path, "vt"), float)
    a, b, c = np.moveaxis(places[corners[..., 0] - 1], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all(), "counter-clockwise from above"
    # From the lower left.
    np.testing.assert_allclose(coordinates, places[:, :2] / (0.4, 0.3) + 0.5, rtol=0, atol=1e-8)


def test_material(out: Path, results: Path) -> None:
    for path in out.glob("*.obj"):
        assert rows(path, "mtllib") == [["surface.mtl"]]
        assert rows(path, "usemtl") == rows(out / "surface.mtl", "newmtl") == [["sheet"]]
    assert rows(out / "surface.mtl", "map_Kd") == [["picture.png"]]
    np.testing.assert_array_equal(np.asarray(Image.open(out / "picture.png")), speckle(30, 40))
    change_scene(results, image=None, output=["trajectory"])
    assert "picture.png" not in export(results, "obj", results / "out").files
    assert rows(results / "out" / "surface.mtl", "map_Kd") == []
