"""An observation of another kind: its rounded values determine the difference step, and its panel is in fit.png."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm import Simulation, fit
from taichi_msm.fitting.observation import Observation, ObservationModel
from taichi_msm.fitting.panels import Panel
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device

Array = NDArray[np.float64]

# Smallest difference of depths [m].
QUANTUM, YOUNG = 1e-5, "tissue.young"


def scene(young: float) -> Scene:
    """A sheet that sinks in its middle, by millimetres."""
    return Scene.model_validate(
        {
            "sheet": {"points": [9, 9], "size": [0.1, 0.1], "fixed": "border"},
            "tissue": {"young": young, "thickness": 3e-3, "density": 1050, "damping": 200, "pretension": 1},
            "probes": [{"total": [0, 0, -0.3], "radius": 0.02, "load": [[0, 0], [0.1, 100]]}],
            "time": {"duration": 0.2, "frames_per_second": 50, "precision": "f64"},
            "output": [],
        }
    )


class DepthModel(ObservationModel):
    def record(self, simulation: Simulation) -> Array:
        position = simulation.positions()
        return position[len(position) // 2, len(position) // 2, [2]]

    def predict(self, recorded: Array) -> Array:
        return QUANTUM * np.round(recorded / QUANTUM)


@dataclass(frozen=True, eq=False)
class Depths(Observation):
    """Depths of the middle of a sheet [m], in multiples of `QUANTUM`, shape (frames, 1)."""

    noun: ClassVar[str] = "depths"
    unit: ClassVar[str] = "m"
    plotted: ClassVar[list[str]] = []

    def build_model(self, scene: Scene, frames: int) -> DepthModel:
        return DepthModel()

    def signal(self, scene: Scene) -> float:
        return float(np.sqrt(np.mean(self.values**2)))

    def difference_step(self, scene: Scene) -> float:
        return max(super().difference_step(scene), float(np.sqrt(QUANTUM / self.signal(scene))))

    def panels(self, scene: Scene, fitted: Array) -> list[Panel]:
        return [*super().panels(scene, fitted), lambda axes: self.plotted.append(axes.get_title() or "new axes")]


def test_step_and_panel_of_an_observation(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the step of f64, differences of these values are 0."""
    model, frames = DepthModel(), []
    with Simulation(scene(3e4), threads=device.threads) as simulation:
        for frame in range(11):
            simulation.advance(min(frame, 1))
            frames.append(model.record(simulation))
    observed = Depths("depths.npz", np.arange(11) / 50, model.predict(np.array(frames)), None)
    monkeypatch.setattr("taichi_msm.fitting.fit.read_observations", lambda *arguments: observed)
    result = fit(scene(2e4), "depths.npz", [YOUNG], directory=tmp_path / "out", workers=1)
    # Without bending stiffness, the depth is about (force / young)^(1/3): its derivative by log(young) is a third.
    tolerance = QUANTUM / (observed.signal(scene(2e4)) / 3)
    assert result.parameters[YOUNG].value == pytest.approx(3e4, rel=tolerance)
    assert any(line.startswith("residual 0 m of 11 depths") for line in result.summary())
    assert observed.plotted == ["new axes"]
    monkeypatch.setattr(Depths, "difference_step", Observation.difference_step)
    assert not fit(scene(2e4), "depths.npz", [YOUNG], workers=1).identifiable
