"""The estimate of an error against the error itself, and the step chosen by it."""

from __future__ import annotations

import math
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.accuracy import time_step
from taichi_msm.accuracy.companions import coarse_steps, fine_steps
from taichi_msm.accuracy.mesh import MeshEstimate
from taichi_msm.accuracy.time_step import (
    TimeStepEstimate,
    TimeStepTrials,
    choose_step,
    max_norm,
)
from taichi_msm.errors import SceneError
from taichi_msm.model.plan import Plan
from taichi_msm.model.verlet import convergence_order
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import with_time
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import estimate_error, frames, notes_of, true_error
from tests.scenes import PRESS, SHEET, SPRINGS, plan_of, scene, with_steps

# Of a run in which something moved.
MOVED = RunProgress(1, 1.0)


SOFT_PRESS = {**PRESS, "force": [0, 300, -1000]}
STIFF = {"structural": 2e4, "shear": 1e4, "virtual": 5e2}

# Four kinds of scene: pressed and let go on a step, stiff with a release between two frames, dragged, and let go where
# no step is.
SCENES: dict[str, Any] = {
    "release": {"probes": [SOFT_PRESS], "damping": 0.02},
    "stiff": {
        "springs": STIFF,
        "probes": [{**PRESS, "force": [0, 0, -1e6], "load": [[0, 0], [0.05, 100], [0.13, 100], [0.13, 0]]}],
        "damping": 0.5,
        "time": {"duration": 0.2},
    },
    "dragged": {
        "probes": [{"at": [[0, 0.2, 0.5], [0.3, 0.8, 0.4]], "force": [200, 0, -500], "falloff": 20}],
        "damping": 0.05,
    },
    "between": {
        "probes": [{**SOFT_PRESS, "load": [[0, 0], [0.1, 100], [0.1 * 2**0.5, 100], [0.1 * 2**0.5, 0]]}],
        "damping": 0.02,
    },
}


@pytest.mark.parametrize(("precision", "tolerance"), [("f32", 5e-4), pytest.param("f64", 5e-5, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", SCENES)
def test_the_step_chosen_is_right_and_the_largest(kind: str, precision: str, tolerance: float, device: Device) -> None:
    sections = SCENES[kind]
    made = scene(**sections | {"time": {"precision": precision, "tolerance": tolerance, **sections.get("time", {})}})
    plan, estimate = choose_step(plan_of(made), device)
    own, steps = plan_of(made).grid.steps_per_frame, plan.grid.steps_per_frame
    assert estimate.error <= tolerance
    assert true_error(plan, device, fine=12) <= 1.5 * tolerance, estimate
    assert estimate.steps_per_frame == steps >= own
    if steps > own:
        # Half as many steps would not have done.
        assert TimeStepTrials(plan, device).estimate(steps // 2).error > tolerance


# Beside these scenes: a load that is there at once, with which damping within a step, g h = 7 and 47, makes velocities
# change their sign at every step; and loads shorter than a step.
AT_ONCE = {"probes": [{**SOFT_PRESS, "load": [[0, 100]]}]}
PULSES = {f"pulse at {a}": [[a, 0], [a, 100], [b, 100], [b, 0]] for a, b in ((0.2005, 0.2006), (0.2, 0.2 + 1e-9))}
HARD: dict[str, Any] = {
    "damping of 3": {**AT_ONCE, "damping": 3.0},
    "damping of 20": {**AT_ONCE, "damping": 20.0},
    **{name: {"probes": [{**SOFT_PRESS, "load": load}]} for name, load in PULSES.items()},
}
BACKWARD = [(kind, "backward") for kind in ("stiff", "between")]


@pytest.mark.parametrize(("kind", "difference"), [*((kind, "central") for kind in {**SCENES, **HARD}), *BACKWARD])
def test_an_estimate_is_near_the_error(kind: str, difference: str, device: Device) -> None:
    sections = {**SCENES, **HARD}[kind]
    made = scene(**sections | {"time": {"damping_difference": difference, **sections.get("time", {})}})
    estimate = estimate_of(made, device)
    exact = with_time(made, damping_difference="central")
    reference = frames(exact, device, cut=64 * plan_of(made).grid.steps_per_frame)
    error = max_norm(frames(made, device) - reference) / max_norm(reference)
    assert error / 1.5 < estimate.error < 1.5 * error
    if difference == "central" and kind in SCENES:
        # The next power of h is (w h)^2 / 24 of the error at most, w h <= 1; and twice that for the kinks of the load.
        assert estimate.error == pytest.approx(error, rel=1 / 12)
    assert ("velocities change their sign" in "".join(notes_of(made, MOVED, None))) == kind.startswith("damping")


def estimate_of(made: Scene, device: Device) -> TimeStepEstimate:
    """The estimate for a scene's own steps."""
    return estimate_error(plan_of(made), device)


class Falling:
    """A stand-in for Dynamics, of every displacement of which h^p is wrong and no more."""

    def __init__(self, p: int, plan: Plan, device: Device, cores: int | None = None) -> None:
        self.p = p
        self.restart(plan)

    def restart(self, plan: Plan) -> None:
        self.h = plan.grid.step

    def advance(self, steps: int, pause: object) -> None:
        pass

    def displacement(self) -> NDArray[np.float64]:
        return np.array([[[1 + self.h**self.p, 0, 0]]])


@pytest.mark.parametrize(("difference", "p"), [("central", 2), ("backward", 1)])
def test_an_error_that_is_a_power_of_the_step_is_told_exactly(
    difference: str, p: int, monkeypatch: pytest.MonkeyPatch, device: Device
) -> None:
    monkeypatch.setattr(time_step, "Dynamics", partial(Falling, p))
    made = scene(probes=[SOFT_PRESS], time={"step": 0.005, "damping_difference": difference})
    # In numbers near 1 the error, 2.5e-5 or more, is rounded by 1e-11 of itself.
    assert estimate_of(made, device).error == pytest.approx(0.005**p, rel=1e-9)


def test_how_many_steps_the_pilots_take() -> None:
    for kind in ("release", "between"):
        made = scene(**SCENES[kind])
        plan = plan_of(made)
        assert fine_steps(plan) == 2 * plan.grid.steps_per_frame
        assert coarse_steps(plan) == math.ceil(plan.grid.steps_per_frame / 2)
    made = scene(damping=3.0, time={"step": 0.0025})
    assert fine_steps(plan_of(made)) == 8 * 16, "g h is 7.5"
    assert coarse_steps(plan_of(made)) == 9, "8 are not stable"
    # Twice this step is not stable.
    limit = plan_of(scene(damping=0.01)).stable_step
    made = with_steps(scene(damping=0.01), math.ceil(0.04 / (0.6 * limit)))
    assert coarse_steps(plan_of(made)) == 0


def test_rounding_is_part_of_the_estimate(device: Device, message: Messages) -> None:
    made = with_steps(scene(probes=[SOFT_PRESS], damping=0.02, time={"precision": "f32"}), 2000)
    in_f64 = with_time(made, precision="f64")
    estimate, double = estimate_of(made, device), estimate_of(in_f64, device)
    exact = frames(in_f64, device)
    rounding = max_norm(frames(made, device) - exact) / max_norm(exact)
    assert estimate.rounding == pytest.approx(rounding, rel=1e-3)
    assert estimate.rounding > estimate.error / 2
    # The whole error, the rounding in it, by an exact solution: of steps whose error is far below rounding.
    truth = frames(in_f64, device, cut=5000)
    error = max_norm(frames(made, device) - truth) / max_norm(truth)
    assert estimate.error == pytest.approx(error, rel=0.02)
    assert estimate.error > 1.5 * estimate.in_f64
    assert double.rounding == 0
    assert estimate.in_f64 == pytest.approx(double.error, rel=1e-9)
    assert double.in_f64 == double.error
    for each in (estimate, double):
        message(notes_of(made, MOVED, each), "error: time step 0.000001 %")


def test_what_f32_cannot_reach_names_f64(device: Device, message: Messages) -> None:
    made = scene(probes=[SOFT_PRESS], damping=0.02, time={"precision": "f32", "tolerance": 1e-8})
    with message.raises(SceneError, "time.tolerance: ", "f64", hide=r"(?<=error of )[\d.e-]+|[\d.e-]+$"):
        choose_step(plan_of(made), device)


@pytest.mark.slow
def test_a_motion_that_does_not_converge_is_refused(device: Device, message: Messages) -> None:
    # Pushed in along the sheet without damping, the points collide and scatter.
    probe = {"force": [3e5, 1e5, -1e4], "falloff": 20}
    made = scene(probes=[probe], damping=0, time={"duration": 2.0, "tolerance": 1e-3})
    with message.raises(SceneError, "time.tolerance: 0.001 ", hide=r"\d+(?= steps)|(?<=error )[^;]*|[\d.e-]+$"):
        choose_step(plan_of(made), device)


def test_a_sheet_that_does_not_move_has_no_error(device: Device) -> None:
    plan = plan_of(scene(probes=[], time={"tolerance": 1e-6}))
    assert choose_step(plan, device)[1] == TimeStepEstimate(plan.grid.steps_per_frame, 0.0, 0.0, 0.0, 2)


# 25 frames a second in steps of 0.01 s.
BETWEEN = 0.105


@pytest.mark.parametrize(
    ("expected", "sections"),
    [
        (2, {"probes": [{**PRESS, "load": [[0, 100], [BETWEEN, 100], [BETWEEN, 0]]}]}),
        (2, {"probes": [{**PRESS, "at": [[0, 0, 0], [BETWEEN, 1, 0], [BETWEEN, 0, 0]]}]}),
        (1, {"probes": [], "time": {"damping_difference": "backward"}}),
        (2, {"probes": [], "time": {"damping_difference": "backward"}, "damping": 0}),
    ],
)
def test_order(expected: int, sections: dict[str, Any]) -> None:
    plan = plan_of(scene(sheet=SHEET, **sections | {"time": {"step": 0.01, **sections.get("time", {})}}))
    assert convergence_order(plan) == expected


@pytest.mark.parametrize(
    "probe",
    [
        {"load": [[0, 0], [0.1, 100], [0.1 * 2**0.5, 100], [0.1 * 2**0.5, 0]]},
        {"load": [[0.0313, 0], [0.0313, 100], [0.0314, 100], [0.0314, 0]]},
        {"load": [[0, 0], [0.1 * 3**0.5, 100], [0.1 * 3**0.5 + 1e-9, 0]]},
        {"at": [[0, 0.2, 0.5], [0.1 * 2**0.5, 0.4, 0.5], [0.1 * 2**0.5, 0.7, 0.4], [0.3, 0.6, 0.3]]},
    ],
    ids=["release", "blow", "nanosecond", "place"],
)
def test_jumps_between_steps_leave_the_order_2(probe: dict[str, Any], device: Device) -> None:
    """By regression over steps that meet none of the jumps; a probe of many steps is the truth."""
    made = scene(probes=[{**SOFT_PRESS, **probe}], damping=0.02)
    counts = (20, 40, 80, 160)
    exact = frames(made, device, cut=1280)
    errors = [max_norm(frames(made, device, cut=count) - exact) / max_norm(exact) for count in counts]
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert slope == pytest.approx(-2, abs=0.1), errors


def test_damping_within_a_hundredth_of_a_step_has_no_estimate(device: Device, message: Messages) -> None:
    made = scene(**AT_ONCE, damping=100.0)
    estimate = estimate_of(made, device)
    assert estimate.error == np.inf
    message(notes_of(made, MOVED, estimate)[0], "error not known")


def test_a_scene_that_is_all_right_has_no_notes(message: Messages) -> None:
    assert not notes_of(scene(), RunProgress(1, 1.0, 0.51), None)
    message(notes_of(scene(), RunProgress(1, 0.0, 0.49), TimeStepEstimate(40, 1e-3, 1e-4, 1e-3, 2)), "error: time step")


@pytest.mark.parametrize("error", [0.015, 0.04, 2000.0])
def test_points_are_advised_where_they_can_help(error: float, message: Messages) -> None:
    steps = TimeStepEstimate(40, error, 0.0, error, 2)
    for affords in (lambda plan: True, lambda plan: False):
        of_mesh = notes_of(scene(), MOVED, None, MeshEstimate(error), affords)
        message(of_mesh[-1], "for a smaller error of the mesh")
        message(notes_of(scene(), MOVED, steps, affords=affords)[1], "for a smaller error of the time step, ")


def test_positions_written_in_f32_have_the_digits_of_the_sheet(device: Device) -> None:
    # Points move by some 4 um on a sheet of 0.4 m, whose positions f32 rounds by up to 2^-27 m: half a unit at 0.2 m.
    faint = {"probes": [{**SOFT_PRESS, "force": [0, 0, -0.5]}], "time": {"precision": "f32"}}
    written = scene(**faint, output=["trajectory"])
    estimate = estimate_of(written, device)
    twin = frames(with_time(written, precision="f64"), device)
    assert 0.3 * 2**-27 < estimate.rounding * max_norm(twin) < 3**0.5 * 2**-27
    assert estimate_of(scene(**faint), device).rounding < 1e-5
    with pytest.raises(SceneError):
        choose_step(plan_of(with_time(written, tolerance=estimate.rounding / 2)), device)
    # Where rounding alone nearly takes up the tolerance, a step is found or the reason told.
    for share in (1.0, 1.1, 1.3):
        with suppress(SceneError):
            found = choose_step(plan_of(with_time(written, tolerance=share * estimate.rounding)), device)[1]
            assert found.error <= share * estimate.rounding


def test_a_press_and_release_that_are_missed_alike_do_not_hide_each_other(device: Device) -> None:
    # Both are moved by parts of a step that the difference of h and h / 2 may not show.
    on, off = 0.0044889, 0.0121111
    made = scene(
        springs={**SPRINGS, "virtual_active": "always"},
        damping=0.001,
        probes=[{**SOFT_PRESS, "load": [[on, 0], [on, 100], [off, 100], [off, 0]]}],
        time={"frames_per_second": 5},
    )
    truth = frames(made, device, cut=50_000)
    for tolerance in (1e-2, 3e-3):
        plan, estimate = choose_step(plan_of(with_time(made, tolerance=tolerance)), device)
        error = max_norm(frames(made, device, cut=plan.grid.steps_per_frame) - truth) / max_norm(truth)
        assert error <= 1.5 * tolerance, estimate
