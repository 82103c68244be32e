"""Tools of a session: what they do from frame to frame is bit-identical to their record."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from taichi_msm.model.loads import Schedule, average_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import path_problems
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import steer_plan
from taichi_msm.terms.contact import ContactTerm
from taichi_msm.view.tools import (
    DEFAULT_FRICTION,
    HOVER_HEIGHT_RADII,
    MAX_DEPTH_RADII,
    RISE_TIME_S,
    ForceControlledTool,
    PositionControlledTool,
)
from tests.scenes import plan_of, scene

# Frame rate of the force-controlled tool, and of the position-controlled one [1/s].
FORCE_RATE, RATE = 50.0, 30.0

# At this rate the rounded time of a frame differs from that of its step.
UNEVEN_RATE = 20.1

RADIUS = 0.01
INSTRUMENT: dict[str, Any] = {"instrument": {"radius": RADIUS, "shaft": [0.5, -0.6, 0.9], "length": 0.2}}


def random_actions(tool: ForceControlledTool | PositionControlledTool, rng: np.random.Generator, count: int) -> None:
    """Press, release, move, or change the strength of a tool."""
    for _ in range(count):
        position = (float(rng.uniform(-0.2, 1.2)), float(rng.uniform(-0.2, 1.2)))
        match int(rng.integers(0, 5)):
            case 0:
                tool.press(position, int(rng.choice([-1, 1])))
            case 1:
                tool.release()
            case 2:
                tool.set_strength(tool.strength + float(rng.integers(-40, 41)))
            case _:
                tool.move(position)


def force_tool() -> ForceControlledTool:
    return ForceControlledTool(scene().probes[0], FORCE_RATE)


def loads(probe: Probe, frame: int) -> Schedule:
    """Return the loads at the steps of a frame."""
    one_frame = scene(time={"frames_per_second": FORCE_RATE, "duration": 1 / FORCE_RATE})
    plan = plan_of(one_frame.model_copy(update={"probes": (probe,)}))
    count = plan.grid.steps_per_frame
    return average_loads(plan, frame * count, count)


def values_of_frames(
    tool: ForceControlledTool | PositionControlledTool, value: Callable[[], float], first: int, count: int
) -> list[float]:
    """Return a value after each of some frames."""
    values = []
    for frame in range(first, first + count):
        tool.advance(frame)
        values.append(value())
    return values


def percents(tool: ForceControlledTool, first: int, count: int) -> list[float]:
    return values_of_frames(tool, lambda: tool.percent, first, count)


def heights(tool: PositionControlledTool, first: int, count: int) -> list[float]:
    """Return the heights after some frames [radii]."""
    return values_of_frames(tool, lambda: tool.height / RADIUS, first, count)


@pytest.mark.parametrize("seed", range(2))
def test_loads_of_every_frame_are_those_of_the_record(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tool, frames = force_tool(), 90
    probes: list[Probe] = []
    for frame in range(frames):
        random_actions(tool, rng, int(rng.integers(0, 3)))
        probes.append(tool.advance(frame))
    record = tool.recorded_probe(frames)
    for frame, probe in enumerate(probes):
        live, recorded = loads(probe, frame), loads(record, frame)
        np.testing.assert_array_equal(live.strength, recorded.strength)
        np.testing.assert_array_equal(live.active, recorded.active)
        # Control points without a load have no effect.
        pressing = recorded.strength.any(axis=(1, 2))
        np.testing.assert_array_equal(live.point[pressing], recorded.point[pressing])


def test_force_rises_gradually_and_falls_at_once() -> None:
    tool = force_tool()
    tool.press((0.4, 0.6), 1)
    rise = percents(tool, 0, 12)
    assert rise[:10] == pytest.approx(list(np.arange(1, 11) * 100 / (RISE_TIME_S * FORCE_RATE)))
    assert rise[10:] == [100.0, 100.0]
    tool.release()
    assert percents(tool, 12, 2) == [0.0, 0.0]
    load = tool.recorded_probe(14).load
    assert (12 / FORCE_RATE, 100.0) in load
    assert (12 / FORCE_RATE, 0.0) in load
    assert len(load) == 1 + 10 + 3, "constant loads have no keyframes"


def test_press_at_another_position_releases_for_a_frame() -> None:
    tool = force_tool()
    tool.press((0.2, 0.2), 1)
    percents(tool, 0, 5)
    tool.press((0.8, 0.8), 1)
    assert percents(tool, 5, 2) == pytest.approx([0, 10])
    at = np.array(tool.recorded_probe(7).at)
    assert (np.diff(at[:, 0]) > 0).all(), "a jumping control point needs another kernel"
    assert tool.position == (0.8, 0.8)


def test_clicks_in_a_pause_become_one() -> None:
    tool = force_tool()
    for n in range(50):
        tool.press((n / 100, 0.123456), 1)
        tool.release()
    assert tool.target == (0.49, 0.123456)
    assert percents(tool, 0, 4) == pytest.approx([10, 0, 0, 0])
    assert tool.position == (0.49, 0.123456)


def position_plan(probe: dict[str, Any] | None = None, **time: Any) -> Plan:
    force = {"force": [0, 0, -1], **INSTRUMENT}
    # Virtual springs act only where a tool presses.
    springs = {"structural": 20, "shear": 10, "virtual": 0.5, "virtual_active": "loaded"}
    return plan_of(scene(probes=[probe or force], springs=springs, time={"frames_per_second": RATE, **time}))


def position_tool(plan: Plan, probe: dict[str, Any] | None = None) -> PositionControlledTool:
    return PositionControlledTool(Probe(**probe) if probe else plan.scene.probes[0], plan)


def step_tables(plan: Plan, frame: int) -> tuple[bytes, ...]:
    """Return all inputs of the steps of a frame that depend on the tool."""
    count = plan.grid.steps_per_frame
    contact, loads = ContactTerm.from_plan(plan), average_loads(plan, frame * count, count)
    assert contact is not None
    assert contact == ContactTerm(("capsule",), (True,), True), "all actions have the same kernel"
    return contact.columns(plan, loads, frame * count).tobytes(), loads.active.tobytes()


@pytest.mark.parametrize(("seed", "rate"), [(0, RATE), (1, UNEVEN_RATE)])
def test_contact_of_every_frame_is_that_of_the_record(seed: int, rate: float) -> None:
    plan, rng = position_plan(frames_per_second=rate, duration=12 / rate), np.random.default_rng(seed)
    tool, frames = position_tool(plan), 240
    live, tables, gripped = plan.with_probes((tool.recorded_probe(0),)), [], 0
    for frame in range(frames):
        random_actions(tool, rng, int(rng.integers(0, 3) // 2))
        live = steer_plan(live, [tool.advance(frame)], plan.grid.time(frame * plan.grid.steps_per_frame))
        tables.append(step_tables(live, frame))
        gripped += tool.gripping
    record = plan.with_probes((tool.recorded_probe(frames),))
    assert gripped > 5
    assert len(record.scene.probes[0].grip) > 1
    assert not list(path_problems(record.scene, record.tools, record.grid))
    assert tables == [step_tables(record, frame) for frame in range(frames)]


def test_tip_falls_and_rises_within_the_rise_time() -> None:
    tool = position_tool(position_plan())
    start = tool.recorded_probe(0)
    assert heights(tool, 0, 2) == [HOVER_HEIGHT_RADII, HOVER_HEIGHT_RADII]
    tool.press((0.4, 0.6), 1)
    tool.set_strength(100)
    down = heights(tool, 2, 8)
    stride = (HOVER_HEIGHT_RADII + MAX_DEPTH_RADII) / (RISE_TIME_S * RATE)
    assert down[:6] == pytest.approx([HOVER_HEIGHT_RADII - stride * (n + 1) for n in range(6)], abs=1e-6)
    assert down[5:] == pytest.approx([-MAX_DEPTH_RADII] * 3)
    tool.release()
    assert heights(tool, 10, 8)[5:] == pytest.approx([HOVER_HEIGHT_RADII] * 3)
    assert tool.position == (0.4, 0.6)
    tool.press((0.3, 0.6), -1)
    heights(tool, 18, 9)
    assert tool.gripping
    tool.reset()
    assert (tool.engaged, tool.gripping) == (False, False)
    assert tool.recorded_probe(0) == start


def test_tip_moves_at_most_by_the_stride_of_a_run() -> None:
    plan = position_plan(step=1 / RATE / 5)
    tool = position_tool(plan)
    tool.move((1.0, 0.5))
    tool.advance(0)
    distance = (tool.position[0] - 0.5) * plan.scene.sheet.size[1]
    assert 0.95 < distance / (5 * RADIUS / 2) < 1
    heights(tool, 1, 20)
    assert tool.position == (1.0, 0.5)


def test_grip_begins_at_the_depth_and_ends_with_the_release() -> None:
    tool = position_tool(position_plan())
    strength = tool.strength
    tool.set_strength(-50)
    assert tool.strength == 0, "only grips can be lifted"
    tool.set_strength(strength)
    tool.press((0.4, 0.6), -1)
    grips = []
    for frame in range(8):
        tool.advance(frame)
        grips.append(tool.gripping)
    assert grips == [False, False, True, True, True, True, True, True]
    assert tool.recorded_probe(8).grip == ((2 / RATE, 8 / RATE),), "it lasts until the end of the record"
    tool.set_strength(-60)
    assert heights(tool, 8, 10)[-1] == pytest.approx(0.6 * MAX_DEPTH_RADII)
    tool.release()
    assert tool.strength == strength, "the next press is not a lift"
    heights(tool, 18, 1)
    assert tool.recorded_probe(19).grip == ((2 / RATE, 18 / RATE),)
    # A click within a frame has no effect.
    tool.press((0.4, 0.6), -1)
    tool.release()
    heights(tool, 19, 10)
    assert heights(tool, 29, 3) == [HOVER_HEIGHT_RADII] * 3


def test_depth_is_at_most_a_quarter_of_the_sheet() -> None:
    instrument = {"radius": 0.1, "shaft": [0, 0, 1], "length": 0.2}
    tool = position_tool(position_plan({"force": [0, 0, -1], "instrument": instrument}))
    assert tool.strength == 100
    assert tool.depth == pytest.approx(0.3 / 4)


def test_friction_is_that_of_the_scene_if_given() -> None:
    plan = position_plan()
    path = {"path": [[0, 0.5, 0.5, 0.01]], **INSTRUMENT}
    for probe, friction in ((None, DEFAULT_FRICTION), (path, DEFAULT_FRICTION), ({**path, "friction": 0.1}, 0.1)):
        assert position_tool(plan, probe).recorded_probe(0).friction == friction
    assert position_tool(position_plan(motion="quasistatic")).recorded_probe(0).friction == 0
