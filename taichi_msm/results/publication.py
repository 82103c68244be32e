"""Replace the results in a directory, whole or not at all, and only what a run, or an export, has written.

New files are staged below the directory, so that every move is a rename within one file system. When all are there, a
marker with their names is written. Then the record of the earlier results is removed, the other files are moved, and
the new record is moved last: where there is a record, the results are whole and belong together. If the process is
killed before the marker is written, the directory stays as it was; if later, the next publication first completes the
moves.

The record lists what was written, and only that is ever replaced or removed. If anything else is in the way, that
is an error before anything is touched.
"""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from taichi_msm.errors import DamagedError, FilesError, ForeignError
from taichi_msm.results.folder import FILE, FOLDER, HAS_DESCRIPTORS, INHERITS, Folder, Tree
from taichi_msm.results.sealed import seal, unseal
from taichi_msm.scene import UNTIL_NEXT

FRAMES, COORDINATES, DEPTH, FLOW, OCCLUSION, INSTRUMENT = SERIES_NAMES = (
    "frames",
    "coordinates",
    "depth",
    "flow",
    "occlusion",
    "instrument",
)
ANIMATION, TRAJECTORY, TRACKS, CAMERA = FILE_NAMES = "animation.gif", "trajectory.npz", "tracks.npz", "camera.json"
RECORD = "run.json"

# Folders with a file for every frame, and the extension of these files.
# The result of an entry of a scene's `output`, where it has another name.
RESULTS = {"png": FRAMES, "gif": ANIMATION, "trajectory": TRAJECTORY, "tracks": TRACKS}
SERIES = dict(zip(SERIES_NAMES, ("png", "npy", "tiff", "flo", "png", "png"), strict=True))

# A folder is a checkpoint if it has a run's manifest. Beside it are the positions of the frames and the last state.
MANIFEST, POSITIONS, STATE = "manifest.json", "positions", "state.npz"

STAGING, NEW, CHECKPOINT = ".partial", "new", "checkpoint"
LOCK, MARKER, DRAFT = "lock", "complete", "draft"

# All files that a run may have below a directory before it publishes its results.
CHECKPOINT_TREE: Tree = dict.fromkeys((MANIFEST, POSITIONS, re.escape(STATE), DRAFT))
NEW_TREE: Tree = {
    **{folder: {rf"[0-9]{{4,}}\.{kind}": None} for folder, kind in SERIES.items()},
    **{re.escape(name): None for name in (*FILE_NAMES, RECORD)},
}

# How often the staging directory is tried again while ending runs remove it; then it counts as missing.
ATTEMPTS = 100

# Size limit of a record [bytes]; even with more frames than any disk holds, it is smaller.
MAX_RECORD = 1 << 28


def open_checkpoint(directory: Path) -> Folder:
    """Open the checkpoint of the unfinished run in a directory; raises OSError if there is none."""
    with Folder.at(directory) as here, here.folder(STAGING) as staging:
        return staging.folder(CHECKPOINT)


def is_unfinished(directory: Path) -> bool:
    """Tell whether a directory has an unfinished run that can be continued."""
    try:
        with open_checkpoint(directory) as checkpoint:
            return checkpoint.kind(MANIFEST) == FILE
    except (OSError, FilesError):
        return False


def series_file(folder: str, number: int) -> str:
    """Name the file of a frame within its folder."""
    return f"{number:04}.{SERIES[folder]}"


def series_length(folder: str, frames: int) -> int:
    """Count the files in a folder of results with this many frames."""
    return max(0, frames - 1) if folder in UNTIL_NEXT else frames


def result_names(outputs: Iterable[str], frames: int) -> list[str]:
    """List the files of results, with their folder.

    Args:
        outputs: names of files and of folders with a file for every frame.
        frames: how many frames.
    """
    names = []
    for output in outputs:
        if output in SERIES:
            names += [f"{output}/{series_file(output, n)}" for n in range(series_length(output, frames))]
        else:
            names.append(output)
    return names


class Kind(NamedTuple):
    """What is published.

    Attributes:
        name: what writes it, in messages.
        record: the file that lists what was written; it is moved last.
        files: all that may be written, the record among it.
        is_result: tells whether this may be the name of a file.
        listed: turns the content of a record into what tells whether it lists a file.
        alone: whether nothing else may be in the directory.
        beside: what else may be in the staging directory.
    """

    name: str
    record: str
    files: Tree
    is_result: Callable[[object], bool]
    listed: Callable[[Any], Callable[[str], bool]]
    alone: bool
    beside: Tree


class Publication:
    """New contents for a directory. Leaving the with statement without `publish` discards them.

    Args:
        directory: where the results go; made if it does not exist.
        names: all that may be published; it is an error if anything but earlier results has one of these names.
        kind: what is published; None: the results of a run.

    Raises:
        FilesError: on entering, when another process publishes there, or something is in the way that no run has put
            there; here and in `publish`.
        OSError: when the directory cannot be written.

    Attributes:
        staging: the folder for all that is not published yet; known after entering.
        staged: the folder to write the new files in, under their final names; likewise.
        keep: whether the checkpoint of an unfinished run, this one or an earlier, stays when the with statement is
            left.
    """

    staging: Folder
    staged: Folder

    def __init__(self, directory: Path, names: Collection[str] = (), kind: Kind | None = None) -> None:
        self.keep = True
        self._kind = kind or RUN
        self._tree: Tree = {
            **dict.fromkeys((LOCK, MARKER, DRAFT)),
            NEW: self._kind.files,
            **self._kind.beside,
        }
        self._path = directory
        self._names = names
        self._open = ExitStack()
        self._lock: BinaryIO | None = None
        self._created = False

    @property
    def lock_descriptors(self) -> tuple[int, ...]:
        """File descriptors that a child process inherits to keep the directory locked while it lives."""
        return (self._lock.fileno(),) if self._lock and INHERITS else ()

    def publish(self, names: Collection[str]) -> None:
        """Replace earlier results by the staged files.

        Args:
            names: the names of the files, all staged, with the record among them.

        Raises:
            FilesError: when a staged file was removed, or something that no run has written is in its place.
        """
        with ExitStack() as opened:
            staged = _Files(self.staged, opened)
            for name in names:
                if staged.kind(name) != FILE:
                    said = f"was removed during the {self._kind.name}; run it again"
                    raise FilesError(f"{self.staged.path / name} {said}")
        earlier = self._earlier()
        self._require_free(names, earlier)
        with ExitStack() as opened:
            here = _Files(self._here, opened)
            # The marker names the exact files, so that a forged marker cannot make us remove the user's files.
            known = {name: here.identity(name) for name in sorted(earlier)}
        self.staging.write(MARKER, seal({"names": sorted(names), "earlier": known}), DRAFT)
        self._complete()

    def __enter__(self) -> Publication:
        self._created = not self._path.exists()
        with ExitStack() as opened:
            self._here = opened.enter_context(Folder.at(self._path, create=True))
            opened.callback(self._remove_if_created)
            try:
                self._acquire(opened)
            except BlockingIOError:
                said = f"another {self._kind.name} is writing there; choose another --out"
                raise FilesError(f"{self._path}: {said}") from None
            self._complete()
            self._clear()
            earlier = self._earlier()
            if self._kind.alone:
                _require_only(self._here, earlier)
            self._require_free(self._names, earlier)
            self.staged = opened.enter_context(self.staging.folder(NEW, create=True))
            self._open = opened.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        # What fails here is done by the next publication; an error that is being raised matters more.
        with suppress(OSError, FilesError):
            self._complete()
            self._clear()
        self._open.close()

    def _earlier(self) -> set[str]:
        """List the earlier results, according to their record."""
        record = self._kind.record
        if self._here.kind(record) is None:
            return set()
        try:
            with self._here.open(record) as file:
                listed = self._kind.listed(json.loads(file.read(MAX_RECORD)))
        except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
            raise ForeignError.at(self._path / record, "a file") from None
        return {name for name in self._here.files(self._kind.files) if self._kind.is_result(name) and listed(name)}

    def _require_free(self, names: Collection[str], earlier: set[str]) -> None:
        """Make sure that results can be put in place, and that only earlier results are in their places."""
        with ExitStack() as opened:
            here = _Files(self._here, opened)
            # Checked here, so that it fails before the run, and not halfway through the moves.
            for folder in _folders(names):
                if here.has_folder(folder) and not here.is_writable(folder):
                    raise PermissionError(errno.EACCES, f"{folder} is not a writable directory")
            for name in names:
                kind = here.kind(name)
                if kind is not None and (kind != FILE or name not in earlier):
                    raise ForeignError.at(self._path / name, kind)

    def _complete(self) -> None:
        """Move the staged files into place, if the marker says that all are there; after an interruption, go on."""
        try:
            with self.staging.open(MARKER) as file:
                marker = unseal(file.read(MAX_RECORD))
            # The marker is not trusted, as anybody may have written it.
            is_result = self._kind.is_result
            names = [name for name in marker["names"] if is_result(name)]
            known = {name: identity for name, identity in marker["earlier"].items() if is_result(name)}
        except FileNotFoundError:
            return
        except (ValueError, KeyError, TypeError, AttributeError):
            message = f"{self.staging.path / MARKER} is damaged; remove {self.staging.path} and run the scene again"
            raise DamagedError(message) from None
        if self.staging.kind(NEW) is None:
            return
        with ExitStack() as opened:
            new = opened.enter_context(self.staging.folder(NEW))
            here, staged = _Files(self._here, opened), _Files(new, opened)
            left = [name for name in names if staged.kind(name) is not None]
            record = self._kind.record
            if record not in left:
                return  # The record is moved last, so all is done.
            earlier = {name for name, identity in known.items() if here.identity(name) == identity}
            self._require_free(left, earlier)
            here.remove(record)
            for name in left:
                if name != record:
                    staged.replace(name, here)
            gone = [name for name in earlier.difference(names) if here.kind(name) == FILE]
            for name in gone:
                here.remove(name)
            for folder in sorted(_folders(gone), reverse=True):
                with suppress(OSError):  # not empty
                    here.remove_folder(folder)
            staged.replace(record, here)

    def _clear(self) -> None:
        """Empty the staging directory, except for the lock and what is to be kept."""
        if not self.keep and self.staging.kind(CHECKPOINT) is not None:
            with self.staging.folder(CHECKPOINT) as checkpoint:
                # The manifest is removed first, so that a half-removed checkpoint does not count as one.
                checkpoint.remove(MANIFEST)
        self.staging.clear(self._tree, keep=(LOCK, CHECKPOINT) if self.keep else (LOCK,))

    def _acquire(self, opened: ExitStack) -> None:
        """Make the staging directory and lock it. The lock is released when the processes that hold it have ended."""
        for _ in range(ATTEMPTS):
            # A run that is ending may remove the directory before we open it, or before we have its lock.
            with suppress(FileNotFoundError), ExitStack() as tried:
                self.staging = tried.enter_context(self._here.folder(STAGING, create=True))
                # Checked before anything is written there.
                self.staging.require_only(self._tree)
                tried.callback(self._remove_staging)
                lock = tried.enter_context(self.staging.lock(LOCK))
                if HAS_DESCRIPTORS:
                    status = os.stat(LOCK, dir_fd=self.staging.descriptor, follow_symlinks=False)
                    if not os.path.samestat(os.fstat(lock.fileno()), status):
                        continue
                self._lock = lock
                tried.callback(self._remove_lock)
                opened.push(tried.pop_all())
                return
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))

    def _remove_lock(self) -> None:
        with suppress(OSError, FilesError):
            self.staging.remove(LOCK)

    def _remove_staging(self) -> None:
        with suppress(OSError):  # not empty
            self._here.remove_folder(STAGING)

    def _remove_if_created(self) -> None:
        if self._created:
            with suppress(OSError):  # not empty
                self._path.rmdir()


class _Files:
    """Files by their names, which may begin with folders; each folder is opened once.

    Args:
        top: the folder of names that begin with none.
        opened: closes what is opened.
    """

    def __init__(self, top: Folder, opened: ExitStack) -> None:
        self._opened = opened
        self._folders = {"": top}

    def has_folder(self, name: str, *, create: bool = False) -> bool:
        """Tell whether a folder is there; raises ForeignError if something else has its name; `create`: make it."""
        if name not in self._folders:
            folder, _, last = name.rpartition("/")
            if self.has_folder(folder, create=create) and (create or self._folders[folder].kind(last) is not None):
                self._folders[name] = self._opened.enter_context(self._folders[folder].folder(last, create=create))
        return name in self._folders

    def is_writable(self, name: str) -> bool:
        """Tell whether this process may write to a folder, which is there."""
        folder, _, last = name.rpartition("/")
        return self._folders[folder].is_writable(last)

    def remove_folder(self, name: str) -> None:
        """Remove an empty folder, whose files were removed here."""
        folder, _, last = name.rpartition("/")
        self._folders[folder].remove_folder(last)

    def kind(self, name: str) -> str | None:
        """Say what has this name."""
        folder, _, file = name.rpartition("/")
        return self._folders[folder].kind(file) if self.has_folder(folder) else None

    def identity(self, name: str) -> list[int] | None:
        """Give what distinguishes a file from any other that may take its place."""
        folder, _, file = name.rpartition("/")
        return self._folders[folder].identity(file) if self.has_folder(folder) else None

    def remove(self, name: str) -> None:
        """Remove a file, if there is one."""
        folder, _, file = name.rpartition("/")
        if self.has_folder(folder):
            self._folders[folder].remove(file)

    def replace(self, name: str, other: _Files) -> None:
        """Move a file to the same name among other files."""
        folder, _, file = name.rpartition("/")
        other.has_folder(folder, create=True)
        self._folders[folder].replace(file, other._folders[folder], file)


def _folders(names: Iterable[str]) -> set[str]:
    """List the folders that files are in, and those around them."""
    found = {name.rpartition("/")[0] for name in names if "/" in name}
    return found | _folders(found) if found else found


def _require_only(directory: Folder, names: set[str]) -> None:
    """Make sure that a directory contains only these files, and its staging directory; raises ForeignError."""
    folders = _folders(names)

    def look(folder: Folder, prefix: str) -> None:
        for last, kind in folder.entries():
            name = prefix + last
            if kind == FOLDER and name in folders:
                with folder.folder(last) as inner:
                    look(inner, f"{name}/")
            elif name != STAGING and not (kind == FILE and name in names):
                raise ForeignError.at(directory.path / name, kind)

    look(directory, "")


def _listed(record: Mapping[str, Any]) -> Callable[[str], bool]:
    """Tell of a result whether it is one of the run with this record."""
    outputs, frames = set(record["outputs"]), int(record["frames"])
    return lambda name: _belongs(name, outputs, frames)


def is_result(name: object) -> bool:
    """Tell whether this is the name of a result."""
    return isinstance(name, str) and (name in (*FILE_NAMES, RECORD) or _frame(name) is not None)


def _belongs(name: str, outputs: Collection[str], frames: int) -> bool:
    """Tell whether a result is one of a run with these outputs and this many frames."""
    frame = _frame(name)
    if frame is None:
        return name in outputs
    folder, number = frame
    return folder in outputs and number < series_length(folder, frames)


def _frame(name: str) -> tuple[str, int] | None:
    """Give the folder of a frame's file, and its number; None for another name."""
    found = re.fullmatch(r"([a-z]+)/([0-9]{4,15})\.[a-z]+", name)
    if not found or found[1] not in SERIES or name != f"{found[1]}/{series_file(found[1], int(found[2]))}":
        return None
    return found[1], int(found[2])


# The results of a run, and beside them the checkpoint from which it can go on.
RUN = Kind("run", RECORD, NEW_TREE, is_result, _listed, alone=False, beside={CHECKPOINT: CHECKPOINT_TREE})
