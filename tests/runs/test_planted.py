"""Prepared folders: no foreign file, in them or behind their links, is read, changed or deleted."""

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
from taichi_msm.runs.checkpoint import is_unfinished, read_manifest
from taichi_msm.runs.writer import ResultWriter
from taichi_msm.scene.scene import Scene
from tests.golden import Messages
from tests.scenes import plan_of, scene, speckle

# Names that a run might reach through a link.
TREASURE = "notes.txt 0000.png frames state.npz run.json lock new/a.txt draft"

Plant = Callable[[Path, Path], None]


def small_scene() -> Scene:
    sheet = {"points": [3, 4], "size": [0.3, 0.4], "mass": 1e-3}
    return scene(image="texture.png", sheet=sheet, render={"size": [8, 6]}, probes=[], output=["png", "trajectory"])


def write(directory: Path, *, resumes: bool = False) -> None:
    """Run into a directory, without simulating."""
    made = small_scene()
    with ResultWriter(directory, plan_of(made), {}, resumes=resumes) as writer:
        for frame in range(made.time.frames + 1):
            writer.add(np.zeros((3, 4, 3)), {"": FrameOutputs(speckle(6, 8, frame))})
        writer.publish({"status": "complete"})


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Kind, and content or target, of every entry below a folder."""
    entries = {}
    for path in sorted(folder.rglob("*")):
        kind = stat.S_IFMT(path.lstat().st_mode)
        data = path.read_bytes() if stat.S_ISREG(kind) else b""
        entries[str(path.relative_to(folder))] = kind, os.fsencode(path.readlink()) if path.is_symlink() else data
    return entries


def plant(name: str, make: Callable[[Path, Path], object]) -> Plant:
    """Plant an entry that `make` creates from its path and the folder of the treasure."""

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


PLANTED = {
    "link at the staging folder": link(".partial"),
    "foreign file in the staging folder": file(".partial/notes.txt"),
    "link at the lock": link(".partial/lock", "lock"),
    "endless lock": link(".partial/lock", "/dev/zero"),
    "pipe at the lock": pipe(".partial/lock"),
    "link at the committed results": link(".partial/whole"),
    "pipe at the committed record": pipe(".partial/whole/run.json"),
    "committed record that lists files elsewhere": file(
        ".partial/whole/run.json", '{"outputs": "../../treasure/notes.txt"}'
    ),
    "link at the earlier record": link(".partial/earlier.json", "notes.txt"),
    "link at the new frames": link(".partial/new/frames"),
    "link at the checkpoint": link(".partial/checkpoint"),
    "link at the state": link(".partial/checkpoint/state.npz", "state.npz"),
    "pipe at the state": pipe(".partial/checkpoint/state.npz"),
    "link at the stored frames": link(".partial/checkpoint/frames", "frames"),
    "link at the draft of the state": link(".partial/checkpoint/state.new", "draft"),
    "foreign file in the checkpoint": file(".partial/checkpoint/draft"),
    "link at the frames": link("frames"),
    "link at a frame": link("frames/0000.png", "0000.png"),
    "folder at a frame": folder("frames/0003.png"),
    "foreign frame": file("frames/0003.png"),
    "foreign trajectory": file("trajectory.npz"),
    "link at the record": link("run.json", "run.json"),
    "record of another program": file("run.json", '{"a": 1}'),
    "record that is a list": file("run.json", "[1e999]"),
    "forged record": file(
        "run.json", json.dumps({"outputs": ["frames", "run.json", "../treasure/notes.txt"], "frames": 1e9})
    ),
}


@pytest.fixture
def treasure(tmp_path: Path) -> Path:
    for name in TREASURE.split():
        file(name, "precious")(tmp_path / "treasure", tmp_path)
    (tmp_path / "out").mkdir()
    return tmp_path / "treasure"


@pytest.mark.parametrize("case", PLANTED)
def test_planted_entries_are_refused(case: str, treasure: Path, message: Messages) -> None:
    out = treasure.parent / "out"
    PLANTED[case](out, treasure)
    precious, before = snapshot(treasure), snapshot(out)
    if case == "forged record":
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
def test_hard_link_in_a_checkpoint(name: str, treasure: Path) -> None:
    checkpoint = treasure.parent / "out" / ".partial" / "checkpoint"
    checkpoint.mkdir(parents=True)
    os.link(treasure / name, checkpoint / name)
    precious = snapshot(treasure)
    with pytest.raises(FilesError):
        write(treasure.parent / "out", resumes=True)
    assert snapshot(treasure) == precious
    write(treasure.parent / "out")
    assert snapshot(treasure) == precious


def test_link_at_the_default_folder(treasure: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """A folder named by an option may be a link; a default folder may have come with the scene."""
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
