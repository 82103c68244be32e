"""Quasi-static scenes from end to end: runs, records, errors and simulations."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taichi_msm.accuracy.path_dependence import PathDependence, second_solution
from taichi_msm.errors import DeviceError, DivergedError, SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.sheet import rest_positions
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.run import resume, run
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.rest import FORCE_TOLERANCE, build_solver
from taichi_msm.solver.sheet_solver import choose_layout
from taichi_msm.study.study import run_study
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.scenes import plan_of
from tests.solver.test_rest import NEVER, PRESSED, PUSH, TISSUE, at_rest

LOADED = {**PUSH, "load": [[0, 50], [2, 100]]}
FRAMES = 4


def loaded(**sections: Any) -> Scene:
    """A growing load, and a position-controlled tool that grips, in several frames."""
    tool = {**PRESSED, "path": [[0, 0.3, 0.3, 0.001], [2, 0.3, 0.3, -0.02], [3, 0.4, 0.4, -0.01]], "grip": [[1.5, 3.5]]}
    return at_rest([LOADED, tool], time={"duration": FRAMES}, **sections)


def shapes(simulation: Simulation, frames: int) -> bytes:
    positions = []
    for _ in range(frames):
        simulation.advance()
        positions.append(simulation.positions().tobytes())
    return b"".join(positions)


def test_restored_and_interrupted_simulation(device: Device) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with Simulation(loaded(), threads=device.threads) as simulation:
        initial = simulation.positions().copy()
        assert simulation.frame == simulation.steps == 0
        assert 0 < simulation.progress.max_displacement == pytest.approx(-initial[..., 2].min(), rel=0.1)
        assert not simulation.velocities().any()
        whole = shapes(simulation, FRAMES)
        assert simulation.progress.evaluations > 100
        simulation.restart()
        assert simulation.positions().tobytes() == initial.tobytes()
        first = shapes(simulation, 2)
        saved = simulation.save()
        second = shapes(simulation, 2)
        assert first + second == whole
        simulation.restore(saved)
        with pytest.raises(KeyboardInterrupt):
            simulation.advance(1, stop)
        assert simulation.frame == 2
        assert shapes(simulation, 2) == second
        assert simulation.progress.residual <= FORCE_TOLERANCE


def test_first_frame_is_in_equilibrium(device: Device) -> None:
    with Simulation(at_rest([{**PRESSED, "path": [[0, 0.5, 0.5, 0.0]]}, PUSH]), threads=device.threads) as simulation:
        forces = simulation.forces()
        first = simulation.positions().copy()
        assert simulation.frame == simulation.steps == 0
        assert simulation.progress.evaluations > 10
        assert forces[1].force != (0, 0, 0)
        simulation.restart()
        assert simulation.positions().tobytes() == first.tobytes()
        assert simulation.forces() == forces


def test_restart_between_quasi_static_and_dynamic(device: Device) -> None:
    tissue = {**TISSUE, "density": 1000, "damping": 10}
    still, moving = at_rest([PUSH], tissue=tissue), at_rest([PUSH], tissue=tissue, time={"motion": "dynamic"})
    with Simulation(still, threads=device.threads) as simulation:
        shape = simulation.positions()
        simulation.restart(moving)
        assert not simulation.positions()[..., 2].any()
        simulation.advance()
        assert simulation.steps > 10
        simulation.restart(still)
        assert simulation.positions().tobytes() == shape.tobytes()


@pytest.mark.slow
def test_residual_of_a_run(device: Device, tmp_path: Path) -> None:
    made = loaded().model_copy(update={"output": ("trajectory",)})
    record = run(made, tmp_path / "out", threads=device.threads)
    assert record["status"] == "complete"
    assert 0 < record["residual"] <= FORCE_TOLERANCE
    assert record["evaluations"] > 100
    assert {record["step"], record["stable_step"], record["steps_per_frame"], record["steps"]} == {None}
    estimate = record["error_estimate"]
    assert estimate is not None
    assert (estimate["error"], record["error_estimate_reason"]) == (None, "quasistatic")
    assert estimate["mesh_error"]
    assert record["notes"][0].startswith("estimated error: mesh ")
    assert "force error" in record["notes"][1]
    positions = read_run(tmp_path / "out").positions()
    assert positions.shape == (FRAMES + 1, *made.sheet.points, 3)
    assert (positions[0] - rest_positions(made.sheet))[..., 2].min() < -1e-3, "the first frame is deformed"


def test_resumed_run_has_the_same_bits(device: Device, tmp_path: Path) -> None:
    made = loaded().model_copy(update={"output": ("trajectory",)})

    def stop(stage: str, done: int, _total: int) -> None:
        if (stage, done) == ("frames", 2):
            raise KeyboardInterrupt

    whole = run(made, tmp_path / "whole", threads=device.threads)
    record = run(made, tmp_path / "parts", threads=device.threads, progress=stop)
    assert (record["status"], record["frames"]) == ("interrupted", 2)
    record = resume(tmp_path / "parts", threads=device.threads)
    assert (record["status"], record["resumed"], record["evaluations"]) == ("complete", 2, whole["evaluations"])
    positions = [np.load(tmp_path / name / "trajectory.npz")["position"].tobytes() for name in ("whole", "parts")]
    assert positions[0] == positions[1]


@pytest.mark.parametrize(("load", "frames"), [([[0, 100]], 0), ([[0, 0], [1, 100]], 1)], ids=["at first", "later"])
def test_solver_that_does_not_converge(
    load: list[list[float]],
    frames: int,
    device: Device,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    message: Messages,
) -> None:
    monkeypatch.setattr("taichi_msm.solver.rest.MAX_EVALUATIONS", 20)
    made = at_rest([{**PUSH, "load": load}], output=["trajectory"], **NEVER)
    record = run(made, tmp_path / "out", threads=device.threads)
    assert (record["status"], record["frames"]) == ("diverged", frames)
    message(record["error"], "220 evaluations", hide=r"0\.1\d+")
    assert (record["dump"] is None) == (frames == 0)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["frames"] == frames


def test_commands_with_a_quasi_static_scene(small: Path, program: Program, message: Messages) -> None:
    still = ["--set", "time.motion=quasistatic"]
    assert "99 points, 5 frames, each at rest, in f64\n" in program("check", "small.yaml", *still).stdout
    facts = json.loads(program("check", "small.yaml", "--json", *still).stdout)
    assert (facts["step"], facts["stable_step"], facts["steps"], facts["precision"]) == (None, None, None, "f64")
    ran = program("run", "small.yaml", *still)
    assert ran.returncode == 0
    assert re.search(r"5 frames, at rest to .* of the largest force, ", ran.stdout)
    again = program("run", "--again", "output/small", "--out", "again")
    assert again.returncode == 0
    pictures = [small / folder / "frames" / "0001.png" for folder in ("output/small", "again")]
    assert pictures[0].read_bytes() == pictures[1].read_bytes()
    gone = [*still, "--set", "sheet.fixed=none", "--set", "springs.virtual=0"]
    diverged = program("run", "small.yaml", "--out", "gone", "--quiet", *gone)
    assert diverged.returncode == 3
    message(diverged.stderr, "frames in gone: 1", hide=r"\d+ evaluations, \S+|(?<=point )\(\d, \d\)")


def test_invalid_quasi_static_scenes(small: Path, device: Device, message: Messages) -> None:
    load_scene("small.yaml", ["sheet.mass=", "time.motion=quasistatic"])
    for change in ("time.tolerance=1e-3", "time.precision=f32", "time.motion=static"):
        with message.raises(SceneError, change.partition("=")[0]):
            load_scene("small.yaml", ["time.motion=quasistatic", change])
    with message.raises(SceneError, "probes.0.friction"):
        Simulation(at_rest([{**PRESSED, "friction": 0.2}]))
    with message.raises(DeviceError, "--arch vulkan"):
        choose_layout(plan_of(at_rest([PUSH])), Device("vulkan", 1))
    with message.raises(SceneError, "time.motion"):
        run_study(at_rest([PUSH]), "rest", threads=device.threads)
    # Keys that only a dynamic scene requires.
    with message.raises(SceneError, "sheet.mass"):
        load_scene("small.yaml", ["sheet.mass="])
    check_scene(at_rest([PUSH]))
    with message.raises(SceneError, "tissue.density"):
        check_scene(at_rest([PUSH], time={"motion": "dynamic"}))


def test_companion_run_that_does_not_converge(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    def diverges(*_: Any) -> None:
        raise DivergedError("", 0, 0.0, (0, 0))

    made = at_rest([PUSH])

    def failing(*arguments: Any, **keys: Any) -> Any:
        companion = build_solver(*arguments, **keys)
        monkeypatch.setattr(companion, "advance", diverges)
        return companion

    monkeypatch.setattr("taichi_msm.accuracy.mesh.build_solver", failing)
    record = run(made, tmp_path / "out", threads=device.threads)
    assert record["error_estimate"] is not None
    assert record["error_estimate"]["mesh_error"] is None
    message(record["notes"], "mesh error not known")


UP_AND_DOWN = [[0, 0], [4, 100], [8, 0]]


def pulled_sideways(force: float = 12.0, **tissue: float) -> Scene:
    """Tissue that a wide tool pulls along its plane and releases, in eight frames."""
    soft = {"young": 3e4, "thickness": 2e-3, "foundation": 1e4, "foundation_active": "always", **tissue}
    tool = {"total": [force, 0, 0], "radius": 0.01, "falloff": 200, "load": UP_AND_DOWN}
    return at_rest([tool], sheet={"points": [25, 25], "size": [0.1, 0.1]}, tissue=soft, time={"duration": 8})


def test_warning_of_path_dependence(device: Device, tmp_path: Path, message: Messages) -> None:
    """Without pretension it wrinkles: the solution of a frame from rest differs by a tenth or more."""

    def notes(made: Scene, folder: str) -> list[str]:
        record = run(made, tmp_path / folder, threads=device.threads)
        return [note for note in record["notes"] if note.startswith("path-dependent")]

    # 10 % or more of the largest displacement.
    message(
        notes(pulled_sideways(bending=1e-5), "wrinkled"), "tissue.pretension", hide=r"at \d s, frame \d|\b\d\d(?= %)"
    )
    assert not notes(pulled_sideways(2.0, pretension=20), "taut")
    assert not notes(loaded(), "held")


def test_warning_of_a_jump(message: Messages) -> None:
    """The sheet moves in proportion to its load, and jumps at a frame."""
    plan = plan_of(pulled_sideways())

    def notes(jump: float) -> list[str]:
        path = PathDependence(plan)
        for frame in range(5):
            moved = np.zeros((25, 25, 3))
            moved[12, 12, 0] = 0.01 * frame / 4 + (jump if frame >= 3 else 0)
            path.check_frame(frame, moved)
        return list(path.warnings())

    assert not notes(0)
    # 0.0025 m per frame.
    assert not notes(4.9 * 0.0025)
    message(notes(5.1 * 0.0025), "path-dependent at 3 s, frame 3", "67 %")


def test_second_solution_of_a_unique_equilibrium(device: Device) -> None:
    made = loaded()
    plan = plan_of(made)
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(1)
        first = simulation.positions() - rest_positions(made.sheet)
    second = second_solution(plan, 1, device, None, lambda: None)
    assert second is not None
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-4 * np.abs(first).max())
    # The tool holds tissue from 1.5 s to 3.5 s.
    assert second_solution(plan, 2, device, None, lambda: None) is None
