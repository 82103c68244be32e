"""The time grid: whole steps, and scenes that reproduce their grid."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest

from taichi_msm import Simulation
from taichi_msm.accuracy.time_step import choose_step
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.solver.planning import choose_precision, freeze_grid
from taichi_msm.system.runtime import Device
from tests.scenes import PRESS, plan_of, scene


def test_times_are_rounded_once() -> None:
    """A time is a quotient of two whole numbers, and neither a sum nor a multiple of a rounded step."""
    grid = TimeGrid(frames_per_second=30.0, frames=10**6, steps_per_frame=49, precision="f64")
    assert (grid.steps, grid.step) == (49 * 10**6, 1 / (30 * 49))
    for n in (*range(1000), 12_345_678, grid.steps):
        assert grid.time(n) == float(Fraction(n, 30 * 49))


@pytest.mark.parametrize(
    "time",
    [
        {},
        {"precision": "f32", "frames_per_second": 30.0, "duration": 1.0},
        {"step": 0.04 / 13},
        {"damping_difference": "backward", "precision": "auto"},
    ],
)
def test_frozen_scene_reproduces_its_grid(time: dict[str, Any]) -> None:
    made = scene(time=time)
    for arch in ("cpu", "cuda"):
        plan = choose_precision(plan_of(made), arch)
        frozen = freeze_grid(plan).scene
        for target in ("cpu", "cuda", "vulkan"):
            assert choose_precision(plan_of(frozen), target).grid == plan.grid
        assert frozen.time.step == made.time.step, "a step that follows from the scene is not written"
        assert freeze_grid(plan_of(frozen)).scene == frozen


def test_frozen_scene_reproduces_the_step_of_a_tolerance() -> None:
    for rate in (10.0, 29.97, 1e-3, 1e5):
        plan = plan_of(scene(time={"frames_per_second": rate, "duration": 3 / rate, "tolerance": 1e-3}))
        for count in (1, 7, 49, 12_345, 10**7 + 1):
            chosen = plan.with_grid(steps_per_frame=count)
            frozen = freeze_grid(chosen).scene
            assert frozen.time.tolerance is None
            assert plan_of(frozen).grid == chosen.grid


def test_scene_of_a_simulation_reproduces_its_grid(device: Device) -> None:
    made = scene(probes=[{**PRESS, "force": [0, 0, -300]}], damping=0.02, time={"tolerance": 3e-4, "precision": "auto"})
    plan, estimate = choose_step(plan_of(made), device)
    assert plan.grid == replace(plan_of(made).grid, steps_per_frame=estimate.steps_per_frame)
    with Simulation(made, threads=device.threads) as simulation:
        assert plan_of(simulation.scene).grid == plan.grid
        assert simulation.scene == freeze_grid(plan).scene
        simulation.advance()
        assert simulation.steps == plan.grid.steps_per_frame
