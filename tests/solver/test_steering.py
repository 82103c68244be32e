"""Tools that get other paths while they move."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm import ArgumentError, Probe, SceneError, Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import assert_steered_like
from tests.scenes import plan_of
from tests.terms.test_contact import HELD, PRESSED, ROD, RUBBED, moved, touching

RATE = 25.0


def guided(probe: dict[str, Any], frames: int = 10, **changes: Any) -> Scene:
    """A scene with a tool that has a key at every frame."""
    ((tool,),) = [plan_of(touching([probe])).tools]
    path = []
    for frame in range(frames + 1):
        x, y, z = tool.lowest_point(frame / RATE)
        path.append([frame / RATE, x / 0.4 + 0.5, 0.5 - y / 0.3, z])
    return touching([{**probe, "path": path, **changes}], time={"duration": frames / RATE})


@pytest.mark.parametrize("probe", [PRESSED, RUBBED, HELD], ids=["pressed", "rubbed", "held"])
def test_a_tool_that_is_steered_frame_by_frame_does_what_the_path_of_all_frames_does(
    probe: dict[str, Any], device: Device
) -> None:
    """To the bit, also while it holds points."""
    made = guided(probe)
    probes = [made.probes[0].model_copy(update={"path": (made.probes[0].path or ())[:1]})]
    assert_steered_like(made, made.model_copy(update={"probes": probes}), device)


def test_between_its_keys_a_tool_goes_straight_on_from_where_it_is(device: Device) -> None:
    """Held points do not jump: as a path through the same places."""
    there = [0.4, 0.7, 0.6, 0.01]
    made = touching([HELD])
    (tool,) = plan_of(made).tools
    x, y, z = tool.lowest_point(0.2)
    through = [0.2, x / 0.4 + 0.5, 0.5 - y / 0.3, z]
    whole = touching([{**HELD, "path": [*HELD["path"][:2], through, there]}])
    with Simulation(made, threads=device.threads) as steered, Simulation(whole, threads=device.threads) as expected:
        steered.advance(5)
        steered.steer([{"path": [there]}])
        steered.advance(5)
        expected.advance(10)
        np.testing.assert_allclose(steered.positions(), expected.positions(), rtol=0, atol=1e-12)
        assert steered.forces()[0].tip == pytest.approx((0.08, -0.03, 0.01))


def test_what_stays_as_it_is_goes_on(device: Device) -> None:
    with (
        Simulation(touching([PRESSED, HELD]), threads=device.threads) as steered,
        Simulation(touching([PRESSED, HELD]), threads=device.threads) as expected,
    ):
        for _ in range(8):
            steered.advance()
            expected.advance()
            steered.steer(steered.scene.probes)
            steered.steer([None, None])
        assert steered.positions().tobytes() == expected.positions().tobytes()


def test_a_grip_can_be_ended_and_begun(device: Device) -> None:
    with Simulation(touching([HELD]), threads=device.threads) as simulation:
        simulation.advance(5)
        up, lifted = {"path": [[0.4, 0.5, 0.4, 0.1]]}, []
        for grip in ([[0.1, 0.25], [0.3, 0.38]], [], [[0.2, 1.0]]):
            saved = simulation.save()
            simulation.steer([{**up, "grip": grip}])
            simulation.advance(1)
            simulation.advance(2)
            lifted.append(float(simulation.positions()[..., 2].max()))
            simulation.restore(saved)
        held, let_go, again = lifted
        assert held > 2 * let_go
        assert again > 2 * let_go


def test_what_was_steered_is_forgotten_by_restart_and_restore(device: Device) -> None:
    with Simulation(touching([PRESSED]), threads=device.threads) as simulation:
        simulation.advance(4)
        saved = simulation.save()
        simulation.advance(4)
        path, position = simulation.scene.probes, simulation.positions()
        simulation.restore(saved)
        for frame in (5, 6):
            simulation.steer([{"path": [[(frame + 1) / RATE, 0.3, 0.3, 0.05]]}])
            simulation.advance()
        steered = simulation.save()
        assert simulation.positions().tobytes() != position.tobytes()
        simulation.restore(saved)
        assert simulation.scene.probes == path
        simulation.advance(4)
        assert simulation.positions().tobytes() == position.tobytes()
        simulation.restore(steered)
        simulation.restart()
        simulation.advance(8)
        assert simulation.positions().tobytes() == position.tobytes()


AT = [0.5, 0.5, 0.0]
REFUSED: dict[str, dict[str, Any]] = {
    "now": {"path": [[0.08, *AT], [0.1, *AT]]},
    "too fast": {"path": [[0.1, *AT], [0.11, 0.5, 0.5, 0.1]]},
    "too fast from here": {"path": [[0.081, 0.9, 0.5, 0.0]]},
    "turned at once": {"path": [[0.1, *AT]], "instrument": {**ROD, "shaft": [0.5, -0.6, 2.0]}},
    "held before": {"path": [[0.1, *AT]], "grip": [[0.05, 0.2]]},
    "no path": {"path": []},
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_tool_cannot_do_is_refused(case: str, device: Device, message: Messages) -> None:
    with Simulation(touching([HELD]), threads=device.threads) as simulation:
        simulation.advance(2)
        before = simulation.scene
        with message.raises(SceneError, "probes.0."):
            simulation.steer([REFUSED[case]])
        assert simulation.scene == before
        simulation.steer([{"path": [[0.12, *AT]], "instrument": {**ROD, "radius": 0.051}}])
        simulation.advance()


FORCE = {"total": [0, 0, -1], "load": [[0, 100]]}
STRUCTURE: dict[str, list[Any]] = {
    "friction": [{"path": [[0.1, *AT]], "friction": 0.1}, FORCE],
    "grips": [{"path": [[0.1, *AT]], "grip": [[0.1, 0.2]]}, FORCE],
    "another tool": [PRESSED, PRESSED],
    "exchanged": [FORCE, PRESSED],
    "one less": [FORCE],
}


@pytest.mark.parametrize("case", STRUCTURE)
def test_what_needs_another_kernel_is_refused(case: str, device: Device, message: Messages) -> None:
    with Simulation(touching([PRESSED, FORCE]), threads=device.threads) as simulation:
        with message.raises(ArgumentError):
            simulation.steer(STRUCTURE[case])
        simulation.steer([{"path": [[0.1, *AT]]}, FORCE])


def test_a_thrown_sheet_may_fly_on_when_its_tool_stands(device: Device) -> None:
    """Farther than it could have gone at the tool's new speed."""
    sheet = {"points": [5, 5], "size": [0.1, 0.1], "fixed": "none"}
    tissue = {"young": 1e3, "thickness": 0.01, "density": 1000}
    rod = moved([0, 0.5, 0.5, -0.11], [0.3, 0.5, 0.5, 0.4], [0.4, 0.5, 0.5, 0.4], instrument={"shaft": [0, 0, -1]})
    made = touching([rod], sheet=sheet, tissue=tissue, time={"duration": 2.0})
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(10)
        speed = float(simulation.velocities()[..., 2].mean())
        assert speed > 1
        simulation.steer([Probe(path=[[0.5, 0.5, 0.5, 0.3], [0.6, 0.5, 0.5, 0.3]], instrument=rod["instrument"])])
        simulation.advance(30)
        assert simulation.positions()[..., 2].min() > 1.3
