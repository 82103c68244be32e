"""The stability limit, the automatic step, and steps and sizes that are refused."""

from __future__ import annotations

import math
from typing import Any

import pytest

from taichi_msm.errors import SceneError
from taichi_msm.load.resolve import resolve
from taichi_msm.solver.planning import try_plan
from taichi_msm.system.runtime import Device
from taichi_msm.terms import highest_frequency
from tests.golden import Messages
from tests.scenes import SHEET, plan_of, scene
from tests.solver.test_tissue_physics import frequency

BACKWARD = {"damping_difference": "backward"}


@pytest.mark.parametrize(
    ("sections", "limit"),
    [
        ({"springs": {"structural": 3, "shear": 5, "virtual": 2}}, 2 / math.sqrt((4 * 3 + 8 * 5 + 2) / 0.5)),
        # (sqrt(g^2 + 4 w^2) - g) / w^2 for g = 6/s and w^2 = 8 * 6 / 0.5
        ({"springs": {"structural": 6}, "damping": 3.0, "time": BACKWARD}, (math.sqrt(36 + 4 * 96) - 6) / 96),
        ({"springs": {}}, math.inf),
        ({"springs": {}, "damping": 2.0, "time": BACKWARD}, 2 / (2.0 / 0.5)),
    ],
    ids=["central", "backward", "no springs", "damping alone"],
)
def test_stability_limit(sections: dict[str, Any], limit: float) -> None:
    assert plan_of(scene(sheet={**SHEET, "mass": 0.5}, **sections)).stable_step == pytest.approx(limit, rel=1e-14)


def test_frequency_bound_of_springs() -> None:
    """The highest frequency of a free sheet, by the twin, approaches the bound from below."""
    made = scene(sheet={**SHEET, "points": [7, 7], "fixed": "none"}, springs={"structural": 3, "shear": 5}, probes=[])
    assert 1 <= highest_frequency(plan_of(made).material, made.sheet) / frequency(made) < math.sqrt(2)


@pytest.mark.parametrize("limit_per_frame", [0.0, 0.3, 1.0, 7.9, 8.0, 8.1])
def test_automatic_step(limit_per_frame: float) -> None:
    """It is the largest fraction of a frame, 1/25 s, up to half the limit."""
    # m = 8 k h^2 / 4 makes 2 / w = h.
    h = 1 / 25 / limit_per_frame if limit_per_frame else 1.0
    made = scene(sheet={**SHEET, "mass": 2 * 3.0 * h * h}, springs={"structural": 3.0} if limit_per_frame else {})
    grid, limit = plan_of(made).grid, plan_of(made).stable_step
    assert grid.step <= limit / 2 * (1 + 1e-9)
    assert grid.steps_per_frame == 1 or 1 / 25 / (grid.steps_per_frame - 1) > limit / 2


def test_invalid_steps(message: Messages) -> None:
    def problems(step: float) -> list[str]:
        return list(map(str, try_plan(scene(springs={"structural": 3.0}, time={"step": step}))[1]))

    # 2 / sqrt(24 / 1e-3) = 0.0129099 s; 0.04 / 4 = 0.01 s is the largest fraction of a frame below it.
    message(problems(0.02), "time.step: 0.02 s ", "0.0129099 s", "0.01,")
    message(problems(0.011), "time.step: 0.011 s ", "0.01")
    assert problems(0.01) == problems(0.04 / 7) == []


@pytest.mark.parametrize(
    "changes", [{"size": [3e-16, 3e-16]}, {"size": [3e18, 3e18]}, {"mass": 1e29}], ids=["tiny", "huge", "heavy"]
)
def test_range_of_f32(changes: dict[str, Any], message: Messages) -> None:
    time = {"frames_per_second": 1e3, "step": 1e-3} if "mass" in changes else {}

    def made(precision: str) -> Any:
        sheet = {**SHEET, "points": [11, 11], **changes}
        return scene(sheet=sheet, springs={"structural": 3.0}, time={**time, "precision": precision})

    message(map(str, try_plan(made("f32"))[1]), "f32", "f64")
    assert not try_plan(made("f64"))[1]
    # `auto` chooses f64 on a CPU, and f32 on a GPU.
    auto = plan_of(made("auto"))
    assert auto.grid.precision == resolve(auto, Device("cpu", 1)).plan.grid.precision == "f64"
    with message.raises(SceneError, "f32", "f64"):
        resolve(auto, Device("vulkan", 1))
