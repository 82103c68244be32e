"""Steering: tools that get other paths during a run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm import ArgumentError, Probe, SceneError, Simulation
from taichi_msm.system.runtime import Device
from taichi_msm.terms.contact import ContactTerm
from taichi_msm.terms.loads import ProbeTerm
from tests.golden import Messages
from tests.motion import assert_steered_like
from tests.scenes import plan_of
from tests.terms.test_contact import HELD, PRESSED, ROD, RUBBED, moved, touching

RATE = 25.0


@pytest.mark.parametrize("probe", [PRESSED, RUBBED, HELD], ids=["pressed", "rubbed", "held"])
def test_steering_frame_by_frame(probe: dict[str, Any], device: Device) -> None:
    """Bits of the path with all keyframes, also while the tool holds mass points."""
    (tool,), path = plan_of(touching([probe])).tools, []
    for frame in range(11):
        x, y, z = tool.lowest_point(frame / RATE)
        path.append([frame / RATE, x / 0.4 + 0.5, 0.5 - y / 0.3, z])
    assert_steered_like(touching([{**probe, "path": path}]), touching([{**probe, "path": path[:1]}]), device)


def test_straight_motion_to_the_first_keyframe(device: Device) -> None:
    """Equal to a path through the current position; held mass points do not jump."""
    made, target = touching([HELD]), [0.4, 0.7, 0.6, 0.01]
    x, y, z = plan_of(made).tools[0].lowest_point(0.2)
    path = [*HELD["path"][:2], [0.2, x / 0.4 + 0.5, 0.5 - y / 0.3, z], target]
    with (
        Simulation(made, threads=device.threads) as steered,
        Simulation(touching([{**HELD, "path": path}]), threads=device.threads) as expected,
    ):
        steered.advance(5)
        steered.steer([{"path": [target]}])
        steered.advance(5)
        expected.advance(10)
        np.testing.assert_allclose(steered.positions(), expected.positions(), rtol=0, atol=1e-12)
        assert steered.forces()[0].tip == pytest.approx((0.08, -0.03, 0.01))


def test_steering_to_unchanged_probes(device: Device) -> None:
    made = touching([PRESSED, HELD])
    with (
        Simulation(made, threads=device.threads) as steered,
        Simulation(made, threads=device.threads) as expected,
    ):
        for _ in range(8):
            steered.advance()
            expected.advance()
            steered.steer(steered.scene.probes)
            steered.steer([None, None])
        assert steered.positions().tobytes() == expected.positions().tobytes()


def test_end_and_begin_of_a_grip(device: Device) -> None:
    with Simulation(touching([HELD]), threads=device.threads) as simulation:
        simulation.advance(5)
        saved, heights = simulation.save(), []
        for grip in ([[0.1, 0.25], [0.3, 0.38]], [], [[0.2, 1.0]]):
            simulation.restore(saved)
            simulation.steer([{"path": [[0.4, 0.5, 0.4, 0.1]], "grip": grip}])
            simulation.advance(1)
            simulation.advance(2)
            heights.append(float(simulation.positions()[..., 2].max()))
        held, released, gripped = heights
        assert held > 2 * released
        assert gripped > 2 * released


def test_restore_and_restart_discard_steering(device: Device) -> None:
    with Simulation(touching([PRESSED]), threads=device.threads) as simulation:
        simulation.advance(4)
        saved = simulation.save()
        simulation.advance(4)
        probes, position = simulation.scene.probes, simulation.positions().tobytes()
        simulation.restore(saved)
        for frame in (5, 6):
            simulation.steer([{"path": [[(frame + 1) / RATE, 0.3, 0.3, 0.05]]}])
            simulation.advance()
        steered = simulation.save()
        simulation.restore(saved)
        assert simulation.scene.probes == probes
        simulation.advance(4)
        assert simulation.positions().tobytes() == position
        simulation.restore(steered)
        simulation.restart()
        simulation.advance(8)
        assert simulation.positions().tobytes() == position


AT = [0.5, 0.5, 0.0]
INVALID: dict[str, dict[str, Any]] = {
    "now": {"path": [[0.08, *AT], [0.1, *AT]]},
    "too fast": {"path": [[0.1, *AT], [0.11, 0.5, 0.5, 0.1]]},
    "too fast from the current position": {"path": [[0.081, 0.9, 0.5, 0.0]]},
    "turned at once": {"path": [[0.1, *AT]], "instrument": {**ROD, "shaft": [0.5, -0.6, 2.0]}},
    "held before": {"path": [[0.1, *AT]], "grip": [[0.05, 0.2]]},
    "no path": {"path": []},
}


def test_invalid_motions(device: Device, message: Messages) -> None:
    with Simulation(touching([HELD]), threads=device.threads) as simulation:
        simulation.advance(2)
        before = simulation.scene
        for probe in INVALID.values():
            with message.raises(SceneError, "probes.0."):
                simulation.steer([probe])
            assert simulation.scene == before
        simulation.steer([{"path": [[0.12, *AT]], "instrument": {**ROD, "radius": 0.051}}])
        simulation.advance()


FORCE = {"total": [0, 0, -1], "load": [[0, 100]]}
OTHER_KERNELS: dict[str, list[Any]] = {
    "friction": [{"path": [[0.1, *AT]], "friction": 0.1}, FORCE],
    "grips": [{"path": [[0.1, *AT]], "grip": [[0.1, 0.2]]}, FORCE],
    "another tool": [PRESSED, PRESSED],
    "a missing probe": [FORCE],
}


def test_changes_that_require_other_kernels(device: Device, message: Messages) -> None:
    with Simulation(touching([PRESSED, FORCE]), threads=device.threads) as simulation:
        for probes in OTHER_KERNELS.values():
            with message.raises(ArgumentError):
                simulation.steer(probes)
        simulation.steer([{"path": [[0.1, *AT]]}, FORCE])


def test_terms_that_require_other_kernels(message: Messages) -> None:
    plate = {**PRESSED, "instrument": {"plate": 0.04, "shaft": [0, 0, 1], "length": 0.3}}
    flat, round_ = (ContactTerm.from_plan(plan_of(touching([tool]))) for tool in (plate, PRESSED))
    assert flat
    assert round_
    message(flat.supports(round_))
    message(ProbeTerm((False,), (True,)).supports(ProbeTerm((False,), (False,))))


def test_flight_after_a_tool_stops(device: Device) -> None:
    """A thrown sheet moves farther than it could at the tool's new speed, which is not a divergence."""
    sheet = {"points": [5, 5], "size": [0.1, 0.1], "fixed": "none"}
    tissue = {"young": 1e3, "thickness": 0.01, "density": 1000}
    rod = moved([0, 0.5, 0.5, -0.11], [0.3, 0.5, 0.5, 0.4], [0.4, 0.5, 0.5, 0.4], instrument={"shaft": [0, 0, -1]})
    with Simulation(touching([rod], sheet=sheet, tissue=tissue, time={"duration": 2.0}), threads=device.threads) as run:
        run.advance(10)
        assert run.velocities()[..., 2].mean() > 1
        run.steer([Probe(path=[[0.5, 0.5, 0.5, 0.3], [0.6, 0.5, 0.5, 0.3]], instrument=rod["instrument"])])
        run.advance(30)
        assert run.positions()[..., 2].min() > 1.3
