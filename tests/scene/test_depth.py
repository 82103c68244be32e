"""Errors, notes and lines of `check` about sheets from depth maps, and about pictures by a camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import SceneError
from taichi_msm.load.scene_file import load_scene
from tests.depths import HEIGHT, WIDTH, wall, write_depth_scene
from tests.golden import Messages


@pytest.fixture
def depth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with scene.yaml, its picture and its depth map."""
    write_depth_scene(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def change(*replacements: tuple[str, str]) -> str:
    """Replace texts in scene.yaml."""
    text = Path("scene.yaml").read_text()
    for old, new in replacements:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    Path("scene.yaml").write_text(text)
    return "scene.yaml"


DEPTH = "depth: {file: depth.npy, unit: mm}"
LENS = "{intrinsics: {fx: 40, fy: 40, cx: 23.5, cy: 17.5}}"
CAMERA = f"camera: {LENS}"
SIZE = ("[9, 11]", "[9, 11]\n  size: [1, 1]")
KEYS: dict[str, tuple[list[tuple[str, str]], str]] = {
    "no unit": ([("depth.npy, unit: mm", "depth.npy")], "scene.yaml:5:5: sheet.surface.depth.unit: missing"),
    "unknown unit": ([("unit: mm", "unit: inch")], "scene.yaml:5:30: sheet.surface.depth.unit:"),
    "no points": ([("  points: [9, 11]\n", "")], "sheet.points: missing"),
    "a size": ([("[9, 11]\n", "[9, 11]\n  size: [1, 1]\n")], "scene.yaml:4:3: sheet.size:"),
    "no image": ([("image: frame.png\n", "")], "sheet.surface.depth"),
    "missing image": ([("frame.png", "missing.png")], "scene.yaml:1:1: image: missing.png"),
    "unreadable image": ([("frame.png", "scene.yaml")], "scene.yaml:1:1: image: scene.yaml"),
    "missing file": ([("depth.npy", "missing.npy")], "scene.yaml:5:13: sheet.surface.depth.file: missing.npy"),
    "file of another folder": ([("depth.npy", "../depth.npy")], "scene.yaml:5:13: sheet.surface.depth.file:"),
    "no camera": ([(f"render: {{{CAMERA}}}\n", "")], "sheet.surface.depth"),
    "camera top": ([(CAMERA, "camera: top")], "sheet.surface.depth"),
    "camera oblique": ([(CAMERA, "cameras: {left: oblique}")], "sheet.surface.depth"),
    "camera fit": ([(CAMERA, "camera: fit"), ("unit: mm", "unit: mm, along: ray")], "sheet.surface.depth"),
    "camera without a lens": ([(LENS, "{eye: [0, 0, 1], target: [0, 0, 0]}")], "sheet.surface.depth"),
    "camera at the origin without a lens": ([(LENS, "{}")], "sheet.surface.depth"),
    "camera without a target": ([(LENS, "{eye: [0, 0, 1], fov: 40}")], "sheet.surface.depth"),
    "another camera": (
        [("unit: mm", "unit: mm, camera: right"), (CAMERA, f"cameras: {{left: {LENS}}}")],
        "scene.yaml:5:40: sheet.surface.depth.camera: right",
    ),
    "name of an unnamed camera": ([("unit: mm", "unit: mm, camera: left")], "sheet.surface.depth.camera: left"),
    "second camera without a pose": (
        [(CAMERA, f"cameras: {{left: {LENS}, right: {LENS}}}")],
        "render.cameras.right.eye: missing",
    ),
    "aspect of pictures": ([("render: {", "render: {size: [48, 48], ")], "render.size: 48 x 48"),
    "bending": ([("damping: 30", "damping: 30, bending: plate")], "tissue.bending:"),
    "picture": ([(DEPTH, f"{DEPTH}\n    picture: left")], "scene.yaml:6:5: sheet.surface.picture:"),
    "picture of a dome": (
        [(DEPTH, "dome: {radius: 2}\n    picture: main"), SIZE, (CAMERA, "camera: top")],
        "scene.yaml:7:5: sheet.surface.picture:",
    ),
    "camera at the origin without a depth map": ([(DEPTH, "dome: {radius: 2}"), SIZE], "render.camera.eye: missing"),
    "grid of a tube": (
        [(DEPTH, "tube: {radius: 2}\n    grid: even"), SIZE, (CAMERA, "camera: top")],
        "scene.yaml:7:5: sheet.surface.grid:",
    ),
    "grid": ([(DEPTH, f"{DEPTH}\n    grid: uneven")], "scene.yaml:6:5: sheet.surface.grid:"),
    "smooth": ([("unit: mm", "unit: mm, smooth: -1")], "sheet.surface.depth.smooth:"),
    "along": ([("unit: mm", "unit: mm, along: z")], "sheet.surface.depth.along:"),
    "region": ([("frame.png\n", "frame.png\nregion: [40, 0, 20, 20]\n")], "region: [40, 0, 20, 20]"),
}  # fmt: skip


@pytest.mark.parametrize("name", KEYS)
def test_invalid_keys(name: str, depth: Path, message: Messages) -> None:
    replacements, place = KEYS[name]
    with message.raises(SceneError, place) as caught:
        load_scene(change(*replacements))
    assert "\n" not in str(caught.value)


def at(row: slice, column: slice, value: float) -> NDArray[Any]:
    """The wall with another depth in a rectangle."""
    changed = wall()
    changed[row, column] = value
    return changed


FAULTY: dict[str, NDArray[Any]] = {
    "another size": wall()[:, :-1],
    "another size with holes": np.full((HEIGHT, WIDTH - 1), np.nan),
    "holes": at(np.s_[:], np.s_[:13], np.nan),
    "holes and a jump": np.where(at(np.s_[:], np.s_[:13], np.nan) > 62, 5.0, at(np.s_[:], np.s_[:13], np.nan)),
    "no depth": np.zeros((HEIGHT, WIDTH)),
    "jump": at(np.s_[10:28], np.s_[20:34], 20.0),
    "text": np.array([["a"]]),
    "four channels": np.zeros((HEIGHT, WIDTH, 4)),
}


@pytest.mark.parametrize("name", FAULTY)
def test_unusable_maps(name: str, depth: Path, message: Messages) -> None:
    np.save("depth.npy", FAULTY[name])
    with message.raises(SceneError, "scene.yaml:5:13: sheet.surface.depth.file: depth.npy") as caught:
        load_scene(change(("unit: mm", "unit: mm, smooth: 0")))
    assert "\n" not in str(caught.value)


def save_rgb(path: str) -> None:
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(path)


PICTURES: dict[str, tuple[str, Callable[[str], object]]] = {
    "colours": ("depth.png", save_rgb),
    "points": ("depth.tiff", lambda path: cv2.imwrite(path, np.ones((HEIGHT, WIDTH, 3), np.float32))),
    "text": ("depth.png", lambda path: Path(path).write_text("no picture")),
}


@pytest.mark.parametrize("name", PICTURES)
def test_unusable_pictures(name: str, depth: Path, message: Messages) -> None:
    path, save = PICTURES[name]
    save(path)
    with message.raises(SceneError, f"scene.yaml:5:13: sheet.surface.depth.file: {path}"):
        load_scene(change(("depth.npy", path)))
