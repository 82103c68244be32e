"""A folder whose files are opened relative to it, so that no link and no name leads out of it.

If the system supports it, every operation names a single entry of an open directory and follows no symbolic link
(`openat` with O_NOFOLLOW). So nobody can redirect an operation by replacing a directory with a link in the meantime.
Windows has no such calls; there each entry is checked before it is opened.
"""

from __future__ import annotations

import os
import re
import stat
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Union

from taichi_msm.errors import ForeignError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

HAS_DESCRIPTORS = os.open in os.supports_dir_fd and hasattr(os, "O_NOFOLLOW")
# Whether child processes can inherit an open file together with its lock.
INHERITS = os.name == "posix"

FILE, FOLDER = "a file", "a folder"

_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
# Opening a pipe must not wait for its other end; what was opened is checked again.
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)

# The entries that a folder of ours may contain: patterns of names, each with None for a file or a tree for a folder.
Tree = Mapping[str, Union["Tree", None]]


@dataclass(frozen=True)
class Folder:
    """An open directory. Usable in a with statement, which closes it.

    Every name is that of a single entry. Methods raise the OSError of the system, and ForeignError if an entry is a
    symbolic link or not of the expected kind.

    Attributes:
        path: of the directory when it was opened, for messages.
        descriptor: of the open directory; None if the system does not support operations relative to one.
    """

    path: Path
    descriptor: int | None

    @classmethod
    def at(cls, path: Path, *, create: bool = False) -> Folder:
        """Open the directory that a user named, following links; `create`: make it and its parents if missing."""
        if create and not path.exists():
            path.mkdir(parents=True, exist_ok=True)
        if HAS_DESCRIPTORS:
            return cls(path, os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC))
        os.scandir(path).close()  # raises what opening it would
        return cls(path, None)

    def kind(self, name: str) -> str | None:
        """Give the kind of an entry, not of what it links to: FILE, FOLDER or other words; None if missing."""
        try:
            return _kind(os.stat(self._entry(name), dir_fd=self.descriptor, follow_symlinks=False).st_mode)
        except FileNotFoundError:
            return None

    def identity(self, name: str) -> list[int] | None:
        """Identify a file by inode, size and time of change, so that its replacement shows; None if it is missing."""
        try:
            status = os.stat(self._entry(name), dir_fd=self.descriptor, follow_symlinks=False)
        except FileNotFoundError:
            return None
        return [status.st_ino, status.st_size, status.st_mtime_ns]

    def is_writable(self, name: str) -> bool:
        """Tell whether this process may write to an entry."""
        return os.access(self._entry(name), os.W_OK, dir_fd=self.descriptor)

    def entries(self) -> Iterator[tuple[str, str]]:
        """List the names and kinds of all entries."""
        with os.scandir(self.path if self.descriptor is None else self.descriptor) as found:
            names = [entry.name for entry in found]
        for name in names:
            if (kind := self.kind(name)) is not None:
                yield name, kind

    def files(self, tree: Tree) -> Iterator[str]:
        """List the names of the files here and below that a tree allows, each with its folders."""
        for name, kind in self.entries():
            for below in _allowed(tree, name):
                if below is not None:
                    with self.folder(name) as inner:
                        yield from [f"{name}/{file}" for file in inner.files(below)]
                elif kind == FILE:
                    yield name

    def folder(self, name: str, *, create: bool = False) -> Folder:
        """Open a folder in this one; `create`: make it if it is missing."""
        if create:
            with suppress(FileExistsError):
                os.mkdir(self._entry(name), dir_fd=self.descriptor)
        self._require(name, FOLDER)
        if self.descriptor is None:
            return Folder.at(self.path / name)
        return Folder(self.path / name, os.open(name, os.O_RDONLY | os.O_DIRECTORY | _NO_LINK, dir_fd=self.descriptor))

    def open(self, name: str, *, write: bool = False, create: bool = False) -> BinaryIO:
        """Open a regular file, without a buffer.

        Args:
            name: of the file.
            write: open it for changes in place; it must then have no other name (hard link).
            create: make it if it is missing.
        """
        self._require(name, FILE)
        flags = (os.O_RDWR if write else os.O_RDONLY) | (os.O_CREAT if create else 0)
        file = self._open(name, flags | _NO_WAIT, buffering=0)
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or (write and status.st_nlink > 1):
            file.close()
            raise ForeignError.at(self.path / name, "a file that has other names, or no file,")
        return file

    def create(self, name: str, buffering: int = -1) -> BinaryIO:
        """Make a new file, and open it for writing and reading; `buffering` as for Python's open."""
        return self._open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL, buffering)

    def add(self, name: str, data: bytes) -> None:
        """Write a new file."""
        with self.create(name) as file:
            file.write(data)

    def lock(self, name: str) -> BinaryIO:
        """Lock a file, made if missing, until it is closed here and in all processes that have inherited it.

        Raises:
            BlockingIOError: when another process holds the lock.
        """
        file = self.open(name, write=True, create=True)
        try:
            _take(file.fileno())
        except BlockingIOError:
            file.close()
            raise
        except OSError:
            pass  # a file system without locks
        return file

    def replace(self, name: str, folder: Folder, new: str) -> None:
        """Move a file to another folder or name, replacing a file there."""
        self._require(name, FILE)
        folder._require(new, FILE)
        os.replace(self._entry(name), folder._entry(new), src_dir_fd=self.descriptor, dst_dir_fd=folder.descriptor)

    def write(self, name: str, data: bytes, draft: str = "draft") -> None:
        """Write a file as a whole or not at all: write a draft, then rename it."""
        self.remove(draft)
        try:
            self.add(draft, data)
            self.replace(draft, self, name)
        except BaseException:
            self.remove(draft)
            raise

    def remove(self, name: str) -> None:
        """Remove a file, if it exists."""
        if self.kind(name) is not None:
            self._require(name, FILE)
            os.unlink(self._entry(name), dir_fd=self.descriptor)

    def remove_folder(self, name: str) -> None:
        """Remove an empty folder."""
        os.rmdir(self._entry(name), dir_fd=self.descriptor)

    def require_only(self, tree: Tree) -> None:
        """Make sure that this folder and those below contain only what a tree allows.

        Raises:
            ForeignError: names the first other entry.
        """
        for name, kind in self.entries():
            allowed = _allowed(tree, name)
            if not allowed:
                raise ForeignError.at(self.path / name, kind)
            if allowed[0] is None:
                self._require(name, FILE)
            else:
                with self.folder(name) as inner:
                    inner.require_only(allowed[0])

    def clear(self, tree: Tree, keep: Collection[str] = ()) -> None:
        """Remove all entries except those in `keep`; raises what `require_only` does, and then removes nothing."""
        self.require_only(tree)
        for name, kind in self.entries():
            if name in keep:
                continue
            if kind == FILE:
                self.remove(name)
            else:
                with self.folder(name) as inner:
                    inner.clear(_allowed(tree, name)[0] or {})
                self.remove_folder(name)

    def close(self) -> None:
        """Close it."""
        if self.descriptor is not None:
            os.close(self.descriptor)

    def __enter__(self) -> Folder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, name: str, flags: int, buffering: int) -> BinaryIO:
        descriptor = os.open(self._entry(name), flags | _NO_LINK, 0o666, dir_fd=self.descriptor)
        mode = "r+b" if flags & os.O_RDWR else "rb"
        return os.fdopen(descriptor, mode, buffering)  # type: ignore[return-value]

    def _require(self, name: str, wanted: str) -> None:
        """Make sure that an entry, if it exists, is of a kind."""
        kind = self.kind(name)
        if kind not in (None, wanted):
            raise ForeignError.at(self.path / name, str(kind))

    def _entry(self, name: str) -> str:
        if name in ("", ".", "..") or "/" in name or os.sep in name or "\0" in name:
            raise ValueError(f"{name!r} is not the name of an entry")
        return name if self.descriptor is not None else str(self.path / name)


def write_all(file: BinaryIO, data: bytes | memoryview) -> None:
    """Write all data to an unbuffered file, which may take only some of the bytes at a time."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]


def allows(tree: Tree, name: str) -> bool:
    """Tell whether a tree allows a file; its name may begin with folders."""
    head, _, rest = name.partition("/")
    found = _allowed(tree, head)
    if not found or not rest:
        return found == [None]
    return found[0] is not None and allows(found[0], rest)


def _allowed(tree: Tree, name: str) -> list[Tree | None]:
    """List what a tree allows for a name: a file (None) or a folder with its tree."""
    return [below for pattern, below in tree.items() if re.fullmatch(pattern, name)]


def _kind(mode: int) -> str:
    if stat.S_ISREG(mode):
        return FILE
    if stat.S_ISDIR(mode):
        return FOLDER
    return "a symbolic link" if stat.S_ISLNK(mode) else "a pipe or a device"


def _take(descriptor: int) -> None:
    """Lock an open file.

    Raises:
        BlockingIOError: when another process holds the lock.
        OSError: when the file system has no locks.
    """
    if sys.platform == "win32":
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError as error:
            raise BlockingIOError(*error.args) from None
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
