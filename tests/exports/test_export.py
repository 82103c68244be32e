"""The command export: folders, replacement, faults, interruption, foreign and forged files."""

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
    """Export as OBJ, which needs the trajectory only."""
    return export(results, "obj", out).files


def test_output_of_the_command(results: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(results.parent)
    before = files(results)
    done = program("export", "results", "--format", "obj")
    assert (done.returncode, done.stdout, done.stderr) == (0, "results/export-obj: 8 files\n", "")
    assert {name: data for name, data in files(results).items() if not name.startswith("export-obj")} == before
    names = ["index.csv", "surface.glb"]
    done = program("export", "results", "--format", "gltf", "--out", "out", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout) == {"directory": "out", "format": "gltf", "files": names, "notes": []}
    assert program("export", "results", "--format", "gltf", "--quiet").stdout == ""
    done = program("export", "results", "--format", "gltf")
    assert done.stdout == "results/export-gltf: index.csv, surface.glb\n"


WRONG = {
    "nowhere": ["nowhere", "--format", "obj"],
    "flow": ["results", "--format", "kitti"],
    "tracks": ["results", "--format", "tapvid"],
    "trajectory": ["without", "--format", "obj"],
    "picture": ["moved", "--format", "gltf"],
    "record as folder": ["results", "--format", "obj", "--out", "results/run.json"],
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
    message(done.stderr)
    assert files(Path()) == before
    assert not list(Path().glob("*/export-*"))


def test_new_export_replaces_the_earlier_one(results: Path) -> None:
    """Files that the new one lacks are removed with their folders, and so are those of a killed process."""
    out = results / "out"
    names = exported(results, out)
    expected = files(out)
    stale = ["0099.obj", "0001.obj", "training/flow_occ/000000_10.png"]
    for name in (*stale, ".partial/new/0000.obj"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("of an earlier export")
    (out / "export.json").write_text(json.dumps({"files": stale + names}))
    assert exported(results, out) == names == sorted(set(expected) - {"export.json"})
    assert files(out) == expected
    assert {path.name for path in out.iterdir()} == {*names, "export.json"}


@pytest.mark.parametrize("name", ["picture.png", "0000.obj", "notes.txt", "sub/0000.obj", "0000.obj/x"])
def test_foreign_files_in_the_folder(name: str, results: Path, message: Messages) -> None:
    out = results / "out"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("mine")
    calls = []
    with message.raises(ForeignError, name.partition("/")[0]):
        export(results, "obj", out, lambda done, total: calls.append(done))
    assert calls == [0], "before any file is written"
    assert files(out) == {name: b"mine"}
    with pytest.raises(ForeignError):
        exported(results, results)


def test_concurrent_exports(results: Path, message: Messages) -> None:
    out = results / "out"

    def second(done: int, total: int) -> None:
        if done == 2:
            with message.raises(FilesError, "--out"):
                exported(results, out)

    names = export(results, "obj", out, second).files
    assert set(files(out)) == {*names, "export.json"}


# An export starts no compiler.
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
    """The next export, also of another format, replaces it; another process exports the same bytes."""
    out, second = results / "out", results / "second"
    exported(results, out)
    before = files(out)
    killed = subprocess.run([sys.executable, "-c", KILLED, str(results), str(out), str(second)], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert files(second) == before
    assert {path: data for path, data in files(out).items() if not path.startswith(".")} == before
    assert set(files(out)) > set(before), "killed after its beginning"
    for name in ("gltf", "obj"):
        shutil.copytree(out, results / name)
        names = export(results, name, results / name).files
        assert {path.name for path in (results / name).iterdir()} == {*names, "export.json"}
        assert name != "obj" or files(results / name) == before


def test_forged_export_record(results: Path, message: Messages) -> None:
    out = results / "out"
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
    for record in ("[" * 10**5, '{"files": [[]]}', "{}"):
        (out / "export.json").write_text(record)
        with message.raises(ForeignError, "export.json"):
            exported(results, out)


def test_run_published_during_an_export(results: Path, device: Device, message: Messages) -> None:
    out = results / "out"
    exported(results, out)
    before = files(out)

    def publish(done: int, total: int) -> None:
        if done == 2 and not (results / "trajectory.npz").stat().st_mtime_ns > begun:
            run(read_run(results).scene, results, threads=device.threads, estimate_error=False)

    begun = (results / "trajectory.npz").stat().st_mtime_ns
    with message.raises(FilesError):
        export(results, "obj", out, publish)
    assert files(out) == before


def test_results_removed_during_an_export(results: Path, message: Messages) -> None:
    def remove(done: int, total: int) -> None:
        (results / "run.json").unlink(missing_ok=True)
        (results / "trajectory.npz").unlink(missing_ok=True)

    with message.raises(FilesError):
        export(results, "obj", results / "out", remove)


def secret(results: Path) -> str:
    """Return the path of a picture outside the folder of the results."""
    path = results.parent / "private" / "secret.png"
    path.parent.mkdir()
    Image.fromarray(speckle(5, 6, 3)).save(path)
    return str(path)


@pytest.mark.parametrize("name", ["gltf", "obj", "vtk"])
def test_forged_picture_path(name: str, results: Path, message: Messages) -> None:
    picture = secret(results)
    change_scene(results, image=picture)
    for digests in ({"image": "0" * 64}, {}):
        change(results, sha256=digests)
        with message.raises(FilesError, "secret.png"):
            export(results, name)
    if name == "vtk":
        change_scene(results, image=None, output=["trajectory"], springs={"map": {"image": picture, "range": [1, 2]}})
        with message.raises(FilesError, "springs.map.image", "secret.png"):
            export(results, name)
    assert not (results / f"export-{name}").exists()


@pytest.mark.parametrize("name", ["trajectory.npz", "frames/0001.png", "frames"])
def test_linked_results(name: str, results: Path, message: Messages) -> None:
    (results.parent / "elsewhere").mkdir()
    moved = (results / name).rename(results.parent / "elsewhere" / Path(name).name)
    (results / name).symlink_to(moved)
    finished = read_run(results)
    with message.raises(FilesError, name):
        finished.positions() if name == "trajectory.npz" else finished.result_path("png", 1)


def test_implausible_positions(results: Path, message: Messages) -> None:
    rewrite(results, edit=lambda position: position * np.array([1, 1, 1e300, 1e300, 1])[:, None, None, None])
    with message.raises(FilesError, "trajectory.npz"):
        export(results, "obj")


def test_overflow_in_a_format(results: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    def overflow(*_: object) -> Iterator[list[str]]:
        yield [str(np.float32(1) * np.array([1e300]).astype(np.float32))]

    monkeypatch.setattr(obj, "write", overflow)
    with message.raises(FilesError):
        exported(results, results / "out")
    assert not (results / "out").exists()


def test_linked_default_folder(results: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    # It may have come with the results.
    monkeypatch.chdir(results.parent)
    Path("elsewhere").mkdir()
    for link, runs in ((results / "export-obj", results), (Path("output"), [results, results])):
        link.symlink_to(results.parent / "elsewhere")
        with message.raises(FilesError, link.name):
            export(runs, "obj")
    assert files(Path("elsewhere")) == {}


def test_failed_export(results: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    out = results / "out"
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


def test_interrupted_export(results: Path) -> None:
    out, calls = results / "out", []
    exported(results, out)
    before = files(out)

    def interrupt(done: int, total: int) -> None:
        calls.append((done, total))
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(results, "obj", out, interrupt)
    assert calls == [(done, 5) for done in (0, 0, 1, 2, 3)]
    assert files(out) == before
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


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
