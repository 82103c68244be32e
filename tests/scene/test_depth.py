"""Errors, notes and lines of `check` about sheets from depth maps, and about pictures by a camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import images
from taichi_msm.accuracy.depth import depth_steps
from taichi_msm.accuracy.surface import describe_surface, surface_notes, surface_record
from taichi_msm.errors import SceneError
from taichi_msm.load.cost import estimate_budget
from taichi_msm.load.scene_file import load_plan, load_scene, schema
from taichi_msm.model.depth import DEPTH_PIXEL_BYTES
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.rest import _rest, rest_of
from taichi_msm.render.notes import drawing_warnings
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import make_plan
from taichi_msm.surfaces.surface import point_surface, positions
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
CALIBRATION = """\
image_width: 96
image_height: 72
camera_matrix: {rows: 3, cols: 3, data: [40, 0, 23.5, 0, 40, 17.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
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
    "no camera": ([(f"render: {{{CAMERA}}}\n", "")], "render.camera"),
    "camera top": ([(CAMERA, "camera: top")], "render.camera"),
    "camera oblique": ([(CAMERA, "cameras: {left: oblique}")], "sheet.surface.depth"),
    "camera fit": ([(CAMERA, "camera: fit"), ("unit: mm", "unit: mm, along: ray")], "render.camera"),
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
    "calibration of another size": (
        [(LENS, "{calibration: camera.yaml}")],
        "scene.yaml:10:19: render.camera.calibration: camera.yaml",
    ),
    "calibration of another folder": (
        [(LENS, "{calibration: ../camera.yaml}")],
        "scene.yaml:10:19: render.camera.calibration: ../camera.yaml",
    ),
    "narrow region": ([("frame.png\n", "frame.png\nregion: [40, 0, 1, 20]\n")], "sheet.surface.depth.file: depth.npy"),
    "region": ([("frame.png\n", "frame.png\nregion: [40, 0, 20, 20]\n")], "region: [40, 0, 20, 20]"),
}  # fmt: skip


@pytest.mark.parametrize("name", KEYS)
def test_invalid_keys(name: str, depth: Path, message: Messages) -> None:
    replacements, place = KEYS[name]
    Path("camera.yaml").write_text(CALIBRATION)
    with message.raises(SceneError, place) as caught:
        load_scene(change(*replacements))
    assert "\n" not in str(caught.value)


def test_calibration_of_the_image(depth: Path) -> None:
    """The calibration is one of the image; `render.size` may be a multiple of its size."""
    Path("camera.yaml").write_text(CALIBRATION.replace("96", str(WIDTH)).replace("72", str(HEIGHT)))
    change((LENS, "{calibration: camera.yaml}"))
    for factor in (1, 2):
        scene = load_scene("scene.yaml", {"render.size": [factor * WIDTH, factor * HEIGHT]})
        assert scene.render.camera.intrinsics.fx == 40  # type: ignore[union-attr]


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


def test_lens_without_a_line_of_sight(depth: Path, message: Messages) -> None:
    """The lens folds back at a radius of 0.91, which it shows at 0.61; the corners are at 0.75."""
    with message.raises(SceneError, "scene.yaml:5:13: sheet.surface.depth.file: depth.npy") as caught:
        load_scene(change(("cy: 17.5}", "cy: 17.5}, distortion: {k1: -0.4}")))
    assert "\n" not in str(caught.value)


def test_mask_counts_for_holes_and_jumps(depth: Path) -> None:
    """Pixels without sheet have no depth; errors and shares are those of the others."""
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:18, 20:34] = 0
    mask[:, :4] = 0
    Image.fromarray(mask).save("mask.png")
    depths = at(np.s_[:17], np.s_[20:34], 20.0)
    depths[:, :4] = np.nan
    depths[0, 4:8] = np.nan
    np.save("depth.npy", depths)
    with pytest.raises(SceneError, match="depth jumps at pixel"):
        load_scene(change(("unit: mm", "unit: mm, smooth: 0")))
    plan = load_plan("scene.yaml", {"sheet.mask": "mask.png", "sheet.fixed": "outline"})
    record = surface_record(plan.scene)
    assert record is not None
    assert record["filled"] == pytest.approx(4 / (36 * 44 - 18 * 14), rel=1e-12)
    # Depths without sheet do not matter.
    depths[:18, 20:34] = 7.0
    np.save("depth.npy", depths)
    again = load_plan("scene.yaml", {"sheet.mask": "mask.png", "sheet.fixed": "outline"})
    np.testing.assert_array_equal(rest_of(again.scene.sheet).position, rest_of(plan.scene.sheet).position)


def lines(*overrides: str) -> list[str]:
    """Notes and lines of `check` about the surface."""
    plan = load_plan("scene.yaml", overrides)
    return [*surface_notes(plan.scene), *describe_surface(plan), *drawing_warnings(plan.scene)]


def counts(scale: float, kind: type[np.unsignedinteger[Any]] = np.uint16) -> NDArray[Any]:
    """The wall in counts of `scale` mm, rounded."""
    return np.rint(wall() / scale).astype(kind)


def test_lines_of_check(depth: Path, message: Messages) -> None:
    message(lines())
    message(lines("sheet.surface.grid=given", "sheet.points=[9, 15]", "sheet.surface.depth.smooth=0"))
    message(lines("sheet.points=[12, 11]"))


def test_notes(depth: Path, message: Messages) -> None:
    holes = wall()
    holes[4:12, 10:30] = np.nan
    np.save("depth.npy", holes)
    message(lines(), "9.3% of the pixels")
    np.save("depth.npy", wall())
    message(next(iter(lines("sheet.surface.depth.unit=m"))), "unit: mm")
    np.save("depth.npy", 100 * wall())
    message(next(iter(lines())), "unit: 1.0e-5")
    np.save("depth.npy", wall(height=12.0))
    message(next(iter(lines("sheet.surface.grid=given", "sheet.surface.depth.smooth=0"))), "grid: even")


STEPS: dict[str, tuple[NDArray[Any], float]] = {
    "8 bits": (counts(0.5, np.uint8), 0.5e-3),
    "16 bits with few values": (257 * counts(0.5), 0.5e-3 / 257),
    # Rounded multiples, whose greatest common divisor is 1, and a hole.
    "rounded": (np.rint(100.3 * np.where(np.arange(WIDTH) < 2, 0, counts(0.5))).astype(np.uint16), 0.5e-3 / 100.3),
    "floats with few values": ((counts(0.5) * 0.5e-3).astype(np.float32), 1.0),
}


@pytest.mark.parametrize("name", STEPS)
def test_depths_in_steps(name: str, depth: Path, message: Messages) -> None:
    """Steps of 0.5 mm where cells are 9 mm wide: over a twentieth."""
    numbers, unit = STEPS[name]
    np.save("depth.npy", numbers)
    plan = load_plan("scene.yaml", {"sheet.surface.depth.unit": unit, "sheet.surface.depth.smooth": 0})
    rest = rest_of(plan.scene.sheet)
    assert isinstance(rest, CurvedRest)
    assert plan.scene.sheet.surface is not None
    steps = depth_steps(plan.scene.sheet.surface, rest)
    assert steps is not None
    assert steps.size == pytest.approx(0.5e-3, rel=0.005)
    message(next(iter(surface_notes(plan.scene))), "depth.smooth: ")
    message(
        next(iter(surface_notes(load_plan("scene.yaml", {"sheet.surface.depth.unit": unit}).scene))), "smoothing by"
    )
    # A pixel is (60 mm / 40 px) wide, and a step becomes a tenth as steep as a pixel is wide.
    assert steps.smooth == pytest.approx(0.5 / (0.1 * 1.5 * np.sqrt(2 * np.pi)), rel=0.1)


@pytest.mark.parametrize("numbers", [wall(), counts(0.002), np.tile(wall()[:1], (HEIGHT, 1))])
def test_depths_without_steps(numbers: NDArray[Any], depth: Path) -> None:
    """Floats, fine counts, and a wall with the same depths in all rows."""
    np.save("depth.npy", numbers)
    unit = 2e-6 if numbers.dtype.kind == "u" else "mm"
    assert not list(surface_notes(load_plan("scene.yaml", {"sheet.surface.depth.unit": unit}).scene))


def test_memory_of_a_map(depth: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """Counted by `check`, and refused before the picture is decoded and before the map is smoothed."""
    plan = load_plan("scene.yaml")
    flat = load_plan("scene.yaml", {"sheet.surface": None, "sheet.size": [0.1, 0.1], "render.camera": "top"})
    added = estimate_budget(plan).simulation_bytes - estimate_budget(flat).simulation_bytes
    assert added > DEPTH_PIXEL_BYTES * WIDTH * HEIGHT
    Image.fromarray(counts(0.002)).save("depth.png")
    monkeypatch.setattr(images, "available_memory", lambda: 20 * WIDTH * HEIGHT - 1)
    for path in ("depth.png", "depth.npy"):
        with message.raises(SceneError, "sheet.surface.depth.file"):
            load_scene("scene.yaml", {"sheet.surface.depth.file": path})


POINTS = """\
{image}sheet:
  surface:
    points: {{file: wall.npy, unit: mm}}{keys}
tissue: {{young: 2.0e+4, thickness: 0.002, density: 1000, foundation: 1.0e+5}}
time: {{duration: 0.04}}
render: {{camera: {{eye: [0, 0, 0.2], target: [0, 0, 0], fov: 40}}}}
output: []
"""


def grid_of_points() -> NDArray[np.float64]:
    """A wavy wall of 9 x 11 points [mm], wider at the right."""
    u, v = np.meshgrid(np.linspace(0, 1, 11) ** 1.5, np.linspace(0, 1, 9))
    return np.stack([80 * u - 40, 30 - 60 * v, 8 * np.sin(3 * u + 2 * v)], axis=-1)


def write_points(keys: str = "", image: str = "image: frame.png\n") -> str:
    np.save("wall.npy", grid_of_points())
    Path("scene.yaml").write_text(POINTS.format(keys=keys, image=image))
    return "scene.yaml"


PICTURE = {
    "unknown camera": ("\n    picture: left", "sheet.surface.picture: left"),
    "no image": ("\n    picture: main", "image: "),
    "a number": ("\n    picture: 3", "sheet.surface.picture: 3"),
}


@pytest.mark.parametrize("name", PICTURE)
def test_invalid_pictures_of_points(name: str, depth: Path, message: Messages) -> None:
    keys, place = PICTURE[name]
    with message.raises(SceneError, place) as caught:
        load_scene(write_points(keys, "" if name == "no image" else "image: frame.png\n"))
    assert "\n" not in str(caught.value)


def test_even_points(depth: Path, message: Messages) -> None:
    """Cells of one aspect in place of narrow ones at the left, on the surface of the file; sides stay sides."""
    given = load_plan(write_points())
    even = load_plan("scene.yaml", {"sheet.surface.grid": "even"})
    rest, before = rest_of(even.scene.sheet), rest_of(given.scene.sheet)
    assert isinstance(rest, CurvedRest)
    assert isinstance(before, CurvedRest)
    assert rest.origin.grid is not None
    on_file = positions(point_surface(grid_of_points() * 1e-3), rest.origin.grid)
    np.testing.assert_allclose(rest.position, on_file, rtol=0, atol=1e-15)
    corners = np.ix_([0, -1], [0, -1])
    np.testing.assert_allclose(rest.position[corners], before.position[corners], rtol=0, atol=1e-15)
    ratios = [each.cells.side_a / each.cells.side_b for each in (rest, before)]
    assert ratios[0].max() / ratios[0].min() < 1.5 < ratios[1].max() / ratios[1].min()
    message([*surface_notes(even.scene), *describe_surface(even)])
    np.save("wall.npy", 0 * grid_of_points())
    with message.raises(SceneError, "sheet.surface.points.file: no even grid"):
        load_plan("scene.yaml", {"sheet.surface.grid": "even"})


def test_schema(depth: Path) -> None:
    """Dumps of scenes with depth and with a picture by a camera satisfy the schema."""
    for _ in range(2):
        jsonschema.validate(load_scene("scene.yaml").model_dump(mode="json", exclude_none=True), schema())
        jsonschema.validate(yaml.safe_load(Path("scene.yaml").read_text()), schema())
        write_points("\n    picture: main\n    grid: even")


def test_least_sizes(depth: Path, message: Messages) -> None:
    """Two mass points a side, of which none is free, and two pixels."""
    for points in ([2, 2], [2, 3]):
        sheet = load_scene("scene.yaml", {"sheet.points": points}).sheet
        corners = rest_of(sheet).position[np.ix_([0, -1], [0, -1])]
        given = rest_of(load_scene("scene.yaml", {"sheet.points": points, "sheet.surface.grid": "given"}).sheet)
        np.testing.assert_allclose(corners, given.position[np.ix_([0, -1], [0, -1])], rtol=0, atol=1e-15)
    load_scene("scene.yaml", {"region": [0, 0, 2, 2]})
    with message.raises(SceneError, "scene.yaml:5:13: sheet.surface.depth.file: depth.npy has 1 x 9 pixels"):
        load_scene("scene.yaml", {"region": [0, 0, 1, 9]})


def test_depth_without_an_end(depth: Path, message: Messages) -> None:
    """A map whose inverse depth falls to the right, where a quarter of it is missing."""
    inverse = np.tile(np.linspace(1, 0.1, WIDTH), (HEIGHT, 1))
    np.save("depth.npy", np.where(np.arange(WIDTH) < 40, 20 / (inverse - 0.2), np.nan))
    with message.raises(SceneError, "scene.yaml:5:13: sheet.surface.depth.file: depth.npy"):
        load_scene("scene.yaml")


def test_memory_for_smoothing(depth: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr(images, "available_memory", lambda: DEPTH_PIXEL_BYTES * WIDTH * HEIGHT - 1)
    _rest.cache_clear()
    with message.raises(SceneError, "scene.yaml:5:13: sheet.surface.depth.file: depth.npy", hide=r"0\.\d+ MiB"):
        load_scene("scene.yaml")


def test_scene_of_a_missing_image(depth: Path, message: Messages) -> None:
    """A scene is valid without its files, as in another folder, but cannot be planned."""
    made = load_scene("scene.yaml")
    Path("frame.png").unlink()
    with message.raises(SceneError, "sheet.surface.depth.file"):
        make_plan(Scene(**made.model_dump()))
    Image.new("RGB", (WIDTH, HEIGHT)).save("frame.png")
    assert make_plan(Scene(**made.model_dump())).scene == made


def test_kinds_of_files(depth: Path) -> None:
    """Floats in an archive, as third numbers of points and in a TIFF, and counts in a PNG: the same sheet."""
    depths = wall().astype(np.float32)
    np.savez("depth.npz", other=np.zeros(3), depth=depths)
    np.save("points.npy", np.stack([0 * depths, 0 * depths, depths], axis=-1))
    Image.fromarray(depths).save("depth.tiff")
    Image.fromarray(counts(0.002)).save("depth.png")
    np.save("depth.npy", depths)
    expected = rest_of(load_scene("scene.yaml").sheet).position
    for name in ("depth.npz", "points.npy", "depth.tiff"):
        same = load_scene("scene.yaml", {"sheet.surface.depth.file": name})
        np.testing.assert_array_equal(rest_of(same.sheet).position, expected)
    rounded = load_scene("scene.yaml", {"sheet.surface.depth": {"file": "depth.png", "unit": 2e-6}})
    # Half a count, and up to as much to the side, where an even grid follows the surface.
    np.testing.assert_allclose(rest_of(rounded.sheet).position, expected, rtol=0, atol=4e-6)
