"""Tissue: kernels against the twin, invalid scenes, mesh error and tolerance, resumption with a map."""

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
)
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.cli.console import run_summary
from taichi_msm.errors import FilesError, SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Maps, rest_positions
from taichi_msm.model.tool_force import describe_forces, probe_records
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
    """A function that loads the scene with overrides; its folder contains a map."""

    def load_text(*overrides: str, text: str = SCENE) -> Scene:
        (tmp_path / "s.yaml").write_text(text)
        return load_scene(tmp_path / "s.yaml", overrides)

    return load_text


# Together they have all terms, free and fixed edges, and moving and stationary tools.
SEEDS = [0, 1, 2, 7, 9, 10]
SLOW = [pytest.param(seed, "f64", marks=pytest.mark.slow) for seed in range(24) if seed not in SEEDS]


@pytest.mark.parametrize(("seed", "precision"), [*((seed, "f64") for seed in SEEDS), (7, "f32"), *SLOW])
def test_random_tissues_match_twin(seed: int, precision: str, image: str, device: Device) -> None:
    """Displacements, energy, and smallest and largest strain."""
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


def test_terms_of_random_tissues(image: str, device: Device) -> None:
    configs = [structure_of(random_tissue(seed, image), device).config for seed in SEEDS]
    for kind in (FoundationTerm, DampingTerm, BendingTerm):
        assert {config.get(kind) is None for config in configs} == {False, True}, kind
    assert {term.mapped for config in configs if (term := config.get(FoundationTerm))} == {False, True}
    springs, probes = ([config.require(kind) for config in configs] for kind in (SpringTerm, ProbeTerm))
    for flag in ("varied", "tense", "open_edges", "by_area"):
        assert {getattr(term, flag) for term in springs} == {False, True}, flag
    for flag in ("moves", "by_area"):
        assert {value for term in probes for value in getattr(term, flag)} == {False, True}, flag


def assert_exactly_like_twin(made: Scene, device: Device) -> None:
    twin = reference.simulate(made) - rest_positions(made.sheet)
    np.testing.assert_allclose(simulate(made, device), twin, rtol=0, atol=1e-12 * np.abs(twin).max())


@pytest.mark.parametrize("points", [(2, 2), (2, 3), (3, 2)])
def test_free_tissues_of_two_rows_match_twin(points: tuple[int, int], load: Any, device: Device) -> None:
    size = [0.01 * (count - 1) for count in points]
    settings = f"sheet.points={list(points)}", f"sheet.size={size}", "sheet.fixed=none", "tissue.pretension=0"
    assert_exactly_like_twin(load(*settings), device)


def test_map_of_springs_matches_twin(load: Any, device: Device) -> None:
    stiff = "springs={structural: 20, shear: 10, virtual: 1, map: {image: map.png, range: [0.5, 3]}}"
    text = "\n".join(line for line in SCENE.splitlines() if not line.startswith("tissue"))
    made = load(stiff, "sheet.mass=0.001", "sheet.fixed=[top]", "damping=0.01", text=text)
    assert_exactly_like_twin(made, device)
    # A spring has the mean factor of its cells, one at an edge and two elsewhere.
    material = plan_of(made).material
    factor: Any = material.factors
    across, down, diagonal = spring_stiffness(material, factor)
    np.testing.assert_allclose(across[[0, -1]], 20 * factor[[0, -1]], rtol=1e-15)
    np.testing.assert_allclose(across[1:-1], 10 * (factor[1:] + factor[:-1]), rtol=1e-15)
    np.testing.assert_allclose(down[:, 1:-1], 10 * (factor[:, 1:] + factor[:, :-1]), rtol=1e-15)
    np.testing.assert_allclose(diagonal, 10 * factor, rtol=1e-15)


def test_pretension_straightens_the_sheet_after_a_load(load: Any, device: Device) -> None:
    """Without pretension a flat sheet has no stiffness out of its plane."""
    soft = ("tissue.foundation=0", "tissue.young=3000", "time.duration=2", "probes.0.total=[0, 0, -0.2]")

    def remaining_share(tension: int) -> float:
        made = load(*soft, "probes.0.load=[[0, 0], [0.2, 100], [0.2, 0]]", f"tissue.pretension={tension}")
        largest = np.abs(frames(made, device)).max(axis=(1, 2, 3))
        return float(largest[-1] / largest.max())

    assert remaining_share(1) < 0.01
    assert remaining_share(0) > 0.05


INVALID = [
    "springs={structural: 1}", "sheet.mass=1", "damping=0.1", "probes.0={force: [0, 0, 1]}", "probes.0.force=[0, 0, 1]",
    "probes.0.offset=3", "probes.0.falloff=0", "sheet.points=[13, 40]", "sheet.points=[40, 13]",
    "sheet={points: [13, 15], size: [100, 0.001]}", "probes.0.total=[5]", "tissue.pretension=90", "tissue.young=0",
    "sheet.size=0", "tissue.density=0", "tissue.bending=thick", "tissue.map={image: map.png}",
]  # fmt: skip


def test_invalid_tissues(load: Any, message: Messages) -> None:
    """The invalid step, which depends on the tissue, is not reported in addition."""
    for override in INVALID:
        with message.raises(SceneError, f"--set {override}: "):
            load(override, "time.step=0.0001")
    # The remedies of both sheets with oblong cells are valid.
    load("sheet.points=[24, 40]")
    load("sheet.points=[40, 24]")


def test_bending_requires_fixed_sides(load: Any, message: Messages) -> None:
    """Otherwise a harmonic shape has no energy, so a strip between two fixed sides would not be supported."""
    for bending, fixed in (("plate", "none"), ("2e-4", "corners"), ("plate", "[top, left, bottom]")):
        with message.raises(SceneError, "tissue.bending"):
            load(f"tissue.bending={bending}", f"sheet.fixed={fixed}")
        load("tissue.bending=0", f"sheet.fixed={fixed}")
    load("tissue.bending=plate", "sheet.fixed=[top, left, bottom, right]")


def test_all_problems_are_reported(load: Any, message: Messages) -> None:
    with message.raises(SceneError, "tissue.pretension", "tissue.map.image", "render.refine"):
        load("tissue.pretension=1", "sheet.fixed=none", "tissue.map={image: no.png, range: [1, 2]}", "render.refine=-1")


def test_unreadable_maps(load: Any, message: Messages) -> None:
    for name in ("f" * 300 + ".png", "a\\0b.png", ".", "no.png", "s.yaml", "../map.png"):
        with message.raises(SceneError, "s.yaml:2:", "tissue.map.image: "):
            load(text=SCENE.replace("damping: 40", f'damping: 40, map: {{image: "{name}", range: [1, 2]}}'))


def test_fold_is_not_a_divergence(load: Any, device: Device) -> None:
    """The energies of tension and bending count as work of a strong, short, eccentric load."""
    made = load("tissue.pretension=5", "tissue.bending=plate", "probes.0.total=[3, 1, -20]", "tissue.damping=0")
    with Simulation(made) as simulation:
        simulation.advance(made.time.frames)
        assert math.isfinite(simulation.progress.energy)


# Mesh error.

SMOOTH = ("probes.0.radius=0.01", "probes.0.falloff=100", "tissue.pretension=5", "tissue.bending=plate", "output=[]")


def mesh_estimate(made: Scene, device: Device) -> MeshEstimate:
    coarse: Any = coarser_plan(plan_of(made))
    companion = MeshCompanion(plan_of(made), coarse, device)
    for u in frames(made, device):
        companion.compare_frame(u, lambda: None)
    return companion.estimate


@pytest.mark.parametrize("count", [25, 24, pytest.param(31, marks=pytest.mark.slow)])
def test_mesh_estimate(count: int, load: Any, device: Device) -> None:
    # With its control point beyond the edge, the load is smooth everywhere on the sheet.
    tense = ("tissue.pretension=20", "tissue.foundation=0", "time.duration=0.2")
    smooth = (*tense, "probes.0.radius=0", "probes.0.at=[-0.3, 0.4]", "probes.0.falloff=10")
    made = load(f"sheet.points=[{count}, {count}]", *smooth)
    fine = frames(load(f"sheet.points=[{4 * count - 3}, {4 * count - 3}]", *smooth), device)[:, ::4, ::4]
    error, estimate = max_norm(frames(made, device) - fine) / max_norm(fine), mesh_estimate(made, device)
    # The estimate takes the order, here 2 to 3, as 1.75 to 2: (2^2 - 1) / (2^1.75 - 1) = 1.3.
    assert 0.8 * error < estimate.error < 1.3 * 1.5 * error
    assert not estimate.doubt


def test_scenes_without_coarser_mesh(load: Any) -> None:
    for points, exists in (((MIN_POINTS_PER_SIDE, 9), True), ((MIN_POINTS_PER_SIDE - 1, 7), False)):
        plan = plan_of(load(f"sheet.points={list(points)}", "sheet.size=[0.1, 0.13]"))
        assert (coarser_plan(plan) is not None) == exists
    assert coarser_plan(plan_of(random_scene(1))) is None


def test_coarser_mesh_at_a_darker_part_of_the_map(load: Any, tmp_path: Path) -> None:
    """As a scene, it would be refused for its pretension."""
    grey = np.full((6, 7), 255, np.uint8)
    grey[3, 3] = 0
    Image.fromarray(grey).save(tmp_path / "map.png")
    # A cell of the coarser sheet, of 6 x 7, is at the texel's centre; those of the sheet, of 12 x 14, a quarter of a
    # texel away, and have 3/4 of it in both directions. The tension is just below the largest one for these.
    largest = 1.5 * 3e4 * 2e-3 * (1 - (1 - 0.01) * (3 / 4) ** 2)
    made = load("tissue.map={image: map.png, range: [0.01, 1]}", f"tissue.pretension={0.99 * largest}")
    coarse: Any = coarser_plan(plan_of(made))
    assert coarse.scene.sheet.points == (7, 8)
    assert coarse.material.factors.min() == pytest.approx(0.01)


@pytest.mark.slow
def test_points_of_a_tolerance(load: Any, device: Device, tmp_path: Path) -> None:
    made = load("sheet.tolerance=0.02", *SMOOTH)
    record: Any = run(made, tmp_path / "out", threads=device.threads)
    assert 0.005 < (record["error_estimate"]["mesh_error"] or 0) <= 0.02
    assert record["scene"]["sheet"]["tolerance"] is None
    assert record["scene"]["sheet"]["points"] == record["points"]
    assert record["asked"]["sheet.tolerance"] == 0.02
    assert record["asked"]["sheet.points"] == made.sheet.points
    assert record["points"] == list(choose_points(plan_of(made), device, check_scene)[0].scene.sheet.points)
    assert record["points"] > [13, 15]
    with Simulation(made, threads=device.threads) as simulation:
        assert simulation.positions().shape[:2] == tuple(record["points"])


def test_points_of_a_tolerance_preserve_cells(load: Any, device: Device) -> None:
    oblong = ("sheet.points=[5, 13]", "sheet.size=[0.04, 0.12]", "sheet.tolerance=0.05", *SMOOTH)
    rows, cols = choose_points(plan_of(load(*oblong)), device, check_scene)[0].scene.sheet.points
    assert (cols - 1) / (rows - 1) == pytest.approx(3, rel=0.1)
    assert cols > 13


def test_impossible_tolerances(load: Any, device: Device, message: Messages) -> None:
    """One run shows that a tolerance is out of reach; a given step limits the number of mass points."""
    tried: list[tuple[int, int]] = []

    def check(scene: Scene, maps: Maps | None) -> Plan:
        tried.append(scene.sheet.points)
        return check_scene(scene, maps)

    with message.raises(SceneError, "sheet.tolerance: 1e-10 ", "no sheet", hide=r"0\.\d+(?=, )"):
        choose_points(plan_of(load("sheet.tolerance=1e-10", *SMOOTH)), device, check)
    assert tried == [(13, 15)]
    made = load("sheet.tolerance=0.001", f"time.step={0.1 / math.ceil(0.1 / plan_of(load()).stable_step)!r}")
    with message.raises(SceneError, "time.step: ", "sheet.tolerance: 0.001"):
        choose_points(plan_of(made), device, check_scene)


def test_wrinkles_make_the_estimate_a_lower_bound(load: Any, device: Device, message: Messages) -> None:
    """Without bending or tension, finer meshes under an in-plane load have more wrinkles."""
    pushed = ("tissue.foundation=1.0e5", "probes.0.total=[1.5, 0.3, -0.3]", "tissue.damping=400")
    message(mesh_estimate(load("sheet.points=[25, 25]", *pushed), device).doubt)
    stiff = ("tissue.bending=plate", "tissue.thickness=5.0e-3")
    assert not mesh_estimate(load("sheet.points=[25, 25]", *pushed, *stiff), device).doubt


# Records and warnings.


def test_record_of_tool_and_mesh(load: Any, device: Device, tmp_path: Path, message: Messages) -> None:
    record = run(load(), tmp_path / "out", threads=device.threads)
    (probe,) = record["probes"]
    assert probe is not None
    assert probe["total_force"] == pytest.approx(2, rel=0.05)
    # The flat end has the full pressure.
    area = math.pi * (0.01**2 + 2 * (0.01 / 100 + 1 / 100**2))
    assert probe["largest_pressure"] == pytest.approx(2 / area, rel=1e-6)
    message(record["notes"], ", mesh ", "for a smaller error of the mesh, ", hide=r"[\d.]+(?= %| mm| px)")
    message((line for line in run_summary(record, tmp_path).splitlines() if "probes.0: " in line), "1.27 kPa")


def test_warning_of_a_partial_tool(load: Any, message: Messages) -> None:
    """Most of the tool is outside the sheet, or between mass points."""

    def warnings(*overrides: str) -> list[str]:
        progress = RunProgress(1, 1.0)
        return [note for note in notes_of(load(*overrides), progress, None) if note.startswith("probes.0: ")]

    assert not warnings()
    message(warnings("probes.0.at=[1.9, 0.5]"))
    message(warnings("probes.0={total: [0, 0, 1], falloff: 5000}"))
    message(map(describe_forces, probe_records(load("probes.0.radius=5"))), hide=r"\d\.\d+")


def test_resumption_with_a_map(
    load: Any, tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """From another folder, and only with the same map."""
    monkeypatch.chdir(tmp_path)
    made = load(text=SCENE.replace("damping: 40", "damping: 40, map: {image: map.png, range: [1, 2]}"))
    made = made.model_copy(update={"output": ("trajectory",)})

    def stop(stage: str, done: int, _total: int) -> None:
        if stage == "frames" and done == 2:
            raise KeyboardInterrupt

    uninterrupted = run(made, "whole", threads=device.threads)
    assert run(made, "parts", threads=device.threads, progress=stop)["status"] == "interrupted"
    monkeypatch.chdir(tmp_path / "whole")
    Path("../map.png").rename("../away.png")
    with message.raises(SceneError, "tissue.map.image: "):
        resume("../parts", threads=device.threads)
    Image.new("L", (3, 3), 99).save("../map.png")
    with message.raises(FilesError, "map.png has changed"):
        resume("../parts", threads=device.threads)
    Path("../away.png").rename("../map.png")
    record = resume("../parts", threads=device.threads)
    assert record["status"] == "complete"
    assert record["scene"] == uninterrupted["scene"]
    assert record["error_estimate"] == uninterrupted["error_estimate"]
    assert results(tmp_path / "parts") == results(tmp_path / "whole")
