"""Write a film as its frames come: H.264 in MP4, by PyAV, whose wheels have the encoder (`docs/decisions/0029`)."""

from __future__ import annotations

from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

NOT_INSTALLED = "mp4 needs PyAV, which is not installed; pip install av"

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
LONGEST = 1 << 16


def is_installed() -> bool:
    """Tell whether PyAV is installed."""
    return find_spec("av") is not None


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
        return 1 / Fraction(1 / rate).limit_denominator(LONGEST)
    return Fraction(rate).limit_denominator(LONGEST)
