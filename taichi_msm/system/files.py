"""Files and folders that may come from anybody."""

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
    """Read a whole file without waiting for a pipe or a device, and without more memory than its limit.

    Args:
        path: the file; links are followed.
        limit: the most that is read [bytes].

    Returns:
        Its content.

    Raises:
        OSError: when it cannot be read, is no regular file or is larger; `strerror` says which.
        ValueError: when it cannot be a path.
    """
    # Opening a pipe would wait for its other end, and opening some devices does something; Windows has neither flag.
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
    """Find a folder of this user in the temporary directory, where others cannot write, for what has no home."""
    if sys.platform == "win32":
        return tempfile.gettempdir()  # of this user
    folder = Path(tempfile.gettempdir(), f"taichi-msm-{os.geteuid()}")
    with suppress(OSError):
        folder.mkdir(0o700)
    with suppress(OSError):
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o077:
            return str(folder)
    # Somebody else has taken the name: a folder for this process alone.
    own = tempfile.mkdtemp(prefix="taichi-msm-")
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own
