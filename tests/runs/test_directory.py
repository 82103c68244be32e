from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO

import pytest

from taichi_msm.errors import FilesError, ForeignError
from taichi_msm.runs.directory import Publication, lock_file
from taichi_msm.runs.writer import RUN_PUBLICATION
from taichi_msm.scene.outputs import RESULT_PATTERNS

OLD = ["frames/0000.png", "frames/0001.png", "frames/0002.png", "flow/0000.flo", "animation.gif", "run.json"]
NEW = ["frames/0000.png", "frames/0001.png", "trajectory.npz", "run.json"]
FOREIGN = [
    "notes.txt",
    "frames/notes.txt",
    "frames/0000 copy.png",
    "frames/12.png",
    "frames/00001.png",
    "A/frames/0000.png",
]

# For every number n that it reads it forks a process that publishes files and dies before the n-th operation on a path,
# or ends well where there are fewer, and tells how it ended.
MORTAL = """
import os, signal, sys
from pathlib import Path
from tests.runs.test_directory import publish

def mortal(operation):
    def call(*args, **kwargs):
        global left
        if not left:
            os.kill(os.getpid(), signal.SIGKILL)
        left -= 1
        return operation(*args, **kwargs)
    return call

for line in sys.stdin:
    left = int(line)
    process = os.fork()
    if not process:
        for name in ("open", "mkdir", "rename", "replace", "unlink", "rmdir"):
            setattr(os, name, mortal(getattr(os, name)))
        publish(Path(sys.argv[1]), sys.argv[2:])
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
"""


def write(directory: Path, names: Collection[str], text: str) -> None:
    """Write files, and in the record what there is."""
    outputs = sorted({name.partition("/")[0] for name in names})
    record = {"outputs": outputs, "frames": sum(name.startswith("frames/") for name in names), "text": text}
    for name in names:
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text(json.dumps(record) if name == "run.json" else text)


def publish(directory: Path, names: Collection[str]) -> None:
    with Publication(directory, RUN_PUBLICATION, names) as publication:
        write(publication.new_folder, names, "new")
        publication.publish(names)


def contents(directory: Path) -> dict[str, str]:
    """The results, the record by its text."""
    paths = {str(path.relative_to(directory)): path for path in sorted(directory.rglob("*"))}
    texts = {name: path.read_text() for name, path in paths.items() if re.fullmatch("|".join(RESULT_PATTERNS), name)}
    return {name: json.loads(text)["text"] if name == "run.json" else text for name, text in texts.items()}


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
    with Publication(directory, RUN_PUBLICATION) as publication:
        write(publication.new_folder, NEW, "new")
        assert contents(directory) == expected(OLD, "old")
        publication.publish(NEW)
        assert contents(directory) == expected(NEW, "new")
    assert contents(directory) == expected(NEW, "new")
    assert_tidy(directory)


def test_leaving_without_publishing_changes_nothing(directory: Path) -> None:
    with Publication(directory, RUN_PUBLICATION) as publication:
        write(publication.new_folder, NEW, "new")
    assert contents(directory) == expected(OLD, "old")
    assert_tidy(directory)


def test_a_directory_made_for_nothing_goes(tmp_path: Path) -> None:
    with Publication(tmp_path / "out" / "press", RUN_PUBLICATION):
        assert (tmp_path / "out" / "press").is_dir()
    assert not (tmp_path / "out" / "press").exists()
    assert tmp_path.exists()


def test_an_empty_directory_of_the_user_stays(tmp_path: Path) -> None:
    with Publication(tmp_path, RUN_PUBLICATION):
        pass
    assert list(tmp_path.iterdir()) == []


def test_frames_that_are_not_wanted_go_with_their_directory(tmp_path: Path) -> None:
    write(tmp_path, OLD, "old")
    with Publication(tmp_path, RUN_PUBLICATION, ["run.json"]) as publication:
        write(publication.new_folder, ["run.json"], "new")
        publication.publish(["run.json"])
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills with SIGKILL")
def test_killed_at_any_moment_the_results_are_all_old_or_all_new(directory: Path, root: Path) -> None:
    outcomes: list[str] = []
    command = [sys.executable, "-c", MORTAL, str(directory), *NEW]
    with subprocess.Popen(command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdin
        assert parent.stdout
        for moment in range(100):
            write(directory, OLD, "old")
            (directory / "trajectory.npz").unlink(missing_ok=True)
            print(moment, file=parent.stdin, flush=True)
            status = int(parent.stdout.readline())
            if status == 0:
                break
            assert status < 0
            if (directory / "run.json").exists():
                # Where there is a record, results are whole without the help of a next run.
                assert contents(directory) in (expected(OLD, "old"), expected(NEW, "new"))
            else:
                assert (directory / ".partial" / "whole" / "run.json").exists()
            with Publication(directory, RUN_PUBLICATION):
                pass
            found = contents(directory)
            assert found in (expected(OLD, "old"), expected(NEW, "new")), f"killed before operation {moment}"
            outcomes.append(found["run.json"])
            assert_tidy(directory)
    assert status == 0
    # Once new, always new: all operations but those before the new files are renamed roll forward.
    assert outcomes == sorted(outcomes, reverse=True)
    assert outcomes.count("old") > 5
    assert outcomes.count("new") > 10


@pytest.mark.skipif(sys.platform == "win32", reason="no lock")
def test_a_second_run_is_refused_until_the_first_ends(directory: Path) -> None:
    with Publication(directory, RUN_PUBLICATION) as first:
        write(first.new_folder, NEW, "new")
        with pytest.raises(FilesError) as refused, Publication(directory, RUN_PUBLICATION):
            pass
        assert str(refused.value) == f"{directory}: another run is writing there; choose another --out"
        first.publish(NEW)
    assert contents(directory) == expected(NEW, "new")
    with Publication(directory, RUN_PUBLICATION):
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
    with Publication(directory, RUN_PUBLICATION):
        assert len(opened) == 2
        monkeypatch.undo()
        with pytest.raises(FilesError), Publication(directory, RUN_PUBLICATION):
            pass


def test_what_a_killed_run_left_is_cleared(directory: Path) -> None:
    write(directory / ".partial", ["lock", "earlier.json", "new/frames/0000.png", "whole/frames/0000.png"], "stale")
    with Publication(directory, RUN_PUBLICATION) as publication:
        assert list(publication.new_folder.iterdir()) == []
    assert contents(directory) == expected(OLD, "old")
    assert_tidy(directory)


def test_a_staged_file_that_is_taken_away_is_missed(directory: Path) -> None:
    with Publication(directory, RUN_PUBLICATION, NEW) as publication:
        write(publication.new_folder, NEW, "new")
        (publication.new_folder / "frames" / "0001.png").unlink()
        with pytest.raises(FilesError, match=r"new/frames/0001\.png was removed during the run; run it again"):
            publication.publish(NEW)
    assert contents(directory) == expected(OLD, "old")
    assert_tidy(directory)


def test_new_files_with_a_damaged_record_are_not_published(directory: Path) -> None:
    write(directory / ".partial" / "whole", NEW, "new")
    for damaged in ("", "[]", '{"outputs": 3, "frames": 2}', '{"outputs": ["frames"], "frames": 1e999}'):
        (directory / ".partial" / "whole" / "run.json").write_text(damaged)
        with (
            pytest.raises(FilesError, match=r"/whole/run\.json is damaged; remove .*/\.partial and run"),
            Publication(directory, RUN_PUBLICATION),
        ):
            pass
        assert contents(directory) == expected(OLD, "old")


def test_new_files_that_were_made_up_take_no_file_of_the_user(tmp_path: Path) -> None:
    write(tmp_path, ["animation.gif", "trajectory.npz", "frames/0000.png"], "mine")
    write(tmp_path / ".partial" / "whole", ["animation.gif", "run.json"], "new")
    with (
        pytest.raises(ForeignError, match=r"/animation\.gif: a file that no run has put there"),
        Publication(tmp_path, RUN_PUBLICATION),
    ):
        pass
    assert contents(tmp_path) == expected(["animation.gif", "trajectory.npz", "frames/0000.png"], "mine")


def test_a_directory_that_is_removed_when_it_was_opened_is_no_endless_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def remove(path: Path) -> BinaryIO:
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        return lock_file(path)

    monkeypatch.setattr("taichi_msm.runs.directory.lock_file", remove)
    with pytest.raises(FileNotFoundError), Publication(tmp_path / "out", RUN_PUBLICATION):
        pass


def test_what_no_run_has_written_is_neither_replaced_nor_removed(directory: Path) -> None:
    """Files with names like ours, which the record does not list."""
    write(directory, ["frames/0100.png"], "mine")
    publish(directory, NEW)
    assert contents(directory) == {**expected(NEW, "new"), "frames/0100.png": "mine"}
    (directory / "animation.gif").write_text("mine")
    with pytest.raises(ForeignError, match=r"/animation\.gif: a file that no run has put there; move it away"):
        publish(directory, OLD)
    assert contents(directory) == {**expected(NEW, "new"), "frames/0100.png": "mine", "animation.gif": "mine"}
