"""A run that is repeated from its run.json."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taichi_msm.errors import FilesError, SceneError
from taichi_msm.load.scene_file import load_plan, load_scene
from taichi_msm.model.plan import Plan
from taichi_msm.runs.finished import RESTORE_PICTURE, read_run
from taichi_msm.runs.manifest import input_digests
from taichi_msm.runs.playback import Playback
from taichi_msm.runs.run import resume, run
from taichi_msm.runs.writer import RunRecord
from taichi_msm.solver.planning import stable_steps
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.outputs import files, results
from tests.runs.test_finished import change, change_scene
from tests.runs.test_resume import Stop
from tests.scenes import speckle

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


def test_results_go_where_they_were(mapped: Path, program: Program) -> None:
    assert program("run", "small.yaml", "--set", SHORT, "--out", "first").returncode == 0
    before, told = results(mapped / "first"), record(mapped / "first")
    (mapped / "first" / "frames" / "0001.png").unlink()
    done = program("run", "--again", "first")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("first: 3 frames")
    assert results(mapped / "first") == before
    again = record(mapped / "first")
    assert again["timings"] != told["timings"]
    for key in ("scene", "working_directory", "overrides", "sha256"):
        assert again[key] == told[key]


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


def test_an_interrupted_run_is_repeated_to_its_end(mapped: Path, device: Device, program: Program) -> None:
    made = load_scene("small.yaml")
    whole = run(made, "whole", threads=device.threads)
    assert run(made, "parts", threads=device.threads, progress=Stop(4))["status"] == "interrupted"
    assert program("run", "--again", "parts", "--quiet").returncode == 0
    assert record(mapped / "parts")["frames"] == whole["frames"]
    assert results(mapped / "parts") == results(mapped / "whole")


CHANGES: dict[str, tuple[Callable[[], object], str]] = {
    "picture gone": (Path("speckle.png").unlink, "image: speckle.png: no such file or directory"),
    "picture changed": (
        lambda: Image.fromarray(speckle(30, 40, 1)).save("speckle.png"),
        "image: speckle.png is not the file of the run, by its SHA-256",
    ),
    "map gone": (Path("map.png").unlink, "springs.map.image: map.png: no such file or directory"),
    "map changed": (
        lambda: Image.new("L", (3, 3), 9).save("map.png"),
        "springs.map.image: map.png is not the file of the run, by its SHA-256",
    ),
    "SHA-256 forged": (
        lambda: change(Path("out"), sha256={"springs.map.image": sha256(Path("map.png"))}),
        "image: speckle.png is not the file of the run, by its SHA-256",
    ),
}


@pytest.mark.parametrize(("alter", "said"), CHANGES.values(), ids=CHANGES)
def test_other_pictures_are_refused(
    alter: Callable[[], object], said: str, mapped: Path, device: Device, program: Program
) -> None:
    run(load_scene("small.yaml", [MAP, SHORT]), "out", threads=device.threads, estimate_error=False)
    alter()
    before = files(mapped)
    done = program("run", "--again", "out", "--out", "second")
    assert (done.returncode, done.stdout, done.stderr) == (4, "", f"out: {said}; {RESTORE_PICTURE}\n")
    assert files(mapped) == before


def test_a_record_that_names_a_picture_elsewhere_draws_nothing_of_it(results: Path, program: Program) -> None:
    secret = results.parent / "secret.png"
    Image.fromarray(speckle(30, 40, 3)).save(secret)
    change_scene(results, image="../secret.png")
    change(results, working_directory=str(results))
    done = program("run", "--again", str(results), "--out", str(results.parent / "second"))
    assert done.returncode == 4
    assert "secret.png is not the file of the run" in done.stderr
    assert not (results.parent / "second").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["small.yaml"], 2, "--again repeats a run with its own settings; leave out SCENE"),
        (["--set", SHORT], 2, "--again repeats a run with its own settings; leave out --set"),
        (["--image", "map.png"], 2, "--again repeats a run with its own settings; leave out --image"),
        (["--resume", "out"], 2, "--resume continues a run with its own settings; leave out --again"),
        (["--out", ""], 2, "Invalid value for --out: is empty; name a directory"),
    ],
)
def test_other_settings_are_refused(
    arguments: list[str], code: int, said: str, small: Path, ran: Path, program: Program
) -> None:
    before = files(small)
    done = program("run", "--again", str(ran), *arguments)
    assert (done.returncode, done.stderr) == (code, f"taichi-msm: {said} (see taichi-msm --help)\n")
    assert files(small) == before


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"overrides": "image=x"}, "run.json: damaged, or not of this run; run the scene again"),
        ({"overrides": [3]}, "run.json: damaged, or not of this run; run the scene again"),
        ({"sha256": None}, "run.json: damaged, or not of this run; run the scene again"),
        ({"sha256": {"image": 3}}, "run.json: damaged, or not of this run; run the scene again"),
        ({"scene": {}}, "run.json: damaged, or not of this run; run the scene again"),
    ],
)
def test_a_damaged_record_is_not_repeated(keys: dict[str, object], said: str, results: Path, program: Program) -> None:
    change(results, **keys)
    before = files(results)
    done = program("run", "--again", str(results))
    assert (done.returncode, done.stderr) == (4, f"{results}/{said}\n")
    assert files(results) == before
    assert program("run", "--again", "nowhere").stderr.startswith("nowhere: no results of a run; name the folder")
    assert program("run", "--again", "").returncode == 2


def test_a_picture_that_changes_while_a_run_starts_is_noticed(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The record tells of the file that was drawn."""

    def late(plan: Plan) -> dict[str, str]:
        found = input_digests(plan)
        Image.fromarray(speckle(30, 40, 1)).save(small / "speckle.png")
        return found

    monkeypatch.setattr("taichi_msm.runs.run.input_digests", late)
    with pytest.raises(SceneError, match=r"^image: speckle.png is not the file of the run"):
        run(load_scene("small.yaml"), "out", threads=device.threads)


def test_a_playback_draws_the_picture_that_was_run(mapped: Path, device: Device) -> None:
    run(load_scene("small.yaml", [MAP, SHORT]), "out", threads=device.threads, estimate_error=False)
    with Playback("out", threads=device.threads) as playback:
        np.testing.assert_array_equal(playback.draw(1), np.asarray(Image.open("out/frames/0001.png")))
        Path("speckle.png").unlink()
        playback.draw(2)  # it was read before
    with Playback("out", threads=device.threads) as playback:
        playback.labels(1)
        with pytest.raises(FilesError, match=r"^out: image: speckle.png: no such file or directory; put back"):
            playback.draw(1)
    Image.new("L", (3, 3), 9).save("map.png")
    with pytest.raises(FilesError, match=r"^out: springs.map.image: map.png is not the file of the run"):
        Playback("out", threads=device.threads)


def test_another_run_is_noticed_while_results_are_read(results: Path) -> None:
    found = read_run(results)
    with found.unchanged():
        found.positions()
    with (
        pytest.raises(FilesError, match="another run replaced these results"),
        found.unchanged(),
    ):
        change(results, steps=3)


def test_a_step_was_good_for_the_map_that_was_run(mapped: Path, device: Device) -> None:
    """A stiffer map in its place would refuse it, but has no part in reading the positions."""
    Image.new("L", (3, 3), 0).save("map.png")
    steps = stable_steps(load_plan("small.yaml", [MAP, SHORT]))
    scene = load_scene("small.yaml", [MAP, SHORT, f"time.step={0.1 / steps}"])
    run(scene, "out", threads=device.threads, estimate_error=False)
    Image.new("L", (3, 3), 255).save("map.png")
    with pytest.raises(SceneError, match="above the stability limit"):
        load_scene("small.yaml", [MAP, SHORT, f"time.step={0.1 / steps}"])
    assert len(read_run("out").positions()) == scene.time.frames + 1
