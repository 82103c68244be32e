"""Error estimates of runs with contact, against the error itself (docs/decisions/0027)."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from taichi_msm.accuracy import time_step
from taichi_msm.accuracy.companions import choose_companion_runs
from taichi_msm.accuracy.mesh import (
    OVERLAP,
    MeshEstimate,
    choose_points,
    estimate_mesh_error,
    mesh_companion_plan,
    with_points,
)
from taichi_msm.accuracy.run_errors import ForceEstimate, RunErrorEstimates, RunErrorEstimator
from taichi_msm.accuracy.time_step import TimeStepEstimate, choose_step, combine_estimates, max_norm
from taichi_msm.errors import SceneError
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import overlap, path_warnings
from taichi_msm.runs.run import run
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import plan_variant
from taichi_msm.system.runtime import Device
from tests.accuracy.test_time_step import MOVED, PowerLaw
from tests.golden import Messages
from tests.motion import estimate_error, frames_on, notes_of, true_error
from tests.scenes import plan_of, random_contact
from tests.terms.test_contact import HELD, PRESSED, RUBBED, moved, touching

# Seeds of random scenes; one is run by default.
SEEDS = [pytest.param(seed, marks=[] if seed == 18 else pytest.mark.slow) for seed in range(30)]


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("map") / "map.png"
    grey = (255 * np.random.default_rng(1).random((5, 5))).astype(np.uint8)
    Image.fromarray(grey).resize((64, 64), Image.Resampling.BICUBIC).save(path)
    return str(path)


def estimates_of(plan: Plan, device: Device) -> Any:
    """The estimated errors of a run, with all companion runs."""
    companions = choose_companion_runs(plan, requested=True)
    estimator = RunErrorEstimator(plan, companions, RunErrorEstimates(), device, device.threads)
    dynamics, displacements = Dynamics(plan, device), []
    for _ in range(plan.grid.frames):
        dynamics.advance(plan.grid.steps_per_frame)
        displacements.append(dynamics.displacement())
        estimator.compare_frame(displacements[-1], lambda: None, dynamics.tool_forces())
    estimator.finish(iter(displacements), lambda done, total: None)
    return estimator.estimates


def true_mesh_error(plan: Plan, device: Device, refinement: int, steps: int = 1) -> float:
    """Error of the mesh by a run in f64 with finer cells; `steps` refines the steps of the run itself."""
    points = [refinement * (count - 1) + 1 for count in plan.scene.sheet.points]
    finer = plan_variant(plan, with_points(plan.scene, (points[0], points[1]))).with_grid(precision="f64")
    reference = frames_on(finer, device)[:, ::refinement, ::refinement]
    displacement = frames_on(plan.with_grid(steps_per_frame=steps * plan.grid.steps_per_frame), device)
    return max_norm(displacement - reference) / max_norm(reference)


@pytest.mark.parametrize("seed", SEEDS)
def test_time_step_estimate_bounds_the_error(seed: int, image: str, device: Device) -> None:
    plan = plan_of(random_contact(seed, image))
    # Half of an odd number of steps is rounded up.
    assert choose_companion_runs(plan).cost <= 0.75 + 1 / plan.grid.steps_per_frame
    estimate = estimates_of(plan, device).time_step
    assert estimate.at_most
    error = true_error(plan, device, fine=16)
    assert error <= 1.5 * estimate.error or estimate.at_least
    assert estimate.error <= 8 * error


@pytest.mark.parametrize("seed", SEEDS)
def test_mesh_estimate_bounds_the_error(seed: int, image: str, device: Device) -> None:
    plan = plan_of(random_contact(seed, image, cells=4))
    if plan.scene.tissue is None:
        pytest.skip("the mesh error of springs is undefined")
    mesh = estimates_of(plan, device).mesh
    assert mesh.at_most or mesh.error == math.inf
    error = true_mesh_error(plan.with_grid(precision="f64"), device, refinement=4, steps=8)
    assert error <= (2 if mesh.doubt else 1.5) * mesh.error


TISSUE = {"young": 3e4, "thickness": 2e-3, "density": 1050, "foundation": 1.3e5, "damping": 200, "pretension": 40}


def pierced(path: list[list[float]], rod: dict[str, Any], time: dict[str, Any], **sections: Any) -> Scene:
    """A rod that is pressed into a sheet with fixed sides."""
    made = {
        "sheet": {"points": [31, 31], "size": [0.1, 0.1], **sections.get("sheet", {})},
        "tissue": {**TISSUE, "foundation_active": "always", **sections.get("tissue", {})},
        "probes": [{"path": path, "instrument": {"length": 0.15, **rod}, "friction": sections.get("friction", 0.0)}],
        "time": {"precision": "f64", **time},
        "output": sections.get("output", []),
    }
    return Scene.model_validate(made)


@pytest.mark.slow
def test_displacement_and_force_estimates_of_a_drag(device: Device) -> None:
    """The estimates are 0.67 to 4 times the errors of displacements and forces, relative to the largest."""
    path = [[0, 0.54, 0.35, 0.001], [0.15, 0.54, 0.35, -0.01], [0.48, 0.48, 0.37, -0.01], [0.54, 0.48, 0.37, 0.012]]
    rod = {"radius": 0.008, "shaft": [0.2, 0.7, 1.2]}
    time = {"duration": 0.56, "frames_per_second": 25}
    plan = plan_of(pierced(path, rod, time, friction=0.3, tissue={"young": 4.5e4}))
    estimates = estimates_of(plan, device)
    finer = plan_variant(plan, with_points(plan.scene, (61, 61))).with_grid(
        steps_per_frame=2 * plan.grid.steps_per_frame
    )
    sheets = Dynamics(plan, device), Dynamics(finer, device)
    error = largest = force_error = largest_force = 0.0
    for _ in range(plan.grid.frames):
        for sheet in sheets:
            sheet.advance(sheet.plan.grid.steps_per_frame)
        displacement, reference = sheets[0].displacement(), sheets[1].displacement()[::2, ::2]
        force, reference_force = (sheet.tool_forces() for sheet in sheets)
        error, largest = max(error, max_norm(displacement - reference)), max(largest, max_norm(reference))
        force_error = max(force_error, max_norm(force - reference_force))
        largest_force = max(largest_force, max_norm(reference_force))
    assert 0.67 <= estimates.mesh.error / (error / largest) <= 4
    assert 0.67 <= estimates.force.error / (force_error / largest_force) <= 4


def small_sheet(radius: float = 0.006, place: float = 0.4583) -> Scene:
    """A rod that is pressed into a sheet of 13 x 13 points."""
    soft = {"young": 2e4, "density": 1000, "foundation": 2e5, "damping": 400, "pretension": 10}
    path, sheet = [[0, place, place, 0.002], [0.4, place, place, -0.002]], {"points": [13, 13], "size": [0.06, 0.06]}
    rod, time = {"radius": radius, "shaft": [0, 0, 1], "length": 0.1}, {"duration": 0.4, "frames_per_second": 10}
    return pierced(path, rod, {**time, "precision": "auto"}, sheet=sheet, tissue=soft, output=["forces"])


@pytest.mark.default_cases("pressed")
@pytest.mark.parametrize("case", [[PRESSED], [RUBBED], [HELD]], ids=["pressed", "rubbed", "held"])
def test_chosen_step_meets_the_tolerance(case: list[dict[str, Any]], device: Device) -> None:
    plan, estimate = choose_step(plan_of(touching(case, time={"tolerance": 0.03})), device)
    assert estimate.error <= 0.03
    assert true_error(plan, device, fine=8) <= 0.03


def test_order_1_and_margin_of_a_fine_companion(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    assert plan_of(touching([])).convergence_order == 2
    plan = plan_of(touching([PRESSED], time={"step": 0.005}))
    assert plan.convergence_order == 1
    monkeypatch.setattr(time_step, "Dynamics", partial(PowerLaw, 1))
    assert estimate_error(plan, device).error == pytest.approx(1.25 * 1.5 * 0.005 / (1 + 0.005 / 2), rel=1e-9)


def test_combination_of_coarse_and_fine_estimates() -> None:
    def of(error: float, *, at_most: bool = True) -> TimeStepEstimate:
        return TimeStepEstimate(10, error, 0.0, error, 1, at_most=at_most)

    # The coarse estimate changes the fine one by at most a third.
    for coarse, share, at_least in [
        (0.01, 2 / 3, True),
        (0.9, 0.9, False),
        (math.inf, 4 / 3, False),
        (0.34, 2 / 3, False),
        (0.33, 2 / 3, True),
    ]:
        combined = combine_estimates(of(coarse), of(1.0))
        assert [combined.error, combined.in_f64] == pytest.approx([share, share])
        assert combined.at_least == at_least
    assert combine_estimates(of(0.9), of(1.0, at_most=False)) == of(1.0, at_most=False)
    assert [combine_estimates(of(0.9), of(error)).error for error in (0.0, math.inf)] == [0, math.inf]


def test_warnings_of_bounds_and_of_a_narrow_tool(message: Messages) -> None:
    made = touching([PRESSED])
    for at_least in (False, True):
        estimate = TimeStepEstimate(10, 0.04, 0.0, 0.04, 1, at_least=at_least, at_most=True)
        notes = notes_of(made, MOVED, estimate)
        message(notes, "error: time step ")
        # At order 1 the remedy is eight times as many steps.
        assert notes[1].endswith(f"time.step: {0.04 / (8 * plan_of(made).grid.steps_per_frame):.9g}")
    # A mesh that is too coarse for the tool has a single remedy.
    for radius in (0.05, 0.01):
        made = touching([{**PRESSED, "instrument": {**PRESSED["instrument"], "radius": radius}}])
        message(notes_of(made, MOVED, None, mesh=MeshEstimate(0.3, at_most=True)))


@pytest.mark.slow
def test_overlap_of_random_capsules() -> None:
    """Axes of random directions, some parallel, some nearly of length 0, against their distance by sampling."""
    rng, shares = np.random.default_rng(5), np.linspace(0, 1, 400)[:, None]
    for _ in range(60):
        tips, axes = rng.uniform(-0.2, 0.2, (2, 3)), rng.uniform(-1, 1, (2, 3))
        axes[rng.random(2) < 0.3] = [0.0, 0.0, 1.0]
        axes *= (rng.choice([1e-3, 0.1, 0.3], 2) / np.linalg.norm(axes, axis=1))[:, None]
        a, b = (tip + shares * axis for tip, axis in zip(tips, axes, strict=True))
        distance = np.linalg.norm(a[:, None] - b, axis=-1).min()
        for radius, expected in ((0.97 * distance / 2, None), (1.03 * distance / 2, (0, 1, 0.0))):
            probes = []
            for (x, y, z), axis in zip(tips, axes, strict=True):
                rod = {"radius": radius, "shaft": axis.tolist(), "length": np.linalg.norm(axis)}
                probes.append(moved([0, 0.5 + x / 0.4, 0.5 - y / 0.3, z - radius], instrument=rod))
            assert overlap(plan_of(touching(probes)).tools, 0.4) == expected, probes


def test_mesh_error_of_overlapping_tools_is_unknown(device: Device, message: Messages) -> None:
    meets = moved([0, 0.8, 0.5, 0.01], [0.2, 0.55, 0.5, -0.02])
    plan = plan_of(touching([PRESSED, meets], time={"duration": 0.2}))
    notes = [note for note in path_warnings(plan.scene, plan.tools) if "through each other" in note]
    message(notes, "probes.0 and probes.1: ")
    estimates = estimates_of(plan, device)
    assert estimates.time_step.at_least
    assert estimates.mesh == MeshEstimate(math.inf, OVERLAP)
    assert estimates.force == ForceEstimate(None, OVERLAP)
    searched = plan_variant(plan, plan.scene.model_copy(update={"sheet": {**dict(plan.scene.sheet), "tolerance": 0.1}}))
    with message.raises(SceneError, "sheet.tolerance"):
        choose_points(searched, device, lambda made, _: plan_of(made))


def test_mesh_companion_is_compared_with_the_run(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without contact it is compared with the coarse time-step companion, which may have other contacts."""
    plan = plan_of(touching([PRESSED]))
    estimator = RunErrorEstimator(
        plan, choose_companion_runs(plan, requested=True), RunErrorEstimates(), device, device.threads
    )
    mesh: Any = estimator._mesh
    compared = Mock()
    monkeypatch.setattr(mesh, "compare_frame", compared)
    displacement = np.zeros((*plan.scene.sheet.points, 3))
    estimator.compare_frame(displacement, lambda: None, np.zeros((1, 3)))
    assert compared.call_args.args[0] is displacement
    assert mesh._solvers[0].plan.grid.steps_per_frame == math.ceil(plan.grid.steps_per_frame / 2)
    coarse = mesh_companion_plan(plan_of(with_points(small_sheet(), (25, 25))))
    assert coarse is not None
    assert coarse.scene.sheet.points == (18, 18), "24 / sqrt(2) is 16.97 cells"


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.003, 0.0045])
def test_second_mesh_companion_of_a_narrow_tip(radius: float, device: Device) -> None:
    """The first companion differs by 50 or 80 %, and the error is a tenth of that."""
    wall = {"thickness": 3e-3, "foundation": 3e5, "damping": 2000, "pretension": 25}
    path, rod = [[0, 0.5, 0.5, 0.0005], [0.5, 0.5, 0.5, -0.003]], {"radius": radius, "shaft": [0.5, 0.9, 0.8]}
    plan = plan_of(pierced(path, rod, {"duration": 0.6, "frames_per_second": 10}, tissue=wall))
    mesh = estimates_of(plan, device).mesh
    assert 0.67 <= mesh.error / true_mesh_error(plan, device, refinement=3) <= 4
    assert estimate_mesh_error(plan, device, lambda done, total: None).error == pytest.approx(mesh.error)


@pytest.mark.slow
def test_second_mesh_companion_with_stable_steps(device: Device) -> None:
    """With twice the step, the tissue slips off the tip on coarser meshes: by 1.5 times the largest displacement."""
    soft = {"young": 1.2e4, "thickness": 2.1e-3, "foundation": 7.6e5, "pretension": 3.35}
    path = [[0, 0.53, 0.57, 0.0009], [0.4, 0.53, 0.57, -0.0089]]
    rod, sheet = {"radius": 0.00944, "shaft": [-0.39, -0.39, 1]}, {"points": [24, 26], "size": [0.1, 0.1087]}
    plan = plan_of(pierced(path, rod, {"duration": 0.6, "frames_per_second": 10}, sheet=sheet, tissue=soft))
    assert 0.67 <= estimates_of(plan, device).mesh.error / true_mesh_error(plan, device, refinement=3) <= 4


def test_force_error_of_a_grip(device: Device) -> None:
    """Forces that agree by chance: 0.4 of the mesh error, in a grip at most 0.15 cells over the radius."""
    made, expected = small_sheet(), {(): 0.2, ((0.2, 0.4),): 0.15 * 0.005 / 0.006}
    for grip, error in expected.items():
        held = made.model_copy(update={"probes": [made.probes[0].model_copy(update={"grip": grip})]})
        plan = plan_of(held)
        companions = choose_companion_runs(plan, requested=True)
        estimator = RunErrorEstimator(plan, companions, RunErrorEstimates(), device, 1)
        estimator._max_force[:] = 1.0
        force = estimator._force_estimate(RunErrorEstimates(mesh=MeshEstimate(0.5, at_most=True)))
        assert force.error == pytest.approx(error)


def test_tool_clear_of_the_sheet_leaves_the_errors_known(device: Device) -> None:
    """A thin rod that passes 10 mm above the sheet touches no mass point, on any mesh."""
    made = small_sheet()
    rod = {"radius": 0.0005, "shaft": [0, 0, 1], "length": 0.1}
    idle = moved([0, 0.2, 0.2, 0.01], [0.4, 0.2, 0.8, 0.01], instrument=rod)
    both = made.model_copy(update={"probes": [made.probes[0], idle]})
    alone, together = (estimates_of(plan_of(each), device) for each in (made, both))
    assert alone.mesh.error < math.inf
    assert (together.mesh, together.force) == (alone.mesh, alone.force)


@pytest.mark.parametrize(
    ("step_error", "first", "second", "expected"),
    [
        (0.1, 0.2, None, 0.24),
        (0.1, 0.35, None, 0.42),
        (0.1, 0.9, 0.4, 0.48),
        (0.1, 1.1, 0.1, 0.8 * 0.08**0.5),
        (0.1, math.inf, 0.1, 0.8 * 0.08**0.5),
        (0.1, 0.9, 1.1, None),
        (0.1, 0.9, math.nan, None),
        (0.1, 0.9, None, None),
        (1.5, 0.2, None, None),
    ],
)
def test_estimates_by_the_differences_of_mesh_companions(
    step_error: float, first: float, second: float | None, expected: float | None, device: Device
) -> None:
    """A second companion follows a difference above 0.3, which counts as at most 8 times that of the second one. Above
    0.4 without it, above 1 with it, or with step_error above 1, the error is unknown."""
    plan = plan_of(small_sheet())
    known = RunErrorEstimates(TimeStepEstimate(10, step_error, 0.0, step_error, 1, at_most=True))
    estimator = RunErrorEstimator(plan, choose_companion_runs(plan, requested=True), known, device, 1)
    mesh: Any = estimator._mesh
    displacement = np.zeros((*plan.scene.sheet.points, 3))
    displacement[6, 6, 2] = 1.0
    estimator.compare_frame(displacement, lambda: None, np.ones((1, 3)))
    mesh._differences = [first]
    second_run = mesh.build_second_run(plan, device, 1)
    assert (second_run is None) == (first < 0.3)
    if second is None:
        mesh._second_run = None
    else:
        second_run._largest, second_run._differences = 1.0, [second]
    estimates: Any = estimator.estimates
    assert estimates.mesh.error == (pytest.approx(expected) if expected else math.inf)
    force_error = pytest.approx(expected * np.clip(1.15 / expected, 0.5, 1)) if expected else None
    assert estimates.force.error == force_error
    assert bool(estimates.mesh.doubt) == bool(estimates.force.doubt) == (expected is None)


@pytest.mark.parametrize(("radius", "known"), [(0.0005, False), (0.006, True)], ids=["meets no point", "meets points"])
def test_errors_of_a_rod_between_points_are_unknown(
    radius: float, known: bool, device: Device, tmp_path: Path, message: Messages
) -> None:
    record: Any = run(small_sheet(radius), tmp_path / "out", threads=device.threads, estimate_error=True)
    estimate = record["error_estimate"]
    assert (estimate["mesh_error"] is not None, estimate["mesh_doubt"] == "") == (known, known)
    assert (estimate["force_error"] is not None, estimate["force_doubt"] == "") == (known, known)
    message(record["notes"], "force error", hide=r"[\d.]+(?= %| mm)")
