"""Estimates of the time-step error against the error itself, and the step chosen by them."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.accuracy import time_step
from taichi_msm.accuracy.companions import coarse_steps, fine_steps
from taichi_msm.accuracy.time_step import TimeStepEstimate, TimeStepTrials, choose_step, max_norm
from taichi_msm.errors import SceneError
from taichi_msm.integrators import INTEGRATORS, Coefficients
from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import with_time
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import estimate_error, frames, notes_of, true_error
from tests.scenes import PRESS, SPRINGS, plan_of, scene, with_steps

# Progress of a run in which something moved by 1 m.
MOVED = RunProgress(1, 1.0)

SOFT_PRESS = {**PRESS, "force": [0, 300, -1000]}
STIFF = {"structural": 2e4, "shear": 1e4, "virtual": 5e2}

# Pressed and released on a step; stiff with a release between two frames; dragged; and released between two steps.
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


def scene_with_time(kind: str, **time: Any) -> Scene:
    sections = {**SCENES, **HARD}[kind]
    return scene(**sections | {"time": {**time, **sections.get("time", {})}})


@pytest.mark.parametrize("kind", SCENES)
def test_chosen_step_is_the_largest_within_the_tolerance(kind: str, device: Device) -> None:
    made = scene_with_time(kind, precision="f32", tolerance=5e-4)
    plan, estimate = choose_step(plan_of(made), device)
    smallest, steps = plan_of(made).grid.steps_per_frame, plan.grid.steps_per_frame
    assert estimate.error <= 5e-4
    assert true_error(plan, device, fine=12) <= 1.5 * 5e-4, estimate
    assert estimate.steps_per_frame == steps >= smallest
    if steps > smallest:
        assert TimeStepTrials(plan, device).estimate(steps // 2).error > 5e-4


# A sudden load, with which damping within a step, g h = 7 and 47, reverses velocities at every step; and loads shorter
# than a step.
SUDDEN = {"probes": [{**SOFT_PRESS, "load": [[0, 100]]}]}
PULSES = {f"pulse at {a}": [[a, 0], [a, 100], [b, 100], [b, 0]] for a, b in ((0.2005, 0.2006), (0.2, 0.2 + 1e-9))}
HARD: dict[str, Any] = {
    "damping of 3": {**SUDDEN, "damping": 3.0},
    "damping of 20": {**SUDDEN, "damping": 20.0},
    **{name: {"probes": [{**SOFT_PRESS, "load": load}]} for name, load in PULSES.items()},
}
BACKWARD = [(kind, "backward") for kind in ("stiff", "between")]


@pytest.mark.parametrize(("kind", "difference"), [*((kind, "central") for kind in {**SCENES, **HARD}), *BACKWARD])
def test_estimate_against_the_true_error(kind: str, difference: str, device: Device) -> None:
    made = scene_with_time(kind, damping_difference=difference)
    estimate = estimate_error(plan_of(made), device)
    exact = with_time(made, damping_difference="central")
    reference = frames(exact, device, cut=64 * plan_of(made).grid.steps_per_frame)
    error = max_norm(frames(made, device) - reference) / max_norm(reference)
    assert error / 1.5 < estimate.error < 1.5 * error
    if difference == "central" and kind in SCENES:
        # The next power of h is (w h)^2 / 24 of the error at most, w h <= 1; and twice that for the kinks of the load.
        assert estimate.error == pytest.approx(error, rel=1 / 12)
    assert ("velocities change their sign" in "".join(notes_of(made, MOVED, None))) == kind.startswith("damping")


def test_an_integrator_owns_its_order(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """The semi-implicit Euler method has the full gain in step 0, which is an error h F / (2 m) of the velocity."""
    central = INTEGRATORS["central"]

    def coefficients(m: float, g: float, h: float) -> Coefficients:
        keep, gain, _ = central.coefficients(m, g, h)
        return Coefficients(keep, gain, gain)

    euler = central._replace(coefficients=coefficients, order=lambda _: 1)
    made = scene(**SUDDEN, damping=0, time={"precision": "f64"})
    reference = frames(made, device, cut=64 * plan_of(made).grid.steps_per_frame)
    monkeypatch.setitem(INTEGRATORS, "central", euler)
    estimate = estimate_error(plan_of(made), device)
    error = max_norm(frames(made, device) - reference) / max_norm(reference)
    assert estimate.order == 1
    # The next power of h is the error of order 2, (w h)^2 / 24 with w h <= 1.
    assert estimate.error == pytest.approx(error, rel=1 / 8)


class PowerLaw:
    """A stand-in for Dynamics whose displacement is 1 + h^p."""

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
def test_estimate_of_a_power_law_is_exact(
    difference: str, p: int, monkeypatch: pytest.MonkeyPatch, device: Device
) -> None:
    monkeypatch.setattr(time_step, "Dynamics", partial(PowerLaw, p))
    made = scene(probes=[SOFT_PRESS], time={"step": 0.005, "damping_difference": difference})
    # The error, 2.5e-5 or more of numbers near 1, is rounded by 1e-11 of itself.
    assert estimate_error(plan_of(made), device).error == pytest.approx(0.005**p, rel=1e-9)


def test_steps_of_the_companion_runs() -> None:
    for kind in ("release", "between"):
        plan = plan_of(scene(**SCENES[kind]))
        assert fine_steps(plan) == 2 * plan.grid.steps_per_frame
        assert coarse_steps(plan) == math.ceil(plan.grid.steps_per_frame / 2)
    damped = plan_of(scene(damping=3.0, time={"step": 0.0025}))
    assert fine_steps(damped) == 8 * 16, "g h is 7.5"
    assert coarse_steps(damped) == 9, "8 are not stable"
    limit = plan_of(scene(damping=0.01)).stable_step
    near_limit = with_steps(scene(damping=0.01), math.ceil(0.04 / (0.6 * limit)))
    assert coarse_steps(plan_of(near_limit)) == 0


def test_rounding_is_part_of_the_estimate(device: Device, message: Messages) -> None:
    single = with_steps(scene(probes=[SOFT_PRESS], damping=0.02, time={"precision": "f32"}), 2000)
    double = with_time(single, precision="f64")
    estimate, in_double = (estimate_error(plan_of(made), device) for made in (single, double))
    displacement, same_step = frames(single, device), frames(double, device)
    rounding = max_norm(displacement - same_step) / max_norm(same_step)
    assert estimate.rounding == pytest.approx(rounding, rel=1e-3)
    assert estimate.rounding > estimate.error / 2
    # The time-step error of the reference is far below rounding.
    reference = frames(double, device, cut=5000)
    error = max_norm(displacement - reference) / max_norm(reference)
    assert estimate.error == pytest.approx(error, rel=0.02)
    assert estimate.error > 1.5 * estimate.in_f64
    assert in_double.rounding == 0
    assert in_double.in_f64 == in_double.error == pytest.approx(estimate.in_f64, rel=1e-9)
    for each in (estimate, in_double):
        message(notes_of(single, MOVED, each), "error: time step 0.000001 %")


def test_tolerance_out_of_reach_of_f32(device: Device, message: Messages) -> None:
    made = scene(probes=[SOFT_PRESS], damping=0.02, time={"precision": "f32", "tolerance": 1e-8})
    with message.raises(SceneError, "time.tolerance: ", "f64", hide=r"(?<=error of )[\d.e-]+|[\d.e-]+$"):
        choose_step(plan_of(made), device)


@pytest.mark.parametrize(("error", "at_most"), [(math.inf, False), (0.02, False), (0.02, True), (0.6, True)])
def test_tolerance_out_of_reach_of_any_step(
    error: float, at_most: bool, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    def estimate(_: TimeStepTrials, steps: int, progress: object) -> TimeStepEstimate:
        return TimeStepEstimate(steps, error, 0.0, error, 1, at_most=at_most)

    monkeypatch.setattr(TimeStepTrials, "estimate", estimate)
    with message.raises(SceneError, "time.tolerance: 0.001 "):
        choose_step(plan_of(scene(time={"tolerance": 1e-3})), device)


@pytest.mark.slow
def test_tolerance_of_a_motion_that_does_not_converge(device: Device, message: Messages) -> None:
    # Pushed in along the sheet without damping, the points collide and scatter.
    probe = {"force": [3e5, 1e5, -1e4], "falloff": 20}
    made = scene(probes=[probe], damping=0, time={"duration": 2.0, "tolerance": 1e-3})
    with message.raises(SceneError, "time.tolerance: 0.001 ", hide=r"\d+(?= steps)|(?<=error )[^;]*|[\d.e-]+$"):
        choose_step(plan_of(made), device)


def test_sheet_without_motion_has_no_error(device: Device) -> None:
    plan = plan_of(scene(probes=[], time={"tolerance": 1e-6}))
    assert choose_step(plan, device)[1] == TimeStepEstimate(plan.grid.steps_per_frame, 0.0, 0.0, 0.0, 2)


def test_damping_within_a_hundredth_of_a_step_has_no_estimate(device: Device, message: Messages) -> None:
    made = scene(**SUDDEN, damping=100.0)
    estimate = estimate_error(plan_of(made), device)
    assert estimate.error == np.inf
    message(notes_of(made, MOVED, estimate)[0], "error not known")


def test_order_with_backward_differences() -> None:
    backward = {"damping_difference": "backward"}
    assert plan_of(scene(time=backward)).convergence_order == 1
    assert plan_of(scene(time=backward, damping=0)).convergence_order == 2


@pytest.mark.parametrize(
    "probe",
    [
        {"load": [[0, 0], [0.1, 100], [0.1 * 2**0.5, 100], [0.1 * 2**0.5, 0]]},
        {"load": [[0.0313, 0], [0.0313, 100], [0.0314, 100], [0.0314, 0]]},
        {"load": [[0, 0], [0.1 * 3**0.5, 100], [0.1 * 3**0.5 + 1e-9, 0]]},
        {"at": [[0, 0.2, 0.5], [0.1 * 2**0.5, 0.4, 0.5], [0.1 * 2**0.5, 0.7, 0.4], [0.3, 0.6, 0.3]]},
    ],
    ids=["release", "pulse", "nanosecond", "place"],
)
def test_order_2_with_jumps_between_steps(probe: dict[str, Any], device: Device) -> None:
    """By regression over steps that meet none of the jumps, against a run of many steps."""
    made = scene(probes=[{**SOFT_PRESS, **probe}], damping=0.02)
    assert plan_of(made).convergence_order == 2
    counts = (20, 40, 80, 160)
    exact = frames(made, device, cut=1280)
    errors = [max_norm(frames(made, device, cut=count) - exact) / max_norm(exact) for count in counts]
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert slope == pytest.approx(-2, abs=0.1), errors


def test_rounding_of_a_trajectory_in_f32(device: Device) -> None:
    # Points move by some 4 um on a sheet of 0.4 m, whose positions f32 rounds by up to 2^-27 m: half a unit at 0.2 m.
    faint = {"probes": [{**SOFT_PRESS, "force": [0, 0, -0.5]}], "time": {"precision": "f32"}}
    stored = scene(**faint, output=["trajectory"])
    rounding = estimate_error(plan_of(stored), device).rounding
    exact = frames(with_time(stored, precision="f64"), device)
    assert 0.3 * 2**-27 < rounding * max_norm(exact) < 3**0.5 * 2**-27
    assert estimate_error(plan_of(scene(**faint)), device).rounding < 1e-5
    with pytest.raises(SceneError):
        choose_step(plan_of(with_time(stored, tolerance=rounding / 2)), device)


def test_equal_errors_of_press_and_release_do_not_cancel(device: Device) -> None:
    # Both are displaced by parts of a step that the difference of h and h / 2 may not show.
    on, off = 0.0044889, 0.0121111
    made = scene(
        springs={**SPRINGS, "virtual_active": "always"},
        damping=0.001,
        probes=[{**SOFT_PRESS, "load": [[on, 0], [on, 100], [off, 100], [off, 0]]}],
        time={"frames_per_second": 5},
    )
    reference = frames(made, device, cut=50_000)
    for tolerance in (1e-2, 3e-3):
        plan, estimate = choose_step(plan_of(with_time(made, tolerance=tolerance)), device)
        displacement = frames(made, device, cut=plan.grid.steps_per_frame)
        assert max_norm(displacement - reference) / max_norm(reference) <= 1.5 * tolerance, estimate
