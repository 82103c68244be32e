"""What a study measures is what it says."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
import yaml
from pydantic import BaseModel

from taichi_msm.accuracy.mesh import with_points
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import with_time
from taichi_msm.study import measurements
from taichi_msm.study.measurements import (
    REFERENCE_MARGIN,
    ROUNDS,
    MeshStudy,
    SteppingStudy,
    _reference,
    measure_pictures,
    mesh_plans,
)
from taichi_msm.study.result import DrawingMeasurement, SteppingMeasurement, Study, observed_orders
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.motion import frames_on
from tests.scenes import PRESS, plan_of, scene, speckle
from tests.terms.test_contact import PRESSED, moved, touching

SOFT_PRESS = {**PRESS, "force": [0, 300, -1000]}


def study_of(made: Scene) -> Study:
    return Study("press", made.model_dump(), "complete", 1e-3, {})


def nothing(done: int, total: int) -> None:
    assert 0 <= done <= total


def stepping_study(made: Scene, device: Device, longest_run: float) -> tuple[Study, Any]:
    """The study of the steps of a scene, and the reference displacements."""
    study = study_of(made)
    return study, SteppingStudy(plan_of(made), device, longest_run, study, nothing).run()


# A release on a step.
RELEASE = scene(probes=[SOFT_PRESS], damping=0.02, time={"damping_difference": "backward"})


@pytest.fixture(scope="module")
def stepping(device: Device) -> tuple[Study, Any]:
    return stepping_study(RELEASE, device, 0.05)


def test_stepping_starts_at_the_largest_stable_step_and_halves_it(stepping: tuple[Study, Any]) -> None:
    points = stepping[0].stepping
    assert {point.method for point in points} == {"f32 central", "f32 backward", "f64 central", "f64 backward"}
    for method in ("f32 central", "f64 backward"):
        steps = [point.step for point in points if point.method == method]
        limit = plan_of(with_time(RELEASE, damping_difference=method.split()[1])).stable_step
        assert 0.5 * limit < steps[0] <= limit
        np.testing.assert_allclose(np.divide(steps[:-1], steps[1:]), 2)
        assert len(steps) >= 3
    assert all(point.seconds.runs == ROUNDS for point in points)
    assert all(point.seconds.fastest <= point.seconds.median <= point.seconds.slowest for point in points)


def test_errors_of_stepping_are_those_of_the_twin(stepping: tuple[Study, Any]) -> None:
    study, _ = stepping
    point = next(point for point in study.stepping if point.method == "f64 backward")
    made = with_time(RELEASE, step=point.step, precision="f64")
    exact = reference.simulate(with_time(made, step=point.step / 16, damping_difference="central"))
    wrong = reference.simulate(made) - exact
    largest = np.linalg.norm(exact - exact[0], axis=-1).max()
    # 16 times finer, of order 2 where the other is of order 1, the twin is off by 1 % of the error or less.
    assert point.error == pytest.approx(np.linalg.norm(wrong, axis=-1).max() / largest, rel=0.01)
    assert study.reference is not None
    assert study.reference.largest == pytest.approx(largest, rel=1e-5)


def test_the_reference_is_as_exact_as_it_says(stepping: tuple[Study, Any], device: Device) -> None:
    study, frames = stepping
    assert study.reference is not None
    plan, steps = (
        plan_of(with_time(RELEASE, damping_difference="central", precision="f64")),
        study.reference.steps_per_frame,
    )
    coarse, fine = (frames_on(plan.with_grid(steps_per_frame=n * steps), device) for n in (2, 4))
    # Extrapolated from steps a quarter as long, it has 1 / 4^4 of the error.
    error = max_norm(frames - (fine + (fine - coarse) / 3)) / study.reference.largest
    # Some ten thousand steps round by 1e-16 each.
    assert error < study.reference.error + 1e-11
    for point in study.stepping:
        assert point.error is not None
        assert point.known == (point.error >= REFERENCE_MARGIN * study.reference.error)


def test_orders_are_fitted_above_the_rounding_floor() -> None:
    def point(step: float, error: float, rounding: float) -> SteppingMeasurement:
        return SteppingMeasurement("f32", "central", 1, step, error, rounding, True, samples=[1.0])

    points = [point(0.1**n, 0.1 ** (2 * n) + 1e-6, 1e-6) for n in range(5)]
    # The points of 1e-6 and 2e-6 are mostly rounding; the next is, by 1 %.
    assert observed_orders(points) == {"f32 central": pytest.approx(2, abs=0.01)}
    assert observed_orders(points[2:]) == {"f32 central": None}


def test_a_series_halves_its_steps_though_they_miss_a_jump(device: Device) -> None:
    # A release at 3.25 frames, which no ninth of a frame meets.
    made = scene(probes=[{**SOFT_PRESS, "load": [[0, 100], [0.13, 100], [0.13, 0]]}], time={"duration": 0.2})
    study, _ = stepping_study(made, device, 0.001)
    assert [point.steps_per_frame for point in study.stepping if point.method == "f64 central"] == [9, 18, 36]


@pytest.mark.slow
def test_a_study_takes_no_steps_in_which_a_tool_moves_too_far(device: Device) -> None:
    fast = moved([0, 0.5, 0.5, 0.1], [0.1, 0.9, 0.5, 0.1], instrument={"radius": 0.005})
    made = touching([fast], time={"step": 0.001, "duration": 0.04})
    assert plan_of(made).stable_step > 0.01
    study, _ = stepping_study(made, device, 0.001)
    assert max(point.step for point in study.stepping) <= 0.005 / 2 / 1.6


@pytest.mark.slow
def test_the_reference_in_contact_is_the_finest_run(device: Device) -> None:
    made = touching([PRESSED])
    study, frames = stepping_study(made, device, 0.01)
    assert study.reference is not None
    steps = study.reference.steps_per_frame
    fine, half = (frames_on(plan_of(made).with_grid(steps_per_frame=n), device) for n in (steps, steps // 2))
    assert frames.tobytes() == fine.tobytes()
    assert study.reference.error == max_norm(fine - half) / max_norm(fine)


def test_points_in_contact_are_not_extrapolated() -> None:
    fields = [np.full((count, count, 3), value) for count, value in ((7, 4.0), (13, 2.0), (25, 1.0))]
    exact, bound = _reference(fields, extrapolate=False)
    assert exact is fields[-1]
    assert bound == pytest.approx(3**0.5)


TISSUE = {"young": 3e3, "thickness": 2e-3, "density": 1050}


def tissue(points: tuple[int, int] = (33, 33), **time: Any) -> Scene:
    """A tense sheet under a tool that covers it, whose displacement is smooth: (S / K)^(1/2) = 16 mm are many cells."""
    return Scene(
        sheet={"points": points, "size": [0.1, 0.1]},
        tissue={**TISSUE, "foundation": 2e4, "damping": 40, "pretension": 5},
        probes=[{"total": [0, 0, -0.2], "radius": 0.2, "falloff": 100, "load": [[0, 0], [0.2, 100]]}],
        time={"duration": 0.2, "frames_per_second": 25, "precision": "f64", **time},
        output=[],
    )


def points_study(made: Scene, device: Device, longest_run: float) -> Study:
    study = study_of(made)
    MeshStudy(plan_of(made), device, longest_run, study, nothing).run()
    return study


@pytest.fixture(scope="module")
def points(device: Device) -> Study:
    return points_study(tissue(), device, 2.0)


def test_the_error_of_points_is_that_against_many_more(points: Study, device: Device) -> None:
    assert points.notes == []
    assert [one.name for one in points.points] == ["9 x 9", "17 x 17", "33 x 33", "65 x 65"]
    assert [one.known for one in points.points[:3]] == [True] * 3
    assert all(one.seconds.runs == ROUNDS for one in points.points)
    many = tissue((65, 65))
    steps = plan_of(many).grid.steps_per_frame

    def displacements(count: int) -> Any:
        return frames_on(plan_of(with_points(many, (count, count))).with_grid(steps_per_frame=steps), device)

    exact = displacements(65)
    largest = np.linalg.norm(exact, axis=-1).max()
    for found in points.points[1:3]:
        stride = 64 // (found.rows - 1)
        apart = np.linalg.norm(displacements(found.rows) - exact[:, ::stride, ::stride], axis=-1).max() / largest
        # 65 x 65 have 1/4 of the error of 33 x 33 themselves; and between the points it may be somewhat larger.
        assert apart <= (found.error or 0.0) < 1.6 * apart


def test_without_time_for_more_points_the_error_of_the_finest_is_a_bound(
    points: Study, device: Device, message: Messages
) -> None:
    measured = points_study(tissue(), device, 1e-6)
    found, better = measured.points, points.points
    message(measured.notes, "65 x 65")
    assert [one.name for one in found] == ["9 x 9", "17 x 17", "33 x 33"]
    assert found[0].known
    assert not found[2].known
    assert (found[2].error or 0.0) > (better[2].error or 1.0)


def points_of(plans: Iterable[Plan]) -> list[tuple[int, int]]:
    return [plan.scene.sheet.points for plan in plans]


def test_points_are_quarters_and_halves_of_the_cells() -> None:
    assert points_of(mesh_plans(plan_of(tissue((31, 31))))) == [(9, 9), (16, 16), (31, 31)]
    assert points_of(mesh_plans(plan_of(tissue((41, 25))))) == [(11, 7), (21, 13), (41, 25)]
    # Too few to be compared with half as many; and cells that would be too long.
    assert points_of(mesh_plans(plan_of(tissue((13, 15))))) == [(7, 8), (13, 15)]
    assert points_of(mesh_plans(plan_of(tissue((6, 6))))) == []
    assert points_of(mesh_plans(plan_of(tissue((46, 27))))) == [(23, 14), (46, 27)]


def test_sheets_without_a_study_of_points(device: Device, message: Messages) -> None:
    few, springs = points_study(tissue((6, 6)), device, 1.0), points_study(scene(), device, 1.0)
    assert few.points == springs.points == []
    assert springs.notes == []
    message(few.notes, "7")


def test_an_interruption_leaves_the_points_that_were_timed(device: Device) -> None:
    made = study_of(tissue((13, 13)))

    def stop(done: int, total: int) -> None:
        # The first runs and the errors of three are done, and one was timed once.
        if done == 2 * 3 + 1 + 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        MeshStudy(plan_of(tissue((13, 13))), device, 0.25, made, stop).run()
    made.finish()
    assert [(one.name, one.seconds.runs) for one in made.points] == [("7 x 7", 1)]
    assert made.points[0].error is not None


@pytest.mark.slow
def test_pictures_are_judged_by_a_finer_one(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements, "REFINES", (0, 3))
    monkeypatch.setattr(measurements, "SUPERSAMPLES", (1, 4))
    monkeypatch.setattr(measurements, "REFERENCE_RENDER", {"refine": 4, "supersample": 5})
    made = scene(render={"size": [60, 45], "camera": "oblique", "refine": 3})
    position = rest_positions(made.sheet)
    position[4, 5, 2] += 0.05
    study = study_of(made)
    measure_pictures(made, position, speckle(20, 30), False, study, nothing)
    points = {(point.refine, point.supersample): point for point in study.drawing}
    assert set(points) == {(0, 1), (3, 1), (0, 4), (3, 4)}
    psnr = {setting: point.psnr or 0.0 for setting, point in points.items()}
    assert psnr[3, 4] > max(psnr[0, 4], psnr[3, 1]) > psnr[0, 1]
    assert points[3, 4].largest_error < points[0, 1].largest_error
    # By the twin.
    fine = made.model_copy(update={"render": BaseModel.model_copy(made.render, update=measurements.REFERENCE_RENDER)})
    own = made.model_copy(update={"render": made.render.model_copy(update={"refine": 0})})
    apart = reference.draw(fine, position, speckle(20, 30)).astype(float) - reference.draw(
        own, position, speckle(20, 30)
    )
    assert psnr[0, 1] == pytest.approx(10 * np.log10(255**2 / (apart**2).mean()), abs=0.1)


def test_psnr_is_of_values_to_255() -> None:
    black = np.zeros((4, 5, 3), np.uint8)
    assert measurements.psnr(black + np.uint8(51), black) == pytest.approx(20 * np.log10(5), abs=1e-12)
    assert measurements.psnr(black, black) is None


def test_a_quick_study_of_pictures_varies_one_at_a_time() -> None:
    made = scene(render={"size": [6, 4], "refine": 2, "supersample": 3})
    settings = list(measurements.render_settings(made, quick=True))
    assert settings == [(2, 1), (2, 2), *((refine, 3) for refine in (0, 1, 2, 5, 10, 20)), (2, 4)]


def stepping_point(error: float | None, seconds: float, **changes: Any) -> SteppingMeasurement:
    values: dict[str, Any] = {"precision": "f32", "damping_difference": "central", "steps_per_frame": 40, "step": 0.001}
    return SteppingMeasurement(**values | changes, error=error, rounding=0.0, known=True, samples=[seconds])


def drawn(refine: int, psnr: float | None, seconds: float, supersample: int = 1) -> DrawingMeasurement:
    return DrawingMeasurement(refine, supersample, psnr, 1, samples=[seconds])


def test_the_recommendation_is_the_cheapest_within_the_tolerance() -> None:
    made = study_of(scene())
    assert made.recommendation() == []
    made.stepping = [
        stepping_point(2e-3, 1.0),
        stepping_point(9e-4, 3.0, precision="f64"),
        stepping_point(5e-4, 2.0, step=0.0005),
        stepping_point(None, 0.5),
    ]
    made.settings["time"]["tolerance"] = 1e-4
    made.drawing = [drawn(0, 40.0, 1.0), drawn(1, 49.95, 2.0), drawn(2, 50.0, 3.0), drawn(1, 60.0, 0.1, supersample=2)]
    assert yaml.safe_load("\n".join(made.recommendation())) == {
        "time": {"tolerance": None, "step": 0.0005, "damping_difference": "central", "precision": "f32"},
        "render": {"refine": 1, "supersample": 1},
    }
    made.stepping = [stepping_point(5e-4, 1.1, step=0.001), stepping_point(1e-4, 1.0, step=0.0005)]
    assert made.best_stepping is made.stepping[0], "of one method the largest step"


def test_the_step_recommended_is_one_that_a_scene_takes() -> None:
    # Written with few digits, it must still divide a frame.
    made = study_of(scene())
    made.stepping = [stepping_point(1e-4, 1.0, step=1 / 25 / 77, steps_per_frame=77)]
    text = made.recommendation()[1].split(": ")[1]
    assert plan_of(with_time(scene(), step=float(text))).grid.steps_per_frame == 77
    assert plan_of(scene(time={"step": float(text)})).grid.step == 1 / (25 * 77)


def test_an_interruption_leaves_what_is_done(device: Device) -> None:
    calls = 0

    def stop(done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls > 90:
            raise KeyboardInterrupt

    study = study_of(scene())
    with pytest.raises(KeyboardInterrupt):
        SteppingStudy(plan_of(scene(probes=[SOFT_PRESS])), device, 0.01, study, stop).run()
    assert study.reference is not None
    assert study.stepping
