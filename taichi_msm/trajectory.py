"""Write the positions of every frame to an .npz file, one frame at a time."""

from __future__ import annotations

import shutil
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

# Zip files bear dates; this one, the earliest there is, makes equal trajectories equal files.
EPOCH = (1980, 1, 1, 0, 0, 0)


class TrajectoryWriter:
    """A growing trajectory. The file's header tells the number of frames, so the file is written at the end.

    Args:
        path: the .npz file to write, uncompressed; the positions wait beside it.
        points: rows, cols.
        precision: type of the positions.
        rate: frames per second.
    """

    def __init__(self, path: Path, points: tuple[int, int], precision: DTypeLike, rate: float) -> None:
        self._path = path
        self._frame = (*points, 3)
        self._precision = np.dtype(precision)
        self._rate = rate
        self._positions = path.with_suffix(".positions").open("w+b")

    def add(self, position: NDArray[Any]) -> None:
        """Add the next frame: positions [m], shape (rows, cols, 3)."""
        self._positions.write(np.ascontiguousarray(position, self._precision).data)

    def finish(self, frames: int) -> None:
        """Write the file.

        Args:
            frames: how many of the frames added it holds: time [s], shape (frames,), and position [m], shape
                (frames, rows, cols, 3).
        """
        header = {
            "descr": npy.dtype_to_descr(self._precision),
            "fortran_order": False,
            "shape": (frames, *self._frame),
        }
        self._positions.truncate(frames * int(np.prod(self._frame)) * self._precision.itemsize)
        self._positions.seek(0)
        with zipfile.ZipFile(self._path, "w", zipfile.ZIP_STORED) as archive:
            with archive.open(zipfile.ZipInfo("time.npy", EPOCH), "w") as entry:
                npy.write_array(entry, np.arange(frames) / self._rate)
            with archive.open(zipfile.ZipInfo("position.npy", EPOCH), "w", force_zip64=True) as entry:
                npy.write_array_header_1_0(entry, header)
                shutil.copyfileobj(self._positions, entry, 1 << 20)
        self.close()

    def close(self) -> None:
        """Remove the positions that wait."""
        with suppress(OSError):  # a full disk may hold back the rest, which nobody wants any more
            self._positions.close()
        Path(self._positions.name).unlink(missing_ok=True)
