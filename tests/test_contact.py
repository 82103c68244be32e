"""Tools that are moved: contact, friction and grips against their twin, and against what must hold of any contact."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from taichi_msm.physics.kernel import SheetLayout
from taichi_msm.physics.state import State
from taichi_msm.scene import Scene
from taichi_msm.system.runtime import Device
from tests import reference
from tests.motion import dynamics_of, structure_of
from tests.scenes import plan_of, scene
from tests.test_dynamics import as_on_a_gpu, assert_like_twin, with_lanes

ROD = {"radius": 0.05, "shaft": [0.5, -0.6, 0.9], "length": 0.3}


def moved(*keys: list[float], **changes: Any) -> dict[str, Any]:
    return {"path": list(keys), "instrument": {**ROD, **changes.pop("instrument", {})}, **changes}


def touching(probes: list[dict[str, Any]], **sections: Any) -> Scene:
    tissue = {"young": 1e3, "thickness": 0.01, "density": 1000, "foundation": 3e3, "damping": 5}
    given = {"sheet": {"points": [17, 21], "size": [0.3, 0.4]}, "tissue": tissue, "springs": None, "damping": 0}
    return scene(**{**given, "probes": probes, **sections})


PRESSED = moved([0, 0.5, 0.5, 0.001], [0.2, 0.52, 0.45, -0.03], [0.4, 0.6, 0.5, -0.02])
RUBBED = moved([0, 0.3, 0.5, 0.0], [0.1, 0.3, 0.5, -0.03], [0.4, 0.7, 0.4, -0.03], friction=0.3)
HELD = moved([0, 0.5, 0.4, 0.0], [0.1, 0.5, 0.4, -0.02], [0.4, 0.45, 0.6, 0.04], grip=[[0.1, 0.25], [0.3, 0.38]])
BESIDE = moved([0, 0.6, 0.4, 0.0], [0.12, 0.55, 0.4, -0.02], [0.4, 0.9, 0.3, 0.03], grip=[[0.12, 0.4]], friction=0.5)

CASES = {"pressed": [PRESSED], "rubbed": [RUBBED], "held": [HELD], "together": [HELD, RUBBED, BESIDE]}


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("case", CASES)
def test_like_twin(case: str, precision: str, device: Device) -> None:
    assert_like_twin(touching(CASES[case], time={"precision": precision}), device)


@pytest.mark.parametrize("case", CASES)
def test_the_case_is_what_its_name_says(case: str) -> None:
    probes = range(len(CASES[case]))
    pushed, held = set(), set()
    for _, contact in reference.steps(plan_of(touching(CASES[case]))):
        pushed |= {index for index in probes if contact.push[index].any()}
        held |= set(contact.holder.ravel()) - {-1}
    assert pushed == set(probes)
    assert held == {index for index in probes if "grip" in CASES[case][index]}


def states(made: Scene, device: Device, layout: SheetLayout) -> bytes:
    """All that the next steps depend on, at the end."""
    dynamics = dynamics_of(made, device, layout)
    dynamics.advance(plan_of(made).grid.steps)
    state = dynamics.state()
    dynamics.close()
    return b"".join(array.tobytes() for array in state[1:])


def test_lanes_workers_and_passes_do_not_change_the_bits(device: Device) -> None:
    made = touching(CASES["together"], time={"precision": "f32"})
    layout = structure_of(made, device)
    plain = states(made, device, layout)
    for lanes, workers, depth in ((layout.code.lanes, 2, 1), (layout.code.lanes, 2, 4), (4, 1, 3), (1, 2, 1)):
        assert states(made, device, replace(with_lanes(layout, lanes), workers=workers, depth=depth)) == plain
    assert states(made, device, as_on_a_gpu(layout)) == plain


def test_steps_go_on_from_a_state(device: Device) -> None:
    made = touching(CASES["together"])
    plan, dynamics = plan_of(made), dynamics_of(made, device)
    dynamics.advance(plan.grid.steps * 3 // 4 + 1)
    saved = dynamics.state()
    assert len(saved.contact) == 3 * 3 + 4
    dynamics.restart(plan, State(*saved))
    dynamics.advance(plan.grid.steps - saved.steps)
    whole = dynamics_of(made, device)
    whole.advance(plan.grid.steps)
    assert [part.tobytes() for part in dynamics.state()[1:]] == [part.tobytes() for part in whole.state()[1:]]
