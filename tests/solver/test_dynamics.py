"""Kernel 1 against its twin, and against what must hold of any integrator of this sheet."""

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
from taichi_msm.solver.planned_sheet import POINTS_PER_WORKER
from taichi_msm.system import process
from taichi_msm.system.launches import MAX_ROUNDS, VULKAN_THREADS
from taichi_msm.system.process import available_threads
from taichi_msm.system.runtime import Device, lanes
from taichi_msm.terms.damping import DampingTerm
from taichi_msm.terms.foundation import FoundationTerm
from taichi_msm.terms.loads import ProbeTerm
from taichi_msm.terms.springs import SpringTerm
from tests import reference
from tests.golden import Messages
from tests.motion import dynamics_of, structure_of
from tests.scenes import PRESS, SHEET, SPRINGS, plan_of, random_scene, scene, with_steps

ROUNDING = {"f32": 2.0**-24, "f64": 2.0**-53}


def simulate(made: Scene, device: Device, layout: SheetLayout | None = None) -> NDArray[Any]:
    """Displacements of every frame, shape (F + 1, rows, cols, 3)."""
    grid, dynamics = plan_of(made).grid, dynamics_of(made, device, layout)
    frames = [dynamics.displacement()]
    for _ in range(grid.frames):
        dynamics.advance(grid.steps_per_frame)
        frames.append(dynamics.displacement())
    return np.array(frames)


def assert_like_twin(made: Scene, device: Device, layout: SheetLayout | None = None) -> None:
    twin = reference.simulate(made) - rest_positions(made.sheet)
    # A rounding of a step, of the size of a rest length, is amplified by at most the number of steps squared;
    # in practice by far less. Chaos is kept away by small displacements and few steps.
    largest = max(np.abs(twin).max(), 1e-3 * max(made.sheet.size))
    steps = plan_of(made).grid.steps
    tolerance = ROUNDING[made.time.precision] * steps**1.5 * largest
    np.testing.assert_allclose(simulate(made, device, layout), twin, rtol=0, atol=tolerance)


SLOW = [pytest.param(seed, precision, marks=pytest.mark.slow) for seed in range(8) for precision in ("f32", "f64")]


# Each has terms of its own, and so a kernel.
@pytest.mark.parametrize(("seed", "precision"), [(0, "f32"), (1, "f64"), (3, "f32"), (4, "f64"), (5, "f64"), *SLOW])
def test_random_scene_is_like_the_twin(seed: int, precision: str, device: Device) -> None:
    assert_like_twin(random_scene(seed, precision), device)


def with_lanes(layout: SheetLayout, lanes: int) -> SheetLayout:
    """The same sheet in other vectors."""
    return replace(layout, config=replace(layout.config, lanes=lanes))


def as_on_a_gpu(layout: SheetLayout) -> SheetLayout:
    """The same sheet in the memory of a GPU."""
    return replace(with_lanes(layout, 1), workers=0, depth=1)


# Each has a structure of its own, and so a kernel.
SHEETS = [
    ([2, 2], "none"), ([2, 2], ["left"]), ([2, 9], "corners"), ([9, 2], ["left", "bottom"]), ([3, 8], "border"),
    ([3, 8], "none"), ([4, 17], "corners"), ([4, 17], ["top"]), ([4, 17], ["left", "bottom"]),
]  # fmt: skip


@pytest.mark.parametrize(("points", "fixed"), SHEETS)
def test_small_sheets_and_fixed_sides(points: list[int], fixed: Any, device: Device) -> None:
    sheet = {**SHEET, "points": points, "fixed": fixed}
    assert_like_twin(scene(sheet=sheet, probes=[{"force": [1, 2, 30], "falloff": 3, "offset": 6}]), device)


@pytest.fixture
def short_launches(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Few steps a launch on a GPU, as each of them is compiled."""
    kernel_gpu._build_advance.cache_clear()
    for module in ("kernel_gpu", "dynamics"):
        monkeypatch.setattr(f"taichi_msm.solver.{module}.STEPS_PER_LAUNCH", 3)
    yield
    kernel_gpu._build_advance.cache_clear()


@pytest.mark.parametrize("fixed", [pytest.param("border", marks=pytest.mark.slow), ["top"]])
def test_bands_and_passes_do_not_change_the_bits(fixed: Any, device: Device) -> None:
    made = scene(sheet={**SHEET, "points": [21, 19], "fixed": fixed}, time={"precision": "f32", "duration": 0.12})
    whole = structure_of(made, device)
    assert (whole.workers, whole.depth) == (1, 1)
    plain = simulate(made, device)
    # Also passes longer than a band has rows, and a last one that is not full.
    for workers, depth in ((1, 3), (2, 1), (2, 4), (2, 16)):
        assert plan_of(made).grid.steps_per_frame % depth != 0 or depth == 1
        layout = replace(whole, workers=workers, depth=depth)
        assert simulate(made, device, layout).tobytes() == plain.tobytes(), (workers, depth)


def test_the_depth_of_a_pass_is_chosen_from_the_size(device: Device) -> None:
    # 61 x 61 points are 132 kB and stay in the cache; 331 x 331 do not.
    for points, depth in ((61, 1), (331, 8), (4096, 8)):
        made = scene(sheet={**SHEET, "points": [points, points]}, time={"precision": "f32"})
        assert structure_of(made, device).depth == depth


def test_no_thread_of_a_gpu_takes_long() -> None:
    """It steps points without a loop, and reads a row; threads share what are more points than threads."""
    assert MAX_POINTS + MAX_POINTS**2 // VULKAN_THREADS < MAX_ROUNDS


@pytest.mark.parametrize("widths", [(16, 2), pytest.param((16, 8, 4, 2), marks=pytest.mark.fuzz)])
def test_lanes_do_not_change_the_bits(widths: tuple[int, ...], device: Device) -> None:
    made = scene(sheet={**SHEET, "points": [7, 13]}, time={"precision": "f32"})
    whole = structure_of(made, device)
    motions = [simulate(made, device, with_lanes(whole, width)).tobytes() for width in widths]
    assert len(set(motions)) == 1


def test_large_sheets_are_cut_into_bands(device: Device) -> None:
    side = int(np.sqrt(2 * POINTS_PER_WORKER)) + 1
    for count, workers in ((side, min(2, available_threads())), (side // 2, 1)):
        made = scene(sheet={**SHEET, "points": [count, count]}, time={"duration": 0.04})
        assert structure_of(made, device).workers == workers
        assert structure_of(made, device, cores=1).workers == 1
        assert_like_twin(made, device)


def test_a_launch_ends_soon(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """And between two launches the sheet can be stopped, and go on."""
    made = scene()
    dynamics = dynamics_of(made, device)
    dynamics.advance(100)
    whole = dynamics.displacement()
    dynamics.restart(plan_of(made))
    monkeypatch.setattr("taichi_msm.solver.dynamics.POINT_STEPS_PER_LAUNCH", 12 * math.prod(made.sheet.points))

    def stop() -> None:
        if dynamics.steps_done == 36:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dynamics.advance(100, stop)
    assert dynamics.steps_done == 36
    dynamics.advance(64)
    assert dynamics.displacement().tobytes() == whole.tobytes()


def test_a_frame_of_a_small_sheet_is_one_launch(device: Device) -> None:
    pauses: list[int] = []
    dynamics_of(scene(), device).advance(plan_of(scene()).grid.steps_per_frame, lambda: pauses.append(1))
    assert plan_of(scene()).grid.steps_per_frame > len(pauses) == 1


def test_absent_terms_are_left_out(device: Device) -> None:
    bare = structure_of(scene(springs={"structural": 1}, probes=[], damping=0), device).config
    assert bare.terms == (SpringTerm(True, False, False, False, False, False), ProbeTerm((), ()))
    assert not structure_of(scene(probes=[]), device).config.get(FoundationTerm), "loaded, but nothing ever loads"
    full = structure_of(scene(), device).config
    assert full.get(FoundationTerm)
    assert full.get(DampingTerm)
    assert full.lanes == lanes("f64")


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("ratio", [0.0, 1e-6, 0.5])
def test_a_spring_that_is_pressed_to_a_point(ratio: float, precision: str, device: Device) -> None:
    # A step of 1 s moves the points of the right column, 1 kg each, by half their load; the next one shows the force.
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


def test_nothing_moves_without_a_load_and_fixed_points_never(device: Device) -> None:
    assert not simulate(scene(probes=[], sheet={**SHEET, "fixed": "none"}), device).any()
    u = simulate(scene(time={"precision": "f32"}), device)
    assert not u[:, [0, -1]].any()
    assert not u[:, :, [0, -1]].any()
    assert u[:, 1:-1, 1:-1].any()


def motion_energy(made: Scene, u: NDArray[Any], difference: NDArray[Any]) -> float:
    """Kinetic energy and that of the springs between points [J]."""
    v = difference / plan_of(made).grid.step
    return float(plan_of(made).material.mass * (v**2).sum() / 2) + reference.energy(made, u)


def test_energy_does_not_drift(device: Device) -> None:
    # Undamped, unloaded after a release: the energy of the scheme oscillates with (w h)^2 and has no trend.
    made = scene(
        damping=0,
        springs={**SPRINGS, "virtual_active": "always"},
        probes=[{"force": [0, 0, -300], "load": [[0, 0], [0.04, 100], [0.04, 0]], "falloff": 20}],
        time={"duration": 24.0},
    )
    steps, virtual = plan_of(made).grid.steps_per_frame, plan_of(made).material.virtual
    assert made.time.frames * steps > 1e4
    dynamics = dynamics_of(made, device)
    energies = []
    for _ in range(made.time.frames):
        dynamics.advance(steps - 1)
        before = dynamics.displacement()
        dynamics.advance(1)
        after = dynamics.displacement()
        middle = (before + after) / 2
        energies.append(motion_energy(made, middle, after - before) + virtual / 2 * (middle**2).sum())
    late = np.array(energies[10:])
    trend = np.polyfit(np.linspace(-0.5, 0.5, len(late)), late, 1)[0]
    # (w h)^2 / 8 = 1/8 of the energy of the highest mode is in the oscillation; the press excites low modes.
    assert late.std() < 0.02 * late.mean()
    assert abs(trend) < 1e-3 * late.mean()


@pytest.mark.usefixtures("short_launches")
@pytest.mark.parametrize(("seed", "width"), [(3, 8), (4, 1)])
def test_the_energy_is_that_of_motion_and_springs(seed: int, width: int, device: Device) -> None:
    made = random_scene(seed)
    layout = structure_of(made, device)
    dynamics = dynamics_of(made, device, layout if width > 1 else as_on_a_gpu(layout))
    dynamics.advance(33)
    (_, u, difference, *_), reading = dynamics.state(), dynamics.read()
    assert reading.energy == pytest.approx(motion_energy(made, u, difference), rel=1e-12)
    assert reading.shortest_spring == pytest.approx(reference.shortest_spring(made, u), rel=1e-12)


@pytest.mark.parametrize("difference", ["central", "backward"])
def test_just_under_the_limit_stays_bounded(difference: str, device: Device) -> None:
    coarse = scene(time={"duration": 1, "damping_difference": difference})
    # Frames of a thousand of the largest steps below the limit.
    h = 0.99 * plan_of(coarse).stable_step
    time = {"duration": 1e5 * h, "frames_per_second": 1 / h / 1000, "step": h, "damping_difference": difference}
    made = scene(probes=[{"force": [0, 0, -1000], "falloff": 20}], time=time)
    dynamics = dynamics_of(made, device)
    for _ in range(100):
        dynamics.advance(1000)
        largest = np.abs(dynamics.displacement()).max()
        assert largest < max(made.sheet.size), "bounded by the sheet, over 10^5 steps"


def test_a_restart_is_a_new_start(device: Device) -> None:
    """Of any scene, where no layout is given."""
    other = scene(probes=[{**PRESS, "at": [0.2, 0.3]}], damping=0.02, sheet={**SHEET, "size": [0.4, 0.2], "mass": 2e-3})
    in_bands = dynamics_of(scene(), device, replace(structure_of(scene(), device), workers=2))
    others = scene(probes=[]), scene(time={"precision": "f32"}), scene(sheet={**SHEET, "points": [9, 12]})
    for dynamics, scenes in (
        (in_bands, (other, with_steps(other, 50), scene())),
        (dynamics_of(scene(), device), others),
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
@pytest.mark.parametrize("patience", [0, 30])
def test_workers_that_give_up_waiting_go_on_to_the_same_bits(
    patience: int, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where another program has a core: in launch after launch, and then by one worker for some time."""
    made = scene(sheet={**SHEET, "points": [21, 19], "fixed": ["top"]}, time={"precision": "f32"})
    alone = dynamics_of(made, device)
    steps = (3, 200, 1, 77, 400, 5)
    for count in steps:
        alone.advance(count)
    monkeypatch.setattr(kernel_cpu, "MAX_CHECKS", patience)
    monkeypatch.setattr(backoff, "MIN_BACKOFF_S", 0.001)
    monkeypatch.setattr(backoff, "MAX_BACKOFF_S", 0.002)
    for workers, depth in ((2, 1), (2, 4), (3, 2)):
        together = dynamics_of(made, device, replace(structure_of(made, device), workers=workers, depth=depth))
        for count in steps:
            together.advance(count)
            time.sleep(0.003)
        for one, other in zip(together.state()[1:3], alone.state()[1:3], strict=True):
            assert one.tobytes() == other.tobytes()


def test_backoffs_grow_while_workers_time_out_on_crowded_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    now, waits = [0.0], [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    monkeypatch.setattr("time.process_time", lambda: now[0])
    monkeypatch.setattr(process, "core_wait_s", lambda: waits[0])
    paused = backoff.Backoff()

    def period(parallel_s: float, waited: float, timed_out: bool = True) -> float:
        """The back-off after a launch in which threads waited for a share of its time."""
        paused.start_launch()
        now[0], waits[0] = now[0] + parallel_s, waits[0] + waited * parallel_s
        paused.end_launch(timed_out=timed_out)
        begin = now[0]
        while paused.is_active:
            now[0] += 1e-4
            waits[0] += 0.5e-4  # of no account, as nobody waits for another worker
        return now[0] - begin

    shortest, longest = backoff.MIN_BACKOFF_S, backoff.MAX_BACKOFF_S
    # As long as no other program wants the cores, a timeout is an accident.
    for _ in range(3):
        assert period(1e-3, 0.0) == pytest.approx(shortest, abs=2e-4)
    periods = [round(period(1e-3, 1.0), 3) for _ in range(6)]
    assert periods == sorted(periods)
    assert periods[-1] == pytest.approx(longest, abs=2e-4)
    # After a long undisturbed time the next one is the shortest again.
    assert period(10.0, 0.0, timed_out=False) == 0
    assert period(1e-3, 1.0) == pytest.approx(shortest, abs=2e-4)


def test_giving_up_in_the_last_pass_of_a_launch_counts(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    made = scene(sheet={**SHEET, "points": [101, 101]}, time={"precision": "f32"})
    monkeypatch.setattr(kernel_cpu, "MAX_CHECKS", 0)
    dynamics = dynamics_of(made, device, replace(structure_of(made, device), workers=2, depth=8))
    scatter = dynamics.sheet.kernel
    assert isinstance(scatter, kernel_cpu.ScatterKernel)
    for _ in range(200):
        dynamics.advance(8)
    assert scatter._backoff._until > 0


def test_a_sheet_that_was_interrupted_while_stepping_is_not_used(
    device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """Python may raise KeyboardInterrupt after a launch, before its steps are counted."""
    made = scene()
    dynamics = dynamics_of(made, device)
    dynamics.advance(10)
    saved, advance = dynamics.state(), dynamics.sheet.kernel.advance

    def interrupted(*arguments: Any) -> None:
        advance(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(dynamics.sheet.kernel, "advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        dynamics.advance(5)
    monkeypatch.undo()
    for use in (dynamics.state, dynamics.read, lambda: dynamics.advance(1)):
        with message.raises(MsmError, "restore"):
            use()
    dynamics.restart(dynamics.plan, saved)
    dynamics.advance(5)
    fresh = dynamics_of(made, device)
    fresh.advance(15)
    assert dynamics.displacement().tobytes() == fresh.displacement().tobytes()


def test_a_second_sheet_of_the_same_terms_compiles_nothing(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever its size and its numbers."""
    first, other = scene(), scene(sheet={**SHEET, "points": [30, 17], "mass": 3e-3}, damping=0.5)
    dynamics_of(first, device).compile()

    def compiled(*_: object, **__: object) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(ast, "parse", compiled)
    dynamics = dynamics_of(other, device)
    dynamics.advance(5)
    dynamics.displacement()
