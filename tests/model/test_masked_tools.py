"""Tools over a sheet with a mask: places on the sheet, gaps, forces, clamps, parts that nothing holds, and messages."""

from __future__ import annotations

import json
import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import Simulation
from taichi_msm.accuracy.contact_warnings import _stiffnesses, first_piercing_probe
from taichi_msm.accuracy.divergence import displacement_bound
from taichi_msm.accuracy.mask import mask_notes
from taichi_msm.cli.main import main
from taichi_msm.errors import DivergedError, SceneError
from taichi_msm.load.scene_file import load_plan
from taichi_msm.model.mask import Mask
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tool_force import sum_probe_forces
from taichi_msm.model.tools import SolidTool
from taichi_msm.runs.run import run
from tests.golden import Messages

# A sheet of 20 x 30 cells of 2 mm, with a round hole of 8 mm radius in the middle.
SCENE: dict[str, Any] = {
    "sheet": {"points": [21, 31], "size": [0.04, 0.06], "mask": "mask.png"},
    "tissue": {"young": 3e4, "thickness": 0.002, "density": 1000, "damping": 40},
    "probes": [],
    "time": {"duration": 0.1, "frames_per_second": 50},
    "output": [],
}
CELL_M = 0.002


def round_hole(pixels: tuple[int, int] = (20, 30), radius: float = 0.2) -> NDArray[np.uint8]:
    """Return a mask, 0 within a radius of the middle [heights]."""
    rows, cols = pixels
    y, x = (np.indices(pixels) + 0.5 - np.reshape([rows / 2, cols / 2], (2, 1, 1))) / rows
    return np.where(np.hypot(x, y) < radius, 0, 255).astype(np.uint8)


@pytest.fixture(autouse=True)
def cwd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write(round_hole())


def write(mask: NDArray[Any]) -> None:
    Image.fromarray(mask.astype(np.uint8)).save("mask.png")
    Path("s.yaml").write_text(json.dumps(SCENE))


def plan_of(**overrides: Any) -> Plan:
    return load_plan("s.yaml", {name.replace("__", "."): value for name, value in overrides.items()})


def ball(*path: list[float], **keys: Any) -> dict[str, Any]:
    return {"path": list(path), "instrument": {"radius": 0.003, "shaft": [0, 0, 1], "length": 0.05}, **keys}


def push(at: Any, **keys: Any) -> dict[str, Any]:
    return {"at": at, "total": [0, 0, -0.1], "load": [[0, 0], [0.1, 100]], "falloff": 1000, **keys}


def test_places_on_the_sheet() -> None:
    """Places on the outline, within rounding, belong to the sheet, and those outside the rectangle do not."""
    mask = Mask(np.array([[True, False], [True, True]]))
    places = [[0.25, 0.25], [0.75, 0.25], [0.5, 0.2], [0.75, 0.5], [1, 1], [1, 0], [0.5 + 1e-12, 0.2], [0.3, -0.1]]
    covered = [True, False, True, True, True, False, True, False]
    np.testing.assert_array_equal(mask.covers(np.array(places)), covered)


@pytest.mark.parametrize(
    ("start", "end", "gap"),
    [
        ([0.25, 0.25], [0.25, 0.75], None),
        ([0.25, 0.75], [0.75, 0.75], None),
        ([0.0, 0.25], [1.0, 0.25], 0.75),  # the middle of the way through the missing cell
        ([0.0, 0.0], [1.0, 1.0], None),  # through the corner
        ([0.5, 0.0], [0.5, 0.5], None),  # along the outline
        ([0.75, 0.25], [0.25, 0.25], 0.0),
    ],
)
def test_lines_that_leave_the_sheet(start: list[float], end: list[float], gap: float | None) -> None:
    mask = Mask(np.array([[True, False], [True, True]]))
    assert mask.first_gap(np.array(start), np.array(end)) == (gap if gap is None else pytest.approx(gap))


def tool_of(probe: dict[str, Any]) -> tuple[SolidTool, Plan]:
    plan = plan_of(probes=[probe])
    (tool,) = plan.tools
    assert isinstance(tool, SolidTool)
    return tool, plan


def test_gap_of_a_ball() -> None:
    """It is the distance from the nearest cell, less the radius, up to 1e-6 of it; clear of the sheet a lower bound."""
    tool, plan = tool_of(ball([0, 0.9, 0.5, 0.01]))
    rest = rest_of(plan.scene.sheet)
    assert rest.mask is not None
    rows, cols = np.nonzero(rest.mask.cells)
    low, high = rest.position[rows + 1, cols], rest.position[rows, cols + 1]
    for x, y, z in product((0, 0.0021, 0.0055, 0.02), (0, 0.0013), (-0.004, 0.0005, 0.002, 0.005)):
        centre = np.array([x, y, z])
        nearest = np.array([x, y, max(z, 0.0)])  # of the upright axis to the plane
        distance = np.linalg.norm(nearest - np.clip(nearest, low, high), axis=1).min()
        gap = tool.gap_at(centre, plan.scene.sheet)
        expected = distance - tool.radius
        assert 0 < gap <= expected if expected > 0 else gap == pytest.approx(expected, abs=1e-6 * tool.radius)


def test_gap_of_a_white_mask_is_that_of_the_rectangle() -> None:
    write(np.full((20, 30), 255))
    tool, plan = tool_of(ball([0, 0.4, 0.5, 0.01]))
    whole = plan_of(sheet__mask=None).scene.sheet
    for z in (0.0, 0.001, 0.004):
        assert tool.gap_at(np.array([0.001, 0.002, z]), plan.scene.sheet) == tool.gap_at(
            np.array([0.001, 0.002, z]), whole
        )


def test_a_path_through_a_hole_touches_nothing() -> None:
    """A ball that fits through the hole moves nothing, neither meets nor pierces the sheet, and none is held."""
    probe = ball([0, 0.5, 0.5, 0.001], [0.1, 0.5, 0.5, -0.02], grip=[[0.05, 0.1]])
    tool, plan = tool_of(probe)
    assert not tool.reaches(plan.scene)
    simulation = Simulation(plan.scene)
    for _ in range(plan.grid.frames):
        simulation.advance()
        assert not first_piercing_probe(plan, simulation.positions() - rest_of(plan.scene.sheet).position, 5)
    np.testing.assert_array_equal(simulation.positions(), rest_of(plan.scene.sheet).position)
    assert simulation.forces()[0].force == (0, 0, 0)


def test_a_tool_beside_the_hole_begins_in_the_sheet(message: Messages) -> None:
    plan_of(probes=[ball([0, 0.5, 0.5, -0.003])])
    with message.raises(SceneError, "probes.0.path: the instrument is 0.003 m in the sheet"):
        plan_of(probes=[ball([0, 0.75, 0.5, -0.003])])


@pytest.mark.parametrize("motion", ["dynamic", "quasistatic"])
def test_points_without_sheet_stay(motion: str) -> None:
    """A wide ball on the rim of the hole, and a grip there, move no point without a cell."""
    probe = ball([0, 0.37, 0.5, 0.0001], [0.1, 0.37, 0.5, -0.002], grip=[[0.06, 0.1]])
    plan = plan_of(probes=[probe], time__motion=motion)
    mask, simulation = rest_of(plan.scene.sheet).mask, Simulation(plan.scene)
    assert mask is not None
    simulation.advance(plan.grid.frames)
    moved = simulation.positions() - rest_of(plan.scene.sheet).position
    assert not moved[~mask.points].any()
    assert np.abs(moved).max() > 1e-3
    assert simulation.forces()[0].force[2] < 0


def test_force_on_the_area_of_the_mask() -> None:
    """The sum over the points converges to the integral of total w / W over the white part of the picture.

    Sampled at the middle of cells, the area of the mask has an error of the outline times half a fine cell: with the
    picture's own pixels of a cell each it is exact, and the sum of w is the midpoint rule, of order 2.
    """
    at = [0.7, 0.5]
    plan = plan_of(probes=[push(at, falloff=300)])
    probe, sheet = plan.scene.probes[0], plan.scene.sheet
    (height, width), n = sheet.size, 20
    y, x = ((np.indices((20 * n, 30 * n)) + 0.5) / n - np.reshape([10, 15], (2, 1, 1))) * CELL_M
    w = np.exp(-300 * np.hypot(x - (at[0] - 0.5) * width, y - (at[1] - 0.5) * height))
    is_sheet = np.kron(round_hole(), np.ones((n, n))) > 0
    exact = 0.1 * (w * is_sheet).sum() * (CELL_M / n) ** 2 / (2 * math.pi / 300**2)
    assert exact < 0.095  # the hole and the border take a part of the force
    (coarse, pressure), (fine, _) = sum_probe_forces(probe, sheet), sum_probe_forces(probe, sheet, 8)
    # The relative error of cells of side h is about (falloff h)^2 / 12, at most the cusp's: 3 % here, and 1/64 of it.
    assert coarse == pytest.approx(exact, rel=0.03)
    assert fine == pytest.approx(exact, rel=0.03 / 64)
    assert pressure == pytest.approx(0.1 / (2 * math.pi / 300**2), rel=1e-12)


def test_largest_pressure_is_on_the_sheet() -> None:
    """Points without sheet, nearer to the tool than the outline, have no pressure, flat and curved."""
    write(np.tile(np.repeat([255, 0], [20, 10]), (20, 1)))
    for surface in (None, {"dome": {"radius": 1.0}}):
        probe = plan_of(probes=[push([2 / 3, 0.5])], sheet__surface=surface).scene.probes[0]
        sheet = plan_of(sheet__surface=surface).scene.sheet
        for refinement in (1, 2):
            total, pressure = sum_probe_forces(probe, sheet, refinement)
            assert 0.03 < total < 0.07  # half of the force acts beyond the outline
            assert pressure == pytest.approx(0.1 / (2 * math.pi / 1000**2), rel=1e-2)
            # One cell beyond the outline, as on a coarser mesh, the pressure at the outline is exp(-2) of that.
            beyond = probe.model_copy(update={"at": (2 / 3 + 1 / 30, 0.5)})
            lower = sum_probe_forces(beyond, sheet, refinement)[1]
            assert lower == pytest.approx(math.exp(-2) * pressure, rel=1e-2)


@pytest.mark.parametrize(
    "at",
    [
        [0.5, 0.5],
        [[0, 0.1, 0.5], [0.1, 0.9, 0.5]],
        [[0, 0.1, 0.5], [0.05, 0.1, 0.5], [0.05, 0.5, 0.5]],
        [[0.5, 0.5, 0.5], [0.6, 0.1, 0.5]],
    ],
    ids=["in the hole", "across the hole", "jump into the hole", "before the first keyframe"],
)
def test_a_force_on_no_sheet_is_refused(at: Any, message: Messages) -> None:
    with message.raises(SceneError, "probes.0.at:"):
        plan_of(probes=[push(at)])


@pytest.mark.parametrize(
    "at",
    [
        [[0, 0.1, 0.5], [0.05, 0.2, 0.5], [0.05, 0.8, 0.5], [0.1, 0.9, 0.5]],
        [[0, 0.1, 0.5], [0.1, 0.2, 0.5], [0.5, 0.5, 0.5]],
        [[-1, 0.5, 0.5], [-0.5, 0.1, 0.5]],
    ],
    ids=["jump over the hole", "hole after the end", "hole before the start"],
)
def test_a_force_that_stays_on_the_sheet(at: Any) -> None:
    assert plan_of(probes=[push(at)]).slots


def test_steering(message: Messages) -> None:
    simulation = Simulation(plan_of(probes=[push([0.2, 0.5])]).scene)
    simulation.advance()
    with message.raises(SceneError, "probes.0.at:"):
        simulation.steer([push([0.5, 0.5])])
    simulation.steer([push([0.8, 0.5])])


def test_clamps(message: Messages) -> None:
    """A clamp holds the points of its side with sheet; a side without is refused."""
    mask = np.full((20, 30), 255)
    mask[:10, 25:] = 0
    write(mask)
    clamp = {"clamp": "right", "path": [[0, 0, 0, 0], [0.1, 0.002, 0, 0]]}
    plan = plan_of(probes=[clamp], sheet__fixed=["left"])
    mean = plan.tools[0].lowest_point(0.0)
    assert mean == pytest.approx((0.03, -0.01, 0))  # the lower half of the side
    mask[:, 25:] = 0
    write(mask)
    with message.raises(SceneError, "probes.0.clamp: right"):
        plan_of(probes=[clamp], sheet__fixed=["left"])
    with message.raises(SceneError, "probes.0.clamp: left"):
        plan_of(probes=[{**clamp, "clamp": "left"}], sheet__fixed="outline")


def split() -> None:
    mask = round_hole()
    mask[:, 20:22] = 0
    mask[:, 26] = 0
    write(mask)


def test_parts_that_nothing_holds(message: Messages) -> None:
    """Parts without a fixed or clamped point and without a foundation are noted, and may move any distance."""
    split()
    plan = plan_of(sheet__fixed=["left"], probes=[push([0.8, 0.5])])
    assert plan.loose_parts == (2, 3)
    message(list(mask_notes(plan)), "row 0, column 22")
    # A force of 0.1 N on the part of 4 x 20 cells moves it farther than ten sheets.
    assert displacement_bound(plan, 10.0) > 10 * 0.06
    clamp = {"clamp": "right", "path": [[0, 0, 0, 0], [0.1, 0.002, 0, 0]]}
    clamped = plan_of(sheet__fixed=["left"], probes=[clamp])
    message(list(mask_notes(clamped)), "row 0, column 22")
    for held in (plan_of(), plan_of(tissue__foundation=1e6, sheet__fixed=["left"])):
        assert list(mask_notes(held)) == []


def test_a_force_on_a_loose_part_at_rest(message: Messages) -> None:
    split()
    simulation = Simulation(plan_of(sheet__fixed=["left"], probes=[push([0.8, 0.5])], time__motion="quasistatic").scene)
    with message.raises(DivergedError, "nothing holds a part of the sheet", hide=r"after .* point \(\d+, \d+\)"):
        simulation.advance(5)


def test_mean_stiffness_of_the_sheet() -> None:
    """Factors of a map in the hole do not count in the warning about a sheet that slides off a tip."""
    Image.fromarray(round_hole()).save("stiff.png")
    stiff = {"image": "stiff.png", "range": [9, 1]}
    membrane, _ = _stiffnesses(plan_of(tissue__map=stiff))
    # The middle of a cell is that of a pixel, so that the map is 1 in all cells of the sheet.
    assert membrane == pytest.approx(3e4 * 0.002, rel=1e-12)


def test_check(message: Messages, capsys: pytest.CaptureFixture[str]) -> None:
    split()
    assert main(("check", "s.yaml", "--set", "sheet.fixed=[left]")) == 0
    lines = capsys.readouterr().out.splitlines()
    message([line for line in lines if line.startswith("mask: ")], "of 600 cells, 3 parts")
    assert main(("check", "s.yaml", "--json", "--set", "sheet.fixed=[left]")) == 0
    record = json.loads(capsys.readouterr().out)
    cells = int((np.array(Image.open("mask.png")) > 0).sum())
    assert record["mask"] == {"cells": cells, "rectangle": 600, "parts": 3}
    assert any("neither fixed nor on a foundation" in note for note in record["notes"])


def test_notes_of_a_run() -> None:
    split()
    record = run(plan_of(sheet__fixed=["left"], probes=[push([0.2, 0.5])]).scene, "out", estimate_error=False)
    assert any("neither fixed nor on a foundation" in note for note in record["notes"])
