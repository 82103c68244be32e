"""What is told of the error of runs whose tools touch the sheet, against the error itself (docs/decisions/0027)."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.accuracy import time_step
from taichi_msm.accuracy.companions import choose_companion_runs
from taichi_msm.accuracy.mesh import MeshEstimate, estimate_mesh_error, mesh_companion_plan, with_points
from taichi_msm.accuracy.run_errors import RunErrorEstimates, RunErrorEstimator
from taichi_msm.accuracy.time_step import (
    TimeStepEstimate,
    choose_step,
    combine_estimates,
    max_norm,
)
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import overlap, path_warnings
from taichi_msm.model.verlet import convergence_order
from taichi_msm.runs.run import run
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import plan_variant
from taichi_msm.system.runtime import Device
from tests.accuracy.test_accuracy import MOVED, Falling
from tests.golden import Messages
from tests.motion import estimate_error, frames_on, notes_of, true_error
from tests.scenes import plan_of, random_contact
from tests.terms.test_contact import HELD, PRESSED, RUBBED, moved, touching

# Random scenes; one is tried by default.
SEEDS = [pytest.param(seed, marks=[] if seed == 18 else pytest.mark.slow) for seed in range(30)]


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("map") / "map.png"
    grey = (255 * np.random.default_rng(1).random((5, 5))).astype(np.uint8)
    Image.fromarray(grey).resize((64, 64), Image.Resampling.BICUBIC).save(path)
    return str(path)


def told(plan: Plan, device: Device) -> RunErrorEstimates:
    """What a run says of its error."""
    companions = choose_companion_runs(plan, requested=True)
    known = RunErrorEstimator(plan, companions, RunErrorEstimates(), device, device.threads)
    own, kept = Dynamics(plan, device), []
    for _ in range(plan.grid.frames):
        own.advance(plan.grid.steps_per_frame)
        kept.append(own.displacement())
        known.compare_frame(kept[-1], lambda: None, own.tool_forces())
    known.finish(iter(kept), lambda done, total: None)
    return known.estimates


@pytest.mark.parametrize("seed", SEEDS)
def test_the_error_of_the_step_is_hardly_above_what_is_told(seed: int, image: str, device: Device) -> None:
    plan = plan_of(random_contact(seed, image))
    # Of an odd number the half is rounded.
    assert choose_companion_runs(plan).cost <= 0.75 + 1 / plan.grid.steps_per_frame
    estimate: Any = told(plan, device).estimate
    assert estimate.at_most
    error = true_error(plan, device, fine=16)
    assert error <= 1.5 * estimate.error or estimate.at_least
    assert estimate.error <= 8 * error


@pytest.mark.parametrize("seed", SEEDS)
def test_the_error_of_the_points_is_hardly_above_what_is_told(seed: int, image: str, device: Device) -> None:
    plan = plan_of(random_contact(seed, image, cells=4))
    if plan.scene.tissue is None:
        pytest.skip("springs have none")
    mesh: Any = told(plan, device).mesh
    assert mesh.at_most or mesh.error == math.inf
    exact = plan.with_grid(precision="f64")
    rows, cols = plan.scene.sheet.points
    finer = plan_variant(exact, with_points(plan.scene, (4 * rows - 3, 4 * cols - 3))).with_grid(precision="f64")
    reference = frames_on(finer, device)[:, ::4, ::4]
    own = frames_on(exact.with_grid(steps_per_frame=8 * plan.grid.steps_per_frame), device)
    error = max_norm(own - reference) / max_norm(reference)
    assert error <= (2 if mesh.doubt else 1.5) * mesh.error


# Of tissue that a rod goes into.
WALL = {"young": 3e4, "thickness": 2e-3, "density": 1050, "foundation": 1.3e5, "damping": 200, "pretension": 40}


def walled(path: list[list[float]], rod: dict[str, Any], time: dict[str, Any], **sections: Any) -> Scene:
    """A rod that goes into a sheet that all holds."""
    made = {
        "sheet": {"points": [31, 31], "size": [0.1, 0.1], **sections.get("sheet", {})},
        "tissue": {**WALL, "foundation_active": "always", **sections.get("tissue", {})},
        "probes": [{"path": path, "instrument": {"length": 0.15, **rod}, "friction": sections.get("friction", 0.0)}],
        "time": {"precision": "f64", **time},
        "output": sections.get("output", []),
    }
    return Scene.model_validate(made)


@pytest.mark.slow
def test_the_errors_of_a_drag_are_about_what_is_told(device: Device) -> None:
    """Told over true is between 0.67 and 4, of displacements and forces, as shares of the greatest."""
    path = [[0, 0.54, 0.35, 0.001], [0.15, 0.54, 0.35, -0.01], [0.48, 0.48, 0.37, -0.01], [0.54, 0.48, 0.37, 0.012]]
    rod = {"radius": 0.008, "shaft": [0.2, 0.7, 1.2]}
    time = {"duration": 0.56, "frames_per_second": 25}
    plan = plan_of(walled(path, rod, time, friction=0.3, tissue={"young": 4.5e4}))
    known: Any = told(plan, device)
    finer = plan_variant(plan, with_points(plan.scene, (61, 61))).with_grid(
        steps_per_frame=2 * plan.grid.steps_per_frame
    )
    own, reference = Dynamics(plan, device), Dynamics(finer, device)
    apart = most = forces_apart = greatest = 0.0
    for _ in range(plan.grid.frames):
        for one in (own, reference):
            one.advance(one.plan.grid.steps_per_frame)
        exact, force = reference.displacement()[::2, ::2], reference.tool_forces()
        apart, most = max(apart, max_norm(own.displacement() - exact)), max(most, max_norm(exact))
        forces_apart = max(forces_apart, max_norm(own.tool_forces() - force))
        greatest = max(greatest, max_norm(force))
    shares = known.mesh.error / (apart / most), known.force.error / (forces_apart / greatest)
    assert all(0.67 <= share <= 4 for share in shares)


def moved_tissue(radius: float = 0.006, place: float = 0.4583) -> Scene:
    """A rod that goes into a small sheet."""
    soft = {"young": 2e4, "density": 1000, "foundation": 2e5, "damping": 400, "pretension": 10}
    path, sheet = [[0, place, place, 0.002], [0.4, place, place, -0.002]], {"points": [13, 13], "size": [0.06, 0.06]}
    rod, time = {"radius": radius, "shaft": [0, 0, 1], "length": 0.1}, {"duration": 0.4, "frames_per_second": 10}
    return walled(path, rod, {**time, "precision": "auto"}, sheet=sheet, tissue=soft, output=["forces"])


@pytest.mark.default_cases("pressed-0.03")
@pytest.mark.parametrize("tolerance", [0.03, pytest.param(0.003, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", [[PRESSED], [RUBBED], [HELD]], ids=["pressed", "rubbed", "held"])
def test_a_tolerance_is_kept(case: list[dict[str, Any]], tolerance: float, device: Device) -> None:
    plan, estimate = choose_step(plan_of(touching(case, time={"tolerance": tolerance})), device)
    assert estimate.error <= tolerance
    assert true_error(plan, device, fine=8) <= tolerance


def test_contact_is_of_order_1() -> None:
    assert convergence_order(plan_of(touching([PRESSED]))) == 1
    assert convergence_order(plan_of(touching([]))) == 2


def test_without_a_coarse_pilot_half_as_much_again_is_told(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    monkeypatch.setattr(time_step, "Dynamics", partial(Falling, 1))
    plan = plan_of(touching([PRESSED], time={"step": 0.005}))
    assert estimate_error(plan, device).error == pytest.approx(1.25 * 1.5 * 0.005 / (1 + 0.005 / 2), rel=1e-9)


@pytest.mark.parametrize(
    ("coarse", "share", "at_least"),
    [(0.01, 2 / 3, True), (0.9, 0.9, False), (math.inf, 4 / 3, False), (0.34, 2 / 3, False), (0.33, 2 / 3, True)],
)
def test_a_coarse_pilot_decides_within_the_doubt_of_the_fine_one(coarse: float, share: float, at_least: bool) -> None:
    def of(error: float, *, at_most: bool = True) -> TimeStepEstimate:
        return TimeStepEstimate(10, error, 0.0, error, 1, at_most=at_most)

    both = combine_estimates(of(coarse), of(1.0))
    assert [both.error, both.in_f64] == pytest.approx([share, share])
    assert both.at_least == at_least
    assert combine_estimates(of(coarse), of(1.0, at_most=False)) == of(1.0, at_most=False)
    assert [combine_estimates(of(coarse), of(error)).error for error in (0.0, math.inf)] == [0, math.inf]


def test_how_wrong_it_is_is_said_as_a_bound(message: Messages) -> None:
    made = touching([PRESSED])
    notes = [
        notes_of(made, MOVED, TimeStepEstimate(10, 0.04, 0.0, 0.04, 1, at_least=at_least, at_most=True))
        for at_least in (False, True)
    ]
    for each in notes:
        message(each, "error: time step ")
    # Of order 1, it takes eight times as many steps.
    assert notes[0][1].endswith(f"time.step: {0.04 / (8 * plan_of(made).grid.steps_per_frame):.9g}")


@pytest.mark.parametrize("radius", [0.05, 0.01])
def test_points_too_far_apart_for_a_tool_have_one_remedy(radius: float, message: Messages) -> None:
    made = touching([{**PRESSED, "instrument": {**PRESSED["instrument"], "radius": radius}}])
    message(notes_of(made, MOVED, None, mesh=MeshEstimate(0.3, at_most=True)))


@pytest.mark.slow
def test_tools_that_run_through_each_other_are_found() -> None:
    """Of random middle lines, some parallel, some of hardly any length."""
    rng, found = np.random.default_rng(5), 0
    shares = np.linspace(0, 1, 400)[:, None]
    for _ in range(60):
        tips, along = rng.uniform(-0.2, 0.2, (2, 3)), rng.uniform(-1, 1, (2, 3))
        along[rng.random(2) < 0.3] = [0.0, 0.0, 1.0]
        along *= (rng.choice([1e-3, 0.1, 0.3], 2) / np.linalg.norm(along, axis=1))[:, None]
        one, other = (tip + shares * way for tip, way in zip(tips, along, strict=True))
        apart = np.linalg.norm(one[:, None] - other, axis=-1).min()
        for radius in (0.97 * apart / 2, 1.03 * apart / 2):
            probes = []
            for (x, y, z), way in zip(tips, along, strict=True):
                rod = {"radius": radius, "shaft": way.tolist(), "length": np.linalg.norm(way)}
                probes.append(moved([0, 0.5 + x / 0.4, 0.5 - y / 0.3, z - radius], instrument=rod))
            plan = plan_of(touching(probes))
            assert overlap(plan.tools, 0.4) == ((0, 1, 0.0) if 2 * radius > apart else None), probes
            found += 2 * radius > apart
    assert found == 60


@pytest.mark.slow
def test_the_error_with_tools_in_one_place_may_be_larger(device: Device, message: Messages) -> None:
    meets = moved([0, 0.8, 0.5, 0.01], [0.2, 0.55, 0.5, -0.02])
    plan = plan_of(touching([PRESSED, meets], time={"duration": 0.2}))
    notes = [note for note in path_warnings(plan.scene, plan.tools) if "through each other" in note]
    message(notes, "probes.0 and probes.1: ")
    estimate: Any = told(plan, device).estimate
    assert estimate.at_least


def test_the_pilot_of_the_points_is_compared_with_the_run(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarse pilot, with steps twice as long, may press quite otherwise."""
    plan = plan_of(touching([PRESSED]))
    known: Any = RunErrorEstimator(plan, choose_companion_runs(plan, requested=True), RunErrorEstimates(), device, 1)
    given: list[Any] = []
    monkeypatch.setattr(known._mesh, "compare_frame", lambda displacement, pause: given.append(displacement))
    of_the_run = np.zeros((*plan.scene.sheet.points, 3))
    known.compare_frame(of_the_run, lambda: None)
    assert given[0] is of_the_run
    steps = [sheet.plan.grid.steps_per_frame for sheet in known._mesh._sheets]
    assert steps == [math.ceil(plan.grid.steps_per_frame / 2)]
    of_25: Any = mesh_companion_plan(plan_of(with_points(moved_tissue(), (25, 25))))
    assert of_25.scene.sheet.points == (18, 18)  # 24 / √2 is 16.97.


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.003, 0.0045])
def test_where_a_tip_is_as_narrow_as_a_cell_a_nearer_run_follows(radius: float, device: Device) -> None:
    """The first run differs by 50 or 80 %, of which the run is off by a tenth."""
    wall = {"thickness": 3e-3, "foundation": 3e5, "damping": 2000, "pretension": 25}
    path, rod = [[0, 0.5, 0.5, 0.0005], [0.5, 0.5, 0.5, -0.003]], {"radius": radius, "shaft": [0.5, 0.9, 0.8]}
    plan = plan_of(walled(path, rod, {"duration": 0.6, "frames_per_second": 10}, tissue=wall))
    mesh: Any = told(plan, device).mesh
    finer = plan_variant(plan, with_points(plan.scene, (91, 91))).with_grid(precision="f64")
    reference = frames_on(finer, device)[:, ::3, ::3]
    error = max_norm(frames_on(plan, device) - reference) / max_norm(reference)
    assert 0.67 <= mesh.error / error <= 4
    assert estimate_mesh_error(plan, device, lambda done, total: None).error == pytest.approx(mesh.error)


@pytest.mark.parametrize(
    ("steps", "apart", "nearer", "expected"),
    [
        (0.1, 0.2, None, 0.24),
        (0.1, 0.9, 0.4, 0.42),
        (0.1, 1.1, 0.2, 0.7 * 0.22**0.5),
        (0.1, 0.9, 1.1, None),
        (0.1, 0.9, math.nan, None),
        (0.1, 0.9, None, None),
        (1.5, 0.2, None, None),
    ],
)
def test_large_differences_tell_little(
    steps: float, apart: float, nearer: float | None, expected: float | None, device: Device
) -> None:
    """Above 0.4 of the displacement a nearer run is needed; above all of it, and of such steps, nothing is known."""
    plan = plan_of(moved_tissue())
    of_steps = TimeStepEstimate(10, steps, 0.0, steps, 1, at_most=True)
    known = RunErrorEstimator(plan, choose_companion_runs(plan, requested=True), RunErrorEstimates(of_steps), device, 1)
    mesh: Any = known._mesh
    displacement = np.zeros((*plan.scene.sheet.points, 3))
    displacement[6, 6, 2] = 1.0
    known.compare_frame(displacement, lambda: None, np.ones((1, 3)))
    mesh._differences = [apart]
    second = mesh.build_second_run(plan, device, 1)
    assert (second is None) == (apart < 0.4)
    if second is not None:
        if nearer is None:
            mesh._second_run = None
        else:
            second._largest, second._differences = 1.0, [nearer]
    estimates: Any = known.estimates
    found, force = estimates.mesh, estimates.force
    assert found.error == (pytest.approx(expected) if expected else math.inf)
    assert force.error == (pytest.approx(expected * np.clip(1.15 / expected, 0.5, 1)) if expected else None)
    assert bool(found.doubt) == bool(force.doubt) == (expected is None)


@pytest.mark.parametrize(
    ("radius", "place", "known"),
    [(0.0005, 0.4583, False), (0.006, 0.4583, True)],
    ids=["meets no point", "meets points"],
)
def test_a_rod_that_meets_no_point_has_no_known_error(
    radius: float, place: float, known: bool, device: Device, tmp_path: Path
) -> None:
    made = moved_tissue(radius, place)
    record = run(made, tmp_path / "out", threads=device.threads, estimate_error=True)
    estimate: Any = record["error_estimate"]
    assert (estimate["mesh_error"] is not None, estimate["mesh_doubt"] == "") == (known, known)
    assert (estimate["force_error"] is not None, estimate["force_doubt"] == "") == (known, known)
    assert any("force error" in note for note in record["notes"])
