"""Exports of a sheet that is curved at rest: positions, orientation, texture coordinates and energy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import export, run
from taichi_msm.exports.inputs import unit_normals
from taichi_msm.runs.finished import read_run
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import make_plan
from taichi_msm.system.runtime import Device
from taichi_msm.terms.elasticity import energy_density
from tests import reference
from tests.exports.test_gltf import read_glb
from tests.exports.test_obj import rows
from tests.exports.test_rerun import logged
from tests.exports.test_vtk import read
from tests.scenes import speckle

POINTS = (9, 13)


@pytest.fixture(scope="module")
def ran(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of two thirds of a tube with folds, pressed from inside."""
    folder = tmp_path_factory.mktemp("curved")
    Image.fromarray(speckle(30, 40)).save(folder / "speckle.png")
    out = folder / "tube"
    scene = Scene.model_validate(
        {
            "image": str(folder / "speckle.png"),
            "sheet": {
                "points": POINTS, "size": [0.06, 0.1],
                "surface": {"tube": {"radius": 0.025, "folds": {"depth": 0.003, "spacing": 0.03}}},
            },
            "tissue": {"young": 2e4, "thickness": 0.002, "density": 1000, "damping": 30},
            "probes": [{"at": [0.2, 0.5], "total": -0.3, "radius": 0.008}],
            "time": {"duration": 0.2, "frames_per_second": 10, "precision": "f64"},
            "output": ["trajectory"],
        }
    )  # fmt: skip
    run(scene, out, threads=device.threads)
    return out


@pytest.fixture(scope="module")
def coordinates() -> NDArray[np.float64]:
    """Across and down of the mass points."""
    across, down = np.meshgrid(*(np.linspace(0, 1, count) for count in POINTS[::-1]))
    return np.stack([across, down], axis=-1).reshape(-1, 2)


def test_obj(ran: Path, tmp_path: Path, coordinates: NDArray[np.float64]) -> None:
    export(ran, "obj", tmp_path / "out")
    rest = np.load(ran / "rest.npz")
    for frame, position in enumerate(read_run(ran).positions()):
        path = tmp_path / f"out/000{frame}.obj"
        np.testing.assert_allclose(np.array(rows(path, "v"), float), position.reshape(-1, 3), rtol=5e-9)
        np.testing.assert_allclose(np.array(rows(path, "vt"), float), coordinates * (1, -1) + (0, 1), atol=1e-8)
    path = tmp_path / "out/0000.obj"
    vertices, normals = (np.array(rows(path, key), float) for key in ("v", "vn"))
    np.testing.assert_allclose(vertices, rest["position"].reshape(-1, 3), rtol=5e-9)
    # Central differences, one-sided at the edges, against the mean of cells of 19 degrees.
    assert (normals * rest["normal"].reshape(-1, 3)).sum(axis=-1).min() > np.cos(np.radians(11))
    corners = np.array([[corner.split("/")[0] for corner in face] for face in rows(path, "f")], int) - 1
    a, b, c = np.moveaxis(vertices[corners], 1, 0)
    assert ((np.cross(b - a, c - a) * normals[corners[:, 0]]).sum(axis=-1) > 0).all(), "counter-clockwise from inside"


def test_energy_density(ran: Path) -> None:
    made, rest = read_run(ran), np.load(ran / "rest.npz")
    plan, displacement = make_plan(made.scene), made.positions()[-1] - rest["position"]
    total = reference.energy(made.scene, displacement)
    assert total > 1e-6
    assert (energy_density(plan, displacement) * rest["area"]).sum() == pytest.approx(total, rel=1e-12)


def test_vtk(ran: Path, tmp_path: Path, coordinates: NDArray[np.float64]) -> None:
    pytest.importorskip("vtkmodules")
    export(ran, "vtk", tmp_path / "out")
    made, rest = read_run(ran), np.load(ran / "rest.npz")
    for frame, position in enumerate(made.positions()):
        _, arrays = read(tmp_path / f"out/000{frame}.vtu")
        displacement = position - rest["position"]
        np.testing.assert_array_equal(arrays["points"], position.reshape(-1, 3))
        np.testing.assert_array_equal(arrays["displacement"], displacement.reshape(-1, 3))
        np.testing.assert_allclose(arrays["texture"], coordinates * (1, -1) + (0, 1), atol=1e-15)
        total = reference.energy(made.scene, displacement)
        assert (arrays["energy_density"] * rest["area"].ravel()).sum() == pytest.approx(total, rel=1e-12)
    assert total > 1e-6


def test_gltf(ran: Path, tmp_path: Path, coordinates: NDArray[np.float64]) -> None:
    export(ran, "gltf", tmp_path / "out")
    content, expected = read_glb(tmp_path / "out/surface.glb"), read_run(ran).positions()
    for frame, position in enumerate(expected):
        np.testing.assert_allclose(content.at(frame / 10), position.reshape(-1, 3), rtol=0, atol=1e-8)
        np.testing.assert_allclose(content.at(frame / 10, "NORMAL"), unit_normals(position), rtol=0, atol=1e-6)
    np.testing.assert_allclose(content.attribute("TEXCOORD_0"), coordinates, atol=1e-7)


def test_rerun(ran: Path, tmp_path: Path, coordinates: NDArray[np.float64]) -> None:
    pytest.importorskip("rerun.chunk")
    export(ran, "rerun", tmp_path / "out")
    log, sheet = logged(tmp_path / "out/000000.rrd"), "/world/sheet Mesh3D:"
    for frame, position in enumerate(read_run(ran).positions()):
        np.testing.assert_allclose(log[sheet + "vertex_positions"][frame], position.reshape(-1, 3), atol=1e-8)
        np.testing.assert_allclose(log[sheet + "vertex_normals"][frame], unit_normals(position), atol=1e-6)
    np.testing.assert_allclose(log[sheet + "vertex_texcoords"][0], coordinates, atol=1e-7)
