"""Write pictures as PNG, GIF and MP4."""

from __future__ import annotations

import os
import time
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event
from typing import NamedTuple

from PIL import Image

from taichi_msm.outputs.gif import GifWriter, Palette, Picture, shades
from taichi_msm.outputs.mp4 import Mp4Writer
from taichi_msm.outputs.table import OUTPUTS
from taichi_msm.progress import Pause
from taichi_msm.results.whole import create

# Of 512 x 512 pixels of shaded tissue Pillow's default takes 93 ms, its level 1 takes 17 ms and 348 kB. With a search
# for runs of equal bytes alone it takes 16 ms and 314 kB: tissue has no other repetitions, and a background has these.
COMPRESSION = {"compress_level": 1, "compress_type": zlib.Z_RLE}

# While a caller waits for pictures to be encoded, this is how long until its `pause` is called again [s].
PATIENCE = 0.1


class Job(NamedTuple):
    """What to encode: as `frames/0000.png` and so on, as `animation.gif`, as `animation.mp4`, or as several of them."""

    folders: tuple[Path, ...]  # where the files go; of several cameras, those of each
    size: tuple[int, int]  # width, height of the pictures [px]
    rate: float  # frames per second
    png: bool
    gif: bool
    background: tuple[int, int, int]  # a colour that the GIF keeps exactly
    mp4: bool = False
    quality: int = 65  # of the film [%]

    def stills(self, number: int) -> list[Path]:
        """Name the PNGs of a frame."""
        return [folder / OUTPUTS["png"].path(number) for folder in self.folders]


class Report(NamedTuple):
    """How many pictures were encoded completely, and the processor time that was spent [s]."""

    frames: int
    seconds: float


class PictureWriter:
    """Encodes pictures in threads of this process, where no KeyboardInterrupt leaves half a file.

    An OSError, in any method and at the latest in `finish`, says that a file cannot be written.

    Args:
        job: what to encode.
        waiting: how many pictures may wait while others are encoded; 0: `add` returns when its picture is encoded.
        hurry: when it is set, pictures are given up that are not being encoded yet, except the first.
    """

    def __init__(self, job: Job, waiting: int = 0, hurry: Event | None = None) -> None:
        self._job, self._waiting, self._hurry = job, waiting, hurry or Event()
        self._frames = self._begun = 0
        self._seconds = 0.0
        self._films: list[list[GifWriter | Mp4Writer]] = []
        self._files = ExitStack()
        self._pending: deque[Future[None]] = deque()
        self._stills = ThreadPoolExecutor(max(1, min(waiting, os.cpu_count() or 1)))
        self._reel = ThreadPoolExecutor(1)

    def add(self, pictures: Picture, pause: Pause = lambda: None) -> None:
        """Encode the pictures of the next frame, which must not change; arguments as for `Encoder.add`."""
        number = self._begun
        self._begun += 1
        paths = self._job.stills(number) if self._job.png else []
        for path in paths if number == 0 else ():
            path.parent.mkdir()
        stills = [self._stills.submit(self._shoot, *each, number) for each in zip(pictures, paths, strict=False)]
        self._pending.append(self._reel.submit(self._complete, pictures, number, stills))
        while len(self._pending) > self._waiting and not self._hurry.is_set():
            with suppress(CancelledError):
                _await(self._pending[0], pause)
            self._pending.popleft()

    def finish(self, pause: Pause = lambda: None, *, hurry: bool = False) -> Report:
        """Wait until all pictures are encoded; arguments as for `Encoder.finish`."""
        if hurry:
            self._hurry.set()
        with suppress(CancelledError):  # and so are those after it
            for task in self._pending:
                _await(task, pause)
        self._stills.shutdown()
        _await(self._reel.submit(self._close), pause)
        for number in range(self._frames, self._begun) if self._job.png else ():
            for path in self._job.stills(number):
                path.unlink(missing_ok=True)
        return Report(self._frames, self._seconds)

    def abort(self) -> None:
        """End the threads, and close the files as they are."""
        self._hurry.set()
        self._stills.shutdown()
        self._reel.shutdown()
        with suppress(OSError):
            self._files.close()

    def _shoot(self, picture: Picture, path: Path, number: int) -> float:
        """Write a PNG; returns the processor time [s]."""
        self._give_up_in_a_hurry(number)
        return _seconds(_write_png, picture, path)

    def _complete(self, pictures: Picture, number: int, stills: Sequence[Future[float]]) -> None:
        """Complete a frame: first its stills, then its place in the films, which so have no frame without a still."""
        self._give_up_in_a_hurry(number)
        spent = sum(still.result() for still in stills)
        self._seconds += spent + _seconds(self._film, pictures)
        self._frames += 1

    def _give_up_in_a_hurry(self, number: int) -> None:
        """Raise CancelledError in a hurry, but for the first frame: a run that was interrupted early keeps one."""
        if self._hurry.is_set() and number > 0:
            raise CancelledError

    def _film(self, pictures: Picture) -> None:
        if self._frames == 0:
            self._films = [self._begin(*each) for each in zip(self._job.folders, pictures, strict=True)]
        for films, picture in zip(self._films, pictures, strict=True):
            for film in films:
                film.add(picture)

    def _begin(self, folder: Path, picture: Picture) -> list[GifWriter | Mp4Writer]:
        """Begin the films of a camera, whose first picture shows the colours that the animation needs."""
        job = self._job
        films: list[GifWriter | Mp4Writer] = []
        if job.gif:
            file = self._files.enter_context(create(folder / OUTPUTS["gif"].path()))
            films.append(GifWriter(file, job.size, job.rate, Palette(shades(picture), job.background)))
        if job.mp4:
            file = self._files.enter_context(create(folder / OUTPUTS["mp4"].path()))
            films.append(Mp4Writer(file, job.size, job.rate, job.quality))
        return films

    def _close(self) -> None:
        """Complete the films, once."""
        while self._films:
            for film in self._films.pop():
                self._seconds += _seconds(film.close)


def _await(task: Future[None], pause: Pause) -> None:
    """Wait for a task, and raise its error."""
    while not wait([task], PATIENCE).done:
        pause()
    task.result()


def _write_png(picture: Picture, path: Path) -> None:
    with create(path) as file:
        Image.fromarray(picture).save(file, "PNG", **COMPRESSION)


def _seconds(work: Callable[..., None], *args: object) -> float:
    """Do some work; returns its processor time [s], which does not grow while the simulation occupies the cores."""
    start = time.thread_time()
    work(*args)
    return time.thread_time() - start
