from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from taichi_msm.errors import FilesError
from taichi_msm.publication import Publication, results

OLD = ["frames/0000.png", "frames/0001.png", "frames/0002.png", "animation.gif", "run.json"]
NEW = ["frames/0000.png", "frames/0001.png", "frames/10000.png", "trajectory.npz", "run.json"]
FOREIGN = ["notes.txt", "frames/notes.txt", "frames/0000 copy.png", "frames/12.png", "a/frames/0000.png"]

# Publishes files and dies before the n-th operation on a path; ends well where there are fewer.
MORTAL = """
import os, signal, sys
from pathlib import Path
from taichi_msm.publication import Publication

left = int(sys.argv[1])

def mortal(operation):
    def call(*args, **kwargs):
        global left
        if not left:
            os.kill(os.getpid(), signal.SIGKILL)
        left -= 1
        return operation(*args, **kwargs)
    return call

for name in ("mkdir", "write_text", "replace", "unlink", "rmdir"):
    setattr(Path, name, mortal(getattr(Path, name)))
with Publication(Path(sys.argv[2])) as publication:
    for name in sys.argv[3:]:
        (publication.staged / name).parent.mkdir(exist_ok=True)
        (publication.staged / name).write_text("new")
    publication.publish()
"""


def write(directory: Path, names: list[str], text: str) -> None:
    for name in names:
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text(text)


def contents(directory: Path) -> dict[str, str]:
    return {name: (directory / name).read_text() for name in sorted(results(directory))}


def expected(names: list[str], text: str) -> dict[str, str]:
    return dict.fromkeys(sorted(names), text)


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """A directory with the results of an earlier run, and with files of the user."""
    directory = tmp_path / "out"
    write(directory, OLD, "old")
    write(directory, FOREIGN, "mine")
    return directory


def assert_tidy(directory: Path) -> None:
    assert not (directory / ".partial").exists()
    assert {name: (directory / name).read_text() for name in FOREIGN} == dict.fromkeys(FOREIGN, "mine")


def test_new_results_take_the_place_of_all_old_ones(directory: Path) -> None:
    with Publication(directory) as publication:
        write(publication.staged, NEW, "new")
        assert contents(directory) == expected(OLD, "old")
        publication.publish()
        assert contents(directory) == expected(NEW, "new")
    assert contents(directory) == expected(NEW, "new")
    assert_tidy(directory)


def test_leaving_without_publishing_changes_nothing(directory: Path) -> None:
    with Publication(directory) as publication:
        write(publication.staged, NEW, "new")
    assert contents(directory) == expected(OLD, "old")
    assert_tidy(directory)


def test_a_directory_made_for_nothing_goes(tmp_path: Path) -> None:
    with Publication(tmp_path / "out" / "press"):
        assert (tmp_path / "out" / "press").is_dir()
    assert not (tmp_path / "out" / "press").exists()
    assert tmp_path.exists()


def test_an_empty_directory_of_the_user_stays(tmp_path: Path) -> None:
    with Publication(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_frames_that_are_not_wanted_go_with_their_directory(tmp_path: Path) -> None:
    write(tmp_path, OLD, "old")
    with Publication(tmp_path) as publication:
        write(publication.staged, ["run.json"], "new")
        publication.publish()
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills with SIGKILL")
def test_killed_at_any_moment_the_results_are_all_old_or_all_new(directory: Path, root: Path) -> None:
    outcomes: list[str] = []
    for moment in range(100):
        write(directory, OLD, "old")
        (directory / "trajectory.npz").unlink(missing_ok=True)
        (directory / "frames/10000.png").unlink(missing_ok=True)
        command = [sys.executable, "-c", MORTAL, str(moment), str(directory), *NEW]
        status = subprocess.run(command, cwd=root, check=False).returncode
        if status == 0:
            break
        assert status < 0
        if not (directory / ".partial" / "complete").exists() and outcomes[-1:] != ["new"]:
            # Before the marker the old results are whole without the help of a next run.
            assert contents(directory) == expected(OLD, "old")
        with Publication(directory):
            pass
        found = contents(directory)
        assert found in (expected(OLD, "old"), expected(NEW, "new")), f"killed before operation {moment}"
        outcomes.append(found["run.json"])
        assert_tidy(directory)
    assert status == 0
    # Once new, always new: all operations but those before the marker roll forward.
    assert outcomes == sorted(outcomes, reverse=True)
    assert outcomes.count("old") > 10
    assert outcomes.count("new") > 10


@pytest.mark.skipif(sys.platform == "win32", reason="no lock")
def test_a_second_run_is_refused_until_the_first_ends(directory: Path) -> None:
    with Publication(directory) as first:
        write(first.staged, NEW, "new")
        with pytest.raises(FilesError) as refused, Publication(directory):
            pass
        assert str(refused.value) == f"{directory}: another run is writing there; choose another --out"
        first.publish()
    assert contents(directory) == expected(NEW, "new")
    with Publication(directory):
        pass
    assert_tidy(directory)


@pytest.mark.skipif(sys.platform == "win32", reason="no lock")
def test_the_lock_of_a_directory_that_was_removed_is_no_lock(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between opening the lock and locking it, the run that held it may end and remove it."""
    import fcntl

    flock = fcntl.flock
    opened: list[int] = []

    def late(file: int, operation: int) -> None:
        if not opened:
            (directory / ".partial" / "lock").unlink()
        opened.append(file)
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with Publication(directory):
        assert len(opened) == 2
        monkeypatch.undo()
        with pytest.raises(FilesError), Publication(directory):
            pass


def test_what_a_killed_run_left_is_cleared(directory: Path) -> None:
    write(directory / ".partial", ["lock", "draft", "new/frames/0000.png", "old/junk/file"], "stale")
    with Publication(directory) as publication:
        assert list(publication.staged.iterdir()) == []
    assert contents(directory) == expected(OLD, "old")
    assert_tidy(directory)


def test_frames_in_the_way_are_found_before_the_run(tmp_path: Path) -> None:
    (tmp_path / "frames").write_text("mine")
    with pytest.raises(PermissionError, match="frames"), Publication(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
