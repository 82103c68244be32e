"""Reading and repeating finished runs; damaged and forged results are refused."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.errors import FilesError, SceneError
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.plan import Plan
from taichi_msm.runs.checkpoint import input_digests
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.playback import Playback
from taichi_msm.runs.run import resume, run
from taichi_msm.runs.writer import RunRecord
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files, results
from tests.runs.test_resume import Stop
from tests.scenes import speckle


def change(results: Path, **values: Any) -> None:
    """Change keys of run.json; None removes one."""
    record = json.loads((results / "run.json").read_text()) | values
    kept = {key: value for key, value in record.items() if value is not None}
    (results / "run.json").write_text(json.dumps(kept))


def change_scene(results: Path, **sections: Any) -> None:
    """Change keys in the sections of the scene of run.json."""
    scene = json.loads((results / "run.json").read_text())["scene"]
    for name, keys in sections.items():
        scene[name] = {**scene[name], **keys} if isinstance(keys, dict) else keys
    change(results, scene=scene)


def test_finished_run(ran: Path) -> None:
    run = read_run(ran)
    assert (run.directory, run.frames, run.scene.time.precision) == (ran, 5, "f64")
    written, positions = np.load(ran / "trajectory.npz"), run.positions()
    assert positions.dtype == np.float64
    assert not positions.flags.writeable
    np.testing.assert_array_equal(positions, written["position"])
    np.testing.assert_array_equal(run.time, written["time"])
    np.testing.assert_array_equal(run.time, [0, 0.1, 0.2, 0.3, 0.4])
    assert run.result_path("png", 4) == ran / "frames" / "0004.png"


def test_picture_paths_are_relative_to_the_working_directory(results: Path) -> None:
    Image.fromarray(speckle(4, 4)).save(results / "map.png")
    stiffness = {"structural": 20.0, "map": {"image": "sub/../map.png", "range": [1.0, 2.0]}}
    change_scene(results, image="sub/speckle.png", springs=stiffness)
    change(results, working_directory=str(results))
    (results / "sub").mkdir()
    made = read_run(results).scene
    assert made.image == str(results / "sub" / "speckle.png")
    assert made.stiffness_map is not None
    assert made.stiffness_map.image == str(results / "sub" / ".." / "map.png")
    change_scene(results, image="gone.png", springs={"map": {"image": "gone.png", "range": [1.0, 2.0]}})
    assert read_run(results).frames == 5, "missing pictures are reported at their first use"


def test_missing_results(results: Path, message: Messages) -> None:
    (results / "trajectory.npz").unlink()
    (results / "frames" / "0003.png").unlink()
    run = read_run(results)
    with message.raises(FilesError, "trajectory.npz"):
        run.positions()
    with message.raises(FilesError, "flow"):
        run.result_path("flow")
    with message.raises(FilesError, "frames/0003.png"):
        run.result_path("png", 3)
    assert run.has_output("png")
    assert not run.has_output("flow")


@pytest.mark.parametrize("name", ["nowhere", "empty", "run.json"])
def test_folder_without_a_run(name: str, results: Path, message: Messages) -> None:
    (results / "empty").mkdir()
    with message.raises(FilesError, name):
        read_run(results / name)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "cut short": lambda path: (path / "run.json").write_bytes((path / "run.json").read_bytes()[:-20]),
    "not UTF-8": lambda path: (path / "run.json").write_bytes(b'{"frames": "\xff"}'),
    "deep": lambda path: (path / "run.json").write_text("[" * 200_000),
    "no scene": lambda path: change(path, scene=None),
    "no frames": lambda path: change(path, frames=None),
    "no frame": lambda path: change(path, frames=0),
    "overrides": lambda path: change(path, overrides="image=x"),
    "digests": lambda path: change(path, sha256={"image": 3}),
    "unknown precision": lambda path: change_scene(path, time={"precision": "auto"}),
    "an unknown key": lambda path: change_scene(path, sheet={"colour": 3}),
    "an eye at its target": lambda path: change_scene(
        path, render={"camera": {"eye": [0.0, 0.0, 0.0], "target": [0.0, 0.0, 0.0]}}
    ),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_record(damage: Callable[[Path], object], results: Path) -> None:
    damage(results)
    with pytest.raises(FilesError, match=r"run\.json: damaged"):
        read_run(results)


def rewrite(
    results: Path,
    name: str = "position",
    edit: Callable[[Any], Any] = lambda position: position,
    save: Callable[..., Any] = np.savez,
) -> None:
    """Rewrite the trajectory with edited positions."""
    position = np.load(results / "trajectory.npz")["position"]
    save(results / "trajectory.npz", **{name: edit(position)})


def forge_size(results: Path) -> None:
    """Forge the header and the record of a trajectory of 10^9 frames."""
    with zipfile.ZipFile(results / "trajectory.npz", "w") as archive:
        archive.writestr("position.npy", np.lib.format.magic(1, 0) + b"v\0{'descr': '<f8', 'shape': (1000000000,)}")
    change_scene(results, time={"duration": 1e8})
    change(results, frames=10**9)


def with_nan(position: Any) -> Any:
    position[3, 4, 5, 1] = np.nan
    return position


FORGERIES: dict[str, Callable[[Path], object]] = {
    "compressed": lambda path: rewrite(path, save=np.savez_compressed),
    "with NaN": lambda path: rewrite(path, edit=with_nan),
    "that begins elsewhere": lambda path: rewrite(path, edit=lambda position: position + 1e-9),
    "without positions": lambda path: rewrite(path, name="place"),
    "truncated": lambda path: (path / "trajectory.npz").write_bytes((path / "trajectory.npz").read_bytes()[:-1]),
    "huge": forge_size,
    "of another sheet": lambda path: change_scene(path, sheet={"size": [0.3, 0.5]}),
}


@pytest.mark.parametrize("forge", FORGERIES.values(), ids=FORGERIES)
def test_forged_trajectory(forge: Callable[[Path], object], results: Path) -> None:
    rewrite(results)
    assert len(read_run(results).positions()) == 5, "files of np.savez are accepted"
    forge(results)
    with pytest.raises(FilesError, match=r"trajectory\.npz: damaged"):
        read_run(results).positions()


def test_bit_flips_are_detected_or_harmless(results: Path, message: Messages) -> None:
    """Some bytes of the zip format are unused, such as its dates; wrong positions are never returned."""
    path, run = results / "trajectory.npz", read_run(results)
    whole, positions = path.read_bytes(), np.array(run.positions())
    rng = np.random.default_rng(0)
    # All bytes of the headers at both ends, and a sample of the others.
    sample = rng.integers(200, len(whole) - 400, 200).tolist()
    errors = set()
    for index in [*range(200), *range(len(whole) - 400, len(whole)), *sample]:
        damaged = bytearray(whole)
        damaged[index] ^= 1 << int(rng.integers(8))
        path.unlink()  # the mapped file stays unchanged
        path.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(run.positions(), positions)
        except FilesError as error:
            errors.add(str(error))
    message(errors)


MAP = "springs.map={image: map.png, range: [1, 2]}"
SHORT = "time.duration=0.2"


@pytest.fixture
def mapped(small: Path) -> Path:
    """A directory to work in with small.yaml, its picture and a map."""
    Image.fromarray(speckle(3, 4, 1)).save(small / "map.png")
    return small


def record(directory: Path) -> RunRecord:
    content: RunRecord = json.loads((directory / "run.json").read_text())
    return content


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_repeated_run_has_the_same_bits(mapped: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.fromarray(speckle(30, 40, 5)).save(mapped / "other.png")
    command = ["run", "small.yaml", "--set", MAP, "--set", SHORT, "--image", "other.png", "--out", "first"]
    assert program(*command).returncode == 0
    (mapped / "elsewhere").mkdir()
    monkeypatch.chdir(mapped / "elsewhere")
    (mapped / "small.yaml").unlink()
    done = program("run", "--again", "../first", "--out", "second", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert results(mapped / "elsewhere" / "second") == results(mapped / "first")
    first, second = record(mapped / "first"), record(mapped / "elsewhere" / "second")
    assert first["overrides"] == second["overrides"] == [MAP, SHORT, "image=other.png"]
    for key in ("points", "step", "precision", "steps", "max_displacement", "error_estimate", "sha256", "outputs"):
        assert first[key] == second[key]
    # A repeated run can be repeated.
    assert program("run", "--again", "second", "--out", "third", "--no-estimate").returncode == 0
    assert results(mapped / "elsewhere" / "third") == results(mapped / "first")
    assert record(mapped / "elsewhere" / "third")["error_estimate_reason"] == "not asked for"


def test_digests_of_pictures_in_the_record(mapped: Path, device: Device) -> None:
    made = load_scene("small.yaml", [MAP, SHORT])
    expected = {"image": sha256(mapped / "speckle.png"), "springs.map.image": sha256(mapped / "map.png")}
    assert run(made, "out", threads=device.threads)["sha256"] == record(mapped / "out")["sha256"] == expected
    assert run(made, "parts", threads=device.threads, progress=Stop(4))["sha256"] == expected
    assert resume("parts", threads=device.threads)["sha256"] == expected
    # A picture that is not drawn may be missing.
    gone = made.model_copy(update={"image": "gone.png", "output": ("trajectory",)})
    assert set(run(gone, "gone", threads=device.threads)["sha256"]) == {"springs.map.image"}


def test_repeated_interrupted_run_is_completed(small: Path, device: Device, program: Program) -> None:
    made = load_scene("small.yaml")
    run(made, "whole", threads=device.threads)
    assert run(made, "parts", threads=device.threads, progress=Stop(4))["status"] == "interrupted"
    done = program("run", "--again", "parts")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("parts: 5 frames")
    assert results(small / "parts") == results(small / "whole")


CHANGES: dict[str, Callable[[], object]] = {
    "picture changed": lambda: Image.fromarray(speckle(30, 40, 1)).save("speckle.png"),
    "map gone": Path("map.png").unlink,
    "SHA-256 forged": lambda: change(Path("out"), sha256={"springs.map.image": sha256(Path("map.png"))}),
}


@pytest.mark.parametrize("alter", CHANGES.values(), ids=CHANGES)
def test_changed_pictures_are_refused(
    alter: Callable[[], object], mapped: Path, device: Device, program: Program, message: Messages
) -> None:
    run(load_scene("small.yaml", [MAP, SHORT]), "out", threads=device.threads, estimate_error=False)
    alter()
    before = files(mapped)
    done = program("run", "--again", "out", "--out", "second")
    assert (done.returncode, done.stdout) == (4, "")
    message(done.stderr, "out: ")
    assert files(mapped) == before


def test_picture_changed_during_startup(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """The digest in the record is that of the drawn file."""

    def late(plan: Plan) -> dict[str, str]:
        digests = input_digests(plan)
        Image.fromarray(speckle(30, 40, 1)).save(small / "speckle.png")
        return digests

    monkeypatch.setattr("taichi_msm.runs.run.input_digests", late)
    with message.raises(SceneError, "image"):
        run(load_scene("small.yaml"), "out", threads=device.threads)


def test_playback_requires_the_pictures_of_the_run(mapped: Path, device: Device, message: Messages) -> None:
    run(load_scene("small.yaml", [MAP, SHORT]), "out", threads=device.threads, estimate_error=False)
    with Playback("out", threads=device.threads) as playback:
        np.testing.assert_array_equal(playback.draw(1), np.asarray(Image.open("out/frames/0001.png")))
        Path("speckle.png").unlink()
        playback.draw(2)  # the picture is already loaded
    with Playback("out", threads=device.threads) as playback:
        playback.labels(1)
        with message.raises(FilesError, "image"):
            playback.draw(1)
    Image.new("L", (3, 3), 9).save("map.png")
    with message.raises(FilesError, "springs.map.image"):
        Playback("out", threads=device.threads)
