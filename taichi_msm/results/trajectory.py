"""Write the positions of all frames to an .npz file, which may be larger than memory."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from typing import BinaryIO

import numpy as np
from numpy.typing import DTypeLike

from taichi_msm.results.npz import write_array


def write_trajectory(
    file: BinaryIO,
    positions: Iterable[memoryview],
    frames: int,
    points: tuple[int, int],
    precision: DTypeLike,
    rate: float,
) -> None:
    """Write time [s], shape (frames,), and position [m], shape (frames, rows, cols, 3), uncompressed.

    Args:
        file: open for writing.
        positions: the bytes of the positions of each frame, in order.
        frames: number of frames.
        points: rows, cols.
        precision: type of the positions.
        rate: frames per second.
    """
    time = np.arange(frames) / rate
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        write_array(archive, "time", time.dtype, time.shape, [time.tobytes()])
        write_array(archive, "position", precision, (frames, *points, 3), positions)
