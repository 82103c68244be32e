"""Error estimates of sheets with a mask, whose outline differs from mesh to mesh (docs/decisions/0037)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.accuracy.companions import QUASISTATIC_REASON, choose_companion_runs
from taichi_msm.accuracy.interpolation import difference, same_outline
from taichi_msm.accuracy.mesh import (
    NO_COARSER_MESH,
    WRINKLING,
    MeshCompanion,
    MeshEstimate,
    choose_points,
    coarser_plan,
    estimate_mesh_error,
    mesh_companion_plan,
    with_points,
)
from taichi_msm.accuracy.run_errors import RunErrorEstimates, RunErrorEstimator, run_warnings
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.load.check import check_scene
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tool_force import probe_records
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.solver.planning import plan_variant
from taichi_msm.solver.rest import build_solver
from taichi_msm.system.runtime import Device
from tests.accuracy.test_time_step import MOVED
from tests.golden import Messages
from tests.scenes import plan_of

PIXELS = 240
Y, X = (np.mgrid[:PIXELS, :PIXELS] + 0.5) / PIXELS
HOLE = np.hypot(X - 0.55, Y - 0.48) > 0.17
# A slit of 0.15 of the width, from the top to the middle.
SLIT = (abs(X - 0.5) > 0.075) | (Y > 0.5)
TISSUE = {"young": 3e4, "thickness": 2e-3, "density": 1050, "foundation": 1.3e5, "foundation_active": "always"}
TISSUE |= {"damping": 200}
REST = {"motion": "quasistatic", "duration": 0.2, "frames_per_second": 5}


@pytest.fixture(autouse=True)
def cwd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def masked(is_sheet: Any, points: tuple[int, int] = (25, 25), **keys: Any) -> dict[str, Any]:
    Image.fromarray(np.where(is_sheet, 255, 0).astype(np.uint8)).save("mask.png")
    return {"points": points, "size": [0.1, 0.1], "mask": "mask.png", **keys}


def pressed(sheet: dict[str, Any], probe: dict[str, Any], time: dict[str, Any], **tissue: Any) -> Scene:
    return Scene.model_validate(
        {"sheet": sheet, "tissue": {**TISSUE, **tissue}, "probes": [probe], "time": time, "output": []}
    )


def force(across: float, down: float, total: float) -> dict[str, Any]:
    return {"at": [across, down], "total": total, "radius": 0.01, "falloff": 200, "load": [[0, 0], [0.1, 100]]}


def field(points: tuple[int, int]) -> Any:
    """x and y of the mass points in units of the sheet, (rows, cols) each."""
    return np.meshgrid(np.linspace(0, 1, points[1]), np.linspace(0, 1, points[0]))


MESHES = {"half": (13, 13), "nearly": (22, 24), "finer": (41, 37)}


@pytest.mark.parametrize("name", MESHES)
def test_difference_crosses_no_slit(name: str) -> None:
    """Linear displacements that differ left and right of a slit are exact on every mesh, up to rounding."""
    sheets = [Sheet.model_validate(masked(SLIT, points)) for points in ((25, 25), MESHES[name])]

    def moved(points: tuple[int, int]) -> Any:
        x, y = field(points)
        above = np.where(x < 0.5, 1 + x - 3 * y, -20 + 2 * y)
        return np.stack([np.where(y < 0.5 + 1e-9, above, 0), x - y, 1 + x], axis=-1)

    compared = difference(moved((25, 25)), moved(MESHES[name]), *sheets)
    # Below the slit, the first component has a kink.
    above = field((25, 25))[1] < 0.5 - 1 / 12
    assert abs(compared[above]).max() < 1e-13 * 20
    assert abs(compared[..., 1:]).max() < 1e-13


def test_difference_without_holes_is_by_cubics() -> None:
    rng = np.random.default_rng(0)
    fine, coarse = rng.random((25, 25, 3)), rng.random((13, 15, 3))
    whole = [Sheet(points=points, size=(1, 1)) for points in ((25, 25), (13, 15))]
    white = [Sheet.model_validate(masked(np.ones((9, 9)), points)) for points in ((25, 25), (13, 15))]
    np.testing.assert_allclose(difference(fine, coarse, *white), difference(fine, coarse, *whole), rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", MESHES)
def test_points_of_both_sheets_are_compared(name: str) -> None:
    """A mass point is compared if a place of its own cells, 1e-6 away from it, is in a cell of the other mesh."""
    sheets = [Sheet.model_validate(masked(HOLE, points)) for points in ((25, 25), MESHES[name])]
    masks: list[Any] = [rest_of(sheet).mask for sheet in sheets]
    expected = np.zeros((25, 25), bool)
    for i, j in np.argwhere(masks[0].points):
        around = [(i + di, j + dj) for di in (-0.5, 0.5) for dj in (-0.5, 0.5)]
        own = [(y, x) for y, x in around if 0 < y < 24 and 0 < x < 24 and masks[0].cells[int(y), int(x)]]
        towards = np.mean(own, axis=0)
        place = np.array([i, j]) + 1e-6 * (towards - (i, j))
        expected[i, j] = masks[1].cells[tuple((place * masks[1].cells.shape / 24).astype(int))]
    ones = np.ones((25, 25, 3))
    compared = difference(ones, np.zeros((*MESHES[name], 3)), *sheets)
    np.testing.assert_array_equal(compared, expected[..., None] * ones)
    assert 0.5 * expected.size < expected.sum() < masks[0].points.sum()


OUTLINES = {
    "hole": (["####", "#..#", "####", "####"], ["##", "##"], False),
    "part": (["#...", "#...", "...#", "...#"], ["#.", ".#"], False),
    "bridge": (["#####.", "#...##", "#.####"], ["####", "#..#", "####"], False),
    "tongue": (["......", "######", "######", "......", "......", "......"], ["#..", "#..", "..."], False),
    "shifted": (["####", "#..#", "####", "####"], ["###", "#.#", "###"], True),
    "oblique": (["####", "#.##", "##.#", "####"], ["###", "#.#", "###"], True),
}


@pytest.mark.parametrize("name", OUTLINES)
def test_outline_with_fewer_points(name: str) -> None:
    """Of # cells: as many holes and parts, and every mass point within a cell of the coarse sheet."""
    fine, coarse, same = OUTLINES[name]
    sheets = []
    for rows in (fine, coarse):
        Image.fromarray(np.array([[255 * (pixel == "#") for pixel in row] for row in rows], np.uint8)).save("mask.png")
        points = len(rows) + 1, len(rows[0]) + 1
        sheets.append(Sheet.model_validate({"points": points, "size": [0.1, 0.1], "mask": "mask.png"}))
        assert rest_of(sheets[-1]).mask is not None
    assert same_outline(*sheets) == same


@pytest.mark.parametrize("surface", [None, {"tube": {"radius": 0.03}}])
def test_no_coarser_mesh_without_cells(surface: Any) -> None:
    """A cross narrower than two cells is between the middles of cells twice as long, but not of 11 cells a side."""
    cross = (abs(X - 0.5) < 1 / 30) | (abs(Y - 0.5) < 1 / 30)
    plan = plan_of(pressed(masked(cross, (25, 25), surface=surface), BALL, REST))
    assert coarser_plan(plan) is None
    assert coarser_plan(plan_variant(plan, with_points(plan.scene, (23, 23)))) is not None


def estimates_and_errors(made: Scene, device: Device) -> tuple[Any, float, float]:
    """Estimates of a run, and its errors against four times the cells per side where both have sheet."""
    plan, refinement = plan_of(made), 4
    finer = plan_variant(plan, with_points(made, (4 * made.sheet.points[0] - 3, 4 * made.sheet.points[1] - 3)))
    masks: list[Any] = [rest_of(each.scene.sheet).mask for each in (plan, finer)]
    both = masks[0].points & masks[1].points[::refinement, ::refinement]
    estimator = RunErrorEstimator(
        plan, choose_companion_runs(plan, requested=True), RunErrorEstimates(), device, device.threads
    )
    sheets, displacements = (build_solver(plan, device), build_solver(finer, device)), []
    error = largest = force_error = largest_force = 0.0
    for _ in range(plan.grid.frames):
        for sheet in sheets:
            sheet.advance(sheet.plan.grid.steps_per_frame)
        displacements.append(sheets[0].displacement())
        forces, reference_forces = (sheet.tool_forces() for sheet in sheets)
        reference = sheets[1].displacement()
        error = max(error, max_norm((displacements[-1] - reference[::refinement, ::refinement])[both]))
        largest = max(largest, max_norm(reference))
        if len(forces):
            force_error = max(force_error, max_norm(forces - reference_forces))
            largest_force = max(largest_force, max_norm(reference_forces))
        estimator.compare_frame(displacements[-1], lambda: None, forces)
    estimator.finish(iter(displacements), lambda done, total: None)
    return estimator.estimates, error / largest, force_error / max(largest_force, 1e-300)


BALL: dict[str, Any] = {
    "path": [[0, 0.32, 0.48, 5e-4], [0.2, 0.32, 0.48, -3e-3]],
    "instrument": {"radius": 8e-3, "shaft": [0, 0, 1], "length": 0.1},
}
CASES: dict[str, Any] = {
    "free hole": ({}, force(0.3, 0.5, -0.1), REST, {}),
    "fixed hole": ({"fixed": "outline"}, force(0.3, 0.5, -0.2), REST, {"pretension": 20}),
    "moving": ({}, force(0.3, 0.5, -0.1), {"duration": 0.15, "frames_per_second": 20}, {}),
    "tube": ({"surface": {"tube": {"radius": 0.03}}}, force(0.3, 0.5, -0.1), REST, {}),
    "ball": ({}, BALL, REST, {}),
}
SLOW = "moving", "tube"


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else []) for name in CASES])
def test_estimate_against_the_true_error(name: str, device: Device) -> None:
    """0.67 to 8 times the error: of 142 random scenes outside this test, 1 was below and 6 above."""
    sheet, probe, time, tissue = CASES[name]
    estimates, error, force_error = estimates_and_errors(pressed(masked(HOLE, **sheet), probe, time, **tissue), device)
    assert 0.67 * error < estimates.mesh.error < 8 * error
    if estimates.force:
        assert 0.67 * force_error < estimates.force.error < 5 * force_error


@pytest.mark.parametrize(
    ("differences", "error", "doubt"),
    [([0.1, 0.2], 0.1, False), ([0.1, 0.6], 0.6 / 2**1.5, False), ([0.1, 0.09], 2 * 0.1, True)],
)
def test_estimate_by_the_differences(differences: list[float], error: float, doubt: bool, device: Device) -> None:
    """Order 1, and 1.5 between the coarser runs; twice as much where these differ less."""
    plan = plan_of(pressed(masked(HOLE, fixed="outline"), force(0.3, 0.5, -0.1), REST, pretension=20))
    coarse: Any = coarser_plan(plan)
    companion = MeshCompanion(plan, coarse, device)
    companion._largest, companion._differences, companion._sampling_error = 1.0, differences, 0.0
    assert companion.estimate.error == pytest.approx(error)
    assert bool(companion.estimate.doubt) == doubt


def test_doubts_of_an_outline(device: Device, message: Messages) -> None:
    """A slit that coarse meshes close, and a tool with one companion run alone."""
    narrow = (abs(X - 0.5 + 1 / 48) > 1 / 48) | (abs(Y - 0.5) > 0.25)
    slit_plan = plan_of(pressed(masked(narrow), force(0.55, 0.5, -0.1), REST))
    slit = estimate_mesh_error(slit_plan, device, lambda done, total: None)
    plan = plan_of(pressed(masked(HOLE), BALL, REST))
    coarse = mesh_companion_plan(plan)
    assert coarse is not None
    companion = MeshCompanion(plan, coarse, device)
    companion._largest, companion._differences = 1.0, [0.1]
    alone = companion.estimate
    assert alone.error == pytest.approx(0.12)
    second: Any = companion.build_second_run(plan, device)
    second._largest, second._differences = 1.0, [0.5]
    assert companion.estimate == MeshEstimate(1.2 * 0.5, at_most=True)
    for doubt in (slit.doubt, alone.doubt):
        errors = RunErrorEstimates(reason=QUASISTATIC_REASON, mesh=MeshEstimate(0.004, doubt))
        message(list(run_warnings(plan, probe_records(plan.scene), MOVED, errors)), "the mesh error may be larger")
    errors = RunErrorEstimates(reason=QUASISTATIC_REASON, mesh=MeshEstimate(0.02, WRINKLING))
    message(list(run_warnings(slit_plan, probe_records(slit_plan.scene), MOVED, errors)), "hold the outline")


def test_points_of_a_tolerance(device: Device) -> None:
    """The first mesh has no coarser one, so that its error is not known, and the search continues."""
    cross = (abs(X - 0.5) < 1 / 11) | (abs(Y - 0.5) < 1 / 11)
    wide = {"at": [0.5, 0.5], "total": -0.05, "radius": 0.02, "falloff": 60, "load": [[0, 0], [0.1, 100]]}
    sheet = masked(cross, (9, 9), fixed="outline", tolerance=0.4)
    plan = plan_of(pressed(sheet, wide, REST, pretension=20, foundation=1e5))
    assert estimate_mesh_error(plan, device, lambda done, total: None) == MeshEstimate(math.inf, NO_COARSER_MESH)
    chosen, estimate = choose_points(plan, device, check_scene)
    assert estimate.error <= 0.4
    assert estimates_and_errors(chosen.scene, device)[1] <= 0.4
