"""Arrays in .npz files: written piece by piece, and read without trusting what the file says of itself."""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
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
    header, info = _header(dtype, shape), _entry(archive, name, dtype, shape)
    # Checks the CRC-32.
    data = archive.read(info)
    if data[: len(header)] != header:
        raise ValueError(name)
    return np.frombuffer(data, dtype, offset=len(header)).reshape(shape)


def read_rows(archive: zipfile.ZipFile, name: str, dtype: DTypeLike, row: Shape) -> NDArray[Any]:
    """Read an array of any number of rows, each of a known shape; raises what `read_array` does."""
    header, size = len(_header(dtype, (0, *row))), math.prod(row) * np.dtype(dtype).itemsize
    rows = (archive.getinfo(f"{name}.npy").file_size - header) // size
    return read_array(archive, name, dtype, (max(0, rows), *row))


def map_array(path: Path, name: str, dtype: DTypeLike, shape: Shape) -> NDArray[Any]:
    """Map an array that `write_array` wrote, which may be larger than memory, once its checksum was found right.

    Args:
        path: of the archive.
        name: of the array.
        dtype: what its numbers must be.
        shape: what it must be, of at least one number.

    Returns:
        The array, read-only, which the system reads when it is looked at.

    Raises:
        ValueError: when it is another, or damaged.
        Exception: whatever `zipfile` raises for an archive that is damaged.
    """
    header = _header(dtype, shape)
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        info = _entry(archive, name, dtype, shape)
        # Before the data there are the entry's own header, its name and further fields, whose lengths are at its end.
        file.seek(info.header_offset + 26)
        file.seek(sum(struct.unpack("<HH", file.read(4))), 1)
        if file.read(len(header)) != header:
            raise ValueError(name)
        mapped = np.asarray(np.memmap(file, dtype, "r", file.tell(), shape))
    if zlib.crc32(mapped.data.cast("B"), zlib.crc32(header)) != info.CRC:
        raise ValueError(name)
    return mapped


def _entry(archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: Shape) -> zipfile.ZipInfo:
    """Find an array that is stored as it is and has the size that it must have; raises ValueError for any other."""
    info = archive.getinfo(f"{name}.npy")
    size = len(_header(dtype, shape)) + math.prod(shape) * np.dtype(dtype).itemsize
    # What is compressed may be of any size, whatever the archive says.
    if info.compress_type != zipfile.ZIP_STORED or (info.file_size, info.compress_size) != (size, size):
        raise ValueError(name)
    return info


def _header(dtype: DTypeLike, shape: Shape) -> bytes:
    header = io.BytesIO()
    descr = npy.dtype_to_descr(np.dtype(dtype))
    npy.write_array_header_1_0(header, {"descr": descr, "fortran_order": False, "shape": shape})
    return header.getvalue()
