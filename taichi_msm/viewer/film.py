"""A film of a session, encoded while the session runs; in the end it is whole or not there."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from taichi_msm.errors import writing
from taichi_msm.outputs.gif import Picture
from taichi_msm.outputs.table import OUTPUTS
from taichi_msm.progress import Pause
from taichi_msm.results.encoder import Encoder, Job
from taichi_msm.results.whole import staged


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
            self._hidden = opened.enter_context(staged(folder))
            self._encoder = Encoder(Job(self._hidden, size, rate, png=False, gif=True, background=background))
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
        return self._hidden / OUTPUTS["gif"].path()

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
