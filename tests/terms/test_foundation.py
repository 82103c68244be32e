"""Elastic foundations with a map of their stiffness, or given by Young's modulus and depth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.errors import SceneError
from taichi_msm.load.scene_file import load_scene
from taichi_msm.runs.run import run
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Foundation
from taichi_msm.solver.state import RunProgress, largest_displacement
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import frames, notes_of
from tests.scenes import plan_of, speckle
from tests.solver.test_tissue_physics import EVERYWHERE, tissue, weight

TOOL = {"at": [0.4, 0.6], "total": [0.3, 0.2, -2], "radius": 0.01, "falloff": 100, "load": [[0, 0], [0.05, 100]]}


@pytest.fixture
def image(tmp_path: Path) -> str:
    """A map of noise."""
    Image.fromarray(speckle(7, 9)[..., 0]).save(tmp_path / "deep.png")
    return str(tmp_path / "deep.png")


def mapped(image: str, fixed: Any = "border", **more: Any) -> Scene:
    """Tissue on a foundation whose stiffness varies by a factor of ten."""
    terms: dict[str, Any] = {"foundation": 2e6, "foundation_map": {"image": image, "range": [0.5, 5]}}
    return tissue((13, 15), fixed=fixed, **terms | {"damping": 40, "probes": [TOOL], "time": {"duration": 0.08}} | more)


def test_depth_without_springs(image: str, device: Device) -> None:
    """The depth of each mass point is the pressure over its stiffness."""
    probe = {**EVERYWHERE, "total": [0, 0, -0.5], "load": [[0, 100]]}
    # Critically damped, with (K / m)^(1/2) from 97 to 309 1/s: e^-29 remains after 0.3 s.
    made = mapped(image, "none", young=1e-9, damping=200, probes=[probe], time={"duration": 0.32})
    factors: Any = plan_of(made).material.virtual_factors
    pressure = 0.5 / weight(plan_of(made).scene.probes[0])
    np.testing.assert_allclose(frames(made, device)[-1, ..., 2], -pressure / (2e6 * factors), rtol=1e-9)


def test_steering_with_a_foundation_map(image: str, device: Device) -> None:
    """Only the fields of decay factors change, not that of the foundation."""
    probe = {**TOOL, "at": [0.7, 0.3]}
    with (
        Simulation(mapped(image), threads=device.threads) as steered,
        Simulation(mapped(image, probes=[probe]), threads=device.threads) as expected,
    ):
        steered.steer([probe])
        steered.advance(2)
        expected.advance(2)
        assert steered.positions().tobytes() == expected.positions().tobytes()


def test_energy_of_the_foundation_is_not_a_divergence(tmp_path: Path, device: Device) -> None:
    """A sheet without other support is released away from rest."""
    white = str(tmp_path / "white.png")
    Image.new("L", (3, 3), 255).save(white)
    stiff = {"foundation": 1e4, "foundation_map": {"image": white, "range": [1, 400]}, "foundation_active": "always"}
    made = mapped(white, "none", young=1.0, damping=0, probes=[], **stiff)
    with Simulation(made, threads=device.threads) as simulation:
        away = np.full((*made.sheet.points, 3), [0, 0, 0.02])
        saved = simulation.save()
        state = saved.state._replace(displacement=away)
        simulation.restore(saved._replace(state=state, progress=RunProgress(reach=largest_displacement(away).reach)))
        simulation.advance(2)
        held = 400 * 1e4 / 2 * 0.1**2 * 0.02**2
        # Without the map, 4 / 400 of this energy would be allowed.
        assert held / 10 < simulation.progress.peak < 1.1 * held


SCENE = """\
sheet: {points: [9, 11], size: [0.1, 0.1]}
tissue:
  young: 3.0e4
  thickness: 2.0e-3
  density: 1050
  foundation: {young: 15e3, depth: 0.05}
  damping: 40
probes:
  - {total: [0, 0, -2], radius: 0.01, falloff: 100, load: [[0, 0], [0.2, 100]]}
time: {duration: 0.4, frames_per_second: 10}
output: [trajectory]
"""


INVALID = [
    "foundation={young: 1e4}", "foundation.depth=0", "foundation.depht=1", "foundation=-1", "foundation=soft",
    "foundation=0", "foundation_map={image: no.png, range: [1, 2]}", "foundation_map.image=deep.png",
]  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, image: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with a scene and two maps."""
    monkeypatch.chdir(tmp_path)
    Image.fromarray(speckle(5, 4, 2)[..., 0]).save("stiff.png")
    Path("s.yaml").write_text(SCENE)
    return tmp_path


@pytest.mark.usefixtures("folder")
def test_stiffness_from_young_and_depth(device: Device) -> None:
    layer, plain = load_scene("s.yaml"), load_scene("s.yaml", ["tissue.foundation=3.0e5"])
    assert layer.tissue is not None
    assert layer.tissue.foundation == Foundation(young=15e3, depth=0.05)
    assert frames(layer, device).tobytes() == frames(plain, device).tobytes()
    softer = load_scene("s.yaml", ["tissue.foundation.young=3e3"])
    assert plan_of(softer).material.virtual == pytest.approx(plan_of(layer).material.virtual / 5)


@pytest.mark.usefixtures("folder")
def test_record_of_foundation_and_maps(device: Device) -> None:
    maps = ("map={image: stiff.png, range: [1, 2]}", "foundation_map={image: deep.png, range: [1, 2]}")
    made = load_scene("s.yaml", [f"tissue.{setting}" for setting in maps])
    record = run(made, "out", threads=device.threads, estimate_error=False)
    assert record["scene"]["tissue"]["foundation"] == {"young": 15e3, "depth": 0.05}
    assert list(record["sha256"]) == ["tissue.map.image", "tissue.foundation_map.image"]


@pytest.mark.usefixtures("folder")
def test_warning_beyond_a_third_of_the_depth(device: Device, message: Messages) -> None:
    made = tissue((9, 9), foundation={"young": 15e3, "depth": 0.03}, probes=[TOOL])
    assert not notes_of(made, RunProgress(1, max_displacement=0.02, deepest=0.0099), None)
    message(notes_of(made, RunProgress(1, 0.02, deepest=0.0101), None), "tissue.foundation.depth")
    assert not notes_of(tissue((9, 9), foundation=5e5, probes=[TOOL]), RunProgress(1, 0.02, deepest=0.02), None), (
        "unknown depth"
    )
    soft = ["tissue.foundation={young: 1.5e3, depth: 5e-3}", "probes.0.falloff=300"]
    record = run(load_scene("s.yaml", soft), "out", threads=device.threads, estimate_error=False)
    deepest = -float(np.load("out/trajectory.npz")["position"][..., 2].min())
    assert any(f"pressed {1000 * deepest:.3g} mm into the 5 mm" in note for note in record["notes"])


@pytest.mark.usefixtures("folder")
def test_invalid_foundations(message: Messages) -> None:
    for override in INVALID:
        more = ["tissue.foundation_map={image: deep.png, range: [1, 2]}"] if override == "foundation=0" else []
        with message.raises(SceneError, "tissue.foundation"):
            load_scene("s.yaml", [f"tissue.{override}", *more])
