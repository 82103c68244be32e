from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from taichi_msm.errors import SceneError
from taichi_msm.load.resolve import resolve
from taichi_msm.model.sheet import rest_positions
from taichi_msm.solver.planning import try_plan
from taichi_msm.system.runtime import Device
from taichi_msm.terms import highest_frequency
from tests import reference
from tests.golden import Messages
from tests.scenes import SHEET, plan_of, scene


def test_limit_of_central_differences() -> None:
    made = scene(sheet={**SHEET, "mass": 0.5}, springs={"structural": 3, "shear": 5, "virtual": 2})
    w = math.sqrt((4 * 3 + 8 * 5 + 2) / 0.5)
    assert plan_of(made).stable_step == pytest.approx(2 / w, rel=1e-14)


def test_limit_of_backward_differences() -> None:
    made = scene(
        sheet={**SHEET, "mass": 0.5}, springs={"structural": 6}, damping=3.0, time={"damping_difference": "backward"}
    )
    g, w2 = 6.0, 8 * 6 / 0.5
    assert plan_of(made).stable_step == pytest.approx((math.sqrt(g * g + 4 * w2) - g) / w2, rel=1e-14)


def test_without_springs_nothing_limits_but_backward_damping() -> None:
    assert plan_of(scene(springs={})).stable_step == math.inf
    assert plan_of(scene(springs={})).grid.steps_per_frame == 1
    damped = scene(springs={}, sheet={**SHEET, "mass": 2}, damping=8.0, time={"damping_difference": "backward"})
    assert plan_of(damped).stable_step == pytest.approx(2 / (8.0 / 2), rel=1e-14)


def test_bound_holds_and_is_tight() -> None:
    # The largest eigenvalue of the stiffness of a free sheet, by the twin's own forces, nears the bound from below.
    made = scene(sheet={**SHEET, "points": [7, 7], "fixed": "none"}, springs={"structural": 3, "shear": 5}, probes=[])
    size = rest_positions(made.sheet).size
    small = 1e-6
    stiffness = np.empty((size, size))
    for n in range(size):
        u = np.zeros(size)
        u[n] = small
        stiffness[n] = -reference.elastic_force(made, u.reshape(7, 7, 3)).ravel() / small
    largest = np.linalg.eigvalsh((stiffness + stiffness.T) / 2)[-1] / plan_of(made).material.mass
    assert 0.5 < largest / highest_frequency(plan_of(made).material, made.sheet) ** 2 < 1


@pytest.mark.parametrize("limit_per_frame", [0.3, 1.0, 7.9, 8.0, 8.1])
def test_auto_is_the_largest_whole_fraction_within_half_the_limit(limit_per_frame: float) -> None:
    # m = 8 k h^2 / 4 makes 2 / w = h; a frame is 1/25 s.
    h = 1 / 25 / limit_per_frame
    made = scene(sheet={**SHEET, "mass": 2 * 3.0 * h * h}, springs={"structural": 3.0})
    n = plan_of(made).grid.steps_per_frame
    assert plan_of(made).grid.step <= plan_of(made).stable_step / 2 * (1 + 1e-9)
    assert n == 1 or 1 / 25 / (n - 1) > plan_of(made).stable_step / 2


def refused(given: float) -> list[str]:
    return list(map(str, try_plan(scene(springs={"structural": 3.0}, time={"step": given}))[1]))


def test_a_step_that_is_too_long_or_divides_no_frame_is_refused(message: Messages) -> None:
    # 2 / sqrt(24 / 1e-3) = 0.0129099 s; 0.04 / 4 = 0.01 s is the largest whole fraction of a frame below.
    message(refused(0.02), "time.step: 0.02 s ", "0.0129099 s", "0.01,")
    message(refused(0.011), "time.step: 0.011 s ", "0.01")
    assert refused(0.01) == refused(0.04 / 7) == []


@pytest.mark.parametrize(
    "changes", [{"size": [3e-16, 3e-16]}, {"size": [3e18, 3e18]}, {"mass": 1e29}], ids=["tiny", "huge", "heavy"]
)
def test_what_f32_cannot_hold_is_refused(changes: dict[str, Any], message: Messages) -> None:
    sections = {"sheet": {**SHEET, "points": [11, 11], **changes}, "springs": {"structural": 3.0}}
    sections |= {"time": {"frames_per_second": 1e3, "step": 1e-3}} if "mass" in changes else {}
    single = scene(**sections | {"time": {**sections.get("time", {}), "precision": "f32"}})
    message(map(str, try_plan(single)[1]), "f32", "f64")
    assert not try_plan(scene(**sections))[1]
    # `auto` takes f64 on a CPU, and f32 on a GPU.
    auto = plan_of(scene(**sections | {"time": {**sections.get("time", {}), "precision": "auto"}}))
    assert auto.grid.precision == resolve(auto, Device("cpu", 1)).plan.grid.precision == "f64"
    with message.raises(SceneError, "f32", "f64"):
        resolve(auto, Device("vulkan", 1))
