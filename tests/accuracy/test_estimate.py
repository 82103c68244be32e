"""Every run says how wrong it is, where that is cheap; and the precision that a scene leaves open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from taichi_msm import load_scene, resume, run
from taichi_msm.accuracy import companions
from taichi_msm.accuracy.companions import NEGLIGIBLE_ERROR, CompanionRuns, choose_companion_runs
from taichi_msm.accuracy.time_step import TimeStepEstimate
from taichi_msm.errors import Pause
from taichi_msm.runs.writer import RunRecord
from taichi_msm.scene.scene import Scene
from taichi_msm.solver import planning
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import affords_companions, choose_precision, with_time
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import notes_of, true_error
from tests.runs.test_resume import Stop
from tests.scenes import PRESS, plan_of, scene

# Of a run in which something moved.
MOVED = RunProgress(1, 1.0)

SHORT = ["output=[trajectory]", "time.duration=0.4"]


def told(record: RunRecord) -> float:
    """The error that a run tells."""
    found: Any = record["error_estimate"]
    return found["error"]


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["time.precision=f32"],
        ["time.damping_difference=backward"],
        ["springs.structural=400", "springs.shear=200", "probes.0.force=[0, 3000, -10000]"],
        ["probes.0.load=[[0, 0], [0.123, 100], [0.123, 0]]"],
    ],
    ids=["plain", "f32", "backward", "stiff", "between"],
)
def test_a_run_says_how_wrong_it_is(overrides: Sequence[str], small: Path, device: Device) -> None:
    made = load_scene("small.yaml", [*SHORT, *overrides])
    record = run(made, "out", threads=device.threads)
    found = told(record)
    error = true_error(plan_of(made), device, fine=16)
    # Outside, 0.89 to 1.5 were found over 98 scenes.
    assert 0.8 * error < found < 1.5 * error
    assert record["notes"][0].startswith("error: time step ")
    assert record["timings"]["pilot"] > 0


def test_an_estimate_can_be_left_out_or_asked_for(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    made = load_scene("small.yaml", SHORT)
    record = run(made, "out", threads=device.threads, estimate_error=False)
    assert (record["error_estimate"], record["error_estimate_reason"]) == (None, "not asked for")
    assert "pilot" not in record["timings"]
    monkeypatch.setattr(companions, "affords_companions", lambda plan, steps: False)
    record = run(made, "out", threads=device.threads)
    assert record["error_estimate"] is None
    message(record["error_estimate_reason"], "two fifths")
    assert record["notes"][0] == f"error not estimated: {record['error_estimate_reason']}"
    record = run(made, "with", threads=device.threads, estimate_error=True)
    assert told(record) < 0.1
    # It does not change the run.
    assert Path("out/trajectory.npz").read_bytes() == Path("with/trajectory.npz").read_bytes()


def test_a_resumed_run_has_the_same_estimate(small: Path, device: Device) -> None:
    made = load_scene("small.yaml", ["output=[png, trajectory]"])
    whole = run(made, "whole", threads=device.threads)
    parts = run(made, "parts", threads=device.threads, progress=Stop(3))
    assert parts["status"] == "interrupted"
    resumed = resume("parts", threads=device.threads)
    assert resumed["status"] == "complete"
    assert resumed["error_estimate"] == whole["error_estimate"]


def test_a_run_that_is_wrong_says_what_helps(message: Messages) -> None:
    def said(error: float, rounding: float, in_f64: float) -> list[str]:
        return notes_of(scene(), MOVED, TimeStepEstimate(10, error, rounding, in_f64, 2))

    assert len(said(0.009, 0.0, 0.009)) == 1
    (_, step) = said(0.04, 0.0, 0.04)
    message(step, "time.step: ")
    # 24 steps a frame make a quarter of the error, and a third as many again half of that.
    tried = plan_of(with_time(scene(), step=float(step.rpartition(" ")[2]))).grid
    assert tried.steps_per_frame == math.ceil(plan_of(scene()).grid.steps_per_frame * 8**0.5)
    message(said(0.03, 0.03, 1e-4), "rounding 3 %", "time.precision: f64")


def test_a_small_run_is_in_f64_and_a_large_one_in_f32() -> None:
    def made(points: int, **keys: Any) -> Scene:
        time = {"duration": 30 / 25, "precision": "auto"}
        return scene(sheet={"points": [points, points], "size": [0.3, 0.3], "mass": 1e-3}, time=time, **keys)

    def precision(scene: Scene, arch: str = "cpu") -> str:
        return choose_precision(plan_of(scene), arch).grid.precision

    assert precision(made(61)) == "f64"
    assert precision(made(61), "cuda") == "f32"
    assert precision(made(1024)) == "f32"
    assert precision(with_time(made(61), precision="f32")) == "f32"
    assert precision(with_time(made(1024), tolerance=1e-3)) == "f64"
    # Pictures make stepping a smaller part.
    edge = next(n for n in range(61, 1024) if precision(made(n)) == "f32")
    assert precision(made(edge, image="a.png", output=["png"])) == "f64"
    # The work is counted, and not timed.
    work = planning.F64_WORK * 30 * plan_of(made(edge)).grid.steps_per_frame * edge**2
    assert work > planning.MAX_F64_SHARE * planning.START_WORK >= work * (1 - 3 / edge)


def test_pilots_are_taken_while_they_are_two_fifths_of_the_run() -> None:
    small = scene(probes=[PRESS], time={"precision": "auto"})
    assert affords_companions(plan_of(small), 2)
    time = {"precision": "auto", "duration": 40.0}
    large = scene(sheet={"points": [2000, 2000], "size": [0.3, 0.3], "mass": 1e-3}, time=time)
    single, double = plan_of(large), plan_of(large).with_grid(precision="f64")
    assert single.grid.precision == "f32"
    # Of a run that is nearly all stepping, two thirds of the run's own steps are two fifths of the whole.
    assert [affords_companions(double, steps) for steps in (0.66, 0.67)] == [True, False]
    assert [affords_companions(single, steps) for steps in (0.33, 0.34)] == [True, False]
    steps = math.ceil(double.grid.steps_per_frame / 2)
    assert choose_companion_runs(double) == CompanionRuns(steps, 0, False, steps / double.grid.steps_per_frame)
    assert choose_companion_runs(single).reason


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Steps of points that sheets take, pilots and the run itself."""
    found: list[int] = []
    advance = Dynamics.advance

    def noted(self: Dynamics, steps: int, pause: Pause = lambda: None) -> None:
        found.append(steps * math.prod(self.plan.scene.sheet.points))
        advance(self, steps, pause)

    monkeypatch.setattr(Dynamics, "advance", noted)
    return found


@pytest.mark.parametrize(("name", "most"), [("press", 0.75), ("figure-3", 0.6)])
def test_pilots_are_cheap(name: str, most: float, root: Path, tmp_path: Path, device: Device, taken: list[int]) -> None:
    made = load_scene(root / f"scenes/{name}.yaml", ["output=[]", "time.duration=0.2"])
    record: Any = run(made, tmp_path / "out", threads=device.threads)
    assert record["precision"] == "f64"
    assert told(record) < NEGLIGIBLE_ERROR
    own = record["steps"] * math.prod(made.sheet.points)
    assert 0.5 * own <= sum(taken) - own <= most * own


# Of which a coarse pilot shows an error of 3e-3.
WRONG = [*SHORT, "probes.0.force=[0, 3000, -10000]"]


@pytest.mark.parametrize("output", ["[trajectory]", "[]"])
def test_a_finer_pilot_follows_an_error_that_matters(
    output: str, small: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = load_scene("small.yaml", [*WRONG, f"output={output}"])
    record = run(made, "out", threads=device.threads)
    error = true_error(plan_of(made), device, fine=16)
    # Twice the next power of h, as in tests/accuracy/test_accuracy.py.
    assert told(record) == pytest.approx(error, rel=1 / 12)
    monkeypatch.setattr(companions, "affords_companions", lambda plan, steps: steps < 1)
    record = run(made, "out", threads=device.threads)
    found: Any = record["error_estimate"]
    assert found["at_least"]
    assert told(record) == pytest.approx(error, rel=0.5)
    assert record["notes"][0].startswith("error: time step at least ")


def test_ctrl_c_in_the_finer_pilot_leaves_a_complete_run(small: Path, device: Device) -> None:
    asked: list[str] = []

    def stop(stage: str, done: int, total: int) -> None:
        """Stop in the finer pilot; as after a signal, whatever is interruptible is interrupted from then on."""
        asked.extend([stage] if stage == "pilot" else [])
        if asked and stage != "write":
            raise KeyboardInterrupt

    made = load_scene("small.yaml", [*WRONG, "output=[]"])
    record = run(made, "out", threads=device.threads, progress=stop)
    assert (asked, record["status"], record["frames"]) == (["pilot"], "complete", 5)
    found: Any = record["error_estimate"]
    assert found["at_least"]


def test_beside_f32_a_coarse_pilot_of_order_1_tells_a_bound(small: Path, device: Device) -> None:
    step = ["time.frames_per_second=50", "time.step=0.004", "time.damping_difference=backward", "time.precision=f32"]
    soft = ["springs.structural=8", "springs.shear=4", "output=[trajectory]"]
    made = load_scene("small.yaml", [*step, *soft, "probes.0.load=[[0, 0], [0.4, 100]]"])
    assert choose_companion_runs(plan_of(made)).concurrent_steps == 3
    record = run(made, "out", threads=device.threads)
    error = true_error(plan_of(made), device, fine=16)
    assert error < told(record) < 4 * error


def test_beside_f32_a_coarse_pilot_tells_a_bound(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, taken: list[int]
) -> None:
    monkeypatch.setattr(companions, "affords_companions", lambda plan, steps: steps < 1)
    made = load_scene("small.yaml", [*WRONG, "time.precision=f32"])
    record: Any = run(made, "out", threads=device.threads)
    steps = math.prod(made.sheet.points) * record["steps"]
    assert sum(taken) <= 1.6 * steps
    error = true_error(plan_of(made), device, fine=16)
    # Three times the error of the step; and all of rounding, of which there is hardly any here.
    assert told(record) == pytest.approx(3 * error, rel=0.5)
    found: Any = record["error_estimate"]
    assert (found["rounding"], found["in_f64"], found["at_least"]) == (None, None, False)
    assert record["notes"][0].startswith("error: time step and rounding at most about ")


@pytest.mark.parametrize("difference", ["central", "backward"])
def test_a_tolerance_is_met_with_either_difference(difference: str, small: Path, device: Device) -> None:
    made = load_scene("small.yaml", [*SHORT, f"time.damping_difference={difference}", "time.tolerance=2e-3"])
    record: Any = run(made, "out", threads=device.threads)
    assert told(record) <= 2e-3
    assert record["error_estimate"]["order"] == (2 if difference == "central" else 1)
    plan = plan_of(made).with_grid(steps_per_frame=record["steps_per_frame"])
    assert true_error(plan, device, fine=16) <= 3e-3
