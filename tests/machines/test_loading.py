"""Tests of a testing machine as the motion of a scene's tool: frames, noise, contact, line of the tool."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm import SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.machines.loading import (
    CONTACT_NOISES,
    DEPTH_FRAMES,
    MAX_FRAMES,
    build_loading,
    find_approach,
    late_contact_note,
    require_plausible_travel,
)
from taichi_msm.machines.reader import MachineTest
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from tests.golden import Messages

Array = NDArray[np.float64]

RADIUS = 0.005
BALL = {"radius": RADIUS, "shaft": [0, 0, 1], "length": 0.05}
PRESS = {"path": [[0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, -0.002]], "instrument": BALL}

# Ten seconds with a contact in the middle, in steps of 0.01 s.
TIME = np.linspace(0, 10, 1001)
RAMP = np.maximum(TIME - 5, 0)


def scene(probes: Any = (PRESS,), **tissue: Any) -> Scene:
    """A ball above a soft sheet; its probes, and further keys of the tissue."""
    return Scene.model_validate(
        {
            "sheet": {"points": [9, 9], "size": [0.02, 0.02]},
            "tissue": {"young": 2e3, "thickness": 1e-3, "foundation": 2e6, "foundation_active": "always", **tissue},
            "probes": list(probes),
            "time": {"duration": 1, "motion": "quasistatic"},
            "output": [],
        }
    )


RELAXING = scene(relaxation=[{"share": 0.5, "time": 0.6}])


def table(time: Array, depth: Array, force: Array, digit: float = 1e-4) -> MachineTest:
    return MachineTest("press.csv", time, depth, force, digit)


def test_frames_are_means_of_rows_and_hold_the_last_one() -> None:
    time = np.arange(0, 2.26, 0.01)
    loading = build_loading(table(time, time, np.maximum(time - 1, 0)), RELAXING)
    assert (loading.rate, len(loading.depth)) == (10, 24)  # 2.25 s are held to 2.3 s
    np.testing.assert_allclose(loading.depth, [0.025, *np.arange(1, 23) / 10, 2.25], atol=1e-12)
    np.testing.assert_allclose(loading.force[11:22], np.arange(1, 12) / 10, atol=1e-12)


def test_frames_between_rows_are_interpolated_at_most_200_by_default() -> None:
    time = np.arange(0, 12.5, 0.5)
    loading = build_loading(table(time, time, np.maximum(time - 6, 0)), RELAXING, rate=4)
    np.testing.assert_allclose(loading.depth, np.arange(49) / 4, atol=1e-12)
    time = np.arange(0, 400.0, 0.5)
    test = table(time, time, np.maximum(time - 100, 0))
    assert [len(build_loading(test, RELAXING, rate).depth) for rate in (None, 1)] == [MAX_FRAMES + 1, 401]


def test_frames_without_relaxation_are_equidistant_up_to_the_greatest_depth() -> None:
    depth = 1e-3 * np.where(TIME < 5, TIME**2 / 25, 1 - (TIME - 5) / 10)
    loading = build_loading(table(TIME, depth, np.maximum(1000 * depth - 0.2, 0), 1e-3), scene())
    assert len(loading.depth) == DEPTH_FRAMES + 1
    steps = np.diff(loading.depth)
    np.testing.assert_allclose(steps[1:-1], steps[1:-1].mean(), rtol=0.5)
    np.testing.assert_allclose(loading.depth[-1], 1e-3, rtol=0.01)
    assert loading.time.max() <= 5


def test_noise_of_the_first_rows() -> None:
    noise = np.random.default_rng(0).normal(0, 0.01, len(TIME))
    loading = build_loading(table(TIME, TIME, 0.3 + noise + RAMP), RELAXING)
    first = noise[:51]
    np.testing.assert_allclose(loading.noise, 1.48 * np.median(np.abs(first - np.median(first))), rtol=1e-9)
    np.testing.assert_allclose(loading.force[:40].mean(), 0, atol=0.01)
    # It is at least a digit of the file.
    assert build_loading(table(TIME, TIME, RAMP, 0.02), scene()).noise == 0.02


@pytest.mark.parametrize("pulled_from", [0.0, 5.0])
@pytest.mark.parametrize("repeated", [1, 2])
def test_standard_deviation_of_frames(pulled_from: float, repeated: int) -> None:
    """That of the means of their rows, also of a ramp from the first row, and where the sensor repeats its values."""
    noise = 0.01 * np.random.default_rng(0).normal(size=len(TIME)).repeat(repeated)[: len(TIME)]
    ramp = np.maximum(TIME - pulled_from, 0)
    loading = build_loading(table(TIME, ramp, ramp**2 + noise, 1e-6), RELAXING, is_clamp=True)
    # Frames of 11 rows, two of which are shared, and of half of them at the ends.
    assert loading.information.tolist() == pytest.approx([5.5 / 6 if pulled_from else 0, *[10 / 11] * 99, 5.5 / 6])
    # 333 means of three rows have 333 / 2.63 degrees of freedom: 6 %; three standard deviations.
    assert loading.sigma_freedom == pytest.approx(333 / 2.63, rel=0.02)
    assert loading.sigma[1] == pytest.approx(0.01 * np.sqrt(repeated / 10), rel=0.19)
    np.testing.assert_allclose(loading.sigma[1:-1], loading.sigma[1])
    np.testing.assert_allclose(loading.sigma[-1], loading.sigma[1] * np.sqrt(10 / 5.5))


def test_frames_between_rows_have_no_information() -> None:
    """Rows at 0, 0.25, 0.5, ... s; half of them are on the border of two frames."""
    time = np.arange(0, 12.6, 0.25)
    loading = build_loading(table(time, time, np.maximum(time - 6, 0), 1e-3), RELAXING, rate=10)
    expected = np.tile([1, 0, 0.5, 0.5, 0], 26)[: len(loading.force)]
    np.testing.assert_allclose(loading.information, expected)
    assert loading.information.sum() == len(time)
    # The corner of the ramp is no error: the digit remains.
    np.testing.assert_allclose(loading.sigma[0], 1e-3 / np.sqrt(12))


def test_first_rows_belong_to_the_first_frame_without_force() -> None:
    """Their median is 0, with the variance of the mean of 2 n / pi rows."""
    random = np.random.default_rng(2)
    force = np.maximum(TIME - 9, 0) + random.normal(0, 0.01, len(TIME))
    loading = build_loading(table(TIME, TIME, force, 1e-6), scene(), contact=9.0)
    rows, spacing = 2 / np.pi * 51, 1.05 / DEPTH_FRAMES
    near = np.abs(TIME - 8.95) <= spacing / 2 * (1 + 1e-6)
    expected = (force[near] - np.median(force[:51])).sum() / (near.sum() + rows)
    assert loading.force[0] == pytest.approx(expected)
    row = loading.sigma[loading.information == 1].max()
    assert loading.sigma[0] == pytest.approx(row / np.sqrt(near.sum() + rows))


def test_contact_is_the_last_row_without_a_force_before_the_peak() -> None:
    force = RAMP.copy()
    force[200] = 3.0  # A knock before the contact.
    loading = build_loading(table(TIME, TIME, force, 0.01), scene())
    assert loading.contact == pytest.approx(5 + CONTACT_NOISES * 0.01, abs=0.0101)
    # A test that begins in contact: no row before the peak is without a force.
    falling = np.r_[50.0 - np.arange(10), np.arange(100, 200)]
    assert build_loading(table(TIME[:110], TIME[:110], falling, 0.1), scene()).contact == TIME[9]
    # The noise of the table counts, also far below the accuracy of predicted forces.
    quiet = build_loading(table(TIME, TIME, RAMP**3, 1e-9), scene())
    assert quiet.noise == 1e-9
    assert quiet.contact == pytest.approx(5)


@pytest.mark.parametrize("rise_s", [0.05, 0.6, 5.0])
def test_a_free_contact_starts_at_the_first_row_of_a_test_in_contact(rise_s: float) -> None:
    """After a step within the rows of the noise, and on a ramp; a test with an approach starts as without."""
    random, share = np.random.default_rng(0), np.clip(TIME / rise_s, 0, 1)
    force = np.where(share < 1, share**2, 0.5 + 0.5 * np.exp(rise_s - TIME)) + random.normal(0, 1e-3, len(TIME))
    for scene_ in (scene(), RELAXING):
        loading = build_loading(table(TIME, share, force, 1e-5), scene_, fits_contact=True)
        assert (loading.contact, loading.finds_contact) == (0, False)
    for test in (table(TIME, TIME, RAMP, 0.01), table(TIME, TIME, RAMP + random.normal(0, 0.2, len(TIME)))):
        assert build_loading(test, scene(), fits_contact=True).contact == build_loading(test, scene()).contact


def test_a_given_offset_is_subtracted() -> None:
    """From all forces, also the median of the first rows in the first frame."""
    test = table(TIME, TIME, RAMP + 0.3, 1e-6)
    for offset in (0.25, 0.3):
        loading = build_loading(test, scene(), contact=9.0, force_offset=offset)
        assert (loading.offset, loading.has_exact_offset) == (offset, True)
        np.testing.assert_allclose(loading.test.force, RAMP + 0.3 - offset, atol=1e-12)
        rows, near = 2 / np.pi * 51, np.abs(TIME - 8.95) <= 0.525 / DEPTH_FRAMES * (1 + 1e-6)
        total = loading.test.force[near].sum() + rows * (0.3 - offset)
        assert loading.force[0] == pytest.approx(total / (near.sum() + rows))
    assert not build_loading(test, scene()).has_exact_offset


def test_note_about_a_late_contact(message: Messages) -> None:
    time, random = np.linspace(0, 5, 101), np.random.default_rng(0)
    early = build_loading(table(time, time, time**2, 1e-3), scene())
    message(str(late_contact_note(early, "contact")), "--free contact")
    for force in (random.normal(0, 0.1, 101) + 9 * np.maximum(time - 3, 0), 1e-3 * time + 9 * np.maximum(time - 1, 0)):
        assert late_contact_note(build_loading(table(time, time, force, 1e-3), scene()), "contact") is None


def test_the_tool_waits_until_contact() -> None:
    loading = build_loading(table(TIME, TIME, RAMP, 0.01), RELAXING, contact=4.0)
    np.testing.assert_allclose(loading.travel(), np.maximum(loading.depth - 4, 0))


@pytest.mark.parametrize("case", ["noise", "depth", "contact", "offset"])
def test_tables_without_a_contact_are_refused(case: str, message: Messages) -> None:
    force = 1e-3 * np.sin(TIME) if case == "noise" else RAMP
    test = table(TIME, 20 - TIME if case == "depth" else TIME, force, 0.01)
    with message.raises(SceneError, "press.csv"):
        options: dict[str, Any] = {"contact": {"contact": 11.0}, "offset": {"force_offset": 9.0}}.get(case, {})
        build_loading(test, scene(), **options)


def test_travel_in_another_unit(message: Messages) -> None:
    """The sheet is 20 mm long."""
    for unit in (1e-3, 1.0):
        loading = build_loading(table(TIME, unit * TIME, RAMP, 0.01), scene())
        if unit < 1:
            require_plausible_travel(loading, scene())
        else:
            with message.raises(SceneError, "press.csv: depth", "[mm]"):
                require_plausible_travel(loading, scene())


@pytest.mark.parametrize(
    ("tip", "shaft"), [("radius", [0, 0, 1]), ("radius", [0.5, -0.6, 0.9]), ("plate", [0.5, -0.6, 0.9])]
)
def test_first_contact_of_a_tool(shaft: list[float], tip: str) -> None:
    path = [[0, 0.3, 0.5, 0.004], [1, 0.5, 0.4, -0.002], [2, 0.4, 0.4, 0]]
    made = scene([{"path": path, "instrument": {tip: RADIUS, "shaft": shaft, "length": 0.05}}])
    approach = find_approach(made)
    if tip == "radius":
        assert approach.start[2] == pytest.approx(RADIUS, rel=1e-8)
    np.testing.assert_allclose(approach.direction, np.array([0.004, 0.002, -0.006]) / np.sqrt(56e-6), rtol=1e-9)
    data = approach.place(made.model_dump(mode="json", exclude_none=True), np.array([0.0, 1e-3]), rate=1.0)
    start, end = np.array(data["probes"][0]["path"])[:, 1:]
    # The gap of a tilted plate is approximate, but the scene is valid.
    assert start[2] == pytest.approx(0, abs=1e-8 if tip == "radius" else 5e-6)
    check_scene(data)
    assert np.linalg.norm((end - start) * [0.02, 0.02, 1]) == pytest.approx(1e-3)


PATHS: dict[str, list[dict[str, Any]]] = {
    "two tools": [PRESS, {**PRESS, "path": [[0, 0.1, 0.5, 0.001], [1, 0.1, 0.5, 0]]}],
    "no tool": [{"total": [0, 0, -1], "radius": 0.002}],
    "one place": [{**PRESS, "path": [[0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, 0.001]]}],
    "misses": [{**PRESS, "path": [[0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, 0.002]]}],
}


@pytest.mark.parametrize("case", PATHS)
def test_scenes_without_a_line_of_one_tool_are_refused(case: str, message: Messages) -> None:
    with message.raises(SceneError, "probes"):
        find_approach(scene(PATHS[case]))


@pytest.mark.parametrize("end", [[0.3, 0.7, -0.002], [0.45, 0.6, -0.003]], ids=["normal", "oblique"])
def test_line_of_a_tool_over_a_dome(end: list[float]) -> None:
    """It starts at contact with the surface; keyframes are on the line, which is straight along a normal."""
    ball = {**PRESS, "path": [[0, 0.3, 0.7, 0.002], [1, *end]]}
    made = scene([ball], foundation=1e6).model_copy(
        update={"sheet": Sheet(points=(8, 8), size=(0.02, 0.02), surface={"dome": {"radius": 0.03}})}
    )
    approach = find_approach(made)
    travel = np.array([0.0, 5e-4, 1e-3])
    data = approach.place(made.model_dump(mode="json", exclude_none=True), travel, rate=1.0)
    placed = check_scene(data)
    (tool,) = placed.tools
    centres = tool.path_at(np.arange(3.0))
    expected = approach.start + travel[:, None] * approach.direction
    np.testing.assert_allclose(centres, expected, atol=1e-12)
    # The sphere is bilinear within cells, 3 mm wide: at most (3 mm)^2 / 4 / 30 mm inside.
    centre = np.array([0, 0, -0.03])
    assert -7.5e-5 < np.linalg.norm(approach.start - centre) - 0.03 - RADIUS < 1e-3 * RADIUS
    if end[:2] == [0.3, 0.7]:
        keys = np.array(data["probes"][0]["path"])
        np.testing.assert_allclose(keys[:, 1:3], [[0.3, 0.7]] * 3, atol=1e-12)
        np.testing.assert_allclose(keys[0, 3] - keys[:, 3], travel, atol=1e-12)
        normal = rest_of(made.sheet).normals(np.array([[0.3, 0.7]]))[0]
        np.testing.assert_allclose(approach.direction, -normal, atol=1e-12)
