"""The mask of a sheet: its key, its file, and the outline that it leaves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taichi_msm.errors import SceneError
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import fixed_points
from tests.golden import Messages

SCENE = """\
sheet:
  points: [5, 7]
  size: [0.04, 0.06]
  {sheet}
tissue: {{young: 3.0e+4, thickness: 0.002, density: 1000{tissue}}}
time: {{duration: 0.1, frames_per_second: 10}}
output: []
"""


@pytest.fixture(autouse=True)
def cwd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def write_scene(sheet: str, tissue: str = "") -> None:
    Path("s.yaml").write_text(SCENE.format(sheet=sheet, tissue=tissue))


def write_mask(cells: list[str]) -> None:
    """Write mask.png with one pixel per cell; # is white."""
    Image.fromarray(np.array([[255 * (pixel == "#") for pixel in row] for row in cells], np.uint8)).save("mask.png")


FAULTS = {
    "empty path": ('mask: ""', [], "s.yaml:4:3: sheet.mask:"),
    "no path": ("mask: {invert: true}", [], "s.yaml:4:3: sheet.mask.image:"),
    "missing file": ("mask: m.png", [], "s.yaml:4:3: sheet.mask: m.png:"),
    "no white pixel": ("mask: mask.png", ["......"] * 4, "s.yaml:4:3: sheet.mask:"),
    "no black pixel": ("mask: {image: mask.png, invert: true}", ["######"] * 4, "s.yaml:4:3: sheet.mask:"),
    "parts that meet in a point": (
        "mask: mask.png",
        ["###...", "###...", "...###", "...###"],
        "s.yaml:4:3: sheet.mask: two parts meet only in the point at row 2, column 3",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_errors_have_the_place(name: str, message: Messages) -> None:
    sheet, cells, place = FAULTS[name]
    if cells:
        write_mask(cells)
    write_scene(sheet)
    with message.raises(SceneError, place):
        load_scene("s.yaml")


def test_mask_needs_tissue(message: Messages) -> None:
    write_mask(["######"] * 4)
    write_scene("mask: mask.png")
    with message.raises(SceneError, "sheet.mask:"):
        load_scene("s.yaml", ["tissue=", "springs={structural: 1}", "sheet.mass=1"])


@pytest.mark.parametrize("key", ["pretension: 1", "bending: 1.0e-5"])
def test_tension_and_bending_need_the_outline(key: str, message: Messages) -> None:
    write_mask(["######", "##..##", "######", "######"])
    write_scene("mask: mask.png", f", {key}")
    with message.raises(SceneError, "set sheet.fixed: outline"):
        load_scene("s.yaml")
    assert load_scene("s.yaml", ["sheet.fixed=outline"]).sheet.fixed == "outline"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_white_from_the_middle_of_the_range(dtype: type, cwd: Path) -> None:
    largest = np.iinfo(dtype).max
    Image.fromarray(np.array([[0, largest // 2, largest // 2 + 1, largest]] * 4, dtype)).save("mask.png")
    write_scene("mask: mask.png")
    mask = rest_of(load_scene("s.yaml").sheet).mask
    assert mask is not None
    # Columns of cells at 1/12, 3/12, ... of the width, and four columns of pixels.
    np.testing.assert_array_equal(mask.cells, [[False, False, False, True, True, True]] * 4)


def test_outline_is_fixed() -> None:
    write_mask(["######", "###.##", "######", "######"])
    write_scene("mask: mask.png")
    inner = np.zeros((5, 7), bool)
    inner[1:-1, 1:-1] = True
    np.testing.assert_array_equal(fixed_points(load_scene("s.yaml").sheet), ~inner)
    inner[1:3, 3:5] = False
    for fixed in ("outline", "[left, outline]"):
        np.testing.assert_array_equal(fixed_points(load_scene("s.yaml", [f"sheet.fixed={fixed}"]).sheet), ~inner)
    without = load_scene("s.yaml", ["sheet.mask=", "sheet.fixed=outline"]).sheet
    np.testing.assert_array_equal(fixed_points(without), fixed_points(load_scene("s.yaml", ["sheet.mask="]).sheet))
