"""A map of stiffness from what was seen: it comes back, as well known as is said, and is written as it was found."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path
from time import sleep
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
from taichi_msm.fitting.tikhonov import MapGrid, MapSearch
from taichi_msm.gradients.gradient import Adjoint
from taichi_msm.load.check import check_scene
from taichi_msm.model.sheet import read_map
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.reporting_process import ReportingProcess

Array = NDArray[np.float64]

GRID = np.linspace(0.03, 0.97, 12)
PLACES = np.stack([axis.ravel() for axis in np.meshgrid(GRID, GRID)], axis=1)

# A stiff field in soft ones.
TRUTH = np.ones((4, 4))
TRUTH[1, 2] = 2.0


def scene(**more: Any) -> Scene:
    """Two tools pull across, then down; the sheet is at rest in each of two pictures."""
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
    return Scene.model_validate(data | more)


def swinging() -> Scene:
    """The same tools on a sheet in motion."""
    data = scene().model_dump(mode="json", exclude_none=True)
    time = {"duration": 0.2, "frames_per_second": 25, "precision": "f64"}
    moving = [one | {"load": [[0, 0], [0.1, 100], [0.2, 0]]} for one in data["probes"]]
    return scene(time=time, tissue=data["tissue"] | {"density": 1050, "damping": 50}, probes=moving)


def seen_in(truth: Scene, device: Device, factors: Array, times: Array, error: float) -> dict[str, Any]:
    """Positions of the places in a scene with a map, with errors of that standard deviation [m]."""
    plan = check_scene(truth)
    position = Adjoint(plan, device).run(MapGrid(len(factors), (8, 8)).factors(np.log(factors).ravel()))
    empty = Positions("", times, np.zeros((len(PLACES), len(times), 3)), None, PLACES)
    points = PointModel(truth, empty, len(position)).points(position)
    noise = np.random.default_rng(1).normal(0, error, points.shape)
    return {"time": times, "coordinates": PLACES, "position": points + noise, "sigma": error}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fit")


@pytest.fixture(scope="module")
def result(device: Device, folder: Path) -> Any:
    """The map that is found from errors of 10 um, with its files."""
    observed = seen_in(scene(), device, TRUTH, np.array([1.0, 2.0]), 1e-5)
    # Half the cells a side would say little of these.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("taichi_msm.fitting.stiffness_map.coarser_plan", lambda plan: None)
        return fit(scene(), observed, ["tissue.map"], resolution=4, directory=folder)


def test_the_map_comes_back_as_well_known_as_is_said(result: Any) -> None:
    assert result.identifiable
    off = np.log(result.map.factors / TRUTH) / result.map.errors
    # Chi-square of 16 numbers is below 3.9, or above 39, once in a thousand times each.
    assert np.abs(off).max() < 4
    assert 3.9 < (off**2).sum() < 39
    assert result.map.factors.argmax() == TRUTH.argmax()
    assert np.median(result.map.errors) < 0.05
    assert result.chi_square == pytest.approx(result.degrees_of_freedom, rel=0.15)
    assert not result.model_rejected


@pytest.mark.slow
def test_a_common_factor_of_the_forces_comes_back_with_the_map(device: Device, message: Messages) -> None:
    """From forces that are 30 % too small, which would make the tissue too soft on its foundation."""
    observed = seen_in(scene(), device, TRUTH, np.array([1.0, 2.0]), 3e-6)
    quieter = [one | {"total": [0.7 * each for each in one["total"]]} for one in scene().model_dump()["probes"]]
    key = "probes.0.total.0"
    found: Any = fit(scene(probes=quieter), observed, ["tissue.map", key], resolution=4)
    force = found.parameters[key]
    assert abs(force.value - 0.5) < 4 * force.standard_error < 0.1
    assert force.interval[0] < force.value < force.interval[1]
    assert [max(probe.total) for probe in found.scene.probes if probe.total] == pytest.approx([force.value] * 4)
    assert np.abs(np.log(found.map.factors / TRUTH) / found.map.errors).max() < 4
    assert not found.model_rejected
    assert found.summary()[0].startswith(f"{key}: ")
    wrong = fit(scene(probes=quieter), observed, ["tissue.map"], resolution=4)
    assert wrong.model_rejected
    message(wrong.summary()[0], "the model is rejected: chi-square ", hide=r"\d[\d.]*")


def test_the_files_give_what_was_fitted(result: Any, folder: Path) -> None:
    written: Any = load_scene(folder / "scene.yaml")
    low, high = result.map.range
    assert written.tissue.map.range == pytest.approx((low, high), rel=1e-12)
    found: Any = check_scene(written).material.factors
    fields = MapGrid(4, (8, 8)).factors(np.log(result.map.factors).ravel())
    np.testing.assert_allclose(found, fields, atol=(high - low) / 65535)
    assert read_map(written.tissue.map).grey.dtype == np.uint16
    errors = np.asarray(Image.open(folder / "map-error.png"), np.float64) / 65535
    np.testing.assert_allclose(errors, result.map.errors, atol=1 / 65535)
    record = json.loads((folder / "fit.json").read_text())
    assert record["map"]["factors"] == result.map.factors.tolist()
    assert {"map.png", "map-error.png", "fit.png", "scene.yaml"} <= set(record["files"])


@pytest.mark.slow
def test_a_map_is_as_smooth_as_the_errors_allow(device: Device) -> None:
    """Of a lump and of even tissue with large errors, no more is followed than there is."""
    spreads = []
    for factors in (TRUTH, np.ones((4, 4))):
        observed = seen_in(scene(), device, factors, np.array([1.0, 2.0]), 1e-4)
        found: Any = fit(scene(), observed, ["tissue.map"], resolution=4).map
        off = np.log(found.factors / factors)[~found.unknown] / found.errors[~found.unknown]
        assert np.sqrt((off**2).mean()) < 1.6
        spreads.append(np.log(found.factors).std())
    # Errors alone explain the even tissue, so that it is as even as the coarsest weight makes it.
    assert 100 * spreads[1] < spreads[0]
    # With a sigma four times too large little is followed, which is said.
    notes = fit(scene(), observed, ["tissue.map"], resolution=4, sigma=4e-4).notes
    assert "the residual is only 0.25 times sigma: with a smaller sigma the map shows more" in notes


@pytest.mark.slow
def test_fields_that_do_not_move_are_unknown(device: Device, tmp_path: Path) -> None:
    # On so stiff a ground, exp(-distance / 5 mm) of a pull is felt: nothing on the other side.
    data = scene().model_dump(mode="json", exclude_none=True)
    tissue, probes = data["tissue"] | {"foundation": 2.4e6}, [one | {"at": [0.2, 0.5]} for one in data["probes"][:2]]
    local = scene(tissue=tissue, probes=probes)
    observed = seen_in(local, device, np.ones((4, 4)), np.array([1.0, 2.0]), 1e-6)
    found: Any = fit(local, observed, ["tissue.map"], resolution=4, directory=tmp_path).map
    assert found.unknown[:, 3].all()
    assert not found.unknown[1:3, 0].any()
    assert (np.asarray(Image.open(tmp_path / "map-error.png"))[:, 3] == 65535).all()


@pytest.mark.slow
def test_pictures_that_have_the_name_of_the_map_are_kept(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, grey in (("map.png", 100), ("other/map.png", 200)):
        Path(name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.full((8, 8), grey, np.uint8)).save(name)
    tissue = scene().model_dump(mode="json", exclude_none=True)["tissue"]
    ground = tissue | {"foundation_map": {"image": "map.png", "range": [0.9, 1.1]}}
    observed = seen_in(scene(tissue=ground), device, np.ones((2, 2)), np.array([1.0, 2.0]), 1e-5)
    begin = ground | {"map": {"image": "other/map.png", "range": [1, 2]}}
    found = fit(scene(tissue=begin, image="map.png"), observed, ["tissue.map"], resolution=2, directory="found")
    written: Any = load_scene("found/scene.yaml")
    fitted: Any
    for fitted in (written, found.scene):
        assert fitted.tissue.foundation_map
        assert fitted.tissue.map.image == str(Path("found/map.png"))
    assert written.image == str(Path("found/pictures/map.png"))
    assert Path("found/pictures/map.png").read_bytes() == Path("map.png").read_bytes()
    assert np.asarray(Image.open("found/map.png")).shape == (2, 2)


def test_bounds_must_leave_springs_a_length(device: Device, message: Messages) -> None:
    # Pretension shortens springs by 0.3 at a factor of 1.
    tissue = scene().model_dump(mode="json", exclude_none=True)["tissue"] | {"pretension": 0.3 * 1.5 * 2e4 * 3e-3}
    taut = scene(tissue=tissue)
    observed = seen_in(taut, device, np.ones((2, 2)), np.array([1.0, 2.0]), 1e-5)
    for bounds in ((0.05, 0.2), (0.1, 1e300)):
        with message.raises(SceneError, "--bounds tissue.map="):
            fit(taut, observed, ["tissue.map"], resolution=2, bounds={"tissue.map": bounds})
    found: Any = fit(taut, observed, ["tissue.map"], resolution=2, bounds={"tissue.map": (0.05, 2)}).map
    assert np.abs(np.log(found.factors)).max() < 4 * found.errors.max()


@pytest.mark.slow
def test_the_mesh_error_is_that_of_the_map_that_was_found(result: Any, folder: Path, device: Device) -> None:
    # The lump of the truth, where the search begins with none, changes it by more than the last digit.
    found, even = (
        estimate_mesh_error(check_scene(without_outputs(each)), device, lambda done, total: None).error
        for each in (load_scene(folder / "scene.yaml"), scene())
    )
    assert result.mesh_error == pytest.approx(found, rel=1e-6)
    assert result.mesh_error != pytest.approx(even, rel=1e-2)


def test_points_that_get_behind_the_eye_are_refused(device: Device, message: Messages) -> None:
    low = scene(render={"camera": {"eye": [0, -0.02, 0.01], "target": [0, 0.05, 0]}})
    pixel = np.arange(2.0 * len(PLACES)).reshape(-1, 1, 2)
    seen = read_observations({"time": [1.0], "coordinates": PLACES, "pixel": pixel, "sigma": 1.0}, 1)
    adjoint = Adjoint(check_scene(low), device)
    search = MapSearch(adjoint, PointModel(low, seen, 3), seen, 1.0, MapGrid(2, (8, 8)), (-2, 2), lambda: None)
    with message.raises(SceneError, "behind the eye"):
        search.predict(np.zeros(4))


@pytest.mark.parametrize(("kind", "made"), [("pixel", scene()), ("position", swinging())], ids=["rest", "motion"])
def test_the_slope_of_the_misfit_is_that_of_differences(device: Device, kind: Any, made: Scene) -> None:
    """By the fields, and by the factor of the forces."""
    times = np.array([0.7, 2.0] if kind == "pixel" else [0.08, 0.16])
    seen = read_observations(seen_in(made, device, TRUTH, times, 1e-4), 1)
    seen = KINDS[kind]("", seen.time, seen.values[..., : 3 if kind == "position" else 2], 1e-4, PLACES)
    plan, fields, limits = check_scene(made), MapGrid(4, (8, 8)), (-2.0, 2.0)
    model = PointModel(plan.scene, seen, plan.grid.frames + 1)
    search = MapSearch(Adjoint(plan, device), model, seen, 1.0, fields, limits, lambda: None, force_limits=limits)
    x, change = np.random.default_rng(0).normal(0, 0.2, (2, 17))
    for way in (change, 0.2 * np.eye(17)[16]):
        after, before = (search.misfit(x + sign * 1e-3 * way)[0] for sign in (1, -1))
        # The shapes at rest are known to 1e-6, and the second difference is 1e-6 of the first.
        assert (after - before) / 2e-3 == pytest.approx(search.misfit(x)[1] @ way, rel=1e-3)


def test_a_map_is_found_in_motion(device: Device) -> None:
    factors = np.array([[1.0, 1.5], [0.7, 1.0]])
    observed = seen_in(swinging(), device, factors, np.arange(1, 6) / 25, 1e-6)
    found: Any = fit(swinging(), observed, ["tissue.map"], resolution=2, bounds={"tissue.map": (0.3, 3)}).map
    np.testing.assert_allclose(found.factors, factors, rtol=0.02)


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
        "tissue.foundation_map",
    ],
)
def test_what_cannot_be_is_said_in_a_sentence(
    options: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: Program, message: Messages
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(json.dumps(scene().model_dump(mode="json", exclude_none=True)))
    rest = np.array([[[-0.02, 0, 0]], [[0.02, 0, 0]]])
    np.savez("seen.npz", time=[1.0], coordinates=[[0.3, 0.5], [0.7, 0.5]], position=rest)
    done = program("fit", "scene.yaml", "seen.npz", "--free", *options.split())
    assert done.returncode == 2
    message(done.stderr)
    assert len(done.stderr.splitlines()) == 1


def test_springs_and_contact_are_refused(device: Device, message: Messages) -> None:
    observed = seen_in(scene(), device, TRUTH, np.array([1.0]), 1e-5)
    springs = {**scene().model_dump(mode="json", exclude_none=True), "springs": {"structural": 20}, "probes": []}
    del springs["tissue"]
    rod = {"radius": 0.006, "shaft": [0, 0, 1], "length": 0.1}
    path = [[0, 0.5, 0.5, 0.001], [2, 0.5, 0.5, -0.003]]
    for made in (springs, scene(probes=[{"path": path, "instrument": rod}])):
        with message.raises(SceneError):
            fit(made, observed, ["tissue.map"], resolution=4)


def test_a_map_that_takes_too_much_memory_is_refused(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr("taichi_msm.fitting.stiffness_map.available_memory", lambda: 1000)
    seen = {"time": [1.0], "coordinates": PLACES, "position": np.zeros((len(PLACES), 1, 3)), "sigma": 1e-5}
    with message.raises(SceneError, "--resolution 4: "):
        fit(scene(), seen, ["tissue.map"], resolution=4)


@pytest.mark.slow
def test_ctrl_c_stops_a_map_in_the_middle_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of which one takes minutes."""
    monkeypatch.chdir(tmp_path)
    data = scene().model_dump(mode="json", exclude_none=True)
    tissue = data["tissue"] | {"density": 1050, "damping": 50}
    sheet, time = data["sheet"] | {"points": [65, 65]}, {"duration": 400, "frames_per_second": 1}
    Path("scene.yaml").write_text(json.dumps(data | {"tissue": tissue, "sheet": sheet, "time": time}))
    rest = np.pad((PLACES - 0.5) * [0.1, -0.1], ((0, 0), (0, 1)))
    seen = np.random.default_rng(0).normal(rest, 1e-5, (2, len(PLACES), 3)).swapaxes(0, 1)
    np.savez("seen.npz", time=[1.0, 2.0], coordinates=PLACES, position=seen)
    command = ["fit", "scene.yaml", "seen.npz", "--free", "tissue.map", "--resolution", "4", "--sigma", "1e-6"]
    with ReportingProcess(*command, stderr=subprocess.PIPE) as process:
        process.until("fit")
        sleep(2)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
    assert (process.returncode, error.splitlines()[-1]) == (130, "interrupted; nothing was written")
