from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm.loads import (
    grips,
    jumps,
    key_times,
    loads_at,
    meets_jumps,
    schedule,
    shortest_ramp,
    steps_to_meet_jumps,
)
from taichi_msm.stability import with_steps
from tests.scenes import PRESS, SPRINGS, scene

# 25 frames a second in 4 steps of 0.01 s.
STEPS = {"duration": 1.0, "step": 0.01}
SOFT = {**SPRINGS, "structural": 0.1, "shear": 0.1, "virtual": 0.1}


def percent(load: list[list[float]], **changes: Any) -> list[float]:
    """Percent at the steps 0 to 5, that is at 0 s to 0.05 s."""
    made = scene(springs=SOFT, probes=[{"force": [100, 0, 0], "load": load}], time=STEPS, **changes)
    return [round(float(value), 9) for value in schedule(made, 0, 6).strength[:, 0, 0]]


@pytest.mark.parametrize(
    ("load", "expected"),
    [
        ([[0, 0], [0.04, 100]], [0, 25, 50, 75, 100, 100]),
        ([[0, 100]], [100, 100, 100, 100, 100, 100]),
        ([[0.02, 100]], [0, 0, 50, 100, 100, 100]),
        ([[0, 0], [0.02, 100], [0.02, 0]], [0, 50, 50, 0, 0, 0]),
        ([[0, 0], [0, 100]], [100, 100, 100, 100, 100, 100]),
        ([[0, -80], [0.04, 80]], [-80, -40, 0, 40, 80, 80]),
        ([[0, 0], [0.03, 0], [0.03, 100]], [0, 0, 0, 50, 100, 100]),
        # Keys 1 ns apart are a ramp, not a jump: at the first of them its own value counts.
        ([[0, 0], [0.02, 0], [0.020000001, 100]], [0, 0, 0, 100, 100, 100]),
    ],
)
def test_percent(load: list[list[float]], expected: list[float]) -> None:
    assert percent(load) == expected


def test_a_step_meets_a_key_in_spite_of_rounding() -> None:
    # Three steps of a frame of 10 s: the third ends at 3 / (3 x 0.1) s, which rounds to less than 10 s.
    made = scene(
        springs={},
        probes=[{"force": [100, 0, 0], "load": [[0, 0], [10, 0], [10, 100]]}],
        time={"duration": 20, "frames_per_second": 0.1, "step": 10 / 3},
    )
    assert 3 / (3 * 0.1) < 10
    assert schedule(made, 0, 6).strength[:, 0, 0].tolist() == [0, 0, 0, 50, 100, 100]


@pytest.mark.parametrize(
    ("loads", "expected"),
    [
        # A jump of the activity, though the percent has none.
        ([[[0.01, 0], [0.03, 100], [0.04, 0]]], [0, 0.5, 1, 1, 0.5, 0]),
        # A percent that only crosses 0 keeps the springs.
        ([[[0, -50], [0.04, 50]]], [1, 1, 1, 1, 1, 1]),
        ([[[0, 0], [0.02, 0], [0.02, 100]]], [0, 0, 0.5, 1, 1, 1]),
        # Any probe is enough, and one that takes over from another leaves no gap.
        ([[[0, 100], [0.02, 100], [0.02, 0]], [[0.02, 0], [0.02, 100]]], [1, 1, 1, 1, 1, 1]),
        ([[[0, 0]]], [0, 0, 0, 0, 0, 0]),
    ],
)
def test_virtual_springs_while_loaded(loads: list[list[list[float]]], expected: list[float]) -> None:
    probes = [{"force": [0, 0, 1], "load": load} for load in loads]
    made = scene(springs=SOFT, probes=probes, time=STEPS)
    assert schedule(made, 0, 6).active.tolist() == expected


def test_virtual_springs_always() -> None:
    made = scene(springs={**SOFT, "virtual_active": "always"}, probes=[], time=STEPS)
    assert schedule(made, 0, 3).active.tolist() == [1, 1, 1]


def test_a_schedule_does_not_depend_on_where_it_is_cut() -> None:
    made = scene(springs=SOFT, time=STEPS)
    whole = schedule(made, 0, 40)
    for cut in (1, 17, 20, 21):
        halves = schedule(made, 0, cut), schedule(made, cut, 40 - cut)
        for n in range(3):
            np.testing.assert_array_equal(np.concatenate([half[n] for half in halves]), whole[n])


def test_a_control_point_moves_between_its_keys_and_is_held_outside() -> None:
    keys = [[0.01, 0, 0], [0.03, 1, 0.5]]
    made = scene(springs=SOFT, probes=[{"force": [0, 0, 1], "at": keys}], time=STEPS)
    point = schedule(made, 0, 6).point[:, 0]
    # The sheet is 0.4 m wide and 0.3 m high, its centre the origin, y up.
    expected = [[-0.2, 0.15], [-0.2, 0.15], [0, 0.075], [0.2, 0], [0.2, 0], [0.2, 0]]
    np.testing.assert_allclose(point, expected, atol=1e-15)


@pytest.mark.parametrize("keys", [[[0, 0, 0], [0.02, 0, 0], [0.02, 1, 1]], [[0.02, 0, 0], [0.02, 1, 1]]])
def test_a_jump_of_the_control_point_shares_the_force_between_both_places(keys: list[list[float]]) -> None:
    probe = {"force": [0, 0, 8], "at": keys, "load": [[0, 100], [0.02, 100], [0.02, 50]]}
    made = scene(springs=SOFT, probes=[probe], time=STEPS)
    assert [grip.before for grip in grips(made)] == [True, False]
    strength = schedule(made, 0, 5).strength[..., 2]
    np.testing.assert_allclose(strength.T, [[0, 0, 4, 0, 0], [8, 8, 2, 4, 4]])
    point = schedule(made, 0, 5).point
    np.testing.assert_allclose(point[2], [[-0.2, 0.15], [0.2, -0.15]])
    np.testing.assert_allclose(point[[0, 1, 3, 4], 1], [[-0.2, 0.15], [-0.2, 0.15], [0.2, -0.15], [0.2, -0.15]])


def test_a_control_point_that_jumps_a_thousand_times_has_two_places() -> None:
    """However many jumps, a step has no more forces to add up."""
    at = [[n / 1000, *place] for n in range(1000) for place in ([n % 7 / 7, 0.5], [n % 5 / 5, 0.25])]
    made = scene(springs=SOFT, probes=[{"force": [0, 0, 8], "at": at}, PRESS], time=STEPS)
    assert [(grip.probe, grip.before, grip.moves) for grip in grips(made)] == [
        (0, True, True),
        (0, False, True),
        (1, False, False),
    ]
    # On the jump at 0.01 s, and between this and the next.
    loads = loads_at(made, np.array([0.01, 0.0104, 0.011]))
    np.testing.assert_allclose(loads.strength[:, :2, 2], [[4, 4], [0, 8], [4, 4]])
    expected = [[(10 % 7 / 7 - 0.5) * 0.4, 0], [(10 % 5 / 5 - 0.5) * 0.4, 0.075]]
    np.testing.assert_allclose(loads.point[0, :2], expected, atol=1e-15)


def test_keys_and_jumps() -> None:
    load = [[-1, 0], [0, 0], [0.1, 50], [0.1, 100], [0.3, 100], [0.5, 0], [0.7, 0], [2, 1]]
    at = [[0, 0, 0], [0.25, 0, 1], [0.25, 1, 1], [0.6, 1, 0]]
    made = scene(springs=SOFT, probes=[{"force": [0, 0, 8], "load": load, "at": at}], time=STEPS)
    np.testing.assert_allclose(key_times(made), [0.1, 0.25, 0.3, 0.5, 0.6, 0.7])
    # The load jumps at 0.1 s, the control point at 0.25 s; the virtual springs end at 0.5 s and are back at 0.7 s.
    np.testing.assert_allclose(jumps(made), [0.1, 0.25, 0.5, 0.7])
    without = scene(springs={**SOFT, "virtual": 0}, probes=made.model_dump()["probes"], time=STEPS)
    np.testing.assert_allclose(jumps(without), [0.1, 0.25])
    assert shortest_ramp(made) == pytest.approx(0.1)
    assert jumps(scene(probes=[])).size == key_times(scene(probes=[])).size == 0
    assert shortest_ramp(scene(probes=[])) == np.inf


def test_a_first_key_that_presses_is_a_jump() -> None:
    made = scene(springs=SOFT, probes=[{"force": [0, 0, 8], "load": [[0.1, 100]]}], time=STEPS)
    np.testing.assert_allclose(jumps(made), [0.1])


@pytest.mark.parametrize(
    ("times", "steps"),
    [
        ([0.12], 1),
        ([0.13], 4),
        ([0.13, 0.15], 4),
        ([0.13, 0.04 / 3], 12),
        ([0.1 * 2**0.5], 0),
        ([0.0401], 400),
        ([], 1),
    ],
)
def test_steps_that_meet_every_jump(times: list[float], steps: int) -> None:
    probes = [{"force": [0, 0, 8], "load": [[0, 100], [time, 100], [time, 0]]} for time in times]
    made = scene(springs=SOFT, probes=probes, time={"duration": 1.0})
    assert steps_to_meet_jumps(made) == steps
    if steps:
        assert meets_jumps(with_steps(made, 3 * steps))
    assert meets_jumps(with_steps(made, 7)) == (steps == 1)
