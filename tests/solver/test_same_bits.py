"""Results have the same bits for any lanes, workers, passes, launches and restarts, and in the kernels of a GPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taichi_msm.scene.scene import Scene
from taichi_msm.solver.arrays import SheetLayout
from taichi_msm.solver.rest import build_solver
from taichi_msm.solver.sheet_solver import choose_layout
from taichi_msm.system.runtime import Device
from tests.scenes import PRESS, plan_of, random_tissue, scene, speckle
from tests.scenes import SHEET as SPRING_SHEET
from tests.solver.test_dynamics import as_on_a_gpu, short_launches, with_lanes
from tests.solver.test_rest import PRESSED as PRESSED_AT_REST
from tests.solver.test_rest import PUSH, SHEET, at_rest, tissue
from tests.terms.test_clamp import HELD as TWO_SIDES
from tests.terms.test_clamp import HOOK, LEFT, PULL, RIGHT, TENSE, TOP
from tests.terms.test_contact import HELD, RUBBED, touching
from tests.terms.test_foundation import mapped
from tests.terms.test_laws import made as pressed
from tests.terms.test_rough import lifted

__all__ = ["short_launches"]

SINGLE = {"precision": "f32", "duration": 0.12}

MOVING: dict[str, Callable[[str], Scene]] = {
    "springs": lambda _: scene(
        sheet={**SPRING_SHEET, "points": [13, 19], "fixed": ["top", "left"]},
        probes=[PRESS, {**PRESS, "at": [[0, 0.1, 0.1], [0.4, 0.9, 0.9]]}],
        time=SINGLE,
    ),
    "tools": lambda _: touching([HELD, RUBBED], time={"precision": "f32", "duration": 0.24}),
    "clamp and tool": lambda _: touching([HOOK, RIGHT], sheet=TWO_SIDES, time=SINGLE),
    "two clamps": lambda _: touching([TOP, RIGHT], sheet=LEFT, time=SINGLE),
    "clamps, bending": lambda _: touching([TOP, RIGHT], sheet=TWO_SIDES, tissue=TENSE, time={"duration": 0.08}),
    "laws": lambda _: pressed("everything", sheet={"points": [11, 21]}, time={"precision": "f32"}),
    "foundation map": lambda image: mapped(image, "none", time={"duration": 0.04, "precision": "f32"}),
    "tissue with a map": lambda image: random_tissue(1, image),
    "tissue that bends": lambda image: random_tissue(5, image),
}

AT_REST: dict[str, Scene] = {
    "moving load, bending": tissue(
        {**PUSH, "at": [[0, 0.2, 0.2], [2, 0.8, 0.6]]}, {"points": [9, 14]}, bending="plate"
    ),
    "tool": at_rest([PRESSED_AT_REST], sheet={**SHEET, "fixed": ["left", "top"]}),
    "rough tool": lifted(),
    "relaxation": pressed("relaxation", time={"motion": "quasistatic"}),
    "clamp": at_rest([PULL], sheet=LEFT),
}


@pytest.fixture
def image(tmp_path: Path) -> str:
    Image.fromarray(speckle(7, 9)[..., 0]).save(tmp_path / "map.png")
    return str(tmp_path / "map.png")


def states(made: Scene, device: Device, layout: SheetLayout, *, piece: int = 10**9, restarts: bool = False) -> bytes:
    """The last state and the tool forces at all frames, for steps in pieces or with a restart within each frame."""
    plan, forces = plan_of(made), []
    sheet, steps = build_solver(plan, device, layout), plan.grid.steps_per_frame
    for _ in range(plan.grid.frames):
        halves = [count for count in (steps // 2 + 1, steps - steps // 2 - 1) if count]
        for count in halves if restarts else [min(piece, steps)] * -(-steps // piece):
            if restarts and sheet.steps_done:
                sheet.restart(plan, sheet.state())
            sheet.advance(count)
        forces.append(sheet.tool_forces())
    assert not plan.tools or np.any(forces)
    state = sheet.state()
    sheet.close()
    return b"".join(np.asarray(array).tobytes() for array in (*state[1:], *forces))


@pytest.mark.default_cases("springs", "tools", "laws", "foundation map", "tissue with a map", "tissue that bends")
@pytest.mark.usefixtures("short_launches")
@pytest.mark.parametrize("name", MOVING)
def test_dynamic_scenes(name: str, image: str, device: Device) -> None:
    made = MOVING[name](image)
    layout = choose_layout(plan_of(made), device)
    # With bending a pass takes one step.
    depth = 3 if layout.config.reach == 1 else 1
    expected = states(made, device, layout)
    assert states(made, device, replace(with_lanes(layout, 4), workers=2, depth=depth), restarts=True) == expected
    for restarts in (False, True):
        assert states(made, device, as_on_a_gpu(layout), restarts=restarts) == expected
    # Of three bands two end at one border; with one step per launch no worker waits.
    assert states(made, device, replace(layout, workers=min(3, layout.rows // 3)), piece=1) == expected


@pytest.mark.default_cases("tool", "relaxation", "clamp")
@pytest.mark.parametrize("name", AT_REST)
def test_quasistatic_scenes(name: str, device: Device) -> None:
    made = AT_REST[name]
    layout = choose_layout(plan_of(made), device)
    assert states(made, device, with_lanes(layout, 1), restarts=True) == states(made, device, layout)
