"""The command that converts results: what it writes where, and what it says when it cannot."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.cli import console
from taichi_msm.errors import FilesError, ForeignError
from taichi_msm.exports import obj
from taichi_msm.exports.export import export
from taichi_msm.exports.formats import FORMATS
from taichi_msm.runs import directory
from taichi_msm.runs.finished import RESTORE_PICTURE, read_run
from taichi_msm.runs.run import run
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.outputs import files
from tests.runs.test_finished import RUN_AGAIN, change, change_scene, rewrite
from tests.scenes import speckle


def exported(results: Path, out: Path) -> list[str]:
    """Export as OBJ, which takes nothing but a trajectory, to a folder."""
    return export(results, "obj", out).files


def test_every_format_has_its_module() -> None:
    for name, row in FORMATS.items():
        assert callable(import_module(f"taichi_msm.exports.{row.module or name}").write)


def test_files_go_beside_the_results(results: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(results.parent)
    before = files(results)
    done = program("export", "results", "--format", "obj")
    assert (done.returncode, done.stdout, done.stderr) == (0, "results/export-obj: 8 files\n", "")
    names = [f"export-obj/{name}" for name in ("0000.obj", "0004.obj", "picture.png", "surface.mtl")]
    written = files(results)
    assert set(names) < set(written)
    assert {name: data for name, data in written.items() if not name.startswith("export-obj")} == before


def test_json_is_all_there_is_on_stdout(results: Path, program: Program) -> None:
    done = program("export", str(results), "--format", "gltf", "--out", str(results / "here"), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    here = str(results / "here")
    names = ["index.csv", "surface.glb"]
    assert json.loads(done.stdout) == {"directory": here, "format": "gltf", "files": names, "notes": []}
    assert program("export", str(results), "--format", "gltf", "--quiet").stdout == ""
    done = program("export", str(results), "--format", "gltf")
    assert done.stdout == f"{results}/export-gltf: index.csv, surface.glb\n"


def test_another_process_gives_the_same_bytes(results: Path) -> None:
    """And does not start Taichi."""
    exported(results, results / "here")
    code = "import sys; from taichi_msm.cli.main import main; main(sys.argv[1:]); sys.exit('taichi' in sys.modules)"
    arguments = ["export", str(results), "--format", "obj", "--out", str(results / "there"), "--quiet"]
    subprocess.run([sys.executable, "-c", code, *arguments], check=True)
    assert files(results / "there") == files(results / "here")


@pytest.mark.parametrize(
    ("arguments", "code", "error"),
    [
        (["nowhere", "--format", "obj"], 4, "nowhere: no results of a run; name the folder that `run --out` wrote"),
        (
            ["results", "--format", "kitti"],
            4,
            'results: kitti needs flow; run the scene again with --set "output=[png,gif,trajectory,flow,occlusion]"',
        ),
        (
            ["results", "--format", "tapvid"],
            4,
            'results: tapvid needs tracks; run the scene again with --set "output=[png,gif,trajectory,tracks]"',
        ),
        (["", "--format", "obj"], 2, "taichi-msm: Invalid value for DIR: is empty; name a directory"),
        (
            ["results", "--format", "obj", "--out", ""],
            2,
            "taichi-msm: Invalid value for --out: is empty; name a directory",
        ),
        (["results"], 2, "taichi-msm: Missing option '--format'."),
        (["results", "--format", "fbx"], 2, "taichi-msm: Invalid value for '--format': 'fbx' is not one of"),
        (["--format", "obj"], 2, "taichi-msm: Missing argument 'DIR ...'."),
    ],
)
def test_what_is_wrong_is_one_line(
    arguments: list[str], code: int, error: str, results: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(results.parent)
    before = files(results.parent)
    done = program("export", *arguments)
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.startswith(error)
    assert done.stderr.count("\n") == 1
    assert files(results.parent) == before
    assert not (results / "export-kitti").exists(), "a folder that was made for nothing goes"


@pytest.mark.parametrize("name", ["vtk", "gltf", "obj"])
def test_a_surface_needs_a_trajectory(name: str, results: Path, program: Program) -> None:
    pytest.importorskip("vtkmodules" if name == "vtk" else "numpy")
    (results / "trajectory.npz").unlink()
    done = program("export", str(results), "--format", name)
    again = 'run the scene again with --set "output=[png,gif,trajectory]"'
    error = f"{results}: {name} needs trajectory; {again}\n"
    assert (done.returncode, done.stderr) == (4, error)


def test_a_picture_that_is_gone_is_named(results: Path, program: Program) -> None:
    record = json.loads((results / "run.json").read_text())
    record["scene"]["image"] = "gone.png"
    (results / "run.json").write_text(json.dumps(record))
    done = program("export", str(results), "--format", "gltf")
    error = f"{results}: image: gone.png: no such file or directory; {RESTORE_PICTURE}\n"
    assert (done.returncode, done.stderr) == (4, error)


def test_a_new_export_takes_the_place_of_the_earlier_one(results: Path) -> None:
    """All of it: files of frames that the new one lacks go too, and so does what a killed process left."""
    out = results / "here"
    names = exported(results, out)
    whole = files(out)
    (out / ".partial" / "new").mkdir(parents=True)
    stale = ["0099.obj", "0001.obj"]
    for name in (*stale, ".partial/new/0000.obj"):
        (out / name).write_text("of an earlier export")
    (out / "export.json").write_text(json.dumps({"files": stale + names}))
    assert exported(results, out) == names == sorted(set(whole) - {"export.json"})
    assert files(out) == whole
    assert not (out / ".partial").exists()


def test_a_file_that_is_named_like_ours_is_not_touched(results: Path) -> None:
    out = results / "here"
    out.mkdir()
    for name in ("picture.png", "0000.obj"):
        (out / name).write_text("mine")
        with pytest.raises(ForeignError, match=rf"^{out}/{name}: a file that no run has put there"):
            exported(results, out)
        assert files(out) == {name: b"mine"}
        (out / name).unlink()


def test_two_exports_do_not_write_into_one_folder(results: Path) -> None:
    out = results / "here"
    refused: list[str] = []

    def second(done: int, total: int) -> None:
        if done == 2 and not refused:
            with pytest.raises(FilesError) as caught:
                exported(results, out)
            refused.append(str(caught.value))

    names = export(results, "obj", out, second).files
    assert refused == [f"{out}: another export is writing there; choose another --out"]
    assert set(files(out)) == {*names, "export.json"}


KILLED = """
import os, signal, sys
from pathlib import Path
from taichi_msm.exports.export import export

def progress(done, total):
    if done == 3:
        os.kill(os.getpid(), signal.SIGKILL)

export(Path(sys.argv[1]), "obj", Path(sys.argv[2]), progress)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="kills with SIGKILL")
@pytest.mark.parametrize("name", ["obj", "gltf"])
def test_an_export_that_is_killed_is_known_to_the_next_one(name: str, results: Path) -> None:
    """Also to one of another format."""
    out = results / "here"
    exported(results, out)
    before = files(out)
    killed = subprocess.run([sys.executable, "-c", KILLED, str(results), str(out)], check=False)
    assert killed.returncode < 0
    left = {path: data for path, data in files(out).items() if not path.startswith(".")}
    assert left == before
    assert set(files(out)) > set(before), "it had begun"
    names = export(results, name, out).files
    assert {path.name for path in out.iterdir()} == {*names, "export.json"}


def test_a_record_that_was_made_up_takes_no_file_of_the_user(results: Path, program: Program) -> None:
    out = results / "here"
    exported(results, out)
    before = files(out)
    for listed in (["a/" * 5000 + "b"], ["../run.json", "training", 3], []):
        (out / "export.json").write_text(json.dumps({"files": [*json.loads(before["export.json"])["files"], *listed]}))
        done = program("export", str(results), "--format", "obj", "--out", str(out))
        assert (done.returncode, done.stderr) == (0, "")
        assert files(out) == before
    (out / "notes.txt").write_text("mine")
    (out / "export.json").write_text(json.dumps({"files": [*json.loads(before["export.json"])["files"], "notes.txt"]}))
    done = program("export", str(results), "--format", "obj", "--out", str(out))
    assert (done.returncode, (out / "notes.txt").read_text()) == (4, "mine")
    assert done.stderr.startswith(f"{out}/notes.txt: a file that no run has put there")
    for record in ("[" * 10**5, '{"files": [[]]}', '{"files": null}', "3", "{}"):
        (out / "export.json").write_text(record)
        done = program("export", str(results), "--format", "obj", "--out", str(out))
        assert (done.returncode, done.stderr.count("\n")) == (4, 1)
        assert done.stderr.startswith(f"{out}/export.json: a file that no run has put there")


def test_many_files_are_compared_in_time_proportional_to_their_number(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, count = results / "here", 300
    names = [f"{number:04}.obj" for number in range(count)]
    out.mkdir()
    for name in names:
        (out / name).write_text("of an earlier export")
    (out / "export.json").write_text(json.dumps({"files": names}))
    calls: list[str] = []
    kind = directory.entry_kind

    def counted(path: Path) -> str | None:
        calls.append(path.name)
        return kind(path)

    monkeypatch.setattr(directory, "entry_kind", counted)
    assert len(exported(results, out)) == 8
    # A name is looked up some times, and never beside each of the others.
    assert count < len(calls) < 10 * count < count**2


def test_files_of_another_format_go_with_their_folders(results: Path) -> None:
    out = results / "here"
    (out / "training" / "flow_occ").mkdir(parents=True)
    (out / "training" / "flow_occ" / "000000_10.png").write_text("of an earlier export")
    (out / "export.json").write_text(json.dumps({"files": ["training/flow_occ/000000_10.png"]}))
    names = exported(results, out)
    assert {path.name for path in out.iterdir()} == {*names, "export.json"}


@pytest.mark.parametrize("moment", [0, 2])
def test_a_run_that_publishes_meanwhile_is_noticed(moment: int, results: Path, device: Device) -> None:
    """No file of an export is of another run than the others."""
    out = results / "here"
    exported(results, out)
    before = files(out)

    def publish(done: int, total: int) -> None:
        if done == moment and not (results / "trajectory.npz").stat().st_mtime_ns > begun:
            run(read_run(results).scene, results, threads=device.threads, estimate_error=False)

    begun = (results / "trajectory.npz").stat().st_mtime_ns
    with pytest.raises(FilesError) as caught:
        export(results, "obj", out, publish)
    assert str(caught.value) == f"{results}: another run replaced these results while they were read; try again"
    assert files(out) == before


def test_results_that_go_meanwhile_are_no_fault_of_the_files(results: Path) -> None:
    def take_away(done: int, total: int) -> None:
        (results / "run.json").unlink(missing_ok=True)
        (results / "trajectory.npz").unlink(missing_ok=True)

    with pytest.raises(FilesError, match="another run replaced these results"):
        export(results, "obj", results / "here", take_away)


def secret(results: Path) -> str:
    """A picture of the user that is no concern of the results."""
    path = results.parent / "private" / "secret.png"
    path.parent.mkdir()
    Image.fromarray(speckle(5, 6, 3)).save(path)
    return str(path)


@pytest.mark.parametrize("name", ["gltf", "obj", "vtk"])
def test_a_record_that_names_a_picture_elsewhere_gets_nothing_of_it(name: str, results: Path, program: Program) -> None:
    pytest.importorskip("vtkmodules" if name == "vtk" else "numpy")
    path = secret(results)
    change_scene(results, image=path)
    fault = f"{path} is not the file of the run, by its SHA-256"
    done = program("export", str(results), "--format", name)
    assert (done.returncode, done.stderr) == (4, f"{results}: image: {fault}; {RESTORE_PICTURE}\n")
    change(results, sha256={})
    assert program("export", str(results), "--format", name).stderr == done.stderr
    assert not (results / f"export-{name}").exists()


def test_a_record_that_names_a_map_elsewhere_gets_nothing_of_it_for_vtk(results: Path, program: Program) -> None:
    pytest.importorskip("vtkmodules")
    path = secret(results)
    change_scene(results, springs={"map": {"image": path, "range": [1.0, 2.0]}})
    done = program("export", str(results), "--format", "vtk")
    fault = f"springs.map.image: {path} is not the file of the run, by its SHA-256"
    assert (done.returncode, done.stderr) == (4, f"{results}: {fault}; {RESTORE_PICTURE}\n")


@pytest.mark.parametrize("name", ["trajectory.npz", "frames/0001.png", "frames"])
def test_results_that_are_links_get_nothing_of_what_they_lead_to(name: str, results: Path) -> None:
    (results.parent / "elsewhere").mkdir()
    moved = (results / name).rename(results.parent / "elsewhere" / Path(name).name)
    (results / name).symlink_to(moved)
    found = read_run(results)
    with pytest.raises(FilesError, match="a symbolic link, which no run writes"):
        found.positions() if name == "trajectory.npz" else found.result_path("png", 1)


@pytest.mark.parametrize("name", ["gltf", "obj", "vtk"])
def test_positions_that_no_run_reaches_are_damage(name: str, results: Path, program: Program) -> None:
    pytest.importorskip("vtkmodules" if name == "vtk" else "numpy")

    def far(position: NDArray[np.float64]) -> NDArray[np.float64]:
        position[2:] *= 1e300
        return position

    rewrite(results, edit=far)
    done = program("export", str(results), "--format", name)
    assert (done.returncode, done.stderr) == (4, f"{results / 'trajectory.npz'}: {RUN_AGAIN}\n")


def test_numbers_that_a_format_cannot_hold_are_one_line(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def overflow(*_: object) -> Iterator[list[str]]:
        yield [str(np.float32(1) * np.array([1e300]).astype(np.float32))]

    monkeypatch.setattr(obj, "write", overflow)
    with pytest.raises(FilesError, match="its numbers are too large for obj; run the scene again"):
        exported(results, results / "here")
    assert not (results / "here").exists()


def test_a_folder_that_cannot_be_is_named(results: Path, program: Program) -> None:
    long = "x" * 300
    done = program("export", str(results), "--format", "obj", "--out", long)
    said = f"{long}: cannot write: File name too long; choose another --out\n"
    assert (done.returncode, done.stderr) == (4, said)
    done = program("export", long, "--format", "obj")
    # From Python 3.14 on, such a folder is one that is not there.
    longer = f"{long}/export-obj: file name too long\n"
    absent = f"{long}: no results of a run; name the folder that `run --out` wrote\n"
    assert (done.returncode, done.stderr) == (4, absent if sys.version_info >= (3, 14) else longer)


def test_an_export_that_fails_leaves_the_earlier_one(results: Path) -> None:
    out = results / "here"
    exported(results, out)
    before = files(out)
    (results / "trajectory.npz").write_bytes(b"")
    with pytest.raises(FilesError):
        exported(results, out)
    assert files(out) == before


@pytest.mark.parametrize("name", ["notes.txt", "sub/0000.obj", "0000.obj.bak", "0000.obj/x"])
def test_what_no_export_has_written_is_not_touched(name: str, results: Path, program: Program) -> None:
    out = results / "here"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("mine")
    calls = []
    with pytest.raises(ForeignError) as refused:
        export(results, "obj", out, lambda done, total: calls.append(done))
    assert calls == [0], "before anything is made"
    assert str(refused.value).startswith(f"{out / name.partition('/')[0]}: a f")
    assert files(out) == {name: b"mine"}
    assert program("export", str(results), "--format", "obj", "--out", str(results)).returncode == 4


def test_a_link_leads_nowhere(results: Path, program: Program) -> None:
    """A folder that nobody named may have come with the results."""
    (results.parent / "elsewhere").mkdir()
    (results / "export-obj").symlink_to(results.parent / "elsewhere")
    done = program("export", str(results), "--format", "obj")
    said = "a symbolic link; name the folder it leads to with --out"
    assert (done.returncode, done.stderr) == (4, f"{results / 'export-obj'}: {said}\n")
    assert files(results.parent / "elsewhere") == {}


def test_a_file_in_the_place_of_the_folder_is_told(results: Path, program: Program) -> None:
    done = program("export", str(results), "--format", "obj", "--out", str(results / "run.json"))
    assert done.returncode == 4
    assert done.stderr.startswith(f"{results / 'run.json'}: cannot write: ")
    assert done.stderr.count("\n") == 1


def test_a_full_disk_leaves_the_earlier_files(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = results / "here"
    exported(results, out)
    before = files(out)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(obj, "create_file", full)
    with pytest.raises(FilesError, match=r"here: cannot write: No space left on device; free some space or choose"):
        exported(results, out)
    with pytest.raises(FilesError, match="cannot write"):
        exported(results, results / "nothing")
    assert files(out) == before
    assert not (results / "nothing").exists()


@pytest.mark.parametrize("name", ["gltf", "obj", "vtk"])
def test_an_interrupted_export_changes_nothing(name: str, results: Path) -> None:
    pytest.importorskip("vtkmodules" if name == "vtk" else "numpy")
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


def test_the_command_says_that_it_was_interrupted(
    results: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("taichi_msm.system.process.Interruption.raise_if_requested", raise_interrupt)
    done = program("export", str(results), "--format", "obj", "--json")
    assert (done.returncode, done.stderr) == (130, "interrupted; nothing was written\n")
    assert json.loads(done.stdout)["status"] == "interrupted"


def raise_interrupt(_: object) -> None:
    raise KeyboardInterrupt


def test_a_long_export_says_how_far_it_is(results: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "LINE_INTERVAL_S", 0.0)
    assert "exporting: 3 of 5 done, about " in program("export", str(results), "--format", "obj").stderr
    assert program("export", str(results), "--format", "obj", "--quiet").stderr == ""
