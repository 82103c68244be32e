"""Estimation of parameters of curved sheets: points, pixels, forces and tables of a testing machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm import Simulation, fit, run
from taichi_msm.fitting.points import Positions
from taichi_msm.machines.loading import find_approach
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import surface_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.fitting.test_machine_fit import forces_of, write

YOUNG = "tissue.young"
TUBE: Any = {"tube": {"radius": 0.03, "folds": {"depth": 0.003, "spacing": 0.04}}}
DOME: Any = {"dome": {"radius": 0.08}}
BALL = {"radius": 0.006, "shaft": [0.3, 0, 1], "length": 0.05}
TIME = np.arange(5) / 20
QUASISTATIC = {"motion": "quasistatic", "duration": float(TIME[-1]), "frames_per_second": 20}
PLACES = np.random.default_rng(0).uniform(0.1, 0.9, (30, 2))


def scene(surface: Any, young: float = 2e4, **keys: Any) -> Scene:
    """A sheet that is pressed along its normal at a place on the side."""
    return Scene.model_validate(
        {
            "sheet": {"points": [9, 9], "size": [0.06, 0.06], "surface": surface},
            "tissue": {"young": young, "thickness": 2e-3, "density": 1000, "foundation": 1e5, "damping": 100}
            | {"foundation_active": "always"},
            "probes": [{"at": [0.3, 0.4], "total": -0.4, "radius": 0.01, "load": [[0, 0], [0.1, 100]]}],
            "time": {"duration": float(TIME[-1]), "frames_per_second": 20, "precision": "f64"},
            "render": {"camera": {"eye": [0.01, -0.03, 0.1], "target": [0, 0, 0]}},
            "output": [],
            **keys,
        }
    )


def observations(truth: Scene, kind: str, device: Device) -> NDArray[np.float64]:
    """Positions [m] or pixels of PLACES in every frame."""
    values: list[NDArray[Any]] = []
    with Simulation(truth, threads=device.threads) as simulation:
        for frame in range(len(TIME)):
            simulation.advance(min(frame, 1))
            if kind == "position":
                values.append(surface_positions(simulation.positions(), truth.render.refine, PLACES))
            else:
                values.append(simulation.locate(PLACES).pixels.astype(float))
    return np.stack(values, axis=1)


@pytest.mark.parametrize("surface", [TUBE, DOME], ids=["tube", "dome"])
@pytest.mark.parametrize("kind", ["position", "pixel"])
def test_recovery_from_points(kind: str, surface: Any, device: Device) -> None:
    observed = {"time": TIME, "coordinates": PLACES, kind: observations(scene(surface), kind, device)}
    result = fit(scene(surface, young=3e4), observed, [YOUNG], workers=1)
    # Pixels are located in f32.
    assert result.parameters[YOUNG].value == pytest.approx(2e4, rel=1e-6 if kind == "position" else 1e-3)
    assert result.identifiable


@pytest.mark.parametrize("surface", [TUBE, DOME], ids=["tube", "dome"])
def test_points_at_rest_are_on_the_surface(surface: Any) -> None:
    made = scene(surface)
    rows, cols = made.sheet.points
    j, i = np.meshgrid(np.arange(cols), np.arange(rows))
    places = np.stack([j / (cols - 1), i / (rows - 1)], axis=-1).reshape(-1, 2)
    observed = Positions("", np.zeros(1), np.zeros((len(places), 1, 3)), None, places)
    expected = rest_of(made.sheet).position.reshape(-1, 3)
    np.testing.assert_allclose(observed.rest_positions(made), expected, atol=1e-15)
    assert not list(Positions("", np.zeros(1), expected[:, None], None, places).faults(made))


def test_recovery_from_positions_and_forces_of_a_tool(tmp_path: Path, device: Device) -> None:
    tool = {"path": [[0, 0.3, 0.4, 0.001], [0.2, 0.6, 0.4, -0.003]], "instrument": BALL}
    truth = scene(DOME, probes=[tool], time=QUASISTATIC, output=["trajectory", "forces"])
    run(truth, tmp_path / "truth", threads=device.threads)
    start = scene(DOME, young=3e4, probes=[tool], time=QUASISTATIC)
    free = [YOUNG, "tissue.foundation"]
    forces = (tmp_path / "truth/forces.csv", 1e-4)
    result = fit(start, tmp_path / "truth/trajectory.npz", free, workers=1, forces=forces, sigma=1e-6)
    assert [result.parameters[key].value for key in free] == pytest.approx([2e4, 1e5], rel=1e-5)


def test_recovery_from_the_table_of_a_ball_pressed_along_the_normal(tmp_path: Path) -> None:
    path = {"path": [[0, 0.3, 0.4, 0.001], [1, 0.3, 0.4, -0.003]], "instrument": BALL}
    sheet = {"points": [13, 13], "size": [0.04, 0.04], "surface": {"dome": {"radius": 0.03}}}
    moving = {"motion": "quasistatic", "duration": 1}
    truth, start = (scene(DOME, young, probes=[path], time=moving, sheet=sheet) for young in (2e4, 3e4))
    normal = rest_of(truth.sheet).normals(np.array([[0.3, 0.4]]))[0]
    time = np.arange(25) / 10
    # Rows without contact, then a ramp from the depth 1 mm.
    depth = 1e-3 + 3e-3 * np.clip((time - 1.2) / 1.2, -0.3, 1)
    placed = find_approach(truth).place(
        truth.model_dump(mode="json", exclude_none=True), np.maximum(depth - 1e-3, 0), 10
    )
    keys = np.array(placed["probes"][0]["path"])
    force = sum(normal[axis] * forces_of(truth, keys, axis) for axis in range(3))
    assert normal[0] < -0.2
    table = write(tmp_path / "table.csv", time, depth, force)
    result = fit(start, table, [YOUNG], workers=1, contact=[1e-3], rate=10)
    # Rows have six digits: 0.02 mN of a force of 0.2 N.
    assert result.parameters[YOUNG].value == pytest.approx(2e4, rel=1e-3)
