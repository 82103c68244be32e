"""Runs of sheets from depth maps: rest.npz, repetition, resumption, a chosen mesh, and the user's grids."""

from __future__ import annotations

import json
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.accuracy.mesh import with_points
from taichi_msm.cli import console
from taichi_msm.errors import FilesError, SceneError
from taichi_msm.fitting.fit import fit
from taichi_msm.gradients.gradient import gradient
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model import grids, rest
from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.run import resume, run
from taichi_msm.scene.scene import Scene
from taichi_msm.sweeps.sweep import sweep
from taichi_msm.system import array_cache
from taichi_msm.system.runtime import Device
from taichi_msm.view.recording import Captures
from tests.conftest import Program
from tests.depths import HEIGHT, WIDTH, wall, write_depth_scene
from tests.golden import Messages
from tests.outputs import files, results
from tests.runs.test_finished import record, sha256
from tests.runs.test_resume import interrupted

LARGE = "render.size=[960, 720]"


@pytest.fixture
def depth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with scene.yaml, its picture and its depth map, and an empty folder of the user."""
    write_depth_scene(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    forget(monkeypatch)
    return tmp_path


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget all sheets and arrays in memory, as another process."""
    monkeypatch.setattr(array_cache, "_arrays", OrderedDict())
    rest._rest.cache_clear()


def refuse(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Forget all grids in memory and in the folder of the user, and let a minimisation fail."""
    forget(monkeypatch)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "empty"))
    monkeypatch.setattr(grids, "even_grid", lambda *_: pytest.fail("a grid is minimised"))


def test_rest_file(depth: Path, device: Device) -> None:
    """Places in the picture, which for a depth map are those of the even grid."""
    run(load_scene("scene.yaml"), "out", threads=device.threads, estimate_error=False)
    sheet = rest_of(load_scene("scene.yaml").sheet)
    assert isinstance(sheet, PicturedRest)
    with np.load("out/rest.npz") as written:
        assert list(written) == ["position", "area", "normal", "texture", "grid"]
        assert {values.dtype for values in written.values()} == {np.dtype(np.float64)}
        np.testing.assert_array_equal(written["position"], sheet.position)
        np.testing.assert_array_equal(written["grid"], sheet.origin.grid)
        # Projections of points that were computed from these places.
        np.testing.assert_allclose(written["texture"], written["grid"], rtol=0, atol=1e-14)
    run(load_scene("scene.yaml", {"sheet.surface.grid": "given"}), "out", threads=device.threads, estimate_error=False)
    with np.load("out/rest.npz") as written:
        assert list(written) == ["position", "area", "normal", "texture"]


def test_repeated_run(depth: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """The grid is that of rest.npz; a changed file, or a rest.npz without the grid, is refused."""
    # So large that the focal length would be refused if it were that of the pictures.
    assert program("run", "scene.yaml", "--out", "first", "--no-estimate", "--set", LARGE).returncode == 0
    refuse(monkeypatch, depth)
    (depth / "elsewhere").mkdir()
    monkeypatch.chdir(depth / "elsewhere")
    assert program("run", "--again", "../first", "--out", "second", "--no-estimate").returncode == 0
    assert results(Path("second")) == results(depth / "first")
    assert record(Path("second"))["surface"] == record(depth / "first")["surface"]
    monkeypatch.chdir(depth)
    content = Path("first/rest.npz").read_bytes()
    for changed in (content[: len(content) // 2], None):
        Path("first/rest.npz").unlink()
        if changed is not None:
            Path("first/rest.npz").write_bytes(changed)
        message(program("run", "--again", "first", "--out", "third").stderr, "first/rest.npz")
    Path("first/rest.npz").write_bytes(content)
    np.save("depth.npy", wall(0.3))
    message(program("run", "--again", "first", "--out", "third").stderr, "sheet.surface.depth.file")
    np.save("depth.npy", wall())
    # Without the image, or with one of another size, there is no sheet.
    Image.open("frame.png").resize((2 * WIDTH, 2 * HEIGHT)).save("frame.png")
    message(program("run", "--again", "first", "--out", "third").stderr, "first: image: frame.png differs")
    Path("frame.png").unlink()
    message(program("run", "--again", "first", "--out", "third").stderr, "first: image: frame.png")
    assert not Path("third").exists()


@pytest.mark.parametrize("grid", ["even", "given"])
def test_resumed_run(grid: str, depth: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bits of an uninterrupted run, from another folder and without a minimisation; a changed map is refused."""
    made = load_scene("scene.yaml", [f"sheet.surface.grid={grid}", LARGE])
    run(made, "whole", threads=device.threads)
    interrupted(made, "parts", device, 4)
    before = files(Path("parts"))
    np.save("depth.npy", wall(0.3))
    with pytest.raises(FilesError, match=r"depth\.npy has changed since the run began; put it back"):
        resume("parts", threads=device.threads)
    assert files(Path("parts")) == before
    np.save("depth.npy", wall())
    refuse(monkeypatch, depth)
    (depth / "elsewhere").mkdir()
    monkeypatch.chdir(depth / "elsewhere")
    assert resume("../parts", threads=device.threads)["status"] == "complete"
    assert results(depth / "parts") == results(depth / "whole")
    for name in ("error_estimate", "surface", "scene", "sha256"):
        assert record(depth / "parts")[name] == record(depth / "whole")[name]


def test_run_continues_an_unfinished_one(depth: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """If both have the same grid."""
    for is_same in (True, False):
        interrupted(load_scene("scene.yaml", [LARGE]), "out", device, 4)
        if not is_same:
            (file,) = grids.user_folder().iterdir()
            with np.load(file) as archive:
                grid = archive["grid"]
            grid[4, 5] += 1e-9
            np.savez(file, grid=grid)
            forget(monkeypatch)
        assert (run(load_scene("scene.yaml", [LARGE]), "out", threads=device.threads)["resumed"] > 0) == is_same


def test_chosen_mesh(depth: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mesh for a tolerance keeps smoothing and grid of the scene's own points, also when it is read again."""
    tolerance = {"sheet.tolerance": 0.1, "tissue.pretension": 50.0, "time.duration": 0.1}
    made = load_scene("scene.yaml", tolerance)
    own = rest_of(made.sheet)
    assert isinstance(own, PicturedRest)
    done = run(made, "out", threads=device.threads)
    rows, cols = done["points"]
    assert rows > made.sheet.points[0]
    resolved = done["scene"]["sheet"]["surface"]["depth"]["smooth"]
    # Half the mean side of a cell of the scene's own points.
    assert resolved == own.origin.deviation == (48 / 10 + 36 / 8) / 4
    assert done["asked"]["sheet.surface.depth.smooth"] == "auto"
    assert own.origin.grid is not None
    with np.load("out/rest.npz") as written:
        grid, position = written["grid"], written["position"]
    # Splines through the own grid, at whose points they are exact.
    step = (rows - 1) // 8
    if (rows - 1, cols - 1) == (8 * step, 10 * step):
        np.testing.assert_allclose(grid[::step, ::step], own.origin.grid, rtol=0, atol=1e-14)
    refuse(monkeypatch, depth)
    again = read_run("out").scene
    np.testing.assert_array_equal(rest_of(again.sheet).position, position)
    run(again, "again", threads=device.threads, estimate_error=False)
    assert results(Path("again")) == results(Path("out"))


def test_dumped_scene(depth: Path) -> None:
    """A dump is the same scene, with the size and the pose that follow from the picture."""
    made = load_scene("scene.yaml")
    again = Scene(**made.model_dump())
    assert again == made
    np.testing.assert_array_equal(rest_of(again.sheet).position, rest_of(made.sheet).position)
    assert made.render.size == (48, 36)


def test_other_meshes(depth: Path) -> None:
    """Companion runs have the surface and, interpolated, the grid of the scene's own points."""
    made = load_scene("scene.yaml")
    coarse, own = (rest_of(each.sheet) for each in (with_points(made, (5, 6)), made))
    np.testing.assert_allclose(coarse.position, own.position[::2, ::2], rtol=0, atol=1e-15)
    assert isinstance(coarse, PicturedRest)
    assert coarse.origin.deviation == (48 / 10 + 36 / 8) / 4


def test_progress_of_the_grid(
    depth: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """Lines on stderr of any command while a grid is minimised, but not with --json, and none for a kept grid."""
    monkeypatch.setattr(console, "LINE_INTERVAL_S", 0.0)
    for words, is_shown in ((("--json",), False), ((), False), (("--set", "sheet.points=[17, 21]"), True), ((), False)):
        forget(monkeypatch)
        done = program("check", "scene.yaml", *words)
        assert done.returncode == 0
        assert ("spreading mass points: 1000 of 2000 done" in done.stderr) == is_shown


def test_fits_copy_the_depth_map(depth: Path, device: Device) -> None:
    run(load_scene("scene.yaml", {"tissue.young": 3e4}), "truth", threads=device.threads, estimate_error=False)
    with np.load("truth/trajectory.npz") as trajectory:
        observed = dict(trajectory)
    result = fit("scene.yaml", observed, ["tissue.young"], directory="fitted", workers=1)
    assert abs(result.parameters["tissue.young"].value / 3e4 - 1) < 1e-4
    for name in ("depth.npy", "frame.png"):
        assert Path("fitted/pictures", name).read_bytes() == Path(name).read_bytes()
    fitted = load_scene("fitted/scene.yaml").sheet
    np.testing.assert_array_equal(rest_of(fitted).position, rest_of(load_scene("scene.yaml").sheet).position)
    with pytest.raises(SceneError, match=r"sheet\.surface: "):
        fit("scene.yaml", observed, ["tissue.map"], resolution=4, workers=1)
    with pytest.raises(SceneError, match=r"sheet\.surface: "):
        gradient(load_scene("scene.yaml"), lambda position: (0.0, 0 * position), threads=device.threads)


def test_saved_session(depth: Path) -> None:
    made = load_scene("scene.yaml")
    saved = load_scene(Captures(Path("session"), "scene").save_scene(made))
    assert saved.sheet.surface is not None
    assert Path(saved.sheet.surface.path).parent == Path("session")
    np.testing.assert_array_equal(rest_of(saved.sheet).position, rest_of(made.sheet).position)


def test_sweep_of_the_surface(depth: Path) -> None:
    """Choices of files, and values of the smoothing and the grid."""
    np.save("deep.npy", wall(height=6.0))
    vary: dict[str, dict[str, Any]] = {
        "sheet.surface.depth.file": {"choice": ["depth.npy", "deep.npy"]},
        "sheet.surface.depth.smooth": {"uniform": [0, 3]},
        "sheet.surface.grid": {"choice": ["even", "given"]},
    }
    outcomes = list(sweep("scene.yaml", vary, "swept", samples=4, overrides={"output": []}, workers=1))
    assert [outcome.status for outcome in outcomes] == 4 * ["complete"]
    surfaces = [json.loads(path.read_text())["surface"] for path in sorted(Path("swept/runs").glob("*/run.json"))]
    assert len(surfaces) == 4
    assert {each["sha256"] for each in surfaces} == {sha256(Path(name)) for name in ("depth.npy", "deep.npy")}
    assert len({each["isotropy_error"]["mean"] for each in surfaces}) == 4
    for path in Path("swept/runs").iterdir():
        assert read_run(path).frames == 11
