"""A run of a sheet with a picture by a camera and a mask: tracks, flow and exported texture coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import export, run
from taichi_msm.model.rest import rest_of
from taichi_msm.render.camera import view
from taichi_msm.runs.finished import read_run
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.exports.test_gltf import read_glb
from tests.scenes import speckle

WIDTH, HEIGHT = SIZE = 96, 72


@pytest.fixture(scope="module")
def ran(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a plane that is seen askew, without a corner of the picture."""
    folder = tmp_path_factory.mktemp("pictured")
    x, y = np.meshgrid((np.arange(WIDTH) - 47.5) / 80, (np.arange(HEIGHT) - 35.5) / 80)
    np.save(folder / "depth.npy", 0.06 / (1 - 0.3 * x + 0.2 * y))
    Image.fromarray(speckle(HEIGHT, WIDTH)).save(folder / "image.png")
    white = np.full((HEIGHT, WIDTH), 255, np.uint8)
    white[:30, :40] = 0
    Image.fromarray(white).save(folder / "mask.png")
    scene = {
        "image": str(folder / "image.png"),
        "sheet": {
            "points": [10, 13], "mask": str(folder / "mask.png"),
            "surface": {"depth": {"file": str(folder / "depth.npy"), "unit": "m"}, "grid": "given"},
        },
        "tissue": {"young": 2e4, "thickness": 0.002, "density": 1000, "foundation": 4e4, "damping": 30},
        "probes": [{"total": -0.2, "at": [0.6, 0.6], "radius": 0.006}],
        "render": {"camera": {"intrinsics": {"fx": 80, "fy": 80, "cx": 47.5, "cy": 35.5}}, "tracks": 6},
        "time": {"duration": 0.2, "frames_per_second": 10, "precision": "f64"},
        "output": ["trajectory", "png", "flow", "coordinates", "tracks"],
    }  # fmt: skip
    run(Scene.model_validate(scene), folder / "out", threads=device.threads)
    return folder / "out"


def fractions(ran: Path, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Fractions of the picture at which its camera sees points, shape (n, 2)."""
    return view(read_run(ran).scene).pixels(points.astype(float)) / SIZE


def test_tracks_and_flow(ran: Path) -> None:
    tracks, scene = np.load(ran / "tracks.npz"), read_run(ran).scene
    # A plane: triangles and cells are the same. f32: 1e-5 px.
    np.testing.assert_allclose(tracks["points"][:, 0], tracks["coordinates"] * SIZE, rtol=0, atol=1e-4)
    np.testing.assert_allclose(fractions(ran, tracks["position"][:, 0]), tracks["coordinates"], rtol=0, atol=1e-6)
    across, down = tracks["coordinates"].T
    assert not ((across < 35 / WIDTH) & (down < 25 / HEIGHT)).any()
    assert 36 - 9 <= len(across) < 36
    assert not tracks["occluded"].any()
    coordinates = np.load(ran / "coordinates" / "0000.npy")
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
    on_sheet = ~np.isnan(coordinates[..., 0])
    np.testing.assert_allclose(coordinates[on_sheet], (pixels / SIZE)[on_sheet], rtol=0, atol=1e-5)
    assert on_sheet.mean() == pytest.approx(rest_of(scene.sheet).present.mean(), abs=0.02)
    flow = np.fromfile(min((ran / "flow").iterdir()), np.float32)[3:].reshape(HEIGHT, WIDTH, 2)
    assert (np.abs(flow[~on_sheet]) > 1e9).all()
    assert 0.5 < np.abs(flow[on_sheet]).max() < 20


def test_texture_coordinates(ran: Path, tmp_path: Path) -> None:
    export(ran, "obj", tmp_path / "obj")
    export(ran, "gltf", tmp_path / "gltf")
    at_rest = read_run(ran).positions()[0]
    expected = fractions(ran, at_rest[rest_of(read_run(ran).scene.sheet).mask.points])  # type: ignore[union-attr]
    lines = (tmp_path / "obj" / "0000.obj").read_text().splitlines()
    found = np.array([line.split()[1:] for line in lines if line.startswith("vt ")], float)
    np.testing.assert_allclose(found * (1, -1) + (0, 1), expected, rtol=0, atol=1e-7)
    content = read_glb(tmp_path / "gltf" / "surface.glb")
    texture = content.accessor(content.primitive["attributes"]["TEXCOORD_0"])
    np.testing.assert_allclose(texture, expected, rtol=0, atol=1e-6)
