"""The time grid: whole steps, and a scene into which it is written gives it again."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from taichi_msm import Simulation
from taichi_msm.accuracy.time_step import choose_step
from taichi_msm.model.loads import average_loads
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.solver.planning import choose_precision, freeze_grid
from taichi_msm.system.runtime import Device
from tests.scenes import PRESS, plan_of, scene


def test_a_time_is_rounded_once() -> None:
    """However many steps: a quotient of two whole numbers, and no sum and no multiple of a rounded step."""
    grid = TimeGrid(frames_per_second=30.0, frames=10**6, steps_per_frame=49, precision="f64")
    assert (grid.steps, grid.step) == (49 * 10**6, 1 / (30 * 49))
    for n in (*range(1000), 12_345_678, grid.steps):
        assert grid.time(n) == float(Fraction(n, 30 * 49))
    with pytest.raises(FrozenInstanceError):
        grid.steps_per_frame = 12  # type: ignore[misc]


def test_the_loads_are_those_of_the_grid() -> None:
    made = scene(springs={}, probes=[{"force": [100, 0, 0], "load": [[0, 0], [10, 1000]]}], time={"step": 0.04})
    plan = plan_of(made).with_grid(steps_per_frame=13)
    found, grid = average_loads(plan, 5, 100).strength[:, 0, 0], plan.grid
    np.testing.assert_allclose(found, [100 * grid.time(n) for n in range(5, 105)], rtol=1e-12)


@pytest.mark.parametrize("arch", ["cpu", "cuda"])
@pytest.mark.parametrize(
    "time",
    [
        {},
        {"precision": "auto"},
        {"precision": "f32", "frames_per_second": 30.0, "duration": 1.0},
        {"step": 0.04 / 13},
        {"damping_difference": "backward", "precision": "auto"},
    ],
)
def test_a_scene_into_which_its_grid_is_written_gives_it_again(time: dict[str, Any], arch: str) -> None:
    made = scene(time=time)
    plan = choose_precision(plan_of(made), arch)
    written = freeze_grid(plan).scene
    for other in ("cpu", "cuda", "vulkan"):
        assert choose_precision(plan_of(written), other).grid == plan.grid
    assert written.time.step == made.time.step, "what follows from the scene is left to it"
    assert freeze_grid(plan_of(written)).scene == written


@pytest.mark.parametrize("rate", [10.0, 24.0, 29.97, 1e-3, 1e5])
@pytest.mark.parametrize("count", [1, 7, 49, 12_345, 10**7 + 1])
def test_a_step_that_a_tolerance_chose_is_written_and_read_again(rate: float, count: int) -> None:
    made = scene(time={"frames_per_second": rate, "duration": 3 / rate, "tolerance": 1e-3})
    plan = plan_of(made).with_grid(steps_per_frame=count)
    written = freeze_grid(plan).scene
    assert plan_of(written).grid == plan.grid
    assert written.time.tolerance is None


def test_a_tolerance_is_met_in_f64_on_a_cpu_whatever_the_work() -> None:
    large = {"points": [1024, 1024], "size": [0.3, 0.3], "mass": 1e-3}
    made = scene(sheet=large, time={"precision": "auto"})
    precise = scene(sheet=large, time={"precision": "auto", "tolerance": 1e-3})
    assert (plan_of(made).grid.precision, plan_of(precise).grid.precision) == ("f32", "f64")
    assert choose_precision(plan_of(precise), "cuda").grid.precision == "f32"


def test_a_simulation_has_the_scene_that_gives_its_grid(device: Device) -> None:
    made = scene(probes=[{**PRESS, "force": [0, 0, -300]}], damping=0.02, time={"tolerance": 3e-4, "precision": "auto"})
    plan, estimate = choose_step(plan_of(made), device)
    grid = plan.grid
    assert grid == replace(plan_of(made).grid, steps_per_frame=estimate.steps_per_frame)
    with Simulation(made, threads=device.threads) as simulation:
        assert plan_of(simulation.scene).grid == grid
        assert simulation.scene == freeze_grid(plan).scene
        simulation.advance()
        assert simulation.steps == grid.steps_per_frame
