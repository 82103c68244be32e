"""Tissue in both kernels against its twin, and what scenes of it may say."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.accuracy.mesh import (
    MIN_POINTS_PER_SIDE,
    MeshCompanion,
    MeshEstimate,
    choose_points,
    coarser_plan,
    interpolate,
)
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.cli.console import run_summary
from taichi_msm.errors import FilesError, SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Maps, rest_positions
from taichi_msm.runs.run import resume, run
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device
from taichi_msm.terms.bending import BendingTerm
from taichi_msm.terms.damping import DampingTerm
from taichi_msm.terms.foundation import FoundationTerm
from taichi_msm.terms.loads import ProbeTerm
from taichi_msm.terms.springs import SpringTerm, spring_stiffness
from tests import reference
from tests.golden import Messages
from tests.motion import dynamics_of, frames, notes_of, structure_of
from tests.outputs import results
from tests.scenes import plan_of, random_scene, random_tissue
from tests.solver.test_dynamics import simulate

SCENE = """\
sheet: {points: [13, 15], size: [0.1, 0.1]}
tissue: {young: 3.0e4, thickness: 2.0e-3, density: 1050, foundation: 2.0e6, damping: 40}
probes:
  - total: [0, 0, -2]
    radius: 0.01
    falloff: 100
    load: [[0, 0], [0.2, 100]]
time: {duration: 0.4, frames_per_second: 10}
output: []
"""


@pytest.fixture
def image(tmp_path: Path) -> str:
    """A map of noise."""
    path = tmp_path / "map.png"
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (7, 9), dtype=np.uint8)).save(path)
    return str(path)


@pytest.fixture
def load(tmp_path: Path, image: str) -> Any:
    """Load the scene with other lines in it; a map lies beside it."""

    def made(*overrides: str, text: str = SCENE) -> Scene:
        (tmp_path / "s.yaml").write_text(text)
        return load_scene(tmp_path / "s.yaml", overrides)

    return made


def stop_at_the_second_frame(stage: str, done: int, total: int) -> None:
    """Interrupt a run that tells its progress."""
    if stage == "frames" and done == 2:
        raise KeyboardInterrupt


# Together they have every term, free and fixed edges, and both ways of a tool.
SEEDS = [0, 1, 2, 7, 9, 10]
SLOW = [pytest.param(seed, "f64", marks=pytest.mark.slow) for seed in range(24) if seed not in SEEDS]


@pytest.mark.parametrize(("seed", "precision"), [*((seed, "f64") for seed in SEEDS), (7, "f32"), *SLOW])
def test_a_random_tissue_is_like_the_twin(seed: int, precision: str, image: str, device: Device) -> None:
    """And so are its energy, and how far springs are pressed and stretched."""
    made = check_scene(random_tissue(seed, image, precision)).scene
    twin, dynamics = reference.simulate(made) - rest_positions(made.sheet), dynamics_of(made, device)
    tolerance = 1e-12 if precision == "f64" else 2e-4
    for frame in twin[1:]:
        dynamics.advance(plan_of(made).grid.steps_per_frame)
        state, reading = dynamics.state(), dynamics.read()
        np.testing.assert_allclose(state.displacement, frame, rtol=0, atol=tolerance * np.abs(twin).max())
    mass, v = reference.sheet(made).mass[..., None], state.difference / plan_of(made).grid.step
    energy = float((mass * v * v).sum()) / 2 + reference.energy(made, state.displacement)
    shortest, longest = (of(made, state.displacement) for of in (reference.shortest_spring, reference.longest_spring))
    assert reading.energy == pytest.approx(energy, rel=1000 * tolerance)
    assert (reading.shortest_spring, reading.longest_spring) == pytest.approx((shortest, longest), rel=tolerance)


@pytest.mark.parametrize("points", [(2, 2), (2, 3), (3, 2)])
def test_a_free_tissue_of_two_rows_is_like_the_twin(points: tuple[int, int], load: Any, device: Device) -> None:
    size = [0.01 * (count - 1) for count in points]
    made = load("sheet.fixed=none", f"sheet.points={list(points)}", f"sheet.size={size}", "tissue.pretension=0")
    twin = reference.simulate(made) - rest_positions(made.sheet)
    np.testing.assert_allclose(simulate(made, device), twin, rtol=0, atol=1e-12 * np.abs(twin).max())


def test_the_random_tissues_have_every_term(image: str, device: Device) -> None:
    codes = [structure_of(random_tissue(seed, image), device).config for seed in SEEDS]
    for kind in (FoundationTerm, DampingTerm, BendingTerm):
        assert {code.get(kind) is None for code in codes} == {False, True}, kind
    assert {term.mapped for code in codes if (term := code.get(FoundationTerm))} == {False, True}
    springs, probes = [code.require(SpringTerm) for code in codes], [code.require(ProbeTerm) for code in codes]
    for flag in ("mapped", "tense", "open_edges", "by_area"):
        assert {getattr(term, flag) for term in springs} == {False, True}, flag
    assert {moves for term in probes for moves in term.moves} == {False, True}
    assert {by_area for term in probes for by_area in term.by_area} == {False, True}


def test_a_map_of_springs_is_like_the_twin(load: Any, device: Device) -> None:
    stiff = "springs={structural: 20, shear: 10, virtual: 1, map: {image: map.png, range: [0.5, 3]}}"
    text = "\n".join(line for line in SCENE.splitlines() if not line.startswith("tissue"))
    made = load(stiff, "sheet.mass=0.001", "sheet.fixed=[top]", "damping=0.01", text=text)
    twin = reference.simulate(made) - rest_positions(made.sheet)
    np.testing.assert_allclose(simulate(made, device), twin, rtol=0, atol=1e-12 * np.abs(twin).max())
    # A spring has the mean of its cells; at an edge it has one.
    material = plan_of(made).material
    factor: Any = material.factors
    across, down, diagonal = spring_stiffness(material, factor)
    np.testing.assert_allclose(across[[0, -1]], 20 * factor[[0, -1]], rtol=1e-15)
    np.testing.assert_allclose(across[1:-1], 10 * (factor[1:] + factor[:-1]), rtol=1e-15)
    np.testing.assert_allclose(down[:, 1:-1], 10 * (factor[:, 1:] + factor[:, :-1]), rtol=1e-15)
    np.testing.assert_allclose(diagonal, 10 * factor, rtol=1e-15)


def test_where_the_tool_lets_go_a_tense_sheet_comes_back(load: Any, device: Device) -> None:
    soft = ("tissue.foundation=0", "tissue.young=3000", "time.duration=2", "probes.0.total=[0, 0, -0.2]")

    def left(tension: int) -> float:
        made = load(*soft, "probes.0.load=[[0, 0], [0.2, 100], [0.2, 0]]", f"tissue.pretension={tension}")
        found = np.abs(frames(made, device)).max(axis=(1, 2, 3))
        return float(found[-1] / found.max())

    assert left(1) < 0.01
    assert left(0) > 0.05, "without tension a flat sheet has no stiffness out of its plane"


REFUSED = [
    "springs={structural: 1}", "sheet.mass=1", "damping=0.1", "probes.0={force: [0, 0, 1]}", "probes.0.force=[0, 0, 1]",
    "probes.0.offset=3", "probes.0.falloff=0", "sheet.points=[13, 40]", "sheet.points=[40, 13]",
    "sheet={points: [13, 15], size: [100, 0.001]}", "probes.0.total=5", "tissue.pretension=90", "tissue.young=0",
    "sheet.size=0", "tissue.density=0", "tissue.bending=thick", "tissue.map={image: map.png}",
]  # fmt: skip


@pytest.mark.parametrize("override", REFUSED)
def test_what_cannot_be_is_refused_with_the_remedy(load: Any, override: str, message: Messages) -> None:
    """And brings no false fault of the step."""
    with message.raises(SceneError, f"--set {override}: "):
        load(override, "time.step=0.0001")


@pytest.mark.parametrize("bending", ["plate", "2e-4"])
@pytest.mark.parametrize("fixed", ["none", "corners", "[top, left, bottom]"])
def test_bending_needs_every_side_fixed(bending: str, fixed: str, load: Any, message: Messages) -> None:
    """Without, a harmonic shape has no energy, so that a strip between two fixed sides would give way for ever."""
    with message.raises(SceneError, "tissue.bending"):
        load(f"tissue.bending={bending}", f"sheet.fixed={fixed}")
    load(f"tissue.bending={bending}", "sheet.fixed=[top, left, bottom, right]")
    load("tissue.bending=0", f"sheet.fixed={fixed}")


def test_the_points_that_would_do_do(load: Any) -> None:
    assert load("sheet.points=[24, 40]").sheet.points == (24, 40)
    assert load("sheet.points=[40, 24]").sheet.points == (40, 24)


def test_all_that_is_wrong_comes_at_once(load: Any, message: Messages) -> None:
    with message.raises(SceneError, "tissue.pretension", "tissue.map.image", "render.refine"):
        load("tissue.pretension=1", "sheet.fixed=none", "tissue.map={image: no.png, range: [1, 2]}", "render.refine=-1")


@pytest.mark.parametrize(
    "name",
    ["f" * 300 + ".png", "a\\0b.png", ".", "no.png", "s.yaml", "../map.png"],
    ids=["long", "null byte", "folder", "missing", "no picture", "outside"],
)
def test_a_map_that_cannot_be_opened_is_refused(name: str, load: Any, message: Messages) -> None:
    """As one that is no picture, or not below the scene's folder."""
    with message.raises(SceneError, "s.yaml:2:", "tissue.map.image: "):
        load(text=SCENE.replace("damping: 40", f'damping: 40, map: {{image: "{name}", range: [1, 2]}}'))


def test_a_sheet_that_folds_over_does_not_seem_to_explode(load: Any, device: Device) -> None:
    # Hard, short and off the middle: the energies of tension and bending are part of what the load explains.
    made = load("tissue.pretension=5", "tissue.bending=plate", "probes.0.total=[3, 1, -20]", "tissue.damping=0")
    with Simulation(made) as simulation:
        simulation.advance(made.time.frames)
        assert math.isfinite(simulation.progress.energy)


SMOOTH = ("probes.0.radius=0.01", "probes.0.falloff=100", "tissue.pretension=5", "tissue.bending=plate", "output=[]")


def mesh_estimate(made: Scene, device: Device) -> MeshEstimate:
    """What the pilot tells of a run."""
    coarse: Any = coarser_plan(plan_of(made))
    pilot = MeshCompanion(plan_of(made), coarse, device)
    for u in frames(made, device):
        pilot.compare_frame(u, lambda: None)
    return pilot.estimate


@pytest.mark.parametrize("count", [25, 24, pytest.param(31, marks=pytest.mark.slow)])
def test_the_mesh_error_is_that_of_the_points(count: int, load: Any, device: Device) -> None:
    # With its control point beyond the edge, a tool is smooth all over the sheet.
    tense = ("tissue.pretension=20", "tissue.foundation=0", "time.duration=0.2")
    smooth = (*tense, "probes.0.radius=0", "probes.0.at=[-0.3, 0.4]", "probes.0.falloff=10")
    made = load(f"sheet.points=[{count}, {count}]", *smooth)
    found, estimate = frames(made, device), mesh_estimate(made, device)
    fine = frames(load(f"sheet.points=[{4 * count - 3}, {4 * count - 3}]", *smooth), device)[:, ::4, ::4]
    error = max_norm(found - fine) / max_norm(fine)
    # An order of 2 to 3, as the runs show here, counts as 2 to 1.75: (2^2 - 1) / (2^1.75 - 1) = 1.3.
    assert 0.8 * error < estimate.error < 1.3 * 1.5 * error
    assert not estimate.doubt


def test_the_pilot_of_the_points_samples_cubics_exactly() -> None:
    def surface(rows: int, cols: int) -> Any:
        x, y = np.arange(cols) / (cols - 1), np.arange(rows)[:, None] / (rows - 1)
        return np.stack([(x**3 - 2 * x) * y, y**3 + 0 * x, x * x * y * y], axis=-1)

    np.testing.assert_allclose(interpolate(surface(5, 8), surface(9, 13)), surface(9, 13), atol=1e-14)


def test_few_points_and_springs_have_no_mesh_error(load: Any, image: str) -> None:
    assert coarser_plan(plan_of(load(f"sheet.points=[{MIN_POINTS_PER_SIDE}, 9]", "sheet.size=[0.1, 0.13]"))) is not None
    assert coarser_plan(plan_of(load(f"sheet.points=[{MIN_POINTS_PER_SIDE - 1}, 7]", "sheet.size=[0.1, 0.13]"))) is None
    assert coarser_plan(plan_of(random_scene(1))) is None


@pytest.mark.slow
def test_a_tolerance_of_the_points_chooses_them(load: Any, device: Device, tmp_path: Path) -> None:
    made = load("sheet.tolerance=0.02", *SMOOTH)
    record: Any = run(made, tmp_path / "out", threads=device.threads)
    assert 0.005 < (record["error_estimate"]["mesh_error"] or 0) <= 0.02
    assert record["scene"]["sheet"]["tolerance"] is None, "as it was run"
    assert record["scene"]["sheet"]["points"] == record["points"]
    assert record["asked"]["sheet.tolerance"] == 0.02
    assert record["asked"]["sheet.points"] == made.sheet.points
    assert record["points"] == list(choose_points(plan_of(made), device, check_scene)[0].scene.sheet.points)
    assert record["points"] > [13, 15]
    with Simulation(made, threads=device.threads) as simulation:
        assert simulation.positions().shape[:2] == tuple(record["points"])


def test_a_tolerance_far_out_of_reach_is_refused_after_one_run(load: Any, device: Device, message: Messages) -> None:
    tried: list[tuple[int, int]] = []

    def check(scene: Scene, maps: Maps | None) -> Plan:
        tried.append(scene.sheet.points)
        return check_scene(scene, maps)

    with message.raises(SceneError, "sheet.tolerance: 1e-10 ", "no sheet", hide=r"0\.\d+(?=, )"):
        choose_points(plan_of(load("sheet.tolerance=1e-10", *SMOOTH)), device, check)
    assert tried == [(13, 15)]


def test_tissue_that_wrinkles_has_an_error_of_at_least_what_is_told(load: Any, device: Device) -> None:
    """Without bending or tension, pushed along itself: the more points, the more wrinkles."""
    pushed = ("tissue.foundation=1.0e5", "probes.0.total=[1.5, 0.3, -0.3]", "tissue.damping=400")
    assert mesh_estimate(load("sheet.points=[25, 25]", *pushed), device).doubt
    stiff = ("tissue.bending=plate", "tissue.thickness=5.0e-3")
    assert not mesh_estimate(load("sheet.points=[25, 25]", *pushed, *stiff), device).doubt


def test_a_run_says_what_its_tool_and_its_points_do(
    load: Any, device: Device, tmp_path: Path, message: Messages
) -> None:
    record = run(load(), tmp_path / "out", threads=device.threads)
    (probe,) = record["probes"]
    assert probe is not None
    assert probe["total_force"] == pytest.approx(2, rel=0.05)
    # Whole pressure acts on the flat end.
    area = math.pi * (0.01**2 + 2 * (0.01 / 100 + 1 / 100**2))
    assert probe["largest_pressure"] == pytest.approx(2 / area, rel=1e-6)
    message(record["notes"], ", mesh ", "for a smaller error of the mesh, ", hide=r"[\d.]+(?= %| mm| px)")
    message((line for line in run_summary(record, tmp_path).splitlines() if "probes.0: " in line), "1.27 kPa")


def test_a_run_that_stretches_too_far_says_so(load: Any, device: Device, tmp_path: Path) -> None:
    record = run(load("probes.0.total=[0, 0, -60]", "tissue.foundation=0"), tmp_path / "out", threads=device.threads)
    assert record["longest_spring"] > 2
    assert any("times its rest length, which no tissue withstands" in note for note in record["notes"])


def test_a_run_with_a_map_goes_on_from_elsewhere(
    load: Any, tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = SCENE.replace("damping: 40", "damping: 40, map: {image: map.png, range: [1, 2]}")
    (tmp_path / "s.yaml").write_text(text)
    made = load_scene("s.yaml", ["output=[trajectory]"])

    whole = run(made, "whole", threads=device.threads)
    assert run(made, "parts", threads=device.threads, progress=stop_at_the_second_frame)["status"] == "interrupted"
    monkeypatch.chdir(tmp_path / "whole")
    record = resume("../parts", threads=device.threads)
    assert record["status"] == "complete"
    assert record["scene"] == whole["scene"]
    assert record["error_estimate"] == whole["error_estimate"]
    assert results(tmp_path / "parts") == results(tmp_path / "whole")


def test_a_run_does_not_go_on_with_another_map(load: Any, tmp_path: Path, device: Device, message: Messages) -> None:
    """Nor without it."""
    made, image = load("tissue.map={image: map.png, range: [1, 2]}", "output=[trajectory]"), tmp_path / "map.png"
    run(made, tmp_path / "out", threads=device.threads, progress=stop_at_the_second_frame)
    image.rename(tmp_path / "away.png")
    with message.raises(SceneError, "tissue.map.image: "):
        resume(tmp_path / "out", threads=device.threads)
    Image.new("L", (3, 3), 99).save(image)
    with message.raises(FilesError, "map.png has changed"):
        resume(tmp_path / "out", threads=device.threads)
    (tmp_path / "away.png").rename(image)
    assert resume(tmp_path / "out", threads=device.threads)["status"] == "complete"


def test_the_cells_keep_their_shape_while_points_are_chosen(load: Any, device: Device) -> None:
    oblong = ("sheet.points=[5, 13]", "sheet.size=[0.04, 0.12]", "sheet.tolerance=0.05", *SMOOTH)
    rows, cols = choose_points(plan_of(load(*oblong)), device, check_scene)[0].scene.sheet.points
    assert (cols - 1) / (rows - 1) == pytest.approx(3, rel=0.1)
    assert cols > 13


def test_points_for_which_a_given_step_is_too_long_are_refused(load: Any, device: Device, message: Messages) -> None:
    limit = plan_of(load()).stable_step
    made = load("sheet.tolerance=0.001", f"time.step={0.1 / math.ceil(0.1 / limit)!r}")
    with message.raises(SceneError, "time.step: ", "sheet.tolerance: 0.001"):
        choose_points(plan_of(made), device, check_scene)


@pytest.mark.parametrize(
    "setting",
    [
        "probes.0.at=[1.9, 0.5]",
        "probes.0={total: [0, 0, 1], at: [0.47, 0.47], falloff: 50000}",
        "probes.0={total: [0, 0, 1], falloff: 5000}",
    ],
)
def test_a_tool_that_does_not_act_as_a_whole_is_told_of(setting: str, load: Any, message: Messages) -> None:
    def notes(made: Scene) -> list[str]:
        return [note for note in notes_of(made, RunProgress(1, 1.0), None) if note.startswith("probes.0: ")]

    assert not notes(load())
    message(notes(load(setting)))


def test_a_coarser_sheet_may_meet_a_darker_part_of_the_map(load: Any, tmp_path: Path) -> None:
    """Where a pretension would be refused for it, it still tells the error of the points."""
    grey = np.full((6, 7), 255, np.uint8)
    grey[3, 3] = 0
    Image.fromarray(grey).save(tmp_path / "map.png")
    # A cell of the coarser sheet, of 6 x 7, is at the texel's centre; those of the sheet, of 12 x 14, are a quarter of
    # a texel beside it, and have 3/4 of it in both directions. The tension is just below what these allow.
    most = 1.5 * 3e4 * 2e-3 * (1 - (1 - 0.01) * (3 / 4) ** 2)
    made = load("tissue.map={image: map.png, range: [0.01, 1]}", f"tissue.pretension={0.99 * most}")
    coarse: Any = coarser_plan(plan_of(made))
    assert coarse.scene.sheet.points == (7, 8)
    assert coarse.material.factors.min() == pytest.approx(0.01)
