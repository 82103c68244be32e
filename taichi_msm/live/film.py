"""A film of a session, encoded beside it, that is whole or not there."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import TracebackType

from taichi_msm.encoding import Encoder, Job
from taichi_msm.errors import writing
from taichi_msm.gif import Picture
from taichi_msm.publication import ANIMATION


class Film:
    """A GIF that is encoded in a process of its own, out of sight; gone when it is left, if nobody took it.

    Args:
        folder: near which it is encoded; made where it does not exist.
        size: width, height of the pictures [px].
        rate: pictures per second.
        background: a colour that is kept exactly.
        option: where another folder is chosen.

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
        with writing(*self._place):
            folder.mkdir(parents=True, exist_ok=True)
            self._hidden = Path(tempfile.mkdtemp(prefix=".film-", dir=folder))
            try:
                self._encoder = Encoder(Job(self._hidden, size, rate, png=False, gif=True, background=background))
            except OSError:
                shutil.rmtree(self._hidden, ignore_errors=True)
                raise

    def add(self, picture: Picture) -> None:
        """Add the next picture, shape (height, width, 3)."""
        with writing(*self._place):
            self._encoder.add(picture)
        self.pictures += 1

    def encoded(self) -> Path:
        """Wait for the last picture; returns the file, which is to be moved to its place. There must be a picture."""
        with writing(*self._place):
            self._encoder.finish()
        return self._hidden / ANIMATION

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._encoder.abort()
        shutil.rmtree(self._hidden, ignore_errors=True)
