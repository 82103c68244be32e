"""Arrays in .npz files: written piece by piece, and read without trusting the file's own headers."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

# Zip files contain dates. A fixed one, the earliest possible, makes files of equal arrays equal.
EPOCH = (1980, 1, 1, 0, 0, 0)

Shape = tuple[int, ...]


def write_array(
    archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: Shape, parts: Iterable[bytes | memoryview]
) -> None:
    """Add an array to an archive.

    Args:
        archive: open for writing.
        name: of the array.
        dtype: of the numbers.
        shape: of the array.
        parts: the bytes of the array in C order, in any number of pieces.
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
        dtype: that the numbers must have.
        shape: that the array must have.

    Raises:
        ValueError: when dtype or shape differ; raised before memory is allocated for the array.
        Exception: whatever `zipfile` raises for a damaged archive.
    """
    header, info = _header(dtype, shape), archive.getinfo(f"{name}.npy")
    size = len(header) + math.prod(shape) * np.dtype(dtype).itemsize
    # Compressed data might expand to any size, whatever the archive says.
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
