"""Write an animated GIF as its frames come, with one palette for all, and exact to 10 ms at every frame rate.

Pillow's own writer keeps all frames in memory until the last one is known; here at most two wait. Given RGB pictures,
Pillow also makes a palette for each, which takes 24 times longer. Measured with 512 x 512 pixels of shaded tissue: 4 ms
and 89 kB a frame. Floyd-Steinberg dithering would take 7 ms and 115 kB, and flicker.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Picture = NDArray[np.uint8]

# The limits of a delay [1/100 s]: it is a whole number of 16 bits, and browsers play 0 and 1 as 10.
SHORTEST = 2
LONGEST = 0xFFFF

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
        repetitions = math.ceil((until - start) / LONGEST)
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
