"""A film of a session, encoded while the session runs; in the end it is whole or not there."""

from __future__ import annotations

import re
import secrets
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType

from taichi_msm.errors import FilesError, writing
from taichi_msm.progress import Pause
from taichi_msm.results.encoder import Encoder, Job
from taichi_msm.results.folder import FOLDER, INHERITS, Folder, Tree
from taichi_msm.results.gif import Picture
from taichi_msm.results.publication import ANIMATION

# A film is encoded in a hidden folder, which is locked until the film is closed.
HIDDEN, LOCK = r"\.film-[0-9a-f]{16}", "lock"
TREE: Tree = {LOCK: None, re.escape(ANIMATION): None}


class Film:
    """A GIF that a process of its own encodes in a hidden folder; on leaving, it is removed unless it was moved away.

    Args:
        folder: the folder in which the hidden one is made; made if it does not exist.
        size: width, height of the pictures [px].
        rate: pictures per second.
        background: a colour that is kept exactly.
        option: what the error says to choose another folder by.

    Raises:
        FilesError: here and in `add` and `encoded`, when it cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        size: tuple[int, int],
        rate: float,
        background: tuple[int, int, int],
        option: str = "--out",
    ) -> None:
        self.pictures = 0
        self._place = folder, option
        with writing(*self._place), ExitStack() as opened:
            near = opened.enter_context(Folder.at(folder, create=True))
            clear_abandoned(near)
            name = f".film-{secrets.token_hex(8)}"
            self._hidden = opened.enter_context(near.folder(name, create=True))
            opened.callback(_remove, near, name)
            lock = [opened.enter_context(self._hidden.lock(LOCK)).fileno()] if INHERITS else []
            job = Job(self._hidden, size, rate, png=False, gif=True, background=background)
            self._encoder = Encoder(job, inherit=tuple(lock))
            opened.callback(self._encoder.abort)
            self._open = opened.pop_all()

    def add(self, picture: Picture, pause: Pause = lambda: None) -> None:
        """Add the next picture, shape (height, width, 3); `pause` as for `Encoder.add`."""
        with writing(*self._place):
            self._encoder.add(picture, pause)
        self.pictures += 1

    def encoded(self, pause: Pause = lambda: None) -> Path:
        """Wait until the last picture is encoded; there must be one. Returns the file, which is to be moved away."""
        with writing(*self._place):
            self._encoder.finish(pause)
        return self._hidden.path / ANIMATION

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()


def clear_abandoned(folder: Folder) -> None:
    """Remove what films of killed processes have left."""
    if not INHERITS:
        return
    for name, kind in folder.entries():
        if kind == FOLDER and re.fullmatch(HIDDEN, name):
            # A film of another user, or one still being made, stays.
            with suppress(OSError, FilesError), folder.folder(name) as hidden:
                hidden.require_only(TREE)
                if hidden.kind(LOCK) is not None:
                    hidden.lock(LOCK).close()
                    _remove(folder, name)


def _remove(folder: Folder, name: str) -> None:
    """Remove a film's hidden folder, as far as possible."""
    with suppress(OSError, FilesError), folder.folder(name) as hidden:
        hidden.clear(TREE)
        folder.remove_folder(name)
