from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from taichi_msm.model.loads import LoadBounds, average_loads, evaluate_loads
from taichi_msm.model.plan import Plan, probe_slots
from tests.scenes import PRESS, SPRINGS, plan_of, scene

# 25 frames a second in 4 steps of 0.01 s.
STEPS = {"duration": 1.0, "step": 0.01}
SOFT = {**SPRINGS, "structural": 0.1, "shear": 0.1, "virtual": 0.1}


def plan_with(*probes: dict[str, Any], springs: dict[str, Any] = SOFT) -> Plan:
    """A scene in steps of 0.01 s, with probes of 100 N along x and 8 N along z by default."""
    return plan_of(scene(springs=springs, probes=[{"force": [100, 0, 8], **probe} for probe in probes], time=STEPS))


@pytest.mark.parametrize(
    ("load", "expected"),
    [
        # A ramp of 25 a step counts with a third of that at t = 0, and a kink with a sixth less or more.
        ([[0, 0], [0.04, 100]], [25 / 3, 25, 50, 75, 100 - 25 / 6, 100]),
        ([[0, -80], [0.04, 80]], [-80 + 40 / 3, -40, 0, 40, 80 - 20 / 3, 80]),
        # A jump on a step counts with the mean of its limits; half-way between two steps with 1/8 and 7/8,
        ([[0, 0], [0, 100]], [100, 100, 100, 100, 100, 100]),
        ([[0.02, 100]], [0, 0, 50, 100, 100, 100]),
        ([[0.025, 100]], [0, 0, 12.5, 87.5, 100, 100]),
        # and so does the end of a ramp: 5/8 of its value before the jump at the top.
        ([[0, 0], [0.02, 100], [0.02, 0]], [50 / 3, 50, 50 - 25 / 3, 0, 0, 0]),
        # Keyframes 1 ns apart are a jump.
        ([[0, 0], [0.02, 0], [0.020000001, 100]], [0, 0, 49.99999, 99.99999, 100, 100]),
        # A pulse of a tenth of a step, at a step and half-way between two.
        ([[0.0195, 0], [0.0195, 100], [0.0205, 100], [0.0205, 0]], [0, 0.125, 9.75, 0.125, 0, 0]),
        ([[0.0245, 0], [0.0245, 100], [0.0255, 100], [0.0255, 0]], [0, 0, 5, 5, 0, 0]),
    ],
)
def test_average_of_a_load(load: list[list[float]], expected: list[float]) -> None:
    assert average_loads(plan_with({"load": load}), 0, 6).strength[:, 0, 0] == pytest.approx(expected, abs=1.1e-5)


def random_load(seed: int) -> list[list[float]]:
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(-0.02, 0.08, 9))
    times[3] = times[4]
    times[6] = times[7] - 1e-9
    return [[float(t), float(rng.uniform(-100, 100))] for t in times]


@pytest.mark.default_cases("2")
@pytest.mark.parametrize("seed", range(4))
def test_average_is_the_integral_with_the_hat(seed: int) -> None:
    load = random_load(seed)
    at = [[0, 0, 0], [0.011, 1, 0], [0.011, 0, 1], [0.043, 0.5, 0.5], [0.043, 0.25, 0]]
    plan = plan_with({"load": load, "at": at})
    averages, h = average_loads(plan, 0, 7), plan.grid.step
    keys = sorted({time for time, _ in load} | {0.011, 0.043})

    def integral(of: Any, n: int) -> float:
        low, high = max(0.0, (n - 1) * h), (n + 1) * h
        cuts = [low, *(time for time in [*keys, n * h] if low < time < high), high]
        parts = [
            quad(lambda t: of(t) * (1 - abs(t - n * h) / h) / h, a, b, epsabs=1e-13)[0]
            for a, b in pairwise(sorted(cuts))
        ]
        return sum(parts) * (2 if n == 0 else 1)

    def of_slot(slot: int, t: float) -> float:
        """The two slots act by turns: the first until the first jump, and from the second one on."""
        acts = ((t >= 0.011) + (t >= 0.043)) % 2 == slot
        return float(evaluate_loads(plan, np.array([t])).strength[0, 0, 0]) if acts else 0.0

    for n in range(7):
        for slot in range(2):
            strength = integral(lambda t, slot=slot: of_slot(slot, t), n)
            assert averages.strength[n, slot, 0] == pytest.approx(strength, abs=1e-9), (n, slot)
        active = integral(lambda t: evaluate_loads(plan, np.array([t])).active[0], n)
        assert averages.active[n] == pytest.approx(active, abs=1e-9), n


def test_averaged_load_displaces_a_free_point_exactly() -> None:
    """Verlet's u_{n+1} = 2 u_n - u_{n-1} + h^2 a_n equals the double integral of a, for any load."""
    load = random_load(5)
    plan = plan_with({"force": [1, 0, 0], "load": load}, springs={})
    a, h = average_loads(plan, 0, 8).strength[:, 0, 0], plan.grid.step
    u = [0.0, h**2 / 2 * a[0]]
    for n in range(1, 8):
        u.append(2 * u[-1] - u[-2] + h**2 * a[n])
    keys = sorted(time for time, _ in load if 0 < time < 8 * h)

    def double_integral(end: float) -> float:
        def integrand(t: float) -> float:
            return (end - t) * float(evaluate_loads(plan, np.array([t])).strength[0, 0, 0])

        cuts = [0.0, *(time for time in keys if time < end), end]
        return sum(quad(integrand, a, b, epsabs=1e-14)[0] for a, b in pairwise(cuts))

    np.testing.assert_allclose(u, [double_integral(n * h) for n in range(9)], atol=1e-12)


def test_step_meets_a_keyframe_in_spite_of_rounding() -> None:
    # Three steps of a frame of 10 s: the third ends at 3 / (3 x 0.1) s, which rounds to less than 10 s.
    made = scene(
        springs={},
        probes=[{"force": [100, 0, 0], "load": [[0, 0], [10, 0], [10, 100]]}],
        time={"duration": 20, "frames_per_second": 0.1, "step": 10 / 3},
    )
    assert 3 / (3 * 0.1) < 10
    strength = average_loads(plan_of(made), 0, 6).strength[:, 0, 0]
    np.testing.assert_allclose(strength, [0, 0, 0, 50, 100, 100], atol=1e-12)


@pytest.mark.parametrize(
    ("loads", "expected"),
    [
        # A jump of the activity, though the percent has none.
        ([[[0.01, 0], [0.03, 100], [0.04, 0]]], [0, 0.5, 1, 1, 0.5, 0]),
        # Between two steps.
        ([[[0, 100], [0.025, 0]]], [1, 1, 0.875, 0.125, 0, 0]),
        # A percent that only crosses 0 keeps the springs.
        ([[[0, -50], [0.04, 50]]], [1, 1, 1, 1, 1, 1]),
        ([[[0, 0], [0.02, 0], [0.02, 100]]], [0, 0, 0.5, 1, 1, 1]),
        # Any probe is enough, and one that takes over from another leaves no gap.
        ([[[0, 100], [0.02, 100], [0.02, 0]], [[0.02, 0], [0.02, 100]]], [1, 1, 1, 1, 1, 1]),
        ([[[0, 0]]], [0, 0, 0, 0, 0, 0]),
    ],
)
def test_activity_of_virtual_springs(loads: list[list[list[float]]], expected: list[float]) -> None:
    probes = [{"load": load} for load in loads]
    assert average_loads(plan_with(*probes), 0, 6).active.tolist() == pytest.approx(expected, abs=1e-12)
    always = plan_with(*probes, springs={**SOFT, "virtual_active": "always"})
    assert average_loads(always, 0, 6).active.tolist() == [1] * 6


def test_schedule_does_not_depend_on_its_blocks() -> None:
    plan = plan_with(PRESS)
    expected = average_loads(plan, 0, 40)
    for cut in (1, 17, 20, 21):
        halves = average_loads(plan, 0, cut), average_loads(plan, cut, 40 - cut)
        for n in range(1, 4):
            np.testing.assert_array_equal(np.concatenate([half[n] for half in halves]), expected[n])


def test_redundant_and_later_keyframes_change_no_bit() -> None:
    """As those that a session omits from its record, and those that are unknown when a step is executed."""

    def bits(load: list[list[float]], steps: int) -> bytes:
        return b"".join(part.tobytes() for part in average_loads(plan_with({"load": load}), 0, steps)[1:])

    load: list[list[float]] = [[0, 0], [0.013, 70], [0.031, 70]]
    assert bits(load, 9) == bits([*load[:2], [0.017, 70], [0.02, 70], *load[2:], [0.05, 70], [0.06, 70]], 9)
    # A load that begins at step 6 does not affect step 5.
    assert bits(load, 6) == bits([*load, [0.06, 70], [0.06, 0], [0.08, 5]], 6)


@pytest.mark.parametrize("at", [[[0, 0, 0], [0.02, 0, 0], [0.02, 1, 1]], [[0.02, 0, 0], [0.02, 1, 1]]])
def test_jump_of_a_control_point_shares_the_force(at: list[list[float]]) -> None:
    loads = average_loads(plan_with({"at": at, "load": [[0, 100], [0.02, 100], [0.02, 50]]}), 0, 5)
    assert [(slot.probe, slot.moves) for slot in loads.slots] == [(0, True), (0, True)]
    np.testing.assert_allclose(loads.strength[..., 2].T, [[8, 8, 4, 0, 0], [0, 0, 2, 4, 4]], atol=1e-12)
    np.testing.assert_allclose(loads.point[2], [[-0.2, 0.15], [0.2, -0.15]])
    np.testing.assert_allclose(loads.point[:2, 0], [[-0.2, 0.15]] * 2)
    np.testing.assert_allclose(loads.point[3:, 1], [[0.2, -0.15]] * 2)


def test_control_point_between_keyframes() -> None:
    # Constant before and after its keyframes. The sheet is 0.4 m wide and 0.3 m high, its centre the origin, y up.
    point = average_loads(plan_with({"at": [[0.01, 0, 0], [0.03, 1, 0.5]]}), 0, 6).point
    expected = [[-0.2, 0.15], [-0.2, 0.15], [0, 0.075], [0.2, 0], [0.2, 0], [0.2, 0]]
    np.testing.assert_allclose(point[:, 0], expected, atol=1e-15)
    # A jump between two steps, with movement before and after it.
    at = [[0, 0, 0], [0.024, 0.6, 0], [0.024, 1, 1], [0.044, 0.5, 1]]
    x = average_loads(plan_with({"at": at}), 0, 6).point[..., 0] / 0.4 + 0.5
    np.testing.assert_allclose(x[[0, 1, 2, 3], 0], [0, 0.25, 0.5, 0.6], atol=1e-12)
    np.testing.assert_allclose(x[[2, 3, 4], 1], [1, 0.85, 0.6], atol=1e-12)


def test_slots_of_a_control_point_with_1000_jumps() -> None:
    """A step adds up one force more than the number of jumps within its hat."""
    at = [[n / 100, *place] for n in range(1000) for place in ([n % 7 / 7, 0.5], [n % 5 / 5, 0.25])]
    probes = [{"force": [0, 0, 8], "at": at}, PRESS]
    made = scene(springs=SOFT, probes=probes, time={"duration": 10.0, "step": 0.005})
    averages = average_loads(plan_of(made), 2, 1)
    assert [(slot.probe, slot.moves) for slot in averages.slots] == [(0, True), (0, True), (1, False)]
    np.testing.assert_allclose(sum(averages.strength[0, :2, 2]), 8, rtol=1e-12)
    assert len(probe_slots(made.probes, made.sheet, 0.01)) == 1 + 3, "two jumps within a hat of 0.01 s"
    # Without averaging, a probe has one slot.
    assert [slot.probe for slot in evaluate_loads(plan_of(made), np.array([0.0104])).slots] == [0, 1]


def test_bounds_of_loads() -> None:
    load = [[0.1, 50], [0.2, -100], [0.2, 0], [0.5, 0], [0.5, 20], [0.6, 0]]
    plan = plan_with({"force": [0, 3, 4], "load": load})

    def bounds(begin: float, end: float) -> tuple[float, bool, int]:
        forces, active, activations = LoadBounds(plan).between(begin, end)
        return round(float(forces.max()), 12), active, activations

    assert bounds(0, 0.08) == (0.0, False, 0)
    assert bounds(0, 0.1) == (5 * 0.5, True, 1)
    assert bounds(0.15, 0.18) == (5 * 0.85, True, 0)
    assert bounds(0.15, 0.19) == (5, True, 0), "the hat of the step at 0.19 s extends to 0.2 s"
    assert bounds(0.3, 0.4) == (0.0, False, 0)
    assert bounds(0.3, 0.55) == (5 * 0.2, True, 1)
    strength = np.linalg.norm(average_loads(plan, 0, 100).strength[:, 0], axis=-1)
    for first in range(0, 96, 4):
        assert strength[first : first + 5].max() <= bounds(first / 100, (first + 4) / 100)[0] * (1 + 1e-12)
