"""Replace the results in a directory, whole or not at all, and only what a run, or an export, has written.

New files are written in `.partial/new`, in the directory itself. When all are there, this folder is renamed to
`.partial/whole`, and from then on the new results count: the record of the earlier ones is moved aside, the new files
are moved into place, those of the earlier ones that are left are removed, and the new record is moved last. So where
there is a record, the results are whole and belong together. If the process is killed before the folder is renamed, the
directory stays as it was; if later, the next publication completes the moves.

A record lists what was written, and only that is ever replaced or removed. Whatever else is in the way, a link or a
device among it, is an error before anything is touched. Who may write to the directory while a run does is trusted.

What is in a folder that we write in: only files of ours, or something that a link, a device or a person put there.

A folder is checked once, when work in it begins. What is created later is created exclusively.

Files that appear whole or not at all: written under a hidden name in the folder where they belong, then renamed.
"""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from taichi_msm.errors import DamagedError, FilesError, ForeignError

pass  # REMOVED
pass  # REMOVED

STAGING, NEW, WHOLE, EARLIER = ".partial", "new", "whole", "earlier.json"

# How often the staging directory is tried again while ending runs remove it; then it counts as missing.
ATTEMPTS = 100

# Size limit of a record [bytes]; even with more frames than any disk holds, it is smaller.
MAX_RECORD = 1 << 28

# Tells of the name of a file whether it is listed in a record.
Listed = Callable[[str], bool]


class Contents(NamedTuple):
    """What is published in a directory: the results of a run, or an export. Patterns are those of `directory.files`."""

    name: str  # what writes it, in messages
    record: str  # the file that lists what was written
    patterns: Collection[str]  # of all files that may be written, the record among them
    listed: Callable[[Mapping[str, Any]], Listed]  # turns the content of a record into what tells of the files
    alone: bool = False  # whether nothing else may be in the directory
    beside: tuple[str, Collection[str]] | None = None  # a folder, and patterns of its files, that `keep` is about


class Publication:
    """New contents for a directory. Leaving the with statement without `publish` discards them.

    `names` are all that may be published; it is an error if anything but earlier results has one of them.

    Raises:
        FilesError: on entering, when another process publishes there, or something is in the way that no run has put
            there; here and in `publish`.
        OSError: when the directory cannot be written.

    Attributes:
        staging: the folder for all that is not published yet.
        staged: the folder to write the new files in, under their final names; made on entering.
        keep: whether the folder beside the new files stays when the with statement is left.
    """

    def __init__(self, directory: Path, contents: Contents, names: Collection[str] = ()) -> None:
        self.staging = directory / STAGING
        self.staged = self.staging / NEW
        self.keep = True
        self._directory = directory
        self._contents = contents
        self._names = names
        self._record = directory / contents.record
        self._beside, inner = contents.beside or ("", ())
        self._patterns = [
            *(rf"{folder}/{pattern}" for folder in (NEW, WHOLE) for pattern in contents.patterns),
            *(rf"{self._beside}/{pattern}" for pattern in inner),
            *(LOCK, re.escape(EARLIER)),
        ]
        self._lock: BinaryIO
        self._open = ExitStack()

    @property
    def lock_descriptors(self) -> tuple[int, ...]:
        """File descriptors that a child process inherits to keep the directory locked while it lives."""
        return (self._lock.fileno(),) if os.name == "posix" else ()

    def publish(self, names: Collection[str]) -> None:
        """Replace earlier results by the staged files of these names, with the record among them."""
        for name in names:
            if kind(self.staged / name) != FILE:
                raise FilesError(f"{self.staged / name} was removed during the {self._contents.name}; run it again")
        self._require_free(names, self._earlier(self._record))
        self.staged.replace(self.staging / WHOLE)
        self._complete()

    def __enter__(self) -> Publication:
        with ExitStack() as opened:
            opened.enter_context(ensured(self._directory))
            try:
                opened.enter_context(self._acquire())
            except BlockingIOError:
                said = f"another {self._contents.name} is writing there; choose another --out"
                raise FilesError(f"{self._directory}: {said}") from None
            self._complete()
            self._clear()
            earlier = self._earlier(self._record)
            if self._contents.alone:
                for name in files(self._directory, self._contents.patterns, strict=True, besides=(STAGING,)):
                    if name not in earlier:
                        raise ForeignError.at(self._directory / name, FILE)
            self._require_free(self._names, earlier)
            self.staged.mkdir()
            self._open = opened.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        # What fails here is done by the next publication; an error that is being raised matters more.
        with suppress(OSError, FilesError):
            self._complete()
            self._clear()
        self._open.close()

    def _earlier(self, record: Path) -> set[str]:
        """List the results that are there, according to their record."""
        if kind(record) is None:
            return set()
        try:
            listed = self._listed(record)
        except ValueError:
            raise ForeignError.at(record, FILE) from None
        return {name for name in files(self._directory, self._contents.patterns, strict=False) if listed(name)}

    def _listed(self, record: Path) -> Listed:
        """Read a record; raises ValueError if it is none, and ForeignError if it is no file."""
        try:
            with require(record, FILE).open("rb") as file:
                return self._contents.listed(json.loads(file.read(MAX_RECORD)))
        except (KeyError, TypeError, RecursionError, OverflowError) as error:
            raise ValueError("no record") from error

    def _require_free(self, names: Collection[str], earlier: set[str]) -> None:
        """Make sure that results can be put in place, and that only earlier results are in their places."""
        for folder in sorted(parents(names)):
            # Checked here, so that it fails before the run, and not halfway through the moves.
            path = require(self._directory / folder, FOLDER)
            if kind(path) is None:
                continue
            if not os.access(path, os.W_OK):
                raise PermissionError(errno.EACCES, f"{folder} is not a writable directory")
        for name in names:
            actual = kind(self._directory / name)
            if actual is not None and (actual != FILE or name not in earlier):
                raise ForeignError.at(self._directory / name, actual)

    def _complete(self) -> None:
        """Move the new files into place, if all are there; after an interruption, go on."""
        whole, aside = self.staging / WHOLE, self.staging / EARLIER
        record = whole / self._contents.record
        if kind(record) is None:
            return  # The record is moved last, so all is done, or nothing is to be done.
        try:
            is_new = self._listed(record)
            if not is_new(record.name):
                raise ValueError("no record of itself")
        except ValueError:
            raise DamagedError(f"{record} is damaged; remove {self.staging} and run the scene again") from None
        begun = kind(aside) is not None
        earlier = self._earlier(aside if begun else self._record)
        left = list(files(whole, self._contents.patterns, strict=True))
        self._require_free(left, earlier)
        if not begun and kind(self._record) is not None:
            self._record.replace(aside)
        for name in left:
            if name != record.name:
                (self._directory / name).parent.mkdir(parents=True, exist_ok=True)
                (whole / name).replace(self._directory / name)
        gone = [name for name in earlier if not is_new(name)]
        for name in gone:
            (self._directory / name).unlink(missing_ok=True)
        for folder in sorted(parents(gone), reverse=True):
            with suppress(OSError):  # not empty
                (self._directory / folder).rmdir()
        record.replace(self._record)

    def _clear(self) -> None:
        """Empty the staging directory, except for the lock and what is to be kept."""
        clear(self.staging, self._patterns, keep=(LOCK, self._beside) if self.keep else (LOCK,))

    def _acquire(self) -> ExitStack:
        """Make the staging directory and lock it; released when all processes that hold the lock have ended."""
        for _ in range(ATTEMPTS):
            # A run that is ending may remove the directory before we open the lock, or before we have it.
            with suppress(FileNotFoundError), ExitStack() as opened:
                with suppress(FileExistsError):
                    self.staging.mkdir()
                # Checked before anything is written there.
                list(files(require(self.staging, FOLDER), self._patterns, strict=True))
                opened.callback(_try, self.staging.rmdir)
                self._lock = opened.enter_context(lock(self.staging / LOCK))
                if os.path.samestat(os.fstat(self._lock.fileno()), (self.staging / LOCK).lstat()):
                    opened.callback(_try, (self.staging / LOCK).unlink)
                    return opened.pop_all()
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))


def _try(remove: Callable[[], None]) -> None:
    with suppress(OSError):
        remove()


FILE, FOLDER = "a file", "a folder"


def kind(path: Path) -> str | None:
    """Give the kind of an entry, not of what it links to: FILE, FOLDER or other words; None if missing."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISREG(mode):
        return FILE
    if stat.S_ISDIR(mode):
        return FOLDER
    return "a symbolic link" if stat.S_ISLNK(mode) else "a pipe or a device"


def require(path: Path, wanted: str) -> Path:
    """Make sure that an entry, if it exists, is of a kind, or raise a ForeignError; returns its path."""
    if (actual := kind(path)) not in (None, wanted):
        raise ForeignError.at(path, str(actual))
    return path


def without_link(folder: Path, option: str) -> Path:
    """Make sure that a folder which the user did not name is no symbolic link: it may have come with the scene."""
    try:
        is_link = folder.is_symlink()
    except OSError as error:
        raise FilesError(f"{folder}: {(error.strerror or str(error)).lower()}") from None
    if is_link:
        raise FilesError(f"{folder}: a symbolic link; name the folder it leads to with {option}")
    return folder


def files(top: Path, patterns: Collection[str], *, strict: bool, besides: Collection[str] = ()) -> Iterator[str]:
    """List the files in a folder and below whose names, with slashes, match a pattern; no link is followed.

    Patterns are regular expressions for whole names, and those for the folders are what is before their last slash. If
    `strict`, the first other entry is a ForeignError, but for those `besides`.
    """
    allowed, folders = re.compile("|".join(patterns)), re.compile("|".join(parents(patterns)))

    def look(folder: Path, prefix: str) -> Iterator[str]:
        for path in folder.iterdir():
            actual, name = kind(path), prefix + path.name
            if actual is None or name in besides:
                continue
            if actual == FOLDER and folders.fullmatch(name):
                yield from look(path, f"{name}/")
            elif actual == FILE and allowed.fullmatch(name):
                yield name
            elif strict:
                raise ForeignError.at(path, actual)

    return look(top, "")


def clear(top: Path, patterns: Collection[str], keep: Collection[str] = ()) -> None:
    """Remove all entries of a folder but those to keep; before, raise a ForeignError if `files` does not allow one."""
    list(files(top, patterns, strict=True))
    for path in list(top.iterdir()):
        if path.name in keep:
            continue
        if kind(path) == FOLDER:
            shutil.rmtree(path)
        else:
            path.unlink()


def parents(names: Iterable[str]) -> set[str]:
    """List the folders that names with slashes are in, and those around them."""
    inner = {name.rpartition("/")[0] for name in names if "/" in name}
    return inner | parents(inner) if inner else inner


pass  # REMOVED

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
