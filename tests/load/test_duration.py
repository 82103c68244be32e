"""How long a run will take: its work, at the speed of this machine."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from taichi_msm.accuracy.companions import choose_companion_runs
from taichi_msm.load import cost
from taichi_msm.load.cost import CALIBRATION_S, WORK_UNIT_S
from taichi_msm.solver.planning import START_WORK, count_work
from taichi_msm.system import process
from tests.conftest import Program
from tests.golden import Messages
from tests.scenes import plan_of
from tests.scenes import scene as small_scene


def test_the_calibration_is_soon_done() -> None:
    cost._calibrate.cache_clear()
    assert 0 < cost._calibrate() < 1


@pytest.mark.parametrize("cores", [1, 64])
def test_the_estimate_is_the_work_at_the_speed_of_the_machine(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "_calibrate", lambda: 2 * CALIBRATION_S)
    monkeypatch.setattr(process, "available_threads", lambda: cores)
    plan = plan_of(small_scene(image="none.png", output=["gif"]))
    parts = count_work(plan, choose_companion_runs(plan).cost)
    assert min(parts) > 0
    assert cost.estimate_duration(plan) == pytest.approx((2 * WORK_UNIT_S * sum(parts), 2 * WORK_UNIT_S * START_WORK))


def test_check_estimates_the_duration_of_a_run(small: Path, program: Program, message: Messages) -> None:
    def line(*options: str) -> str:
        (found,) = (line for line in program("check", "small.yaml", *options).stdout.splitlines() if " to run" in line)
        return found

    message(line(), hide=r"^\D*[\d.]+ \w+")
    message(line("--set", "time.step=auto", "--set", "time.tolerance=0.01"), "time.tolerance", hide=r"^\D*[\d.]+ \w+")
    before = program("check", "small.yaml", "--json").stdout
    assert program("run", "small.yaml", "--quiet").returncode == 0
    after = program("check", "small.yaml", "--json").stdout
    assert json.loads(after)["estimated_seconds"] == json.loads(before)["estimated_seconds"], "nothing is learnt"
