"""Measurements of studies: errors, orders of convergence, pictures and recommendations."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from pydantic import BaseModel

from taichi_msm.accuracy.mesh import with_points
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.errors import SceneError
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
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
from taichi_msm.study.study import run_study
from taichi_msm.system import process
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.motion import frames_on
from tests.scenes import PRESS, plan_of, scene, speckle
from tests.terms.test_contact import PRESSED, moved, touching

SOFT_PRESS = {**PRESS, "force": [0, 300, -1000]}


def study_of(scene: Scene) -> Study:
    return Study("press", scene.model_dump(), "complete", 1e-3, {})


def progress(done: int, total: int) -> None:
    assert 0 <= done <= total


def stepping_study(scene: Scene, device: Device, longest_run: float) -> tuple[Study, Any]:
    """Return the study of the steps of a scene, and the reference displacements [m]."""
    study = study_of(scene)
    return study, SteppingStudy(plan_of(scene), device, longest_run, study, progress).run()


# A release at the end of a step.
RELEASE = scene(probes=[SOFT_PRESS], damping=0.02, time={"damping_difference": "backward"})


@pytest.fixture(scope="module")
def stepping(device: Device) -> tuple[Study, Any]:
    return stepping_study(RELEASE, device, 0.05)


def test_steps_are_halved_from_the_largest_stable_one(stepping: tuple[Study, Any]) -> None:
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
    measured = with_time(RELEASE, step=point.step, precision="f64")
    exact = reference.simulate(with_time(measured, step=point.step / 16, damping_difference="central"))
    error = reference.simulate(measured) - exact
    largest = np.linalg.norm(exact - exact[0], axis=-1).max()
    # With a sixteenth of the step and order 2 instead of 1, the twin has less than 1 % of this error.
    assert point.error == pytest.approx(np.linalg.norm(error, axis=-1).max() / largest, rel=0.01)
    assert study.reference is not None
    assert study.reference.largest == pytest.approx(largest, rel=1e-5)


def test_error_of_the_reference(stepping: tuple[Study, Any], device: Device) -> None:
    study, frames = stepping
    assert study.reference is not None
    plan, steps = (
        plan_of(with_time(RELEASE, damping_difference="central", precision="f64")),
        study.reference.steps_per_frame,
    )
    coarse, fine = (frames_on(plan.with_grid(steps_per_frame=n * steps), device) for n in (2, 4))
    # The extrapolation from a quarter of the step has 1 / 4^4 of the error.
    error = max_norm(frames - (fine + (fine - coarse) / 3)) / study.reference.largest
    # About 1e4 steps, each with a rounding of 1e-16.
    assert error < study.reference.error + 1e-11
    for point in study.stepping:
        assert point.error is not None
        assert point.known == (point.error >= REFERENCE_MARGIN * study.reference.error)


def test_orders_are_fitted_above_rounding() -> None:
    def point(step: float, error: float, rounding: float) -> SteppingMeasurement:
        return SteppingMeasurement("f32", "central", 1, step, error, rounding, True, samples=[1.0])

    points = [point(0.1**n, 0.1 ** (2 * n) + 1e-6, 1e-6) for n in range(5)]
    # The errors of 1e-6 and 2e-6 are mostly rounding, the next one by 1 %.
    assert observed_orders(points) == {"f32 central": pytest.approx(2, abs=0.01)}
    assert observed_orders(points[2:]) == {"f32 central": None}


def test_steps_that_miss_a_jump_are_halved(device: Device) -> None:
    """The release is at 3.25 frames, and a frame has 9 steps at first."""
    release = scene(probes=[{**SOFT_PRESS, "load": [[0, 100], [0.13, 100], [0.13, 0]]}], time={"duration": 0.2})
    study, _ = stepping_study(release, device, 0.001)
    assert [point.steps_per_frame for point in study.stepping if point.method == "f64 central"] == [9, 18, 36]


@pytest.mark.slow
def test_reference_in_contact_is_the_finest_run(device: Device) -> None:
    contact = touching([PRESSED])
    study, frames = stepping_study(contact, device, 0.01)
    assert study.reference is not None
    steps = study.reference.steps_per_frame
    fine, half = (frames_on(plan_of(contact).with_grid(steps_per_frame=n), device) for n in (steps, steps // 2))
    assert frames.tobytes() == fine.tobytes()
    assert study.reference.error == max_norm(fine - half) / max_norm(fine)


def test_meshes_in_contact_are_not_extrapolated() -> None:
    fields = [np.full((count, count, 3), value) for count, value in ((7, 4.0), (13, 2.0), (25, 1.0))]
    meshes = [Sheet(points=(count, count), size=(1, 1)) for count in (7, 13, 25)]
    exact, bound = _reference(fields, meshes, extrapolate=False)
    assert exact is fields[-1]
    assert bound == pytest.approx(3**0.5)


TISSUE = {"young": 3e3, "thickness": 2e-3, "density": 1050}


def tissue(points: tuple[int, int] = (33, 33), **time: Any) -> Scene:
    """A tense sheet under a wide tool, with a smooth displacement: (S / K)^(1/2) = 16 mm are many cells."""
    return Scene(
        sheet={"points": points, "size": [0.1, 0.1]},
        tissue={**TISSUE, "foundation": 2e4, "damping": 40, "pretension": 5},
        probes=[{"total": [0, 0, -0.2], "radius": 0.2, "falloff": 100, "load": [[0, 0], [0.2, 100]]}],
        time={"duration": 0.2, "frames_per_second": 25, "precision": "f64", **time},
        output=[],
    )


def mesh_study(scene: Scene, device: Device, longest_run: float) -> Study:
    study = study_of(scene)
    MeshStudy(plan_of(scene), device, longest_run, study, progress).run()
    return study


@pytest.fixture(scope="module")
def meshes(device: Device) -> Study:
    return mesh_study(tissue(), device, 2.0)


def test_discretisation_errors(meshes: Study, device: Device) -> None:
    assert meshes.notes == []
    assert [mesh.name for mesh in meshes.points] == ["9 x 9", "17 x 17", "33 x 33", "65 x 65"]
    assert [mesh.known for mesh in meshes.points[:3]] == [True] * 3
    assert all(mesh.seconds.runs == ROUNDS for mesh in meshes.points)
    finest = tissue((65, 65))
    steps = plan_of(finest).grid.steps_per_frame

    def displacements(count: int) -> Any:
        return frames_on(plan_of(with_points(finest, (count, count))).with_grid(steps_per_frame=steps), device)

    exact = displacements(65)
    largest = np.linalg.norm(exact, axis=-1).max()
    for mesh in meshes.points[1:3]:
        stride = 64 // (mesh.rows - 1)
        error = np.linalg.norm(displacements(mesh.rows) - exact[:, ::stride, ::stride], axis=-1).max() / largest
        # The error of 65 x 65 is 1/4 of that of 33 x 33; between the mass points errors may be somewhat larger.
        assert error <= (mesh.error or 0.0) < 1.6 * error


def test_error_of_the_finest_mesh_is_a_bound(meshes: Study, device: Device, message: Messages) -> None:
    bounded = mesh_study(tissue(), device, 1e-6)
    message(bounded.notes, "65 x 65")
    assert [mesh.name for mesh in bounded.points] == ["9 x 9", "17 x 17", "33 x 33"]
    assert [bounded.points[n].known for n in (0, 2)] == [True, False]
    assert (bounded.points[2].error or 0.0) > (meshes.points[2].error or 1.0)


def points_of(plans: Iterable[Plan]) -> list[tuple[int, int]]:
    return [plan.scene.sheet.points for plan in plans]


def test_meshes_have_quarters_and_halves_of_the_cells() -> None:
    assert points_of(mesh_plans(plan_of(tissue((31, 31))))) == [(9, 9), (16, 16), (31, 31)]
    assert points_of(mesh_plans(plan_of(tissue((41, 25))))) == [(11, 7), (21, 13), (41, 25)]
    # Half the points would be too few, or cells too long.
    assert points_of(mesh_plans(plan_of(tissue((13, 15))))) == [(7, 8), (13, 15)]
    assert points_of(mesh_plans(plan_of(tissue((6, 6))))) == []
    assert points_of(mesh_plans(plan_of(tissue((46, 27))))) == [(23, 14), (46, 27)]


def test_sheets_without_a_study_of_meshes(device: Device, message: Messages) -> None:
    few, springs = mesh_study(tissue((6, 6)), device, 1.0), mesh_study(scene(), device, 1.0)
    assert few.points == springs.points == []
    assert springs.notes == []
    message(few.notes, "7")


def test_interruption_keeps_the_timed_meshes(device: Device) -> None:
    study = study_of(tissue((13, 13)))

    def stop(done: int, total: int) -> None:
        # After the first runs and the errors of three meshes, and one timing.
        if done == 2 * 3 + 1 + 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        MeshStudy(plan_of(tissue((13, 13))), device, 0.25, study, stop).run()
    study.finish()
    assert [(mesh.name, mesh.seconds.runs) for mesh in study.points] == [("7 x 7", 1)]
    assert study.points[0].error is not None


@pytest.mark.slow
def test_errors_of_pictures_are_those_of_the_twin(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements, "REFINES", (0, 3))
    monkeypatch.setattr(measurements, "SUPERSAMPLES", (1, 4))
    monkeypatch.setattr(measurements, "REFERENCE_RENDER", {"refine": 4, "supersample": 5})
    drawn_scene = scene(render={"size": [60, 45], "camera": "oblique", "refine": 3})
    position = rest_positions(drawn_scene.sheet)
    position[4, 5, 2] += 0.05
    study = study_of(drawn_scene)
    measure_pictures(drawn_scene, position, speckle(20, 30), False, study, progress)
    points = {(point.refine, point.supersample): point for point in study.drawing}
    assert set(points) == {(0, 1), (3, 1), (0, 4), (3, 4)}
    psnr = {setting: point.psnr or 0.0 for setting, point in points.items()}
    assert psnr[3, 4] > max(psnr[0, 4], psnr[3, 1]) > psnr[0, 1]
    assert points[3, 4].largest_error < points[0, 1].largest_error
    # The twin has the same ratio.
    render = drawn_scene.render
    renders = (
        BaseModel.model_copy(render, update=measurements.REFERENCE_RENDER),
        render.model_copy(update={"refine": 0}),
    )
    fine, coarse = (
        reference.draw(drawn_scene.model_copy(update={"render": each}), position, speckle(20, 30)).astype(float)
        for each in renders
    )
    assert psnr[0, 1] == pytest.approx(10 * np.log10(255**2 / ((fine - coarse) ** 2).mean()), abs=0.1)


@pytest.mark.slow
def test_steps_are_limited_by_the_speed_of_tools(device: Device) -> None:
    fast = moved([0, 0.5, 0.5, 0.1], [0.1, 0.9, 0.5, 0.1], instrument={"radius": 0.005})
    made = touching([fast], time={"step": 0.001, "duration": 0.04})
    assert plan_of(made).stable_step > 0.01
    study, _ = stepping_study(made, device, 0.001)
    # Half the radius at 1.6 m/s.
    assert max(point.step for point in study.stepping) <= 0.005 / 2 / 1.6


def test_warnings_of_a_study(device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """Without a picture; interrupted; with memory for neither the reference picture nor the trajectories."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("taichi_msm.study.study.SteppingStudy", Mock())
    monkeypatch.setattr("taichi_msm.study.study.MeshStudy", Mock(side_effect=interrupt))
    message(run_study(scene(), "name", threads=device.threads).notes, "image", "interrupted")
    monkeypatch.setattr(process, "available_memory", lambda: 0)
    study, rest = study_of(scene()), rest_positions(scene().sheet)
    measure_pictures(scene(), rest, speckle(20, 30), False, study, progress)
    message(study.notes, "memory")
    with message.raises(SceneError, "time.duration"):
        run_study(scene(), "name", threads=device.threads)


def test_psnr() -> None:
    black = np.zeros((4, 5, 3), np.uint8)
    assert measurements.psnr(black + np.uint8(51), black) == pytest.approx(20 * np.log10(5), abs=1e-12)
    assert measurements.psnr(black, black) is None


def test_render_settings_of_a_quick_study() -> None:
    render = {"size": [6, 4], "refine": 2, "supersample": 3}
    settings = list(measurements.render_settings(scene(render=render), quick=True))
    assert settings == [(2, 1), (2, 2), *((refine, 3) for refine in (0, 1, 2, 5, 10, 20)), (2, 4)]


def stepping_point(error: float | None, seconds: float, **changes: Any) -> SteppingMeasurement:
    values: dict[str, Any] = {"precision": "f32", "damping_difference": "central", "steps_per_frame": 40, "step": 0.001}
    return SteppingMeasurement(**values | changes, error=error, rounding=0.0, known=True, samples=[seconds])


def drawn(refine: int, psnr: float | None, seconds: float, supersample: int = 1) -> DrawingMeasurement:
    return DrawingMeasurement(refine, supersample, psnr, 1, samples=[seconds])


def test_recommendation_is_the_cheapest_within_the_tolerance() -> None:
    study = study_of(scene())
    assert study.recommendation() == []
    study.stepping = [
        stepping_point(2e-3, 1.0),
        stepping_point(9e-4, 3.0, precision="f64"),
        stepping_point(5e-4, 2.0, step=0.0005),
        stepping_point(None, 0.5),
    ]
    study.settings["time"]["tolerance"] = 1e-4
    study.drawing = [drawn(0, 40.0, 1.0), drawn(1, 49.95, 2.0), drawn(2, 50.0, 3.0), drawn(1, 60.0, 0.1, supersample=2)]
    assert yaml.safe_load("\n".join(study.recommendation())) == {
        "time": {"tolerance": None, "step": 0.0005, "damping_difference": "central", "precision": "f32"},
        "render": {"refine": 1, "supersample": 1},
    }
    study.stepping = [stepping_point(5e-4, 1.1, step=0.001), stepping_point(1e-4, 1.0, step=0.0005)]
    assert study.best_stepping is study.stepping[0], "the largest step of a method"


def test_digits_of_the_recommended_step_suffice() -> None:
    study = study_of(scene())
    study.stepping = [stepping_point(1e-4, 1.0, step=1 / 25 / 77, steps_per_frame=77)]
    text = study.recommendation()[1].split(": ")[1]
    assert plan_of(with_time(scene(), step=float(text))).grid.steps_per_frame == 77
    assert plan_of(scene(time={"step": float(text)})).grid.step == 1 / (25 * 77)
