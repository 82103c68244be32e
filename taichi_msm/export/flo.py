"""Reading optical flow as Middlebury's .flo has it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.results.finished_run import damaged, reading

MAGIC = b"PIEH"


def read_flo(path: Path, size: tuple[int, int]) -> NDArray[np.float32]:
    """Read a file of flow.

    Args:
        path: of the file.
        size: width, height that it must have [px].

    Returns:
        Flow to the right and down [px], shape (height, width, 2).

    Raises:
        FilesError: when it cannot be read, or is none of that size.
    """
    width, height = size
    header, length = struct.pack("<4sii", MAGIC, width, height), 8 * width * height
    with reading(path), path.open("rb") as file:
        # Another size in the file takes no more memory.
        found, data, rest = file.read(len(header)), file.read(length), file.read(1)
    if found != header or len(data) != length or rest:
        raise damaged(path)
    return np.frombuffer(data, "<f4").reshape(height, width, 2)
