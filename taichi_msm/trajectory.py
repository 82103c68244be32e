"""Write the positions of every frame to an .npz file, which may be larger than memory."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike

# Zip files bear dates; this one, the earliest there is, makes equal trajectories equal files.
EPOCH = (1980, 1, 1, 0, 0, 0)


def write_trajectory(
    path: Path, positions: BinaryIO, frames: int, points: tuple[int, int], precision: DTypeLike, rate: float
) -> None:
    """Write time [s], shape (frames,), and position [m], shape (frames, rows, cols, 3).

    Args:
        path: the file to write, uncompressed.
        positions: the numbers of the positions, of as many frames or more.
        frames: how many frames.
        points: rows, cols.
        precision: type of the positions.
        rate: frames per second.
    """
    dtype = np.dtype(precision)
    shape = (frames, *points, 3)
    header = {"descr": npy.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    positions.seek(0)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        with archive.open(zipfile.ZipInfo("time.npy", EPOCH), "w") as entry:
            npy.write_array(entry, np.arange(frames) / rate)
        with archive.open(zipfile.ZipInfo("position.npy", EPOCH), "w", force_zip64=True) as entry:
            npy.write_array_header_1_0(entry, header)
            left = int(np.prod(shape)) * dtype.itemsize
            while left and (part := positions.read(min(left, 1 << 20))):
                entry.write(part)
                left -= len(part)
