"""Write an animated GIF as its frames come, with one palette for all, and exact to 10 ms at every frame rate.

Pillow's own writer keeps all frames in memory until the last one is known; here at most two wait. Given RGB pictures,
Pillow also makes a palette for each, which takes 24 times longer. Measured with 512 x 512 pixels of shaded tissue: 4 ms
and 89 kB a frame. Floyd-Steinberg dithering would take 7 ms and 115 kB, and flicker.

Write a film as its frames come: H.264 in MP4, by PyAV, whose wheels have the encoder (`docs/decisions/0029`).

Write pictures as PNG, GIF and MP4.
"""

from __future__ import annotations

import math
import os
import struct
import time
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from fractions import Fraction
from pathlib import Path
from threading import Event
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import Pause
from taichi_msm.runs.directory import create
from taichi_msm.scene.outputs import OUTPUTS

Picture = NDArray[np.uint8]

# The limits of a delay [1/100 s]: it is a whole number of 16 bits, and browsers play 0 and 1 as 10.
SHORTEST = 2
MAX_GIF_DELAY = 0xFFFF

# The last of the 256 indices is not a colour but transparent: it lets the frame before show through.
COLOURS = 255
TRANSPARENT = COLOURS

# The palette is chosen from this many pixels of the first frame along each axis, at these levels of light: the first
# frame shows the sheet at rest, whose parts later turn toward the headlight and away from it. Most parts do not turn.
SAMPLES = 48
LIGHT = (1.0, 1.0, 1.0, 1.0, 1.15, 1.3, 0.8, 0.6, 0.35, 0.15)

# Pillow's lookup gives each cell of 4 x 4 x 4 colours the palette entry nearest to the cell's darkest corner. Looking
# up entries that were made half a cell darker gives the entry nearest to the cell's middle: the error falls by 0.8 dB.
HALF_CELL = 2


def shades(picture: Picture) -> Picture:
    """Predict the colours of an animation, shape (height, width, 3), from its first frame, likewise."""
    stride = -(-max(picture.shape) // SAMPLES)
    samples = picture[::stride, ::stride].astype(np.float32)
    return np.concatenate([np.clip(samples * light, 0, 255) for light in LIGHT]).astype(np.uint8)


class Palette:
    """The colours that all frames share.

    They are chosen for samples, shape (height, width, 3), like the frames to come; the background is kept exactly.
    """

    def __init__(self, samples: Picture, background: tuple[int, int, int]) -> None:
        # Median cut alone, Pillow's default, loses rare hues: it makes the purple vessels of the shipped scenes brown.
        method = Image.Quantize.MAXCOVERAGE
        reduced = Image.fromarray(samples).quantize(COLOURS - 1, method=method, kmeans=1).getpalette() or []
        colours = np.array([*background, *reduced], np.uint8).reshape(-1, 3)
        self.table: Picture = np.concatenate([colours, np.zeros((COLOURS + 1 - len(colours), 3), np.uint8)])
        self._background = background
        self._lookup = Image.new("P", (1, 1))
        self._lookup.putpalette((np.maximum(colours, HALF_CELL) - HALF_CELL).tobytes())

    def indices(self, picture: Picture) -> Picture:
        """Find the nearest colour of every pixel: rows of `table`, shape (height, width)."""
        image = Image.fromarray(picture)
        indices = np.array(image.quantize(palette=self._lookup, dither=Image.Dither.NONE))
        red, green, blue = self._background
        indices[(picture[..., 0] == red) & (picture[..., 1] == green) & (picture[..., 2] == blue)] = 0
        return indices


class _Shown(NamedTuple):
    """A frame on its way to the file: when it appears [1/100 s], and its pixels."""

    start: int
    indices: Picture


class GifWriter:
    """An animation that loops for ever; frame f lasts from f / rate to (f + 1) / rate, in whole 1/100 s.

    A frame that would be shown for less than 2/100 s is left out, except the last one, for which the one before is
    shortened. A frame equal to the one before is left out too, and the one before lasts longer. The size is width and
    height [px]; `close` closes the file.
    """

    def __init__(self, file: BinaryIO, size: tuple[int, int], rate: float, palette: Palette) -> None:
        self._rate = rate
        self._palette = palette
        self._frames = 0
        self._latest: Picture | None = None
        # At most two: the second may turn out to be the last and too short, and then the first is shortened.
        self._waiting: deque[_Shown] = deque()
        self._screen: Picture | None = None
        self._file = file
        self._file.write(b"GIF89a" + struct.pack("<HHBBB", *size, 0xF7, 0, 0) + palette.table.tobytes())
        self._file.write(b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00")

    def add(self, picture: Picture) -> None:
        """Add the next frame, shape (height, width, 3)."""
        start = self._hundredths(self._frames)
        self._frames += 1
        self._latest = picture
        waiting = self._waiting
        if waiting and start - waiting[-1].start < SHORTEST:
            return
        indices = self._palette.indices(picture)
        if waiting and np.array_equal(indices, waiting[-1].indices):
            return
        waiting.append(_Shown(start, indices))
        if len(waiting) > 2:
            self._write_first(until=waiting[1].start)

    def close(self) -> None:
        """Write the frames that wait and close the file."""
        with self._file:
            if self._latest is not None:
                self._write_last(self._palette.indices(self._latest))
            self._file.write(b";")

    def _hundredths(self, frame: int) -> int:
        return round(100 * frame / self._rate)

    def _write_last(self, indices: Picture) -> None:
        """Write the frames that wait; the last one shows the last state of the animation."""
        first, last = self._waiting[0], self._waiting.pop()
        end = self._hundredths(self._frames)
        start = min(last.start, end - SHORTEST)
        if start - first.start < SHORTEST:
            self._waiting.clear()
            start = first.start
        else:
            self._write_first(until=start)
        self._waiting.append(_Shown(start, indices))
        self._write_first(until=max(end, start + 1))

    def _write_first(self, until: int) -> None:
        """Write the frame that has waited longest; a delay too long for one frame is divided among repetitions."""
        start, indices = self._waiting.popleft()
        repetitions = math.ceil((until - start) / MAX_GIF_DELAY)
        for n in range(repetitions):
            delay = (until - start) * (n + 1) // repetitions - (until - start) * n // repetitions
            self._write(indices, delay)

    def _write(self, indices: Picture, delay: int) -> None:
        """Write the rectangle of the pixels that change, for a delay [1/100 s]."""
        left, top, patch = 0, 0, indices
        if self._screen is not None:
            changed = indices != self._screen
            rows, cols = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
            # If nothing changes, one pixel is written as it is.
            left, top, right, bottom = (cols[0], rows[0], cols[-1], rows[-1]) if rows.size else (0, 0, 0, 0)
            patch = np.where(changed, indices, np.uint8(TRANSPARENT))[top : bottom + 1, left : right + 1]
        self._screen = indices
        height, width = patch.shape
        keep_and_transparent = 0b101
        self._file.write(b"\x21\xf9\x04" + struct.pack("<BHBB", keep_and_transparent, delay, TRANSPARENT, 0))
        self._file.write(b"\x2c" + struct.pack("<HHHHB", left, top, width, height, 0))
        # Pillow's LZW encoder: rows of bytes, 8 bits a pixel, not interlaced.
        self._file.write(b"\x08" + Image.fromarray(patch).tobytes("gif", "L", 8, 0) + b"\x00")


# This preset is twice as fast as the default for no more bytes, and looks 10 frames ahead, not 40, which all wait in
# memory. With one thread the bytes are the same for any number of cores.
OPTIONS = {"preset": "veryfast", "threads": "1"}

# The rate factor of H.264 at a quality of 0 %; at 100 % it is 1, as 0 would need a profile that browsers do not play.
LARGEST_RATE_FACTOR = 51

# The index comes before the pictures, so that a browser shows a film while it loads.
CONTAINER = {"movflags": "faststart"}

# The colours of HDTV, named in the file, because players choose by the size of the picture where nothing is named.
BT709, LIMITED = 1, 1

# The largest denominator of a frame rate or of its inverse; ticks of MP4 have 32 bits.
MAX_RATE_DENOMINATOR = 1 << 16


class Mp4Writer:
    """A film; frame f lasts from f / rate to (f + 1) / rate.

    An odd last row or column is repeated, as H.264 takes colours of 2 x 2 pixels together.

    Args:
        file: where it is written; it has a name and is seekable, and `close` closes it.
        size: width and height [px].
        rate: frames per second.
        quality: 1 to 100 [%].
    """

    def __init__(self, file: BinaryIO, size: tuple[int, int], rate: float, quality: int) -> None:
        import av

        self._file, self._frame = file, av.VideoFrame
        self._odd = [(0, side % 2) for side in reversed(size)]
        # To move the pictures behind the index, they are read again, by another file than is written to.
        self._container = av.open(file, "w", format="mp4", options=CONTAINER, io_open=self._reopen)
        factor = max(1, round(LARGEST_RATE_FACTOR * (1 - quality / 100)))
        self._stream: Any = self._container.add_stream("libx264", _ratio(rate), options={"crf": str(factor), **OPTIONS})
        self._stream.width, self._stream.height = (side + side % 2 for side in size)
        self._stream.pix_fmt = "yuv420p"
        code = self._stream.codec_context
        code.colorspace = code.color_primaries = code.color_trc = BT709
        code.color_range = LIMITED

    def _reopen(self, *_: object) -> BinaryIO:
        return Path(self._file.name).open("rb")

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add the next frame, shape (height, width, 3)."""
        even = np.pad(picture, (*self._odd, (0, 0)), mode="edge")
        frame = self._frame.from_ndarray(even, format="rgb24")
        coded = frame.reformat(format="yuv420p", dst_colorspace=BT709, dst_color_range=LIMITED)
        self._container.mux(self._stream.encode(coded))

    def close(self) -> None:
        """Write the frames that wait and close the file."""
        with self._file, self._container:
            self._container.mux(self._stream.encode(None))


def _ratio(rate: float) -> Fraction:
    """Give frames per second as a ratio of small numbers, exact for rates such as 25, 30000 / 1001 and 0.1."""
    if rate < 1:
        return 1 / Fraction(1 / rate).limit_denominator(MAX_RATE_DENOMINATOR)
    return Fraction(rate).limit_denominator(MAX_RATE_DENOMINATOR)


pass  # REMOVED
pass  # REMOVED

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
