"""Numbers of a scene from what was seen: they come back, as well known as is said."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy.stats import t as student

from taichi_msm import ArgumentError, SceneError, Simulation, fit, load_scene, run
from taichi_msm.fitting.archive import read_observations
from taichi_msm.fitting.checks import faults
from taichi_msm.fitting.forces import read_forces
from taichi_msm.fitting.observation import ErrorCorrelation
from taichi_msm.fitting.parameters import Method, make_parameters
from taichi_msm.fitting.points import MIN_MOTION_SIGMAS, Pixels
from taichi_msm.fitting.predict import FitProblem, ForwardModel, Prediction, Runs, without_outputs
from taichi_msm.fitting.result import FitResult
from taichi_msm.model.surface import surface_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.fitting.conftest import with_keys
from tests.golden import Messages

Array = NDArray[np.float64]

TRUTH: dict[str, Any] = {
    "sheet": {"points": [9, 9], "size": [0.1, 0.1]},
    "tissue": {
        "young": 2e4,
        "thickness": 3e-3,
        "density": 1050,
        "foundation": 3e5,
        "foundation_active": "always",
        "damping": 200,
        "pretension": 10,
    },
    "probes": [
        {"total": [0, 0, -2], "radius": 0.01, "falloff": 100, "load": [[0, 0], [0.1, 100], [0.2, 100], [0.2, 0]]}
    ],
    "time": {"duration": 0.4, "frames_per_second": 25, "precision": "f64"},
    "render": {"camera": {"eye": [0, -0.06, 0.09]}, "tracks": 6},
    "output": [],
}

FORCES = "time,probe,force_x,force_y,force_z\n"

GRID = (np.arange(6) + 0.5) / 6
PLACES = np.stack([axis.ravel() for axis in np.meshgrid(GRID, GRID)], axis=1)


def changed(**keys: Any) -> Scene:
    """The truth with other values."""
    return Scene.model_validate(with_keys(TRUTH, **keys))


def positions_in(made: Scene, device: Device) -> Array:
    """Positions of the mass points in every frame [m], shape (frames, rows, cols, 3)."""
    with Simulation(made, threads=device.threads) as simulation:
        frames = [simulation.positions()]
        for _ in range(10):
            simulation.advance()
            frames.append(simulation.positions())
    return np.array(frames)


def pixels_in(made: Scene, motion: Array, device: Device) -> Array:
    """What a scene's camera sees of the places in every frame, without errors, shape (places, frames, 2)."""
    with Simulation(made, threads=device.threads) as simulation:
        frames = enumerate(motion)
        pixels = [simulation.locate(PLACES, positions=each, time=n / 25).pixels for n, each in frames]
    return np.stack(pixels, axis=1).astype(np.float64)


@pytest.fixture(scope="module")
def motion(device: Device) -> Array:
    """That of the truth."""
    return positions_in(changed(), device)


@pytest.fixture(scope="module")
def tracks(device: Device, motion: Array) -> dict[str, Array]:
    return {"time": np.arange(11) / 25, "coordinates": PLACES, "pixel": pixels_in(changed(), motion, device)}


def noisy(tracks: dict[str, Array], error: float, seed: int = 0, **more: Any) -> dict[str, Any]:
    pixel = tracks["pixel"] + np.random.default_rng(seed).normal(0, error, tracks["pixel"].shape)
    return {**tracks, "pixel": pixel, **more}


def save(path: Path, arrays: Any) -> None:
    np.savez(path, **arrays)


def values(result: FitResult) -> list[float]:
    return [one.value for one in result.parameters.values()]


def test_a_camera_that_moves_and_bends_lines_sees_what_is_predicted(motion: Array, device: Device) -> None:
    eye = [[0, 0, -0.06, 0.09], [0.4, 0.02, -0.05, 0.1]]
    made = changed(render__camera={"eye": eye, "fov": 40, "distortion": {"k1": -0.3, "k2": 0.1}})
    points = np.stack([surface_positions(each, made.render.refine, PLACES) for each in motion], axis=1)
    seen = Pixels("", np.arange(11) / 25, points, None, PLACES).observe(made, points)
    np.testing.assert_allclose(seen, pixels_in(made, motion, device), atol=1e-4)


@pytest.mark.slow
def test_the_truth_comes_back_from_a_start_that_is_far_off(motion: Array) -> None:
    start = changed(tissue__young=6e4, tissue__foundation=6e4, tissue__damping=1000, probes__0__at=[0.4, 0.6])
    free = ["tissue.young", "tissue.foundation", "tissue.damping", "probes.0.at.0"]
    seen = {"time": np.arange(11) / 25, "position": motion}
    found = fit(start, seen, [*free, "probes.0.at.1"], workers=1)
    np.testing.assert_allclose(values(found), [2e4, 3e5, 200, 0.5, 0.5], rtol=1e-6)
    assert found.identifiable
    assert found.parameters["tissue.young"].start == 6e4


@pytest.mark.slow
def test_other_starts_are_tried_where_the_first_does_not_fit(motion: Array) -> None:
    # From a tool at the other end of the sheet nothing leads to the middle.
    start = changed(probes__0__at=[0.05, 0.05])
    seen = {"time": np.arange(11) / 25, "position": motion}
    found = fit(
        start, seen, ["probes.0.at.0", "probes.0.at.1"], bounds={"probes.0.at.0": (0, 1), "probes.0.at.1": (0, 1)}
    )
    np.testing.assert_allclose(values(found), [0.5, 0.5], atol=1e-5)


def test_intervals_hold_the_truth_as_often_as_they_say(tracks: dict[str, Array]) -> None:
    # Errors so small that the motion is linear in the parameters within their intervals.
    start = changed(tissue__damping=300, tissue__foundation=2e5)
    held, ratios = [], []
    for seed in range(6):
        more = {"sigma": 0.05} if seed % 2 else {}
        found = fit(start, noisy(tracks, 0.05, seed, **more), ["tissue.damping", "tissue.foundation"], workers=1)
        assert found.sigma == pytest.approx(0.05, rel=0.12)  # of 792 numbers, 4.8 / sqrt(2 * 790)
        for one, truth in zip(found.parameters.values(), (200, 3e5), strict=True):
            low, high = one.interval
            assert low is not None
            assert high is not None
            held.append(low < truth < high)
            ratios.append((one.value - truth) / one.standard_error)
    # Of 12 at 95 % each: 9 or fewer with a probability of 2 %; the seeds are fixed.
    assert sum(held) >= 10
    # The standard deviation of 12 standard normal numbers is 1 +- 0.2.
    assert 0.5 < float(np.std(ratios)) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("bounded", [False, True])
def test_a_profile_ends_where_the_others_can_no_longer_make_up_for_it(tracks: dict[str, Array], bounded: bool) -> None:
    # Errors so large that the motion is not linear in the damping; or a foundation that bounds keep from the truth.
    key, other, error = ("young", 2.95e5, 0.1) if bounded else ("damping", 3e5, 0.5)
    bounds = {"tissue.foundation": (2.9e5, 2.99e5)} if bounded else {}
    given: dict[str, Any] = {"bounds": bounds, "workers": 1}
    free, seen = [f"tissue.{key}", "tissue.foundation"], noisy(tracks, error, sigma=error)
    best: Any = fit(changed(tissue__foundation=other), seen, free, profile=True, **given)
    quantile = student.ppf(0.975, best.degrees_of_freedom)
    for end in best.parameters[free[0]].interval:
        assert end is not None
        held: Any = fit(changed(**{f"tissue__{key}": end, "tissue__foundation": other}), seen, free[1:], **given)
        # An end is found to 1 % of its distance.
        assert held.chi_square - best.chi_square == pytest.approx(quantile**2, rel=0.04 if bounded else 0.03)
    curve = np.array([place.deviations for place in best.curves[free[0]]])
    assert curve.min() < -1.9
    assert curve.max() > 1.9


@pytest.mark.slow
def test_what_pictures_cannot_tell_is_named_and_a_force_tells_it(
    tracks: dict[str, Array], tmp_path: Path, message: Messages
) -> None:
    # Without inertia only ratios of forces are seen.
    time = {"duration": 0.2, "frames_per_second": 20, "motion": "quasistatic"}
    at_rest = {**TRUTH, "time": {**TRUTH["time"], **time}, "output": ["tracks", "forces"]}
    run(at_rest, tmp_path / "truth", threads=2, estimate_error=False)
    start = Scene.model_validate(at_rest).model_copy(update={"output": ()})
    free = ["tissue.young", "tissue.foundation", "tissue.pretension", "probes.0.total.2"]
    given = start, tmp_path / "truth" / "tracks.npz", free
    found = fit(*given, sigma=0.1, workers=1)
    assert not found.identifiable
    for one in found.parameters.values():
        assert (one.identifiable, one.interval, one.mesh_error) == (False, (None, None), None)
    (unseen,) = found.unseen
    assert unseen.parameters == free
    assert len(unseen.known) == 3
    assert all(sorted(map(abs, one.exponents.values())) == [1, 1] for one in unseen.known)
    message(unseen.text, "--forces", hide=r"^.*(?=each alone)")
    told: Any = fit(*given, sigma=0.1, forces=(tmp_path / "truth" / "forces.csv", 0.01), workers=1)
    assert told.identifiable
    assert told.unseen == []
    assert told.residual_force < 1e-4
    assert told.fitted[1].shape == (5, 3)
    np.testing.assert_allclose(values(told), [2e4, 3e5, 10, -2], rtol=1e-4)


@pytest.mark.slow
def test_a_product_is_known_where_its_factors_are_not(motion: Array) -> None:
    # At rest and without bending, young and thickness act only as their product.
    scene = changed(time__motion="quasistatic")
    with Simulation(scene) as simulation:
        simulation.advance(4)
        position = simulation.positions()[None]
    found = fit(scene, {"time": [0.16], "position": position, "sigma": 1e-5}, ["tissue.young", "tissue.thickness"])
    (unseen,) = found.unseen
    assert unseen.text.startswith("tissue.young x tissue.thickness is known to ")
    assert not found.identifiable


@pytest.mark.parametrize("sigma", [0.02, *(pytest.param(one, marks=pytest.mark.fuzz) for one in (0.2, 0.002))])
def test_a_pair_that_is_not_seen_leaves_the_others_as_they_are(tracks: dict[str, Array], sigma: float) -> None:
    """Young and depth of the foundation act only as their quotient, at any size of the errors."""
    start, seen = changed(tissue__foundation={"young": 1.5e4, "depth": 0.05}), noisy(tracks, sigma, sigma=sigma)
    free = ["tissue.young", "tissue.foundation.young", "tissue.foundation.depth"]
    alone, found = fit(start, seen, free[:2], workers=1), fit(start, seen, free, workers=1)
    error = alone.parameters[free[0]].standard_error
    assert found.parameters[free[0]].standard_error == pytest.approx(error, rel=0.05)
    assert [one.identifiable for one in found.parameters.values()] == [True, False, False]
    (unseen,) = found.unseen
    (known,) = unseen.known
    assert sorted(known.exponents.values()) == [-1, 1]
    assert known.standard_error == pytest.approx(alone.parameters[free[1]].standard_error / 1.5e4, rel=0.05)


def test_a_number_that_can_change_to_one_side_only_is_found(tracks: dict[str, Array]) -> None:
    # The load's third key may not be later than its fourth.
    load = [[0, 0], [0.1, 100], [0.2 - 1e-6, 100], [0.2, 0]]
    found = fit(changed(probes__0__load=load), tracks, ["probes.0.load.2.0"], workers=1)
    assert values(found) == pytest.approx([0.2], abs=1e-4)


def test_an_occluded_track_is_not_used(tracks: dict[str, Array], message: Messages) -> None:
    points, occluded = np.zeros((2, 3, 2), np.float32), np.zeros((2, 3), np.bool_)
    occluded[1, 2] = True
    seen = read_observations({"coordinates": [[0.5, 0.5], [0.2, 0.7]], "points": points, "occluded": occluded}, 25)
    assert seen.time.tolist() == [0, 0.04, 0.08]
    assert (seen.is_observed != occluded).all()
    # Nor one that is masked, or not visible.
    visible = np.random.default_rng(0).random(tracks["pixel"].shape[:2]) < 0.5
    masked = np.ma.masked_array(tracks["pixel"], np.repeat(~visible[..., None], 2, axis=2))
    for seen in (
        read_observations({**tracks, "pixel": masked}, 25),
        read_observations(tracks | {"visible": visible}, 25),
    ):
        np.testing.assert_array_equal(seen.is_observed, visible)
    for name, array in (("visible", 0.9 * visible), ("validity", visible)):
        with message.raises(SceneError, name):
            read_observations({**tracks, name: array}, 25)


def test_a_number_that_nothing_shows_is_not_identifiable(motion: Array) -> None:
    # Positions do not depend on the camera.
    seen = {"time": np.arange(11) / 25, "position": motion, "sigma": 1e-5}
    found = fit(changed(), seen, ["tissue.foundation", "render.camera.eye.2"])
    assert found.parameters["tissue.foundation"].identifiable
    assert not found.parameters["render.camera.eye.2"].identifiable
    assert [one.text for one in found.unseen] == ["render.camera.eye.2: not identifiable: fix it"]


def test_depths_and_forces_of_a_tool_tell_the_foundation(device: Device, tmp_path: Path) -> None:
    # A table of force and depth, and one point, below the tip.
    tool = {
        "path": [[0, 0.5, 0.5, 0], [0.4, 0.5, 0.5, -0.004]],
        "instrument": {"radius": 0.02, "shaft": [0, 0, 1], "length": 0.1},
    }
    timed = {"duration": 0.4, "frames_per_second": 10, "motion": "quasistatic"}
    truth = changed(probes=[tool], time=timed)
    rows = ["time,probe,force_x,force_y,force_z"]
    with Simulation(truth, threads=device.threads) as simulation:
        for _ in range(4):
            simulation.advance()
            rows.append(f"{simulation.time},0,,,{simulation.forces()[0].force[2]}")
    (tmp_path / "forces.csv").write_text("\n".join(rows))
    below = {"time": [0.4], "coordinates": [[0.5, 0.5]], "position": [[[0, 0, -0.004]]], "sigma": 1e-4}
    start, forces = changed(probes=[tool], time=timed, tissue__foundation=1e5), (tmp_path / "forces.csv", 0.001)
    found = fit(start, below, ["tissue.foundation"], forces=forces, directory=tmp_path / "fit")
    assert values(found) == pytest.approx([3e5], rel=1e-4)
    assert (tmp_path / "fit" / "fit.png").stat().st_size > 10_000
    record = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert record["sigma_force"] == 0.001
    assert record["residual_force"] < 0.001


def test_what_is_far_off_counts_less_in_a_robust_fit(tracks: dict[str, Array], message: Messages) -> None:
    """But in full for its rejection."""
    seen, free = noisy(tracks, 0.1, sigma=0.1), ["tissue.foundation"]
    assert not fit(changed(), seen, free, robust=True, workers=1).model_rejected
    seen["pixel"][[7, 20]] += np.linspace(0, 40, 11)[:, None]
    plain, robust = fit(changed(), seen, free, workers=1), fit(changed(), seen, free, robust=True, workers=1)
    errors = [abs(values(one)[0] / 3e5 - 1) for one in (plain, robust)]
    assert errors[1] < 0.1 * errors[0]
    assert errors[1] < 3 * robust.parameters["tissue.foundation"].standard_error / 3e5
    message(robust.summary()[0], "the model is rejected: ", hide=r"\d[\d.]*")


def test_a_robust_fit_of_good_tracks_is_nearly_the_same(tracks: dict[str, Array]) -> None:
    # Without errors, so that sigma alone tells how well the number is known.
    key, seen = "tissue.foundation", {**tracks, "sigma": 0.1}
    plain, robust = (fit(changed(), seen, [key], robust=one, profile=one).parameters[key] for one in (False, True))
    assert robust.standard_error == pytest.approx(plain.standard_error, rel=0.01)
    np.testing.assert_allclose(np.array(robust.interval, float), np.array(plain.interval, float), rtol=1e-3)


@pytest.mark.slow
def test_errors_that_are_alike_widen_the_intervals_and_are_told(tracks: dict[str, Array]) -> None:
    # Each frame's tracks are off by one number, as when a camera shakes.
    rng, seen = np.random.default_rng(2), noisy(tracks, 0.02)
    seen["pixel"] += rng.normal(0, 0.5, (1, 11, 2))
    free = ["tissue.foundation"]
    plain = fit(changed(), seen, free, workers=1)
    assert any("neighbouring points are correlated" in note and "--correlation PX" in note for note in plain.notes)
    alike = fit(changed(), seen, free, correlation=1000, workers=1, profile=True)
    assert alike.parameters[free[0]].standard_error > 2 * plain.parameters[free[0]].standard_error
    assert not any("--correlation" in note for note in alike.notes)
    low, high = np.array(alike.parameters[free[0]].interval, float)
    assert (high - low) / (2 * 1.96) == pytest.approx(alike.parameters[free[0]].standard_error, rel=0.1)


@pytest.mark.slow
def test_the_points_move_what_is_found_about_as_far_as_is_said(device: Device) -> None:
    position = positions_in(changed(sheet__points=[33, 33]), device)[:, ::4, ::4]
    found = fit(changed(), {"time": np.arange(11) / 25, "position": position}, ["tissue.foundation"])
    one: Any = found.parameters["tissue.foundation"]
    assert found.mesh_error
    # The finer scene has a sixteenth of the error left; half of so few points are too few to tell it closely.
    assert abs(one.value - 3e5) / 4 < one.mesh_error < 4 * abs(one.value - 3e5)
    assert any("the number of points moves tissue.foundation" in note for note in found.notes)


def test_a_third_mesh_tells_the_order_of_the_mesh_error(
    tracks: dict[str, Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    def told(order: int) -> float:
        def coarse(runs: Runs, x: Array, halvings: int) -> Prediction:
            fine: Any = runs.predict_one(x)
            off = 1e-3 * (2 ** (order * halvings) - 1)
            return fine._replace(values=fine.values + off * (fine.values - tracks["pixel"][:, :1]))

        monkeypatch.setattr(Runs, "predict_coarse", coarse)
        error: Any = fit(changed(), tracks, ["tissue.foundation"], workers=1).parameters["tissue.foundation"].mesh_error
        return error

    # From half the cells to so many the change is 1 or 3 errors.
    assert told(1) == pytest.approx(told(2), rel=0.01)


def test_side_by_side_and_one_after_another_give_the_same_bits(tracks: dict[str, Array]) -> None:
    found = [fit(changed(tissue__young=3e4), noisy(tracks, 0.1), ["tissue.young"], workers=count) for count in (1, 2)]
    assert values(found[0]) == values(found[1])
    assert found[0].runs == found[1].runs


@pytest.mark.slow
def test_a_number_below_0_stays_there_and_one_that_starts_at_0_needs_bounds(
    tracks: dict[str, Array], message: Messages
) -> None:
    start, key = changed(probes__0__total=[0, 0, -1]), "probes.0.total.2"
    one: Any = fit(start, tracks, [key], bounds={key: (-5, 5)}).parameters[key]
    assert one.value == pytest.approx(-2, rel=1e-4)
    assert one.interval[0] <= one.value <= one.interval[1]
    start = changed(tissue__damping=0)
    with message.raises(SceneError, "tissue.damping", "--bounds"):
        fit(start, tracks, ["tissue.damping"])
    found = fit(start, tracks, ["tissue.damping"], bounds={"tissue.damping": (0, 1000)})
    assert values(found) == pytest.approx([200], rel=1e-4)


def test_an_interrupted_fit_leaves_nothing(tracks: dict[str, Array], tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        if done > 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(changed(tissue__young=3e4), tracks, ["tissue.young"], directory=tmp_path / "fit", progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_what_it_found(tracks: dict[str, Array], small: Path, program: Program) -> None:
    (small / "press.yaml").write_text(yaml.safe_dump({**TRUTH, "image": "speckle.png", "output": ["png"]}))
    save(small / "seen.npz", noisy(tracks, 0.1, sigma=0.1))
    given = "--set", "tissue.young=3e4", "--bounds", "tissue.young=1e4,1e5"
    done = program("fit", "press.yaml", "seen.npz", "--free", "tissue.young", "tissue.foundation", *given, "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    folder = small / "output" / "press-fit"
    record = json.loads((folder / "fit.json").read_text())
    assert said["parameters"] == record["parameters"]
    assert sorted(record["files"]) == ["fit.png", "pictures/speckle.png", "scene.yaml"]
    assert (folder / "pictures" / "speckle.png").read_bytes() == (small / "speckle.png").read_bytes()
    fitted: Any = load_scene(folder / "scene.yaml")
    assert fitted.tissue.young == record["parameters"]["tissue.young"]["value"]
    assert fitted.output == ("png",)
    young = record["parameters"]["tissue.young"]
    assert young.keys() == {"value", "standard_error", "interval", "start", "identifiable", "mesh_error"}
    assert young["interval"][0] < young["value"] < young["interval"][1]
    assert np.array(record["correlation"]).shape == (2, 2)
    assert 0.8 < record["chi_square"] / record["degrees_of_freedom"] < 1.2
    assert record["sigma"] == 0.1
    assert record["identifiable"] is True
    assert record["unseen"] == []
    # Again, in place of the first.
    done = program("fit", "press.yaml", "seen.npz", "--free", "tissue.young", "--set", "image=speckle.png")
    assert "tissue.young: 2" in done.stdout


def bad(tracks: dict[str, Array], motion: Array) -> dict[str, dict[str, Any]]:
    """What cannot be used."""
    pixel, time, still = tracks["pixel"], tracks["time"], np.repeat(tracks["pixel"][:, :1], 11, axis=1)
    hidden, mass = np.full_like(pixel, np.nan), {"time": time, "position": motion}
    lone, zeros, marked = hidden.copy(), pixel.copy(), pixel.copy()
    lone[0, 3], zeros[3, 4:], marked[3, 4:] = pixel[0, 3], 0, -9999
    seen = noisy(tracks, 0.1)
    return {
        "few": {**tracks, "pixel": lone},
        "hidden": {**tracks, "pixel": hidden},
        "still": {**tracks, "pixel": still},
        "rounded": {**tracks, "pixel": still * (1 + 1e-13 * np.random.default_rng(1).normal(size=still.shape))},
        "huge": {**tracks, "pixel": 1e40 * pixel},
        "tiny": {**tracks, "sigma": 1e-300},
        "noise": {**tracks, "sigma": 50.0},
        "missed": {**tracks, "time": np.linspace(0, 0.004, 11)},
        "mm": {**mass, "position": 1000 * motion},
        "ms": {**tracks, "time": 1000 * time},
        "late": {**tracks, "time": time + 0.1},
        "early": {**tracks, "time": time - 0.1},
        "camera": {**tracks, "pixel": 2 * pixel},
        "origin": {**mass, "position": motion + 0.05},
        "pixels": {**tracks, "coordinates": 512 * PLACES},
        "turned": {**tracks, "pixel": pixel.swapaxes(0, 1)},
        "lacks": {"time": time, "pixel": pixel},
        "both": {**tracks, "position": np.zeros((36, 11, 3))},
        # Conventions of other programs.
        "zeros": {**tracks, "pixel": zeros},
        "marked": {**tracks, "pixel": marked},
        "fractions": {**tracks, "pixel": pixel / 512},
        "numbers": {**tracks, "time": np.arange(11)},
        "from 0": {**seen, "pixel": seen["pixel"] - 0.5},
        "from 1": {**seen, "pixel": seen["pixel"] + 0.5},
        "from 1 in x": {**seen, "pixel": seen["pixel"] + [0.5, 0]},
        "upward": {**seen, "pixel": [0, 512] + seen["pixel"] * [1, -1]},
        "downward": {**mass, "position": motion * [1, -1, 1]},
        "away": {**mass, "position": motion * [1, 1, -1]},
    }


def test_what_cannot_be_used_is_answered_by_one_sentence(
    tracks: dict[str, Array], motion: Array, tmp_path: Path, message: Messages
) -> None:
    for name, arrays in bad(tracks, motion).items():
        save(tmp_path / f"{name}.npz", arrays)
        with message.raises(SceneError, f"{name}.npz: ", "; "):
            fit(changed(), tmp_path / f"{name}.npz", ["tissue.young", "tissue.foundation", "tissue.damping"], workers=1)


def test_motion_of_many_tracks_is_seen_though_it_is_smaller_than_their_errors(tracks: dict[str, Array]) -> None:
    # The square of the motion is 0.4 of that of the errors, of 36 points at 11 times.
    motion = 0.95 * np.sin(np.arange(11))[:, None]
    noise = np.random.default_rng(3).normal(0, 1, tracks["pixel"].shape)
    for moving in (True, False):
        pixel = tracks["pixel"][:, :1] + moving * motion + noise
        seen = read_observations({**tracks, "pixel": pixel, "sigma": 1.0}, 25)
        assert seen.signal(changed()) < MIN_MOTION_SIGMAS
        assert bool(list(faults([seen], changed(), 1))) != moving


@pytest.mark.parametrize(
    "arguments",
    [
        "--free tissue.yuong",
        "--free time.duration",
        "",
        "--free tissue.young --bounds tissue.young=9",
        "--free tissue.young --bounds tissue.young=3e4,9e4",
        "--free tissue.young --bounds tissue.damping=1,2",
        "--free tissue.young --forces none.csv,0.1",
        "--free tissue.young --forces none.csv",
        "--free tissue.young --free tissue.young",
        "--free tissue.young --bounds tissue.young=1,1e5 tissue.young=2,1e5",
        "--free tissue.young --set sheet.tolerance=0.1",
        "--free tissue.young --sigma 0",
        "--free tissue.young --correlation 0",
    ],
)
def test_wrong_arguments_are_answered_in_a_line(
    tracks: dict[str, Array], small: Path, program: Program, arguments: str, message: Messages
) -> None:
    (small / "press.yaml").write_text(yaml.safe_dump(TRUTH))
    save(small / "seen.npz", tracks)
    done = program("fit", "press.yaml", "seen.npz", *arguments.split())
    assert done.returncode == 2
    message(done.stderr)
    assert len(done.stderr.splitlines()) == 1
    assert not (small / "output").exists()


def saved(array: Array) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


FILES = {"empty": b"", "text": b"nothing", "no arrays": b"PK\x05\x06" + bytes(18), "single array": saved(np.ones(3))}


@pytest.mark.parametrize("case", FILES)
def test_a_file_that_is_none_is_refused(tmp_path: Path, case: str, message: Messages) -> None:
    (tmp_path / "seen.npz").write_bytes(FILES[case])
    with message.raises(SceneError, "seen.npz: "):
        fit(changed(), tmp_path / "seen.npz", ["tissue.young"])


ZEROS = f"{FORCES}0,0,0,0,0\n"
UNREADABLE: dict[str, str | bytes] = {
    "empty": "",
    "no row": FORCES,
    "no force": f"{FORCES}0.1,0,,,\n",
    "no time": f"{FORCES},0,0,0,1\n",
    "no force_z": "time,probe,force_x,force_y\n0,0,0,0\n",
    "word": f"{ZEROS}0.1,0,n/a,0,0\n",
    "huge": f"{ZEROS}0.1,0,0,1e308,0\n",
    "twice": f"{ZEROS}0,0,0,0,1\n",
    "decimal commas": f"{ZEROS}0,1,0,0,0,0,0,-0,5\n",
    # A German -1.234 is a thousand times as much.
    "both decimal marks": FORCES.replace(",", ";") + "0,2;0;0;0;-1.234\n",
    "millinewtons": f"{FORCES}s,-,mN,mN,mN\n0,0,0,0,1\n",
    # One thousand two hundred and thirty-four, or a decimal comma.
    "comma between commas": f'{FORCES}0,0,0,1,"1,234"\n',
    "row that ends early": f"{ZEROS}0.1,0,0,0\n",
    "row that ends early, after spaces": "time probe force_x force_y force_z\n0 0 0 0\n",
    "no probe": f"{FORCES}0,,0,0,1\n",
    "no such probe": f"{ZEROS}0.1,1,0,0,1\n",
    "names not in a cell each": FORCES.replace("time", "time s") + "0,0,0,0,1\n",
    "column twice": f"{FORCES.strip()},force_z [N]\n0,0,0,0,1,2\n",
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_a_table_of_forces_that_cannot_be_read_is_refused(tmp_path: Path, case: str, message: Messages) -> None:
    table = UNREADABLE[case]
    (tmp_path / "forces.csv").write_bytes(table.encode() if isinstance(table, str) else table)
    with message.raises(SceneError, "forces.csv"):
        read_forces(tmp_path / "forces.csv", 0.1, 1)


@pytest.mark.parametrize(
    "data",
    [
        b'# a rig\n"time","probe","force_x","force_y","force_z"\ns,-,N,N,N\n# it begins\n"0.1","0","","","-0.5"\n',
        b"time [s];probe;force_x [N];force_y [N];force_z [N]\n0,1;0;;;-0,5\n",
        b"# time,probe,force_x,force_y,force_z\n0.1,0,,,-0.5\n",
        b"\xef\xbb\xbftime,probe,force_x,force_y,force_z,rig\n0.1,0,,,-0.5,W\xe4ge 1, \n",
        b"time,probe,force_z,force_x,force_y\n0.1,0,-0.5,,\n",
        b"sep=;\nA rig; of a lab\nTime;Probe;Force_X;Force_Y;Force_Z\n[s];[-];[N];[N];[N]\n0,1;0;;;-0,5\n% end\n;;;;\n",
    ],
    ids=["quotes, units, comments", "decimal commas", "commented header", "damaged byte", "empty cells", "titles"],
)
def test_tables_of_other_programs_are_understood(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "forces.csv").write_bytes(data)
    read = read_forces(tmp_path / "forces.csv", 0.1, 1)
    assert (read.time.tolist(), read.probe.tolist()) == ([0.1], [0])
    np.testing.assert_array_equal(read.values, [[np.nan, np.nan, -0.5]])


def test_arrays_that_are_not_needed_are_left_unread(
    tracks: dict[str, Array], tmp_path: Path, message: Messages
) -> None:
    save(tmp_path / "seen.npz", {**tracks, "meta": np.array({"rig": 1}, object)})
    assert read_observations(tmp_path / "seen.npz", 25).values.shape == tracks["pixel"].shape
    save(tmp_path / "seen.npz", {**tracks, "time": np.array([{}], object)})
    with message.raises(SceneError, "seen.npz: time: ", "objects"):
        read_observations(tmp_path / "seen.npz", 25)


HEADER = b"\x93NUMPY\x01\x00"


@pytest.mark.parametrize(
    ("data", "method", "changes"),
    [
        (HEADER + bytes(200), zipfile.ZIP_DEFLATED, {38: 0xFF}),
        (HEADER + bytes(200), zipfile.ZIP_STORED, {6: 1, -22 - 54 + 8: 1}),
        (HEADER + b"\x04\x00((\n(", zipfile.ZIP_STORED, {}),
        (HEADER + b"\x40\x1f" + b"-" * 8000, zipfile.ZIP_STORED, {}),
    ],
    ids=["deflate", "encrypted", "tokens", "deep"],
)
def test_an_array_that_cannot_be_read_is_named(
    tmp_path: Path, data: bytes, method: int, changes: dict[int, int], message: Messages
) -> None:
    with zipfile.ZipFile(tmp_path / "seen.npz", "w", method) as archive:
        archive.writestr("time.npy", data)
    damaged = bytearray((tmp_path / "seen.npz").read_bytes())
    for at, byte in changes.items():
        damaged[at] = byte
    (tmp_path / "seen.npz").write_bytes(damaged)
    with message.raises(SceneError, "seen.npz: time: ", hide=r"(?<=cannot be read: )[^;]*") as caught:
        read_observations(tmp_path / "seen.npz", 25)
    assert "\n" not in str(caught.value)
    assert "ZipInfo" not in str(caught.value)


@pytest.mark.parametrize("factor", [1, 1.1, -1, 1000, 101.97, 0.001])
def test_units_and_signs_of_forces_are_asked_about(
    tracks: dict[str, Array], device: Device, tmp_path: Path, factor: float, message: Messages
) -> None:
    rows = [FORCES.strip()]
    with Simulation(changed(), threads=device.threads) as simulation:
        for _ in range(5):
            simulation.advance()
            rows.append(f"{simulation.time},0,,,{factor * simulation.forces()[0].force[2]}")
    (tmp_path / "forces.csv").write_text("\n".join(rows))
    # The force of the tool is given, so that no parameter scales it.
    given = changed(tissue__young=2e5), noisy(tracks, 0.1, sigma=0.1), ["tissue.young"]
    forces = tmp_path / "forces.csv", 0.01 * abs(factor)
    if factor not in (1, 1.1):
        with message.raises(SceneError, "forces.csv"):
            fit(*given, forces=forces, workers=1)
        return
    found = fit(*given, forces=(forces[0], 0.01), workers=1)
    assert not any("times those of the scene" in note for note in found.notes)
    assert (", mostly of the forces, which are 1.1 times the predicted ones" in found.summary()[0]) == (factor == 1.1)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.filterwarnings("error:::taichi_msm")
def test_an_exact_fit_has_errors_next_to_0(device: Device, robust: bool) -> None:
    free = ["tissue.young", "tissue.foundation"]
    empty = read_observations({"time": np.arange(11) / 25, "coordinates": PLACES, "position": np.ones((36, 11, 3))}, 25)
    job = FitProblem("token", without_outputs(changed()), make_parameters(changed(), free, {}), (empty,))
    predictor = ForwardModel(job, device.threads)
    seen = {
        "time": empty.time,
        "coordinates": PLACES,
        "position": predictor.predict(np.zeros(2), to_end=True).values[0],
    }
    predictor.close()
    found = fit(changed(), seen, free, robust=robust, profile=True, workers=1)
    assert found.residual == 0
    assert values(found) == [2e4, 3e5]
    assert found.identifiable
    assert all(0 < one.standard_error < 1e-6 * one.value for one in found.parameters.values())
    assert any("the residual is next to 0" in note and "--sigma" in note for note in found.notes)
    assert not any("nan" in line or "inf" in line for line in found.summary()[:-1])
    told = fit(changed(), seen, free, robust=robust, sigma=1e-5, workers=1)
    assert told.chi_square == 0
    assert not any("the residual is next to 0" in note for note in told.notes)


def near_the_sheet(motion: Array, device: Device) -> tuple[Scene, dict[str, Array]]:
    """A camera that a third of the places are behind, and what it sees."""
    scene = changed(render__camera={"eye": [0, -0.02, 0.01], "target": [0, 0.05, 0]})
    pixel = pixels_in(scene, motion, device)
    assert np.isnan(pixel).any(axis=(1, 2)).sum() == 12
    return scene, {"time": np.arange(11) / 25, "coordinates": PLACES, "pixel": pixel}


def test_points_that_the_camera_does_not_see_have_no_part_in_a_correlation(motion: Array, device: Device) -> None:
    scene, seen = near_the_sheet(motion, device)
    seen = noisy(seen, 0.1, sigma=0.1)
    seen["pixel"][30, 2:5] = np.nan
    there = np.isfinite(seen["pixel"]).any(axis=(1, 2))
    fewer = {**seen, "coordinates": PLACES[there], "pixel": seen["pixel"][there]}
    whole, part = (
        fit(scene, each, ["tissue.foundation"], correlation=50, workers=1).parameters["tissue.foundation"]
        for each in (seen, fewer)
    )
    assert 0 < whole.standard_error < 0.1 * whole.value
    assert whole.standard_error == pytest.approx(part.standard_error, rel=1e-9)


def test_points_behind_the_eye_are_refused_where_they_were_seen(
    motion: Array, device: Device, message: Messages
) -> None:
    scene, seen = near_the_sheet(motion, device)
    unseen = np.isnan(seen["pixel"])
    seen["pixel"][unseen] = np.arange(unseen.sum())
    with message.raises(SceneError, "pixel: 12 "):
        fit(scene, seen, ["tissue.young"], workers=1)


def test_a_calibrated_camera_comes_back(tracks: dict[str, Array], motion: Array, device: Device) -> None:
    camera, truth = {"eye": [0, -0.06, 0.09]}, {"fx": 700, "fy": 710, "cx": 255.5, "cy": 250.5}
    pixel = pixels_in(changed(render__camera={**camera, "intrinsics": truth}), motion, device)
    start = changed(render__camera={**camera, "intrinsics": {"fx": 702, "fy": 708, "cx": 254.5, "cy": 251.5}})
    keys = [f"render.camera.intrinsics.{name}" for name in truth]
    # Focal lengths by their logs, the principal point in widths and heights of the picture.
    assert [one.scale for one in make_parameters(start, keys, {})] == [0, 0, 512, 512]
    found = fit(start, {**tracks, "pixel": pixel, "sigma": 1.0}, keys, workers=1)
    np.testing.assert_allclose(values(found), list(truth.values()), atol=1e-3)
    assert found.identifiable


def test_a_number_of_a_named_camera_is_found(tracks: dict[str, Array]) -> None:
    data = changed().model_dump(mode="json", exclude_none=True)
    cameras = {"left": {"eye": [0.001, -0.06, 0.09]}, "right": {"beside": "left", "baseline": 0.004}}
    data["render"] = {"tracks": 6, "cameras": cameras}
    found = fit(data, tracks, ["render.cameras.left.eye.0"], workers=1)
    np.testing.assert_allclose(values(found), [0], atol=1e-6)


WRONG_TYPES: dict[str, dict[str, Any]] = {
    "free, text": {"free": "tissue.young"},
    "observed": {"observed": 5},
    "scene": {"scene": 5},
    "bounds, list": {"bounds": [("tissue.young", 1, 2)]},
    "forces": {"forces": "forces.csv"},
    "workers": {"workers": 0},
    "sigma": {"sigma": "0.5"},
    "robust": {"robust": "yes"},
    "unknown": {"profiles": True},
}


@pytest.mark.parametrize("case", WRONG_TYPES)
def test_arguments_of_a_wrong_type_are_answered_in_a_line(
    tracks: dict[str, Array], case: str, message: Messages
) -> None:
    given: dict[str, Any] = {"scene": changed(), "observed": tracks, "free": ["tissue.young"], **WRONG_TYPES[case]}
    with message.raises(ArgumentError):
        fit(given.pop("scene"), given.pop("observed"), given.pop("free"), **given)


def test_methods_are_those_that_are_described() -> None:
    assert fit.__doc__ is not None
    assert all(f"{name}" in fit.__doc__ for name in Method.__annotations__)


@pytest.mark.slow
def test_tracks_that_drift_widen_the_intervals(tracks: dict[str, Array]) -> None:
    seen = noisy(tracks, 0.05)
    seen["pixel"] += np.cumsum(np.random.default_rng(3).normal(0, 0.1, tracks["pixel"].shape), axis=1)
    free = ["tissue.young", "tissue.foundation"]
    plain = fit(changed(), seen, free, workers=1)
    drifting = fit(changed(), seen, free, drift=1.0, workers=1)
    assert any("--drift SECONDS" in line for line in plain.summary())
    assert plain.model_rejected
    assert not drifting.model_rejected
    assert not any("--drift" in line for line in drifting.summary())
    widening = drifting.parameters[free[1]].standard_error / plain.parameters[free[1]].standard_error
    assert 1.2 < widening < 11**0.5


@pytest.mark.parametrize("case", ["sigma", "no sigma", "two times"])
def test_a_wrong_scene_is_rejected_first_of_all(tracks: dict[str, Array], case: str, message: Messages) -> None:
    """By another damping; without sigma by the pattern of what is left, also at two times."""
    seen = noisy(tracks, 0.05, sigma=0.05) if case == "sigma" else noisy(tracks, 0.02)
    if case == "two times":
        seen |= {"time": seen["time"][5:7], "pixel": seen["pixel"][:, 5:7]}
    wrong, right = (fit(changed(tissue__damping=g), seen, ["tissue.foundation"], workers=1) for g in (600, 200))
    assert (wrong.as_json()["model_rejected"], right.as_json()["model_rejected"]) == (True, False)
    message(wrong.summary()[0], "the model is rejected: ", hide=r"\d[\d.]*")
    assert "rejected" not in right.summary()[0]


NOISE = [ErrorCorrelation(None, None), ErrorCorrelation(5.0, None), ErrorCorrelation(None, 1.0)]


@pytest.mark.parametrize("alike", NOISE, ids=["independent", "alike in space", "alike in time"])
def test_noise_is_not_taken_for_a_wrong_model(alike: ErrorCorrelation) -> None:
    """Also where some jump, and some were not seen."""
    rng, wolves = np.random.default_rng(4), 0
    times = np.arange(9.0)
    for _ in range(400):
        left = rng.normal(0, 1, (36, 9, 2))
        left += 0 if alike.correlation is None else rng.normal(0, 2, (1, 9, 2))
        left = left if alike.drift is None else np.cumsum(left, axis=1)
        left[rng.random(left.shape) < 0.05] *= 10
        left[rng.random(left.shape[:2]) < 0.1] = np.nan
        wolves += Pixels("", times, left, None, PLACES).pattern(left, 10.0, alike) is not None
    # Of 400, 0.4 are expected; more than 3 have a probability of 1e-3.
    assert wolves <= 3
    times = np.arange(40.0)
    wrong = np.sin(times / 6)[:, None] + rng.normal(0, 1, (36, 40, 2))
    assert Pixels("", times, wrong, None, PLACES).pattern(wrong, 10.0, alike) is not None
