"""What a run has written is read again as it was, and what no run has written is not."""

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
from taichi_msm.load.scene_file import load_plan, load_scene
from taichi_msm.model.plan import Plan
from taichi_msm.runs.checkpoint import input_digests
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.playback import Playback
from taichi_msm.runs.run import resume, run
from taichi_msm.runs.writer import RunRecord
from taichi_msm.solver.planning import stable_steps
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


def test_a_run_is_read_as_it_was(ran: Path) -> None:
    run = read_run(ran)
    assert (run.directory, run.frames) == (ran, 5)
    np.testing.assert_array_equal(run.time, [0, 0.1, 0.2, 0.3, 0.4])
    written = np.load(ran / "trajectory.npz")
    positions = run.positions()
    assert positions.dtype == np.float64
    assert not positions.flags.writeable
    np.testing.assert_array_equal(positions, written["position"])
    np.testing.assert_array_equal(run.time, written["time"])
    assert run.scene.time.precision == "f64"
    assert run.result_path("png", 4) == ran / "frames" / "0004.png"


def test_pictures_are_found_from_where_the_run_was(results: Path) -> None:
    Image.fromarray(speckle(4, 4)).save(results / "map.png")
    stiffness = {"structural": 20.0, "map": {"image": "sub/../map.png", "range": [1.0, 2.0]}}
    change_scene(results, image="sub/speckle.png", springs=stiffness)
    change(results, working_directory=str(results))
    (results / "sub").mkdir()
    made = read_run(results).scene
    assert made.image == str(results / "sub" / "speckle.png")
    assert made.stiffness_map is not None
    assert made.stiffness_map.image == str(results / "sub" / ".." / "map.png")
    change_scene(results, image=None, output=["trajectory"])
    assert read_run(results).scene.image is None


def test_a_picture_that_is_gone_is_no_damage(results: Path) -> None:
    """Not everything that is made of a run needs it."""
    change_scene(results, image="gone.png", springs={"map": {"image": "gone.png", "range": [1.0, 2.0]}})
    assert read_run(results).frames == 5


def test_what_is_missing_is_named_with_the_remedy(results: Path, message: Messages) -> None:
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
def test_a_folder_without_a_run_is_told_of(name: str, results: Path, message: Messages) -> None:
    (results / "empty").mkdir()
    with message.raises(FilesError, name):
        read_run(results / name)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "cut short": lambda path: (path / "run.json").write_bytes((path / "run.json").read_bytes()[:-20]),
    "not UTF-8": lambda path: (path / "run.json").write_bytes(b'{"frames": "\xff"}'),
    "deep": lambda path: (path / "run.json").write_text("[" * 200_000),
    "no scene": lambda path: change(path, scene=None),
    "no frames": lambda path: change(path, frames=None),
    "no working directory": lambda path: change(path, working_directory=None),
    "too many frames": lambda path: change(path, frames=6),
    "no frame": lambda path: change(path, frames=0),
    "a name for frames": lambda path: change(path, frames="5"),
    "unknown precision": lambda path: change_scene(path, time={"precision": "auto"}),
    "a number for a folder": lambda path: change(path, working_directory=3),
    "an unknown key": lambda path: change_scene(path, sheet={"colour": 3}),
    "an eye at its target": lambda path: change_scene(
        path, render={"camera": {"eye": [0.0, 0.0, 0.0], "target": [0.0, 0.0, 0.0]}}
    ),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_record_is_one_line(damage: Callable[[Path], object], results: Path) -> None:
    damage(results)
    with pytest.raises(FilesError, match=r"run\.json: damaged"):
        read_run(results)


def rewrite(
    results: Path,
    name: str = "position",
    edit: Callable[[Any], Any] = lambda position: position,
    save: Callable[..., Any] = np.savez,
) -> None:
    """Write the trajectory anew, after `edit` made something else of its positions."""
    position = np.load(results / "trajectory.npz")["position"]
    save(results / "trajectory.npz", **{name: edit(position)})


def cut(results: Path, length: int) -> None:
    path = results / "trajectory.npz"
    path.write_bytes(path.read_bytes()[:length])


def claim_to_be_huge(results: Path) -> None:
    """A header and a record may both say so; the file is as long as it is."""
    with zipfile.ZipFile(results / "trajectory.npz", "w") as archive:
        archive.writestr("position.npy", np.lib.format.magic(1, 0) + b"v\0{'descr': '<f8', 'shape': (1000000000,)}")
    change_scene(results, time={"duration": 1e8})
    change(results, frames=10**9)


def with_nan(position: Any) -> Any:
    position[3, 4, 5, 1] = np.nan
    return position


FORGERIES: dict[str, Callable[[Path], object]] = {
    "compressed": lambda path: rewrite(path, save=np.savez_compressed),
    "of other numbers": lambda path: rewrite(path, edit=lambda position: position.astype(np.float32)),
    "of fewer frames": lambda path: rewrite(path, edit=lambda position: position[:-1]),
    "of another shape": lambda path: rewrite(path, edit=lambda position: position.reshape(5, 11, 9, 3)),
    "in another order": lambda path: rewrite(path, edit=np.asfortranarray),
    "with NaN": lambda path: rewrite(path, edit=with_nan),
    "that begins elsewhere": lambda path: rewrite(path, edit=lambda position: position + 1e-9),
    "without positions": lambda path: rewrite(path, name="place"),
    "empty": lambda path: cut(path, 0),
    "a part": lambda path: cut(path, 1000),
    "cut short": lambda path: cut(path, -1),
    "huge": claim_to_be_huge,
    "of another sheet": lambda path: change_scene(path, sheet={"size": [0.3, 0.5]}),
}


@pytest.mark.parametrize("forge", FORGERIES.values(), ids=FORGERIES)
def test_a_forged_trajectory_is_refused(forge: Callable[[Path], object], results: Path) -> None:
    rewrite(results)
    assert len(read_run(results).positions()) == 5, "NumPy's own files are taken"
    forge(results)
    with pytest.raises(FilesError, match=r"trajectory\.npz: damaged"):
        read_run(results).positions()


def test_a_flipped_bit_is_found_or_does_no_harm(results: Path, message: Messages) -> None:
    """The zip format has bytes that say nothing, such as dates; no other positions are ever read."""
    path, run = results / "trajectory.npz", read_run(results)
    whole, positions = path.read_bytes(), np.array(run.positions())
    rng = np.random.default_rng(0)
    # All of the headers at both ends, and places between.
    places = [*range(200), *range(len(whole) - 400, len(whole)), *rng.integers(200, len(whole) - 400, 200).tolist()]
    errors = set()
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.unlink()  # what is mapped stays as it was
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
    found: RunRecord = json.loads((directory / "run.json").read_text())
    return found


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_run_is_repeated_to_the_bit_from_anywhere(
    mapped: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    # And a repeated run can be repeated.
    assert program("run", "--again", "second", "--out", "third", "--no-estimate").returncode == 0
    assert results(mapped / "elsewhere" / "third") == results(mapped / "first")
    assert record(mapped / "elsewhere" / "third")["error_estimate_reason"] == "not asked for"


def test_the_record_has_the_sha_256_of_every_picture(mapped: Path, device: Device) -> None:
    made = load_scene("small.yaml", [MAP, SHORT])
    told = run(made, "out", threads=device.threads)
    expected = {"image": sha256(mapped / "speckle.png"), "springs.map.image": sha256(mapped / "map.png")}
    assert told["sha256"] == record(mapped / "out")["sha256"] == expected
    assert run(made, "parts", threads=device.threads, progress=Stop(4))["sha256"] == expected
    assert resume("parts", threads=device.threads)["sha256"] == expected
    # What is not drawn need not be there.
    gone = made.model_copy(update={"image": "gone.png", "output": ("trajectory",)})
    assert set(run(gone, "gone", threads=device.threads)["sha256"]) == {"springs.map.image"}


def test_an_interrupted_run_is_repeated_to_its_end_where_it_was(small: Path, device: Device, program: Program) -> None:
    made = load_scene("small.yaml")
    run(made, "whole", threads=device.threads)
    assert run(made, "parts", threads=device.threads, progress=Stop(4))["status"] == "interrupted"
    done = program("run", "--again", "parts")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("parts: 5 frames")
    assert results(small / "parts") == results(small / "whole")


CHANGES: dict[str, Callable[[], object]] = {
    "picture gone": Path("speckle.png").unlink,
    "picture changed": lambda: Image.fromarray(speckle(30, 40, 1)).save("speckle.png"),
    "map gone": Path("map.png").unlink,
    "map changed": lambda: Image.new("L", (3, 3), 9).save("map.png"),
    "SHA-256 forged": lambda: change(Path("out"), sha256={"springs.map.image": sha256(Path("map.png"))}),
}


@pytest.mark.parametrize("alter", CHANGES.values(), ids=CHANGES)
def test_other_pictures_are_refused(
    alter: Callable[[], object], mapped: Path, device: Device, program: Program, message: Messages
) -> None:
    run(load_scene("small.yaml", [MAP, SHORT]), "out", threads=device.threads, estimate_error=False)
    alter()
    before = files(mapped)
    done = program("run", "--again", "out", "--out", "second")
    assert (done.returncode, done.stdout) == (4, "")
    message(done.stderr, "out: ")
    assert files(mapped) == before


def test_a_damaged_record_is_not_repeated(results: Path, program: Program, message: Messages) -> None:
    whole = record(results)
    for keys in ({"overrides": "image=x"}, {"overrides": [3]}, {"sha256": None}, {"sha256": {"image": 3}}):
        change(results, **{**whole, **keys})
        before = files(results)
        done = program("run", "--again", str(results))
        assert (done.returncode, done.stdout) == (4, "")
        message(done.stderr, "run.json")
        assert files(results) == before


def test_a_picture_that_changes_while_a_run_starts_is_noticed(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """The record tells of the file that was drawn."""

    def late(plan: Plan) -> dict[str, str]:
        found = input_digests(plan)
        Image.fromarray(speckle(30, 40, 1)).save(small / "speckle.png")
        return found

    monkeypatch.setattr("taichi_msm.runs.run.input_digests", late)
    with message.raises(SceneError, "image"):
        run(load_scene("small.yaml"), "out", threads=device.threads)


def test_a_playback_draws_the_picture_that_was_run(mapped: Path, device: Device, message: Messages) -> None:
    run(load_scene("small.yaml", [MAP, SHORT]), "out", threads=device.threads, estimate_error=False)
    with Playback("out", threads=device.threads) as playback:
        np.testing.assert_array_equal(playback.draw(1), np.asarray(Image.open("out/frames/0001.png")))
        Path("speckle.png").unlink()
        playback.draw(2)  # it was read before
    with Playback("out", threads=device.threads) as playback:
        playback.labels(1)
        with message.raises(FilesError, "image"):
            playback.draw(1)
    Image.new("L", (3, 3), 9).save("map.png")
    with message.raises(FilesError, "springs.map.image"):
        Playback("out", threads=device.threads)


def test_a_step_was_good_for_the_map_that_was_run(mapped: Path, device: Device, message: Messages) -> None:
    """A stiffer map in its place would refuse it, but has no part in reading the positions."""
    Image.new("L", (3, 3), 0).save("map.png")
    steps = stable_steps(load_plan("small.yaml", [MAP, SHORT]))
    scene = load_scene("small.yaml", [MAP, SHORT, f"time.step={0.1 / steps}"])
    run(scene, "out", threads=device.threads, estimate_error=False)
    Image.new("L", (3, 3), 255).save("map.png")
    with message.raises(SceneError, "time.step"):
        load_scene("small.yaml", [MAP, SHORT, f"time.step={0.1 / steps}"])
    assert len(read_run("out").positions()) == scene.time.frames + 1
