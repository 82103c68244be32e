"""Errors, notes and lines of `check` about sheets that are curved at rest."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import array_files, images
from taichi_msm.accuracy.surface import describe_surface, surface_notes, surface_record
from taichi_msm.errors import SceneError
from taichi_msm.load.cost import estimate_budget
from taichi_msm.load.scene_file import load_plan, load_scene, schema
from taichi_msm.model.tool_force import force_warnings, probe_records
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from tests.golden import Messages

SCENE = """\
sheet:
  {sheet}
  surface:
    {surface}
tissue: {{young: 2.0e+4, thickness: 0.002, density: 1000, {tissue}}}
time: {{duration: 0.04}}
output: []
"""
FLAT = "points: [9, 11]\n  size: [0.08, 0.1]"


def flat_points() -> NDArray[np.float64]:
    """A flat grid of 9 x 11 points, 80 x 100 mm, shape (9, 11, 3) [mm]."""
    u, v = np.meshgrid(np.linspace(0, 1, 11), np.linspace(0, 1, 9))
    return np.stack([100 * u, -80 * v, 0 * u], axis=-1)


def changed(*changes: tuple[Any, float]) -> NDArray[np.float64]:
    """The flat grid with numbers added at indices."""
    points = flat_points()
    for at, value in changes:
        points[at] += value
    return points


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Write the scene s.yaml with a surface into the current directory."""
    monkeypatch.chdir(tmp_path)

    def write(surface: str, sheet: str | None = None, tissue: str = "foundation: 1.0e+5") -> Path:
        sheet = sheet or ("fixed: border" if surface.startswith("{points") else FLAT)
        Path("s.yaml").write_text(SCENE.format(surface=surface, sheet=sheet, tissue=tissue))
        return Path("s.yaml")

    return write


KEYS = {
    "no kind": ("{}", "s.yaml:4:3: sheet.surface:"),
    "two kinds": ("{tube: {radius: 0.05}, dome: {radius: 0.2}}", "s.yaml:5:28: sheet.surface.dome:"),
    "tube without a radius": ("{tube: {radius: 0}}", "s.yaml:5:13: sheet.surface.tube.radius:"),
    "dome without a radius": ("{dome: {radius: 0}}", "s.yaml:5:13: sheet.surface.dome.radius:"),
    "narrow tube": ("{tube: {radius: 0.01}}", "s.yaml:5:13: sheet.surface.tube.radius:"),
    "narrow tube from outside": ("{tube: {radius: -0.01}}", "s.yaml:5:13: sheet.surface.tube.radius:"),
    "small dome": ("{dome: {radius: 0.06}}", "s.yaml:5:13: sheet.surface.dome.radius:"),
    "deep folds": (
        "{tube: {radius: 0.05, folds: {depth: 0.05, spacing: 0.02}}}",
        "s.yaml:5:35: sheet.surface.tube.folds.depth:",
    ),
    "array without a unit": ("{height: {file: z.npy}}", "s.yaml:5:6: sheet.surface.height.unit: missing"),
    "array with a range": (
        "{height: {file: z.npy, unit: mm, range: [0, 1]}}",
        "s.yaml:5:38: sheet.surface.height.range:",
    ),
    "picture without a range": ("{height: {file: z.png}}", "s.yaml:5:6: sheet.surface.height.range: missing"),
    "picture with a unit": (
        "{height: {file: z.png, range: [0, 1], unit: mm}}",
        "s.yaml:5:43: sheet.surface.height.unit:",
    ),
    "points without a unit": ("{points: {file: p.npy}}", "s.yaml:4:6: sheet.surface.points.unit: missing"),
    "another unit": ("{points: {file: p.npy, unit: cm}}", "s.yaml:4:28: sheet.surface.points.unit:"),
    "file of another folder": ("{points: {file: ../p.npy, unit: mm}}", "s.yaml:4:15: sheet.surface.points.file:"),
}


@pytest.mark.parametrize("name", KEYS)
def test_invalid_keys(name: str, write: Callable[..., Path], message: Messages) -> None:
    surface, place = KEYS[name]
    with message.raises(SceneError, place):
        load_scene(write(surface))


def test_size_of_points(write: Callable[..., Path], message: Messages) -> None:
    np.save("p.npy", flat_points())
    with message.raises(SceneError, "s.yaml:3:3: sheet.size:"):
        load_scene(write("{points: {file: p.npy, unit: mm}}", FLAT))


def test_bending(write: Callable[..., Path], message: Messages) -> None:
    with message.raises(SceneError, "tissue.bending:", "foundation"):
        load_scene(write("{dome: {radius: 0.2}}", tissue="bending: plate"))


@pytest.mark.parametrize("kind", ["tube", "dome"])
def test_remedies_for_radii_suffice(kind: str) -> None:
    """The suggested radius, rounded to four digits, is valid, whatever the width."""
    for width in np.linspace(0.1, 0.2, 50).tolist():
        with pytest.raises(SceneError) as caught:
            Sheet(points=(9, 11), size=(0.08, width), surface={kind: {"radius": -0.001}})
        radius = float(str(caught.value).partition("at most ")[2].partition(" m")[0])
        Sheet(points=(9, 11), size=(0.08, width), surface={kind: {"radius": radius}})


def to_bytes(save: Callable[[Any], None]) -> bytes:
    file = io.BytesIO()
    save(file)
    return file.getvalue()


def header(shape: tuple[int, ...]) -> bytes:
    """The header of an .npy file, without numbers."""
    content = {"descr": "<f8", "fortran_order": False, "shape": shape}
    return to_bytes(lambda file: np.lib.format.write_array_header_1_0(file, content))


def bomb() -> bytes:
    """An .npz file of a kilobyte per megabyte."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("points.npy", "w") as member:
        member.write(header((3000, 3000, 3)))
        for _ in range(207):
            member.write(bytes(1 << 20))
    return file.getvalue()


ARCHIVE = to_bytes(lambda file: np.savez_compressed(file, points=flat_points()))
FILES: dict[str, bytes | NDArray[Any]] = {
    "text": b"x y z\n1 2 3\n",
    "empty": b"",
    "truncated": ARCHIVE[: len(ARCHIVE) // 2],
    "damaged": ARCHIVE[:90] + b"xxxx" + ARCHIVE[94:],
    "pickled": to_bytes(lambda file: np.save(file, np.array([{}]), allow_pickle=True)),
    "missing numbers": header((5, 5, 3)) + bytes(16),
    "larger than the memory": header((10**6, 10**6, 3)) + bytes(16),
    "two arrays": to_bytes(lambda file: np.savez(file, x=flat_points(), y=flat_points())),
    "no array": to_bytes(lambda file: np.savez(file)),
    "texts": np.array(["1", "2"]),
    "pairs": flat_points()[..., :2],
    "one row": flat_points()[:1],
    "a dimension more": flat_points()[None],
    "not a number": changed((np.s_[2, 3, 1], np.nan)),
    "infinite": changed((np.s_[0, 0, 2], np.inf)),
    "astronomic": flat_points() * 1e300,
    "too many": np.zeros((5000, 2, 3), np.float32),
}


@pytest.mark.parametrize("name", FILES)
def test_unusable_points(name: str, write: Callable[..., Path], message: Messages) -> None:
    content = FILES[name]
    Path("p.npy").write_bytes(content if isinstance(content, bytes) else to_bytes(lambda file: np.save(file, content)))
    with message.raises(SceneError, "s.yaml:4:15: sheet.surface.points.file: p.npy"):
        load_scene(write("{points: {file: p.npy, unit: mm}}"))


@pytest.mark.parametrize("points", ["", "points: [9, 11]"])
def test_missing_files(points: str, write: Callable[..., Path]) -> None:
    """The error is at the file, whether or not the number of mass points depends on it."""
    with pytest.raises(SceneError, match=r"^s\.yaml:4:15: sheet\.surface\.points\.file: p\.npz: no such file .*$"):
        load_scene(write("{points: {file: p.npz, unit: mm}}", points))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
@pytest.mark.parametrize("kind", ["folder", "pipe"])
def test_irregular_files(kind: str, write: Callable[..., Path], message: Messages) -> None:
    (os.mkdir if kind == "folder" else os.mkfifo)("p.npy")
    with message.raises(SceneError, "sheet.surface.points.file: p.npy"):
        load_scene(write("{points: {file: p.npy, unit: mm}}"))
    with message.raises(SceneError, "sheet.surface.height.file: p.npy"):
        load_scene(write("{height: {file: p.npy, unit: mm}}"))


def test_too_large_members(write: Callable[..., Path], message: Messages, monkeypatch: pytest.MonkeyPatch) -> None:
    """The size of an array is known before it is decompressed."""
    Path("p.npz").write_bytes(bomb())
    write("{points: {file: p.npz, unit: mm}}")
    monkeypatch.setattr(images, "available_memory", lambda: 2**28)
    with message.raises(SceneError, "p.npz needs"):
        load_scene("s.yaml")
    monkeypatch.setattr(array_files, "MAX_BYTES", 2**27)
    with message.raises(SceneError, "take at most"):
        load_scene("s.yaml")


def test_unusable_heights(write: Callable[..., Path], message: Messages) -> None:
    np.save("z.npy", flat_points())
    with message.raises(SceneError, "s.yaml:5:15: sheet.surface.height.file: z.npy", "(h, w)"):
        load_scene(write("{height: {file: z.npy, unit: mm}}"))
    Path("z.png").write_bytes(b"text")
    with message.raises(SceneError, "s.yaml:5:15: sheet.surface.height.file: z.png"):
        load_scene(write("{height: {file: z.png, range: [0, 0.01]}}"))


FAULTY: dict[str, NDArray[np.float64]] = {
    "no area": changed((np.s_[4, 5, 0], -10), (np.s_[3, 5, 0], -10)),
    "all at a point": 0 * flat_points(),
    "turned over": changed((np.s_[4, 5, 0], 25)),
    "tiny": flat_points() * 1e-200,
    "sheared": flat_points() + 1.5 * flat_points()[..., [1, 2, 2]],
    "long": flat_points() * (6, 1, 1),
}


@pytest.mark.parametrize("name", FAULTY)
def test_faulty_cells(name: str, write: Callable[..., Path], message: Messages) -> None:
    np.save("p.npy", FAULTY[name])
    with message.raises(SceneError, "s.yaml:4:6: sheet.surface.points: "):
        load_scene(write("{points: {file: p.npy, unit: mm}}"))


def test_steep_heights(write: Callable[..., Path], message: Messages) -> None:
    np.save("z.npy", 30 * np.add.outer(np.arange(9), np.arange(11)))
    with message.raises(SceneError, "s.yaml:5:6: sheet.surface.height: "):
        load_scene(write("{height: {file: z.npy, unit: mm}}"))
    # The sides of cells are almost parallel, or parallel but for rounding.
    with pytest.raises(SceneError, match=r"sheet\.surface\.height: .*less steep"):
        load_scene("s.yaml", {"sheet.surface.height.unit": "m"})
    with pytest.raises(SceneError, match=r"sheet\.surface\.height: the cell at row 0, column 0 has no area"):
        load_scene("s.yaml", {"sheet.surface.height.unit": 1e3, "sheet.size": [8e-5, 1e-4]})


def test_heights_in_another_unit(write: Callable[..., Path], message: Messages) -> None:
    """Ridges of 300 mm between the columns of a sheet of 100 mm, which would be gentle in micrometres."""
    np.save("z.npy", np.tile(300 * (np.arange(11) % 2), (9, 1)))
    with message.raises(SceneError, "s.yaml:5:6: sheet.surface.height: "):
        load_scene(write("{height: {file: z.npy, unit: mm}}"))


def test_a_tube_of_few_points(write: Callable[..., Path], message: Messages) -> None:
    """Three cells around a tube meet at about 120 degrees."""
    with message.raises(SceneError, "degrees"):
        load_scene(write("{tube: {radius: 0.016}}", "points: [4, 4]\n  size: [0.1, 0.1]"))


def lines(scene: Path) -> list[str]:
    plan = load_plan(scene)
    return [*surface_notes(plan.scene), *describe_surface(plan)]


def test_lines_of_check(write: Callable[..., Path], message: Messages) -> None:
    Image.fromarray(np.linspace(0, 255, 11).astype(np.uint8)[None].repeat(9, axis=0)).save("z.png")
    np.save("p.npy", flat_points() + 0.5 * flat_points()[..., [1, 2, 2]])
    for arguments in (
        ("{tube: {radius: 0.03, folds: {depth: 0.006, spacing: 0.02}}}", "points: [33, 41]\n  size: [0.08, 0.1]"),
        ("{dome: {radius: 0.08}}", FLAT, "pretension: 3"),
        ("{height: {file: z.png, range: [0, 0.15]}}", "points: [9, 21]\n  size: [0.08, 0.1]"),
        ("{height: {file: z.png, range: [0, 0.01]}}", "points: [9, 21]\n  size: [0.08, 0.1]"),
        ("{points: {file: p.npy, unit: mm}}",),
    ):
        message(lines(write(*arguments)))


def test_springs_are_not_isotropic_tissue(write: Callable[..., Path]) -> None:
    springs = {"tissue": None, "springs": {"structural": 20}, "sheet.mass": 1e-3}
    plan = load_plan(write("{dome: {radius: 0.08}}"), springs)
    assert not any("isotropy" in line for line in (*surface_notes(plan.scene), *describe_surface(plan)))


def test_a_note_about_sharp_folds(write: Callable[..., Path], message: Messages) -> None:
    np.save("z.npy", 0.006 * np.abs(np.arange(-5, 6))[None])
    message(surface_notes(load_scene(write("{height: {file: z.npy, unit: m}}"))), "degrees")


def scene_with(sheet: Any, **keys: Any) -> Scene:
    tissue = {"young": 2e4, "thickness": 0.002, "density": 1000}
    return Scene(output=[], sheet=sheet, tissue=tissue, time={"duration": 1, "frames_per_second": 1}, **keys)


def test_force_on_a_fold(message: Messages) -> None:
    """A fold has more area around the control point than a plane, over which the force is spread."""
    tube = {"radius": 0.025, "folds": {"depth": 0.012, "spacing": 0.02}}
    sheet = {"points": [41, 41], "size": [0.06, 0.06], "surface": {"tube": tube}}
    made = scene_with(sheet, probes=[{"total": -1, "radius": 0.01, "falloff": 300}])
    message(force_warnings(made, probe_records(made)), "probes.0")


@pytest.mark.parametrize("kind", ["unit of points", "unit of a radius", "origin"])
def test_implausible_lengths(kind: str, tmp_path: Path, message: Messages) -> None:
    x, y = np.meshgrid(np.linspace(0, 80, 21), np.linspace(60, 0, 16))
    np.save(tmp_path / "grid.npy", np.stack([x, y, 0.01 * x**2 + 5000 * (kind == "origin")], axis=-1))
    unit = "m" if kind == "unit of points" else "mm"
    points = {"surface": {"points": {"file": str(tmp_path / "grid.npy"), "unit": unit}}}
    dome = {"points": [21, 21], "size": [0.1, 0.1], "surface": {"dome": {"radius": 60}}}
    message(surface_notes(scene_with(dome if kind == "unit of a radius" else points)), "sheet.surface")


def test_a_picture_in_few_steps(write: Callable[..., Path]) -> None:
    """Grey values of 8 bits in a picture of 16 bits: a step is 1 / 255 of the range."""
    grey = np.linspace(0, 255, 80).astype(np.uint8)[None].repeat(9, axis=0)
    Image.fromarray(grey.astype(np.uint16) * 257).save("z.png")
    surface = load_scene(write("{height: {file: z.png, range: [0.051, 0]}}")).sheet.surface
    assert surface
    assert surface.file
    np.testing.assert_allclose(surface.file.step, 0.051 / 255, rtol=1e-12)


def test_records(write: Callable[..., Path]) -> None:
    """The record of a tube: no file; rectangular cells of one width, the chord of 10 parts of 0.1 m, and one height."""
    record = surface_record(load_scene(write("{tube: {radius: 0.03}}")))
    assert record is not None
    sides = sorted([0.06 * np.sin(0.01 / 0.06), 0.01])
    np.testing.assert_allclose(record["sides"], sides, rtol=1e-12)
    assert record["isotropy_error"]["worst"] < 1e-12
    assert (record["kind"], record["sha256"], record["clamped"], record["filled"]) == ("tube", None, 0, 0.0)
    assert (
        surface_record(Scene(**{**load_scene("s.yaml").model_dump(), "sheet": {"points": (3, 3), "size": (1, 1)}}))
        is None
    )


@pytest.mark.parametrize("down", [(0, 3**0.5), (0, 3**-0.5), (0.5, 0.75**0.5), (-0.5, 0.75**0.5)])
def test_cells_at_the_limit_are_not_clamped(write: Callable[..., Path], down: tuple[float, float]) -> None:
    """Rectangles with sides sqrt(3) to 1, and rhombi of 60 and 120 degrees: a number is 0 but for rounding."""
    i, j = np.mgrid[:9, :11] * 0.01
    np.save("p.npy", np.stack([j + down[0] * i, -down[1] * i, 0 * i], axis=-1))
    record = surface_record(load_scene(write("{points: {file: p.npy, unit: m}}")))
    assert record is not None
    assert record["clamped"] == 0


@pytest.mark.parametrize(
    "surface", [f"{{tube: {{radius: {0.1 / (2 * np.pi)}}}}}", f"{{dome: {{radius: {0.2 / np.pi}}}}}"]
)
def test_the_smallest_radii(write: Callable[..., Path], surface: str) -> None:
    """A tube whose sides meet and a quarter of a dome are allowed, although a product is larger by rounding."""
    load_scene(write(surface))


def test_schema() -> None:
    """Exactly one kind; surfaces of points need neither size nor number of points."""
    described = schema()
    validator = jsonschema.Draft202012Validator({"$ref": "#/$defs/Sheet", "$defs": described["$defs"]})
    flat: dict[str, Any] = {"points": [9, 11], "size": [0.3, 0.4]}
    tube, points = {"tube": {"radius": 0.1}}, {"points": {"file": "p.npy", "unit": "mm"}}
    for sheet in (flat, flat | {"surface": tube}, {"surface": points}):
        assert validator.is_valid(sheet)
    for sheet in ({"points": [9, 11]}, {}, flat | {"surface": {}}, flat | {"surface": tube | points}):
        assert not validator.is_valid(sheet)


def test_memory_of_a_file(write: Callable[..., Path]) -> None:
    """The budget counts the array of a file: 8 bytes per number."""
    needed = []
    for count in (11, 1001):
        np.save("z.npy", np.zeros((9, count), np.float32))
        needed.append(estimate_budget(load_plan(write("{height: {file: z.npy, unit: m}}"))).memory_bytes)
    assert needed[1] - needed[0] == 8 * 9 * 990
