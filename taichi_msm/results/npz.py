"""Arrays in .npz files: written piece by piece, and read without trusting what the file says of itself."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

# Zip files bear dates; this one, the earliest there is, makes equal arrays equal files.
EPOCH = (1980, 1, 1, 0, 0, 0)

Shape = tuple[int, ...]


def write_array(
    archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: Shape, parts: Iterable[bytes | memoryview]
) -> None:
    """Add an array to an archive.

    Args:
        archive: open for writing.
        name: of the array.
        dtype: of its numbers.
        shape: of the array.
        parts: its bytes in C order, in any number of pieces.
    """
    with archive.open(zipfile.ZipInfo(f"{name}.npy", EPOCH), "w", force_zip64=True) as entry:
        entry.write(_header(dtype, shape))
        for part in parts:
            entry.write(part)


def read_array(archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: Shape) -> NDArray[Any]:
    """Read an array that `write_array` wrote.

    Args:
        archive: open for reading.
        name: of the array.
        dtype: what its numbers must be.
        shape: what it must be.

    Raises:
        ValueError: when it is another, before any memory is taken for it.
        Exception: whatever `zipfile` raises for an archive that is damaged.
    """
    header, info = _header(dtype, shape), archive.getinfo(f"{name}.npy")
    size = len(header) + math.prod(shape) * np.dtype(dtype).itemsize
    # What is compressed may be of any size, whatever the archive says.
    if info.compress_type != zipfile.ZIP_STORED or (info.file_size, info.compress_size) != (size, size):
        raise ValueError(name)
    # Checks the CRC-32.
    data = archive.read(info)
    if data[: len(header)] != header:
        raise ValueError(name)
    return np.frombuffer(data, dtype, offset=len(header)).reshape(shape)


def _header(dtype: DTypeLike, shape: Shape) -> bytes:
    header = io.BytesIO()
    descr = npy.dtype_to_descr(np.dtype(dtype))
    npy.write_array_header_1_0(header, {"descr": descr, "fortran_order": False, "shape": shape})
    return header.getvalue()
