"""Untrusted files and folders."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path

import pytest

from taichi_msm.errors import FilesError
from taichi_msm.runs.finished import read_run
from taichi_msm.system.files import private_folder, read_regular
from tests.golden import Messages


def test_size_limit_of_a_file(tmp_path: Path, message: Messages) -> None:
    (tmp_path / "a").write_bytes(b"123")
    assert read_regular(tmp_path / "a", 3) == b"123"
    with message.raises(OSError):
        read_regular(tmp_path / "a", 2)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_devices_pipes_and_endless_files(tmp_path: Path, message: Messages) -> None:
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(20 << 30)
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path / "sparse", tmp_path):
        with message.raises(OSError, hide=r": \d+$"):
            read_regular(path, 1 << 20)


def test_huge_record(results: Path, message: Messages) -> None:
    os.truncate(results / "run.json", 20 << 30)
    with message.raises(FilesError, "run.json"):
        read_run(results)


@pytest.mark.skipif(sys.platform == "win32", reason="the temporary directory is the user's")
@pytest.mark.parametrize("existing", ["missing", "private", "public", "link", "file"])
def test_private_folder(existing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    expected = tmp_path / f"taichi-msm-{os.geteuid()}"
    if existing == "link":
        (tmp_path / "theirs").mkdir()
        expected.symlink_to(tmp_path / "theirs")
    elif existing == "file":
        expected.touch()
    elif existing != "missing":
        expected.mkdir(0o700)
        expected.chmod(0o777 if existing == "public" else 0o700)
    folder = Path(private_folder())
    assert (folder == expected) == (existing in ("missing", "private"))
    status = folder.lstat()
    assert (stat.S_IMODE(status.st_mode), status.st_uid) == (0o700, os.geteuid())


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() != 0, reason="needs the right to be another user")
def test_private_folder_of_another_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    expected = tmp_path / f"taichi-msm-{os.geteuid()}"
    expected.mkdir(0o700)
    os.chown(expected, 12345, 12345)
    assert Path(private_folder()) != expected
