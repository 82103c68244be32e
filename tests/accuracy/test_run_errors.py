"""Error estimates of runs by companion runs, the remedies in warnings, and the default precision."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from taichi_msm import load_scene, resume, run
from taichi_msm.accuracy import companions
from taichi_msm.accuracy.companions import (
    NEGLIGIBLE_ERROR,
    QUASISTATIC_REASON,
    CompanionRuns,
    choose_companion_runs,
)
from taichi_msm.accuracy.mesh import LARGE_STEP_ERROR, NARROW_TIP, NOT_CONVERGED, OVERLAP, WRINKLING, MeshEstimate
from taichi_msm.accuracy.run_errors import ForceEstimate, RunErrorEstimates, RunErrorEstimator, run_warnings
from taichi_msm.accuracy.time_step import TimeStepEstimate
from taichi_msm.errors import DeviceError, Pause
from taichi_msm.model.tool_force import probe_records
from taichi_msm.runs.run import _choose_companions
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import affords_companions, choose_precision, with_time
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device
from tests.accuracy.test_time_step import MOVED
from tests.golden import Messages
from tests.motion import notes_of, true_error
from tests.runs.test_resume import Stop
from tests.scenes import PRESS, plan_of, scene
from tests.terms.test_contact import PRESSED, touching

SHORT = ["output=[trajectory]", "time.duration=0.4"]

# A coarse companion run shows an error of 3e-3.
LARGE_ERROR = [*SHORT, "probes.0.force=[0, 3000, -10000]"]


def run_with_error(overrides: Sequence[str], device: Device, **options: Any) -> tuple[Scene, Any, float]:
    """Run small.yaml; return its scene, its record and its estimated error."""
    made = load_scene("small.yaml", overrides)
    record: Any = run(made, "out", threads=device.threads, **options)
    return made, record, (record["error_estimate"] or {"error": math.nan})["error"]


@pytest.mark.parametrize(
    "overrides",
    [
        ["time.precision=f32"],
        ["time.damping_difference=backward"],
        ["springs.structural=400", "springs.shear=200", "probes.0.force=[0, 3000, -10000]"],
        ["probes.0.load=[[0, 0], [0.123, 100], [0.123, 0]]"],
    ],
    ids=["f32", "backward", "stiff", "between"],
)
def test_estimate_of_a_run_against_the_true_error(overrides: Sequence[str], small: Path, device: Device) -> None:
    made, record, estimate = run_with_error([*SHORT, *overrides], device)
    error = true_error(plan_of(made), device, fine=16)
    # The extremes of 98 scenes outside this test were 0.89 and 1.5.
    assert 0.8 * error < estimate < 1.5 * error
    assert record["notes"][0].startswith("estimated error: time step ")
    assert record["timings"]["pilot"] > 0


def test_omitted_and_requested_estimates(
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
    assert record["error_estimate"] is not None
    # The estimate does not change the run.
    assert Path("out/trajectory.npz").read_bytes() == Path("with/trajectory.npz").read_bytes()


def test_missing_estimate_of_a_gpu(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    context: Any = SimpleNamespace(manifest=SimpleNamespace(asks_estimate=None), device=Device("vulkan", 1))
    message(_choose_companions(context, resumed=False).reason, "--estimate-error")
    monkeypatch.setattr("taichi_msm.runs.run.RunErrorEstimator", Mock(side_effect=DeviceError))
    _, record, _ = run_with_error(SHORT, device)
    message(record["notes"], "f64")


@pytest.mark.parametrize("tool", [False, True])
def test_resumed_run_has_the_same_estimate(tool: bool, small: Path, device: Device) -> None:
    """Of displacements, and of the forces of a tool."""
    made = load_scene("small.yaml", ["output=[png, trajectory]"])
    if tool:
        made = touching([PRESSED], tissue={"young": 1e3, "thickness": 0.01, "density": 1000}, output=["trajectory"])
    expected: Any = run(made, "complete", threads=device.threads, estimate_error=True)
    interrupted = run(made, "parts", threads=device.threads, estimate_error=True, progress=Stop(3))
    assert interrupted["status"] == "interrupted"
    resumed = resume("parts", threads=device.threads)
    assert resumed["status"] == "complete"
    assert resumed["error_estimate"] == expected["error_estimate"]
    assert bool(expected["error_estimate"].get("force_error")) == tool


def test_warnings_of_small_errors_and_short_springs(message: Messages) -> None:
    assert not notes_of(scene(), RunProgress(1, 1.0, 0.51), None)
    assert len(notes_of(scene(), MOVED, TimeStepEstimate(10, 0.009, 0.0, 0.009, 2))) == 1
    message(notes_of(scene(), RunProgress(1, 0.0, 0.49), TimeStepEstimate(40, 1e-3, 1e-4, 1e-3, 2)), "error: time step")


def test_warnings_of_missing_and_doubtful_estimates(device: Device, message: Messages) -> None:
    plan = plan_of(touching([PRESSED]))

    def warnings(errors: RunErrorEstimates) -> list[str]:
        return list(run_warnings(plan, probe_records(plan.scene), MOVED, errors))

    rounded = TimeStepEstimate(10, 0.02, 0.02, 0.02, 2, separate=False)
    message(warnings(RunErrorEstimates(rounded, "", MeshEstimate(0.004, WRINKLING), ForceEstimate(0.03))))
    message(warnings(RunErrorEstimates(reason=QUASISTATIC_REASON, mesh=MeshEstimate(0.004, OVERLAP))))
    message(warnings(RunErrorEstimates(mesh=MeshEstimate(0.02, WRINKLING))))
    message(warnings(RunErrorEstimates(reason=QUASISTATIC_REASON)))
    for doubt in (NARROW_TIP, NOT_CONVERGED, LARGE_STEP_ERROR):
        message(warnings(RunErrorEstimates(mesh=MeshEstimate(math.inf, doubt))), "mesh error not known")
    for known in (RunErrorEstimates(), RunErrorEstimates(mesh=MeshEstimate(0.004))):
        estimator = RunErrorEstimator(plan, CompanionRuns(reason="not asked for"), known, device, 1)
        message(warnings(estimator.estimates), "force error not known")


def test_warnings_of_springs_and_damping(message: Messages) -> None:
    message(notes_of(scene(), RunProgress(1, 1.0, longest_spring=2.1), None))
    message(notes_of(scene(damping=1.0, time={"step": 0.04}), MOVED, None))


@pytest.mark.parametrize("error", [0.015, 0.04])
def test_remedies_of_large_errors(error: float, message: Messages) -> None:
    steps = TimeStepEstimate(40, error, 0.0, error, 2)
    for affords in (lambda plan: True, lambda plan: False):
        message(notes_of(scene(), MOVED, None, MeshEstimate(error), affords)[-1], "for a smaller error of the mesh")
        message(notes_of(scene(), MOVED, steps, affords=affords)[1], "for a smaller error of the time step, ")
    rounding = TimeStepEstimate(10, error, error, 1e-4, 2)
    message(notes_of(scene(), MOVED, rounding)[1], "time.precision: f64")


def test_default_precision() -> None:
    def made(points: int, **keys: Any) -> Scene:
        time = {"duration": 30 / 25, "precision": "auto"}
        return scene(sheet={"points": [points, points], "size": [0.3, 0.3], "mass": 1e-3}, time=time, **keys)

    def precision(scene: Scene, arch: str = "cpu") -> str:
        return choose_precision(plan_of(scene), arch).grid.precision

    assert precision(made(61)) == "f64"
    assert precision(made(61), "cuda") == "f32"
    assert precision(made(1024)) == "f32"
    assert precision(with_time(made(61), precision="f32")) == "f32"
    # A tolerance is met in f64 on a CPU, whatever the work.
    tolerated = with_time(made(1024), tolerance=1e-3)
    assert (precision(tolerated), precision(tolerated, "cuda")) == ("f64", "f32")
    # Pictures make stepping a smaller part of the work.
    edge = next(n for n in range(61, 1024) if precision(made(n)) == "f32")
    assert precision(made(edge, image="a.png", output=["png"])) == "f64"


def test_companion_runs_take_up_to_two_fifths_of_the_run() -> None:
    assert affords_companions(plan_of(scene(probes=[PRESS], time={"precision": "auto"})), 2)
    time = {"precision": "auto", "duration": 40.0}
    single = plan_of(scene(sheet={"points": [2000, 2000], "size": [0.3, 0.3], "mass": 1e-3}, time=time))
    double = single.with_grid(precision="f64")
    assert single.grid.precision == "f32"
    # If a run is nearly all stepping, two thirds of the run's own steps are two fifths of the total.
    assert [affords_companions(double, steps) for steps in (0.66, 0.67)] == [True, False]
    assert [affords_companions(single, steps) for steps in (0.33, 0.34)] == [True, False]
    steps = math.ceil(double.grid.steps_per_frame / 2)
    assert choose_companion_runs(double) == CompanionRuns(steps, 0, False, steps / double.grid.steps_per_frame)
    assert choose_companion_runs(single).reason


@pytest.fixture
def node_steps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Steps times mass points of every call of `Dynamics.advance`, of the run and its companions."""
    counted: list[int] = []
    advance = Dynamics.advance

    def count(self: Dynamics, steps: int, pause: Pause = lambda: None) -> None:
        counted.append(steps * math.prod(self.plan.scene.sheet.points))
        advance(self, steps, pause)

    monkeypatch.setattr(Dynamics, "advance", count)
    return counted


@pytest.mark.parametrize(("name", "most"), [("press", 0.75), ("figure-3", 0.6)])
def test_cost_of_companion_runs(
    name: str, most: float, root: Path, tmp_path: Path, device: Device, node_steps: list[int]
) -> None:
    made = load_scene(root / f"scenes/{name}.yaml", ["output=[]", "time.duration=0.2"])
    record: Any = run(made, tmp_path / "out", threads=device.threads)
    assert record["precision"] == "f64"
    assert record["error_estimate"]["error"] < NEGLIGIBLE_ERROR
    run_cost = record["steps"] * math.prod(made.sheet.points)
    assert 0.5 * run_cost <= sum(node_steps) - run_cost <= most * run_cost


@pytest.mark.parametrize("output", ["[trajectory]", "[]"])
def test_fine_companion_follows_a_large_error(
    output: str, small: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides = [*LARGE_ERROR, f"output={output}"]
    made, _, estimate = run_with_error(overrides, device)
    error = true_error(plan_of(made), device, fine=16)
    # Twice the next power of h, as in tests/accuracy/test_time_step.py.
    assert estimate == pytest.approx(error, rel=1 / 12)
    monkeypatch.setattr(companions, "affords_companions", lambda plan, steps: steps < 1)
    _, record, estimate = run_with_error(overrides, device)
    assert record["error_estimate"]["at_least"]
    assert estimate == pytest.approx(error, rel=0.5)
    assert record["notes"][0].startswith("estimated error: time step at least ")


def test_interrupted_fine_companion_leaves_a_complete_run(small: Path, device: Device) -> None:
    stages: list[str] = []

    def stop(stage: str, done: int, total: int) -> None:
        """Interrupt the fine companion run, and after it everything but writing, as after a signal."""
        stages.extend([stage] if stage == "pilot" else [])
        if stages and stage != "write":
            raise KeyboardInterrupt

    _, record, _ = run_with_error([*LARGE_ERROR, "output=[]"], device, progress=stop)
    assert (stages, record["status"], record["frames"]) == (["pilot"], "complete", 5)
    assert record["error_estimate"]["at_least"]


def test_bounds_by_a_coarse_companion_in_f32(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, node_steps: list[int]
) -> None:
    step = ["time.frames_per_second=50", "time.step=0.004", "time.damping_difference=backward", "time.precision=f32"]
    soft = ["springs.structural=8", "springs.shear=4", "output=[trajectory]", "probes.0.load=[[0, 0], [0.4, 100]]"]
    made, _, estimate = run_with_error([*step, *soft], device)
    assert choose_companion_runs(plan_of(made)).concurrent_steps == 3
    assert 1 < estimate / true_error(plan_of(made), device, fine=16) < 4
    # At order 2, it is three times the error of the step, plus all of the rounding, which is small here.
    monkeypatch.setattr(companions, "affords_companions", lambda plan, steps: steps < 1)
    node_steps.clear()
    made, record, estimate = run_with_error([*LARGE_ERROR, "time.precision=f32"], device)
    assert sum(node_steps) <= 1.6 * math.prod(made.sheet.points) * record["steps"]
    assert estimate == pytest.approx(3 * true_error(plan_of(made), device, fine=16), rel=0.5)
    parts = record["error_estimate"]
    assert (parts["rounding"], parts["in_f64"], parts["at_least"]) == (None, None, False)
    assert record["notes"][0].startswith("estimated error: time step and rounding at most about ")


@pytest.mark.parametrize("difference", ["central", "backward"])
def test_tolerance_is_met_with_either_difference(difference: str, small: Path, device: Device) -> None:
    overrides = [*SHORT, f"time.damping_difference={difference}", "time.tolerance=2e-3"]
    made, record, estimate = run_with_error(overrides, device)
    assert estimate <= 2e-3
    assert record["error_estimate"]["order"] == (2 if difference == "central" else 1)
    plan = plan_of(made).with_grid(steps_per_frame=record["steps_per_frame"])
    assert true_error(plan, device, fine=16) <= 3e-3
