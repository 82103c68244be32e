"""A file of arrays of one shape, one for each frame, that grows while a run does, and survives its death."""

from __future__ import annotations

import hashlib
import math
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DamagedError, ForeignError
from taichi_msm.results.whole import create

DIGEST_BYTES = 32


class Records:
    """The arrays, each with a SHA-256 that also depends on its number and on the run.

    Args:
        path: of the file.
        shape: of an array.
        dtype: of its numbers.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: Any) -> None:
        self._path, self._shape, self._dtype = path, shape, np.dtype(dtype)
        self._size = DIGEST_BYTES + math.prod(shape) * self._dtype.itemsize
        # The digest of the run's manifest, to which all parts of a checkpoint are tied.
        self._key = b""
        self._file: BinaryIO
        self._open = ExitStack()

    def begin(self, key: bytes) -> None:
        """Make the file of a new run."""
        # Unbuffered, so that what was written is not lost when the process is killed.
        self._key, self._file = key, self._open.enter_context(create(self._path, buffering=0))

    def reopen(self, key: bytes) -> None:
        """Open the file of an earlier run; FileNotFoundError: there is none."""
        self._key, self._file = key, self._open.enter_context(self._path.open("r+b", buffering=0))
        if os.fstat(self._file.fileno()).st_nlink > 1:
            raise ForeignError.at(self._path, "a file that has other names")

    def require(self, count: int) -> None:
        """Raise a DamagedError if the file has fewer arrays."""
        if os.fstat(self._file.fileno()).st_size < count * self._size:
            raise damaged(self._path)

    def add(self, number: int, values: NDArray[Any]) -> None:
        """Write the array of a number, over any that is there."""
        data = np.ascontiguousarray(values, self._dtype).reshape(-1).view(np.uint8).data
        self._file.seek(number * self._size)
        for rest in (memoryview(self._digest(number, data)), data):
            while rest:  # A write to an unbuffered file may take only some of the bytes.
                rest = rest[self._file.write(rest) :]

    def read(self, number: int) -> NDArray[Any]:
        """Read the array of a number; DamagedError: it is not what was written, or not finite."""
        record = np.empty(self._size, np.uint8)
        self._file.seek(number * self._size)
        rest = record.data
        while rest and (count := self._file.readinto(rest)):  # type: ignore[attr-defined]
            rest = rest[count:]
        data = record[DIGEST_BYTES:]
        values = data.view(self._dtype).reshape(self._shape)
        if rest or record[:DIGEST_BYTES].tobytes() != self._digest(number, data.data) or not np.isfinite(values).all():
            raise damaged(self._path)
        return values

    def close(self) -> None:
        """Close the file."""
        self._open.close()

    def _digest(self, number: int, data: memoryview) -> bytes:
        return digest(self._key, number.to_bytes(8, "little"), data)


def damaged(path: Path) -> DamagedError:
    """Make the error for a part of a checkpoint that is not what the run has written."""
    return DamagedError(f"{path} is damaged; run the scene again")


def digest(*parts: bytes | memoryview) -> bytes:
    """Compute the SHA-256 of some bytes."""
    found = hashlib.sha256()
    for part in parts:
        found.update(part)
    return found.digest()
