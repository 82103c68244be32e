"""The command that converts results: what it writes where, and what it says when it cannot."""

from __future__ import annotations

import errno
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taichi_msm.errors import FilesError, ForeignError
from taichi_msm.exports import obj
from taichi_msm.exports.export import export
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.run import run
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files
from tests.runs.test_finished import change, change_scene, rewrite
from tests.scenes import speckle


def exported(results: Path, out: Path) -> list[str]:
    """Export as OBJ, which takes nothing but a trajectory, to a folder."""
    return export(results, "obj", out).files


def test_default_folder(results: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(results.parent)
    before = files(results)
    done = program("export", "results", "--format", "obj")
    assert (done.returncode, done.stdout, done.stderr) == (0, "results/export-obj: 8 files\n", "")
    assert {name: data for name, data in files(results).items() if not name.startswith("export-obj")} == before


def test_json_and_text_on_stdout(results: Path, program: Program) -> None:
    done = program("export", str(results), "--format", "gltf", "--out", str(results / "here"), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    here = str(results / "here")
    names = ["index.csv", "surface.glb"]
    assert json.loads(done.stdout) == {"directory": here, "format": "gltf", "files": names, "notes": []}
    assert program("export", str(results), "--format", "gltf", "--quiet").stdout == ""
    done = program("export", str(results), "--format", "gltf")
    assert done.stdout == f"{results}/export-gltf: index.csv, surface.glb\n"


WRONG = {
    "nowhere": ["nowhere", "--format", "obj"],
    "flow": ["results", "--format", "kitti"],
    "tracks": ["results", "--format", "tapvid"],
    "trajectory": ["without", "--format", "obj"],
    "picture": ["moved", "--format", "gltf"],
    "record as folder": ["results", "--format", "obj", "--out", "results/run.json"],
    "long folder": ["results", "--format", "obj", "--out", 300 * "x"],
    "long name": [300 * "x", "--format", "obj"],
}


@pytest.mark.parametrize("arguments", WRONG.values(), ids=WRONG)
def test_invalid_arguments_and_results(
    arguments: list[str], results: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.chdir(results.parent)
    if arguments[0] in ("without", "moved"):
        results.rename(arguments[0])
        Path("without/trajectory.npz").unlink(missing_ok=True)
        if arguments[0] == "moved":
            change_scene(Path("moved"), image="/none/gone.png")
    before = files(Path())
    done = program("export", *arguments)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (4, "", 1)
    # From Python 3.14 on, a folder whose name is too long is one that is not there.
    message(done.stderr, hide=r"x{300}(/export-obj: file name too long|: no results of a run.*)")
    assert files(Path()) == before
    assert not list(Path().glob("*/export-*")), "a folder that was made for nothing goes"


def test_new_export_replaces_the_earlier_one(results: Path) -> None:
    """All of it: files that the new one lacks go with their folders, and so does what a killed process left."""
    out = results / "here"
    names = exported(results, out)
    whole = files(out)
    stale = ["0099.obj", "0001.obj", "training/flow_occ/000000_10.png"]
    for name in (*stale, ".partial/new/0000.obj"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("of an earlier export")
    (out / "export.json").write_text(json.dumps({"files": stale + names}))
    assert exported(results, out) == names == sorted(set(whole) - {"export.json"})
    assert files(out) == whole
    assert {path.name for path in out.iterdir()} == {*names, "export.json"}


def test_foreign_file_with_the_name_of_an_export(results: Path, message: Messages) -> None:
    out = results / "here"
    out.mkdir()
    for name in ("picture.png", "0000.obj"):
        (out / name).write_text("mine")
        with message.raises(ForeignError, name):
            exported(results, out)
        assert files(out) == {name: b"mine"}
        (out / name).unlink()


def test_concurrent_exports(results: Path, message: Messages) -> None:
    out = results / "here"

    def second(done: int, total: int) -> None:
        if done == 2:
            with message.raises(FilesError, "--out"):
                exported(results, out)

    names = export(results, "obj", out, second).files
    assert set(files(out)) == {*names, "export.json"}


# Does not start the compiler either.
KILLED = """
import os, signal, sys
from pathlib import Path
from taichi_msm.exports.export import export

def progress(done, total):
    assert not {"taichi", "quadrants"} & set(sys.modules)
    if done == 3:
        os.kill(os.getpid(), signal.SIGKILL)

export(Path(sys.argv[1]), "obj", Path(sys.argv[3]))
export(Path(sys.argv[1]), "obj", Path(sys.argv[2]), progress)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="kills with SIGKILL")
def test_killed_export(results: Path) -> None:
    """Also to one of another format; and one that ends has the same bytes in another process."""
    out, there = results / "here", results / "there"
    exported(results, out)
    before = files(out)
    killed = subprocess.run([sys.executable, "-c", KILLED, str(results), str(out), str(there)], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert files(there) == before
    left = {path: data for path, data in files(out).items() if not path.startswith(".")}
    assert left == before
    assert set(files(out)) > set(before), "it had begun"
    for name in ("gltf", "obj"):
        shutil.copytree(out, results / name)
        names = export(results, name, results / name).files
        assert {path.name for path in (results / name).iterdir()} == {*names, "export.json"}
        assert name != "obj" or files(results / name) == before


def test_forged_export_record(results: Path, message: Messages) -> None:
    out = results / "here"
    names = exported(results, out)
    before = files(out)
    for listed in (["a/" * 5000 + "b"], ["../run.json", "training", 3], []):
        (out / "export.json").write_text(json.dumps({"files": [*names, *listed]}))
        exported(results, out)
        assert files(out) == before
    (out / "notes.txt").write_text("mine")
    (out / "export.json").write_text(json.dumps({"files": [*names, "notes.txt"]}))
    with message.raises(ForeignError, "notes.txt"):
        exported(results, out)
    assert (out / "notes.txt").read_text() == "mine"
    for record in ("[" * 10**5, '{"files": [[]]}', '{"files": null}', "3", "{}"):
        (out / "export.json").write_text(record)
        with message.raises(ForeignError, "export.json"):
            exported(results, out)


@pytest.mark.parametrize("moment", [0, 2])
def test_run_published_during_an_export(moment: int, results: Path, device: Device, message: Messages) -> None:
    """No file of an export is of another run than the others."""
    out = results / "here"
    exported(results, out)
    before = files(out)

    def publish(done: int, total: int) -> None:
        if done == moment and not (results / "trajectory.npz").stat().st_mtime_ns > begun:
            run(read_run(results).scene, results, threads=device.threads, estimate_error=False)

    begun = (results / "trajectory.npz").stat().st_mtime_ns
    with message.raises(FilesError):
        export(results, "obj", out, publish)
    assert files(out) == before


def test_results_removed_during_an_export(results: Path, message: Messages) -> None:
    def take_away(done: int, total: int) -> None:
        (results / "run.json").unlink(missing_ok=True)
        (results / "trajectory.npz").unlink(missing_ok=True)

    with message.raises(FilesError):
        export(results, "obj", results / "here", take_away)


def secret(results: Path) -> str:
    """A picture of the user that is no concern of the results."""
    path = results.parent / "private" / "secret.png"
    path.parent.mkdir()
    Image.fromarray(speckle(5, 6, 3)).save(path)
    return str(path)


@pytest.mark.parametrize("name", ["gltf", "obj", "vtk"])
def test_forged_picture_path(name: str, results: Path, message: Messages) -> None:
    change_scene(results, image=secret(results))
    for digests in ({"image": "0" * 64}, {}):
        change(results, sha256=digests)
        with message.raises(FilesError, "secret.png"):
            export(results, name)
        assert not (results / f"export-{name}").exists()


def test_forged_map_path(results: Path, message: Messages) -> None:
    change_scene(results, springs={"map": {"image": secret(results), "range": [1.0, 2.0]}})
    with message.raises(FilesError, "springs.map.image", "secret.png"):
        export(results, "vtk")


@pytest.mark.parametrize("name", ["trajectory.npz", "frames/0001.png", "frames"])
def test_linked_results(name: str, results: Path, message: Messages) -> None:
    (results.parent / "elsewhere").mkdir()
    moved = (results / name).rename(results.parent / "elsewhere" / Path(name).name)
    (results / name).symlink_to(moved)
    found = read_run(results)
    with message.raises(FilesError, name):
        found.positions() if name == "trajectory.npz" else found.result_path("png", 1)


@pytest.mark.parametrize("name", ["gltf", "obj", "vtk"])
def test_implausible_positions(name: str, results: Path, message: Messages) -> None:
    rewrite(results, edit=lambda position: position * np.array([1, 1, 1e300, 1e300, 1])[:, None, None, None])
    with message.raises(FilesError, "trajectory.npz"):
        export(results, name)


def test_overflow_in_a_format(results: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    def overflow(*_: object) -> Iterator[list[str]]:
        yield [str(np.float32(1) * np.array([1e300]).astype(np.float32))]

    monkeypatch.setattr(obj, "write", overflow)
    with message.raises(FilesError):
        exported(results, results / "here")
    assert not (results / "here").exists()


@pytest.mark.parametrize("name", ["notes.txt", "sub/0000.obj", "0000.obj.bak", "0000.obj/x"])
def test_foreign_files_in_the_folder(name: str, results: Path, message: Messages) -> None:
    out = results / "here"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("mine")
    calls = []
    with message.raises(ForeignError):
        export(results, "obj", out, lambda done, total: calls.append(done))
    assert calls == [0], "before anything is made"
    assert files(out) == {name: b"mine"}
    with pytest.raises(ForeignError):
        exported(results, results)


def test_linked_default_folder(results: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """A folder that nobody named may have come with the results."""
    monkeypatch.chdir(results.parent)
    Path("elsewhere").mkdir()
    for link, runs in ((results / "export-obj", results), (Path("output"), [results, results])):
        link.symlink_to(results.parent / "elsewhere")
        with message.raises(FilesError, link.name):
            export(runs, "obj")
    assert files(Path("elsewhere")) == {}


def test_failed_export(results: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    out = results / "here"
    exported(results, out)
    before = files(out)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(obj, "create_file", full)
        for folder in (out, results / "nothing"):
            with message.raises(FilesError, folder.name):
                exported(results, folder)
    (results / "trajectory.npz").write_bytes(b"")
    with message.raises(FilesError, "trajectory.npz"):
        exported(results, out)
    assert files(out) == before
    assert not (results / "nothing").exists()


@pytest.mark.parametrize("name", ["gltf", "obj", "vtk"])
def test_interrupted_export(name: str, results: Path) -> None:
    out = results / "here"
    export(results, name, out)
    before, calls = files(out), []

    def interrupt(done: int, total: int) -> None:
        calls.append((done, total))
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(results, name, out, interrupt)
    assert calls[0] == (0, 5)
    assert [done for done, _ in calls[1:]] == [0, 1, 2, 3], "it says how far it is, frame by frame"
    assert files(out) == before
    assert [path.name for path in out.iterdir() if path.name.startswith(".")] == []


def test_interrupted_command(
    results: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("taichi_msm.system.process.Interruption.raise_if_requested", interrupt)
    done = program("export", str(results), "--format", "obj", "--json")
    assert done.returncode == 130
    message(done.stderr)
    assert json.loads(done.stdout)["status"] == "interrupted"
