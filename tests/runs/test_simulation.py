"""The Python API."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import taichi_msm
from taichi_msm import DivergedError, Simulation
from taichi_msm.render.labels import FrameOutputs
from taichi_msm.runs import run
from taichi_msm.system import process
from taichi_msm.system.compiler import active_compiler
from taichi_msm.system.runtime import Device
from tests import reference
from tests.scenes import plan_of, scene, speckle


def test_frames_positions_and_pictures(device: Device) -> None:
    made = scene(render={"size": [40, 30], "refine": 1})
    twin = reference.simulate(made)
    with Simulation(made, threads=device.threads, texture=speckle(30, 40)) as simulation:
        np.testing.assert_array_equal(simulation.positions(), twin[0])
        simulation.advance(3)
        assert simulation.frame == 3
        assert simulation.time == pytest.approx(0.12)
        np.testing.assert_allclose(simulation.positions(), twin[3], atol=1e-13)
        apart = np.abs(simulation.draw().astype(int) - reference.draw(made, twin[3], speckle(30, 40)))
        assert (apart > 1).mean() < 0.01
        simulation.advance(0)
        assert simulation.frame == 3
    assert simulation.progress.max_displacement == pytest.approx(np.linalg.norm(twin[:4] - twin[0], axis=-1).max())


def test_kernels_are_compiled_once_in_a_process(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    observed, own = [], Simulation.observe

    def observe(simulation: Simulation, *given: Any) -> FrameOutputs:
        observed.append(given)
        return own(simulation, *given)

    monkeypatch.setattr(Simulation, "observe", observe)
    for refine, drawn in ((3, 2), (2, 2), (0, 4)):  # Only whether the sheet is refined is compiled.
        made = scene(render={"size": [40, 30], "refine": refine}, image="any.png", output=["png"])
        with Simulation(made, threads=device.threads, texture=speckle(30, 40)) as simulation:
            if refine == 3:
                monkeypatch.setattr("taichi_msm.runs.simulation._compiled_kernels", set())
            simulation.compile()
        assert len(observed) == drawn


def test_positions_of_a_frame_stay_as_they_were(device: Device) -> None:
    with Simulation(scene(), threads=device.threads) as simulation:
        simulation.advance()
        before = simulation.positions()
        copy = before.copy()
        simulation.advance()
        np.testing.assert_array_equal(before, copy)
        with pytest.raises(ValueError, match="read-only"):
            before[0, 0, 0] = 1


def test_after_a_divergence_the_last_good_frame_is_there(device: Device) -> None:
    # At 0.1 s the load jumps to what tears the sheet apart.
    made = scene(probes=[{"force": [0, 0, 1], "load": [[0, 0], [0.1, 100], [0.1, 1e15]], "falloff": 20}])
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(2)
        good = simulation.positions()
        with pytest.raises(DivergedError, match=r"diverged before 0\.12 s, step \d+: point \(\d+, \d+\) is "):
            simulation.advance(5)
        np.testing.assert_array_equal(simulation.positions(), good)


def test_a_sheet_that_nothing_holds_may_fly_away(device: Device) -> None:
    # F = 0.05 N on each point of 1 g for 0.8 s: u = F t^2 / (2 m) = 16 m, forty sheets away, and no error of Verlet.
    made = scene(
        sheet={"points": [2, 2], "size": [0.4, 0.4], "mass": 1e-3, "fixed": "none"},
        springs={"structural": 20},
        damping=0,
        probes=[{"force": [0, 0, 0.05], "falloff": 0, "offset": 0}],
        time={"duration": 0.8},
    )
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(20)
        np.testing.assert_allclose(simulation.positions()[..., 2], 16.0, rtol=1e-12)


def test_one_device_a_process(device: Device) -> None:
    with pytest.raises(taichi_msm.DeviceError, match=f"{active_compiler().title} already runs on cpu with 2 threads"):
        Simulation(scene(), threads=device.threads + 1)


def test_the_encoder_has_a_core_of_its_own_while_it_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "available_threads", lambda: 4)
    made = scene(render={"size": [512, 512]}, time={"step": 0.001})
    assert run.free_cores(plan_of(made)) == 4, "nothing to encode"
    made = made.model_copy(update={"image": "a.png", "output": ("gif",)})
    assert run.free_cores(plan_of(made)) == 3
    # 40 steps of 10^6 points a frame take longer than its 512 x 512 pixels.
    large = made.sheet.model_copy(update={"points": (1000, 1000)})
    large_scene = made.model_copy(update={"sheet": large})
    assert run.free_cores(plan_of(large_scene)) == 4
    monkeypatch.setattr(process, "available_threads", lambda: 1)
    assert run.free_cores(plan_of(made)) == 1
