"""Optical flow in Middlebury's .flo format: a magic number, width, height, two floats per pixel; little-endian."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

MAGIC = b"PIEH"


def write_flo(file: BinaryIO, flow: NDArray[np.float32]) -> None:
    """Write flow to the right and down [px], shape (height, width, 2)."""
    height, width, _ = flow.shape
    file.write(_header(width, height))
    file.write(np.ascontiguousarray(flow, "<f4").data)


def read_flo(path: Path, size: tuple[int, int]) -> NDArray[np.float32]:
    """Read flow as above; raises ValueError when the file has no flow of this width and height [px]."""
    width, height = size
    header, length = _header(width, height), 8 * width * height
    with path.open("rb") as file:
        # Only the expected size is read, so that a wrong one in the file takes no more memory.
        start, data, rest = file.read(len(header)), file.read(length), file.read(1)
    if start != header or len(data) != length or rest:
        raise ValueError(f"not a flow of {width} x {height} pixels")
    return np.frombuffer(data, "<f4").reshape(height, width, 2)


def _header(width: int, height: int) -> bytes:
    return struct.pack("<4sii", MAGIC, width, height)
