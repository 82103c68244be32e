"""Warnings of `check` about implausible numbers: thickness, pressure, paths and grips outside the sheet."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.load.check import check_scene
from taichi_msm.load.scene_file import load_plan
from taichi_msm.model.plan import Plan
from taichi_msm.model.tool_force import force_warnings, probe_records
from taichi_msm.model.tools import path_warnings
from taichi_msm.render.notes import drawing_warnings
from tests.golden import Messages

TIP = {"radius": 0.004, "shaft": [0, 0, 1], "length": 0.05}


def plan_of(**sections: Any) -> Plan:
    """A sheet of 41 x 41 points, 2 mm apart, without output."""
    tissue = {"young": 3e4, "thickness": 0.003, "density": 1000, **sections.pop("tissue", {})}
    sheet = {"points": [41, 41], "size": [0.08, 0.08], **sections.pop("sheet", {})}
    time = {"duration": 0.4, "motion": "quasistatic"}
    return check_scene({"sheet": sheet, "tissue": tissue, "time": time, "output": [], **sections})


def notes(plan: Plan) -> list[str]:
    def all_notes() -> Iterator[str]:
        yield from force_warnings(plan.scene, probe_records(plan.scene))
        yield from path_warnings(plan.scene, plan.tools)
        yield from drawing_warnings(plan.scene)

    return list(all_notes())


def moved(*path: list[float], **keys: Any) -> list[dict[str, Any]]:
    return [{"path": list(path), "instrument": TIP, **keys}]


@pytest.fixture
def hole(tmp_path: Path) -> str:
    """A mask with a hole of 32 mm in the middle of the sheet."""
    is_sheet = np.full((40, 40), 255, np.uint8)
    is_sheet[12:28, 12:28] = 0
    Image.fromarray(is_sheet).save(tmp_path / "mask.png")
    return str(tmp_path / "mask.png")


def test_thickness(message: Messages) -> None:
    assert not notes(plan_of(tissue={"thickness": 0.1}))
    (note,) = notes(plan_of(tissue={"thickness": 3}))
    message(note, "0.003")


def test_pressure(message: Messages) -> None:
    """A flat end of 1 cm, without decay, presses with total / (pi R^2), of 1 MPa at 314 N."""
    for total in (250.0, 400.0):
        probe = {"total": -total, "radius": 0.01, "falloff": 1e4}
        found = [note for note in notes(plan_of(probes=[probe])) if "MPa" in note]
        assert len(found) == (total > 314)
    message(found, "probes.0")


PATHS = {
    "never on it": ([[0, 1.2, 0.5, 0.01], [0.3, 1.4, 0.5, 0.01]], 0),
    "below it": ([[0, 0.5, 0.5, 0.01], [0.3, 0.5, 1.5, -0.003]], 1),
    "in pixels or percent": ([[0, 0.5, 0.5, 0.01], [0.3, -0.2, 0.5, 0]], 1),
    "from beyond an edge": ([[0, -0.2, 0.5, 0.01], [0.3, 0.5, 0.5, -0.003]], None),
    "to the edge": ([[0, 0, 1, 0.01], [0.3, 1, 0, -0.003]], None),
}


@pytest.mark.parametrize("surface", [None, {"dome": {"radius": 0.1}}], ids=["flat", "dome"])
@pytest.mark.parametrize("name", PATHS)
def test_path_outside_the_sheet(name: str, surface: dict[str, Any] | None, message: Messages) -> None:
    path, keyframe = PATHS[name]
    found = [note for note in notes(plan_of(sheet={"surface": surface}, probes=moved(*path))) if "outside" in note]
    assert len(found) == (keyframe is not None)
    if keyframe is not None:
        message(found, f"at {path[keyframe][0]:g} s")


def test_grip_in_a_hole(hole: str, message: Messages) -> None:
    """A tip of 4 mm holds points within 6 mm; the middle of the hole is 16 mm from the sheet, its edge 0 mm."""
    for across, count in ((0.5, 1), (0.31, 0), (0.1, 0)):
        probes = moved([0, across, 0.5, 0.01], [0.1, across, 0.5, 0], grip=[[0.1, 0.4]])
        found = [note for note in notes(plan_of(sheet={"mask": hole}, probes=probes)) if "grip" in note]
        assert len(found) == count
        if count:
            message(found, "0.016 m")


def test_shipped_scenes_are_plausible(root: Path) -> None:
    for path in sorted(root.glob("scenes/*.yaml")):
        plan = load_plan(path)
        words = ("MPa", "outside the sheet", "holds nothing", "thick")
        assert not [note for note in notes(plan) if any(word in note for word in words)], path
