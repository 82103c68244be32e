from __future__ import annotations

import errno
import sys
from pathlib import Path

import pytest

from taichi_msm.runs.directory import LOCK_FILE, hidden_folder, lock_file, move_to_free_name, replacing


@pytest.mark.skipif(sys.platform == "win32", reason="no lock")
def test_what_a_killed_process_left_is_cleared_by_the_next(tmp_path: Path) -> None:
    """But nothing that is still being written, and nothing of anybody else."""
    stale, living, begun, mine = (tmp_path / f".partial-{name}" for name in (16 * "a", 16 * "b", 16 * "c", "mine"))
    for folder in (stale, living, begun, mine):
        folder.mkdir()
        (folder / "animation.gif").write_text("half")
        if folder != begun:
            (folder / LOCK_FILE).touch()
    with lock_file(living / LOCK_FILE), hidden_folder(tmp_path) as hidden:
        assert set(tmp_path.iterdir()) == {living, begun, mine, hidden}
        (hidden / "a").write_text("half")
    assert set(tmp_path.iterdir()) == {living, begun, mine}


def test_a_link_among_what_was_left_leads_nowhere(tmp_path: Path) -> None:
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


def test_a_folder_with_files_of_the_user_stays(tmp_path: Path) -> None:
    mine = tmp_path / f".partial-{16 * 'a'}"
    mine.mkdir()
    for name in (LOCK_FILE, "thesis.txt"):
        (mine / name).touch()
    with hidden_folder(tmp_path):
        pass
    assert (mine / "thesis.txt").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no lock")
def test_without_locks_nothing_is_taken_for_abandoned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as a film that is still being recorded."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr("fcntl.flock", refuse)
    with hidden_folder(tmp_path) as film:
        (film / "animation.gif").touch()
        with hidden_folder(tmp_path):
            pass
        assert (film / "animation.gif").exists()


def test_a_folder_made_for_nothing_goes(tmp_path: Path) -> None:
    with hidden_folder(tmp_path / "out"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a"
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
    assert [(entry.name, entry.read_bytes()) for entry in tmp_path.iterdir()] == [("a", b"second")]


def test_a_draft_of_the_user_stays(tmp_path: Path) -> None:
    (tmp_path / "draft").write_text("mine")
    with replacing(tmp_path / "a") as file:
        file.write(b"new")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "new", "draft": "mine"}


def test_a_file_takes_the_first_free_name(tmp_path: Path) -> None:
    for name in ("a-1.png", "a-3.png"):
        (tmp_path / name).write_text("mine")
    with hidden_folder(tmp_path) as hidden:
        for data in ("second", "fourth"):
            (hidden / "a").write_text(data)
            move_to_free_name(hidden / "a", tmp_path, "a", ".png")
            (hidden / "a").unlink(missing_ok=True)
    texts = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert texts == {"a-1.png": "mine", "a-2.png": "second", "a-3.png": "mine", "a-4.png": "fourth"}
