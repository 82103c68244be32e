"""Atomic replacement of files and of all results in a directory.

A publication has three steps:

1. Write the new results to `.partial/new` inside the directory.
2. Commit: rename this folder to `.partial/whole`.
3. Move the record of the earlier results aside. Move the new files into place, and delete obsolete ones. Last, move the
   new record into place.

A directory with a record therefore contains complete and consistent results. A process killed before the commit leaves
the directory unchanged; after the commit, the next publication completes step 3.

The record lists the files of a publication, and only listed files are replaced or deleted. A foreign entry at the path
of a result, such as a link or a device, is an error before any change. Folders are checked at the beginning of a
publication; files are opened for creation only. Processes that write to the directory during a run are trusted.

Single files are replaced atomically, too: they are written to a hidden folder next to their destination and renamed.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple

from taichi_msm.errors import DamagedError, FilesError, ForeignError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

STAGING_FOLDER, NEW_FOLDER, READY_FOLDER, PREVIOUS_RECORD = ".partial", "new", "whole", "earlier.json"
LOCK_FILE, DRAFT_FILE = "lock", "draft"

# Kinds of directory entries, for `entry_kind` and messages.
FILE, FOLDER = "a file", "a folder"

# Limit of the size of a record; no run has a larger one.
MAX_RECORD_BYTES = 1 << 28

# Predicate of a file name: whether the record lists it.
IsListed = Callable[[str], bool]


class PublicationSpec(NamedTuple):
    """Files that a run, an export or a fit publishes in a directory. Patterns are those of `list_files`."""

    name: str  # name of the publishing command, for messages
    record: str  # name of the file that lists the others
    patterns: Collection[str]  # of all files that may be published, including the record
    read_record: Callable[[Mapping[str, Any]], IsListed]  # converts a record to a predicate of file names
    exclusive: bool = False  # whether other files in the directory are errors
    # Folder next to the new files that is kept but not published, and patterns of its files.
    unpublished: tuple[str, Collection[str]] | None = None


class Publication(AbstractContextManager["Publication"]):
    """Publication of new files in a directory: a context manager that discards them at exit, except after `publish`.

    `names` are all files that may be published. Another process that publishes to the directory, and a foreign file at
    the path of one of them, are FilesErrors.
    """

    def __init__(self, directory: Path, spec: PublicationSpec, names: Collection[str] = ()) -> None:
        self.staging_folder = directory / STAGING_FOLDER  # for unpublished files
        self.new_folder = self.staging_folder / NEW_FOLDER  # for new files under their final names
        self.keep_unpublished = True  # whether the unpublished folder of the spec is kept at exit
        self._directory, self._spec, self._record = directory, spec, directory / spec.record
        self._unpublished, inner = spec.unpublished or ("", ())
        self._patterns = [
            *(rf"{folder}/{pattern}" for folder in (NEW_FOLDER, READY_FOLDER) for pattern in spec.patterns),
            *(rf"{self._unpublished}/{pattern}" for pattern in inner),
            *(LOCK_FILE, re.escape(PREVIOUS_RECORD)),
        ]
        with ExitStack() as opened:
            opened.enter_context(ensured_folder(directory))
            try:
                self._lock = self._acquire(opened)
            except BlockingIOError:
                fault = f"another {spec.name} is writing there; choose another --out"
                raise FilesError(f"{directory}: {fault}") from None
            self._complete()
            self._clear()
            earlier = self._listed_results(self._record)
            if spec.exclusive:
                for name in list_files(directory, spec.patterns, strict=True, ignored=(STAGING_FOLDER,)):
                    if name not in earlier:
                        raise ForeignError.at(directory / name, FILE)
            self._require_free(names, earlier)
            self.new_folder.mkdir()
            self._open = opened.pop_all()

    @property
    def lock_descriptors(self) -> tuple[int, ...]:
        """File descriptors that a child process inherits to keep the directory locked while it lives."""
        return (self._lock.fileno(),) if os.name == "posix" else ()

    def publish(self, names: Collection[str]) -> None:
        """Replace earlier results by the named new files, which include the record."""
        for name in names:
            if entry_kind(self.new_folder / name) != FILE:
                raise FilesError(f"{self.new_folder / name} was removed during the {self._spec.name}; run it again")
        self._require_free(names, self._listed_results(self._record))
        self.new_folder.replace(self.staging_folder / READY_FOLDER)
        self._complete()

    def publish_record(self, record: Mapping[str, Any]) -> None:
        """Write a record with the names of all new files, and publish them."""
        names = sorted(list_files(self.new_folder, self._spec.patterns, strict=True))
        text = json.dumps({**record, "files": names}, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        write_new_file(self.new_folder / self._spec.record, text.encode())
        self.publish([*names, self._spec.record])

    def __exit__(self, *_: object) -> None:
        # Errors are ignored: the next publication repeats the cleanup, and an exception of the block has precedence.
        with suppress(OSError, FilesError):
            self._complete()
            self._clear()
        self._open.close()

    def _listed_results(self, record: Path) -> set[str]:
        """List the existing results that a record names."""
        if entry_kind(record) is None:
            return set()
        try:
            is_listed = self._read_record(record)
        except ValueError:
            raise ForeignError.at(record, FILE) from None
        return {name for name in list_files(self._directory, self._spec.patterns, strict=False) if is_listed(name)}

    def _read_record(self, record: Path) -> IsListed:
        """Read a record; raise a ValueError if it is invalid, a ForeignError if it is not a regular file."""
        try:
            with require_kind(record, FILE).open("rb") as file:
                return self._spec.read_record(json.loads(file.read(MAX_RECORD_BYTES)))
        except (KeyError, TypeError, RecursionError, OverflowError) as error:
            raise ValueError("no record") from error

    def _require_free(self, names: Collection[str], earlier: set[str]) -> None:
        """Require writable folders, and no foreign entries at the paths of new files."""
        for folder in sorted(parent_folders(names)):
            # An unwritable folder is an error here, before the run, not later during the moves.
            path = require_kind(self._directory / folder, FOLDER)
            if entry_kind(path) is not None and not os.access(path, os.W_OK):
                raise PermissionError(errno.EACCES, f"{folder} is not a writable directory")
        for name in names:
            actual = entry_kind(self._directory / name)
            if actual is not None and (actual != FILE or name not in earlier):
                raise ForeignError.at(self._directory / name, actual)

    def _complete(self) -> None:
        """Complete a committed publication, this one or an interrupted one: move its files into place."""
        ready, moved_record = self.staging_folder / READY_FOLDER, self.staging_folder / PREVIOUS_RECORD
        record = ready / self._spec.record
        if entry_kind(record) is None:
            return  # the record is moved last: nothing is committed, or all moves are done
        try:
            is_new = self._read_record(record)
            if not is_new(record.name):
                raise ValueError
        except ValueError:
            raise DamagedError(f"{record} is damaged; remove {self.staging_folder} and run the scene again") from None
        is_continued = entry_kind(moved_record) is not None
        earlier = self._listed_results(moved_record if is_continued else self._record)
        remaining = list(list_files(ready, self._spec.patterns, strict=True))
        self._require_free(remaining, earlier)
        if not is_continued and entry_kind(self._record) is not None:
            self._record.replace(moved_record)
        for name in remaining:
            if name != record.name:
                (self._directory / name).parent.mkdir(parents=True, exist_ok=True)
                (ready / name).replace(self._directory / name)
        obsolete = [name for name in earlier if not is_new(name)]
        for name in obsolete:
            (self._directory / name).unlink(missing_ok=True)
        for folder in sorted(parent_folders(obsolete), reverse=True):
            with suppress(OSError):  # when it is not empty
                (self._directory / folder).rmdir()
        record.replace(self._record)

    def _clear(self) -> None:
        """Delete the contents of the staging folder, except the lock and a kept folder."""
        list(list_files(self.staging_folder, self._patterns, strict=True))  # raises an error for foreign files
        keep = (LOCK_FILE, self._unpublished) if self.keep_unpublished else (LOCK_FILE,)
        for path in [path for path in self.staging_folder.iterdir() if path.name not in keep]:
            if entry_kind(path) == FOLDER:
                shutil.rmtree(path)
            else:
                path.unlink()

    def _acquire(self, opened: ExitStack) -> BinaryIO:
        """Create the staging folder, and lock it until all processes with the lock's descriptor have ended."""
        path = self.staging_folder / LOCK_FILE
        # Another publication may end and delete the folder or the lock at any moment; then try again.
        for _ in range(100):
            with suppress(FileNotFoundError), ExitStack() as attempt:
                with suppress(FileExistsError):
                    self.staging_folder.mkdir()
                # Raise an error for foreign files before anything is written.
                list(list_files(require_kind(self.staging_folder, FOLDER), self._patterns, strict=True))
                attempt.callback(_try_to_remove, self.staging_folder.rmdir)
                lock = attempt.enter_context(lock_file(path))
                if os.path.samestat(os.fstat(lock.fileno()), path.lstat()):
                    attempt.callback(_try_to_remove, path.unlink)
                    opened.push(attempt.pop_all())
                    return lock
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))


def _try_to_remove(remove: Callable[[], None]) -> None:
    with suppress(OSError):
        remove()


def entry_kind(path: Path) -> str | None:
    """Return the kind of a directory entry: FILE, FOLDER or a description, such as of a link; None if missing."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISREG(mode):
        return FILE
    if stat.S_ISDIR(mode):
        return FOLDER
    return "a symbolic link" if stat.S_ISLNK(mode) else "a pipe or a device"


def require_kind(path: Path, kind: str) -> Path:
    """Return a path whose entry is of a kind, FILE or FOLDER, or missing; others, such as links, are ForeignErrors."""
    if (actual := entry_kind(path)) not in (None, kind):
        raise ForeignError.at(path, str(actual))
    return path


def require_no_link(folder: Path, option: str) -> Path:
    """Return a default folder; raise a FilesError if it is a symbolic link, which may come with an untrusted scene."""
    try:
        is_link = folder.is_symlink()
    except OSError as error:
        raise FilesError(f"{folder}: {(error.strerror or str(error)).lower()}") from None
    if is_link:
        raise FilesError(f"{folder}: a symbolic link; name the folder it leads to with {option}")
    return folder


def list_files(top: Path, patterns: Collection[str], *, strict: bool, ignored: Collection[str] = ()) -> Iterator[str]:
    """Yield the files below a folder whose relative paths, with slashes, match a pattern; links are not followed.

    The part of a pattern before each slash is that of a subfolder. With `strict`, an entry without a match is a
    ForeignError. Entries with a name in `ignored` are skipped.
    """
    files, folders = re.compile("|".join(patterns)), re.compile("|".join(parent_folders(patterns)))

    def walk(folder: Path, prefix: str) -> Iterator[str]:
        for path in folder.iterdir():
            actual, name = entry_kind(path), prefix + path.name
            if actual is None or name in ignored:
                continue
            if actual == FOLDER and folders.fullmatch(name):
                yield from walk(path, f"{name}/")
            elif actual == FILE and files.fullmatch(name):
                yield name
            elif strict:
                raise ForeignError.at(path, actual)

    return walk(top, "")


def parent_folders(names: Iterable[str]) -> set[str]:
    """Collect all ancestor folders of relative paths."""
    inner = {name.rpartition("/")[0] for name in names if "/" in name}
    return inner | parent_folders(inner) if inner else inner


@contextmanager
def ensured_folder(folder: Path) -> Iterator[None]:
    """Create a folder and its ancestors if missing; at exit, delete the new folder if it is empty."""
    is_new = not folder.exists()
    if is_new:
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        if is_new:
            with suppress(OSError):  # when it is not empty
                folder.rmdir()


@contextmanager
def hidden_folder(folder: Path) -> Iterator[Path]:
    """Create a hidden folder for unfinished files in their destination `folder`, and delete it at exit.

    The destination is created if missing. Hidden folders of killed processes are deleted.
    """
    with ensured_folder(folder):
        _clear_abandoned(folder)
        temporary = TemporaryDirectory(prefix=".partial-", dir=folder, ignore_cleanup_errors=True)
        with temporary as hidden, lock_file(Path(hidden, LOCK_FILE)):
            yield Path(hidden)


def _clear_abandoned(folder: Path) -> None:
    """Delete the hidden folders of killed processes."""
    for hidden in list(folder.iterdir()):
        if re.fullmatch(r"\.partial-[0-9a-z_]{8,16}", hidden.name) and entry_kind(hidden) == FOLDER:
            # Others are kept: locked or incomplete ones, those of other users, and those with foreign files.
            with suppress(OSError, FilesError):
                pattern = r"lock|draft|picture|session|copy|animation\.(?:gif|mp4)|study\.(?:png|md|json)|sweep\.json"
                list(list_files(hidden, [pattern], strict=True))
                if entry_kind(hidden / LOCK_FILE) == FILE:
                    with (hidden / LOCK_FILE).open("ab", 0) as file:
                        is_abandoned = _try_lock(file)
                    if is_abandoned:
                        shutil.rmtree(hidden)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a draft that replaces a file at exit; after an exception, the file is unchanged."""
    with hidden_folder(path.parent) as hidden:
        with create_file(hidden / DRAFT_FILE) as file:
            yield file
        (hidden / DRAFT_FILE).replace(path)


def move_to_free_name(draft: Path, folder: Path, stem: str, suffix: str) -> Path:
    """Move a file to the first free name in a folder: stem-1.suffix, stem-2.suffix and so on; return its path."""
    number = 1
    while os.path.lexists(path := folder / f"{stem}-{number}{suffix}") or not link_without_replacing(draft, path):
        number += 1
    return path


def link_without_replacing(draft: Path, path: Path) -> bool:
    """Link a file to a new path, or move it on a file system without links; return whether the path was free.

    An existing file is kept, except in a race on a file system without links.
    """
    try:
        # A rename would replace an existing file.
        os.link(draft, path)
    except FileExistsError:
        return False
    except OSError:  # the file system has no links
        draft.replace(path)
    return True


def create_file(path: Path) -> BinaryIO:
    """Create a file, and open it for writing and reading; raise a FileExistsError if it exists."""
    return path.open("x+b")


def write_new_file(path: Path, data: bytes) -> None:
    """Create a file with its content; raise a FileExistsError if it exists."""
    with create_file(path) as file:
        file.write(data)


def lock_file(path: Path) -> BinaryIO:
    """Lock a file, created if missing, until it is closed here and in all processes that inherit it.

    A lock of another process is a BlockingIOError.
    """
    file = path.open("ab", 0)
    try:
        _try_lock(file)
    except BlockingIOError:
        file.close()
        raise
    return file


def _try_lock(file: BinaryIO) -> bool:
    """Lock an open file; return False if the file system has no locks, raise a BlockingIOError if it is locked."""
    try:
        if sys.platform == "win32":
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError) as error:  # PermissionError on Windows
        raise BlockingIOError(*error.args) from None
    except OSError:
        return False
    return True
