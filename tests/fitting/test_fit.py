"""Parameter estimation from observed points and forces: recovery, intervals, identifiability, refusals."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import zipfile
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy.stats import t as student

from taichi_msm import ArgumentError, MsmError, SceneError, Simulation, fit, load_scene, run
from taichi_msm.fitting.archive import read_observations
from taichi_msm.fitting.checks import faults
from taichi_msm.fitting.fit import search_notes, uncertainty_notes
from taichi_msm.fitting.forces import read_forces
from taichi_msm.fitting.least_squares import Solution
from taichi_msm.fitting.observation import ErrorCorrelation
from taichi_msm.fitting.outliers import outlier_notes
from taichi_msm.fitting.parameters import Method, make_parameters
from taichi_msm.fitting.points import MIN_MOTION_SIGMAS, Pixels, PointObservation, Positions
from taichi_msm.fitting.predict import FitProblem, ForwardModel, Prediction, Runs, without_outputs
from taichi_msm.fitting.rejection import by_pattern
from taichi_msm.fitting.result import FitResult
from taichi_msm.fitting.uncertainty import Uncertainty, unidentified_groups
from taichi_msm.model.surface import surface_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.sweeps.pool import DiedError
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.fitting.conftest import with_keys
from tests.golden import Messages
from tests.reporting_process import ReportingProcess

Array = NDArray[np.float64]

TRUTH: dict[str, Any] = {
    "sheet": {"points": [9, 9], "size": [0.1, 0.1]},
    "tissue": {"young": 2e4, "thickness": 3e-3, "density": 1050, "foundation": 3e5, "foundation_active": "always"}
    | {"damping": 200, "pretension": 10},
    "probes": [
        {"total": [0, 0, -2], "radius": 0.01, "falloff": 100, "load": [[0, 0], [0.1, 100], [0.2, 100], [0.2, 0]]}
    ],
    "time": {"duration": 0.4, "frames_per_second": 25, "precision": "f64"},
    "render": {"camera": {"eye": [0, -0.06, 0.09]}, "tracks": 6},
    "output": [],
}

TIME = np.arange(11) / 25
GRID = (np.arange(6) + 0.5) / 6
PLACES = np.stack([axis.ravel() for axis in np.meshgrid(GRID, GRID)], axis=1)

YOUNG, FOUNDATION, DAMPING = "tissue.young", "tissue.foundation", "tissue.damping"

Arrays = dict[str, Array]


def changed(**keys: Any) -> Scene:
    """The truth with other values."""
    return Scene.model_validate(with_keys(TRUTH, **keys))


def estimate(start: Any, observed: Any, free: list[str], **options: Any) -> Any:
    """A fit in this process."""
    return fit(start, observed, free, **{"workers": 1, **options})


def positions_in(scene: Scene, device: Device) -> Array:
    """Positions of the mass points in every frame [m], shape (frames, rows, cols, 3)."""
    with Simulation(scene, threads=device.threads) as simulation:
        frames = [simulation.positions()]
        for _ in TIME[1:]:
            simulation.advance()
            frames.append(simulation.positions())
    return np.array(frames)


def pixels_in(scene: Scene, motion: Array, device: Device) -> Array:
    """Pixels of PLACES in every frame, without errors, shape (places, frames, 2)."""
    with Simulation(scene, threads=device.threads) as simulation:
        frames = zip(motion, TIME.tolist(), strict=True)
        pixels = [simulation.locate(PLACES, positions=position, time=time).pixels for position, time in frames]
    return np.stack(pixels, axis=1).astype(np.float64)


@pytest.fixture(scope="module")
def motion(device: Device) -> Array:
    """Positions of the truth."""
    return positions_in(changed(), device)


@pytest.fixture(scope="module")
def mass_points(motion: Array) -> Arrays:
    return {"time": TIME, "position": motion}


@pytest.fixture(scope="module")
def tracks(device: Device, motion: Array) -> Arrays:
    return {"time": TIME, "coordinates": PLACES, "pixel": pixels_in(changed(), motion, device)}


def noisy(tracks: Arrays, error: float, seed: int = 0, **arrays: Any) -> dict[str, Any]:
    pixel = tracks["pixel"] + np.random.default_rng(seed).normal(0, error, tracks["pixel"].shape)
    return {**tracks, "pixel": pixel, **arrays}


def save(path: Path, arrays: Any) -> None:
    np.savez(path, **arrays)


def values(result: FitResult) -> list[float]:
    return [parameter.value for parameter in result.parameters.values()]


def test_pixels_of_a_moving_camera_with_distortion(motion: Array, device: Device) -> None:
    eye = [[0, 0, -0.06, 0.09], [0.4, 0.02, -0.05, 0.1]]
    scene = changed(render__camera={"eye": eye, "fov": 40, "distortion": {"k1": -0.3, "k2": 0.1}})
    points = np.stack([surface_positions(frame, scene.render.refine, PLACES) for frame in motion], axis=1)
    predicted = Pixels("", TIME, points, None, PLACES).observe(scene, points)
    np.testing.assert_allclose(predicted, pixels_in(scene, motion, device), atol=1e-4)


@pytest.mark.slow
def test_recovery_from_a_distant_start(mass_points: Arrays) -> None:
    start = changed(tissue__young=6e4, tissue__foundation=6e4, tissue__damping=1000, probes__0__at=[0.4, 0.6])
    result = estimate(start, mass_points, [YOUNG, FOUNDATION, DAMPING, "probes.0.at.0", "probes.0.at.1"])
    np.testing.assert_allclose(values(result), [2e4, 3e5, 200, 0.5, 0.5], rtol=1e-6)
    assert result.identifiable
    assert result.parameters[YOUNG].start == 6e4


@pytest.mark.slow
def test_recovery_by_alternative_starts(mass_points: Arrays) -> None:
    # At the other end of the sheet, the cost has no slope toward the middle.
    start, free = changed(probes__0__at=[0.05, 0.05]), ["probes.0.at.0", "probes.0.at.1"]
    result = fit(start, mass_points, free, bounds=dict.fromkeys(free, (0, 1)))
    np.testing.assert_allclose(values(result), [0.5, 0.5], atol=1e-5)


def test_coverage_of_intervals(tracks: Arrays) -> None:
    # Errors so small that the motion is linear in the parameters within their intervals.
    start = changed(tissue__damping=300, tissue__foundation=2e5)
    is_covered, ratios = [], []
    for seed in range(6):
        arrays = {"sigma": 0.05} if seed % 2 else {}
        result = estimate(start, noisy(tracks, 0.05, seed, **arrays), [DAMPING, FOUNDATION])
        assert result.sigma == pytest.approx(0.05, rel=0.12)  # of 792 numbers, 4.8 / sqrt(2 * 790)
        for parameter, truth in zip(result.parameters.values(), (200, 3e5), strict=True):
            is_covered.append(parameter.interval[0] < truth < parameter.interval[1])
            ratios.append((parameter.value - truth) / parameter.standard_error)
    # Of 12 at 95 % each: 9 or fewer with a probability of 2 %; the seeds are fixed.
    assert sum(is_covered) >= 10
    # The standard deviation of 12 standard normal numbers is 1 +- 0.2.
    assert 0.5 < float(np.std(ratios)) < 1.5


def test_interval_of_correlated_parameters(device: Device) -> None:
    """Without `profile`: at its ends, chi-square with the lock refitted has risen by Student's t squared."""
    keys: dict[str, Any] = {"tissue__foundation": 1e5, "probes__0__total": [0, 0, -6]}
    keys["tissue__stiffening"] = {"lock": 0.05}
    truth = changed(**keys)
    pixel, lock = pixels_in(truth, positions_in(truth, device), device), "tissue.stiffening.lock"
    observed = noisy({"time": TIME, "coordinates": PLACES, "pixel": pixel}, 1.0, sigma=1.0)
    best = estimate(truth, observed, [YOUNG, lock])
    assert best.correlation[0][1] > 0.95
    quantile = student.ppf(0.975, best.degrees_of_freedom)
    for end in best.parameters[YOUNG].interval:
        start = changed(**keys, tissue__young=end)
        refitted = estimate(start, observed, [lock])
        # An end is determined to 1 % of its distance; the symmetric interval differs by up to 1.9.
        assert refitted.chi_square - best.chi_square == pytest.approx(quantile**2, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("bounded", [False, True])
def test_profile_interval(tracks: Arrays, bounded: bool) -> None:
    """At its ends, chi-square with the foundation refitted has risen by Student's t squared."""
    # Errors so large that the motion is not linear in the damping; or bounds that exclude the true foundation.
    key, foundation, error = ("young", 2.95e5, 0.1) if bounded else ("damping", 3e5, 0.5)
    options = {"bounds": {FOUNDATION: (2.9e5, 2.99e5)} if bounded else {}}
    free, observed = [f"tissue.{key}", FOUNDATION], noisy(tracks, error, sigma=error)
    best = estimate(changed(tissue__foundation=foundation), observed, free, profile=True, **options)
    quantile = student.ppf(0.975, best.degrees_of_freedom)
    for end in best.parameters[free[0]].interval:
        start = changed(**{f"tissue__{key}": end, "tissue__foundation": foundation})
        refitted = estimate(start, observed, free[1:], **options)
        # An end is determined to 1 % of its distance.
        assert refitted.chi_square - best.chi_square == pytest.approx(quantile**2, rel=0.04 if bounded else 0.03)
    curve = np.array([point.deviations for point in best.curves[free[0]]])
    assert curve.min() < -1.9
    assert curve.max() > 1.9


@pytest.mark.slow
def test_identifiability_without_and_with_a_force(tracks: Arrays, tmp_path: Path, message: Messages) -> None:
    # Without inertia only ratios of forces are identifiable from pixels.
    time = {"duration": 0.2, "frames_per_second": 20, "motion": "quasistatic"}
    truth = {**TRUTH, "time": {**TRUTH["time"], **time}, "output": ["tracks", "forces"]}
    run(truth, tmp_path / "truth", threads=2, estimate_error=False)
    start = Scene.model_validate(truth).model_copy(update={"output": ()})
    free = [YOUNG, FOUNDATION, "tissue.pretension", "probes.0.total.2"]
    arguments = start, tmp_path / "truth" / "tracks.npz", free
    result = estimate(*arguments, sigma=0.1)
    assert not result.identifiable
    for parameter in result.parameters.values():
        assert (parameter.identifiable, parameter.interval, parameter.mesh_error) == (False, (None, None), None)
    (group,) = result.unseen
    assert group.parameters == free
    assert len(group.known) == 3
    assert all(sorted(map(abs, known.exponents.values())) == [1, 1] for known in group.known)
    message(group.text, "--forces", hide=r"^.*(?=each alone)")
    result = estimate(*arguments, sigma=0.1, forces=(tmp_path / "truth" / "forces.csv", 0.01))
    assert (result.identifiable, result.unseen) == (True, [])
    assert result.residual_force < 1e-4
    assert result.fitted[1].shape == (5, 3)
    np.testing.assert_allclose(values(result), [2e4, 3e5, 10, -2], rtol=1e-4)


def test_an_unidentifiable_pair_does_not_change_other_estimates(tracks: Arrays, message: Messages) -> None:
    """Young and depth of the foundation act only as their quotient."""
    start, observed = changed(tissue__foundation={"young": 1.5e4, "depth": 0.05}), noisy(tracks, 0.02, sigma=0.02)
    free = [YOUNG, "tissue.foundation.young", "tissue.foundation.depth"]
    alone, result = estimate(start, observed, free[:2]), estimate(start, observed, free)
    errors = [fitted.parameters[YOUNG].standard_error for fitted in (result, alone)]
    assert errors[0] == pytest.approx(errors[1], rel=0.05)
    assert [parameter.identifiable for parameter in result.parameters.values()] == [True, False, False]
    (group,) = result.unseen
    message(group.text, "tissue.foundation.young / tissue.foundation.depth ", hide=r"\d[\d.]*")
    (known,) = group.known
    assert known.standard_error == pytest.approx(alone.parameters[free[1]].standard_error / 1.5e4, rel=0.05)


def test_unidentifiable_parameter(mass_points: Arrays, message: Messages) -> None:
    # Positions do not depend on the camera.
    result = fit(changed(), {**mass_points, "sigma": 1e-5}, [FOUNDATION, "render.camera.eye.2"])
    assert [parameter.identifiable for parameter in result.parameters.values()] == [True, False]
    message([group.text for group in result.unseen], "render.camera.eye.2")


def uncertain(*deviations: float) -> Uncertainty:
    """Uncertainty of two parameters by the standard deviations of their sum and difference."""
    directions = np.array([[1, 1], [1, -1]]) / np.sqrt(2)
    none, root = np.zeros(0), directions * deviations
    return Uncertainty((1.0,), 1.0, 100, 100.0, none, none, directions, root, np.ones(2))


def test_positions_that_are_known_only_in_combination(message: Messages) -> None:
    parameters = make_parameters(changed(), ["probes.0.at.0", "probes.0.at.1"], {})
    groups = unidentified_groups(parameters, np.zeros(2), uncertain(1e-3, 1e4), forces=False)
    message([group.text for group in groups], "probes.0.at.0", "--forces")


def test_notes_of_search_and_uncertainty(message: Messages) -> None:
    parameters = make_parameters(changed(), [YOUNG, FOUNDATION], {FOUNDATION: (2e5, 3e5)})
    x, prediction = np.array([np.log(1000), 0]), Prediction((), 1, np.zeros(2))
    message(search_notes(Solution(x, prediction, (1.0,), 1.0, False), parameters, fits_well=False), "--set", "--bounds")
    message(uncertainty_notes(parameters, x, uncertain(1e-3, 0.1), np.array([0.5, 0]), []), YOUNG, "sheet.points")


def test_one_sided_differences(tracks: Arrays) -> None:
    # The load's third key may not be later than its fourth.
    load = [[0, 0], [0.1, 100], [0.2 - 1e-6, 100], [0.2, 0]]
    result = estimate(changed(probes__0__load=load), tracks, ["probes.0.load.2.0"])
    assert values(result) == pytest.approx([0.2], abs=1e-4)


def test_occluded_invisible_and_masked_tracks(tracks: Arrays, message: Messages) -> None:
    points, occluded = np.zeros((2, 3, 2), np.float32), np.zeros((2, 3), np.bool_)
    occluded[1, 2] = True
    observed = read_observations({"coordinates": [[0.5, 0.5], [0.2, 0.7]], "points": points, "occluded": occluded}, 25)
    assert observed.time.tolist() == [0, 0.04, 0.08]
    assert (observed.is_observed != occluded).all()
    visible = np.random.default_rng(0).random(tracks["pixel"].shape[:2]) < 0.5
    masked = np.ma.masked_array(tracks["pixel"], np.repeat(~visible[..., None], 2, axis=2))
    for arrays in ({**tracks, "pixel": masked}, tracks | {"visible": visible}):
        np.testing.assert_array_equal(read_observations(arrays, 25).is_observed, visible)
    for name, array in (("visible", 0.9 * visible), ("validity", visible)):
        with message.raises(SceneError, name):
            read_observations({**tracks, name: array}, 25)


@pytest.mark.parametrize("sigma", [0.1, None])
def test_robust_fit_of_outliers(tracks: Arrays, sigma: float | None, message: Messages) -> None:
    """A robust fit leaves them out, and the rest judges the model; without outliers it equals a plain fit."""
    rng, free = np.random.default_rng(7), [YOUNG, FOUNDATION]
    observed = noisy(tracks, 0.1) | ({} if sigma is None else {"sigma": sigma})
    plain, robust = (estimate(changed(), observed, free, robust=is_robust) for is_robust in (False, True))
    # Of 396 samples, 0.4 exceed the limit of 1e-3 by chance; more than 3 do with a probability of 1e-3.
    assert robust.left_out[0].mask.sum() <= 3
    for key in free:
        first, second = (result.parameters[key] for result in (plain, robust))
        assert abs(second.value - first.value) < 0.5 * first.standard_error
        assert second.standard_error == pytest.approx(first.standard_error, rel=0.05)
    # Anywhere in the frame, in another pixel than the point.
    is_outlier = rng.random((36, 11)) < 0.25
    observed["pixel"][is_outlier] = rng.uniform(0, 512, (is_outlier.sum(), 2))
    start = changed(tissue__young=3e4, tissue__foundation=2e5)
    result = estimate(start, observed, free, robust=True)
    (left_out,) = result.left_out
    assert left_out.mask[is_outlier].all()
    assert left_out.mask.sum() <= is_outlier.sum() + 3
    assert not result.model_rejected
    assert result.degrees_of_freedom == 2 * (396 - left_out.mask.sum()) - 2
    assert result.sigma == pytest.approx(0.1, rel=0.1)  # of 600 numbers, 3.5 standard deviations
    for key, truth in zip(free, (2e4, 3e5), strict=True):
        low, high = result.parameters[key].interval
        assert low < truth < high
    (record,) = result.as_json()["left_out"]
    assert [tuple(sample) for sample in record["samples"]] == list(zip(*np.nonzero(left_out.mask), strict=True))
    message(str(left_out), "outliers")


@pytest.mark.slow
def test_errors_correlated_in_space_widen_intervals(tracks: Arrays, message: Messages) -> None:
    # A shaking camera: the errors of a frame have a common part.
    observed, free = noisy(tracks, 0.02), [FOUNDATION]
    observed["pixel"] += np.random.default_rng(2).normal(0, 0.5, (1, 11, 2))
    plain = estimate(changed(), observed, free)
    (note,) = (note for note in plain.notes if "--correlation" in note)
    message(note, "PX", hide=r"\d[\d.]*")
    correlated = estimate(changed(), observed, free, correlation=1000, profile=True)
    errors = [result.parameters[FOUNDATION].standard_error for result in (plain, correlated)]
    assert errors[1] > 2 * errors[0]
    assert not any("--correlation" in note for note in correlated.notes)
    low, high = correlated.parameters[FOUNDATION].interval
    assert (high - low) / (2 * 1.96) == pytest.approx(errors[1], rel=0.1)


@pytest.mark.slow
def test_errors_correlated_in_time_widen_intervals(tracks: Arrays, message: Messages) -> None:
    observed, free = noisy(tracks, 0.05), [YOUNG, FOUNDATION]
    observed["pixel"] += np.cumsum(np.random.default_rng(3).normal(0, 0.1, tracks["pixel"].shape), axis=1)
    plain, drifting = estimate(changed(), observed, free), estimate(changed(), observed, free, drift=1.0)
    assert (plain.model_rejected, drifting.model_rejected) == (True, False)
    message([line for line in plain.summary() if "--drift" in line], "SECONDS", hide=r"\d[\d.]*")
    assert not any("--drift" in line for line in drifting.summary())
    widening = drifting.parameters[FOUNDATION].standard_error / plain.parameters[FOUNDATION].standard_error
    assert 1.2 < widening < 11**0.5


@pytest.mark.slow
def test_mesh_error_of_a_parameter(device: Device, message: Messages) -> None:
    position = positions_in(changed(sheet__points=[33, 33]), device)[:, ::4, ::4]
    result: Any = fit(changed(), {"time": TIME, "position": position}, [FOUNDATION])
    error = abs(values(result)[0] - 3e5)
    assert result.mesh_error
    # The finer scene has a sixteenth of the error; half of 9 x 9 points are too few for a close estimate.
    assert error / 4 < result.parameters[FOUNDATION].mesh_error < 4 * error
    (note,) = (note for note in result.notes if "mesh" in note)
    message(note, FOUNDATION, hide=r"\d[\d.]*")


def test_order_of_the_mesh_error(tracks: Arrays, monkeypatch: pytest.MonkeyPatch) -> None:
    def mesh_error(order: int) -> float:
        def predict_coarse(runs: Runs, x: Array, halvings: int) -> Prediction:
            fine: Any = runs.predict_one(x)
            share = 1e-3 * (2 ** (order * halvings) - 1)
            return fine._replace(values=fine.values + share * (fine.values - tracks["pixel"][:, :1]))

        monkeypatch.setattr(Runs, "predict_coarse", predict_coarse)
        error: float = estimate(changed(), tracks, [FOUNDATION]).parameters[FOUNDATION].mesh_error
        return error

    # Half the cells per side add 1 or 3 errors.
    assert mesh_error(1) == pytest.approx(mesh_error(2), rel=0.01)


def test_failed_runs_of_a_search(tracks: Arrays, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """Runs of a dead worker process, and all runs near the initial values."""
    future: Future[Any] = Future()
    future.set_exception(DiedError("its process was ended by SIGKILL"))
    monkeypatch.setattr("taichi_msm.fitting.predict.Pool", Mock(return_value=Mock(submit=lambda *call: future)))
    with message.raises(MsmError, "SIGKILL"):
        estimate(changed(), tracks, [YOUNG, FOUNDATION], workers=2)
    monkeypatch.setattr(Runs, "predict_many", lambda runs, coordinates, steps=None: [None] * len(coordinates))
    with message.raises(SceneError, YOUNG):
        estimate(changed(), tracks, [YOUNG])


def test_runs_that_a_search_leaves_out(tracks: Arrays, message: Messages) -> None:
    """With infinite values, and with more halvings of the cells than the sheet has."""
    problem = FitProblem(without_outputs(changed()), make_parameters(changed(), [YOUNG], {}),
                         (read_observations(tracks, 25),))  # fmt: skip
    model = ForwardModel(problem, 1)
    with message.raises(SceneError):
        model.predict(np.array([1e3]))
    with message.raises(SceneError, "sheet.points"):
        model.predict(np.zeros(1), halvings=9)


def test_scene_without_motion(tracks: Arrays, message: Messages) -> None:
    with message.raises(SceneError, "probes"):
        estimate(changed(probes__0__total=[0, 0, 0]), tracks, [FOUNDATION])


def test_missing_matplotlib(tracks: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setitem(sys.modules, "taichi_msm.fitting.plots", None)
    result = estimate(changed(), tracks, [FOUNDATION], directory=tmp_path / "fit")
    message(result.notes[-1], "fit.png", "pip install")
    assert not (tmp_path / "fit" / "fit.png").exists()


def test_same_bits_with_any_number_of_workers(tracks: Arrays) -> None:
    results = [estimate(changed(tissue__young=3e4), noisy(tracks, 0.1), [YOUNG], workers=count) for count in (1, 2)]
    assert values(results[0]) == values(results[1])
    assert results[0].runs == results[1].runs


@pytest.mark.slow
def test_a_negative_parameter_and_one_that_starts_at_0(tracks: Arrays, message: Messages) -> None:
    key = "probes.0.total.2"
    result = fit(changed(probes__0__total=[0, 0, -1]), tracks, [key], bounds={key: (-5, 5)})
    low, high = result.parameters[key].interval
    assert low is not None
    assert high is not None
    assert low <= values(result)[0] <= high
    assert values(result) == pytest.approx([-2], rel=1e-4)
    start = changed(tissue__damping=0)
    with message.raises(SceneError, DAMPING, "--bounds"):
        fit(start, tracks, [DAMPING])
    assert values(fit(start, tracks, [DAMPING], bounds={DAMPING: (0, 1000)})) == pytest.approx([200], rel=1e-4)


def test_an_interrupted_fit_leaves_no_files(tracks: Arrays, tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        if done > 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(changed(tissue__young=3e4), tracks, [YOUNG], directory=tmp_path / "fit", progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_files(number: signal.Signals, tracks: Arrays, small: Path) -> None:
    (small / "press.yaml").write_text(yaml.safe_dump(TRUTH))
    save(small / "tracks.npz", tracks)
    command = ["fit", "press.yaml", "tracks.npz", "--free", YOUNG, "--set", "tissue.young=3e4", "--out", "out"]
    with ReportingProcess(*command, stderr=subprocess.PIPE) as process:
        # As soon as there are files, and before the first run.
        while not (small / "out/.partial/lock").exists():
            assert process.poll() is None
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert "interrupted; nothing was written" in errors
    assert not (small / "out").exists()


def test_files_of_the_command(tracks: Arrays, small: Path, program: Program, message: Messages) -> None:
    (small / "press.yaml").write_text(yaml.safe_dump({**TRUTH, "image": "speckle.png", "output": ["png"]}))
    save(small / "tracks.npz", noisy(tracks, 0.1, sigma=0.1))
    options = "--set", "tissue.young=3e4", "--bounds", "tissue.young=1e4,1e5"
    done = program("fit", "press.yaml", "tracks.npz", "--free", YOUNG, FOUNDATION, *options, "--json")
    assert done.returncode == 0, done.stderr
    folder = small / "output" / "press-fit"
    record = json.loads((folder / "fit.json").read_text())
    assert json.loads(done.stdout)["parameters"] == record["parameters"]
    message(" ".join(record), "parameters")
    assert sorted(record["files"]) == ["fit.png", "pictures/speckle.png", "scene.yaml"]
    assert (folder / "pictures" / "speckle.png").read_bytes() == (small / "speckle.png").read_bytes()
    fitted: Any = load_scene(folder / "scene.yaml")
    young = record["parameters"][YOUNG]
    assert (fitted.tissue.young, fitted.output) == (young["value"], ("png",))
    assert young.keys() == {"value", "standard_error", "interval", "start", "identifiable", "mesh_error"}
    assert young["interval"][0] < young["value"] < young["interval"][1]
    assert np.array(record["correlation"]).shape == (2, 2)
    assert 0.8 < record["chi_square"] / record["degrees_of_freedom"] < 1.2
    assert (record["sigma"], record["identifiable"], record["unseen"]) == (0.1, True, [])


def implausible(tracks: Arrays, mass: Arrays) -> dict[str, dict[str, Any]]:
    """Implausible observations by name."""
    pixel, time, motion = tracks["pixel"], tracks["time"], mass["position"]
    still, hidden = np.repeat(pixel[:, :1], 11, axis=1), np.full_like(pixel, np.nan)
    lone, zeros, marked = hidden.copy(), pixel.copy(), pixel.copy()
    lone[0, 3], zeros[3, 4:], marked[3, 4:] = pixel[0, 3], 0, -9999
    errors = noisy(tracks, 0.1)["pixel"]
    pixels = {
        "few": lone,
        "hidden": hidden,
        "still": still,
        "rounded": still * (1 + 1e-13 * np.random.default_rng(1).normal(size=still.shape)),
        "huge": 1e40 * pixel,
        "camera": 2 * pixel,
        "turned": pixel.swapaxes(0, 1),
        # Conventions of other programs.
        "zeros": zeros,
        "marked": marked,
        "fractions": pixel / 512,
        "from 0": errors - 0.5,
        "from 1": errors + 0.5,
        "from 1 in x": errors + np.array([0.5, 0]),
        "upward": np.array([0, 512]) + errors * [1, -1],
        "from the right": np.array([512, 0]) + errors * [-1, 1],
    }
    times = {"missed": np.linspace(0, 0.004, 11), "ms": 1000 * time, "late": time + 0.1, "early": time - 0.1}
    times |= {"numbers": np.arange(11.0), "unknown": np.where(time > 0.3, np.nan, time)}
    positions = {"mm": 1000 * motion, "cm": 100 * motion, "origin": motion + 0.05}
    positions |= {"leftward": motion * [-1, 1, 1], "downward": motion * [1, -1, 1], "away": motion * [1, 1, -1]}
    return {
        **{name: {**tracks, "pixel": array} for name, array in pixels.items()},
        **{name: {**tracks, "time": array} for name, array in times.items()},
        **{name: {**mass, "position": array} for name, array in positions.items()},
        "tiny": {**tracks, "sigma": 1e-300},
        "noise": {**tracks, "sigma": 50.0},
        "places": {**tracks, "coordinates": 512 * PLACES},
        "texts": {**tracks, "coordinates": PLACES.astype("U8")},
        "lacks": {"time": time, "pixel": pixel},
        "lacks values": {"time": time, "coordinates": PLACES},
        "both": {**tracks, "position": np.zeros((36, 11, 3))},
    }


def test_implausible_observations_are_refused(
    tracks: Arrays, mass_points: Arrays, tmp_path: Path, message: Messages
) -> None:
    for name, arrays in implausible(tracks, mass_points).items():
        save(tmp_path / f"{name}.npz", arrays)
        with message.raises(SceneError, f"{name}.npz: ", "; "):
            estimate(changed(), tmp_path / f"{name}.npz", [YOUNG, FOUNDATION, DAMPING])


def test_motion_of_many_tracks_below_their_errors_is_significant(tracks: Arrays) -> None:
    # The square of the motion is 0.4 of that of the errors, of 36 points at 11 times.
    motion = 0.95 * np.sin(np.arange(11))[:, None]
    noise = np.random.default_rng(3).normal(0, 1, tracks["pixel"].shape)
    for moves in (True, False):
        pixel = tracks["pixel"][:, :1] + moves * motion + noise
        observed = read_observations({**tracks, "pixel": pixel, "sigma": 1.0}, 25)
        assert observed.signal(changed()) < MIN_MOTION_SIGMAS
        assert bool(list(faults([observed], changed(), 1))) != moves


@pytest.mark.parametrize(
    "arguments",
    [
        "--free tissue.yuong",
        "--free time.duration",
        '--free tissue.foundation --set tissue.foundation={"young":1e4,"depth":0.01}',
        "",
        "--free tissue.young --bounds tissue.young=9",
        "--free tissue.young --bounds tissue.young=3e4,9e4",
        "--free tissue.young --bounds tissue.damping=1,2",
        "--free tissue.young --bounds damping=1,2",
        "--free tissue.young --forces none.csv,0.1",
        "--free tissue.young --forces none.csv",
        "--free tissue.young --forces none.csv,0",
        "--free tissue.young --free tissue.young",
        "--free tissue.young --bounds tissue.young=1,1e5 tissue.young=2,1e5",
        "--free tissue.young --set sheet.tolerance=0.1",
        "--free tissue.young --sigma 0",
        "--free tissue.young --correlation 0",
    ],
)
def test_invalid_options_of_the_command(
    tracks: Arrays, small: Path, program: Program, arguments: str, message: Messages
) -> None:
    (small / "press.yaml").write_text(yaml.safe_dump(TRUTH))
    save(small / "tracks.npz", tracks)
    done = program("fit", "press.yaml", "tracks.npz", *arguments.split())
    assert done.returncode == 2
    message(done.stderr)
    assert len(done.stderr.splitlines()) == 1
    assert not (small / "output").exists()


INVALID_ARGUMENTS: dict[str, dict[str, Any]] = {
    "observed": {"observed": 3},
    "free, text": {"free": "tissue.young"},
    "bounds, list": {"bounds": [("tissue.young", 1, 2)]},
    "forces": {"forces": "forces.csv"},
    "directory": {"directory": 3},
    "workers": {"workers": 0},
    "sigma": {"sigma": "0.1"},
    "robust": {"robust": 1},
    "profile": {"profile": "all"},
    "correlation": {"correlation": "5 px"},
    "drift": {"drift": True},
    "resolution": {"resolution": 4.0},
    "columns": {"columns": "depth=Traverse, mm"},
    "force offset": {"force_offset": 0.1},
    "sheet": {"sheet": 1},
    "block": {"block": "2"},
    "window": {"window": 12.0},
    "rate": {"rate": "25"},
    "contact": {"contact": 0.002},
    "unknown": {"profiles": True},
}


@pytest.mark.parametrize("case", INVALID_ARGUMENTS)
def test_types_of_arguments(tracks: Arrays, case: str, message: Messages) -> None:
    arguments: dict[str, Any] = {"scene": changed(), "observed": tracks, "free": [YOUNG], **INVALID_ARGUMENTS[case]}
    with message.raises(ArgumentError):
        fit(**arguments)


def test_options_are_documented() -> None:
    assert fit.__doc__ is not None
    assert all(name in fit.__doc__ for name in Method.__annotations__)


def test_files_of_other_kinds_are_refused(tmp_path: Path, message: Messages) -> None:
    np.save(tmp_path / "array.npy", np.ones(3))
    single = (tmp_path / "array.npy").read_bytes()
    for name, data in {"empty": b"", "text": b"nothing", "none": b"PK\x05\x06" + bytes(18), "single": single}.items():
        (tmp_path / f"{name}.npz").write_bytes(data)
        with message.raises(SceneError, f"{name}.npz: "):
            fit(changed(), tmp_path / f"{name}.npz", [YOUNG])


def test_unused_arrays_are_not_read(tracks: Arrays, tmp_path: Path, message: Messages) -> None:
    save(tmp_path / "tracks.npz", {**tracks, "meta": np.array({"rig": 1}, object)})
    assert read_observations(tmp_path / "tracks.npz", 25).values.shape == tracks["pixel"].shape
    save(tmp_path / "tracks.npz", {**tracks, "time": np.array([{}], object)})
    with message.raises(SceneError, "tracks.npz: time: ", "objects"):
        read_observations(tmp_path / "tracks.npz", 25)


def test_a_damaged_array_is_named(tmp_path: Path, message: Messages) -> None:
    with zipfile.ZipFile(tmp_path / "tracks.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("time.npy", b"\x93NUMPY\x01\x00" + bytes(200))
    damaged = bytearray((tmp_path / "tracks.npz").read_bytes())
    damaged[38] = 0xFF
    (tmp_path / "tracks.npz").write_bytes(damaged)
    with message.raises(SceneError, "tracks.npz: time: ", hide=r"(?<=cannot be read: )[^;]*"):
        read_observations(tmp_path / "tracks.npz", 25)


def test_arrays_larger_than_the_memory(
    tracks: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    save(tmp_path / "tracks.npz", tracks)
    monkeypatch.setattr("taichi_msm.fitting.archive.available_memory", lambda: 2000)
    with message.raises(SceneError, "tracks.npz: "):
        read_observations(tmp_path / "tracks.npz", 25)


FORCES = "time,probe,force_x,force_y,force_z\n"
ZEROS = f"{FORCES}0,0,0,0,0\n"
INVALID_TABLES = {
    "empty": "",
    "no row": FORCES,
    "no force": f"{FORCES}0.1,0,,,\n",
    "no time": f"{FORCES},0,0,0,1\n",
    "no force_z": "time,probe,force_x,force_y\n0,0,0,0\n",
    "word": f"{ZEROS}0.1,0,n/a,0,0\n",
    "twice": f"{ZEROS}0,0,0,0,1\n",
    "millinewtons": f"{FORCES}s,-,mN,mN,mN\n0,0,0,0,1\n",
    # One thousand two hundred and thirty-four, or a decimal comma.
    "comma between commas": f'{FORCES}0,0,0,1,"1,234"\n',
    "row that ends early": f"{ZEROS}0.1,0,0,0\n",
    "no probe": f"{FORCES}0,,0,0,1\n",
    "no such probe": f"{ZEROS}0.1,1,0,0,1\n",
    "names not in a cell each": FORCES.replace("time", "time s") + "0,0,0,0,1\n",
    "column twice": f"{FORCES.strip()},force_z [N]\n0,0,0,0,1,2\n",
}


@pytest.mark.parametrize("case", INVALID_TABLES)
def test_invalid_tables_of_forces(tmp_path: Path, case: str, message: Messages) -> None:
    (tmp_path / "forces.csv").write_text(INVALID_TABLES[case])
    with message.raises(SceneError, "forces.csv"):
        read_forces(tmp_path / "forces.csv", 0.1, 1)


def test_tables_of_forces_of_other_programs(tmp_path: Path) -> None:
    for text in (
        "sep=;\nA rig; of a lab\nTime;Probe;Force_X;Force_Y;Force_Z\n[s];[-];[N];[N];[N]\n0,1;0;;;-0,5\n% end\n;;;;\n",
        "time,probe,force_z [N],force_x,force_y,rig\n0.1,0,-0.5,,,one\n",
    ):
        (tmp_path / "forces.csv").write_text(text)
        table = read_forces(tmp_path / "forces.csv", 0.1, 1)
        assert (table.time.tolist(), table.probe.tolist()) == ([0.1], [0])
        np.testing.assert_array_equal(table.values, [[np.nan, np.nan, -0.5]])


def test_units_and_signs_of_forces(tracks: Arrays, device: Device, tmp_path: Path, message: Messages) -> None:
    """The force of the tool is given, so that no parameter scales it."""
    measured = []
    with Simulation(changed(), threads=device.threads) as simulation:
        for _ in range(5):
            simulation.advance()
            measured.append((simulation.time, simulation.forces()[0].force[2]))
    arguments = changed(tissue__young=2e5), noisy(tracks, 0.1, sigma=0.1), [YOUNG]

    def estimate_with(factor: float, **options: Any) -> Any:
        rows = [f"{time},0,,,{factor * force}\n" for time, force in measured]
        (tmp_path / "forces.csv").write_text(FORCES + "".join(rows))
        sigma = 0.01 * max(1, abs(factor))
        return estimate(*arguments, forces=(tmp_path / "forces.csv", sigma), **options)

    for factor in (-1, 1000, 101.97, 0.001):
        with message.raises(SceneError, "forces.csv"):
            estimate_with(factor)
    for factor in (1.1, 1):
        result = estimate_with(factor, directory=tmp_path / "fit")
        assert not any("are they in" in note for note in result.notes)
        assert result.model_rejected == (factor == 1.1)
        if result.model_rejected:
            message(result.summary()[0], "forces", "1.1 times", hide=r"\d[\d.e+]* (?=for|deg|of)")
    record = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert record["residual_force"] < record["sigma_force"] == 0.01
    assert (tmp_path / "fit" / "fit.png").stat().st_size > 10_000


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.5])
def test_note_about_outliers(share: float, message: Messages) -> None:
    """A few values carry chi-square; normal errors and half of the values do not."""
    residuals = np.random.default_rng(2).normal(size=2000)
    residuals[: round(2000 * share)] *= 100
    notes = list(outlier_notes(residuals))
    assert len(notes) == (0 < share < 0.3)
    if notes:
        message(notes, "--robust")


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.filterwarnings("error:::taichi_msm")
def test_exact_fit(tracks: Arrays, robust: bool, message: Messages) -> None:
    free = [YOUNG, FOUNDATION]
    first = estimate(changed(), tracks, free)
    exact = {**tracks, "pixel": first.fitted[0]}
    result = estimate(first.scene, exact, free, robust=robust, profile=True)
    assert (result.residual, values(result), result.identifiable) == (0, values(first), True)
    assert all(0 < each.standard_error < 1e-6 * each.value for each in result.parameters.values())
    (note,) = (note for note in result.notes if "--sigma" in note)
    message(note)
    assert not any("nan" in line or "inf" in line for line in result.summary()[:-1])
    result = estimate(first.scene, exact, free, robust=robust, sigma=1e-5)
    assert result.chi_square == 0
    assert not any("--sigma" in note for note in result.notes)


def test_points_behind_the_camera(motion: Array, device: Device, message: Messages) -> None:
    """They do not count in correlations; observed ones are refused."""
    scene = changed(render__camera={"eye": [0, -0.02, 0.01], "target": [0, 0.05, 0]})
    observed = noisy({"time": TIME, "coordinates": PLACES, "pixel": pixels_in(scene, motion, device)}, 0.1, sigma=0.1)
    is_invisible = np.isnan(observed["pixel"])
    assert is_invisible.any(axis=(1, 2)).sum() == 12
    observed["pixel"][30, 2:5] = np.nan
    is_tracked = np.isfinite(observed["pixel"]).any(axis=(1, 2))
    fewer = {**observed, "coordinates": PLACES[is_tracked], "pixel": observed["pixel"][is_tracked]}
    results = [estimate(scene, arrays, [FOUNDATION], correlation=50) for arrays in (observed, fewer)]
    errors = [result.parameters[FOUNDATION].standard_error for result in results]
    assert 0 < errors[0] < 0.1 * values(results[0])[0]
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)
    observed["pixel"][is_invisible] = np.arange(is_invisible.sum())
    with message.raises(SceneError, "pixel: 12 "):
        estimate(scene, observed, [YOUNG])


def test_calibration_of_a_named_camera(tracks: Arrays, motion: Array, device: Device) -> None:
    def with_intrinsics(**intrinsics: float) -> Scene:
        left = {"eye": [0, -0.06, 0.09], "intrinsics": intrinsics}
        return changed(render={"tracks": 6, "cameras": {"left": left, "right": {"beside": "left", "baseline": 0.004}}})

    truth = {"fx": 700, "fy": 710, "cx": 255.5, "cy": 250.5}
    pixel = pixels_in(with_intrinsics(**truth), motion, device)
    start = with_intrinsics(fx=702, fy=708, cx=254.5, cy=251.5)
    keys = [f"render.cameras.left.intrinsics.{name}" for name in truth]
    # Focal lengths by their logs, the principal point in widths and heights of the picture.
    assert [parameter.scale for parameter in make_parameters(start, keys, {})] == [0, 0, 512, 512]
    result = estimate(start, {**tracks, "pixel": pixel, "sigma": 1.0}, keys)
    np.testing.assert_allclose(values(result), list(truth.values()), atol=1e-3)
    assert result.identifiable


@pytest.mark.parametrize("case", ["sigma", "no sigma", "two times"])
def test_rejection_of_a_wrong_damping(tracks: Arrays, case: str, message: Messages) -> None:
    """With sigma by chi-square, without it by the pattern of the residuals, also at two times."""
    observed = noisy(tracks, 0.05, sigma=0.05) if case == "sigma" else noisy(tracks, 0.02)
    if case == "two times":
        observed |= {"time": observed["time"][5:7], "pixel": observed["pixel"][:, 5:7]}
    wrong, right = (estimate(changed(tissue__damping=damping), observed, [FOUNDATION]) for damping in (600, 200))
    assert (wrong.as_json()["model_rejected"], right.as_json()["model_rejected"]) == (True, False)
    message(wrong.summary()[0], "the model is rejected: ", hide=r"\d[\d.]*")
    assert "rejected" not in right.summary()[0]
    if case == "sigma":
        (note,) = (note for note in wrong.notes if "sigma" in note)
        message(note, hide=r"\d[\d.]*")


CORRELATIONS = [ErrorCorrelation(None, None), ErrorCorrelation(5.0, None), ErrorCorrelation(None, 1.0)]


@pytest.mark.parametrize("correlation", CORRELATIONS, ids=["independent", "in space", "in time"])
def test_false_rejections_by_a_pattern(correlation: ErrorCorrelation, message: Messages) -> None:
    """Of noise with jumps and missing observations; a wrong model is rejected."""
    rng = np.random.default_rng(4)

    def reason(residuals: Array) -> str | None:
        # The displacement grows in time, most in the middle of the sheet.
        times = np.arange(residuals.shape[1], dtype=float)
        displacement = np.exp(-8 * ((PLACES - 0.5) ** 2).sum(axis=1))[:, None, None] * times[:, None] * [1.0, 0.5]
        return by_pattern(residuals, displacement, times, PLACES, 10.0, correlation, "give --correlation PX")

    rejections = 0
    for _ in range(400):
        residuals = rng.normal(0, 1, (36, 9, 2))
        residuals += 0 if correlation.length is None else rng.normal(0, 2, (1, 9, 2))
        residuals = residuals if correlation.drift is None else np.cumsum(residuals, axis=1)
        residuals[rng.random(residuals.shape) < 0.05] *= 10
        residuals[rng.random(residuals.shape[:2]) < 0.1] = np.nan
        rejections += reason(residuals) is not None
    # Of 400, 0.4 are expected; more than 3 have a probability of 1e-3.
    assert rejections <= 3
    residuals = np.sin(np.arange(40) / 6)[:, None] + rng.normal(0, 1, (36, 40, 2))
    message(reason(residuals) or "", "correlated")


def test_rejection_of_a_linear_model_of_locked_tissue(device: Device, message: Messages) -> None:
    """Its residuals are 5 % larger than the noise, and Young's modulus is wrong by a factor of 1.6."""
    keys: dict[str, Any] = {"tissue__foundation": 1e5, "probes__0__total": [0, 0, -6]}
    locked, linear = changed(tissue__stiffening={"lock": 0.15}, **keys), changed(tissue__young=3e4, **keys)
    pixel = pixels_in(locked, positions_in(locked, device), device)
    for seed in (0, 1):
        observed = noisy({"time": TIME, "coordinates": PLACES, "pixel": pixel}, 0.5, seed)
        wrong = estimate(linear, observed, [YOUNG])
        assert wrong.residual == pytest.approx(0.525, rel=0.04)
        assert values(wrong)[0] == pytest.approx(3.3e4, rel=0.1)
        assert wrong.model_rejected
        assert not estimate(locked, observed, [YOUNG]).model_rejected
    message(wrong.summary()[0], "the model is rejected: ", hide=r"\d[\d.]*")


@pytest.mark.parametrize("kind", [Pixels, Positions])
def test_notes_of_correlated_residuals(kind: type[PointObservation], message: Messages) -> None:
    """Of neighbouring points by a shaking camera, and of a point by its drift."""
    size, times, rng = 2 if kind is Pixels else 3, np.arange(40.0), np.random.default_rng(5)
    noise, shaking = rng.normal(0, 1, (36, 40, size)), rng.normal(0, 5, (1, 40, size))
    observed = kind("", times, np.zeros_like(noise), None, PLACES)
    assert not list(observed.residual_notes(noise, 10.0, ErrorCorrelation(None, None)))
    for residuals in (noise + shaking, np.cumsum(noise, axis=1)):
        message(observed.residual_notes(residuals, 10.0, ErrorCorrelation(None, None)), hide=r"\d\.\d+")
