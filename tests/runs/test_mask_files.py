"""The mask of a sheet is a picture everywhere: overrides, digests, repetition, resumption, sweeps, copies, memory."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from PIL import Image

from taichi_msm import images, load_scene, run, sweep
from taichi_msm.cli.main import main
from taichi_msm.errors import FilesError, SceneError
from taichi_msm.load.cost import estimate_budget
from taichi_msm.load.scene_file import load_plan, schema
from taichi_msm.model.rest import rest_of
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.run import resume
from taichi_msm.study.study import run_study
from taichi_msm.sweeps.pool import Pool
from taichi_msm.system.runtime import Device
from taichi_msm.view.recording import Captures
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files, results
from tests.runs.test_resume import interrupted

SCENE = """\
sheet:
  points: [9, 13]
  size: [0.04, 0.06]
  mask: masks/hole.png
tissue: {young: 2.0e+4, thickness: 0.002, density: 1000, foundation: 1.0e+5, damping: 30}
probes:
  - {at: [0.2, 0.5], total: [0, 0, -0.05], radius: 0.005, load: [[0, 0], [0.1, 100]]}
time: {duration: 0.2, frames_per_second: 50, precision: f64}
output: [trajectory]
"""

# Columns of cells without sheet: nowhere at the tool, under it, and everywhere.
MASKS = {"hole": (6, 8), "right": (9, 12), "under": (1, 4), "black": (0, 12)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("masks").mkdir()
    for name, (first, last) in MASKS.items():
        pixels = np.full((8, 12), 255, np.uint8)
        pixels[2 : 6 if name == "hole" else 8, first:last] = 0
        pixels[: 2 if name == "black" else 0] = 0
        Image.fromarray(pixels).save(f"masks/{name}.png")
    Path("s.yaml").write_text(SCENE)
    return tmp_path


def cells_of(*overrides: Any) -> int:
    mask = rest_of(load_scene("s.yaml", *overrides).sheet).mask
    return 0 if mask is None else int(mask.cells.sum())


def test_overrides(folder: Path, message: Messages) -> None:
    """Paths in overrides are relative to the scene; a key of the mapping may be set where the file has a path."""
    assert cells_of() == 96 - 8
    assert cells_of(["sheet.mask=masks/right.png"]) == 96 - 18
    assert cells_of({"sheet.mask": {"image": "masks/right.png", "invert": True}, "probes": []}) == 18
    assert cells_of(["sheet.mask.invert=true", "probes=[]"]) == 8
    assert cells_of(["sheet.mask.image=masks/right.png"]) == 96 - 18
    assert cells_of(["sheet.mask="]) == 0
    elsewhere = folder / "below"
    elsewhere.mkdir()
    (elsewhere / "s.yaml").write_text(SCENE.replace("masks/hole.png", "../masks/hole.png"))
    with message.raises(SceneError, "s.yaml:4:3: sheet.mask: ../masks/hole.png is not below the scene's folder"):
        load_scene("below/s.yaml")
    (elsewhere / "s.yaml").write_text(SCENE.replace("masks/hole.png", "{image: ../masks/hole.png}"))
    with message.raises(SceneError, "s.yaml:4:10: sheet.mask.image: ../masks/hole.png is not below"):
        load_scene("below/s.yaml", ["sheet.mask.invert=true"])


def test_schema_accepts_both_forms() -> None:
    validator = jsonschema.Draft202012Validator(schema())
    allowed: list[Any] = ["a.png", {"image": "a.png"}, {"image": "a.png", "invert": True}, None]
    refused: list[Any] = ["", 3, {"invert": True}, {"image": "a.png", "inverted": True}]
    for mask in (*allowed, *refused):
        sheet, tissue = {"points": [9, 13], "size": [1, 1], "mask": mask}, {"young": 1, "thickness": 1}
        assert validator.is_valid({"sheet": sheet, "tissue": tissue, "time": {"duration": 1}}) == (mask in allowed)


def test_repeated_run(folder: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """The scene of run.json names the mask from the directory of the run, and requires its content."""
    assert program("run", "s.yaml", "--out", "first", "--no-estimate").returncode == 0
    record = json.loads(Path("first/run.json").read_text())
    digest = hashlib.sha256(Path("masks/hole.png").read_bytes()).hexdigest()
    assert record["sha256"] == {"sheet.mask.image": digest}
    (folder / "elsewhere").mkdir()
    monkeypatch.chdir(folder / "elsewhere")
    assert program("run", "--again", "../first", "--out", "second", "--no-estimate").returncode == 0
    assert results(Path("second")) == results(folder / "first")
    monkeypatch.chdir(folder)
    hole = Path("masks/hole.png")
    for name in ("right", "under", "black"):
        hole.write_bytes(Path(f"masks/{name}.png").read_bytes())
        with pytest.raises(FilesError, match=r"^first: sheet\.mask\.image: masks/hole\.png differs from the file"):
            read_run("first")
    done = program("run", "--again", "first", "--out", "second")
    assert (done.returncode, done.stdout) == (4, "")
    message(done.stderr, "first: sheet.mask.image:")
    hole.unlink()
    done = program("run", "--again", "first", "--out", "second")
    message(done.stderr, "first: sheet.mask.image:")


def test_resumed_run(folder: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bits of an uninterrupted run; a changed file is refused, and the results are kept."""
    run(load_scene("s.yaml"), "whole", threads=device.threads)
    interrupted(load_scene("s.yaml"), "parts", device, 4)
    hole, before = Path("masks/hole.png"), files(Path("parts"))
    original = hole.read_bytes()
    for name in ("right", "under", "black"):
        hole.write_bytes(Path(f"masks/{name}.png").read_bytes())
        with pytest.raises(FilesError, match=r"masks/hole\.png has changed since the run began; put it back"):
            resume("parts", threads=device.threads)
    hole.unlink()
    with pytest.raises(SceneError, match=r"^sheet\.mask: .*masks/hole\.png: no such file"):
        resume("parts", threads=device.threads)
    assert files(Path("parts")) == before
    hole.write_bytes(original)
    (folder / "elsewhere").mkdir()
    monkeypatch.chdir(folder / "elsewhere")
    assert resume("../parts", threads=device.threads)["status"] == "complete"
    assert results(folder / "parts") == results(folder / "whole")


@pytest.mark.parametrize("key", ["sheet.mask", "sheet.mask.image"])
def test_masks_vary(key: str, folder: Path) -> None:
    """Masks are a choice of pictures; one under the tool is a refused run, as a row of the table."""
    values = [f"masks/{name}.png" for name in ("hole", "right", "under")]
    pool = Pool(1)
    rows = sorted(sweep("s.yaml", {key: {"grid": values}}, "many", executor=pool), key=lambda row: row.run)
    pool.shutdown()
    assert [row.status for row in rows] == ["complete", "complete", "refused"]
    assert "probes.0.at" in str(rows[2].error)
    for row, value in zip(rows[:2], values, strict=False):
        record = json.loads((Path("many/runs") / f"{row.run:06}" / "run.json").read_text())
        assert record["sha256"]["sheet.mask.image"] == hashlib.sha256(Path(value).read_bytes()).hexdigest()
        assert record["overrides"] == [f"{key}={value}"]


def test_a_pattern_of_masks(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("many.yaml").write_text('scene: s.yaml\nsamples: 4\nvary: {sheet.mask: {choice: "masks/[hr]*.png"}}\n')
    assert main(("sweep", "many.yaml", "--dry-run")) == 0
    shown = capsys.readouterr().out
    assert "masks/hole.png" in shown or "masks/right.png" in shown
    assert "under" not in shown


def test_saved_scenes_have_copies(folder: Path) -> None:
    saved = load_scene(Captures(Path("session"), "s").save_scene(load_scene("s.yaml", ["sheet.mask.invert=false"])))
    assert saved.sheet.mask is not None
    assert Path(saved.sheet.mask.image).read_bytes() == Path("masks/hole.png").read_bytes()
    assert Path(saved.sheet.mask.image).parent == Path("session")


def test_memory(folder: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """The pixels are counted, and a mask that cannot be decoded in memory is refused by its header."""
    plan = load_plan("s.yaml")
    Image.fromarray(np.full((800, 1200), 255, np.uint8)).save("masks/large.png")
    large = load_plan("s.yaml", ["sheet.mask=masks/large.png"])
    assert estimate_budget(large).memory_bytes - estimate_budget(plan).memory_bytes == 800 * 1200 - 8 * 12
    monkeypatch.setattr(images, "available_memory", lambda: 20 * 800 * 1200 - 1)
    with message.raises(SceneError, "sheet.mask: masks/large.png needs"):
        load_plan("s.yaml", ["sheet.mask=masks/large.png"])
    Image.new("1", (30000, 3000)).save("masks/huge.png")
    with message.raises(SceneError, "sheet.mask: masks/huge.png has more than"):
        load_plan("s.yaml", ["sheet.mask=masks/huge.png"])


def test_study(folder: Path, device: Device) -> None:
    study = run_study(load_plan("s.yaml", ["output=[]"]), "s", quick=True, threads=device.threads)
    assert study.status == "complete"
    assert study.stepping
