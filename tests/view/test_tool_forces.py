"""The tool that a hand holds by position: what it does from frame to frame is what its record says, to the bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm.model.loads import average_loads
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
    PositionControlledTool,
)
from tests.scenes import plan_of, scene

RATE = 30.0

# At this rate the time of a frame is not that of its step, to the bit.
UNEVEN = 20.1

RADIUS = 0.01
ROD: dict[str, Any] = {"instrument": {"radius": RADIUS, "shaft": [0.5, -0.6, 0.9], "length": 0.2}}


def plan(probe: dict[str, Any] | None = None, **time: Any) -> Plan:
    force = {"force": [0, 0, -1], **ROD}
    # Not always, so that it matters when the tool counts as pressing.
    springs = {"structural": 20, "shear": 10, "virtual": 0.5, "virtual_active": "loaded"}
    return plan_of(scene(probes=[probe or force], springs=springs, time={"frames_per_second": RATE, **time}))


def tool(made: Plan, probe: dict[str, Any] | None = None) -> PositionControlledTool:
    return PositionControlledTool(Probe(**probe) if probe else made.scene.probes[0], made)


def follow(hand: PositionControlledTool, first: int, count: int) -> list[float]:
    """The heights after some frames, in radii."""
    found = []
    for frame in range(first, first + count):
        hand.advance(frame)
        found.append(hand.height / RADIUS)
    return found


def tables(held: Plan, frame: int) -> tuple[bytes, ...]:
    """All that the steps of a frame are told of a tool."""
    count = held.grid.steps_per_frame
    contact, loads = ContactTerm.from_plan(held), average_loads(held, frame * count, count)
    assert contact is not None
    assert contact == ContactTerm(("capsule",), (True,), True), "one kernel, whatever is done"
    return contact.columns(held, loads, frame * count).tobytes(), loads.active.tobytes()


@pytest.mark.parametrize(("seed", "rate"), [(0, RATE), (1, UNEVEN)])
def test_every_frame_is_what_the_record_says(seed: int, rate: float) -> None:
    made, rng = plan(frames_per_second=rate, duration=12 / rate), np.random.default_rng(seed)
    hand, frames = tool(made), 240
    live, seen, gripped = made.with_probes((hand.recorded_probe(0),)), [], 0
    for frame in range(frames):
        for _ in range(int(rng.integers(0, 3) // 2)):
            place = (float(rng.uniform(-0.2, 1.2)), float(rng.uniform(-0.2, 1.2)))
            match int(rng.integers(0, 5)):
                case 0:
                    hand.press(place, int(rng.choice([-1, 1])))
                case 1:
                    hand.release()
                case 2:
                    hand.set_strength(hand.strength + float(rng.integers(-40, 41)))
                case _:
                    hand.move(place)
        live = steer_plan(live, [hand.advance(frame)], made.grid.time(frame * made.grid.steps_per_frame))
        seen.append(tables(live, frame))
        gripped += hand.gripping
    record = made.with_probes((hand.recorded_probe(frames),))
    assert gripped > 5
    assert len(record.scene.probes[0].grip) > 1
    assert not list(path_problems(record.scene, record.tools, record.grid))
    assert seen == [tables(record, frame) for frame in range(frames)]


def test_a_press_goes_down_in_a_fifth_of_a_second_at_most_and_a_release_up() -> None:
    hand = tool(plan())
    assert follow(hand, 0, 2) == [HOVER_HEIGHT_RADII, HOVER_HEIGHT_RADII]
    hand.press((0.4, 0.6), 1)
    hand.set_strength(100)
    down = follow(hand, 2, 8)
    stride = (HOVER_HEIGHT_RADII + MAX_DEPTH_RADII) / (RISE_TIME_S * RATE)
    assert down[:6] == pytest.approx([HOVER_HEIGHT_RADII - stride * (n + 1) for n in range(6)], abs=1e-6)
    assert down[5:] == pytest.approx([-MAX_DEPTH_RADII] * 3)
    hand.release()
    assert follow(hand, 10, 8)[5:] == pytest.approx([HOVER_HEIGHT_RADII] * 3)
    assert hand.position == (0.4, 0.6)


def test_it_goes_no_farther_in_a_step_than_a_run_allows() -> None:
    made = plan(step=1 / RATE / 5)
    hand = tool(made)
    hand.move((1.0, 0.5))
    hand.advance(0)
    way = (hand.position[0] - 0.5) * made.scene.sheet.size[1]
    assert 0.95 < way / (5 * RADIUS / 2) < 1
    follow(hand, 1, 20)
    assert hand.position == (1.0, 0.5)


def test_a_grip_begins_where_the_tip_stops_and_ends_with_the_press() -> None:
    hand = tool(plan())
    usual = hand.strength
    hand.set_strength(-50)
    assert hand.strength == 0, "nothing is held that could be lifted"
    hand.set_strength(usual)
    hand.press((0.4, 0.6), -1)
    grips = []
    for frame in range(8):
        hand.advance(frame)
        grips.append(hand.gripping)
    assert grips == [False, False, True, True, True, True, True, True]
    assert hand.recorded_probe(8).grip == ((2 / RATE, 8 / RATE),), "it lasts as long as the record"
    hand.set_strength(-60)
    assert follow(hand, 8, 10)[-1] == pytest.approx(0.6 * MAX_DEPTH_RADII)
    hand.release()
    assert hand.strength == usual, "the next press is no lift"
    follow(hand, 18, 1)
    assert hand.recorded_probe(19).grip == ((2 / RATE, 18 / RATE),)


def test_a_click_shorter_than_a_frame_touches_nothing() -> None:
    hand = tool(plan())
    hand.press((0.4, 0.6), -1)
    hand.release()
    assert follow(hand, 0, 3) == [HOVER_HEIGHT_RADII] * 3
    assert not hand.gripping


def test_it_is_no_deeper_than_the_sheet_bears() -> None:
    rod = {"radius": 0.1, "shaft": [0, 0, 1], "length": 0.2}
    hand = tool(plan({"force": [0, 0, -1], "instrument": rod}))
    assert hand.strength == 100
    assert hand.depth == pytest.approx(0.3 / 4), "a quarter of the shorter side"


def test_the_friction_is_that_of_the_scene_if_it_gives_any() -> None:
    made = plan()
    path = {"path": [[0, 0.5, 0.5, 0.01]], **ROD}
    assert tool(made).recorded_probe(0).friction == DEFAULT_FRICTION
    assert tool(made, path).recorded_probe(0).friction == DEFAULT_FRICTION
    assert tool(made, {**path, "friction": 0.1}).recorded_probe(0).friction == 0.1
    assert tool(plan(motion="quasistatic")).recorded_probe(0).friction == 0, "at rest nothing rubs"


def test_what_was_done_is_forgotten_at_rest() -> None:
    hand = tool(plan())
    beginning = hand.recorded_probe(0)
    hand.press((0.4, 0.6), -1)
    follow(hand, 0, 9)
    hand.reset()
    assert not hand.engaged
    assert not hand.gripping
    assert hand.recorded_probe(0) == beginning
