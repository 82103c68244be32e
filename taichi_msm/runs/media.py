"""Streaming writers of animated GIF and MP4.

GIF: all frames share a palette, and their times are exact to 10 ms at any frame rate. At most two frames are queued.
Pillow's writer keeps all frames in memory, and computes a palette for each one, which takes 24 times longer. A frame of
512 x 512 pixels of shaded tissue takes 4 ms and 89 kB; with Floyd-Steinberg dithering, 7 ms and 115 kB, with flicker.

MP4: H.264, encoded by PyAV, whose wheels include the encoder (`docs/decisions/0029`).
"""

from __future__ import annotations

import math
import struct
from collections import deque
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Picture = NDArray[np.uint8]  # colours, shape (height, width, 3), or palette indices, shape (height, width)

# Limits of a frame's duration [1/100 s]: browsers replace 0 and 1 by 10, and the field has 16 bits.
MIN_GIF_DELAY = 2
MAX_GIF_DELAY = 0xFFFF

# Number of colours of a palette; the last of the 256 indices is transparent, and keeps the pixel of the previous frame.
PALETTE_SIZE = 255
TRANSPARENT_INDEX = PALETTE_SIZE


def predict_colours(picture: Picture) -> Picture:
    """Predict typical colours of an animation, shape (n, m, 3), from its first frame, shape (height, width, 3)."""
    # Pixels of a coarse grid, at most 48 per axis, at several brightnesses: later, parts of the sheet turn toward the
    # headlight or away.
    stride = -(-max(picture.shape) // 48)
    samples = picture[::stride, ::stride].astype(np.float32)
    brightnesses = (1.0, 1.0, 1.0, 1.0, 1.15, 1.3, 0.8, 0.6, 0.35, 0.15)
    return np.concatenate([np.clip(samples * factor, 0, 255) for factor in brightnesses]).astype(np.uint8)


class Palette:
    """Colour palette of an animation: exactly the background, and typical colours, from samples of shape (n, m, 3)."""

    def __init__(self, samples: Picture, background: tuple[int, int, int]) -> None:
        # Pillow's default, median cut, loses rare hues: the purple vessels of the shipped scenes become brown.
        method = Image.Quantize.MAXCOVERAGE
        reduced = Image.fromarray(samples).quantize(PALETTE_SIZE - 1, method=method, kmeans=1).getpalette() or []
        colours = np.array([*background, *reduced], np.uint8).reshape(-1, 3)
        # The colours, shape (256, 3); unused entries are black.
        self.table: Picture = np.concatenate([colours, np.zeros((PALETTE_SIZE + 1 - len(colours), 3), np.uint8)])
        self._background = background
        self._lookup = Image.new("P", (1, 1))
        # Pillow maps each cell of 4 x 4 x 4 colours to the palette entry nearest to the cell's darkest corner. With a
        # palette darker by half a cell, it is the entry nearest to the cell's centre: 0.8 dB less error.
        self._lookup.putpalette((np.maximum(colours, 2) - 2).tobytes())

    def indices(self, picture: Picture) -> Picture:
        """Return the palette index of every pixel, shape (height, width), of a picture, shape (height, width, 3)."""
        image = Image.fromarray(picture)
        indices = np.array(image.quantize(palette=self._lookup, dither=Image.Dither.NONE))
        red, green, blue = self._background
        indices[(picture[..., 0] == red) & (picture[..., 1] == green) & (picture[..., 2] == blue)] = 0
        return indices


class GifWriter:
    """Writer of an endlessly looping GIF. Frame f lasts from f / rate to (f + 1) / rate, rounded to 1/100 s.

    Frames shorter than 2/100 s are dropped, except for the last one, which shortens its predecessor. Equal consecutive
    frames are merged. The size is width and height [px].
    """

    def __init__(self, file: BinaryIO, size: tuple[int, int], rate: float, palette: Palette) -> None:
        self._rate = rate
        self._palette = palette
        self._frames = 0
        self._latest: Picture | None = None
        # Start time [1/100 s] and palette indices of two frames, because a short last frame shortens its predecessor.
        self._queue: deque[tuple[int, Picture]] = deque()
        self._screen: Picture | None = None
        self._file = file
        self._file.write(b"GIF89a" + struct.pack("<HHBBB", *size, 0xF7, 0, 0) + palette.table.tobytes())
        self._file.write(b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00")

    def add(self, picture: Picture) -> None:
        """Add the next frame, shape (height, width, 3)."""
        start = self._centiseconds(self._frames)
        self._frames += 1
        self._latest = picture
        queue = self._queue
        if queue and start - queue[-1][0] < MIN_GIF_DELAY:
            return
        indices = self._palette.indices(picture)
        if queue and np.array_equal(indices, queue[-1][1]):
            return
        queue.append((start, indices))
        if len(queue) > 2:
            self._write_first(until=queue[1][0])

    def close(self) -> None:
        """Write the queued frames and close the file."""
        with self._file:
            if self._latest is not None:
                self._write_last(self._palette.indices(self._latest))
            self._file.write(b";")

    def _centiseconds(self, frame: int) -> int:
        return round(100 * frame / self._rate)

    def _write_last(self, indices: Picture) -> None:
        """Write the queued frames, with the latest frame in place of the last one."""
        first, last = self._queue[0][0], self._queue.pop()[0]
        end = self._centiseconds(self._frames)
        start = min(last, end - MIN_GIF_DELAY)
        if start - first < MIN_GIF_DELAY:
            # The frame before would be too short, or does not exist.
            self._queue.clear()
            start = first
        else:
            self._write_first(until=start)
        self._queue.append((start, indices))
        self._write_first(until=max(end, start + 1))

    def _write_first(self, until: int) -> None:
        """Write the oldest queued frame; repeat it if its delay exceeds the maximum."""
        start, indices = self._queue.popleft()
        repetitions = math.ceil((until - start) / MAX_GIF_DELAY)
        for n in range(repetitions):
            delay = (until - start) * (n + 1) // repetitions - (until - start) * n // repetitions
            self._write(indices, delay)

    def _write(self, indices: Picture, delay: int) -> None:
        """Write the bounding box of the changed pixels with a delay [1/100 s]."""
        left, top, patch = 0, 0, indices
        if self._screen is not None:
            changed = indices != self._screen
            rows, cols = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
            # Without a change, one pixel is written.
            left, top, right, bottom = (cols[0], rows[0], cols[-1], rows[-1]) if rows.size else (0, 0, 0, 0)
            patch = np.where(changed, indices, np.uint8(TRANSPARENT_INDEX))[top : bottom + 1, left : right + 1]
        self._screen = indices
        height, width = patch.shape
        keep_and_transparent = 0b101
        self._file.write(b"\x21\xf9\x04" + struct.pack("<BHBB", keep_and_transparent, delay, TRANSPARENT_INDEX, 0))
        self._file.write(b"\x2c" + struct.pack("<HHHHB", left, top, width, height, 0))
        # Pillow's LZW encoder: 8 bits per pixel, not interlaced.
        self._file.write(b"\x08" + Image.fromarray(patch).tobytes("gif", "L", 8, 0) + b"\x00")


# Colour space and range of HDTV. Without them in the file, players choose others by the size of the picture.
BT709, LIMITED_RANGE = 1, 1

# Largest denominator of a frame rate or of its inverse; the time base of MP4 has 32 bits.
MAX_RATE_DENOMINATOR = 1 << 16


class Mp4Writer:
    """Writer of an MP4. Frame f lasts from f / rate to (f + 1) / rate.

    An odd number of rows or columns is padded by repeating the last one, because H.264 subsamples colours by 2 x 2. The
    file must be seekable and have a name; the size is width and height [px], the quality 1 to 100 [%].
    """

    def __init__(self, file: BinaryIO, size: tuple[int, int], rate: float, quality: int) -> None:
        import av

        self._file, self._frame_class = file, av.VideoFrame
        self._padding = [(0, side % 2) for side in reversed(size)]
        # With faststart, the index precedes the pictures, so that browsers play the video while it loads. PyAV opens
        # the file a second time to move the pictures.
        options = {"movflags": "faststart"}
        self._container = av.open(file, "w", format="mp4", options=options, io_open=self._reopen)
        # The constant rate factor is 51 at 0 % and 1 at 100 %; 0 requires a profile that browsers do not play. This
        # preset is twice as fast as the default at the same file size, and keeps 10 frames in memory instead of 40.
        # With one thread the file does not depend on the number of cores.
        factor = max(1, round(51 * (1 - quality / 100)))
        self._stream: Any = self._container.add_stream(
            "libx264",
            _rate_fraction(rate),
            options={"crf": str(factor), "preset": "veryfast", "threads": "1"},
        )
        self._stream.width, self._stream.height = (side + side % 2 for side in size)
        self._stream.pix_fmt = "yuv420p"
        codec = self._stream.codec_context
        codec.colorspace = codec.color_primaries = codec.color_trc = BT709
        codec.color_range = LIMITED_RANGE

    def _reopen(self, *_: object) -> BinaryIO:
        return Path(self._file.name).open("rb")

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add the next frame, shape (height, width, 3)."""
        even = np.pad(picture, (*self._padding, (0, 0)), mode="edge")
        frame = self._frame_class.from_ndarray(even, format="rgb24")
        coded = frame.reformat(format="yuv420p", dst_colorspace=BT709, dst_color_range=LIMITED_RANGE)
        self._container.mux(self._stream.encode(coded))

    def close(self) -> None:
        """Write the queued frames and close the file."""
        with self._file, self._container:
            self._container.mux(self._stream.encode(None))


def _rate_fraction(rate: float) -> Fraction:
    """Convert frames per second to a fraction, exact for rates such as 25, 30000 / 1001 and 0.1."""
    if rate < 1:
        return 1 / Fraction(1 / rate).limit_denominator(MAX_RATE_DENOMINATOR)
    return Fraction(rate).limit_denominator(MAX_RATE_DENOMINATOR)
