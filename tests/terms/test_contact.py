"""Position-controlled tools: contact, friction and grips against the twin, invalid paths, and warnings."""

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
OBLIQUE = moved([0, 0.6, 0.4, 0.0], [0.12, 0.55, 0.4, -0.02], [0.4, 0.9, 0.3, 0.03], grip=[[0.12, 0.4]], friction=0.5)

CASES = {"pressed": [PRESSED], "rubbed": [RUBBED], "held": [HELD], "together": [HELD, RUBBED, OBLIQUE]}


@pytest.mark.parametrize(("case", "precision"), [("pressed", "f64"), ("rubbed", "f32"), ("together", "f64")])
def test_contact_matches_twin(case: str, precision: str, device: Device) -> None:
    made = touching(CASES[case], time={"precision": precision})
    assert_like_twin(made, device)
    pushed, held = set(), set()
    for _, contact in reference.steps(plan_of(made)):
        pushed |= {index for index in range(len(CASES[case])) if contact.push[index].any()}
        held |= set(contact.holder.ravel()) - {-1}
    assert pushed == set(range(len(CASES[case])))
    assert held == {index for index, probe in enumerate(CASES[case]) if "grip" in probe}


DOWN_AND_UP = ([0, 0.5, 0.5, 0.0], [0.1, 0.5, 0.5, -0.02], [0.4, 0.6, 0.5, 0.02])
LOADED = {"total": [0, 0, 2], "radius": 0.05, "load": [[0, 0], [0.2, 100]]}
FRAME = 1 / 25

# Limits of the rules for paths and grips.
EDGES: dict[str, list[dict[str, Any]]] = {
    "grip at a frame": [moved(*DOWN_AND_UP, grip=[[3 * FRAME + 0.9e-6 * FRAME, 7 * FRAME - 0.9e-6 * FRAME]])],
    "grip after a frame": [moved(*DOWN_AND_UP, grip=[[3 * FRAME + 2e-6 * FRAME, 7 * FRAME + 2e-6 * FRAME]])],
    "consecutive grips": [moved(*DOWN_AND_UP, grip=[[0.1, 0.2], [0.2, 0.3]])],
    "grip shorter than a step": [moved(*DOWN_AND_UP, grip=[[0.1001, 0.1002], [0.15, 0.1501]])],
    "longer than the scene": [
        moved([-0.5, 0.5, 0.5, 0.05], [0.3, 0.5, 0.5, -0.02], [0.9, 0.5, 0.5, 0.0], grip=[[-1, 5]])
    ],
    "single keyframe": [moved([0.1, 0.5, 0.5, 0.0], grip=[[0.1, 0.3]]), LOADED],
    "late begin and early end": [moved([0.1, 0.5, 0.5, 0.0], [0.2, 0.5, 0.5, -0.03])],
    "from outside the border": [moved([0, 1.5, 0.5, -0.03], [0.4, 0.8, 0.5, -0.03])],
    "larger than the sheet": [
        moved([0, 0.5, 0.5, 0.0], [0.2, 0.5, 0.5, -0.05], [0.4, 0.5, 0.5, -0.01], instrument={"radius": 0.5})
    ],
    "from below": [
        moved([0, 0.5, 0.5, -0.1], [0.2, 0.5, 0.45, -0.07], instrument={"shaft": [0.2, 0.1, -1]}, friction=0.3)
    ],
    "horizontal": [moved([0, 0.3, 0.5, 0.0], [0.2, 0.3, 0.5, -0.03], instrument={"shaft": [1, 0, 0]}, friction=0.3)],
}


@pytest.mark.parametrize("case", EDGES)
def test_limits_match_twin(case: str, device: Device) -> None:
    assert_like_twin(touching(EDGES[case], sheet={"points": [9, 11], "size": [0.3, 0.4]}), device)


def test_contact_of_four_points_matches_twin(device: Device) -> None:
    path = [0, 0.2, 0.2, 0.0], [0.2, 0.2, 0.2, -0.03], [0.4, 0.6, 0.5, -0.02]
    held = moved(*path, friction=0.3, grip=[[0.2, 0.3]], instrument={"radius": 0.2})
    assert_like_twin(touching([held], sheet={"points": [2, 2], "size": [0.3, 0.3], "fixed": "none"}), device)


@pytest.mark.parametrize(("height", "pushed"), [(0.05, 0.05), (0.0, 0.0), (0.1, 0.0)], ids=["axis", "below", "above"])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_correction_on_axis_and_surface(precision: str, height: float, pushed: float, device: Device) -> None:
    """A mass point on the axis is corrected upward by the radius, and at the surface not at all."""
    probe = moved([0, 0.5, 0.5, 0.0], instrument={"shaft": [1, 0, 0]}, friction=0.3)
    plan = plan_of(scene(springs={"virtual": 1.0}, damping=0, probes=[probe], time={"precision": precision}))
    displacement = np.zeros((*plan.scene.sheet.points, 3), precision.replace("f", "float"))
    displacement[4, 5, 2] = height
    dynamics = Dynamics(plan, device)
    dynamics.restart(plan, State(1, displacement, np.zeros_like(displacement)))
    dynamics.advance(1)
    assert dynamics.state().memory[:3, 4, 5] == pytest.approx([0, 0, pushed])
    assert dynamics.displacement()[4, 5] == pytest.approx([0, 0, height + pushed])


PATH = PRESSED["path"]
INVALID: dict[str, dict[str, Any]] = {
    "in the sheet": moved([0, 0.5, 0.5, -0.01]),
    "shaft downwards": moved([0, 0.5, 0.5, 0.01], instrument={"shaft": [0, 0, -1]}),
    "jump": moved([0, 0.5, 0.5, 0.0], [0, 0.5, 0.5, 0.01]),
    "no instrument": {"path": PATH},
    "force": {**PRESSED, "total": [0, 0, -1]},
    "keys of a force": {**PRESSED, "at": [0.5, 0.5], "total": [0, 0, -1], "radius": 0.01, "load": [[0, 100]]},
    "no path": {"total": [0, 0, -1], "friction": 0.1},
    "reversed grip": {**PRESSED, "grip": [[0.2, 0.1]]},
    "overlapping grips": {**PRESSED, "grip": [[0.1, 0.3], [0.2, 0.4]]},
}


def test_invalid_tools(message: Messages) -> None:
    for probe in INVALID.values():
        tissue = {"young": 1e3, "thickness": 0.01, "density": 1000}
        sheet, time = {"points": [9, 11], "size": [0.3, 0.4]}, {"duration": 0.4}
        with message.raises(SceneError, "probes.0."):
            check_scene({"sheet": sheet, "tissue": tissue, "time": time, "output": [], "probes": [probe]})


def test_fast_tool_on_a_sheet_in_millimetres(message: Messages) -> None:
    sheet, path = {"points": [9, 11], "size": [60, 80]}, [[0, 0.5, 0.5, 0.01], [0.4, 0.6, 0.5, 0.01]]
    with message.raises(SceneError, "probes.0.path.1", "[0.06, 0.08]"):
        check_scene(touching([moved(*path)], sheet=sheet))


def test_largest_motion_in_a_step(message: Messages) -> None:
    """Half the radius, 0.025 m: within a segment of the path, across a keyframe, and from the start on."""

    def problems(*keys: list[float]) -> list[str]:
        return [str(problem) for problem in try_plan(touching([moved(*keys)], time={"step": 0.01}))[1]]

    start = [0, 0.5, 0.5, 0.1]
    assert not problems(start, [0.4, 0.5, 0.5, 0.1])
    # The sheet is 0.4 m wide: 0 m/s, 2.4 m/s, 2.6 m/s.
    assert not problems(start, [0.1, 0.5 + 0.24 / 0.4, 0.5, 0.1])
    message(problems(start, [0.2, 0.5, 0.5, 0.1], [0.3, 0.5 + 0.26 / 0.4, 0.5, 0.1]), "probes.0.path.2: ")
    # 0.024 m within a microsecond, and twice that within a step.
    assert not problems(start, [0.1, 0.5, 0.5, 0.1], [0.100001, 0.56, 0.5, 0.1])
    twice = [[0.1, 0.5, 0.5, 0.1], [0.100001, 0.56, 0.5, 0.1], [0.104, 0.56, 0.5, 0.1], [0.104001, 0.62, 0.5, 0.1]]
    message(problems(start, *twice)[0], "0.048 m")
    # A simulation can continue after the end of the scene, but does not begin before its start.
    assert problems(start, [0.4, 0.5, 0.5, 0.1], [0.41, 0.9, 0.5, 0.1])
    assert not problems([-0.01, 0.1, 0.5, 0.1], start)


def test_steps_per_frame_of_a_fast_tool() -> None:
    plan = plan_of(touching([moved([0, 0.5, 0.5, 0.1], [0.1, 1.5, 0.5, 0.1])]))
    assert min_steps_per_frame(plan.tools, plan.grid, 1) == 7  # 0.16 m in a frame, in parts of 0.025 m
    assert min_steps_per_frame(plan.tools, plan.grid, 9) == 9
    assert min_steps_per_frame((), plan.grid, 1) == 1


def test_invalid_tissue_causes_no_path_problem() -> None:
    # The tool moves little in a step of this scene, but far in a frame.
    data = touching([moved([0, 0.5, 0.5, 0.001], [0.02, 0.5, 0.5, -0.03])]).model_dump(mode="json", exclude_none=True)
    check_scene(data)
    data["tissue"]["yuong"] = data["tissue"].pop("young")
    with pytest.raises(SceneError) as caught:
        check_scene(data)
    assert {line.split(":")[0] for line in caught.value.lines} == {"tissue.yuong"}


def test_warnings_of_implausible_paths(message: Messages) -> None:
    made = touching([{**PRESSED, "path": [[0, 0.5, 0.5, 1], [300, 0.5, 0.5, -5]], "grip": [[2, 3]]}])
    message(list(path_warnings(made, build_tools(made.probes, made.sheet)))[:3], "probes.0.path", "probes.0.grip")


def test_warning_of_a_deep_tip_on_a_soft_foundation(message: Messages) -> None:
    def warnings(depth: float = 0.002, young: float = 1e3) -> list[str]:
        rod = moved([0, 0.5, 0.5, 0], [0.2, 0.5, 0.5, -depth], instrument={"radius": 0.005})
        sheet, tissue = {"points": [41, 41], "size": [0.1, 0.1]}, {"young": young, "thickness": 1e-3, "foundation": 3e5}
        made = touching([rod], sheet=sheet, tissue=tissue, time={"motion": "quasistatic"})
        return [note for note in notes_of(made, RunProgress(), None) if "slides" in note]

    # E t is 1 N/m, k R^2 7.5 N/m, R / 5 1 mm.
    message(warnings(), "probes.0: ")
    assert not warnings(depth=0.00099)
    assert warnings(young=7.4e3)
    assert not warnings(young=7.6e3)


def test_warning_of_a_pierced_sheet(device: Device, message: Messages) -> None:
    def progress_of(made: Scene, frames: int) -> RunProgress:
        with Simulation(made, device.arch) as simulation:
            simulation.advance(frames)
            return simulation.progress

    from_the_side = [moved([0, -0.5, 0.6, -0.08], [0.3, 1.5, 0.6, -0.08])]
    made = touching(from_the_side, tissue={"young": 1e4, "thickness": 1e-3, "density": 1050}, time={"duration": 0.32})
    # The border is at 0, a quarter of the path.
    progress = progress_of(made, 8)
    assert (progress.pierced_by, progress.pierced_frame) == (1, 2)
    message((note for note in notes_of(made, progress, None) if "went through" in note), "probes.0: ", "frame 2")
    # Exactly on the diagonal of a cell, without contact with its corners.
    path, rod = ([0, 0.525, 0.53125, 0.001], [0.2, 0.525, 0.53125, -0.03]), {"radius": 0.004, "shaft": [0, 0, 1]}
    progress = progress_of(touching([moved(*path, instrument=rod)]), 8)
    assert (progress.pierced_by, progress.max_displacement) == (1, 0)
    assert progress_of(touching([PRESSED, HELD]), 10).pierced_by == 0
