"""Sessions of a sheet with a picture by a camera: another view changes neither the surface nor the picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm import load_scene
from taichi_msm.model.rest import rest_of
from taichi_msm.system.runtime import Device
from taichi_msm.view.events import Drag, Press, Turn
from taichi_msm.view.recording import Captures
from taichi_msm.view.session import Session
from tests.scenes import speckle

WIDTH, HEIGHT = 96, 72


@pytest.mark.parametrize("kind", ["depth", "points"])
def test_session(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    camera: dict[str, Any] = {"intrinsics": {"fx": 80, "fy": 80, "cx": 47.5, "cy": 35.5}}
    x, y = np.meshgrid((np.arange(WIDTH) - 47.5) / 80, (np.arange(HEIGHT) - 35.5) / 80)
    depth = 0.06 / (1 - 0.3 * x + 0.2 * y)
    Image.fromarray(speckle(HEIGHT, WIDTH)).save("image.png")
    np.save("depth.npy", depth)
    surface = {"depth": {"file": "depth.npy", "unit": "m"}}
    sheet: dict[str, Any] = {"points": [10, 13], "surface": surface}
    if kind == "points":
        x, y = np.meshgrid(np.linspace(-0.6, 0.6, 13), np.linspace(-0.45, 0.45, 10))
        z = 0.06 / (1 - 0.3 * x + 0.2 * y)
        np.save("points.npy", np.stack([x * z, -y * z, -z], axis=-1))
        sheet = {"surface": {"points": {"file": "points.npy", "unit": "m"}, "picture": "main"}}
        camera["pose"] = {"rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "translation": [0, 0, 0]}
    scene = {
        "image": "image.png",
        "sheet": sheet,
        "tissue": {"young": 2e4, "thickness": 0.002, "density": 1000, "foundation": 4e4, "damping": 30},
        "probes": [{"total": -0.2, "at": [0.5, 0.5], "radius": 0.006}],
        "render": {"camera": camera, "refine": 2, "shading": "headlight"},
        "time": {"duration": 1, "frames_per_second": 30, "precision": "f64"},
    }
    Path("scene.yaml").write_text(json.dumps(scene))
    with Session(load_scene("scene.yaml"), Captures(Path("captures"), "scene.yaml"), threads=2) as session:
        at_rest = rest_of(session.scene.sheet).position.copy()
        assert np.abs(session.bare_picture().astype(int) - speckle(HEIGHT, WIDTH)).max() <= 1
        session.handle(Press(30.0, 40.0))
        session.advance()
        # In a scene file, places have six digits.
        assert session.tool.position == pytest.approx((30.5 / WIDTH, 40.5 / HEIGHT), abs=1e-3)
        session.handle(Drag(40.0, 44.0))
        session.advance()
        assert session.tool.position == pytest.approx((40.5 / WIDTH, 44.5 / HEIGHT), abs=1e-3)
        session.handle(Turn(20, 10))
        session.advance()
        assert np.abs(session.bare_picture().astype(int) - speckle(HEIGHT, WIDTH)).mean() > 10
        path = session.captures.save_scene(session.recorded_scene())
        positions = session.positions().copy()
    recorded = load_scene(str(path))
    np.testing.assert_array_equal(rest_of(recorded.sheet).position, at_rest)
    assert [*recorded.render.all_cameras] == ["main", "picture"]
    assert np.abs(positions - at_rest).max() > 1e-4
