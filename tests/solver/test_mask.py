"""Sheets with a mask against the twin: motion, contact, equilibrium, limits of the step, and points without sheet."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import FilesError, resume, run
from taichi_msm.accuracy.surface import describe_surface
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.mask import Mask
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tool_force import control_point
from taichi_msm.model.tools import path_warnings
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet, SheetMask
from taichi_msm.scene.tools import Probe
from taichi_msm.solver import dynamics as dynamics_module
from taichi_msm.solver.arrays import SheetLayout
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import make_plan
from taichi_msm.solver.rest import QuasiStatics
from taichi_msm.solver.sheet_solver import choose_layout
from taichi_msm.system.runtime import Device
from taichi_msm.terms import highest_frequency
from taichi_msm.terms.contact_rest import touched_points
from taichi_msm.terms.elasticity import energy_density
from taichi_msm.terms.springs import assemble_springs
from tests import reference
from tests.outputs import results as outcomes
from tests.reference import surface
from tests.reference.loads import frame_loads
from tests.reference.mask import cell_counts, held_points, present_cells
from tests.reference.sheet import highest_frequency as twin_frequency
from tests.runs.test_resume import interrupted
from tests.scenes import random_tissue, speckle
from tests.solver.test_dynamics import as_on_a_gpu
from tests.solver.test_same_bits import states
from tests.solver.test_tissue_physics import frequency

# A missing corner, holes of which two meet at a point, a slit one cell wide, a notch at the left side, and two further
# parts, one of which reaches no side but the bottom. # is sheet.
CELLS = [
    "....##########",
    "##############",
    "##...#########",
    "##...#########",
    "#####..###.###",
    "##########.###",
    "##########.###",
    ".#########.###",
    "..############",
    "..............",
    "#####..#######",
    "#####..#######",
    "#####..#######",
]
POINTS, SIZE = [14, 15], [0.12, 0.14]
TISSUE = {"young": 2e4, "thickness": 0.002, "density": 1000, "foundation": 1e5, "damping": 30}
LOCK: Any = {"stiffening": {"lock": 0.3}, "foundation": {"young": 2e4, "depth": 0.2, "lock": 0.002}}
MAPS: Any = {
    "map": {"image": "map.png", "range": [0.7, 3]},
    "foundation_map": {"image": "map.png", "range": [0.2, 4]},
}
TUBE = {"tube": {"radius": 0.04, "folds": {"depth": 0.004, "spacing": 0.03}}}
LOADS: Any = [
    {"at": [0.45, 0.6], "total": -0.6, "radius": 0.01, "load": [[0, 0], [0.05, 100]]},
    {"at": [[0, 0.9, 0.2], [0.1, 0.85, 0.65]], "total": [0.1, 0.2, 0.3], "radius": 0.01, "load": [[0, 100]]},
    {"at": [0.1, 0.3], "total": [0.1, 0, 0.3], "radius": 0.02},
]
BALL: Any = {
    "path": [[0, 0.3, 0.3, 0.002], [0.04, 0.3, 0.3, -0.004], [0.1, 0.5, 0.5, -0.005]],
    "instrument": {"radius": 0.012, "shaft": [0.3, 0, 1], "length": 0.03},
}
CLAMP: Any = {"clamp": "right", "path": [[0, 0, 0, 0], [0.06, 0.003, 0.002, -0.004]]}
OUTLINE: Any = {"fixed": ["outline"]}

CASES: dict[str, Any] = {
    "loads": {"probes": LOADS},
    "locking": {"tissue": LOCK, "probes": LOADS},
    "maps": {"tissue": {**LOCK, **MAPS}, "probes": LOADS[1:]},
    "no foundation": {"tissue": {"foundation": 0, "damping": 0}, "fixed": "corners", "probes": LOADS},
    "tense, maps, relaxing": {
        **OUTLINE,
        "tissue": {
            "pretension": 3, **MAPS, "foundation_active": "always", "relaxation": [{"share": 0.4, "time": 0.05}]
        },
        "probes": LOADS,
    },
    "bending": {**OUTLINE, "tissue": {"bending": 1e-3}, "probes": LOADS},
    "tense plate": {"fixed": ["left", "outline"], "tissue": {"bending": "plate", "pretension": 2}, "probes": [BALL]},
    "ball": {"probes": [BALL, LOADS[1]]},
    "friction": {"probes": [{**BALL, "friction": 0.4}, LOADS[1]]},
    "grip": {"probes": [{**BALL, "grip": [[0.05, 0.2]]}]},
    "clamp": {
        "tissue": {"relaxation": [{"share": 0.3, "time": 0.1}], "foundation_active": "always"},
        "probes": [CLAMP, BALL],
    },
    "tube": {"surface": TUBE, "probes": [{**BALL, "friction": 0.4}, *LOADS]},
    "tube, ball": {"surface": TUBE, "probes": [BALL]},
    "dome, tense, locking": {
        **OUTLINE,
        "surface": {"dome": {"radius": 0.1}},
        "tissue": {**LOCK, "pretension": 3, "map": MAPS["map"]},
        "probes": LOADS,
    },
}  # fmt: skip

# Each case has other terms, and therefore other kernels.
DEFAULT = pytest.mark.default_cases("loads", "tense, maps, relaxing", "tense plate", "tube")


@pytest.fixture(autouse=True)
def pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_mask(CELLS)
    Image.fromarray(speckle(7, 9)[..., 0]).save("map.png")


def write_mask(cells: list[str]) -> None:
    """Write mask.png with one pixel per cell; # is white."""
    Image.fromarray(np.array([[255 * (pixel == "#") for pixel in row] for row in cells], np.uint8)).save("mask.png")


def scene_of(case: str, sheet: Any = None, **time: Any) -> Scene:
    """Scene of a case, free except on the left."""
    keys = CASES[case]
    own = {"points": POINTS, "size": SIZE, "fixed": keys.get("fixed", ["left"]), "mask": {"image": "mask.png"}}
    return Scene(
        output=[],
        sheet={**own, "surface": keys.get("surface"), **(sheet or {})},
        tissue={**TISSUE, **keys.get("tissue", {})},
        probes=keys["probes"],
        time={"duration": 0.1, "frames_per_second": 50, "precision": "f64", **time},
    )


def frames(scene: Scene, device: Device, layout: SheetLayout | None = None) -> NDArray[Any]:
    plan = make_plan(scene)
    dynamics, displacements = Dynamics(plan, device, layout), []
    for _ in range(plan.grid.frames):
        dynamics.advance(plan.grid.steps_per_frame)
        displacements.append(dynamics.displacement())
    return np.array(displacements)


@DEFAULT
@pytest.mark.parametrize("case", CASES)
def test_motion_matches_twin(case: str, device: Device) -> None:
    scene = scene_of(case)
    plan = make_plan(scene)
    twin = [u for u, _ in reference.steps(plan)]
    expected = np.array(twin[plan.grid.steps_per_frame :: plan.grid.steps_per_frame])
    assert np.abs(expected).max() > 1e-3
    # A rounding per step, amplified by the number of steps.
    atol = 1e-13 * np.abs(expected).max() * plan.grid.steps
    np.testing.assert_allclose(frames(scene, device), expected, rtol=0, atol=atol)


@pytest.mark.parametrize("case", CASES)
def test_material_matches_twin(case: str) -> None:
    """Also of curved sheets, whose numbers are those of the cells that are sheet."""
    scene = scene_of(case)
    plan, twin = make_plan(scene), reference.sheet(scene)
    np.testing.assert_array_equal(rest_of(scene.sheet).present, present_cells(scene.sheet))
    np.testing.assert_array_equal(plan.fixed, held_points(scene.sheet))
    np.testing.assert_allclose(plan.material.mass * plan.area_shares, twin.mass, rtol=1e-12, atol=0)
    springs = assemble_springs(plan.material, scene.sheet)
    for k, tau, own in zip(springs.stiffness, springs.tension, twin.springs, strict=True):
        np.testing.assert_allclose(k, own.stiffness, rtol=1e-12, atol=0)
        pull = own.stiffness * (own.length - own.unstretched) / own.length
        np.testing.assert_allclose(tau, pull, rtol=0, atol=1e-12 * own.stiffness.max())
    if not plan.material.bending:
        frequency = highest_frequency(plan.material, scene.sheet)
        assert frequency == pytest.approx(twin_frequency(scene), rel=1e-12)
    rest, cells, present = rest_of(scene.sheet), surface.cells(twin.rest), present_cells(scene.sheet)
    sides = [own.length[own.stiffness > 0] for own in twin.springs[:2]] if twin.is_curved else []
    if isinstance(rest, CurvedRest):
        assert rest.shortest_side == pytest.approx(min(each.min() for each in sides), rel=1e-12)
        assert rest.longest_side == pytest.approx(max(each.max() for each in sides), rel=1e-12)
        means = [np.linalg.norm(side[present], axis=-1).mean() for side in (cells.a, cells.b)]
        assert rest.cell_sides == pytest.approx(means, rel=1e-12)
        np.testing.assert_allclose(rest.areas, twin.area, rtol=1e-12, atol=0)
        expected = surface.isotropy_error(cells) * present
        np.testing.assert_allclose(rest.isotropy_errors, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_pixels_match_twin(dtype: type) -> None:
    """Pictures of fewer and of more pixels than cells."""
    for size in ((5, 7), (13, 40), (26, 28)):
        grey = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, size, dtype=dtype, endpoint=True)
        Image.fromarray(grey).save("mask.png")
        for invert in (False, True):
            sheet = scene_of("loads", {"mask": {"image": "mask.png", "invert": invert}}).sheet
            np.testing.assert_array_equal(rest_of(sheet).present, present_cells(sheet))


def test_parts_that_meet_at_a_point() -> None:
    """Two holes may meet at one, and parts that hang together elsewhere."""
    falling, rising = np.eye(2, dtype=bool), np.eye(2, dtype=bool)[::-1]
    ring = ~np.pad(falling, 1)
    assert [list(Mask(cells).pinched_points()) for cells in (falling, rising, ring)] == [[(1, 1)], [(1, 1)], []]


@pytest.mark.parametrize("place", [(0.01, 0.0, 0.05), (1.0, 2.0, 3.0)])
def test_places_of_points_without_sheet_do_not_matter(place: Any, device: Device) -> None:
    """They make cells without area, or long ones, next to the path of a ball."""
    shape = surface.rest_positions({"dome": {"radius": 0.1}}, (14, 15), (0.12, 0.14))
    ball = Probe(**{**BALL, "path": [[0, 0.39, 0.19, 0.001], [0.1, 0.39, 0.19, -0.004]]})
    results = []
    for absent in (shape, np.array(place)):
        count = cell_counts(present_cells(scene_of("loads").sheet))[..., None]
        np.save("points.npy", np.where(count > 0, shape, absent))
        keys = {"points": POINTS, "surface": {"points": {"file": "points.npy", "unit": "m"}}, "mask": "mask.png"}
        scene = scene_of("dome, tense, locking")
        sheet, probes = Sheet(**keys, fixed=["outline"]), (scene.probes[0], ball)
        scene = scene.model_copy(update={"sheet": sheet, "probes": probes})
        plan, displacements = make_plan(scene), frames(scene, device)
        texts = [*describe_surface(plan), *path_warnings(scene, plan.tools)]
        density = energy_density(plan, displacements[-1])
        results.append((plan.stable_step, displacements.tobytes(), density.tobytes(), texts))
    assert results[0] == results[1]


@DEFAULT
@pytest.mark.parametrize("case", CASES)
def test_energy_and_strains_match_twin(case: str, device: Device) -> None:
    """Springs without stiffness have no strain."""
    scene = scene_of(case)
    plan, twin = make_plan(scene), reference.sheet(scene)
    dynamics = Dynamics(plan, device)
    dynamics.advance(3 * plan.grid.steps_per_frame)
    reading, difference = dynamics.read(), dynamics.state().difference
    kinetic = float((twin.mass[..., None] * difference**2).sum()) / plan.grid.step**2 / 2
    elastic = reference.energy(scene, reading.displacement)
    assert reading.energy == pytest.approx(kinetic + elastic, rel=1e-10)
    for value, of in ((reading.shortest_spring, "shortest_spring"), (reading.longest_spring, "longest_spring")):
        assert value == pytest.approx(getattr(reference, of)(scene, reading.displacement), rel=1e-12)
    # The density times the area is the energy, which is relative to the state at rest.
    density, areas = energy_density(plan, reading.displacement), plan.area_shares * rest_of(scene.sheet).cell_area
    bent = 0.0
    if plan.material.bending:
        bent = elastic - reference.energy(scene, reading.displacement, twin._replace(bending=0.0))
    assert (density * areas).sum() == pytest.approx(elastic - bent, rel=1e-10)
    assert not density[plan.area_shares == 0].any()


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("case", ["tense, maps, relaxing", "tube"])
def test_points_without_sheet_stay(case: str, precision: str, device: Device) -> None:
    scene = scene_of(case, precision=precision)
    plan, absent = make_plan(scene), cell_counts(present_cells(scene.sheet)) == 0
    dynamics = Dynamics(plan, device)
    for _ in range(plan.grid.frames):
        dynamics.advance(plan.grid.steps_per_frame)
        reading, state = dynamics.read(), dynamics.state()
        assert not reading.displacement[absent].any()
        assert not state.difference[absent].any()
        assert np.isfinite(reading.displacement).all()
        assert np.isfinite([reading.energy, reading.shortest_spring, reading.longest_spring]).all()
        assert np.isfinite(dynamics.tool_forces()).all()
        assert np.isfinite(state.memory).all()
    assert reading.energy > 0


@pytest.mark.default_cases("tense, maps, relaxing")
@pytest.mark.parametrize("case", CASES)
def test_bits_are_those_of_bands_passes_gathering_and_restarts(case: str, device: Device) -> None:
    scene = scene_of(case)
    layout = choose_layout(make_plan(scene), device)
    # With bending a pass takes one step.
    depth = 3 if layout.config.reach == 1 else 1
    expected = states(scene, device, layout)
    assert states(scene, device, replace(layout, workers=2, depth=depth), restarts=True) == expected
    assert states(scene, device, as_on_a_gpu(layout), restarts=True) == expected


@pytest.mark.default_cases("tense plate")
@pytest.mark.parametrize("case", ["maps", "bending", "tense plate", "ball", "tube, ball", "dome, tense, locking"])
def test_equilibrium_has_no_force(case: str, device: Device) -> None:
    scene = scene_of(case, motion="quasistatic")
    rest = QuasiStatics(make_plan(scene), device)
    rest.advance(5)
    u = rest.displacement()
    assert np.abs(u).max() > 1e-3
    assert not u[cell_counts(present_cells(scene.sheet)) == 0].any()
    free = ~rest.plan.fixed & ~touched_points(len(rest.plan.tools), rest.state().memory).any(axis=0)
    # The criterion is 1e-7 of the largest force of a spring.
    assert reference.residual(scene, u, frame_loads(rest.plan, 5), free) < 2e-7


# The largest ratio of the bound to the highest frequency; with maps it is larger.
RATIOS = {"loads": 1.25, "bending": 1.25, "tense plate": 1.25, "tube": 1.25, "maps": 1.25, "dome, tense, locking": 1.6}


@pytest.mark.parametrize("case", RATIOS)
def test_bound_of_frequencies(case: str) -> None:
    """The highest frequency of the twin's free points is below the bound, and near it; without laws."""
    scene = scene_of(case)
    assert scene.tissue is not None
    linear = scene.tissue.model_copy(update={"stiffening": None, "foundation": 1e5})
    scene = scene.model_copy(update={"tissue": linear})
    true, bound = frequency(scene), highest_frequency(make_plan(scene).material, scene.sheet)
    assert true < bound < RATIOS[case] * true


@pytest.mark.parametrize("fixed", ["outline", "none"])
def test_rectangle_of_a_mask_is_a_smaller_sheet(fixed: str, device: Device) -> None:
    """Five rows and six columns of cells in the middle; loads and tools are at the same places."""
    write_mask(["." * 14] * 3 + ["....######...."] * 5 + ["." * 14] * 5)
    place = {"at": [0.5, 0.5], "total": [0.1, 0, -0.3], "radius": 0.01}
    ball = {"path": [[0, 0.5, 0.5, 0], [0.1, 0.5, 0.5, -0.004]], "instrument": BALL["instrument"]}
    at = (0.5 * 14 - 4) / 6, (0.5 * 13 - 3) / 5
    moved = {**place, "at": at}, {**ball, "path": [[t, *at, z] for t, _, _, z in ball["path"]]}
    masked = {"points": POINTS, "size": SIZE, "mask": {"image": "mask.png"}, "fixed": fixed}
    whole = {"points": [6, 7], "size": [5 * SIZE[0] / 13, 0.06], "fixed": "border" if fixed == "outline" else "none"}
    time = {"duration": 0.1, "frames_per_second": 50, "precision": "f64"}
    large, small = (
        Scene(output=[], sheet=sheet, tissue={**TISSUE, **LOCK}, probes=probes, time=time)
        for sheet, probes in ((masked, (place, ball)), (whole, moved))
    )
    assert make_plan(large).is_held == make_plan(small).is_held == (fixed == "outline")
    assert make_plan(large).stable_step == pytest.approx(make_plan(small).stable_step, rel=1e-12)
    u = frames(small, device)
    assert np.abs(u).max() > 1e-3
    np.testing.assert_allclose(frames(large, device)[:, 3:9, 4:11], u, rtol=0, atol=1e-12 * np.abs(u).max())


def random_cells(seed: int, scene: Scene) -> NDArray[np.bool_]:
    """Two thirds of the cells at random, and those under force-controlled tools.

    Of two parts that meet at a point, one cell more is sheet.
    """
    rows, cols = (count - 1 for count in scene.sheet.points)
    cells = np.random.default_rng(seed).random((rows, cols)) < 2 / 3
    for probe, time in product(scene.probes, np.linspace(0, scene.time.duration, 400)):
        if not probe.moved:
            across, down = rest_of(scene.sheet).fractions(control_point(probe, scene.sheet, time))
            cells[int(down * rows), int(across * cols)] = True
    while pinched := next(Mask(cells).pinched_points(), None):
        cells[pinched[0] - 1, pinched[1]] = cells[pinched] = True
    return cells


@pytest.mark.default_cases("0")
@pytest.mark.parametrize("seed", range(24))
def test_random_masks_match_twin(seed: int, device: Device) -> None:
    """Tissues of `random_tissue`, whose sides are free or fixed, with a border fixed as an outline."""
    made = random_tissue(seed, "map.png")
    write_mask(["".join("#" if cell else "." for cell in row) for row in random_cells(seed, made)])
    fixed = "outline" if made.sheet.fixed == "border" else made.sheet.fixed
    sheet = made.sheet.model_copy(update={"mask": SheetMask(image="mask.png"), "fixed": fixed})
    made = made.model_copy(update={"sheet": sheet})
    plan = make_plan(made)
    twin = [u for u, _ in reference.steps(plan)]
    expected = np.array(twin[plan.grid.steps_per_frame :: plan.grid.steps_per_frame])
    atol = 1e-12 * np.abs(expected).max()
    np.testing.assert_allclose(frames(made, device), expected, rtol=0, atol=atol)
    layout = choose_layout(plan, device)
    gathered = replace(layout, workers=0, config=replace(layout.config, lanes=1))
    np.testing.assert_allclose(frames(made, device, gathered), expected, rtol=0, atol=atol)


@pytest.mark.slow
def test_interrupted_run_with_a_mask(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It resumes with the bits of an uninterrupted one, and restarts with another mask."""
    monkeypatch.setattr(dynamics_module, "MAX_STEPS_PER_LAUNCH", 300)
    time = {"frames_per_second": 100, "step": 1e-5}
    made = scene_of("tense, maps, relaxing", **time).model_copy(update={"output": ("trajectory",)})
    run(made, "whole", threads=device.threads, estimate_error=False)
    with np.load("whole/trajectory.npz") as whole:
        absent = cell_counts(present_cells(made.sheet)) == 0
        assert (whole["position"][:, absent] == whole["position"][0, absent]).all()
    interrupted(made, "parts", device)
    assert resume("parts", threads=device.threads)["resumed"] > 0
    assert outcomes(tmp_path / "parts") == outcomes(tmp_path / "whole")
    interrupted(made, "parts", device)
    write_mask(["#" * 14] * 13)
    with pytest.raises(FilesError, match="mask"):
        resume("parts", threads=device.threads)
    # As another process reads the file.
    made = scene_of("tense, maps, relaxing", **time).model_copy(update={"output": ("trajectory",)})
    assert run(made, "parts", threads=device.threads, estimate_error=False)["resumed"] == 0
