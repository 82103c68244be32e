"""Kernel 1 against its twin, and properties of any integrator of the sheet: energy, stability, bits, interruption."""

from __future__ import annotations

import ast
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.errors import MsmError
from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.solver import backoff, kernel_cpu, kernel_gpu
from taichi_msm.solver.arrays import SheetLayout
from taichi_msm.solver.sheet_solver import POINTS_PER_WORKER
from taichi_msm.system import process
from taichi_msm.system.launches import MAX_ROUNDS, VULKAN_THREADS
from taichi_msm.system.process import available_threads
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.motion import dynamics_of, structure_of
from tests.scenes import PRESS, SHEET, SPRINGS, plan_of, random_scene, scene, with_steps

ROUNDING = {"f32": 2.0**-24, "f64": 2.0**-53}


def simulate(made: Scene, device: Device, layout: SheetLayout | None = None) -> NDArray[Any]:
    """Displacements at every frame [m], shape (F + 1, rows, cols, 3)."""
    grid, dynamics = plan_of(made).grid, dynamics_of(made, device, layout)
    frames = [dynamics.displacement()]
    for _ in range(grid.frames):
        dynamics.advance(grid.steps_per_frame)
        frames.append(dynamics.displacement())
    return np.array(frames)


def assert_like_twin(made: Scene, device: Device, layout: SheetLayout | None = None) -> None:
    twin = reference.simulate(made) - rest_positions(made.sheet)
    # A rounding of a step, of the size of a rest length, is amplified by at most the number of steps squared; in
    # practice by far less. Displacements and numbers of steps are too small for chaos.
    largest = max(np.abs(twin).max(), 1e-3 * max(made.sheet.size))
    tolerance = ROUNDING[made.time.precision] * plan_of(made).grid.steps ** 1.5 * largest
    np.testing.assert_allclose(simulate(made, device, layout), twin, rtol=0, atol=tolerance)


SLOW = [pytest.param(seed, precision, marks=pytest.mark.slow) for seed in range(8) for precision in ("f32", "f64")]


# Each case has other terms, and therefore another kernel.
@pytest.mark.parametrize(("seed", "precision"), [(0, "f32"), (1, "f64"), (3, "f32"), (4, "f64"), (5, "f64"), *SLOW])
def test_random_scenes_match_twin(seed: int, precision: str, device: Device) -> None:
    assert_like_twin(random_scene(seed, precision), device)


def with_lanes(layout: SheetLayout, lanes: int) -> SheetLayout:
    return replace(layout, config=replace(layout.config, lanes=lanes))


def as_on_a_gpu(layout: SheetLayout) -> SheetLayout:
    return replace(with_lanes(layout, 1), workers=0, depth=1)


# Each case has another structure, and therefore another kernel.
SHEETS = [
    ([2, 2], "none"), ([2, 9], "corners"), ([9, 2], ["left", "bottom"]), ([3, 8], "border"), ([4, 17], ["top"]),
]  # fmt: skip


@pytest.mark.parametrize(("points", "fixed"), SHEETS)
def test_small_sheets_match_twin(points: list[int], fixed: Any, device: Device) -> None:
    sheet = {**SHEET, "points": points, "fixed": fixed}
    assert_like_twin(scene(sheet=sheet, probes=[{"force": [1, 2, 30], "falloff": 3, "offset": 6}]), device)


@pytest.fixture
def short_launches(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fewer steps per launch on a GPU, because each of them is compiled."""
    kernel_gpu._build_advance.cache_clear()
    for module in ("kernel_gpu", "dynamics"):
        monkeypatch.setattr(f"taichi_msm.solver.{module}.STEPS_PER_LAUNCH", 3)
    yield
    kernel_gpu._build_advance.cache_clear()


@pytest.mark.parametrize("fixed", [pytest.param("border", marks=pytest.mark.slow), ["top"]])
def test_bands_passes_and_lanes_preserve_bits(fixed: Any, device: Device) -> None:
    made = scene(sheet={**SHEET, "points": [21, 19], "fixed": fixed}, time={"precision": "f32", "duration": 0.12})
    serial = structure_of(made, device)
    assert (serial.workers, serial.depth) == (1, 1)
    expected = simulate(made, device)
    # Also passes longer than a band has rows, and an incomplete last pass.
    for workers, depth in ((1, 3), (2, 1), (2, 4), (2, 16)):
        assert plan_of(made).grid.steps_per_frame % depth != 0 or depth == 1
        layout = replace(serial, workers=workers, depth=depth)
        assert simulate(made, device, layout).tobytes() == expected.tobytes(), (workers, depth)
    for lanes in (16, 2):
        assert simulate(made, device, with_lanes(serial, lanes)).tobytes() == expected.tobytes(), lanes


def test_layout_by_size(device: Device) -> None:
    """Large sheets have several bands; a pass takes several steps if a band exceeds the cache."""
    side = int(np.sqrt(2 * POINTS_PER_WORKER)) + 1
    for count, workers in ((side, min(2, available_threads())), (side // 2, 1)):
        made = scene(sheet={**SHEET, "points": [count, count]}, time={"duration": 0.04})
        assert structure_of(made, device).workers == workers
        assert structure_of(made, device, cores=1).workers == 1
        assert_like_twin(made, device)
    # 61 x 61 points take 132 kB.
    for count, depth in ((61, 1), (331, 8), (4096, 8)):
        made = scene(sheet={**SHEET, "points": [count, count]}, time={"precision": "f32"})
        assert structure_of(made, device).depth == depth


def test_rounds_of_a_gpu_thread() -> None:
    """A thread steps its mass points without a loop and reads one row, below the watchdog's limit."""
    assert MAX_POINTS + MAX_POINTS**2 // VULKAN_THREADS < MAX_ROUNDS


def test_launches_and_interruption(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame of a small sheet is one launch; an interruption between launches changes no bits."""
    made, pauses = scene(), list[int]()
    dynamics = dynamics_of(made, device)
    dynamics.advance(plan_of(made).grid.steps_per_frame, lambda: pauses.append(dynamics.steps_done))
    assert pauses == [plan_of(made).grid.steps_per_frame]
    dynamics.restart(plan_of(made))
    dynamics.advance(100)
    expected = dynamics.displacement()
    dynamics.restart(plan_of(made))
    monkeypatch.setattr("taichi_msm.solver.dynamics.POINT_STEPS_PER_LAUNCH", 12 * math.prod(made.sheet.points))

    def stop() -> None:
        if dynamics.steps_done == 36:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dynamics.advance(100, stop)
    assert dynamics.steps_done == 36
    dynamics.advance(64)
    assert dynamics.displacement().tobytes() == expected.tobytes()


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("ratio", [0.0, 1e-6, 0.5])
def test_spring_compressed_to_a_point(ratio: float, precision: str, device: Device) -> None:
    # A step of 1 s moves the mass points of the right column, 1 kg each, by half their load; the next shows the force.
    sheet, load = {"points": [2, 2], "size": [1, 1], "mass": 1, "fixed": ["left"]}, [[0, 100], [0.5, 100], [0.5, 0]]
    made = scene(
        sheet=sheet,
        springs={"structural": 0.25, "shear": 0.125},
        damping=0,
        probes=[{"force": [2 * (ratio - 1), 0, 0], "falloff": 0, "offset": 0, "load": load}],
        time={"duration": 2, "frames_per_second": 1, "step": 1, "precision": precision},
    )
    dynamics = dynamics_of(made, device)
    dynamics.advance(2)
    twin = reference.simulate(made)[2] - rest_positions(made.sheet)
    np.testing.assert_allclose(dynamics.displacement(), twin, rtol=0, atol=8 * ROUNDING[precision])


def test_rest_without_load_and_fixed_points(device: Device) -> None:
    assert not simulate(scene(probes=[], sheet={**SHEET, "fixed": "none"}), device).any()
    u = simulate(scene(time={"precision": "f32"}), device)
    assert not u[:, [0, -1]].any()
    assert not u[:, :, [0, -1]].any()
    assert u[:, 1:-1, 1:-1].any()


def motion_energy(made: Scene, u: NDArray[Any], difference: NDArray[Any]) -> float:
    """Kinetic energy and energy of the springs between mass points [J]."""
    v = difference / plan_of(made).grid.step
    return float(plan_of(made).material.mass * (v**2).sum() / 2) + reference.energy(made, u)


def test_energy_drift(device: Device) -> None:
    """Undamped and unloaded after a release, the energy of the scheme oscillates with (w h)^2 and has no trend."""
    made = scene(
        damping=0,
        springs={**SPRINGS, "virtual_active": "always"},
        probes=[{"force": [0, 0, -300], "load": [[0, 0], [0.04, 100], [0.04, 0]], "falloff": 20}],
        time={"duration": 24.0},
    )
    steps, virtual = plan_of(made).grid.steps_per_frame, plan_of(made).material.virtual
    assert made.time.frames * steps > 1e4
    dynamics, energies = dynamics_of(made, device), []
    for _ in range(made.time.frames):
        dynamics.advance(steps - 1)
        before = dynamics.displacement()
        dynamics.advance(1)
        after = dynamics.displacement()
        middle = (before + after) / 2
        energies.append(motion_energy(made, middle, after - before) + virtual / 2 * (middle**2).sum())
    late = np.array(energies[10:])
    trend = np.polyfit(np.linspace(-0.5, 0.5, len(late)), late, 1)[0]
    # Of the energy of the highest mode, (w h)^2 / 8 = 1/8 oscillates; the press excites low modes.
    assert late.std() < 0.02 * late.mean()
    assert abs(trend) < 1e-3 * late.mean()


@pytest.mark.usefixtures("short_launches")
def test_measures_on_a_gpu(device: Device) -> None:
    made = random_scene(4)
    dynamics = dynamics_of(made, device, as_on_a_gpu(structure_of(made, device)))
    dynamics.advance(33)
    (_, u, difference, *_), reading = dynamics.state(), dynamics.read()
    assert reading.energy == pytest.approx(motion_energy(made, u, difference), rel=1e-12)
    assert reading.shortest_spring == pytest.approx(reference.shortest_spring(made, u), rel=1e-12)


@pytest.mark.parametrize("difference", ["central", "backward"])
def test_bounded_motion_below_stability_limit(difference: str, device: Device) -> None:
    h = 0.99 * plan_of(scene(time={"duration": 1, "damping_difference": difference})).stable_step
    time = {"duration": 1e5 * h, "frames_per_second": 1 / h / 1000, "step": h, "damping_difference": difference}
    made = scene(probes=[{"force": [0, 0, -1000], "falloff": 20}], time=time)
    dynamics = dynamics_of(made, device)
    for _ in range(100):
        dynamics.advance(1000)
        assert np.abs(dynamics.displacement()).max() < max(made.sheet.size)


def test_restart(device: Device) -> None:
    """A restart equals a new start, with any scene if the layout is not given."""
    moved = scene(probes=[{**PRESS, "at": [0.2, 0.3]}], damping=0.02, sheet={**SHEET, "size": [0.4, 0.2], "mass": 2e-3})
    in_bands = dynamics_of(scene(), device, replace(structure_of(scene(), device), workers=2))
    different = scene(probes=[]), scene(time={"precision": "f32"}), scene(sheet={**SHEET, "points": [9, 12]})
    for dynamics, scenes in (
        (in_bands, (moved, with_steps(moved, 50), scene())),
        (dynamics_of(scene(), device), different),
    ):
        dynamics.advance(77)
        for made in scenes:
            dynamics.restart(plan_of(made))
            frames = [dynamics.displacement()]
            for _ in range(made.time.frames):
                dynamics.advance(plan_of(made).grid.steps_per_frame)
                frames.append(dynamics.displacement())
            np.testing.assert_array_equal(frames, simulate(made, device))


@pytest.mark.default_cases("30")
@pytest.mark.parametrize("checks", [0, 30])
def test_worker_timeouts_preserve_bits(checks: int, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Timeouts as with other programs on the cores, launch after launch, each followed by a back-off."""
    made = scene(sheet={**SHEET, "points": [21, 19], "fixed": ["top"]}, time={"precision": "f32"})
    alone, steps = dynamics_of(made, device), (3, 200, 1, 77, 400, 5)
    for count in steps:
        alone.advance(count)
    monkeypatch.setattr(kernel_cpu, "MAX_CHECKS", checks)
    monkeypatch.setattr(backoff, "MIN_BACKOFF_S", 0.001)
    monkeypatch.setattr(backoff, "MAX_BACKOFF_S", 0.002)
    for workers, depth in ((2, 1), (2, 4), (3, 2)):
        together = dynamics_of(made, device, replace(structure_of(made, device), workers=workers, depth=depth))
        for count in steps:
            together.advance(count)
            time.sleep(0.003)
        for array, expected in zip(together.state()[1:3], alone.state()[1:3], strict=True):
            assert array.tobytes() == expected.tobytes()


def test_backoff_period(monkeypatch: pytest.MonkeyPatch) -> None:
    """It grows with consecutive timeouts while other programs compete for the cores, and is minimal otherwise."""
    now, waits = [0.0], [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    monkeypatch.setattr("time.process_time", lambda: now[0])
    monkeypatch.setattr(process, "core_wait_s", lambda: waits[0])
    tested = backoff.Backoff()

    def period(parallel_s: float, wait_share: float, timed_out: bool = True) -> float:
        tested.start_launch()
        now[0], waits[0] = now[0] + parallel_s, waits[0] + wait_share * parallel_s
        tested.end_launch(timed_out=timed_out)
        begin = now[0]
        while tested.is_active:
            now[0] += 1e-4
            waits[0] += 0.5e-4  # ignored, because a single worker waits for no other
        return now[0] - begin

    shortest = pytest.approx(backoff.MIN_BACKOFF_S, abs=2e-4)
    for _ in range(3):
        assert period(1e-3, 0.0) == shortest
    periods = [round(period(1e-3, 1.0), 3) for _ in range(6)]
    assert periods == sorted(periods)
    assert periods[-1] == pytest.approx(backoff.MAX_BACKOFF_S, abs=2e-4)
    # It decays during parallel steps without a timeout.
    assert period(10.0, 0.0, timed_out=False) == 0
    assert period(1e-3, 1.0) == shortest


def test_interrupted_launch(device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """Python can raise KeyboardInterrupt after a launch, before its steps are counted."""
    dynamics = dynamics_of(scene(), device)
    dynamics.advance(15)
    expected = dynamics.displacement()
    dynamics.restart(dynamics.plan)
    dynamics.advance(10)
    saved, advance = dynamics.state(), dynamics.kernel.advance

    def interrupted(*arguments: Any) -> None:
        advance(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(dynamics.kernel, "advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        dynamics.advance(5)
    monkeypatch.undo()
    for use in (dynamics.state, dynamics.read, lambda: dynamics.advance(1)):
        with message.raises(MsmError, "restore"):
            use()
    dynamics.restart(dynamics.plan, saved)
    dynamics.advance(5)
    assert dynamics.displacement().tobytes() == expected.tobytes()


def test_interrupted_restart(device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    dynamics = dynamics_of(scene(), device)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(dynamics, "_build_kernel", interrupted)
    with pytest.raises(KeyboardInterrupt):
        dynamics.restart(dynamics.plan)
    with message.raises(MsmError):
        dynamics.compile()
    monkeypatch.undo()
    dynamics.restart(dynamics.plan)
    dynamics.advance(1)


def test_kernels_are_reused(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sheet of the same terms compiles nothing, whatever its size and coefficients."""
    dynamics_of(scene(), device).compile()

    def compiled(*_: object, **__: object) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(ast, "parse", compiled)
    dynamics = dynamics_of(scene(sheet={**SHEET, "points": [30, 17], "mass": 3e-3}, damping=0.5), device)
    dynamics.advance(5)
    dynamics.displacement()
