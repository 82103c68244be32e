"""Estimation of parameters of a sheet with a hole: points, a table of a testing machine, and refused fits of maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm import Simulation, fit
from taichi_msm.errors import SceneError
from taichi_msm.gradients.gradient import gradient
from taichi_msm.machines.loading import find_approach
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import surface_positions, surface_weights
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.fitting.test_machine_fit import forces_of, write
from tests.golden import Messages

YOUNG = "tissue.young"
TIME = np.arange(5) / 20
# The last two are in the hole, the one before them on its outline.
PLACES = np.array([[0.2, 0.3], [0.15, 0.6], [0.8, 0.2], [0.6, 0.85], [0.25, 0.5], [0.5, 0.25], [0.5, 0.5], [0.6, 0.45]])
BALL = {"radius": 0.006, "shaft": [0.3, 0, 1], "length": 0.05}


@pytest.fixture(autouse=True)
def cwd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mask with a square hole between a quarter and three quarters of both sides."""
    monkeypatch.chdir(tmp_path)
    pixels = np.full((8, 8), 255, np.uint8)
    pixels[2:6, 2:6] = 0
    Image.fromarray(pixels).save("hole.png")


def scene(young: float = 2e4, **keys: Any) -> Scene:
    return Scene.model_validate(
        {
            "sheet": {"points": [17, 17], "size": [0.06, 0.06], "mask": "hole.png"},
            "tissue": {"young": young, "thickness": 2e-3, "density": 1000, "damping": 100}
            | {"foundation": 1e5, "foundation_active": "always"},
            "probes": [{"at": [0.2, 0.4], "total": -0.1, "radius": 0.01, "load": [[0, 0], [0.1, 100]]}],
            "time": {"duration": float(TIME[-1]), "frames_per_second": 20, "precision": "f64"},
            "output": [],
            **keys,
        }
    )


def test_recovery_from_points(device: Device, message: Messages) -> None:
    """Points that fall on no sheet are left out, whatever their values."""
    with Simulation(scene(), threads=device.threads) as simulation:
        values = []
        for frame in range(len(TIME)):
            simulation.advance(min(frame, 1))
            values.append(surface_positions(simulation.positions(), simulation.scene.render.refine, PLACES))
    position = np.stack(values, axis=1)
    position[-2:] += np.random.default_rng(0).normal(0, 0.01, position[-2:].shape)
    observed = {"time": TIME, "coordinates": PLACES, "position": position}
    result = fit(scene(young=3e4), observed, [YOUNG], workers=1)
    assert result.parameters[YOUNG].value == pytest.approx(2e4, rel=1e-6)
    assert result.identifiable
    message([note for note in result.notes if "no sheet" in note], "2 of 8 points")
    observed = {name: array if name == "time" else array[-2:] for name, array in observed.items()}
    with message.raises(SceneError, "observed: coordinates:"):
        fit(scene(young=3e4), observed, [YOUNG], workers=1)


def test_points_of_a_coarser_mesh() -> None:
    """Where the cells of a coarser mesh leave no sheet, a point continues a cell: linear positions are exact."""
    coarse = scene(sheet={"points": [3, 3], "size": [0.06, 0.06], "mask": "hole.png"}, probes=[]).sheet
    mask = rest_of(coarse).mask
    assert mask is not None
    assert not mask.covers(PLACES[:6]).all()
    corners, weights = surface_weights(PLACES, coarse, 3)
    assert mask.points.ravel()[corners].all()
    position = rest_of(coarse).position.reshape(-1, 3)
    np.testing.assert_allclose((weights[..., None] * position[corners]).sum(axis=1)[:, 0] / 0.06 + 0.5, PLACES[:, 0])


def test_maps_and_gradients_are_refused(device: Device, message: Messages) -> None:
    observed = {"time": TIME, "coordinates": PLACES[:1], "position": np.zeros((1, 5, 3)) + TIME[:, None]}
    with message.raises(SceneError, "sheet.mask: "):
        fit(scene(), observed, ["tissue.map"], resolution=4, workers=1)
    with message.raises(SceneError, "sheet.mask: "):
        gradient(scene(), lambda position: (0.0, 0 * position), threads=device.threads)


def test_recovery_from_the_table_of_a_ball(tmp_path: Path, message: Messages) -> None:
    """A ball meets the sheet beside the hole at z = 0; a line through the hole misses it."""
    path = {"path": [[0, 0.125, 0.5, 0.001], [1, 0.125, 0.5, -0.003]], "instrument": BALL}
    moving = {"motion": "quasistatic", "duration": 1}
    truth, start = (scene(young, probes=[path], time=moving) for young in (2e4, 3e4))
    time = np.arange(25) / 10
    # Rows without contact, then a ramp from the depth 1 mm.
    depth = 1e-3 + 3e-3 * np.clip((time - 1.2) / 1.2, -0.3, 1)
    approach = find_approach(truth)
    assert approach.start[2] == pytest.approx(0.006, abs=1e-11)
    placed = approach.place(truth.model_dump(mode="json", exclude_none=True), np.maximum(depth - 1e-3, 0), 10)
    table = write(tmp_path / "table.csv", time, depth, forces_of(truth, np.array(placed["probes"][0]["path"])))
    result = fit(start, table, [YOUNG], workers=1, contact=[1e-3], rate=10)
    # Rows have six digits: 0.5 uN of a force of some 0.1 N.
    assert result.parameters[YOUNG].value == pytest.approx(2e4, rel=1e-3)
    through = {"path": [[0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, -0.003]], "instrument": {**BALL, "shaft": [0, 0, 1]}}
    with message.raises(SceneError, "probes.0.path:"):
        find_approach(scene(probes=[through]))
