"""Forces of probes on the sheet, against the NumPy reference and closed forms."""

from __future__ import annotations

import csv
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm import ArgumentError, DivergedError, Simulation, run
from taichi_msm.cli.console import run_summary
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import surface_point
from taichi_msm.model.tool_force import control_point
from taichi_msm.scene.scene import Scene
from taichi_msm.system.process import available_threads
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.scenes import plan_of, scene
from tests.terms.test_contact import CASES, PRESSED, touching

Array = NDArray[np.float64]


def expected_forces(made: Scene) -> Array:
    """Mean force of every probe over each frame in the reference [N], shape (frames, probes, 3)."""
    plan = plan_of(made)
    per_frame, forces = plan.grid.steps_per_frame, []
    for n, (_, contact) in enumerate(reference.steps(plan)):
        if n > 0:
            forces.append(contact.force.sum(axis=(1, 2)))
    return np.array(forces).reshape(-1, per_frame, len(made.probes), 3).mean(axis=1)


@pytest.mark.parametrize(
    ("precision", "difference", "error"),
    [
        pytest.param("f32", "central", 2e-3, marks=pytest.mark.slow),
        ("f64", "central", 1e-13),
        ("f64", "backward", 1e-13),
    ],
)
def test_tool_force_against_the_reference(precision: str, difference: str, error: float, device: Device) -> None:
    """In f32, positions of 0.1 m are rounded by 4e-9 m, and contact corrections are 1e-5 m."""
    made = touching(CASES["together"], time={"precision": precision, "damping_difference": difference})
    forces, expected = [], expected_forces(made)
    with Simulation(made, threads=device.threads) as simulation:
        assert all(tip.force == (0, 0, 0) for tip in simulation.forces())
        for frame, each in enumerate(expected):
            simulation.advance()
            forces.append([tip.force for tip in simulation.forces()])
            lowest = [tool.lowest_point((frame + 1) / 25) for tool in plan_of(made).tools]
            assert [tip.tip for tip in simulation.forces()] == lowest
            assert np.abs(np.array(forces[-1]) - each).max() < error * np.abs(expected).max()
        norms = np.linalg.norm(forces, axis=2)
        for index, peak in enumerate(simulation.felt.greatest):
            greatest = int(norms[:, index].argmax())
            assert (peak.time, peak.force) == ((greatest + 1) / 25, forces[greatest][index])


# Jumps up at a frame, down between two frames, and to another position at a third.
JUMPING: dict[str, Any] = {
    "at": [[0, 0.4, 0.5], [0.2, 0.6, 0.5], [0.2, 0.3, 0.5]],
    "load": [[0, 0], [0.08, 50], [0.08, 100], [0.17, 100], [0.17, 0], [0.2, 0], [0.3, 80]],
    "falloff": 40,
    "force": [1, 0, -3],
    "offset": 0,
}


def test_load_force_at_each_frame(device: Device) -> None:
    made = scene(probes=[JUMPING])
    rate = made.time.frames_per_second
    percents = {0: 0, 1: 25, 2: 100, 3: 100, 4: 100, 5: 0, 6: 80 * 0.4, 7: 80 * 0.8, 8: 80}
    rest, free = rest_positions(made.sheet), ~plan_of(made).fixed
    with Simulation(made, threads=device.threads) as simulation:
        for frame, percent in percents.items():
            (felt,) = simulation.forces()
            at = control_point(made.probes[0], made.sheet, frame / rate)
            distance = np.hypot(*(rest[..., :2] - at).T).T
            total = np.exp(-40 * distance)[free].sum() * percent / 100
            np.testing.assert_allclose(felt.force, np.array([1, 0, -3]) * total, rtol=1e-13, atol=0)
            assert felt.tip == tuple(surface_point(simulation.positions(), made.render.refine, made.sheet, at)[0])
            assert felt.tip[2] < 0 or frame == 0
            simulation.advance()


def test_forces_of_a_restored_simulation(device: Device, message: Messages) -> None:
    made = touching([PRESSED, {"total": [0, 0, -1], "at": [0.2, 0.2], "load": [[0, 0], [0.2, 100], [0.4, 0]]}])
    with Simulation(made, threads=device.threads) as simulation:
        first = simulation.forces()
        simulation.advance(6)
        saved, felt = simulation.save(), simulation.forces()
        simulation.advance(4)
        end = simulation.felt
        assert end.forces[0] != felt[0]
        simulation.restore(saved)
        assert simulation.forces() == felt
        simulation.advance(4)
        assert simulation.felt == end
        simulation.restart()
        assert simulation.forces() == first
        simulation.advance(10)
        assert simulation.felt == end
        with message.raises(ArgumentError, "probes"):
            simulation.restore(saved._replace(probe_forces=saved.probe_forces._replace(forces=())))


def table_of(directory: Path) -> list[list[str]]:
    with (directory / "forces.csv").open(newline="") as file:
        return list(csv.reader(file))


def test_table_of_forces(device: Device, tmp_path: Path) -> None:
    """The table has the bits of the simulation, and run.json the greatest force of every probe."""
    load = {"total": [0.1, 0, -1], "load": [[0, 0], [0.2, 100], [0.4, 0]], "at": [0.2, 0.3]}
    made = touching([load, *CASES["rubbed"]], output=["forces"])
    expected = []
    with Simulation(made, threads=device.threads) as simulation:
        for frame in range(11):
            expected += [[frame / 25, tip.probe, *tip.tip, *tip.force] for tip in simulation.forces()]
            simulation.advance(int(frame < 10))
    record = run(made, tmp_path / "out", threads=device.threads)
    assert record["outputs"] == ["forces.csv", "run.json"]
    header, *rows = table_of(tmp_path / "out")
    assert header == ["time", "probe", "tip_x", "tip_y", "tip_z", "force_x", "force_y", "force_z"]
    assert [list(map(float, row)) for row in rows] == expected
    for index, probe in enumerate(record["probes"]):
        greatest, row = max((math.hypot(*row[5:]), row) for row in expected if row[1] == index)
        assert probe["greatest_force"] == greatest
        assert [probe["greatest_force_time"], *probe["greatest_force_vector"]] == [row[0], *row[5:]]
    summary = run_summary(record, tmp_path)
    assert re.search(r"^probes\.0: [\d.]+ N in all, at most [\d.]+ kPa$", summary, re.MULTILINE)
    assert re.search(r"^probes\.1: at most [\d.]+ N, at 0\.\d+ s$", summary, re.MULTILINE)
    run(scene(probes=[], output=["forces"]), tmp_path / "none", threads=device.threads, estimate_error=False)
    assert len(table_of(tmp_path / "none")) == 1


@pytest.mark.slow
def test_forces_are_independent_of_threads(tmp_path: Path, device: Device) -> None:
    """The run with one thread is in another process."""
    probes = json.dumps([{**PRESSED, "friction": 0.3}])
    (tmp_path / "scene.yaml").write_text(
        "sheet: {points: [41, 61], size: [0.3, 0.4]}\n"
        "tissue: {young: 1.0e3, thickness: 0.01, density: 1000, foundation: 3.0e3, damping: 5}\n"
        f"probes: {probes}\n"
        "time: {duration: 0.2, precision: f32}\n"
        "output: [forces]\n"
    )
    command = [sys.executable, "-m", "taichi_msm", "run", "scene.yaml", "--threads", "1", "--no-estimate", "--quiet"]
    subprocess.run([*command, "--out", "out-1"], cwd=tmp_path, check=True)
    made = load_scene(tmp_path / "scene.yaml")
    record = run(made, tmp_path / "out-2", threads=device.threads, estimate_error=False)
    tables = [(tmp_path / f"out-{threads}" / "forces.csv").read_bytes() for threads in (1, 2)]
    assert tables[0] == tables[1]
    assert record["workers"] == min(2, available_threads()) or device.threads == 1
    assert record["probes"][0]["greatest_force"] > 0.1


def test_forces_before_a_divergence(device: Device) -> None:
    """Forces of the last valid frame, also after a diagnosis from an earlier state."""
    blow = {"total": [0, 0, 1e30], "load": [[0.21, 0], [0.21, 100]]}
    with Simulation(touching([PRESSED, blow]), threads=device.threads) as simulation:
        simulation.advance(3)
        start = simulation.save()
        simulation.advance(2)
        felt = simulation.felt
        with pytest.raises(DivergedError):
            simulation.advance()
        assert simulation.felt == felt
        good = simulation.diagnose(start).last_sound_state
        assert good is not None
        assert good.probe_forces == felt
        assert felt.forces[0].force[2] < -0.1
