"""What a study measures is what it says."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from taichi_msm import reference
from taichi_msm.physics.lattice import rest_positions
from taichi_msm.physics.solver import structure
from taichi_msm.physics.timestep import stable_step, step, steps_per_frame, with_time
from taichi_msm.study import pictures
from taichi_msm.study.peer import TooSlowError, solve
from taichi_msm.study.pictures import PictureStudy
from taichi_msm.study.result import Drawn, Stepping, Study, Timing
from taichi_msm.study.stepping import MARGIN, ROUNDS, SteppingStudy, observed_orders
from taichi_msm.study.terms import TermStudy, variants
from taichi_msm.system.runtime import Device
from tests.scenes import PRESS, SPRINGS, scene, speckle

SOFT_PRESS = {**PRESS, "force": [0, 300, -1000]}


def nothing(done: int, total: int) -> None:
    assert 0 <= done <= total


@pytest.fixture(scope="module")
def stepping(device: Device) -> Any:
    """A study of a small scene with a release on a step."""
    made = scene(probes=[SOFT_PRESS], damping=0.02, time={"damping_difference": "backward"})
    with closing(SteppingStudy(made, device, 0.05, nothing)) as measured:
        measured.run()
        yield measured


def test_stepping_starts_at_the_largest_stable_step_and_halves_it(stepping: SteppingStudy) -> None:
    points = stepping.points()
    assert {point.method for point in points} == {"f32 central", "f32 backward", "f64 central", "f64 backward"}
    for method in ("f32 central", "f64 backward"):
        steps = [point.step for point in points if point.method == method]
        limit = stable_step(with_time(stepping.scene, damping_difference=method.split()[1]))
        assert 0.5 * limit < steps[0] <= limit
        np.testing.assert_allclose(np.divide(steps[:-1], steps[1:]), 2)
        assert len(steps) >= 3
    assert all(point.seconds.runs == ROUNDS for point in points)
    assert all(point.seconds.fastest <= point.seconds.median <= point.seconds.slowest for point in points)


def test_errors_of_stepping_are_those_of_the_twin(stepping: SteppingStudy) -> None:
    point = next(point for point in stepping.points() if point.method == "f64 backward")
    made = with_time(stepping.scene, step=point.step, precision="f64")
    exact = reference.simulate(with_time(made, step=point.step / 64, damping_difference="central"))
    wrong = reference.simulate(made) - exact
    largest = np.linalg.norm(exact - exact[0], axis=-1).max()
    # 64 times finer, of order 2 beside one of order 1, the twin is off by 1 % of the error or less.
    assert point.error == pytest.approx(np.linalg.norm(wrong, axis=-1).max() / largest, rel=0.01)
    assert stepping.reference is not None
    assert stepping.reference.largest == pytest.approx(largest, rel=1e-5)


def test_the_reference_is_as_exact_as_it_says(stepping: SteppingStudy) -> None:
    assert stepping.frames is not None
    assert stepping.reference is not None
    made = with_time(stepping.scene, damping_difference="central")
    solved, _ = solve(made, 1e-12, 1e-14, float("inf"), lambda: None)
    error = np.linalg.norm(solved - stepping.frames, axis=-1).max() / stepping.reference.largest
    # The integrator keeps 1e-12 a step, of some thousand steps.
    assert error < stepping.reference.error + 1e-9
    for point in stepping.points():
        assert point.error is not None
        assert point.known == (point.error >= MARGIN * stepping.reference.error)


def test_observed_orders(stepping: SteppingStudy) -> None:
    orders = observed_orders(stepping.points())
    assert orders["f64 backward"] == pytest.approx(1, abs=0.15)
    # From the limit of stability down the first halvings are not in the range of the asymptote yet.
    assert orders["f64 central"] == pytest.approx(2, abs=0.3)


def test_orders_are_fitted_above_the_rounding_floor() -> None:
    def point(step: float, error: float, rounding: float) -> Stepping:
        return Stepping("f32", "central", 1, step, error, rounding, True, Timing(1, 1, 1, 5))

    points = [point(0.1**n, 0.1 ** (2 * n) + 1e-6, 1e-6) for n in range(5)]
    # The points of 1e-6 and 2e-6 are mostly rounding; the next is, by 1 %.
    assert observed_orders(points) == {"f32 central": pytest.approx(2, abs=0.01)}
    assert observed_orders(points[2:]) == {"f32 central": None}


def test_a_series_halves_its_steps_though_they_miss_a_jump(device: Device) -> None:
    # A release at 3.25 frames, which no ninth of a frame meets.
    made = scene(probes=[{**SOFT_PRESS, "load": [[0, 100], [0.13, 100], [0.13, 0]]}], time={"duration": 0.2})
    with closing(SteppingStudy(made, device, 0.001, nothing)) as measured:
        measured.run()
        counts = [point.steps_per_frame for point in measured.points() if point.method == "f64 central"]
    assert counts == [9, 18, 36]


def test_dop853_solves_moving_and_jumping_probes() -> None:
    at = [[0, 0.2, 0.3], [0.2, 0.6, 0.5], [0.2, 0.4, 0.4], [0.3, 0.5, 0.7]]
    probe = {"at": at, "force": [200, 100, -500], "load": [[0.05, 50], [0.3, 100], [0.3, 0]], "falloff": 20}
    made = scene(probes=[probe], springs={**SPRINGS, "virtual": 5}, time={"step": 0.04 / 320})
    solved, evaluations = solve(made, 1e-8, 1e-12, float("inf"), lambda: None)
    coarse, fine = (
        (reference.simulate(with_time(made, step=0.04 / cut)) - rest_positions(made.sheet))[1:] for cut in (160, 320)
    )
    largest = np.abs(solved).max()
    error = np.abs(solved - fine).max()
    # The twin's own error, of order 2 as every jump is on a step: a third of what a halving changes.
    assert error == pytest.approx(np.abs(fine - coarse).max() / 3, rel=0.1)
    assert error < 1e-3 * largest
    assert solved.shape == (10, 9, 11, 3)
    assert evaluations > 100


def test_a_timing_is_a_median_with_its_spread() -> None:
    assert Timing.of([3.0, 1.0, 9.0, 2.0, 4.0]) == Timing(3.0, 1.0, 9.0, 5)


def test_an_error_near_that_of_the_reference_is_not_known(stepping: SteppingStudy) -> None:
    assert stepping.reference is not None
    assert stepping.known(21 * stepping.reference.error)
    assert not stepping.known(19 * stepping.reference.error)


def test_dop853_gives_up_in_time() -> None:
    with pytest.raises(TooSlowError):
        solve(scene(), 1e-3, 1e-6, 0.0, lambda: None)


def test_terms_are_left_out_of_the_kernel(device: Device) -> None:
    made = scene(probes=[PRESS, PRESS])
    shapes = {name: structure(variant, device).code for name, variant in variants(made)}
    assert list(shapes) == [
        "",
        "springs.structural",
        "springs.shear",
        "springs.virtual",
        "damping",
        "probes.0",
        "probes.1",
    ]
    assert shapes[""].structural
    assert shapes[""].shear
    assert not shapes["springs.structural"].structural
    assert not shapes["springs.shear"].shear
    assert not shapes["springs.virtual"].virtual
    assert not shapes["damping"].damped
    assert len(shapes["probes.1"].slots_move) == 1
    assert {steps_per_frame(variant) for _, variant in variants(made)} == {steps_per_frame(made)}
    assert list(dict(variants(scene(springs={}, damping=0, probes=[])))) == [""]


def test_terms_are_timed(device: Device) -> None:
    measured = TermStudy(scene(damping=0, springs={"shear": 10}), device, 0.001, nothing)
    measured.run()
    assert [term.without for term in measured.points()] == ["", "springs.shear", "probes.0"]
    assert all(1e-8 < term.seconds.median < 1e-2 and term.seconds.runs == 9 for term in measured.points())


def test_pictures_are_judged_by_a_finer_one(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "REFINES", (0, 3))
    monkeypatch.setattr(pictures, "SUPERSAMPLES", (1, 4))
    monkeypatch.setattr(pictures, "FINEST", {"refine": 4, "supersample": 5})
    made = scene(render={"size": [60, 45], "camera": "oblique", "refine": 3})
    position = rest_positions(made.sheet)
    position[4, 5, 2] += 0.05
    measured = PictureStudy(made, position, speckle(20, 30), False, nothing)
    measured.run()
    points = {(point.refine, point.supersample): point for point in measured.points()}
    assert set(points) == {(0, 1), (3, 1), (0, 4), (3, 4)}
    psnr = {setting: point.psnr or 0.0 for setting, point in points.items()}
    assert psnr[3, 4] > max(psnr[0, 4], psnr[3, 1]) > psnr[0, 1]
    assert points[3, 4].largest_error < points[0, 1].largest_error
    # By the twin.
    fine = made.model_copy(update={"render": BaseModel.model_copy(made.render, update=pictures.FINEST)})
    own = made.model_copy(update={"render": made.render.model_copy(update={"refine": 0})})
    apart = reference.draw(fine, position, speckle(20, 30)).astype(float) - reference.draw(
        own, position, speckle(20, 30)
    )
    assert psnr[0, 1] == pytest.approx(10 * np.log10(255**2 / (apart**2).mean()), abs=0.1)


def test_psnr_is_of_values_to_255() -> None:
    black = np.zeros((4, 5, 3), np.uint8)
    assert pictures.psnr(black + np.uint8(51), black) == pytest.approx(20 * np.log10(5), abs=1e-12)
    assert pictures.psnr(black, black) is None


def test_a_quick_study_of_pictures_varies_one_at_a_time(device: Device) -> None:
    made = scene(render={"size": [6, 4], "refine": 2, "supersample": 3})
    measured = PictureStudy(made, rest_positions(made.sheet), speckle(3, 3), True, nothing)
    settings = measured._settings
    assert settings == [(2, 1), (2, 2), *((refine, 3) for refine in (0, 1, 2, 5, 10, 20)), (2, 4)]


def stepping_point(error: float | None, seconds: float, **changes: Any) -> Stepping:
    values: dict[str, Any] = {"precision": "f32", "damping_difference": "central", "steps_per_frame": 40, "step": 0.001}
    return Stepping(
        **values | changes,
        error=error,
        rounding=0.0,
        known=True,
        seconds=Timing(seconds, seconds, seconds, 5),
    )


def drawn(refine: int, psnr: float | None, seconds: float, supersample: int = 1) -> Drawn:
    return Drawn(refine, supersample, psnr, 1, Timing(seconds, seconds, seconds, 5))


def test_the_recommendation_is_the_cheapest_within_the_tolerance() -> None:
    made = Study("press", scene().model_dump(), "complete", 1e-3, {})
    assert made.recommendation() == []
    made.stepping = [
        stepping_point(2e-3, 1.0),
        stepping_point(9e-4, 3.0, precision="f64"),
        stepping_point(5e-4, 2.0, step=0.0005),
        stepping_point(None, 0.5),
    ]
    made.settings["time"]["tolerance"] = 1e-4
    made.drawing = [drawn(0, 40.0, 1.0), drawn(1, 49.95, 2.0), drawn(2, 50.0, 3.0), drawn(1, 60.0, 0.1, supersample=2)]
    assert made.recommendation() == [
        "time:",
        "  tolerance: null",
        "  step: 0.0005",
        "  damping_difference: central",
        "  precision: f32",
        "render:",
        "  refine: 1",
        "  supersample: 1",
    ]


def test_the_step_recommended_is_one_that_a_scene_takes() -> None:
    # Written with few digits, it must still divide a frame.
    made = Study("press", scene().model_dump(), "complete", 1e-3, {})
    made.stepping = [stepping_point(1e-4, 1.0, step=1 / 25 / 77, steps_per_frame=77)]
    text = made.recommendation()[1].split(": ")[1]
    assert steps_per_frame(with_time(scene(), step=float(text))) == 77
    assert step(scene(time={"step": float(text)})) == 1 / (25 * 77)


def test_of_one_method_the_largest_step_is_recommended() -> None:
    made = Study("press", scene().model_dump(), "complete", 1e-3, {})
    made.stepping = [stepping_point(5e-4, 1.1, step=0.001), stepping_point(1e-4, 1.0, step=0.0005)]
    assert made.best_stepping is made.stepping[0]


def test_an_interruption_leaves_what_is_done(device: Device) -> None:
    calls = 0

    def stop(done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls > 90:
            raise KeyboardInterrupt

    with closing(SteppingStudy(scene(probes=[SOFT_PRESS]), device, 0.01, stop)) as measured:
        with pytest.raises(KeyboardInterrupt):
            measured.run()
        assert measured.reference is not None
        assert measured.points()
