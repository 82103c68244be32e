"""Replace what a directory holds: whole or not at all.

New files are staged below the directory, so that every move is a rename within one file system. When all
are there, a marker with their names says so; then they are moved, and what is left of earlier results goes.
A process killed before the marker leaves the directory as it was; after it, the next publication completes
the moves first.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from taichi_msm.errors import FilesError

try:
    import fcntl
except ImportError:  # Windows, where one has to take care not to run twice into one directory
    fcntl = None  # type: ignore[assignment]

FRAMES = "frames"
ANIMATION = "animation.gif"
TRAJECTORY = "trajectory.npz"
RECORD = "run.json"

STAGING = ".partial"

# What makes a checkpoint one: a run's plan.
PLAN = "plan.json"


def checkpoint_in(directory: Path) -> Path:
    """Tell where an unfinished run into a directory keeps what it needs to go on."""
    return directory / STAGING / "checkpoint"


def is_unfinished(directory: Path) -> bool:
    """Tell whether there is a run into a directory to go on with."""
    try:
        return (checkpoint_in(directory) / PLAN).exists()
    except OSError:
        return False


def frame_name(number: int) -> str:
    """Name the picture of a frame."""
    return f"{FRAMES}/{number:04}.png"


def results(directory: Path) -> Iterator[str]:
    """List the files in a directory that runs write; all others belong to the user."""
    for path in (directory / FRAMES).glob("*.png"):
        if re.fullmatch(r"[0-9]{4,}", path.stem):
            yield f"{FRAMES}/{path.name}"
    for name in (ANIMATION, TRAJECTORY, RECORD):
        if (directory / name).is_file():
            yield name


class Publication:
    """New contents for a directory. Leaving the with statement without `publish` discards them.

    Args:
        directory: where the results go; made where it does not exist.

    Raises:
        FilesError: on entering, when another process publishes there.
        OSError: when the directory cannot be written.

    Attributes:
        staged: the directory to write the new files in, under their final names.
        checkpoint: where an unfinished run, this one or an earlier, keeps what it needs to go on.
        keep: whether it stays when the with statement is left.
    """

    def __init__(self, directory: Path) -> None:
        self.keep = True
        self.checkpoint = checkpoint_in(directory)
        self.staged = directory / STAGING / "new"
        self._directory = directory
        self._staging = directory / STAGING
        self._marker = directory / STAGING / "complete"
        self._lock_path = directory / STAGING / "lock"
        self._lock: BinaryIO | None = None
        self._created = False

    @property
    def lock_descriptors(self) -> tuple[int, ...]:
        """File descriptors that a child process inherits to keep the directory locked while it lives."""
        return () if self._lock is None else (self._lock.fileno(),)

    def publish(self) -> None:
        """Put the staged files in the place of earlier results."""
        draft = self._staging / "draft"
        draft.write_text("\n".join(sorted(results(self.staged))), encoding="utf-8")
        draft.replace(self._marker)
        self._complete()

    def __enter__(self) -> Publication:
        self._created = not self._directory.exists()
        try:
            self._acquire()
            self._complete()
            self._clear()
            self._check_frames()
            self.staged.mkdir()
        except OSError:
            self._release()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # What cannot be tidied now is tidied by the next publication; an error on its way out matters more.
        with suppress(OSError):
            self._complete()
            self._clear()
        self._release()

    def _check_frames(self) -> None:
        """Fail before the run rather than halfway through the moves."""
        frames = self._directory / FRAMES
        if frames.exists() and not (frames.is_dir() and os.access(frames, os.W_OK)):
            raise PermissionError(errno.EACCES, f"{FRAMES} is no directory that can be written")

    def _complete(self) -> None:
        """Move the staged files into place if the marker says that all are there; as often as it takes."""
        try:
            names = self._marker.read_text(encoding="utf-8").split("\n")
        except FileNotFoundError:
            return
        for name in names:
            if (self.staged / name).exists():
                (self._directory / name).parent.mkdir(exist_ok=True)
                (self.staged / name).replace(self._directory / name)
        for name in set(results(self._directory)).difference(names):
            (self._directory / name).unlink()
        with suppress(OSError):  # not empty
            (self._directory / FRAMES).rmdir()

    def _clear(self) -> None:
        """Empty the staging directory but for the lock and what is to be kept."""
        for path in self._staging.iterdir():
            if path == self.checkpoint and self.keep:
                continue
            if path.is_dir():
                # First of all, so that a part of a checkpoint is none.
                (path / PLAN).unlink(missing_ok=True)
                shutil.rmtree(path)
            elif path != self._lock_path:
                path.unlink()

    def _acquire(self) -> None:
        """Make the staging directory and lock it. The lock dies with the processes that hold it."""
        while True:
            self._staging.mkdir(parents=True, exist_ok=True)
            if fcntl is None:
                return
            # A run that ends just now may remove what we open, or have removed it when we have its lock.
            with suppress(FileNotFoundError), ExitStack() as opened:
                lock = opened.enter_context(self._lock_path.open("ab"))
                self._seize(lock)
                if os.path.samestat(os.fstat(lock.fileno()), self._lock_path.stat()):
                    opened.pop_all()
                    self._lock = lock
                    return

    def _seize(self, lock: BinaryIO) -> None:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            message = f"{self._directory}: another run is writing there; choose another --out"
            raise FilesError(message) from None
        except OSError:
            pass  # a file system without locks

    def _release(self) -> None:
        """Unlock, and remove the directories that are empty and ours."""
        with suppress(OSError):
            if self._lock is not None:
                self._lock_path.unlink()
            self._staging.rmdir()
            if self._created:
                self._directory.rmdir()
        if self._lock is not None:
            self._lock.close()
