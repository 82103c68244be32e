"""Tools that are moved: contact, friction and grips against their twin, and against what must hold of any contact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm import Simulation
from taichi_msm.errors import SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.model.tools import build_tools, min_steps_per_frame, path_warnings
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import try_plan
from taichi_msm.solver.state import RunProgress, State
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.motion import notes_of
from tests.scenes import plan_of, scene
from tests.solver.test_dynamics import assert_like_twin

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


@pytest.mark.parametrize(("case", "precision"), [("pressed", "f64"), ("rubbed", "f32"), ("together", "f64")])
def test_like_twin(case: str, precision: str, device: Device) -> None:
    assert_like_twin(touching(CASES[case], time={"precision": precision}), device)


@pytest.mark.parametrize("case", ["pressed", "together"])
def test_the_case_is_what_its_name_says(case: str) -> None:
    probes = range(len(CASES[case]))
    pushed, held = set(), set()
    for _, contact in reference.steps(plan_of(touching(CASES[case]))):
        pushed |= {index for index in probes if contact.push[index].any()}
        held |= set(contact.holder.ravel()) - {-1}
    assert pushed == set(probes)
    assert held == {index for index in probes if "grip" in CASES[case][index]}


DOWN_AND_UP = ([0, 0.5, 0.5, 0.0], [0.1, 0.5, 0.5, -0.02], [0.4, 0.6, 0.5, 0.02])
LOADED = {"total": [0, 0, 2], "radius": 0.05, "load": [[0, 0], [0.2, 100]]}
FRAME = 1 / 25

# What is at an edge of the rules.
EDGES: dict[str, list[dict[str, Any]]] = {
    "equal to a frame": [moved(*DOWN_AND_UP, grip=[[3 * FRAME + 0.9e-6 * FRAME, 7 * FRAME - 0.9e-6 * FRAME]])],
    "after a frame": [moved(*DOWN_AND_UP, grip=[[3 * FRAME + 2e-6 * FRAME, 7 * FRAME + 2e-6 * FRAME]])],
    "one grip after the other": [moved(*DOWN_AND_UP, grip=[[0.1, 0.2], [0.2, 0.3]])],
    "shorter than a step": [moved(*DOWN_AND_UP, grip=[[0.1001, 0.1002], [0.15, 0.1501]])],
    "from before the start to after the end": [
        moved([-0.5, 0.5, 0.5, 0.05], [0.3, 0.5, 0.5, -0.02], [0.9, 0.5, 0.5, 0.0], grip=[[-1, 5]])
    ],
    "a single key": [moved([0.1, 0.5, 0.5, 0.0], grip=[[0.1, 0.3]]), LOADED],
    "begins late and ends early": [moved([0.1, 0.5, 0.5, 0.0], [0.2, 0.5, 0.5, -0.03])],
    "comes from beside": [moved([0, 1.5, 0.5, -0.03], [0.4, 0.8, 0.5, -0.03])],
    "larger than the sheet": [
        moved([0, 0.5, 0.5, 0.0], [0.2, 0.5, 0.5, -0.05], [0.4, 0.5, 0.5, -0.01], instrument={"radius": 0.5})
    ],
    "from below": [
        moved([0, 0.5, 0.5, -0.1], [0.2, 0.5, 0.45, -0.07], instrument={"shaft": [0.2, 0.1, -1]}, friction=0.3)
    ],
    "lies": [moved([0, 0.3, 0.5, 0.0], [0.2, 0.3, 0.5, -0.03], instrument={"shaft": [1, 0, 0]}, friction=0.3)],
}


@pytest.mark.parametrize("case", EDGES)
def test_edges_like_twin(case: str, device: Device) -> None:
    made = touching(EDGES[case])
    small = made.sheet.model_copy(update={"points": (9, 11)})
    assert_like_twin(made.model_copy(update={"sheet": small}), device)


@pytest.mark.parametrize(("height", "pushed"), [(0.05, 0.05), (0.0, 0.0), (0.1, 0.0)], ids=["axis", "below", "above"])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_the_middle_line_pushes_up_and_the_surface_does_not(
    precision: str, height: float, pushed: float, device: Device
) -> None:
    """A point with d = 0 and with d = radius, to the bit, and with no force on it."""
    probe = moved([0, 0.5, 0.5, 0.0], instrument={"shaft": [1, 0, 0]}, friction=0.3)
    plan = plan_of(scene(springs={"virtual": 1.0}, damping=0, probes=[probe], time={"precision": precision}))
    displacement = np.zeros((*plan.scene.sheet.points, 3), precision.replace("f", "float"))
    displacement[4, 5, 2] = height
    dynamics = Dynamics(plan, device)
    dynamics.restart(plan, State(1, displacement, np.zeros_like(displacement)))
    dynamics.advance(1)
    assert dynamics.state().memory[:3, 4, 5] == pytest.approx([0, 0, pushed])
    assert dynamics.displacement()[4, 5] == pytest.approx([0, 0, height + pushed])


def test_a_sheet_of_four_points_like_twin(device: Device) -> None:
    path = [0, 0.2, 0.2, 0.0], [0.2, 0.2, 0.2, -0.03], [0.4, 0.6, 0.5, -0.02]
    held = moved(*path, friction=0.3, grip=[[0.2, 0.3]], instrument={"radius": 0.2})
    assert_like_twin(touching([held], sheet={"points": [2, 2], "size": [0.3, 0.3], "fixed": "none"}), device)


PATH = PRESSED["path"]
REFUSED: dict[str, dict[str, Any]] = {
    "in the sheet": moved([0, 0.5, 0.5, -0.01]),
    "a jump": moved([0, 0.5, 0.5, 0.0], [0, 0.5, 0.5, 0.01]),
    "no rod": {"path": PATH},
    "a force": {**PRESSED, "total": [0, 0, -1]},
    "no path": {"total": [0, 0, -1], "friction": 0.1},
    "a grip that ends before": {**PRESSED, "grip": [[0.2, 0.1]]},
    "two grips at once": {**PRESSED, "grip": [[0.1, 0.3], [0.2, 0.4]]},
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_tool_cannot_be_is_refused_with_the_remedy(case: str, message: Messages) -> None:
    tissue = {"young": 1e3, "thickness": 0.01, "density": 1000}
    sheet, time = {"points": [9, 11], "size": [0.3, 0.4]}, {"duration": 0.4}
    with message.raises(SceneError, "probes.0."):
        check_scene({"sheet": sheet, "tissue": tissue, "time": time, "output": [], "probes": [REFUSED[case]]})


def problems(*keys: list[float], **time: Any) -> list[str]:
    return [str(problem) for problem in try_plan(touching([moved(*keys)], time=time))[1]]


def test_how_far_a_tool_comes_in_a_step(message: Messages) -> None:
    """Half of its radius, 0.05 m, at most: within one segment of its path, across a key, and from the start on."""
    still, step = [0, 0.5, 0.5, 0.1], {"step": 0.01}
    assert not problems(still, [0.4, 0.5, 0.5, 0.1], **step)
    # Between columns 0.4 m apart in all: 0.16 m/s, 2.4 m/s, 2.6 m/s.
    assert not problems(still, [0.1, 0.5 + 0.24 / 0.4, 0.5, 0.1], **step)
    message(problems(still, [0.2, 0.5, 0.5, 0.1], [0.3, 0.5 + 0.26 / 0.4, 0.5, 0.1], **step), "probes.0.path.2: ")
    # 0.024 m within a microsecond, and twice that within a step.
    assert not problems(still, [0.1, 0.5, 0.5, 0.1], [0.100001, 0.56, 0.5, 0.1], **step)
    twice = [[0.1, 0.5, 0.5, 0.1], [0.100001, 0.56, 0.5, 0.1], [0.104, 0.56, 0.5, 0.1], [0.104001, 0.62, 0.5, 0.1]]
    message(problems(still, *twice, **step)[0], "0.048 m")
    # After the end, where a simulation may still go, and before the start.
    assert problems(still, [0.4, 0.5, 0.5, 0.1], [0.41, 0.9, 0.5, 0.1], **step)
    assert not problems([-0.01, 0.1, 0.5, 0.1], still, **step)


def test_the_fewest_steps_in_which_no_tool_moves_too_far() -> None:
    plan = plan_of(touching([moved([0, 0.5, 0.5, 0.1], [0.1, 1.5, 0.5, 0.1])]))
    assert min_steps_per_frame(plan.tools, plan.grid, 1) == 7  # 0.16 m in a frame, in parts of 0.025 m
    assert min_steps_per_frame(plan.tools, plan.grid, 9) == 9
    assert min_steps_per_frame((), plan.grid, 1) == 1


def test_a_fault_of_tissue_brings_no_fault_of_a_path() -> None:
    # In a step of this scene it moves little, but much in a frame.
    fast = moved([0, 0.5, 0.5, 0.001], [0.02, 0.5, 0.5, -0.03])
    data = touching([fast]).model_dump(mode="json", exclude_none=True)
    check_scene(data)
    data["tissue"]["yuong"] = data["tissue"].pop("young")
    with pytest.raises(SceneError) as caught:
        check_scene(data)
    assert {line.split(":")[0] for line in caught.value.lines} == {"tissue.yuong", "tissue.young"}


def test_units_and_times_that_cannot_be_meant_are_noted(message: Messages) -> None:
    late = {**PRESSED, "path": [[0, 0.5, 0.5, 1], [300, 0.5, 0.5, -5]], "grip": [[2, 3]]}
    made = touching([late])
    message(list(path_warnings(made, build_tools(made.probes, made.sheet)))[:3], "probes.0.path", "probes.0.grip")


def test_a_tip_that_is_deep_in_a_soft_foundation_is_noted(message: Messages) -> None:
    def notes(depth: float = 0.002, young: float = 1e3) -> list[str]:
        rod = moved([0, 0.5, 0.5, 0], [0.2, 0.5, 0.5, -depth], instrument={"radius": 0.005})
        sheet, tissue = {"points": [41, 41], "size": [0.1, 0.1]}, {"young": young, "thickness": 1e-3, "foundation": 3e5}
        made = touching([rod], sheet=sheet, tissue=tissue, time={"motion": "quasistatic"})
        return [note for note in notes_of(made, RunProgress(), None) if "slides" in note]

    # E t is 1 N/m, k R^2 7.5 N/m, R / 5 1 mm.
    message(notes(), "probes.0: ")
    assert not notes(depth=0.00099)
    assert notes(young=7.4e3)
    assert not notes(young=7.6e3)


def test_a_rod_that_goes_through_the_sheet_is_noted(device: Device, message: Messages) -> None:
    from_the_side = [moved([0, -0.5, 0.6, -0.08], [0.3, 1.5, 0.6, -0.08])]
    made = touching(from_the_side, tissue={"young": 1e4, "thickness": 1e-3, "density": 1050}, time={"duration": 0.32})
    # The border is at 0, a quarter of the way.
    with Simulation(made, device.arch) as simulation:
        simulation.advance(8)
        progress = simulation.progress
    assert (progress.pierced_by, progress.pierced_frame) == (1, 2)
    message((note for note in notes_of(made, progress, None) if "went through" in note), "probes.0: ", "frame 2")
    # Exactly on the diagonal of a cell, without touching its corners.
    path, rod = ([0, 0.525, 0.53125, 0.001], [0.2, 0.525, 0.53125, -0.03]), {"radius": 0.004, "shaft": [0, 0, 1]}
    with Simulation(touching([moved(*path, instrument=rod)]), device.arch) as simulation:
        simulation.advance(8)
        assert simulation.progress.pierced_by == 1
        assert simulation.progress.max_displacement == 0
    with Simulation(touching([PRESSED, HELD]), device.arch) as simulation:
        simulation.advance(10)
        assert simulation.progress.pierced_by == 0
