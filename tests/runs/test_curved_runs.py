"""Runs of sheets that are curved at rest: their files, repetition, resumption, sweeps, fits and saved sessions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.accuracy.mesh import coarser_plan
from taichi_msm.errors import FilesError, SceneError
from taichi_msm.fitting.fit import fit
from taichi_msm.gradients.gradient import gradient
from taichi_msm.load.scene_file import load_plan, load_scene
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.run import resume, run
from taichi_msm.system.runtime import Device
from taichi_msm.view.recording import Captures
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files, results
from tests.reference import surface as twin
from tests.runs.test_finished import record, sha256
from tests.runs.test_resume import interrupted
from tests.scenes import speckle

SIZE = "  points: [9, 11]\n  size: [0.08, 0.1]\n"
SCENE = """\
image: speckle.png
sheet:
{size}  surface: {surface}
tissue: {{young: 2.0e+4, thickness: 0.002, density: 1000, foundation: 1.0e+5, damping: 30}}
probes:
  - {{at: [0.5, 0.5], total: -0.05, radius: 0.01, load: [[0, 0], [0.1, 100]]}}
time: {{duration: 0.2, frames_per_second: 50, precision: f64}}
render: {{size: [16, 12]}}
output: [trajectory]
"""
SURFACES: dict[str, dict[str, Any]] = {
    "tube": {"tube": {"radius": 0.03, "folds": {"depth": 0.004, "spacing": 0.03}}},
    "dome": {"dome": {"radius": -0.08}},
    "height": {"height": {"file": "files/bump.png", "range": [0, 0.01]}},
    "points": {"points": {"file": "files/wall.npz", "unit": "mm"}},
}


def write_wall(path: str, depth: float = 8.0) -> None:
    """Write a wavy grid of 7 x 9 points [mm], around the origin."""
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 7))
    np.savez(path, wall=np.stack([100 * u - 50, 40 - 80 * v, depth * np.sin(3 * u + 2 * v)], axis=-1))


@pytest.fixture
def curved(small: Path) -> Path:
    """The current directory, with a scene of each kind of surface, and files of surfaces in a folder below it."""
    Path("files").mkdir()
    u, v = np.meshgrid(np.linspace(0, 1, 12), np.linspace(0, 1, 10))
    Image.fromarray(np.uint8(200 * np.sin(2 * u) * np.cos(v))).save("files/bump.png")
    write_wall("files/wall.npz")
    write_wall("files/deep.npz", 12.0)
    for kind, surface in SURFACES.items():
        size = "  points: [13, 16]\n" if kind == "points" else SIZE
        Path(f"{kind}.yaml").write_text(SCENE.format(size=size, surface=json.dumps(surface)))
    return small


@pytest.mark.parametrize("kind", SURFACES)
def test_rest_file(kind: str, curved: Path, device: Device) -> None:
    """Positions, areas and normals of the twin in float64, but for rounding."""
    made = load_scene(f"{kind}.yaml")
    run(made, "out", threads=device.threads, estimate_error=False)
    assert record(curved / "out")["outputs"] == ["trajectory.npz", "rest.npz", "run.json"]
    size = None if kind == "points" else made.sheet.size
    position = twin.rest_positions(SURFACES[kind], made.sheet.points, size)
    cells = twin.cells(position)
    expected = {"position": position, "area": twin.point_areas(cells), "normal": twin.normals(cells)}
    with np.load("out/rest.npz") as written:
        assert list(written) == list(expected)
        for name, values in expected.items():
            assert written[name].dtype == np.float64
            # Lengths of 0.1 m, and differences of a hundredth: 1e-16 / 0.01.
            np.testing.assert_allclose(written[name], values, rtol=1e-13, atol=1e-15)
    with np.load("out/trajectory.npz") as moved:
        np.testing.assert_allclose(moved["position"][0], position, rtol=1e-13, atol=1e-15)
    summary, surface = twin.summary(position), record(curved / "out")["surface"]
    assert surface["kind"] == kind
    np.testing.assert_allclose(surface["sides"], summary.sides, rtol=1e-12)
    np.testing.assert_allclose(surface["isotropy_error"]["mean"], summary.mean, atol=1e-12)
    np.testing.assert_allclose(surface["isotropy_error"]["worst"], summary.worst, atol=1e-12)
    assert (surface["clamped"], surface["filled"]) == (summary.clamped, 0)
    file = {"height": "files/bump.png", "points": "files/wall.npz"}.get(kind)
    digest = record(curved / "out")["sha256"].get(f"sheet.surface.{kind}.file")
    assert surface["sha256"] == digest == (sha256(curved / file) if file else None)


def test_rest_file_is_replaced_with_the_run(curved: Path, device: Device) -> None:
    for kind in ("tube", "dome"):
        run(load_scene(f"{kind}.yaml"), "out", threads=device.threads, estimate_error=False)
    run(load_scene("dome.yaml"), "dome", threads=device.threads, estimate_error=False)
    assert results(Path("out")) == results(Path("dome"))
    run(load_scene("tube.yaml", {"output": []}), "out", threads=device.threads, estimate_error=False)
    assert sorted(results(Path("out"))) == ["rest.npz"]
    run(load_scene("small.yaml", {"output": ["forces"]}), "out", threads=device.threads, estimate_error=False)
    assert sorted(results(Path("out"))) == ["forces.csv"]
    assert "surface" not in record(Path("out"))


def test_foreign_rest_file_is_kept(curved: Path, device: Device) -> None:
    Path("out").mkdir()
    Path("out/rest.npz").write_text("mine")
    with pytest.raises(FilesError, match=r"^out/rest\.npz: a file not written by this program"):
        run(load_scene("tube.yaml"), "out", threads=device.threads, estimate_error=False)
    assert files(Path("out")) == {"rest.npz": b"mine"}


def test_repeated_run(curved: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """The scene of run.json names the file from the directory of the run, and requires its content."""
    assert program("run", "points.yaml", "--out", "first", "--no-estimate").returncode == 0
    (curved / "elsewhere").mkdir()
    monkeypatch.chdir(curved / "elsewhere")
    assert program("run", "--again", "../first", "--out", "second", "--no-estimate").returncode == 0
    assert results(Path("second")) == results(curved / "first")
    for name in ("outputs", "sha256", "surface"):
        assert record(Path("second"))[name] == record(curved / "first")[name]
    monkeypatch.chdir(curved)
    wall = Path("files/wall.npz")
    for content in (Path("files/deep.npz").read_bytes(), b"text"):
        wall.write_bytes(content)
        done = program("run", "--again", "first", "--out", "second")
        assert (done.returncode, done.stdout) == (4, "")
        message(done.stderr, "first: sheet.surface.points.file:")
    wall.unlink()
    done = program("run", "--again", "first", "--out", "second")
    message(done.stderr, "first: sheet.surface.points.file:")
    assert not Path("second").exists()


@pytest.mark.parametrize("kind", ["height", "points"])
def test_resumed_run(kind: str, curved: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bits of an uninterrupted run; a changed file is refused, and the results are kept."""
    run(load_scene(f"{kind}.yaml"), "whole", threads=device.threads)
    interrupted(load_scene(f"{kind}.yaml"), "parts", device, 4)
    path = next(Path("files").glob("bump.png" if kind == "height" else "wall.npz"))
    original, before = path.read_bytes(), files(Path("parts"))
    if kind == "height":
        Image.fromarray(speckle(4, 5, 1)).save(path)
    else:
        write_wall(str(path), 7.0)
    with pytest.raises(FilesError, match=rf"{path} has changed since the run began; put it back"):
        resume("parts", threads=device.threads)
    path.unlink()
    with pytest.raises(SceneError, match=rf"^sheet\.surface\.{kind}\.file: .*{path}: no such file"):
        resume("parts", threads=device.threads)
    assert files(Path("parts")) == before
    path.write_bytes(original)
    (curved / "elsewhere").mkdir()
    monkeypatch.chdir(curved / "elsewhere")
    assert resume("../parts", threads=device.threads)["status"] == "complete"
    assert results(curved / "parts") == results(curved / "whole")


def test_fits_of_numbers(curved: Path, device: Device, message: Messages) -> None:
    """A fit by finite differences of positions of a stiffer sheet; the file is copied with the fitted scene."""
    run(load_scene("points.yaml", {"tissue.young": 3e4}), "truth", threads=device.threads, estimate_error=False)
    with np.load("truth/trajectory.npz") as trajectory:
        observed = dict(trajectory)
    result = fit("points.yaml", observed, ["tissue.young"], directory="fitted", workers=1)
    assert abs(result.parameters["tissue.young"].value / 3e4 - 1) < 1e-4
    assert Path("fitted/pictures/wall.npz").read_bytes() == Path("files/wall.npz").read_bytes()
    assert load_scene("fitted/scene.yaml").sheet.points == (13, 16)
    with message.raises(SceneError, "sheet.surface: "):
        fit("points.yaml", observed, ["tissue.map"], resolution=4, workers=1)
    with message.raises(SceneError, "sheet.surface: "):
        gradient(load_scene("dome.yaml"), lambda position: (0.0, 0 * position), threads=device.threads)


def test_saved_sessions(curved: Path) -> None:
    """A saved scene has copies of its files next to it, and the same mass points."""
    for kind in ("height", "points"):
        made = load_scene(f"{kind}.yaml")
        saved = load_scene(Captures(Path("session"), kind).save_scene(made))
        assert saved.sheet.surface is not None
        assert made.sheet.surface is not None
        assert saved.sheet.points == made.sheet.points
        assert Path(saved.sheet.surface.path).read_bytes() == Path(made.sheet.surface.path).read_bytes()
        assert Path(saved.sheet.surface.path).parent == Path("session")


def test_companions_are_the_same_surface(curved: Path) -> None:
    """Half the cells: every second mass point where the surface is a formula; none where its cells would fold."""
    plan = load_plan("tube.yaml", {"sheet.points": [17, 21]})
    coarse = coarser_plan(plan)
    assert coarse is not None
    fine, few = (twin.rest_positions(SURFACES["tube"], each.scene.sheet.points, (0.08, 0.1)) for each in (plan, coarse))
    np.testing.assert_allclose(few, fine[::2, ::2], rtol=0, atol=1e-16)
    # Six cells around a tube meet at 60 degrees, and three at 120.
    around = {"sheet.points": [7, 7], "sheet.size": [0.1, 0.1], "sheet.surface.tube": {"radius": 0.016}}
    assert coarser_plan(load_plan("tube.yaml", around)) is None


def test_read_run_compares_scenes(curved: Path, device: Device) -> None:
    """Scenes whose files were read are equal by their keys, as sweeps and exports compare them."""
    made = load_scene("points.yaml")
    run(made, "out", threads=device.threads, estimate_error=False)
    assert read_run("out").scene.sheet == made.sheet == load_scene("points.yaml").sheet
    assert made.sheet != load_scene("points.yaml", {"sheet.surface.points.unit": 2e-3}).sheet
