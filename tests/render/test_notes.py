"""Warnings about scenes whose pictures may not look as intended."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.sheet import spacing
from taichi_msm.render.notes import drawing_warnings
from taichi_msm.scene.scene import Scene
from tests.conftest import Program
from tests.golden import Messages
from tests.scenes import PRESS, SHEET, scene


def with_picture(tmp_path: Path, size: tuple[int, int], **changes: Any) -> Scene:
    """A scene of a sheet 0.4 m wide and 0.3 m high with a picture of a size."""
    Image.new("RGB", size).save(tmp_path / "picture.png")
    return scene(image=str(tmp_path / "picture.png"), sheet={**SHEET, "size": [0.3, 0.4]}, output=["png"], **changes)


def test_sheet_in_millimetres(message: Messages) -> None:
    message(drawing_warnings(scene(sheet={**SHEET, "size": [75, 100]})), "sheet.size", "[0.075, 0.1]")
    assert not any("sheet.size" in text for text in drawing_warnings(scene(sheet={**SHEET, "size": [0.075, 5]})))


@pytest.mark.parametrize(
    "instrument",
    [{"radius": 0.01, "shaft": [0, 0.3, -1], "length": 0.1}, {"radius": 4, "shaft": [0, 0, 1], "length": 9}],
    ids=["down", "wide"],
)
def test_implausible_instruments(instrument: dict[str, Any], message: Messages) -> None:
    (warning,) = drawing_warnings(scene(probes=[{**PRESS, "instrument": instrument}]))
    message(warning, "probes.0.instrument")


@pytest.mark.parametrize(
    ("size", "sheet", "region"),
    [((300, 600), "0.4,0.2", "0,187,300,225"), ((800, 300), "0.15,0.4", "200,0,400,300")],
    ids=["high", "wide"],
)
def test_stretched_picture_and_its_two_remedies(
    tmp_path: Path, size: tuple[int, int], sheet: str, region: str, message: Messages
) -> None:
    (warning,) = drawing_warnings(with_picture(tmp_path, size))
    message(warning, f'--set "sheet.size=[{sheet}]"', f'--set "region=[{region}]"')
    like_picture = {**SHEET, "size": [float(side) for side in sheet.split(",")]}
    assert not list(drawing_warnings(scene(image=str(tmp_path / "picture.png"), sheet=like_picture, output=["png"])))
    made = with_picture(tmp_path, size, region=[int(number) for number in region.split(",")])
    assert not list(drawing_warnings(made))
    assert not list(drawing_warnings(with_picture(tmp_path, size).model_copy(update={"output": ("trajectory",)})))


def test_stretched_region(tmp_path: Path) -> None:
    (warning,) = drawing_warnings(with_picture(tmp_path, (800, 600), region=[100, 50, 600, 300]))
    assert '--set "region=[200,50,400,300]"' in warning


@pytest.mark.parametrize("size", [(900, 500), (300, 700)])
def test_tissue_with_the_proportions_of_the_picture_has_square_cells(
    tmp_path: Path, size: tuple[int, int], root: Path
) -> None:
    Image.new("RGB", size).save(tmp_path / "picture.png")
    press = ["image=picture.png", "probes.0.instrument=null"]
    (tmp_path / "press.yaml").write_text((root / "scenes/press.yaml").read_text())
    (warning,) = drawing_warnings(load_scene(tmp_path / "press.yaml", press))
    settings = re.findall(r'--set "(sheet[^"]+)"', warning)
    assert [setting.partition("=")[0] for setting in settings] == ["sheet.size", "sheet.points"]
    made = load_scene(tmp_path / "press.yaml", [*press, *settings])
    assert not list(drawing_warnings(made))
    down, across = spacing(made.sheet)
    assert down == pytest.approx(across, rel=0.02)


@pytest.mark.parametrize(("size", "has_region"), [((3, 4000), False), ((5, 5), False), ((20, 12), True)])
def test_region_of_a_small_picture(tmp_path: Path, size: tuple[int, int], has_region: bool) -> None:
    """For 3 or 5 columns, no number of rows has the proportions 4 : 3; for 12 rows, 16 columns have."""
    (warning,) = drawing_warnings(with_picture(tmp_path, size))
    assert ("region" in warning) == has_region


@pytest.mark.parametrize(("width", "is_stretched"), [(407, False), (393, False), (409, True), (392, True)])
def test_tolerance_of_stretching(tmp_path: Path, width: int, is_stretched: bool) -> None:
    assert bool(list(drawing_warnings(with_picture(tmp_path, (width, 300))))) == is_stretched


@pytest.mark.parametrize("shading", ["none", "headlight"])
def test_light_without_tissue(tmp_path: Path, shading: str, message: Messages) -> None:
    render = {"light": {"gloss": 0.1}}
    (warning,) = drawing_warnings(with_picture(tmp_path, (400, 300), render={**render, "shading": shading}))
    message(warning, "render.light", shading)
    assert not list(drawing_warnings(with_picture(tmp_path, (400, 300), render={**render, "shading": "tissue"})))


def test_transparent_picture(tmp_path: Path, message: Messages) -> None:
    made = with_picture(tmp_path, (400, 300), render={"background": [9, 8, 7]})
    picture = Image.new("RGBA", (400, 300), (200, 100, 50, 255))
    picture.save(tmp_path / "picture.png")
    assert not list(drawing_warnings(made))
    picture.putpixel((399, 299), (200, 100, 50, 254))
    picture.save(tmp_path / "picture.png")
    message(drawing_warnings(made), "render.background: [9, 8, 7]")


def test_check_and_run_print_warnings(small: Path, program: Program) -> None:
    changes = ["--set", "sheet.size=[0.1, 0.4]", "--set", "output=[png]"]
    (warning,) = json.loads(program("check", "small.yaml", *changes, "--json").stdout)["notes"]
    assert "40 x 30 pixels is stretched" in warning
    assert warning in program("check", "small.yaml", *changes).stdout
    assert warning in program("run", "small.yaml", *changes).stdout


@pytest.mark.parametrize(
    "camera",
    [
        {"pose": {"rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "translation": [0, 300, 400]}},
        {"eye": [0, 0, 0.4], "target": [0, 0, 1]},
        {"eye": [[0, 0, 0.1, 0.3], [1, 0.1, 0, 0.4]], "target": [3, 0, 0.4]},
        {
            "eye": [0, 0, 0.4],
            "intrinsics": {"fx": 26, "fy": 26, "cx": 2000, "cy": 256},
            "distortion": {"model": "fisheye"},
            "outside": "background",
        },
    ],
    ids=["millimetres", "upward", "moving", "beyond the lens"],
)
def test_invisible_sheet(tmp_path: Path, camera: dict[str, Any], message: Messages) -> None:
    made = with_picture(tmp_path, (400, 300), render={"cameras": {"left": "top", "right": camera}})
    (warning,) = drawing_warnings(made)
    message(warning, "render.cameras.right ")
    (warning,) = drawing_warnings(with_picture(tmp_path, (400, 300), render={"camera": camera}))
    message(warning, "render.camera ")
    assert not list(drawing_warnings(made.model_copy(update={"output": ("trajectory",)})))


@pytest.mark.parametrize(
    "camera",
    [
        {"eye": [0.013, 0.017, 0.4], "target": [0.013, 0.017, 0], "fov": 0.01},
        {"eye": [[0, 9, 9, 1], [0.3, 9, 9, 1], [0.4, 0, 0, 1]], "target": [[0.3, 9, 9, 9], [0.4, 0, 0, 0]]},
        {"eye": [0, 0, 1e-4], "target": [0.2, 0, 0]},
    ],
    ids=["narrow", "last frame", "close"],
)
def test_barely_visible_sheet(tmp_path: Path, camera: dict[str, Any]) -> None:
    assert not list(drawing_warnings(with_picture(tmp_path, (400, 300), render={"camera": camera})))


@pytest.mark.parametrize(("shaft", "pierces"), [([1, 0, 0.1], False), ([-0.2, 0, 1], True)])
def test_shaft_through_a_curved_sheet(shaft: list[float], pierces: bool, message: Messages) -> None:
    """At the left side of a tube that is seen from inside the normal points to the right."""
    path = {"path": [[0, 0.5, 0.5, 0.01], [1, 0.25, 0.5, 0.01]]}
    for motion in (path, {"at": [0.25, 0.5], "force": -1}):
        made = scene(
            sheet={**SHEET, "size": [0.1, 0.0628], "surface": {"tube": {"radius": 0.01}}},
            probes=[{**motion, "instrument": {"radius": 0.001, "shaft": shaft, "length": 0.005}}],
        )
        warnings = list(drawing_warnings(made))
        assert len(warnings) == pierces
        if pierces:
            message(warnings, "probes.0.instrument", "[1, 0, 0]")
