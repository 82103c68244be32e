from __future__ import annotations

import errno
import fcntl
import json
import os
import re
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from taichi_msm.errors import FilesError, ForeignError
from taichi_msm.runs.directory import LOCK_FILE, Publication, hidden_folder, lock_file, move_to_free_name, replacing
from taichi_msm.runs.writer import RUN_PUBLICATION
from taichi_msm.scene.outputs import RESULT_PATTERNS
from tests.golden import Messages
from tests.outputs import files

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


def write(directory: Path, names: Collection[str], text: str) -> None:
    """Write files, and a record that lists them."""
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
    """Texts of the results by name."""
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


def test_new_results_replace_earlier_ones(directory: Path) -> None:
    with Publication(directory, RUN_PUBLICATION) as publication:
        write(publication.new_folder, NEW, "new")
        assert contents(directory) == expected(OLD, "old")
        publication.publish(NEW)
        assert contents(directory) == expected(NEW, "new")
    assert contents(directory) == expected(NEW, "new")
    assert_tidy(directory)


class Killed(BaseException):
    """End of a process, as by SIGKILL: no operation on a path succeeds afterwards."""


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of a lock that is not closed
@pytest.mark.parametrize(
    ("operation", "calls", "outcome"),
    [
        pytest.param("mkdir", 1, "old", id="new folder"),
        pytest.param("replace", 0, "old", id="commit"),
        pytest.param("replace", 1, "new", id="earlier record"),
        pytest.param("replace", 3, "new", id="second file"),
        pytest.param("unlink", 1, "new", id="second obsolete file"),
        pytest.param("rmdir", 0, "new", id="obsolete folder"),
        pytest.param("replace", 5, "new", id="new record"),
    ],
)
def test_publication_killed_at_each_stage(
    operation: str, calls: int, outcome: str, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results with a record are all old or all new; the next publication completes or discards the new ones."""
    remaining, killed = calls, False

    def mortal(name: str) -> Callable[..., Any]:
        original = getattr(os, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal remaining, killed
            remaining -= name == operation
            if killed or remaining < 0:
                killed = True
                raise Killed
            return original(*args, **kwargs)

        return call

    with monkeypatch.context() as patch, suppress(Killed):
        for name in ("open", "mkdir", "rename", "replace", "unlink", "rmdir"):
            patch.setattr(os, name, mortal(name))
        publish(directory, NEW)
    assert killed
    if (directory / "run.json").exists():
        assert contents(directory) in (expected(OLD, "old"), expected(NEW, "new"))
    else:
        assert (directory / ".partial" / "whole" / "run.json").exists()
    with Publication(directory, RUN_PUBLICATION):
        pass
    assert contents(directory) == expected(OLD if outcome == "old" else NEW, outcome)
    assert_tidy(directory)


def test_concurrent_publication_is_refused(directory: Path, message: Messages) -> None:
    with Publication(directory, RUN_PUBLICATION) as first:
        write(first.new_folder, NEW, "new")
        with message.raises(FilesError, "--out"), Publication(directory, RUN_PUBLICATION):
            pass
        first.publish(NEW)
    assert contents(directory) == expected(NEW, "new")
    with Publication(directory, RUN_PUBLICATION):
        pass
    assert_tidy(directory)


def test_lock_in_a_deleted_folder(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between opening a lock and locking it, the run that holds it may end and delete it."""
    flock, locked = fcntl.flock, list[int]()

    def lock_late(file: int, operation: int) -> None:
        if not locked:
            (directory / ".partial" / "lock").unlink()
        locked.append(file)
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", lock_late)
    with Publication(directory, RUN_PUBLICATION):
        assert len(locked) == 2
        monkeypatch.undo()
        with pytest.raises(FilesError), Publication(directory, RUN_PUBLICATION):
            pass


def test_leftovers_of_a_killed_run_are_deleted(directory: Path) -> None:
    write(directory / ".partial", ["lock", "earlier.json", "new/frames/0000.png", "whole/frames/0000.png"], "stale")
    with Publication(directory, RUN_PUBLICATION) as publication:
        assert list(publication.new_folder.iterdir()) == []
    assert contents(directory) == expected(OLD, "old")
    assert_tidy(directory)


def test_missing_staged_file(directory: Path, message: Messages) -> None:
    with Publication(directory, RUN_PUBLICATION, NEW) as publication:
        write(publication.new_folder, NEW, "new")
        (publication.new_folder / "frames" / "0001.png").unlink()
        with message.raises(FilesError, "new/frames/0001.png"):
            publication.publish(NEW)
    assert contents(directory) == expected(OLD, "old")
    assert_tidy(directory)


def test_forged_new_results_replace_no_foreign_files(tmp_path: Path, message: Messages) -> None:
    write(tmp_path, ["animation.gif", "trajectory.npz"], "mine")
    write(tmp_path / ".partial" / "whole", ["animation.gif", "run.json"], "new")
    with message.raises(ForeignError, "animation.gif"), Publication(tmp_path, RUN_PUBLICATION):
        pass
    assert contents(tmp_path) == expected(["animation.gif", "trajectory.npz"], "mine")


def test_foreign_files_are_kept(directory: Path, message: Messages) -> None:
    """Files with names of results that the record does not list."""
    write(directory, ["frames/0100.png"], "mine")
    publish(directory, NEW)
    assert contents(directory) == {**expected(NEW, "new"), "frames/0100.png": "mine"}
    (directory / "animation.gif").write_text("mine")
    with message.raises(ForeignError, "animation.gif"):
        publish(directory, OLD)
    assert contents(directory) == {**expected(NEW, "new"), "frames/0100.png": "mine", "animation.gif": "mine"}


def test_unwritable_folder_of_results(directory: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "frames")
    with message.raises(PermissionError, "frames"), Publication(directory, RUN_PUBLICATION, NEW):
        pass


def test_abandoned_hidden_folders_are_deleted(tmp_path: Path) -> None:
    """Locked or incomplete folders, and those with foreign files, are kept."""
    names = (*(16 * letter for letter in "abcd"), "mine")
    stale, living, begun, used, _ = kept = [tmp_path / f".partial-{name}" for name in names]
    for folder in kept:
        folder.mkdir()
        (folder / ("thesis.txt" if folder == used else "animation.gif")).write_text("half")
        if folder != begun:
            (folder / LOCK_FILE).touch()
    kept.remove(stale)
    with lock_file(living / LOCK_FILE), hidden_folder(tmp_path) as hidden:
        assert set(tmp_path.iterdir()) == {*kept, hidden}
        (hidden / "a").write_text("half")
    assert set(tmp_path.iterdir()) == set(kept)
    assert (used / "thesis.txt").exists()


def test_links_in_hidden_folders_are_not_followed(tmp_path: Path) -> None:
    treasure, out = tmp_path / "treasure", tmp_path / "out"
    (treasure / "lock").mkdir(parents=True)
    for name in ("a", "b"):
        (out / f".partial-{16 * name}").mkdir(parents=True)
    (out / f".partial-{16 * 'a'}" / LOCK_FILE).touch()
    (out / f".partial-{16 * 'a'}" / "deep").symlink_to(treasure)
    (out / f".partial-{16 * 'b'}" / LOCK_FILE).symlink_to(treasure / "notes.txt")
    (out / f".partial-{16 * 'c'}").symlink_to(treasure)
    with hidden_folder(out):
        pass
    assert (treasure / "lock").is_dir()
    assert not (treasure / "notes.txt").exists()


def test_folder_is_kept_on_a_disk_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with hidden_folder(tmp_path) as film:
        (film / "animation.gif").touch()
        with hidden_folder(tmp_path):
            pass
        assert (film / "animation.gif").exists()


def test_atomic_replacement_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a"
    (tmp_path / "draft").write_text("mine")
    for data in (b"first", b"second"):
        with replacing(path) as file:
            file.write(data)
        assert path.read_bytes() == data

    def fail() -> None:
        with replacing(path) as file:
            file.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert files(tmp_path) == {"a": b"second", "draft": b"mine"}


def test_first_free_name(tmp_path: Path) -> None:
    for name in ("a-1.png", "a-3.png"):
        (tmp_path / name).write_text("mine")
    with hidden_folder(tmp_path) as hidden:
        for data in ("second", "fourth"):
            (hidden / "a").write_text(data)
            move_to_free_name(hidden / "a", tmp_path, "a", ".png")
            (hidden / "a").unlink(missing_ok=True)
    texts = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert texts == {"a-1.png": "mine", "a-2.png": "second", "a-3.png": "mine", "a-4.png": "fourth"}
