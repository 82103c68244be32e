"""The command that converts results: what it writes where, and what it says when it cannot."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from pathlib import Path

import pytest

from taichi_msm import cli, console
from taichi_msm.errors import FilesError, ForeignError
from taichi_msm.export.convert import convert
from taichi_msm.export.formats import FORMATS
from taichi_msm.export.staging import staging
from tests.conftest import Program
from tests.outputs import files


def exported(results: Path, out: Path) -> list[str]:
    """Export as OBJ, which takes nothing but a trajectory, to a folder."""
    return convert(results, "obj", out).files


def test_the_command_knows_the_formats_that_there_are() -> None:
    assert tuple(FORMATS) == cli.FORMATS


def test_files_go_beside_the_results(results: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(results.parent)
    before = files(results)
    done = program("export", "results", "--format", "obj")
    assert (done.returncode, done.stdout, done.stderr) == (0, "results/export-obj: 7 files\n", "")
    names = [f"export-obj/{name}" for name in ("0000.obj", "0004.obj", "picture.png", "surface.mtl")]
    written = files(results)
    assert set(names) < set(written)
    assert {name: data for name, data in written.items() if not name.startswith("export-obj")} == before


def test_json_is_all_there_is_on_stdout(results: Path, program: Program) -> None:
    done = program("export", str(results), "--format", "gltf", "--out", str(results / "here"), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    here = str(results / "here")
    assert json.loads(done.stdout) == {"directory": here, "format": "gltf", "files": ["surface.glb"], "notes": []}
    assert program("export", str(results), "--format", "gltf", "--quiet").stdout == ""
    assert program("export", str(results), "--format", "gltf").stdout == f"{results}/export-gltf: surface.glb\n"


def test_another_process_gives_the_same_bytes(results: Path) -> None:
    """And does not start Taichi."""
    exported(results, results / "here")
    code = "import sys; from taichi_msm.cli import main; main(sys.argv[1:]); sys.exit('taichi' in sys.modules)"
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
        (["--format", "obj"], 2, "taichi-msm: Missing argument 'DIR'."),
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
    gone = Path(record["working_directory"]) / "gone.png"
    remedy = "put back the picture that it was run with, or run the scene again"
    error = f"{results}: image: {gone}: no such file or directory; {remedy}\n"
    assert (done.returncode, done.stderr) == (4, error)


def test_a_new_export_takes_the_place_of_the_earlier_one(results: Path) -> None:
    """All of it: files of frames that the new one lacks go too, and so does what a killed process left."""
    out = results / "here"
    names = exported(results, out)
    whole = files(out)
    (out / ".partial-x1").mkdir()
    stale = ["0099.obj", "0001.obj"]
    for name in (*stale, ".partial-x1/0000.obj"):
        (out / name).write_text("of an earlier export")
    (out / "export.json").write_text(json.dumps({"files": stale + names}))
    assert exported(results, out) == names == sorted(set(whole) - {"export.json"})
    assert files(out) == whole
    assert not (out / ".partial-x1").exists()


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
    exported(results, out)
    before = files(out)
    with (
        staging(out, {r".*": None}) as staged,
        pytest.raises(FilesError, match="another export is writing there; choose another --out"),
    ):
        exported(results, out)
    assert not staged.exists()
    assert set(files(out)) == {"export.json"}, "the first one had no files"
    assert before


def test_an_export_that_is_killed_is_known_to_the_next_one(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = results / "here"
    names = exported(results, out)
    whole = files(out)

    def killed(self: Path, target: Path) -> None:
        raise SystemExit

    # While it moves its files into place.
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", killed)
        with pytest.raises(SystemExit):
            exported(results, out)
    assert set(files(out)) == {"export.json"}
    assert exported(results, out) == names
    assert files(out) == whole


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
        convert(results, "obj", out, lambda done, total: calls.append(done))
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

    def full(path: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
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
    convert(results, name, out)
    before, calls = files(out), []

    def interrupt(done: int, total: int) -> None:
        calls.append((done, total))
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(results, name, out, interrupt)
    assert calls[0] == (0, 5)
    assert [done for done, _ in calls[1:]] == [0, 1, 2, 3], "it says how far it is, frame by frame"
    assert files(out) == before
    assert [path.name for path in out.iterdir() if path.name.startswith(".")] == []


def test_the_command_says_that_it_was_interrupted(
    results: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("taichi_msm.system.signals.Interruption.grant", raise_interrupt)
    done = program("export", str(results), "--format", "obj", "--json")
    assert (done.returncode, done.stderr) == (130, "interrupted; nothing was written\n")
    assert json.loads(done.stdout)["status"] == "interrupted"


def raise_interrupt(_: object) -> None:
    raise KeyboardInterrupt


def test_a_long_export_says_how_far_it_is(results: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "LINE_EVERY", 0.0)
    assert "exporting: 3 of 5 done, about " in program("export", str(results), "--format", "obj").stderr
    assert program("export", str(results), "--format", "obj", "--quiet").stderr == ""
