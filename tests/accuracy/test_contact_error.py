"""What is told of the error of runs whose tools touch the sheet, against the error itself (docs/decisions/0027)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.accuracy import time_step
from taichi_msm.accuracy.companions import choose_companion_runs
from taichi_msm.accuracy.mesh import MeshEstimate, estimate_mesh_error, mesh_companion_plan, with_points
from taichi_msm.accuracy.report import RunErrorEstimates, RunErrorEstimator
from taichi_msm.accuracy.time_step import (
    TimeStepEstimate,
    choose_step,
    combine_estimates,
    convergence_order,
    estimate_error,
    max_norm,
)
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import overlap, path_warnings
from taichi_msm.runs.run import run
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import plan_variant
from taichi_msm.system.runtime import Device
from tests.accuracy.test_accuracy import MOVED, Falling
from tests.motion import frames_on, notes_of, true_error
from tests.scenes import plan_of, random_contact
from tests.terms.test_contact import HELD, PRESSED, RUBBED, moved, touching

# Of 30 random scenes a few are tried by default.
SEEDS = [pytest.param(seed, marks=[] if seed in (0, 18) else pytest.mark.slow) for seed in range(30)]


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
def test_the_error_of_the_step_is_hardly_above_what_is_told(
    seed: int, image: str, device: Device, record_property: Callable[[str, object], None]
) -> None:
    plan = plan_of(random_contact(seed, image))
    # Of an odd number the half is rounded.
    assert choose_companion_runs(plan).cost <= 0.75 + 1 / plan.grid.steps_per_frame
    estimate = told(plan, device).estimate
    assert estimate is not None
    assert estimate.at_most
    error = true_error(plan, device, fine=16)
    record_property("told", f"{estimate.error:.3g}, {estimate.error / error:.2f} of the truth, {estimate.at_least=}")
    assert error <= 1.5 * estimate.error or estimate.at_least
    assert estimate.error <= 8 * error


@pytest.mark.parametrize("seed", SEEDS)
def test_the_error_of_the_points_is_hardly_above_what_is_told(
    seed: int, image: str, device: Device, record_property: Callable[[str, object], None]
) -> None:
    plan = plan_of(random_contact(seed, image, cells=4))
    if plan.scene.tissue is None:
        pytest.skip("springs have none")
    mesh = told(plan, device).mesh
    assert mesh is not None
    assert mesh.at_most
    exact = plan.with_grid(precision="f64")
    rows, cols = plan.scene.sheet.points
    finer = plan_variant(exact, with_points(plan.scene, (4 * rows - 3, 4 * cols - 3))).with_grid(precision="f64")
    reference = frames_on(finer, device)[:, ::4, ::4]
    own = frames_on(exact.with_grid(steps_per_frame=8 * plan.grid.steps_per_frame), device)
    error = max_norm(own - reference) / max_norm(reference)
    record_property("told", f"{mesh.error:.3g}, {mesh.error / error:.2f} of the truth, {mesh.doubt=}")
    assert error <= (2 if mesh.doubt else 1.5) * mesh.error


def test_the_errors_of_a_drag_are_about_what_is_told(
    device: Device, record_property: Callable[[str, object], None]
) -> None:
    """Told over true is between 0.67 and 4, of displacements and forces, as shares of the greatest."""
    wall = {"young": 4.5e4, "thickness": 2e-3, "density": 1050, "foundation": 1.3e5, "damping": 200, "pretension": 40}
    path = [[0, 0.54, 0.35, 0.001], [0.15, 0.54, 0.35, -0.01], [0.48, 0.48, 0.37, -0.01], [0.54, 0.48, 0.37, 0.012]]
    rod = {"radius": 0.008, "shaft": [0.2, 0.7, 1.2], "length": 0.15}
    made = {
        "sheet": {"points": [31, 31], "size": [0.1, 0.1], "fixed": "border"},
        "tissue": {**wall, "foundation_active": "always"},
        "probes": [{"path": path, "friction": 0.3, "instrument": rod}],
        "time": {"duration": 0.56, "frames_per_second": 25, "precision": "f64"},
        "output": [],
    }
    plan = plan_of(Scene.model_validate(made))
    known = told(plan, device)
    assert known.mesh is not None
    assert known.force is not None
    assert known.force.error is not None
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
    record_property("told", f"{shares[0]:.2f} and {shares[1]:.2f} of the truth")
    assert all(0.67 <= share <= 4 for share in shares)


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
    assert combine_estimates(of(coarse), of(0.0)).error == 0
    assert combine_estimates(of(coarse), of(math.inf)).error == math.inf


def test_how_wrong_it_is_is_said_as_a_bound() -> None:
    made = touching([PRESSED])

    def said(*, at_least: bool) -> list[str]:
        return notes_of(made, MOVED, TimeStepEstimate(10, 0.04, 0.0, 0.04, 1, at_least=at_least, at_most=True))

    first, step = said(at_least=False)
    assert first.startswith("error: time step at most about 4 % of ")
    # Of order 1, it takes eight times as many steps.
    finer = 0.04 / (8 * plan_of(made).grid.steps_per_frame)
    assert step == f"for a smaller error of the time step, try time.step: {finer:.9g}"
    assert said(at_least=True)[0].startswith("error: time step roughly 4 % of ")


def test_points_too_far_apart_for_a_tool_have_one_remedy() -> None:
    made = touching([PRESSED])
    thin = touching([{**PRESSED, "instrument": {**PRESSED["instrument"], "radius": 0.01}}])
    for scene, few in ((made, False), (thin, True)):
        notes = notes_of(scene, MOVED, None, mesh=MeshEstimate(0.3, at_most=True))
        assert any("which touches few of them" in note for note in notes) == few
        assert sum("sheet.points" in note or "wider tip" in note for note in notes) == 1
        assert sum("30 %" in note for note in notes) == 1


def segments(rng: np.random.Generator) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Ends of middle lines within a cube, some parallel, some of hardly any length."""
    while True:
        tip, along = rng.uniform(-0.2, 0.2, 3), rng.uniform(-1, 1, 3)
        if rng.random() < 0.3:
            along = np.array([0.0, 0.0, 1.0])
        yield tip, tip + along / np.linalg.norm(along) * rng.choice([1e-3, 0.1, 0.3])


def test_tools_that_run_through_each_other_are_found() -> None:
    drawn, found = segments(np.random.default_rng(5)), 0
    for _ in range(60):
        ends = [next(drawn), next(drawn)]
        shares = np.linspace(0, 1, 400)[:, None]
        one, other = (tip + shares * (top - tip) for tip, top in ends)
        apart = np.linalg.norm(one[:, None] - other, axis=-1).min()
        for radius in (0.97 * apart / 2, 1.03 * apart / 2):
            probes = [
                moved(
                    [0, 0.5 + tip[0] / 0.4, 0.5 - tip[1] / 0.3, tip[2] - radius],
                    instrument={"radius": radius, "shaft": (top - tip).tolist(), "length": np.linalg.norm(top - tip)},
                )
                for tip, top in ends
            ]
            plan = plan_of(touching(probes))
            assert overlap(plan.tools, 0.4) == ((0, 1, 0.0) if 2 * radius > apart else None), ends
            found += 2 * radius > apart
    assert found == 60


def test_the_error_with_tools_in_one_place_may_be_larger(device: Device) -> None:
    meets = moved([0, 0.8, 0.5, 0.01], [0.2, 0.55, 0.5, -0.02])
    plan = plan_of(touching([PRESSED, meets], time={"duration": 0.2}))
    where = overlap(plan.tools, 0.2)
    assert where is not None
    one, other, time = where
    assert (one, other) == (0, 1)
    (note,) = (note for note in path_warnings(plan.scene, plan.tools) if "through each other" in note)
    assert note.startswith(f"probes.0 and probes.1: their instruments run through each other at {time:.3g} s")
    estimate = told(plan, device).estimate
    assert estimate is not None
    assert estimate.at_least


def test_the_pilot_of_the_points_is_compared_with_the_run(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarse pilot, with steps twice as long, may press quite otherwise."""
    plan = plan_of(touching([PRESSED]))
    known = RunErrorEstimator(plan, choose_companion_runs(plan, requested=True), RunErrorEstimates(), device, 1)
    given: list[Any] = []
    assert known._mesh is not None
    monkeypatch.setattr(known._mesh, "compare_frame", lambda displacement, pause: given.append(displacement))
    of_the_run = np.zeros((*plan.scene.sheet.points, 3))
    known.compare_frame(of_the_run, lambda: None)
    assert given[0] is of_the_run
    steps = [sheet.plan.grid.steps_per_frame for sheet in known._mesh._sheets]
    assert steps == [math.ceil(plan.grid.steps_per_frame / 2)]
    of_25 = mesh_companion_plan(plan_of(with_points(moved_tissue(), (25, 25))))
    assert of_25 is not None
    assert of_25.scene.sheet.points == (18, 18)  # 24 / √2 is 16.97.


def moved_tissue(radius: float = 0.006, place: float = 0.4583) -> Scene:
    """A rod that goes into a small sheet."""
    return Scene.model_validate(
        {
            "sheet": {"points": [13, 13], "size": [0.06, 0.06], "fixed": "border"},
            "tissue": {
                "young": 2e4,
                "thickness": 2e-3,
                "density": 1000,
                "foundation": 2e5,
                "foundation_active": "always",
                "damping": 400,
                "pretension": 10,
            },
            "probes": [
                {
                    "path": [[0, place, place, 0.002], [0.4, place, place, -0.002]],
                    "instrument": {"radius": radius, "shaft": [0, 0, 1], "length": 0.1},
                }
            ],
            "time": {"duration": 0.4, "frames_per_second": 10},
            "output": ["forces"],
        }
    )


@pytest.mark.parametrize("radius", [0.003, 0.0045])
def test_where_a_tip_is_as_narrow_as_a_cell_a_nearer_run_follows(radius: float, device: Device) -> None:
    """The first run differs by 50 or 80 %, of which the run is off by a tenth."""
    wall = {"young": 3e4, "thickness": 3e-3, "density": 1050, "foundation": 3e5, "damping": 2000, "pretension": 25}
    rod = {"radius": radius, "shaft": [0.5, 0.9, 0.8], "length": 0.15}
    made = {
        "sheet": {"points": [31, 31], "size": [0.1, 0.1], "fixed": "border"},
        "tissue": {**wall, "foundation_active": "always"},
        "probes": [{"path": [[0, 0.5, 0.5, 0.0005], [0.5, 0.5, 0.5, -0.003]], "instrument": rod}],
        "time": {"duration": 0.6, "frames_per_second": 10, "precision": "f64"},
        "output": [],
    }
    plan = plan_of(Scene.model_validate(made))
    mesh = told(plan, device).mesh
    assert mesh is not None
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
    mesh = known._mesh
    assert mesh is not None
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
    found, force = known.estimates.mesh, known.estimates.force
    assert found is not None
    assert force is not None
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
    estimate = record["error_estimate"]
    assert estimate is not None
    assert (estimate["mesh_error"] is not None, estimate["mesh_doubt"] == "") == (known, known)
    assert (estimate["force_error"] is not None, estimate["force_doubt"] == "") == (known, known)
    assert any("force error" in note for note in record["notes"])
