"""PNGs with 16 bits per channel.

The format is written here, in one page: Pillow has no such pictures in colour, pypng has had no release since 2022, and
OpenCV would be 60 MB to install for one call.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

SIGNATURE = b"\x89PNG\r\n\x1a\n"
DEPTH, RGB = 16, 2
# The filter that keeps the difference from the row above, byte by byte.
UP = 2

# Level 1 takes a tenth of the time of the default (17 against 169 ms for rough flow of 512 x 512 pixels) for 7 % more
# bytes.
COMPRESS_LEVEL = 1


def png16(picture: NDArray[np.uint16]) -> bytes:
    """Encode colours, shape (height, width, 3), as a PNG of 16 bits a channel.

    Source: the PNG specification of the W3C (third edition), sections 9 (filters) and 11 (chunks).
    """
    height, width, _ = picture.shape
    rows = picture.astype(">u2").view(np.uint8).reshape(height, -1)
    above = np.zeros_like(rows)
    above[1:] = rows[:-1]
    filtered = np.full((height, 1 + rows.shape[1]), UP, np.uint8)
    filtered[:, 1:] = rows - above
    header = struct.pack(">IIBBBBB", width, height, DEPTH, RGB, 0, 0, 0)
    data = zlib.compress(filtered.tobytes(), COMPRESS_LEVEL)
    return b"".join([SIGNATURE, *_chunk(b"IHDR", header), *_chunk(b"IDAT", data), *_chunk(b"IEND", b"")])


def _chunk(kind: bytes, data: bytes) -> Iterator[bytes]:
    yield struct.pack(">I", len(data))
    yield kind
    yield data
    yield struct.pack(">I", zlib.crc32(data, zlib.crc32(kind)))
