"""Files that appear whole or not at all: written under a hidden name in the folder where they belong, then renamed."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from taichi_msm.errors import FilesError
from taichi_msm.results.entries import FILE, FOLDER, files, kind

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

HIDDEN, LOCK, DRAFT = r"\.partial-[0-9a-f]{16}", "lock", "draft"

# The files that are written in hidden folders.
STAGED = (LOCK, DRAFT, "picture", "session", "copy", r"animation\.gif", r"study\.(?:png|md|json)", r"sweep\.json")


@contextmanager
def ensured(folder: Path) -> Iterator[None]:
    """Make a folder and those around it if they are missing; one that was made and stays empty is removed."""
    is_new = not folder.exists()
    if is_new:
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        if is_new:
            with suppress(OSError):  # not empty
                folder.rmdir()


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Make a hidden folder to write files in until they are moved out; it is removed with those that are left.

    What a killed process has left there is removed before. The folder where the files belong is made if missing.
    """
    with ensured(folder):
        _clear_abandoned(folder)
        hidden = folder / f".partial-{secrets.token_hex(8)}"
        hidden.mkdir()
        try:
            with lock(hidden / LOCK):
                yield hidden
        finally:
            shutil.rmtree(hidden, ignore_errors=True)


def _clear_abandoned(folder: Path) -> None:
    for hidden in list(folder.iterdir()):
        if re.fullmatch(HIDDEN, hidden.name) and kind(hidden) == FOLDER:
            # One that is locked, or still being made, or of another user, or has other files than ours, stays.
            with suppress(OSError, FilesError):
                list(files(hidden, STAGED, strict=True))
                if kind(hidden / LOCK) == FILE:
                    with (hidden / LOCK).open("ab", 0) as file:
                        is_abandoned = _try_lock(file)
                    if is_abandoned:
                        shutil.rmtree(hidden)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a hidden draft of a file, which it replaces at the end of the block; if that raises, the file stays."""
    with staged(path.parent) as hidden:
        with create(hidden / DRAFT) as file:
            yield file
        (hidden / DRAFT).replace(path)


def place(draft: Path, folder: Path, stem: str, suffix: str) -> Path:
    """Move a file to the first free name of stem-1, stem-2 and so on; replaces none, and returns where it is."""
    number = 1
    while os.path.lexists(path := folder / f"{stem}-{number}{suffix}") or not give_name(draft, path):
        number += 1
    return path


def give_name(draft: Path, path: Path) -> bool:
    """Give a file a name, unless another has taken it meanwhile."""
    try:
        # Unlike a rename, a link does not replace another file.
        os.link(draft, path)
    except FileExistsError:
        return False
    except OSError:  # The file system has no links.
        draft.replace(path)
    return True


def create(path: Path, buffering: int = -1) -> BinaryIO:
    """Make a new file, and open it for writing and reading; raises FileExistsError where there is anything."""
    return path.open("x+b", buffering)


def add(path: Path, data: bytes) -> None:
    """Write a new file."""
    with create(path) as file:
        file.write(data)


def lock(path: Path) -> BinaryIO:
    """Lock a file, made if missing, until it is closed here and in all processes that have inherited it.

    Raises BlockingIOError when another process holds the lock.
    """
    file = path.open("ab", 0)
    try:
        _try_lock(file)
    except BlockingIOError:
        file.close()
        raise
    return file


def _try_lock(file: BinaryIO) -> bool:
    """Lock an open file; False where the file system has no locks; BlockingIOError where another has the lock."""
    try:
        if sys.platform == "win32":
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError) as error:  # the latter on Windows
        raise BlockingIOError(*error.args) from None
    except OSError:
        return False
    return True
