"""The tool in the hand: what it does from frame to frame is what its record says, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_msm.model.loads import Schedule, average_loads
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.tools import Probe
from taichi_msm.view.tools import RISE_TIME_S, ForceControlledTool
from tests.scenes import plan_of, scene

RATE = 50.0


def tool() -> ForceControlledTool:
    return ForceControlledTool(scene().probes[0], RATE)


def with_probe(probe: Probe, frames: int) -> Scene:
    base = scene(time={"frames_per_second": RATE, "duration": frames / RATE})
    return base.model_copy(update={"probes": (probe,)})


def loads(probe: Probe, frame: int) -> Schedule:
    """The loads at the steps of a frame."""
    plan = plan_of(with_probe(probe, 1))
    count = plan.grid.steps_per_frame
    return average_loads(plan, frame * count, count)


def percents(hand: ForceControlledTool, first: int, count: int) -> list[float]:
    found = []
    for frame in range(first, first + count):
        hand.advance(frame)
        found.append(hand.percent)
    return found


@pytest.mark.parametrize("seed", range(2))
def test_every_frame_has_the_loads_of_the_record(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hand, frames = tool(), 90
    seen: list[Probe] = []
    for frame in range(frames):
        for _ in range(rng.integers(0, 3)):
            what = rng.integers(0, 5)
            place = (float(rng.uniform(-0.2, 1.2)), float(rng.uniform(-0.2, 1.2)))
            if what == 0:
                hand.press(place, int(rng.choice([-1, 1])))
            elif what == 1:
                hand.release()
            elif what == 2:
                hand.strength = float(rng.integers(0, 101))
            else:
                hand.move(place)
        seen.append(hand.advance(frame))
    record = hand.recorded_probe(frames)
    for frame, probe in enumerate(seen):
        now, then = loads(probe, frame), loads(record, frame)
        np.testing.assert_array_equal(now.strength, then.strength)
        np.testing.assert_array_equal(now.active, then.active)
        # Where it does not press, it is no matter at what.
        pressing = then.strength.any(axis=(1, 2))
        np.testing.assert_array_equal(now.point[pressing], then.point[pressing])


def test_a_hand_takes_time_to_press_and_none_to_let_go() -> None:
    hand = tool()
    hand.press((0.4, 0.6), 1)
    rise = percents(hand, 0, 12)
    assert rise[:10] == pytest.approx(list(np.arange(1, 11) * 100 / (RISE_TIME_S * RATE)))
    assert rise[10:] == [100.0, 100.0]
    hand.release()
    assert percents(hand, 12, 2) == [0.0, 0.0]
    load = hand.recorded_probe(14).load
    assert (12 / RATE, 100.0) in load
    assert (12 / RATE, 0.0) in load
    assert len(load) == 1 + 10 + 3, "what does not change needs no keys"


def test_pressing_elsewhere_at_once_lets_go_for_a_frame() -> None:
    hand = tool()
    hand.press((0.2, 0.2), 1)
    percents(hand, 0, 5)
    hand.press((0.8, 0.8), 1)
    assert percents(hand, 5, 2) == pytest.approx([0, 10])
    at = np.array(hand.recorded_probe(7).at)
    assert (np.diff(at[:, 0]) > 0).all(), "a control point that jumps would need a kernel of its own"
    assert hand.position == (0.8, 0.8)


def test_clicks_while_time_stands_still_are_one() -> None:
    hand = tool()
    for n in range(50):
        hand.press((n / 100, 0.123456), 1)
        hand.release()
    assert hand.target == (0.49, 0.123456)
    assert percents(hand, 0, 4) == pytest.approx([10, 0, 0, 0])
    assert hand.position == (0.49, 0.123456)


def test_what_it_is_asked_for_last_is_its_goal() -> None:
    hand = tool()
    hand.press((0.2, 0.2), 1)
    assert hand.target == (0.2, 0.2)
    hand.advance(0)
    hand.move((0.3, 0.2))
    assert (hand.target, hand.position) == ((0.3, 0.2), (0.2, 0.2))
    hand.press((0.7, 0.2), 1)
    assert hand.target == (0.7, 0.2)
    hand.move((0.8, 0.2))
    assert hand.target == (0.8, 0.2)
