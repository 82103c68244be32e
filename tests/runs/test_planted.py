"""Folders that somebody else has prepared: nothing of theirs, or beyond, is read, changed or removed."""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from taichi_msm.cli.common import result_directory
from taichi_msm.errors import FilesError
from taichi_msm.render.labels import FrameOutputs
from taichi_msm.runs.checkpoint import STATE_FILE, is_unfinished, read_manifest
from taichi_msm.runs.writer import ResultWriter
from taichi_msm.scene.scene import Scene
from tests.golden import Messages
from tests.scenes import plan_of, scene, speckle

# Everything that a run might reach beyond its folder.
TREASURE = "notes.txt 0000.png frames state.npz run.json lock new/a.txt draft"

Plant = Callable[[Path, Path], None]


def small_scene() -> Scene:
    sheet = {"points": [3, 4], "size": [0.3, 0.4], "mass": 1e-3}
    return scene(image="texture.png", sheet=sheet, render={"size": [8, 6]}, output=["png", "trajectory"])


def write(directory: Path, *, resumes: bool = False) -> None:
    """Run into a directory, without simulating."""
    made = small_scene()
    with ResultWriter(directory, plan_of(made), {}, resumes=resumes) as writer:
        for frame in range(made.time.frames + 1):
            writer.add(np.zeros((3, 4, 3)), {"": FrameOutputs(speckle(6, 8, frame))})
        writer.publish({"status": "complete"})


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Everything in a folder and below: kind, and what is in it or where it leads."""
    found = {}
    for path in sorted(folder.rglob("*")):
        kind = stat.S_IFMT(path.lstat().st_mode)
        data = path.read_bytes() if stat.S_ISREG(kind) else b""
        found[str(path.relative_to(folder))] = kind, os.fsencode(path.readlink()) if path.is_symlink() else data
    return found


def plant(name: str, make: Callable[[Path, Path], object]) -> Plant:
    """Plant what `make`, given its path and the folder of the treasure, makes."""

    def planted(out: Path, treasure: Path) -> None:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        make(out / name, treasure)

    return planted


def link(name: str, target: str = "") -> Plant:
    """Plant a symbolic link to the treasure, to a file in it, or to an absolute path."""
    return plant(name, lambda path, treasure: path.symlink_to(treasure / target))


def pipe(name: str) -> Plant:
    return plant(name, lambda path, treasure: os.mkfifo(path))


def file(name: str, text: str = "mine") -> Plant:
    return plant(name, lambda path, treasure: path.write_text(text))


def folder(name: str) -> Plant:
    return plant(name, lambda path, treasure: path.mkdir())


LIES = json.dumps({"outputs": ["frames", "run.json", "../treasure/notes.txt"], "frames": 1e9})

PLANTED = {
    "the staging folder leads elsewhere": link(".partial"),
    "the staging folder is the user's": file(".partial/notes.txt"),
    "the staging folder is a file": file(".partial"),
    "the lock leads elsewhere": link(".partial/lock", "lock"),
    "the lock never ends": link(".partial/lock", "/dev/zero"),
    "the lock is a pipe": pipe(".partial/lock"),
    "the whole results lead elsewhere": link(".partial/whole"),
    "the record of whole results is a pipe": pipe(".partial/whole/run.json"),
    "the record of whole results names what is elsewhere": file(
        ".partial/whole/run.json", '{"outputs": "../../treasure/notes.txt"}'
    ),
    "the earlier record leads elsewhere": link(".partial/earlier.json", "notes.txt"),
    "the new results lead elsewhere": link(".partial/new"),
    "the new frames lead elsewhere": link(".partial/new/frames"),
    "unknown link beside them": link(".partial/x"),
    "the checkpoint leads elsewhere": link(".partial/checkpoint"),
    "the state leads elsewhere": link(".partial/checkpoint/state.npz", "state.npz"),
    "the state is a pipe": pipe(".partial/checkpoint/state.npz"),
    "the stored frames lead elsewhere": link(".partial/checkpoint/frames", "frames"),
    "the draft leads elsewhere": link(".partial/checkpoint/state.new", "draft"),
    "unknown file beside them": file(".partial/checkpoint/draft"),
    "the state is a folder": folder(".partial/checkpoint/state.npz"),
    "the frames lead elsewhere": link("frames"),
    "the frames are a file": file("frames"),
    "a frame leads elsewhere": link("frames/0000.png", "0000.png"),
    "a frame is a folder": folder("frames/0003.png"),
    "a frame is the user's": file("frames/0003.png"),
    "the trajectory is the user's": file("trajectory.npz"),
    "the trajectory is a pipe": pipe("trajectory.npz"),
    "the record leads elsewhere": link("run.json", "run.json"),
    "the record is a folder": folder("run.json"),
    "the record is another program's": file("run.json", '{"a": 1}'),
    "the record is no list": file("run.json", "[1e999]"),
    "the record lies": file("run.json", LIES),
}


@pytest.fixture
def treasure(tmp_path: Path) -> Path:
    for name in TREASURE.split():
        file(name, "precious")(tmp_path / "treasure", tmp_path)
    (tmp_path / "out").mkdir()
    return tmp_path / "treasure"


@pytest.mark.parametrize("case", PLANTED)
def test_what_no_run_has_put_there_is_left_alone(case: str, treasure: Path, message: Messages) -> None:
    out = treasure.parent / "out"
    PLANTED[case](out, treasure)
    precious, before = snapshot(treasure), snapshot(out)
    if case == "the record lies":
        write(out)
        assert snapshot(treasure) == precious
        return
    for resumes in (False, True):
        with message.raises(FilesError):
            write(out, resumes=resumes)
        assert (snapshot(treasure), snapshot(out)) == (precious, before)
    if "the state" in case or "checkpoint" in case:
        assert not is_unfinished(out)
        with message.raises(FilesError):
            read_manifest(out)


@pytest.mark.parametrize("name", ["frames", "state.npz"])
def test_a_checkpoint_whose_file_has_another_name(name: str, treasure: Path) -> None:
    """A hard link to what is elsewhere is not written to."""
    checkpoint = treasure.parent / "out" / ".partial" / "checkpoint"
    checkpoint.mkdir(parents=True)
    os.link(treasure / name, checkpoint / name)
    precious = snapshot(treasure)
    with pytest.raises(FilesError):
        write(treasure.parent / "out", resumes=True)
    assert snapshot(treasure) == precious
    write(treasure.parent / "out")
    assert snapshot(treasure) == precious


def test_the_default_folder_is_not_reached_by_a_link(
    treasure: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """Who names a folder may name a link; what came with a scene may not choose for them."""
    monkeypatch.chdir(treasure.parent)
    Path("output").mkdir()
    assert result_directory(None, "press") == Path("output/press")
    Path("output/press").symlink_to(treasure)
    with message.raises(FilesError, "output/press"):
        result_directory(None, "press")
    shutil.rmtree("output")
    Path("output").symlink_to(treasure)
    with message.raises(FilesError, "output"):
        result_directory(None, "press")
    assert result_directory("output/press", "press") == Path("output/press")


def test_a_plan_alone_is_enough_to_be_unfinished(tmp_path: Path) -> None:
    file(f".partial/checkpoint/{STATE_FILE}")(tmp_path, tmp_path)
    assert is_unfinished(tmp_path)
