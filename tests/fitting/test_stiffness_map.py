"""Stiffness maps from observed points: recovery with errors, smoothness, files, refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import SceneError, fit, load_scene
from taichi_msm.accuracy.mesh import estimate_mesh_error
from taichi_msm.fitting.archive import KINDS, read_observations
from taichi_msm.fitting.points import PointModel, Positions
from taichi_msm.fitting.predict import without_outputs
from taichi_msm.fitting.result import FittedMap
from taichi_msm.fitting.stiffness_map import map_notes
from taichi_msm.fitting.tikhonov import MapGrid, MapSearch, MapSolution, SmoothnessWeight
from taichi_msm.gradients.gradient import Adjoint
from taichi_msm.load.check import check_scene
from taichi_msm.model.sheet import read_map
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages

Array = NDArray[np.float64]

GRID = np.linspace(0.03, 0.97, 12)
PLACES = np.stack([axis.ravel() for axis in np.meshgrid(GRID, GRID)], axis=1)

# A stiff cell among soft ones.
TRUTH = np.ones((4, 4))
TRUTH[1, 2] = 2.0


def scene(**sections: Any) -> Scene:
    """Two tools pull across, then down; the sheet is in equilibrium in each of two frames."""
    pulls = [
        {"at": at, "total": total, "load": load, "radius": 0.01, "falloff": 100}
        for at in ([0.35, 0.6], [0.7, 0.35])
        for total, load in (([0.5, 0, 0], [[0, 0], [1, 100], [2, 0]]), ([0, 0.5, 0], [[0, 0], [1, 0], [2, 100]]))
    ]
    data = {
        "sheet": {"points": [9, 9], "size": [0.1, 0.1], "fixed": "border"},
        "tissue": {"young": 2e4, "thickness": 3e-3, "foundation": 5e4, "foundation_active": "always", "pretension": 5},
        "probes": pulls,
        "time": {"duration": 2, "frames_per_second": 1, "motion": "quasistatic", "precision": "f64"},
        "render": {"camera": {"eye": [0, -0.06, 0.09]}},
        "output": [],
    }
    return Scene.model_validate(data | sections)


def data_of(made: Scene) -> dict[str, Any]:
    return made.model_dump(mode="json", exclude_none=True)


TISSUE, PROBES = data_of(scene())["tissue"], data_of(scene())["probes"]


def swinging() -> Scene:
    """The same tools on a sheet in motion."""
    time = {"duration": 0.2, "frames_per_second": 25, "precision": "f64"}
    moving = [probe | {"load": [[0, 0], [0.1, 100], [0.2, 0]]} for probe in PROBES]
    return scene(time=time, tissue=TISSUE | {"density": 1050, "damping": 50}, probes=moving)


def observe(truth: Scene, device: Device, factors: Array, times: Any = (1.0, 2.0), error: float = 1e-5) -> Any:
    """Positions of PLACES in a scene with a map, with errors of a standard deviation [m]."""
    times = np.array(times)
    position = Adjoint(check_scene(truth), device).run(MapGrid(len(factors), (8, 8)).factors(np.log(factors).ravel()))
    empty = Positions("", times, np.zeros((len(PLACES), len(times), 3)), None, PLACES)
    points = PointModel(truth, empty, len(position)).points(position)
    noise = np.random.default_rng(1).normal(0, error, points.shape)
    return {"time": times, "coordinates": PLACES, "position": points + noise, "sigma": error}


def fit_map(start: Scene, observed: Any, resolution: int = 4, **options: Any) -> Any:
    return fit(start, observed, ["tissue.map"], resolution=resolution, **options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fit")


@pytest.fixture(scope="module")
def result(device: Device, folder: Path) -> Any:
    """The map estimated from errors of 10 um, with its files."""
    # Without a mesh error, which would dominate these.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("taichi_msm.fitting.stiffness_map.coarser_plan", lambda plan: None)
        return fit_map(scene(), observe(scene(), device, TRUTH), directory=folder)


def test_recovery_within_errors(result: Any, message: Messages) -> None:
    assert result.identifiable
    deviations = np.log(result.map.factors / TRUTH) / result.map.errors
    # Chi-square of 16 numbers is below 3.9, or above 39, once in a thousand times each.
    assert np.abs(deviations).max() < 4
    assert 3.9 < (deviations**2).sum() < 39
    assert result.map.factors.argmax() == TRUTH.argmax()
    assert np.median(result.map.errors) < 0.05
    assert result.chi_square == pytest.approx(result.degrees_of_freedom, rel=0.15)
    assert not result.model_rejected
    message(result.summary(), "4 x 4 cells", hide=r"\d[\d.e+-]*(?! x|\d* cells)")


def test_notes_of_a_map(message: Messages) -> None:
    """With an unknown cell, two cells at bounds, and a large mesh error, and residuals that the map cannot explain."""
    observed = Positions("", np.ones(1), np.zeros((4, 1, 3)), 1e-5, np.zeros((4, 2)))
    none, limits = np.zeros(0), (-2.0, 2.0)
    choice = SmoothnessWeight(1.0, none, none, none, none)
    x, errors = np.array([-2.0, 0, 1, 2]), np.array([0.1, np.nan, 0.2, 0.3])
    fitted = FittedMap(np.exp(x).reshape(2, 2), errors.reshape(2, 2), choice, 1e-5)
    for excess, residual in ((1.0, 2e-6), (4.0, 2e-5)):
        solution = MapSolution(x, errors, excess, choice)
        message(map_notes(observed, solution, fitted, 2e-5, limits, np.full(12, residual)), "--bounds", "sheet.points")


@pytest.mark.slow
def test_recovery_with_a_common_factor_of_the_forces(device: Device, message: Messages) -> None:
    """From forces that are 30 % too small, which would make the tissue too soft on its foundation."""
    observed = observe(scene(), device, TRUTH, error=3e-6)
    weaker, key = (
        scene(probes=[probe | {"total": [0.7 * f for f in probe["total"]]} for probe in PROBES]),
        "probes.0.total.0",
    )
    free: Any = fit(weaker, observed, ["tissue.map", key], resolution=4)
    force = free.parameters[key]
    assert abs(force.value - 0.5) < 4 * force.standard_error < 0.1
    assert force.interval[0] < force.value < force.interval[1]
    assert [max(probe.total) for probe in free.scene.probes] == pytest.approx([force.value] * 4)
    assert np.abs(np.log(free.map.factors / TRUTH) / free.map.errors).max() < 4
    assert not free.model_rejected
    message(free.summary()[0], key, hide=r"\d[\d.]{2,}")
    fixed = fit_map(weaker, observed)
    assert fixed.model_rejected
    message(fixed.summary()[0], "the model is rejected: chi-square ", hide=r"\d[\d.]*")


def test_recovery_in_motion(device: Device) -> None:
    factors = np.array([[1.0, 1.5], [0.7, 1.0]])
    observed = observe(swinging(), device, factors, np.arange(1, 6) / 25, 1e-6)
    fitted = fit_map(swinging(), observed, 2, bounds={"tissue.map": (0.3, 3)}).map
    np.testing.assert_allclose(fitted.factors, factors, rtol=0.02)


def test_files(result: Any, folder: Path) -> None:
    written: Any = load_scene(folder / "scene.yaml")
    low, high = result.map.range
    assert written.tissue.map.range == pytest.approx((low, high), rel=1e-12)
    factors: Any = check_scene(written).material.factors
    expected = MapGrid(4, (8, 8)).factors(np.log(result.map.factors).ravel())
    np.testing.assert_allclose(factors, expected, atol=(high - low) / 65535)
    assert read_map(written.tissue.map).grey.dtype == np.uint16
    errors = np.asarray(Image.open(folder / "map-error.png"), np.float64) / 65535
    np.testing.assert_allclose(errors, result.map.errors, atol=1 / 65535)
    record = json.loads((folder / "fit.json").read_text())
    assert record["map"]["factors"] == result.map.factors.tolist()
    assert {"map.png", "map-error.png", "fit.png", "scene.yaml"} <= set(record["files"])


@pytest.mark.slow
def test_smoothness_by_the_errors(device: Device, message: Messages) -> None:
    """Large errors explain even tissue, but not a stiff cell."""
    spreads = []
    for factors in (TRUTH, np.ones((4, 4))):
        observed = observe(scene(), device, factors, error=1e-4)
        fitted = fit_map(scene(), observed).map
        deviations = (np.log(fitted.factors / factors) / fitted.errors)[~fitted.unknown]
        assert np.sqrt((deviations**2).mean()) < 1.6
        spreads.append(np.log(fitted.factors).std())
    # The even tissue is as even as the largest weight makes it.
    assert 100 * spreads[1] < spreads[0]
    (note,) = (note for note in fit_map(scene(), observed, sigma=4e-4).notes if "residual" in note)
    message(note, "0.25 times sigma")


@pytest.mark.slow
def test_cells_without_motion_are_unknown(device: Device, tmp_path: Path) -> None:
    # On this foundation, a pull decays as exp(-distance / 5 mm).
    local = scene(tissue=TISSUE | {"foundation": 2.4e6}, probes=[probe | {"at": [0.2, 0.5]} for probe in PROBES[:2]])
    observed = observe(local, device, np.ones((4, 4)), error=1e-6)
    fitted = fit_map(local, observed, directory=tmp_path).map
    assert fitted.unknown[:, 3].all()
    assert not fitted.unknown[1:3, 0].any()
    assert (np.asarray(Image.open(tmp_path / "map-error.png"))[:, 3] == 65535).all()


@pytest.mark.slow
def test_pictures_with_the_name_of_the_map_are_kept(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, grey in (("map.png", 100), ("other/map.png", 200)):
        Path(name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.full((8, 8), grey, np.uint8)).save(name)
    tissue = TISSUE | {"foundation_map": {"image": "map.png", "range": [0.9, 1.1]}}
    observed = observe(scene(tissue=tissue), device, np.ones((2, 2)))
    start = scene(tissue=tissue | {"map": {"image": "other/map.png", "range": [1, 2]}}, image="map.png")
    result = fit_map(start, observed, 2, directory="out")
    written: Any = load_scene("out/scene.yaml")
    for fitted in (written, result.scene):
        assert fitted.tissue.foundation_map
        assert fitted.tissue.map.image == str(Path("out/map.png"))
    assert written.image == str(Path("out/pictures/map.png"))
    assert Path("out/pictures/map.png").read_bytes() == Path("map.png").read_bytes()
    assert np.asarray(Image.open("out/map.png")).shape == (2, 2)


@pytest.mark.slow
def test_mesh_error_is_that_of_the_fitted_map(result: Any, folder: Path, device: Device) -> None:
    fitted, even = (
        estimate_mesh_error(check_scene(without_outputs(made)), device, lambda done, total: None).error
        for made in (load_scene(folder / "scene.yaml"), scene())
    )
    assert result.mesh_error == pytest.approx(fitted, rel=1e-6)
    assert result.mesh_error != pytest.approx(even, rel=1e-2)


@pytest.mark.parametrize(("kind", "made"), [("pixel", scene()), ("position", swinging())], ids=["rest", "motion"])
def test_gradient_of_the_misfit(device: Device, kind: Any, made: Scene) -> None:
    """By the cells, and by the factor of the forces, against central differences."""
    observed = read_observations(observe(made, device, TRUTH, [0.7, 2.0] if kind == "pixel" else [0.08, 0.16], 1e-4), 1)
    observed = KINDS[kind]("", observed.time, observed.values[..., : 3 if kind == "position" else 2], 1e-4, PLACES)
    plan, limits = check_scene(made), (-2.0, 2.0)
    model, grid = PointModel(plan.scene, observed, plan.grid.frames + 1), MapGrid(4, (8, 8))
    search = MapSearch(Adjoint(plan, device), model, observed, 1.0, grid, limits, lambda: None, force_limits=limits)
    x, change = np.random.default_rng(0).normal(0, 0.2, (2, 17))
    for direction in (change, 0.2 * np.eye(17)[16]):
        after, before = (search.misfit(x + sign * 1e-3 * direction)[0] for sign in (1, -1))
        # Equilibria are solved to 1e-6, and the second difference is 1e-6 of the first.
        assert (after - before) / 2e-3 == pytest.approx(search.misfit(x)[1] @ direction, rel=1e-3)


def test_bounds_below_the_pretension(device: Device, message: Messages) -> None:
    # Pretension shortens springs by 0.3 at a factor of 1.
    taut = scene(tissue=TISSUE | {"pretension": 0.3 * 1.5 * 2e4 * 3e-3})
    observed = observe(taut, device, np.ones((2, 2)))
    for bounds in ((0.05, 0.2), (0.1, 1e300)):
        with message.raises(SceneError, "--bounds tissue.map="):
            fit_map(taut, observed, 2, bounds={"tissue.map": bounds})
    fitted = fit_map(taut, observed, 2, bounds={"tissue.map": (0.05, 2)}).map
    assert np.abs(np.log(fitted.factors)).max() < 4 * fitted.errors.max()


def test_steps_too_long_for_the_largest_factor(device: Device, message: Messages) -> None:
    made = swinging()
    made = made.model_copy(update={"time": made.time.model_copy(update={"step": check_scene(made).grid.step})})
    with message.raises(SceneError, "time.step", "--bounds", hide=r"\d[\d.e-]*(?= s)"):
        fit_map(made, {"time": [0.1], "coordinates": PLACES, "position": np.zeros((144, 1, 3)), "sigma": 1e-5})


def test_points_behind_the_camera_with_some_maps(device: Device, message: Messages) -> None:
    low = scene(render={"camera": {"eye": [0, -0.02, 0.01], "target": [0, 0.05, 0]}})
    pixel = np.arange(2.0 * len(PLACES)).reshape(-1, 1, 2)
    observed = read_observations({"time": [1.0], "coordinates": PLACES, "pixel": pixel, "sigma": 1.0}, 1)
    model, adjoint = PointModel(low, observed, 3), Adjoint(check_scene(low), device)
    search = MapSearch(adjoint, model, observed, 1.0, MapGrid(2, (8, 8)), (-2, 2), lambda: None)
    with message.raises(SceneError, "behind the eye"):
        search.predict(np.zeros(4))


@pytest.mark.parametrize(
    "options",
    [
        "tissue.young --resolution 4",
        "tissue.map",
        "tissue.map tissue.young --resolution 4",
        "tissue.map --resolution 9",
        "tissue.map --resolution 4",
        "tissue.map --resolution 8 --sigma 1e-5",
        "tissue.map --resolution 4 --profile",
        "tissue.map --resolution 4 --bounds tissue.map=2,1",
        "tissue.map --resolution 4 --bounds tissue.young=1e4,3e4",
        "tissue.foundation_map",
    ],
)
def test_invalid_options(
    options: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: Program, message: Messages
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(json.dumps(data_of(scene())))
    rest = np.array([[[-0.02, 0, 0]], [[0.02, 0, 0]]])
    np.savez("points.npz", time=[1.0], coordinates=[[0.3, 0.5], [0.7, 0.5]], position=rest)
    done = program("fit", "scene.yaml", "points.npz", "--free", *options.split())
    assert done.returncode == 2
    message(done.stderr)
    assert len(done.stderr.splitlines()) == 1


def test_springs_contact_and_large_maps_are_refused(
    device: Device, message: Messages, monkeypatch: pytest.MonkeyPatch
) -> None:
    observed = observe(scene(), device, TRUTH, [1.0])
    springs = {**data_of(scene()), "springs": {"structural": 20}, "probes": []}
    del springs["tissue"]
    instrument = {"radius": 0.006, "shaft": [0, 0, 1], "length": 0.1}
    path = [[0, 0.5, 0.5, 0.001], [2, 0.5, 0.5, -0.003]]
    for made in (Scene.model_validate(springs), scene(probes=[{"path": path, "instrument": instrument}])):
        with message.raises(SceneError):
            fit_map(made, observed)
    monkeypatch.setattr("taichi_msm.fitting.stiffness_map.available_memory", lambda: 1000)
    with message.raises(SceneError, "--resolution 4: "):
        fit_map(scene(), observed)
