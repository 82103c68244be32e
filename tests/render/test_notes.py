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
from tests.scenes import PRESS, SHEET, scene


def carrying(tmp_path: Path, size: tuple[int, int], **changes: Any) -> Scene:
    """Make a scene whose sheet, 0.4 m wide and 0.3 m high, carries a picture of a size."""
    Image.new("RGB", size).save(tmp_path / "picture.png")
    return scene(image=str(tmp_path / "picture.png"), sheet={**SHEET, "size": [0.3, 0.4]}, output=["png"], **changes)


def test_a_sheet_in_millimetres_is_asked_about() -> None:
    notes = drawing_warnings(scene(sheet={**SHEET, "size": [75, 100]}))
    assert "sheet.size: 75 x 100 m is large for tissue; if these are millimetres, take [0.075, 0.1]" in notes
    assert not any("sheet.size" in note for note in drawing_warnings(scene(sheet={**SHEET, "size": [0.075, 5]})))


@pytest.mark.parametrize(
    ("instrument", "said"),
    [
        ({"radius": 0.01, "shaft": [0, 0.3, -1], "length": 0.1}, "probes.0.instrument: its shaft points down"),
        ({"radius": 4, "shaft": [0, 0, 1], "length": 9}, "probes.0.instrument: 4 m is a wide rod for a sheet of 0.4 m"),
    ],
)
def test_instruments_that_can_hardly_be_meant(instrument: dict[str, Any], said: str) -> None:
    (note,) = drawing_warnings(scene(probes=[{**PRESS, "instrument": instrument}]))
    assert note.startswith(said)


@pytest.mark.parametrize(
    ("size", "sheet", "part"),
    [
        ((300, 600), "0.4,0.2", "0,187,300,225"),
        ((800, 300), "0.15,0.4", "200,0,400,300"),
        ((90, 90), "0.4,0.4", "0,11,90,68"),
    ],
)
def test_a_stretched_picture_and_two_ways_out(tmp_path: Path, size: tuple[int, int], sheet: str, part: str) -> None:
    (note,) = drawing_warnings(carrying(tmp_path, size))
    width, height = size
    assert note == (
        f"the picture of {width} x {height} pixels is stretched onto a sheet 0.4 m wide and 0.3 m high; "
        f'--set "sheet.size=[{sheet}]" makes the sheet like the picture, '
        f'--set "region=[{part}]" cuts a part like the sheet'
    )
    like_picture = {**SHEET, "size": [float(side) for side in sheet.split(",")]}
    assert not list(drawing_warnings(scene(image=str(tmp_path / "picture.png"), sheet=like_picture, output=["png"])))
    assert not list(drawing_warnings(carrying(tmp_path, size, region=[int(number) for number in part.split(",")])))


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


def test_the_part_is_within_the_region(tmp_path: Path) -> None:
    (note,) = drawing_warnings(carrying(tmp_path, (800, 600), region=[100, 50, 600, 300]))
    assert note.endswith('--set "region=[200,50,400,300]" cuts a part like the sheet')


@pytest.mark.parametrize(("size", "cuts"), [((3, 4000), False), ((5, 5), False), ((20, 12), True)])
def test_a_small_picture_may_have_no_such_part(tmp_path: Path, size: tuple[int, int], cuts: bool) -> None:
    """Of 3 or of 5 columns, no whole number of rows has the proportions 4 : 3; of 12 rows, 16 columns have."""
    (note,) = drawing_warnings(carrying(tmp_path, size))
    assert note.endswith("cuts a part like the sheet") == cuts
    assert cuts or note.endswith("makes the sheet like the picture")


@pytest.mark.parametrize("size", [(400, 300), (407, 300), (393, 300), (64, 48)])
def test_a_picture_like_the_sheet(tmp_path: Path, size: tuple[int, int]) -> None:
    assert not list(drawing_warnings(carrying(tmp_path, size)))


@pytest.mark.parametrize("size", [(409, 300), (392, 300)])
def test_a_picture_a_little_unlike_the_sheet(tmp_path: Path, size: tuple[int, int]) -> None:
    assert list(drawing_warnings(carrying(tmp_path, size)))


@pytest.mark.parametrize("shading", ["none", "headlight"])
def test_a_light_without_tissue(tmp_path: Path, shading: str) -> None:
    (note,) = drawing_warnings(carrying(tmp_path, (400, 300), render={"light": {"gloss": 0.1}, "shading": shading}))
    assert note == f"render.light has no effect with shading: {shading}; take render.shading: tissue"
    assert not list(
        drawing_warnings(carrying(tmp_path, (400, 300), render={"light": {"gloss": 0.1}, "shading": "tissue"}))
    )


@pytest.mark.parametrize(("alpha", "seen"), [(254, True), (255, False)])
def test_a_picture_that_is_see_through(tmp_path: Path, alpha: int, seen: bool) -> None:
    made = carrying(tmp_path, (400, 300), render={"background": [9, 8, 7]})
    picture = Image.new("RGBA", (400, 300), (200, 100, 50, 255))
    picture.putpixel((399, 299), (200, 100, 50, alpha))
    picture.save(tmp_path / "picture.png")
    said = ["the picture is see-through in parts, which show render.background: [9, 8, 7]"]
    assert list(drawing_warnings(made)) == (said if seen else [])


def test_a_palette_with_a_transparent_colour_is_see_through(tmp_path: Path) -> None:
    made = carrying(tmp_path, (400, 300))
    Image.new("P", (400, 300)).save(tmp_path / "picture.png", transparency=0)
    (note,) = drawing_warnings(made)
    assert note.startswith("the picture is see-through")


def test_without_pictures_there_is_nothing_to_stretch(tmp_path: Path) -> None:
    made = carrying(tmp_path, (10, 300))
    assert not list(drawing_warnings(made.model_copy(update={"output": ("trajectory",)})))


def test_check_and_run_say_it(tmp_path: Path, program: Program) -> None:
    Image.new("RGB", (128, 48)).save(tmp_path / "wide.png")
    (tmp_path / "scene.yaml").write_text(
        "image: wide.png\nsheet: {points: [5, 5], size: [0.1, 0.1], mass: 1e-3}\nsprings: {structural: 1}\n"
        "time: {duration: 0.04}\nrender: {size: [16, 16]}\noutput: [gif]\n"
    )
    said = "the picture of 128 x 48 pixels is stretched onto a sheet 0.1 m wide and 0.1 m high; --set "
    assert said in program("check", str(tmp_path / "scene.yaml")).stdout
    (note,) = json.loads(program("check", str(tmp_path / "scene.yaml"), "--json").stdout)["notes"]
    assert note.startswith(said)
    assert said in program("run", str(tmp_path / "scene.yaml"), "--out", str(tmp_path / "out")).stdout


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
            "intrinsics": {"fx": 15, "fy": 15, "cx": 2000, "cy": 256},
            "distortion": {"model": "fisheye"},
            "outside": "background",
        },
    ],
    ids=["beside in millimetres", "millimetres", "upward", "moving", "lens", "beyond the lens"],
)
def test_a_camera_that_shows_nothing(tmp_path: Path, camera: dict[str, Any]) -> None:
    said = "shows nothing of the sheet at rest, or only a dot, in all frames; lengths are in metres"
    (note,) = drawing_warnings(carrying(tmp_path, (400, 300), render={"camera": camera}))
    assert note == f"render.camera {said}"
    cameras = {"left": "top", "right": camera}
    (note,) = drawing_warnings(carrying(tmp_path, (400, 300), render={"cameras": cameras}))
    assert note == f"render.cameras.right {said}"
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
