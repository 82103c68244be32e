"""Fits of tables of a testing machine: recovery of the tissue, and explanations of a rejected model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm import SceneError, Simulation, fit, load_scene
from taichi_msm.cli.fit import parse_window
from taichi_msm.fitting.least_squares import Misfit, Solution
from taichi_msm.fitting.machine_curve import CurveRuns, relax
from taichi_msm.fitting.machine_fit import FittedTest, explanations, fitted_tests, unknown_notes
from taichi_msm.fitting.machine_model import MachineForces, MachineProblem, read_machine_problem
from taichi_msm.fitting.machine_units import unit_notes
from taichi_msm.fitting.observation import ErrorCorrelation
from taichi_msm.fitting.parameters import Parameter, Request
from taichi_msm.fitting.predict import Prediction
from taichi_msm.fitting.profiles import Profiler
from taichi_msm.fitting.uncertainty import uncertainty
from taichi_msm.machines.loading import Loading, build_loading, find_approach
from taichi_msm.machines.reader import TORE, MachineTest
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
YOUNG, SHARE, TIME = "tissue.foundation.young", "tissue.relaxation.0.share", "tissue.relaxation.0.time"


def scene(**tissue: Any) -> Scene:
    """A ball above a soft sheet on a foundation; further keys of the tissue."""
    material = {"young": 2e3, "thickness": 1e-3, "foundation": FOUNDATION, "foundation_active": "always"}
    instrument = {"radius": 0.005, "shaft": [0, 0, 1], "length": 0.05}
    return Scene.model_validate(
        {
            "sheet": {"points": [9, 9], "size": [0.02, 0.02]},
            "tissue": {**material, **tissue},
            "probes": [{"path": [[0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, -0.002]], "instrument": instrument}],
            "time": {"duration": 1, "motion": "quasistatic"},
            "output": [],
        }
    )


RELAXING = scene(relaxation=[BRANCH])


def estimate(start: Scene, tables: str | list[str], free: list[str], **options: Any) -> Any:
    """A fit in this process."""
    return fit(start, tables, free, workers=1, **options)


def forces_of(scene: Scene, path: Array, axis: int = 2, **keys: Any) -> Array:
    """Forces on the tool along an axis [N] at the frames of its path [s, ...], one per row."""
    data = scene.model_dump(mode="json", exclude_none=True)
    time = {"time__duration": float(path[-1, 0]), "time__frames_per_second": float(1 / path[1, 0])}
    with Simulation(with_keys(data, probes__0__path=path.tolist(), **time, **keys)) as simulation:
        forces = []
        for frame in range(len(path)):
            simulation.advance(min(frame, 1))
            forces.append(-simulation.forces()[0].force[axis])
    return np.array(forces)


def pressed_path(time: Array, depth: Array, contact: float) -> Array:
    return np.stack([time, 0 * time + 0.5, 0 * time + 0.5, -np.maximum(depth - contact, 0.0)], axis=1)


def write(path: Path, time: Array, depth: Array, force: Array) -> str:
    rows = [f"{t:.4f},{1000 * d:.6f},{f:.6f}" for t, d, f in zip(time, depth, force, strict=True)]
    path.write_text("\n".join(["Time [s],Depth [mm],Force [N]", *rows]) + "\n")
    return str(path)


@pytest.fixture(scope="module")
def pressed(device: Device, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The table of relaxing tissue: a ramp after an approach, held to the end, with noise of 2e-4 N."""
    time = np.arange(round(END_S * RATE) + 1) / RATE
    depth = CONTACT + DEEPEST * np.clip((time - CONTACT_S) / (RISE_S - CONTACT_S), -0.4, 1)
    force = forces_of(RELAXING, pressed_path(time, depth, CONTACT)) + np.random.default_rng(1).normal(
        0, 2e-4, len(time)
    )
    return write(tmp_path_factory.mktemp("tables") / "pressed.csv", time, depth, force)


def test_a_held_load_relaxes_exponentially() -> None:
    n, branches = np.arange(20), [(0.3, 0.5), (0.2, 3.0)]
    expected = 1 - sum(share * (1 - np.exp(-0.1 * n / time)) for share, time in branches)
    np.testing.assert_allclose(relax(np.ones(20), branches, 0.1), expected, rtol=1e-13)
    assert relax(n.astype(float), [], 0.1).tolist() == n.tolist()


@pytest.mark.slow
def test_recovery_of_relaxing_tissue(pressed: str, tmp_path: Path) -> None:
    """Its scene has the fitted forces."""
    start = scene(relaxation=[{"share": 0.3, "time": 1.0}], foundation={**FOUNDATION, "young": 1e4})
    free = {YOUNG: FOUNDATION["young"], SHARE: BRANCH["share"], TIME: BRANCH["time"]}
    result = estimate(start, pressed, list(free), rate=RATE, contact=[CONTACT], directory=tmp_path / "out")
    for key, parameter in result.parameters.items():
        assert parameter.identifiable
        # Rows in mm with six digits, and differences of 0.01 in x.
        assert abs(parameter.value - free[key]) < 4 * parameter.standard_error + 1e-3 * free[key]
    record = json.loads((tmp_path / "out/fit.json").read_text())
    assert record["residual_force"] < 3 * 2e-4
    assert record["residual"] is None
    assert (tmp_path / "out/fit.png").stat().st_size > 10000
    written = load_scene(tmp_path / "out/scene.yaml")
    forces = forces_of(written, np.array(written.probes[0].path))
    np.testing.assert_allclose(forces, result.fitted[0][:, 0], atol=1e-6)


@pytest.mark.slow
def test_a_share_without_information_is_not_identifiable(pressed: str) -> None:
    start, free = (
        scene(relaxation=[BRANCH, {"share": 1e-3, "time": 1e4}]),
        [SHARE.replace("0", "1"), TIME.replace("0", "1")],
    )
    result = estimate(start, pressed, free, rate=RATE, contact=[CONTACT])
    assert not result.identifiable
    assert sum(branch.share for branch in result.scene.tissue.relaxation) < 1


def test_recovery_of_a_clamped_strip(device: Device, tmp_path: Path) -> None:
    """Its displacement is that of the table from the first row, its force the one along its motion."""
    start = Scene.model_validate(
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
    force = -forces_of(start, np.stack([time, pull, 0 * time, 0 * time], axis=1), axis=0, tissue__young=1e5)
    assert force[-1] > 0.1
    # With an offset of the force, and signs opposite to the motion, as machines write them.
    result = estimate(start, write(tmp_path / "pulled.csv", time, -5e-3 - pull, -0.3 - force), ["tissue.young"], rate=1)
    (fitted,) = result.tests
    assert (fitted.contact, fitted.loading.force[-1]) == pytest.approx((5e-3, force[-1]), abs=1e-6)
    assert result.parameters["tissue.young"].value == pytest.approx(1e5, rel=1e-3)
    assert np.array(result.scene.probes[0].path)[-1].tolist() == pytest.approx([15, 3e-3, 0, 0], abs=1e-7)


def test_a_contact_at_the_greatest_depth_has_no_curve(pressed: str, message: Messages) -> None:
    """As in a profile, which extends to the bounds."""
    problem = read_machine_problem([pressed], Request(scene(), ["contact"], {}, None, {"contact": [CONTACT]}))
    with CurveRuns(problem, 1, lambda stage, done, total: None) as runs:
        assert runs.predict_coarse(problem.limits[1], 0) is None
        with message.raises(SceneError, "contact"):
            runs.run_curve(problem.limits[1])


def test_starts_are_within_bounds(pressed: str) -> None:
    """Too large shares are scaled down, a share at most to its bound; a trust region has a width."""
    start = scene(relaxation=[{"share": 0.8, "time": 0.6}, {"share": 0.1, "time": 5.0}])
    free = [SHARE, SHARE.replace("0", "1"), TIME]
    bounds = {SHARE: (0.7, 0.9), SHARE.replace("0", "1"): (1e-14, 0.9)}
    problem = read_machine_problem([pressed], Request(start, free, bounds, None, {"contact": [CONTACT]}))
    low, high = problem.limits
    with CurveRuns(problem, 1, lambda stage, done, total: None) as runs:
        assert runs.with_valid_shares(np.zeros(3)).tolist() == [0, 0, 0]
        valid = runs.with_valid_shares(high)
        # 0.9 + 0.9 becomes 0.49 + 0.49, then 0.7 + 0.28.
        shares = [problem.parameters[n].value(valid[n]) for n in range(2)]
        assert shares == pytest.approx([0.7, 0.28])
        assert (low <= valid).all()
        runs._tangent = SimpleNamespace(reach=1e-3)  # type: ignore[assignment]
        first, last = runs.trust_region(low, np.zeros(3))
        assert (low <= first).all()
        assert (first < last).all()


class LinearRuns:
    """Predictions that are linear in x."""

    def __init__(self, problem: Any, slopes: Array) -> None:
        self.problem, self.slopes, self.count, self.expected = problem, slopes, 0, 0

    def predict_many(self, coordinates: list[Array]) -> list[Prediction]:
        return [Prediction(((self.slopes @ x)[:, None],), 1, np.zeros(1)) for x in coordinates]


def linear_problem(outliers: int = 0) -> tuple[Misfit, LinearRuns]:
    """Two tests with noise and offsets, a parameter that is a slope of both, and one that is a curvature."""
    random, time, tests = np.random.default_rng(3), np.linspace(0, 10, 241), []
    for offset in (0.2, -0.3):
        force = time + offset + random.normal(0, 0.1, len(time))
        force[100 : 100 + outliers] += 30
        tests.append(build_loading(MachineTest("press.csv", time, time, force, 1e-4), RELAXING, is_clamp=True))
    joined = [np.concatenate([getattr(test, name) for test in tests]) for name in ("time", "force", "sigma")]
    approach = find_approach(RELAXING)
    observed = MachineForces("press.csv", joined[0], joined[1][:, None], joined[2], approach, tuple(tests))
    slopes = np.stack([joined[0], joined[0] ** 2 / 10], axis=1)
    keys = ("tissue.young", "tissue.stiffening.lock")
    parameters = tuple(Parameter(key, 1.0, -9.0, 9.0, 1.0) for key in keys)
    problem = MachineProblem(RELAXING, parameters, (observed,), tuple(tests), approach=approach)
    return Misfit([observed], [1.0], robust=outliers > 0), LinearRuns(problem, slopes)


def test_uncertainty_of_the_offsets() -> None:
    """It is that of least squares with one more parameter per test, also in profiles."""
    misfit, runs = linear_problem()
    (observed,) = misfit.observations
    assert isinstance(observed, MachineForces)
    frames = np.repeat(np.eye(2), len(observed.values) // 2, axis=0)
    information = np.concatenate([test.information for test in observed.tests])
    matrix = np.hstack([runs.slopes, frames]) * ((information > 0) / observed.sigma)[:, None]
    scaled = observed.values[:, 0] / observed.sigma * (information > 0)
    covariance = np.linalg.inv(matrix.T @ matrix)
    expected: Array = covariance @ matrix.T @ scaled
    predicted = runs.predict_many([expected[:2]])[0]
    cost = misfit.cost(misfit.residuals(predicted, misfit.scales([1.0])))
    solution = Solution(expected[:2], predicted, misfit.scales([1.0]), cost, converged=True)
    found = uncertainty(misfit, solution, runs.slopes, ErrorCorrelation(None, None))
    assert 2 * cost == pytest.approx(np.sum((matrix @ expected - scaled) ** 2))
    assert found.freedom == round(information.sum()) - 4
    np.testing.assert_allclose(found.root @ found.root.T, found.factor * covariance[:2, :2], rtol=1e-9)
    tests = fitted_tests(runs.problem, {}, predicted.values[0], runs.slopes, found)
    for n, (fitted, given) in enumerate(zip(tests, observed.tests, strict=True)):
        assert fitted.loading.offset - given.offset == pytest.approx(expected[2 + n])
        assert fitted.offset_error == pytest.approx(np.sqrt(found.factor * covariance[2 + n, 2 + n]))
        assert abs(fitted.loading.offset - (0.2, -0.3)[n]) < 4 * fitted.offset_error
        np.testing.assert_allclose(fitted.loading.force, given.force - expected[2 + n])
    for n, profile in Profiler(runs, misfit, solution, found).profiles([0, 1]).items():  # type: ignore[arg-type]
        half_width = found.quantile * found.deviations[n]
        # Ends have a relative tolerance of 0.05.
        assert profile.low == pytest.approx(expected[n] - half_width, abs=0.05 * half_width)
        assert profile.high == pytest.approx(expected[n] + half_width, abs=0.05 * half_width)


def test_a_given_offset_is_not_fitted() -> None:
    """The other test keeps its offset, as in least squares with one more parameter."""
    misfit, runs = linear_problem()
    (observed,) = misfit.observations
    assert isinstance(observed, MachineForces)
    tests = (replace(observed.tests[0], has_exact_offset=True), observed.tests[1])
    given = replace(observed, tests=tests)
    assert given.freedom == observed.freedom + 1
    rows = np.random.default_rng(5).normal(size=(len(observed.values), 2))
    count = len(tests[0].force)
    expected = rows[:count] * (tests[0].information > 0)[:, None]
    np.testing.assert_array_equal(given.without_offset(rows)[:count], expected)
    np.testing.assert_array_equal(given.without_offset(rows)[count:], observed.without_offset(rows)[count:])
    misfit = Misfit([given], [1.0], robust=False)
    predicted = runs.predict_many([np.array([1.0, 0.0])])[0]
    solution = Solution(np.array([1.0, 0.0]), predicted, misfit.scales([1.0]), 0.0, converged=True)
    found = uncertainty(misfit, solution, runs.slopes, ErrorCorrelation(None, None))
    problem = replace(runs.problem, tests=tests)
    fitted = fitted_tests(problem, {}, predicted.values[0], runs.slopes, found)
    assert (fitted[0].loading.offset, fitted[0].offset_error) == (tests[0].offset, 0)
    assert fitted[1].offset_error > 0


def test_offsets_of_a_robust_fit() -> None:
    """Outliers of a tenth of the frames move the offset by less than a standard deviation of a frame."""
    misfit, runs = linear_problem(outliers=24)
    residuals = misfit.residuals(runs.predict_many([np.array([1.0, 0.0])])[0], misfit.scales([1.0]))
    assert np.sum(np.abs(residuals) > 20) > 15
    for part in np.split(residuals, 2):
        assert abs(np.median(part)) < 0.5


def test_note_about_an_estimated_contact(pressed: str) -> None:
    """A late contact makes the tissue too stiff; a given one has no note."""
    for contact in (None, [CONTACT]):
        result = estimate(RELAXING, pressed, [YOUNG], rate=RATE, contact=contact)
        notes = [note for note in result.notes if "found from the noise" in note]
        assert len(notes) == (contact is None)


def test_rejection_of_a_contact_found_in_a_slack(device: Device, tmp_path: Path, message: Messages) -> None:
    """A drag of 5 mN over a slack of 1 mm hides the contact; with the contact of the note the stiffness is right."""
    time = np.arange(121) / 10
    depth = np.linspace(0, 3.6e-3, len(time))
    force = forces_of(scene(), pressed_path(time, depth, 1.6e-3)) + 5e-3 * (depth > 0.6e-3)
    table = write(tmp_path / "slack.csv", time, depth, force + np.random.default_rng(1).normal(0, 2e-4, len(time)))
    result = estimate(scene(), table, [YOUNG])
    assert result.model_rejected
    assert result.tests[0].contact < 0.61e-3
    (note,) = (note for note in result.notes if "slack.csv" in note)
    message(result.summary(), "--contact", hide=r"-?\d[\d.e+-]*")
    contact = float(note.partition("give --contact ")[2].partition(",")[0])
    assert f"a contact at {1000 * contact:g} mm of the table" in note
    assert contact == pytest.approx(1.6e-3, abs=0.1e-3)
    young = estimate(scene(), table, [YOUNG], contact=[contact]).parameters[YOUNG].value
    assert young == pytest.approx(FOUNDATION["young"], rel=0.1)


def held(power: float = 1.0, fall: float = 0.0) -> Loading:
    """A ramp of 3 mm, held, whose force is a power of the depth [mm] and falls at a rate [1/s]."""
    time = np.linspace(0, 8, 401)
    depth = 1e-3 * np.clip(time - 1, 0, 3)
    force = (1000 * depth) ** power * np.exp(-fall * np.maximum(time - 4, 0))
    return build_loading(MachineTest("press.csv", time, depth, force, 1e-4), RELAXING)


@pytest.mark.parametrize("case", ["sign", "relaxation", "contact", "curvature"])
def test_explanations_of_a_rejected_model(case: str, message: Messages) -> None:
    loading = held(2, fall=case == "relaxation")
    travel = 1000 * loading.travel()
    predicted = {
        "sign": -loading.force,
        "relaxation": travel**2,
        "contact": np.maximum(travel - 0.2, 0) ** 2,
        "curvature": 3 * travel,
    }[case]
    message(explanations([FittedTest(loading, loading.contact, predicted)], fits_contact=False), "press.csv")


def test_explanations_of_unidentifiable_parameters(message: Messages) -> None:
    loading = held()
    fitted = FittedTest(loading, loading.contact, loading.force)
    assert fitted.rise == pytest.approx(3, abs=0.11)
    values = {"tissue.relaxation.0.time": 0.02, "tissue.relaxation.1.time": 90.0, "tissue.relaxation.1.share": 0.1}
    values |= {"tissue.foundation.lock": 0.1, "tissue.stiffening.lock": 4.0}
    message(unknown_notes([fitted], values), "shorter", "longer", "beyond", "stretch")


def test_a_tear_is_a_reason_of_an_unknown_lock(message: Messages) -> None:
    loading = held()
    test = replace(loading.test, notes=(f"press.csv: {TORE}",))
    fitted = FittedTest(replace(loading, test=test), loading.contact, loading.force)
    message(unknown_notes([fitted], {"tissue.stiffening.lock": 4.0}), "tore", "--window")


@pytest.mark.parametrize(
    ("old", "new", "factor", "option"),
    [
        ("[N]", "[mN]", 1e3, "force=Force, N"),
        ("[N]", "[kN]", 1e-5, "force=Force, N"),
        ("[N]", "[kgf]", 1e-4, "force=Force, gf"),
        ("[N]", "[kN]", 1e-3, "above 1 MPa"),
        ("[mm]", "[um]", 1e-6, "depth=Depth, mm"),
        ("[N]", "[N]", 1e-14, "check"),
        ("[N]", "[N]", 1.0, ""),
    ],
)
def test_units_that_no_tissue_has(
    old: str, new: str, factor: float, option: str, pressed: str, tmp_path: Path, message: Messages
) -> None:
    """Another unit by a factor of 1000 or 9.81 is named where it helps; forces grow with the square of the depth."""
    text = Path(pressed).read_text().replace(old, new)
    (tmp_path / "other.csv").write_text(text)
    request = Request(scene(), [YOUNG], {}, None, {})
    problem = read_machine_problem([str(tmp_path / "other.csv")], request)
    (loading,) = problem.tests
    travel = loading.travel()
    predicted = factor * loading.peak * (travel / travel.max()) ** 2
    notes = list(unit_notes(problem, predicted[:, None]))
    assert len(notes) == bool(option)
    if notes:
        message(notes, option, hide=r"\d[\d.e+-]*(?= Pa,)")


def test_notes_about_the_table_come_before_the_search(pressed: str, tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text(Path(pressed).read_text().replace("[N]", "[mN]"))
    events: list[str] = []
    result = fit(
        scene(),
        str(tmp_path / "other.csv"),
        [YOUNG],
        contact=[CONTACT],
        workers=1,
        report=events.append,
        progress=lambda stage, done, total: events.append(f"{done}"),
    )
    (note,) = (event for event in events if not event.isdecimal())
    assert note in result.notes
    assert {*events[: events.index(note)]} <= {"0", "1"}
    assert int(events[-1]) > 3


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"sigma": 1e-3}, "sigma"),
        ({"drift": 1.0}, "drift"),
        ({"rate": -1.0}, "rate"),
        ({"contact": [1e-3, 1e-3]}, "contact"),
        ({"force_offset": [0.1, 0.1]}, "force-offset"),
        ({"forces": ("forces.csv", 0.1)}, "forces"),
        ({"free": ["contact.1"]}, "contact.1"),
        ({"free": ["probes.0.path.0.3"]}, "path"),
        ({"free": ["contact"], "bounds": {"contact": (5e-3, 6e-3)}}, "bounds"),
        ({"rate": 0.1}, "frames"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_invalid_options(pressed: str, options: dict[str, Any], word: str, message: Messages) -> None:
    with message.raises(SceneError, word):
        fit(scene(), pressed, **{"free": [YOUNG, "tissue.foundation.lock"], **options})


def test_options_and_files_of_points_and_tables_exclude_each_other(message: Messages) -> None:
    with message.raises(SceneError, "tracks.npz"):
        fit(scene(), ["tracks.npz", "press.csv"], ["tissue.young"])
    observed = {"time": [0.0], "coordinates": [[0.5, 0.5]], "position": [[[0.0, 0.0, 0.0]]]}
    for option, value in {"rate": 5.0, "force_offset": [0.1]}.items():
        with message.raises(SceneError, option.replace("_", "-")):
            fit(scene(), observed, ["tissue.young"], **{option: value})  # type: ignore[arg-type]


def test_command_with_two_tables(pressed: str, tmp_path: Path, program: Program, message: Messages) -> None:
    """They have the same tissue, but depths of contact of their own."""
    start = scene(relaxation=[BRANCH], foundation={**FOUNDATION, "young": 1.5e4})
    (tmp_path / "scene.yaml").write_text(start.model_dump_json(exclude_none=True))
    options = ["--rate", str(RATE), "--contact", str(CONTACT), "--contact", "1.2e-3", "--window", "0,4", "--columns"]
    free = ["--free", YOUNG, "--free", "contact.1", "--out", str(tmp_path / "out"), "--workers", "1"]
    done = program("fit", str(tmp_path / "scene.yaml"), pressed, pressed, *free, *options, "depth=Depth")
    assert done.returncode == 0, done.stderr
    message(done.stdout, "contact.1", hide=r"(?<!tact\.)-?\b\d[\d.e+-]*")
    record = json.loads((tmp_path / "out/fit.json").read_text())
    assert [test["frames"] for test in record["tests"]] == [4 * RATE + 1] * 2
    assert record["parameters"][YOUNG]["value"] == pytest.approx(FOUNDATION["young"], rel=0.01)
    assert record["tests"][1]["contact"] == pytest.approx(CONTACT, abs=2e-5)
    for name in ("scene", "scene-1"):
        assert load_scene(tmp_path / f"out/{name}.yaml").time.duration == 4
    with message.raises(click.BadParameter, "0.5"):
        parse_window("0.5")
