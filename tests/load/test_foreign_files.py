"""Files and folders that may come from anybody."""

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


def test_a_file_comes_whole_up_to_its_limit(tmp_path: Path, message: Messages) -> None:
    (tmp_path / "a").write_bytes(b"123")
    assert read_regular(tmp_path / "a", 3) == b"123"
    with message.raises(OSError):
        read_regular(tmp_path / "a", 2)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_what_is_no_file_or_never_ends_is_not_read(tmp_path: Path, message: Messages) -> None:
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(20 << 30)
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path / "sparse", tmp_path):
        with message.raises(OSError, hide=r": \d+$"):
            read_regular(path, 1 << 20)


def test_a_record_that_fills_memory_is_one_line(results: Path, message: Messages) -> None:
    os.truncate(results / "run.json", 20 << 30)
    with message.raises(FilesError, "run.json"):
        read_run(results)


@pytest.mark.skipif(sys.platform == "win32", reason="the temporary directory is the user's")
@pytest.mark.parametrize("found", ["nothing", "ours", "open to others", "a link", "a file"])
def test_without_a_home_kernels_go_where_nobody_else_writes(
    found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    place = tmp_path / f"taichi-msm-{os.geteuid()}"
    if found == "a link":
        (tmp_path / "theirs").mkdir()
        place.symlink_to(tmp_path / "theirs")
    elif found == "a file":
        place.touch()
    elif found != "nothing":
        place.mkdir(0o700)
        place.chmod(0o777 if found == "open to others" else 0o700)
    folder = Path(private_folder())
    assert (folder == place) == (found in ("nothing", "ours"))
    status = folder.lstat()
    assert (stat.S_IMODE(status.st_mode), status.st_uid) == (0o700, os.geteuid())


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() != 0, reason="needs the right to be another user")
def test_without_a_home_kernels_of_another_user_are_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    place = tmp_path / f"taichi-msm-{os.geteuid()}"
    place.mkdir(0o700)
    os.chown(place, 12345, 12345)
    assert Path(private_folder()) != place
