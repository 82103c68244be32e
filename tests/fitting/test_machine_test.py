"""Tests of a testing machine: their frames, and the parameters of the tissue that was pressed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm import SceneError, Simulation, fit, load_scene
from taichi_msm.cli.fit import parse_window
from taichi_msm.fitting.machine_curve import CurveRuns, relax
from taichi_msm.fitting.machine_fit import FittedTest, explanations, unknown_notes
from taichi_msm.fitting.machine_model import read_machine_problem
from taichi_msm.load.check import check_scene
from taichi_msm.machines.loading import (
    CONTACT_NOISES,
    DEPTH_FRAMES,
    MAX_FRAMES,
    build_loading,
    find_approach,
    late_contact_note,
)
from taichi_msm.machines.reader import MachineTest
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.fitting.conftest import with_keys
from tests.golden import Messages

Array = NDArray[np.float64]

# The noise is that of the rows before contact: ten or more.
RATE, CONTACT_S, RISE_S, END_S, DEEPEST, CONTACT = 5.0, 2.4, 4.0, 5.6, 2e-3, 1e-3
BRANCH = {"share": 0.5, "time": 0.6}
FOUNDATION = {"young": 2e4, "depth": 0.015, "lock": 0.006}
RADIUS = 0.005


def scene(**tissue: Any) -> Scene:
    """A ball above a soft sheet on a foundation; keys of the tissue."""
    material = {"young": 2e3, "thickness": 1e-3, "foundation": FOUNDATION, "foundation_active": "always"}
    instrument = {"radius": RADIUS, "shaft": [0, 0, 1], "length": 0.05}
    return Scene.model_validate(
        {
            "sheet": {"points": [9, 9], "size": [0.02, 0.02]},
            "tissue": {**material, **tissue},
            "probes": [{"path": [[0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, -0.002]], "instrument": instrument}],
            "time": {"duration": 1, "motion": "quasistatic"},
            "output": [],
        }
    )


def changed(initial: Scene, **keys: Any) -> dict[str, Any]:
    return with_keys(initial.model_dump(mode="json", exclude_none=True), **keys)


def ramp() -> tuple[Array, Array]:
    """Times [s], and depths of a ramp after an approach, held to the end [m]."""
    time = np.arange(round(END_S * RATE) + 1) / RATE
    return time, CONTACT + DEEPEST * np.clip((time - CONTACT_S) / (RISE_S - CONTACT_S), -0.4, 1)


def forces_of(data: dict[str, Any], axis: int = 2) -> Array:
    """Forces on the tool along an axis at the frames of a scene [N]."""
    with Simulation(data) as simulation:
        forces = []
        for frame in range(simulation.scene.time.frames + 1):
            simulation.advance(min(frame, 1))
            forces.append(-simulation.forces()[0].force[axis])
    return np.array(forces)


def write(path: Path, time: Array, depth: Array, force: Array) -> str:
    rows = [f"{t:.4f},{1000 * d:.6f},{f:.6f}" for t, d, f in zip(time, depth, force, strict=True)]
    path.write_text("\n".join(["Time [s],Depth [mm],Force [N]", *rows]) + "\n")
    return str(path)


def machine_test(time: Array, depth: Array, force: Array, digit: float = 1e-4) -> MachineTest:
    return MachineTest("press.csv", time, depth, force, digit)


@pytest.fixture(scope="module")
def pressed(device: Device, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The table of a tissue that relaxes, with noise of 2e-4 N."""
    time, depth = ramp()
    path = [[t, 0.5, 0.5, -max(d - CONTACT, 0.0)] for t, d in zip(time.tolist(), depth.tolist(), strict=True)]
    data = changed(scene(relaxation=[BRANCH]), probes__0__path=path, time__duration=END_S, time__frames_per_second=RATE)
    force = forces_of(data) + np.random.default_rng(1).normal(0, 2e-4, len(time))
    return write(tmp_path_factory.mktemp("tables") / "pressed.csv", time, depth, force)


def test_frames_are_means_of_the_rows_near_them_and_the_last_row_is_held() -> None:
    time = np.arange(0, 2.26, 0.01)
    loading = build_loading(machine_test(time, time, np.maximum(time - 1, 0)), scene(relaxation=[BRANCH]))
    assert loading.rate == 10
    assert len(loading.depth) == 24  # 2.25 s are held to 2.3 s
    np.testing.assert_allclose(loading.depth[1:-1], np.arange(1, 23) / 10, atol=1e-12)
    np.testing.assert_allclose(loading.force[11:22], np.arange(1, 12) / 10, atol=1e-12)
    np.testing.assert_allclose([loading.depth[0], loading.depth[-1]], [0.025, 2.25], atol=1e-12)


def test_frames_between_few_rows_are_interpolated_and_200_unless_a_rate_is_given() -> None:
    time, relaxing = np.arange(0, 12.5, 0.5), scene(relaxation=[BRANCH])
    loading = build_loading(machine_test(time, time, np.maximum(time - 6, 0)), relaxing, rate=4)
    np.testing.assert_allclose(loading.depth, np.arange(49) / 4, atol=1e-12)
    time = np.arange(0, 400.0, 0.5)
    test = machine_test(time, time, np.maximum(time - 100, 0))
    assert [len(build_loading(test, relaxing, rate).depth) for rate in (None, 1)] == [MAX_FRAMES + 1, 401]


def test_frames_without_relaxation_are_even_in_depth_up_to_the_deepest_row() -> None:
    time = np.linspace(0, 10, 1001)
    depth = 1e-3 * np.where(time < 5, time**2 / 25, 1 - (time - 5) / 10)
    loading = build_loading(machine_test(time, depth, np.maximum(1000 * depth - 0.2, 0), 1e-3), scene())
    assert len(loading.depth) == DEPTH_FRAMES + 1
    steps = np.diff(loading.depth)
    np.testing.assert_allclose(steps[1:-1], steps[1:-1].mean(), rtol=0.5)
    np.testing.assert_allclose(loading.depth[-1], 1e-3, rtol=0.01)
    assert loading.time.max() <= 5


def test_noise_is_of_the_first_rows_and_its_median_is_subtracted() -> None:
    time = np.linspace(0, 10, 1001)
    noise = np.random.default_rng(0).normal(0, 0.01, 1001)
    loading = build_loading(machine_test(time, time, 0.3 + noise + np.maximum(time - 5, 0)), scene(relaxation=[BRANCH]))
    first = (0.3 + noise)[:51]
    np.testing.assert_allclose(loading.noise, 1.48 * np.median(np.abs(first - np.median(first))), rtol=1e-9)
    np.testing.assert_allclose(loading.force[:40].mean(), 0, atol=0.01)
    assert build_loading(machine_test(time, time, np.maximum(time - 5, 0), 0.02), scene()).noise == 0.02


def test_contact_is_the_last_row_without_a_force_before_the_peak() -> None:
    time = np.linspace(0, 10, 1001)
    force = np.maximum(time - 5, 0)
    force[200] = 3.0  # A knock before the contact.
    loading = build_loading(machine_test(time, time, force, 0.01), scene())
    assert loading.contact == pytest.approx(5 + CONTACT_NOISES * 0.01, abs=0.0101)
    # A test that begins in contact: no row before the peak is without a force.
    falling = np.r_[50.0 - np.arange(10), np.arange(100, 200)]
    at_once = build_loading(machine_test(time[:110], time[:110], falling, 0.1), scene())
    assert at_once.contact == time[9]
    # The noise of the table counts, also far below the accuracy of predicted forces.
    quiet = build_loading(machine_test(time, time, np.maximum(time - 5, 0) ** 3, 1e-9), scene())
    assert quiet.noise == 1e-9
    assert quiet.contact == pytest.approx(5)


def test_a_force_that_rises_in_the_rows_of_the_noise_is_noted(message: Messages) -> None:
    time, random = np.linspace(0, 5, 101), np.random.default_rng(0)
    early = build_loading(machine_test(time, time, time**2, 1e-3), scene())
    message(str(late_contact_note(early, "contact")), "--free contact")
    for force in (random.normal(0, 0.1, 101) + 9 * np.maximum(time - 3, 0), 1e-3 * time + 9 * np.maximum(time - 1, 0)):
        assert late_contact_note(build_loading(machine_test(time, time, force, 1e-3), scene()), "contact") is None


def test_a_load_that_is_held_relaxes_exponentially() -> None:
    n, branches = np.arange(20), [(0.3, 0.5), (0.2, 3.0)]
    expected = 1 - sum(share * (1 - np.exp(-0.1 * n / time)) for share, time in branches)
    np.testing.assert_allclose(relax(np.ones(20), branches, 0.1), expected, rtol=1e-13)
    assert relax(n.astype(float), [], 0.1).tolist() == n.tolist()


def test_parameters_without_information_are_explained(message: Messages) -> None:
    time = np.linspace(0, 8, 401)
    depth = 1e-3 * np.clip(time - 1, 0, 3)
    loading = build_loading(machine_test(time, depth, 1000 * depth), scene(relaxation=[BRANCH]))
    fitted = FittedTest(loading, loading.contact, loading.force)
    assert fitted.rise == pytest.approx(3, abs=0.11)
    values = {"tissue.relaxation.0.time": 0.02, "tissue.relaxation.1.time": 90.0, "tissue.relaxation.1.share": 0.1}
    values |= {"tissue.foundation.lock": 0.1, "tissue.stiffening.lock": 4.0}
    message(unknown_notes([fitted], values), "shorter", "longer", "beyond", "stretch")


def test_the_tool_waits_until_contact() -> None:
    time = np.linspace(0, 10, 1001)
    loading = build_loading(
        machine_test(time, time, np.maximum(time - 5, 0), 0.01), scene(relaxation=[BRANCH]), contact=4.0
    )
    travel = loading.travel()
    assert (travel[loading.depth <= 4] == 0).all()
    np.testing.assert_allclose(travel[loading.depth > 4], loading.depth[loading.depth > 4] - 4)


@pytest.mark.parametrize(
    ("tip", "shaft"), [("radius", [0, 0, 1]), ("radius", [0.5, -0.6, 0.9]), ("plate", [0.5, -0.6, 0.9])]
)
def test_a_tool_starts_where_it_touches_the_sheet(shaft: list[float], tip: str) -> None:
    data = changed(scene(), probes__0__instrument={tip: RADIUS, "shaft": shaft, "length": 0.05})
    data["probes"][0]["path"] = [[0, 0.3, 0.5, 0.004], [1, 0.5, 0.4, -0.002], [2, 0.4, 0.4, 0]]
    approach = find_approach(Scene.model_validate(data))
    if tip == "radius":
        assert approach.start[2] == pytest.approx(RADIUS, rel=1e-8)
    np.testing.assert_allclose(approach.direction, np.array([0.004, 0.002, -0.006]) / np.sqrt(56e-6), rtol=1e-9)
    data = approach.place(data, np.array([0.0, 1e-3]), rate=1.0)
    path = data["probes"][0]["path"]
    # The gap of a tilted plate is approximate, but the scene is not refused.
    assert path[0][3] == pytest.approx(0, abs=1e-8 if tip == "radius" else 5e-6)
    check_scene(data)
    lengths = (np.array(path[1][1:]) - path[0][1:]) * [0.02, 0.02, 1]
    assert np.linalg.norm(lengths) == pytest.approx(1e-3)


@pytest.mark.parametrize("case", ["two tools", "no tool", "one place", "misses"])
def test_a_scene_without_one_line_of_a_tool_is_refused(case: str, message: Messages) -> None:
    data = changed(scene())
    (probe,) = data["probes"]
    if case == "two tools":
        data["probes"] = [probe, {**probe, "path": [[0, 0.1, 0.5, 0.001], [1, 0.1, 0.5, 0]]}]
    elif case == "no tool":
        data["probes"] = [{"total": [0, 0, -1], "radius": 0.002}]
    else:
        probe["path"] = [[0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, 0.001 if case == "one place" else 0.002]]
    with message.raises(SceneError, "probes"):
        find_approach(Scene.model_validate(data))


@pytest.mark.parametrize("case", ["noise", "depth", "contact"])
def test_a_table_that_shows_no_contact_is_refused(case: str, message: Messages) -> None:
    time = np.linspace(0, 10, 1001)
    depth, force = (time, np.maximum(time - 5, 0)) if case != "depth" else (20 - time, np.maximum(time - 5, 0))
    test = machine_test(time, depth, 1e-3 * np.sin(time) if case == "noise" else force, 0.01)
    with message.raises(SceneError, "press.csv"):
        build_loading(test, scene(), contact=11.0 if case == "contact" else None)


@pytest.mark.slow
def test_the_parameters_of_a_tissue_that_relaxes_come_back_and_its_scene_runs_alone(
    pressed: str, tmp_path: Path
) -> None:
    initial = scene(relaxation=[{"share": 0.3, "time": 1.0}], foundation={**FOUNDATION, "young": 1e4})
    free = ["tissue.foundation.young", "tissue.relaxation.0.share", "tissue.relaxation.0.time"]
    result = fit(initial, pressed, free, rate=RATE, contact=[CONTACT], directory=tmp_path / "out", workers=1)
    truth = dict(zip(free, (FOUNDATION["young"], BRANCH["share"], BRANCH["time"]), strict=True))
    for key, estimate in result.parameters.items():
        assert estimate.identifiable
        # Rows in mm with six digits, and frames 0.01 apart in x.
        assert abs(estimate.value - truth[key]) < 4 * estimate.standard_error + 1e-3 * truth[key]
    record = json.loads((tmp_path / "out/fit.json").read_text())
    assert record["residual_force"] < 3 * 2e-4
    assert record["residual"] is None
    assert (tmp_path / "out/fit.png").stat().st_size > 10000
    np.testing.assert_allclose(
        forces_of(json.loads(load_scene(tmp_path / "out/scene.yaml").model_dump_json(exclude_none=True))),
        result.fitted[0][:, 0],
        atol=1e-6,
    )


def test_a_contact_at_the_greatest_depth_gives_no_run(pressed: str, message: Messages) -> None:
    """As in a profile, which goes to the bounds."""
    problem = read_machine_problem([pressed], scene(), ["contact"], {}, None, {"contact": [CONTACT]})
    with CurveRuns(problem, 1, lambda stage, done, total: None) as runs:
        assert runs.predict_coarse(problem.limits[1], 0) is None
        with message.raises(SceneError, "contact"):
            runs.run_curve(problem.limits[1])


@pytest.mark.slow
def test_several_tables_have_the_same_tissue_and_contacts_of_their_own(pressed: str) -> None:
    result = fit(
        scene(relaxation=[BRANCH], foundation={**FOUNDATION, "young": 1.5e4}),
        [pressed, pressed],
        ["tissue.foundation.young", "contact.1"],
        rate=RATE,
        contact=[CONTACT, 1.2e-3],
        workers=1,
    )
    assert result.parameters["tissue.foundation.young"].value == pytest.approx(FOUNDATION["young"], rel=0.01)
    assert result.tests[1].contact == pytest.approx(CONTACT, abs=2e-5)


@pytest.mark.slow
def test_a_share_without_information_is_not_identifiable(pressed: str) -> None:
    branches = [BRANCH, {"share": 1e-3, "time": 1e4}]
    free = ["tissue.relaxation.1.share", "tissue.relaxation.1.time"]
    result = fit(scene(relaxation=branches), pressed, free, rate=RATE, contact=[CONTACT], workers=1)
    assert not result.identifiable
    assert sum(branch.share for branch in result.scene.tissue.relaxation) < 1 if result.scene.tissue else False


@pytest.mark.slow
def test_a_model_without_relaxation_is_rejected_with_the_reason(pressed: str, message: Messages) -> None:
    result = fit(scene(), pressed, ["tissue.foundation.young"], contact=[CONTACT], workers=1)
    assert result.model_rejected
    message((note for note in result.notes if "relaxation" in note), "falls", hide=r"/\S*/|[\d.]+ %")


@pytest.mark.parametrize("case", ["sign", "relaxation", "contact", "curvature"])
def test_reasons_are_those_that_the_table_shows(case: str, message: Messages) -> None:
    time = np.linspace(0, 8, 401)
    depth = 1e-3 * np.clip(time - 1, 0, 3)
    force = (1000 * depth) ** 2
    if case == "relaxation":
        force = force * np.where(time > 4, np.exp(-(time - 4)), 1)
    loading = build_loading(machine_test(time, depth, force), scene(relaxation=[BRANCH]))
    travel = loading.travel()
    predicted = {
        "sign": -loading.force,
        "relaxation": (1000 * travel) ** 2,
        "contact": (1000 * np.maximum(travel - 2e-4, 0)) ** 2,
        "curvature": 3000 * travel,
    }[case]
    message(explanations([FittedTest(loading, loading.contact, predicted)], fits_contact=False), "press.csv")


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"sigma": 1e-3}, "sigma"),
        ({"drift": 1.0}, "drift"),
        ({"rate": -1.0}, "rate"),
        ({"contact": [1e-3, 1e-3]}, "contact"),
        ({"forces": ("forces.csv", 0.1)}, "forces"),
        ({"free": ["contact.1"]}, "contact.1"),
        ({"free": ["probes.0.path.0.3"]}, "path"),
        ({"free": ["contact"], "bounds": {"contact": (5e-3, 6e-3)}}, "bounds"),
        ({"rate": 0.1}, "frames"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_options_of_other_fits_are_refused(pressed: str, options: dict[str, Any], word: str, message: Messages) -> None:
    free = ["tissue.foundation.young", "tissue.foundation.lock"]
    with message.raises(SceneError, word):
        fit(scene(), pressed, **{"free": free, **options})


def test_a_clamp_follows_a_table_from_its_first_row(device: Device, tmp_path: Path) -> None:
    """Its displacement is the table's from the first row, and its force is along its motion."""
    initial = Scene.model_validate(
        {
            "sheet": {"points": [3, 5], "size": [0.01, 0.02], "fixed": ["left"]},
            "tissue": {"young": 2e5, "thickness": 2e-3},
            "probes": [{"clamp": "right", "path": [[0, 0, 0, 0], [1, 1e-3, 0, 0]]}],
            "time": {"duration": 1, "motion": "quasistatic"},
            "output": [],
        }
    )
    time = np.arange(16.0)
    pull = 5e-4 * np.maximum(time - 9, 0)
    path = np.stack([time, pull, 0 * time, 0 * time], axis=1).tolist()
    pulled = changed(initial, probes__0__path=path, time__duration=15.0, time__frames_per_second=1.0, tissue__young=1e5)
    force = -forces_of(pulled, axis=0)
    assert force[-1] > 0.1
    # An offset of the force, which is subtracted; and counted the other way, as machines do.
    table = write(tmp_path / "pulled.csv", time, -5e-3 - pull, -0.3 - force)
    result = fit(initial, table, ["tissue.young"], rate=1, workers=1)
    (fitted,) = result.tests
    assert (fitted.contact, fitted.loading.force[-1]) == pytest.approx((5e-3, force[-1]), abs=1e-6)
    assert result.parameters["tissue.young"].value == pytest.approx(1e5, rel=1e-3)
    assert np.array(result.scene.probes[0].path)[-1].tolist() == pytest.approx([15, 3e-3, 0, 0], abs=1e-7)


def test_a_window_is_two_numbers(message: Messages) -> None:
    assert parse_window("0.5,12") == (0.5, 12.0)
    with message.raises(click.BadParameter, "0.5"):
        parse_window("0.5")


def test_tables_and_points_are_not_mixed(message: Messages) -> None:
    with message.raises(SceneError, "tracks.npz"):
        fit(scene(), ["tracks.npz", "press.csv"], ["tissue.young"])
    observed = {"time": [0.0], "coordinates": [[0.5, 0.5]], "position": [[[0.0, 0.0, 0.0]]]}
    with message.raises(SceneError, "rate"):
        fit(scene(), observed, ["tissue.young"], rate=5.0)


def test_the_command_fits_tables(pressed: str, tmp_path: Path, program: Program) -> None:
    (tmp_path / "scene.yaml").write_text(scene(relaxation=[BRANCH]).model_dump_json(exclude_none=True))
    options = ["--rate", str(RATE), "--contact", str(CONTACT), "--window", "0,4", "--columns", "depth=Depth"]
    arguments = [str(tmp_path / "scene.yaml"), pressed, pressed, "--free", "tissue.foundation.young", *options]
    done = program("fit", *arguments, "--out", str(tmp_path / "out"), "--json", "--workers", "1")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["tests"]) == 2
    for name in ("scene", "scene-1"):
        assert load_scene(tmp_path / f"out/{name}.yaml").time.duration == 4
    assert found["parameters"]["tissue.foundation.young"]["value"] == pytest.approx(FOUNDATION["young"], rel=0.01)
    assert found["tests"][0]["frames"] == 4 * RATE + 1
