"""Exports of a sheet with a mask: only cells that are sheet, and mass points that they have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import FilesError, Simulation, export, run
from taichi_msm.exports.inputs import unit_normals
from taichi_msm.model.mask import Mask
from taichi_msm.runs.finished import read_run
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import make_plan
from taichi_msm.system.runtime import Device
from taichi_msm.terms.elasticity import energy_density
from tests.exports.test_gltf import read_glb
from tests.exports.test_obj import rows
from tests.exports.test_rerun import logged
from tests.exports.test_vtk import read
from tests.golden import Messages
from tests.reference.shading import normals
from tests.scenes import speckle

ROWS, COLS = 8, 10  # of cells
SIZE = 0.08, 0.1


def cells() -> NDArray[np.bool_]:
    """A hole of 2 x 3 cells, whose two inner mass points have no cell, and no upper left corner."""
    present = np.ones((ROWS, COLS), bool)
    present[3:5, 4:7] = False
    present[0, 0] = False
    return present


def build_scene(folder: Path) -> Scene:
    Image.fromarray(speckle(30, 40)).save(folder / "speckle.png")
    Image.fromarray(cells() * np.uint8(255)).save(folder / "mask.png")
    return Scene.model_validate(
        {
            "image": str(folder / "speckle.png"),
            "sheet": {"points": [ROWS + 1, COLS + 1], "size": SIZE, "mask": str(folder / "mask.png")},
            "tissue": {"young": 2e4, "thickness": 0.002, "density": 1000, "damping": 30},
            "probes": [{"at": [0.2, 0.5], "total": [0, 0, -0.3], "radius": 0.02}],
            "time": {"duration": 0.2, "frames_per_second": 10, "precision": "f64"},
            "render": {"size": [40, 30], "tracks": 8, "camera": "oblique"},
            "output": ["trajectory", "png", "tracks"],
        }
    )


@pytest.fixture(scope="module")
def ran(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("masked")
    run(build_scene(folder), folder / "out", threads=device.threads)
    return folder / "out"


def points() -> NDArray[np.bool_]:
    """Mass points of the sheet: all but two in the hole and one at the corner."""
    present = np.ones((ROWS + 1, COLS + 1), bool)
    present[[4, 4, 0], [5, 6, 0]] = False
    return present


def area(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> float:
    a, b, c = np.moveaxis(np.asarray(vertices, float)[triangles], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2)


# The flat sheet in the first frame, in f32 or with nine digits.
AREA = pytest.approx(cells().sum() * SIZE[0] * SIZE[1] / (ROWS * COLS), rel=1e-6)


def test_obj(ran: Path, tmp_path: Path) -> None:
    export(ran, "obj", tmp_path / "out")
    for frame, position in enumerate(read_run(ran).positions()):
        path = tmp_path / f"out/000{frame}.obj"
        vertices = np.array(rows(path, "v"), float)
        np.testing.assert_allclose(vertices, position[points()], rtol=5e-9)
        expected = normals(position, cells())[points()]
        np.testing.assert_allclose(np.array(rows(path, "vn"), float), expected, rtol=0, atol=1e-9)
        faces = np.array([[corner.split("/")[0] for corner in face] for face in rows(path, "f")], int) - 1
        assert len(faces) == 2 * cells().sum()
        np.testing.assert_array_equal(np.unique(faces), np.arange(points().sum()))
        if frame == 0:
            assert area(vertices, faces) == AREA
    textures = np.array(rows(path, "vt"), float)
    np.testing.assert_allclose(textures, vertices_at_rest()[:, :2] / SIZE[::-1] + 0.5, atol=1e-8)


def vertices_at_rest() -> NDArray[np.float64]:
    i, j = np.argwhere(points()).T
    x, y = (j / COLS - 0.5) * SIZE[1], (0.5 - i / ROWS) * SIZE[0]
    return np.stack([x, y, 0 * x], axis=-1)


def test_gltf(ran: Path, tmp_path: Path) -> None:
    export(ran, "gltf", tmp_path / "out")
    content, mask = read_glb(tmp_path / "out/surface.glb"), Mask(cells())
    for frame, position in enumerate(read_run(ran).positions()):
        np.testing.assert_allclose(content.at(frame / 10), position[points()], rtol=0, atol=1e-8)
        np.testing.assert_allclose(content.at(frame / 10, "NORMAL"), unit_normals(position, mask), rtol=0, atol=1e-6)
    triangles = content.accessor(content.primitive["indices"]).reshape(-1, 3)
    assert len(triangles) == 2 * cells().sum()
    assert area(content.at(0), triangles) == AREA


def test_vtk(ran: Path, tmp_path: Path) -> None:
    pytest.importorskip("vtkmodules")
    export(ran, "vtk", tmp_path / "out")
    plan = make_plan(read_run(ran).scene)
    for frame, position in enumerate(read_run(ran).positions()):
        grid, arrays = read(tmp_path / f"out/000{frame}.vtu")
        np.testing.assert_array_equal(arrays["points"], position[points()])
        np.testing.assert_array_equal(arrays["displacement"], position[points()] - vertices_at_rest())
        assert grid.GetNumberOfCells() == 2 * cells().sum()
        displacement = position - read_run(ran).positions()[0]
        np.testing.assert_array_equal(arrays["energy_density"], energy_density(plan, displacement)[points()])
    assert arrays["energy_density"].max() > 0.01


def test_rerun(ran: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun.chunk")
    export(ran, "rerun", tmp_path / "out")
    log, sheet = logged(tmp_path / "out/000000.rrd"), "/world/sheet Mesh3D:"
    for frame, position in enumerate(read_run(ran).positions()):
        np.testing.assert_allclose(log[sheet + "vertex_positions"][frame], position[points()], atol=1e-8)
    assert len(log[sheet + "triangle_indices"][0]) == 2 * cells().sum()


def test_tracks(ran: Path, tmp_path: Path) -> None:
    """Tracks at the centres of 8 x 8 equal parts: 4 are in the hole, which is 0.375 to 0.625 high, 0.4 to 0.7 wide."""
    export(ran, "tapvid", tmp_path / "out")
    coordinates = np.load(ran / "tracks.npz")["coordinates"]
    across, down = np.moveaxis(coordinates, -1, 0)
    assert not ((across > 0.4) & (across < 0.7) & (down > 0.375) & (down < 0.625)).any()
    # The centre of the first part is at 0.0625, in the cell without sheet.
    assert len(coordinates) == 64 - 2 * 3 - 1


def test_surface_of_a_simulation(tmp_path: Path, device: Device) -> None:
    with Simulation(build_scene(tmp_path), threads=device.threads) as simulation:
        surface, refine = simulation.surface(), simulation.scene.render.refine
    assert len(surface.triangles) == 2 * cells().sum() * (refine + 1) ** 2
    assert area(surface.vertices, surface.triangles) == AREA
    np.testing.assert_array_equal(np.unique(surface.triangles), np.arange(len(surface.vertices)))
    np.testing.assert_allclose(surface.texture_coordinates, surface.vertices[:, :2] / SIZE[::-1] * [1, -1] + 0.5)


def test_export_requires_the_mask_of_the_run(ran: Path, tmp_path: Path, message: Messages) -> None:
    mask = ran.parent / "mask.png"
    content = mask.read_bytes()
    try:
        Image.fromarray(~cells() * np.uint8(255)).save(mask)
        with message.raises(FilesError, "sheet.mask.image"):
            export(ran, "obj", tmp_path / "out")
    finally:
        mask.write_bytes(content)
