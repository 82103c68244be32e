"""Files and directories that other users may have created."""

from __future__ import annotations

import atexit
import errno
import os
import shutil
import stat
import sys
import tempfile
from contextlib import suppress
from pathlib import Path


def read_regular(path: str | Path, limit: int) -> bytes:
    """Read a regular file of at most `limit` bytes, without blocking on a pipe or a device.

    Other files raise an OSError, whose `strerror` has the reason, and invalid paths a ValueError.
    """
    # Opening a pipe would block, and opening some devices has side effects; Windows lacks these flags.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)
    with open(os.open(path, flags), "rb") as file:  # noqa: PTH123  # a descriptor
        status = os.fstat(file.fileno())
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.ENOTSUP, "not a regular file", str(path))
        if status.st_size <= limit and len(data := file.read(limit + 1)) <= limit:
            return data
    raise OSError(errno.EFBIG, f"larger than {limit:,} bytes", str(path))


def private_folder() -> str:
    """Return a temporary directory that only this user can write, for use without a home directory."""
    if sys.platform == "win32":
        return tempfile.gettempdir()  # of this user
    folder = Path(tempfile.gettempdir(), f"taichi-msm-{os.geteuid()}")
    with suppress(OSError):
        folder.mkdir(0o700)
    with suppress(OSError):
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o077:
            return str(folder)
    # The name is taken by another user, so this process gets its own directory.
    process_folder = tempfile.mkdtemp(prefix="taichi-msm-")
    atexit.register(shutil.rmtree, process_folder, ignore_errors=True)
    return process_folder
