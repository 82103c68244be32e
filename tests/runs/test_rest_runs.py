"""Scenes at rest from end to end: runs, their records and errors, and simulations from Python."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
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
from taichi_msm.solver.planned_sheet import choose_layout
from taichi_msm.solver.rest import FORCE_TOLERANCE, build_dynamics
from taichi_msm.study.study import run_study
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.scenes import plan_of
from tests.solver.test_rest import NEVER, PRESSED, PUSH, TISSUE, at_rest

LOADED = {**PUSH, "load": [[0, 50], [2, 100]]}
FRAMES = 4


def loaded(**sections: Any) -> Scene:
    """A load that grows, in some frames, with a tool and a grip besides."""
    tool = {**PRESSED, "path": [[0, 0.3, 0.3, 0.001], [2, 0.3, 0.3, -0.02], [3, 0.4, 0.4, -0.01]], "grip": [[1.5, 3.5]]}
    return at_rest([LOADED, tool], time={"duration": FRAMES}, **sections)


def shapes(simulation: Simulation, frames: int) -> bytes:
    found = []
    for _ in range(frames):
        simulation.advance()
        found.append(simulation.positions().tobytes())
    return b"".join(found)


def test_the_first_frame_is_at_rest_too(device: Device) -> None:
    with Simulation(loaded(), threads=device.threads) as simulation:
        first = simulation.positions().copy()
        assert simulation.frame == simulation.steps == 0
        assert 0 < simulation.progress.max_displacement == pytest.approx(-first[..., 2].min(), rel=0.1)
        assert simulation.progress.evaluations > 10
        assert not simulation.velocities().any()
        simulation.restart()
        assert simulation.positions().tobytes() == first.tobytes()
        assert first.dtype == np.float64


def test_it_goes_on_from_what_was_saved_and_after_an_interruption(device: Device) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with Simulation(loaded(), threads=device.threads) as simulation:
        whole = shapes(simulation, FRAMES)
        evaluations = simulation.progress.evaluations
        simulation.restart()
        begun = shapes(simulation, 2)
        saved = simulation.save()
        rest = shapes(simulation, 2)
        assert begun + rest == whole
        simulation.restore(saved)
        with pytest.raises(KeyboardInterrupt):
            simulation.advance(1, stop)
        assert simulation.frame == 2
        assert shapes(simulation, 2) == rest
        simulation.restart()
        simulation.restore(saved)
        assert shapes(simulation, 2) == rest
        assert simulation.progress.residual <= FORCE_TOLERANCE
    assert evaluations > 100


def test_a_simulation_can_begin_again_in_motion(device: Device) -> None:
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
def test_a_run_tells_how_well_the_forces_balance(device: Device, tmp_path: Path) -> None:
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
    assert record["notes"][0].startswith("error: mesh ")
    assert "time step" in record["notes"][1]
    positions = read_run(tmp_path / "out").positions()
    assert positions.shape == (FRAMES + 1, *made.sheet.points, 3)
    assert (positions[0] - rest_positions(made.sheet))[..., 2].min() < -1e-3, "it begins pressed"


def test_an_interrupted_run_ends_with_the_same_bits(device: Device, tmp_path: Path) -> None:
    made = loaded().model_copy(update={"output": ("trajectory",)})

    def stops_in(frame: int) -> Callable[[str, int, int], None]:
        def progress(stage: str, done: int, _total: int) -> None:
            if stage == "frames" and done == frame:
                raise KeyboardInterrupt

        return progress

    whole = run(made, tmp_path / "whole", threads=device.threads)
    with pytest.raises(KeyboardInterrupt):
        run(made, tmp_path / "first", threads=device.threads, progress=stops_in(0))
    record = run(made, tmp_path / "parts", threads=device.threads, progress=stops_in(2))
    assert (record["status"], record["frames"]) == ("interrupted", 2)
    record = resume(tmp_path / "parts", threads=device.threads)
    assert (record["status"], record["resumed"], record["evaluations"]) == ("complete", 2, whole["evaluations"])
    positions = [np.load(tmp_path / name / "trajectory.npz")["position"].tobytes() for name in ("whole", "parts")]
    assert positions[0] == positions[1]


@pytest.mark.parametrize(("load", "frames"), [([[0, 100]], 0), ([[0, 0], [1, 100]], 1)], ids=["at first", "later"])
def test_what_never_rests_is_a_divergence(
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


def test_the_program_tells_of_rest(small: Path, program: Program, message: Messages) -> None:
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


def test_what_does_not_go_with_rest(small: Path, device: Device, message: Messages) -> None:
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
    # And what is missed only in motion.
    with message.raises(SceneError, "sheet.mass"):
        load_scene("small.yaml", ["sheet.mass="])
    check_scene(at_rest([PUSH]))
    with message.raises(SceneError, "tissue.density"):
        check_scene(at_rest([PUSH], time={"motion": "dynamic"}))


def test_a_pilot_that_never_rests_leaves_the_error_unknown(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverges(*_: Any) -> None:
        raise DivergedError("", 0, 0.0, (0, 0))

    made = at_rest([PUSH])

    def failing(*arguments: Any, **keys: Any) -> Any:
        pilot = build_dynamics(*arguments, **keys)
        monkeypatch.setattr(pilot, "advance", diverges)
        return pilot

    monkeypatch.setattr("taichi_msm.accuracy.mesh.build_dynamics", failing)
    record = run(made, tmp_path / "out", threads=device.threads)
    assert record["error_estimate"] is not None
    assert record["error_estimate"]["mesh_error"] is None
    assert record["notes"][0] == "mesh error not known: the run with fewer points diverged"


UP_AND_DOWN = [[0, 0], [4, 100], [8, 0]]


def drawn_sideways(force: float = 12.0, **tissue: float) -> Scene:
    """Tissue that is drawn along its plane by a wide tool, and let go, in eight frames."""
    soft = {"young": 3e4, "thickness": 2e-3, "foundation": 1e4, "foundation_active": "always", **tissue}
    tool = {"total": [force, 0, 0], "radius": 0.01, "falloff": 200, "load": UP_AND_DOWN}
    return at_rest([tool], sheet={"points": [25, 25], "size": [0.1, 0.1]}, tissue=soft, time={"duration": 8})


def test_an_equilibrium_that_depends_on_the_way_is_noted(device: Device, tmp_path: Path) -> None:
    """Without tension it wrinkles: a frame that is loaded at once, from rest, differs by a tenth and more."""

    def notes(made: Scene, where: str) -> list[str]:
        record = run(made, tmp_path / where, threads=device.threads)
        return [note for note in record["notes"] if note.startswith("path-dependent")]

    (note,) = notes(drawn_sideways(bending=1e-5), "wrinkled")
    assert "loaded at once" in note
    share = re.search(r"(\d+) % of the largest displacement", note)
    assert share is not None
    assert int(share[1]) >= 10
    assert "tissue.pretension, bending or a stiffer foundation" in note
    assert not notes(drawn_sideways(2.0, pretension=20), "taut")
    assert not notes(loaded(), "held")


def test_a_frame_that_jumps_is_noted() -> None:
    """The sheet moves with its load, and at one frame by a tenth of the largest displacement more."""
    plan = plan_of(drawn_sideways())

    def notes(jump: float) -> list[str]:
        path = PathDependence(plan)
        for frame in range(5):
            moved = np.zeros((25, 25, 3))
            moved[12, 12, 0] = 0.01 * frame / 4 + (jump if frame >= 3 else 0)
            path.check_frame(frame, moved)
        return list(path.warnings())

    assert not notes(0)
    # 0.0025 a frame.
    assert not notes(4.9 * 0.0025)
    (note,) = notes(5.1 * 0.0025)
    assert note.startswith("path-dependent at 3 s, frame 3: since the previous frame the sheet jumped by 67 %")


def test_a_second_solution_is_the_first_where_only_one_is_possible(device: Device) -> None:
    made = loaded()
    plan = plan_of(made)
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(1)
        found = simulation.positions() - rest_positions(made.sheet)
    second = second_solution(plan, 1, device, None, lambda: None)
    assert second is not None
    np.testing.assert_allclose(second, found, rtol=0, atol=1e-4 * np.abs(found).max())
    # The tool holds tissue from 1.5 s to 3.5 s.
    assert second_solution(plan, 2, device, None, lambda: None) is None
