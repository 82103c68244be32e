"""Warnings about a scene that will not look as intended."""

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


def carrying(tmp_path: Path, size: tuple[int, int], **changes: Any) -> Scene:
    """Make a scene whose sheet, 0.4 m wide and 0.3 m high, carries a picture of a size."""
    Image.new("RGB", size).save(tmp_path / "picture.png")
    return scene(image=str(tmp_path / "picture.png"), sheet={**SHEET, "size": [0.3, 0.4]}, output=["png"], **changes)


def test_a_sheet_in_millimetres_is_asked_about(message: Messages) -> None:
    message(drawing_warnings(scene(sheet={**SHEET, "size": [75, 100]})), "sheet.size", "[0.075, 0.1]")
    assert not any("sheet.size" in note for note in drawing_warnings(scene(sheet={**SHEET, "size": [0.075, 5]})))


@pytest.mark.parametrize(
    "instrument",
    [{"radius": 0.01, "shaft": [0, 0.3, -1], "length": 0.1}, {"radius": 4, "shaft": [0, 0, 1], "length": 9}],
    ids=["down", "wide"],
)
def test_instruments_that_can_hardly_be_meant(instrument: dict[str, Any], message: Messages) -> None:
    (note,) = drawing_warnings(scene(probes=[{**PRESS, "instrument": instrument}]))
    message(note, "probes.0.instrument")


@pytest.mark.parametrize(
    ("size", "sheet", "part"),
    [
        ((300, 600), "0.4,0.2", "0,187,300,225"),
        ((800, 300), "0.15,0.4", "200,0,400,300"),
        ((90, 90), "0.4,0.4", "0,11,90,68"),
    ],
)
def test_a_stretched_picture_and_two_ways_out(
    tmp_path: Path, size: tuple[int, int], sheet: str, part: str, message: Messages
) -> None:
    (note,) = drawing_warnings(carrying(tmp_path, size))
    message(note, f'--set "sheet.size=[{sheet}]"', f'--set "region=[{part}]"')
    like_picture = {**SHEET, "size": [float(side) for side in sheet.split(",")]}
    assert not list(drawing_warnings(scene(image=str(tmp_path / "picture.png"), sheet=like_picture, output=["png"])))
    assert not list(drawing_warnings(carrying(tmp_path, size, region=[int(number) for number in part.split(",")])))
    # The part is within the region.
    (note,) = drawing_warnings(carrying(tmp_path, (800, 600), region=[100, 50, 600, 300]))
    assert '--set "region=[200,50,400,300]"' in note


@pytest.mark.parametrize("size", [(900, 500), (300, 700)])
def test_tissue_like_the_picture_has_square_cells(tmp_path: Path, size: tuple[int, int], root: Path) -> None:
    Image.new("RGB", size).save(tmp_path / "picture.png")
    press = ["image=picture.png", "probes.0.instrument=null"]
    (tmp_path / "press.yaml").write_text((root / "scenes/press.yaml").read_text())
    (note,) = drawing_warnings(load_scene(tmp_path / "press.yaml", press))
    settings = re.findall(r'--set "(sheet[^"]+)"', note)
    assert [setting.partition("=")[0] for setting in settings] == ["sheet.size", "sheet.points"]
    made = load_scene(tmp_path / "press.yaml", [*press, *settings])
    assert not list(drawing_warnings(made))
    down, across = spacing(made.sheet)
    assert down == pytest.approx(across, rel=0.02)


@pytest.mark.parametrize(("size", "cuts"), [((3, 4000), False), ((5, 5), False), ((20, 12), True)])
def test_a_small_picture_may_have_no_such_part(tmp_path: Path, size: tuple[int, int], cuts: bool) -> None:
    """Of 3 or of 5 columns, no whole number of rows has the proportions 4 : 3; of 12 rows, 16 columns have."""
    (note,) = drawing_warnings(carrying(tmp_path, size))
    assert "sheet.size" in note
    assert ("region" in note) == cuts


@pytest.mark.parametrize(
    ("size", "like"),
    [*(((width, 300), True) for width in (400, 407, 393)), ((64, 48), True), ((409, 300), False), ((392, 300), False)],
)
def test_a_picture_may_be_a_little_unlike_the_sheet(tmp_path: Path, size: tuple[int, int], like: bool) -> None:
    assert (not list(drawing_warnings(carrying(tmp_path, size)))) == like


@pytest.mark.parametrize("shading", ["none", "headlight"])
def test_a_light_without_tissue(tmp_path: Path, shading: str, message: Messages) -> None:
    render = {"light": {"gloss": 0.1}}
    (note,) = drawing_warnings(carrying(tmp_path, (400, 300), render={**render, "shading": shading}))
    message(note, "render.light", shading)
    assert not list(drawing_warnings(carrying(tmp_path, (400, 300), render={**render, "shading": "tissue"})))


def test_a_picture_that_is_see_through(tmp_path: Path, message: Messages) -> None:
    made = carrying(tmp_path, (400, 300), render={"background": [9, 8, 7]})
    picture = Image.new("RGBA", (400, 300), (200, 100, 50, 255))
    picture.save(tmp_path / "picture.png")
    assert not list(drawing_warnings(made))
    picture.putpixel((399, 299), (200, 100, 50, 254))
    picture.save(tmp_path / "picture.png")
    message(drawing_warnings(made), "render.background: [9, 8, 7]")
    # A palette with a transparent colour.
    Image.new("P", (400, 300)).save(tmp_path / "picture.png", transparency=0)
    message(drawing_warnings(made), "render.background")


def test_without_pictures_there_is_nothing_to_stretch(tmp_path: Path) -> None:
    made = carrying(tmp_path, (10, 300))
    assert not list(drawing_warnings(made.model_copy(update={"output": ("trajectory",)})))


def test_check_and_run_print_the_notes(tmp_path: Path, program: Program) -> None:
    Image.new("RGB", (128, 48)).save(tmp_path / "wide.png")
    (tmp_path / "scene.yaml").write_text(
        "image: wide.png\nsheet: {points: [5, 5], size: [0.1, 0.1], mass: 1e-3}\nsprings: {structural: 1}\n"
        "time: {duration: 0.04}\nrender: {size: [16, 16]}\noutput: [gif]\n"
    )
    (note,) = json.loads(program("check", str(tmp_path / "scene.yaml"), "--json").stdout)["notes"]
    assert "128 x 48" in note
    assert note in program("check", str(tmp_path / "scene.yaml")).stdout
    assert note in program("run", str(tmp_path / "scene.yaml"), "--out", str(tmp_path / "out")).stdout


@pytest.mark.parametrize(
    "camera",
    [
        {"pose": {"rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "translation": [0, 300, 400]}},
        {"eye": [0, -30, 400]},
        {"eye": [0, 0, 0.4], "target": [0, 0, 1]},
        {"eye": [[0, 0, 0.1, 0.3], [1, 0.1, 0, 0.4]], "target": [3, 0, 0.4]},
        {
            "eye": [0.6, 0, 0.4],
            "target": [0.6, 0, 0],
            "intrinsics": {"fx": 900, "fy": 900, "cx": 256, "cy": 256},
            "distortion": {"k1": -0.1},
        },
        {
            "eye": [0, 0, 0.4],
            "intrinsics": {"fx": 26, "fy": 26, "cx": 2000, "cy": 256},
            "distortion": {"model": "fisheye"},
            "outside": "background",
        },
    ],
    ids=["pose in millimetres", "millimetres", "upward", "moving", "lens", "beyond the lens"],
)
def test_a_camera_that_shows_nothing(tmp_path: Path, camera: dict[str, Any], message: Messages) -> None:
    (note,) = drawing_warnings(carrying(tmp_path, (400, 300), render={"camera": camera}))
    message(note, "render.camera ")
    cameras = {"left": "top", "right": camera}
    (note,) = drawing_warnings(carrying(tmp_path, (400, 300), render={"cameras": cameras}))
    message(note, "render.cameras.right ")
    blind = carrying(tmp_path, (400, 300), render={"camera": camera}).model_copy(update={"output": ("trajectory",)})
    assert not list(drawing_warnings(blind))


@pytest.mark.parametrize(
    "camera",
    [
        {"eye": [0.013, 0.017, 0.4], "target": [0.013, 0.017, 0], "fov": 0.01},
        {"eye": [[0, 9, 9, 1], [0.3, 9, 9, 1], [0.4, 0, 0, 1]], "target": [[0.3, 9, 9, 9], [0.4, 0, 0, 0]]},
        {"eye": [0, 0, 1e-4], "target": [0.2, 0, 0]},
    ],
    ids=["narrow", "at last", "close"],
)
def test_a_camera_that_shows_little_is_enough(tmp_path: Path, camera: dict[str, Any]) -> None:
    assert not list(drawing_warnings(carrying(tmp_path, (400, 300), render={"camera": camera})))
