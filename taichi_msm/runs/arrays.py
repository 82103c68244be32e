"""Array files: NumPy's .npz archives and Middlebury's .flo format.

Archives are written in chunks, because a trajectory may exceed memory. Readers verify dtype and shape before they
allocate, because a header may be forged. A .flo file contains a magic number, width, height and two float32 per pixel,
all little-endian.
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

Shape = tuple[int, ...]


class ChunkedArray(NamedTuple):
    """Array that is written chunk by chunk, as it may exceed memory."""

    dtype: DTypeLike  # of all chunks
    shape: Shape  # of the whole array
    chunks: Iterable[NDArray[Any]]  # contiguous; together the array's elements in C order


def write_arrays(file: BinaryIO, arrays: Mapping[str, NDArray[Any] | ChunkedArray]) -> None:
    """Write arrays, by name, to an uncompressed .npz archive; equal arrays produce identical files."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            chunks = array.chunks if isinstance(array, ChunkedArray) else [np.ascontiguousarray(array)]
            # A fixed date, the earliest of the zip format, keeps equal files identical.
            info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            with archive.open(info, "w", force_zip64=True) as entry:
                entry.write(_npy_header(array.dtype, array.shape))
                for chunk in chunks:
                    entry.write(chunk.data)


def read_array(archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: Shape) -> NDArray[Any]:
    """Read an array of the expected dtype and shape, read-only, and verify its CRC-32.

    Another dtype or shape is a ValueError before memory is allocated; a damaged archive raises exceptions of many
    types.
    """
    header, info = _npy_header(dtype, shape), _find_entry(archive, name, dtype, shape)
    data = archive.read(info)
    if data[: len(header)] != header:
        raise ValueError(name)
    return np.frombuffer(data, dtype, offset=len(header)).reshape(shape)


def read_rows(archive: zipfile.ZipFile, name: str, dtype: DTypeLike, row_shape: Shape) -> NDArray[Any]:
    """Read an array with any number of rows, shape (rows, *row_shape), as `read_array` does."""
    header_bytes, row_bytes = len(_npy_header(dtype, (0, *row_shape))), math.prod(row_shape) * np.dtype(dtype).itemsize
    rows = (archive.getinfo(f"{name}.npy").file_size - header_bytes) // row_bytes
    return read_array(archive, name, dtype, (max(0, rows), *row_shape))


def map_array(path: Path, name: str, dtype: DTypeLike, shape: Shape) -> NDArray[Any]:
    """Map an array that is not empty into memory, read-only, and verify its CRC-32, with errors as `read_array`."""
    header = _npy_header(dtype, shape)
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        info = _find_entry(archive, name, dtype, shape)
        # The data follow the local header, the name and the extra field, whose lengths are bytes 26 to 29.
        file.seek(info.header_offset + 26)
        file.seek(sum(struct.unpack("<HH", file.read(4))), 1)
        if file.read(len(header)) != header:
            raise ValueError(name)
        mapped = np.asarray(np.memmap(file, dtype, "r", file.tell(), shape))
    if zlib.crc32(mapped.data.cast("B"), zlib.crc32(header)) != info.CRC:
        raise ValueError(name)
    return mapped


def _find_entry(archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: Shape) -> zipfile.ZipInfo:
    """Find the entry of an array; raise a ValueError if it is compressed or not of the expected size."""
    info = archive.getinfo(f"{name}.npy")
    size = len(_npy_header(dtype, shape)) + math.prod(shape) * np.dtype(dtype).itemsize
    # Compressed data could expand beyond the size in the header.
    if info.compress_type != zipfile.ZIP_STORED or (info.file_size, info.compress_size) != (size, size):
        raise ValueError(name)
    return info


def _npy_header(dtype: DTypeLike, shape: Shape) -> bytes:
    header = io.BytesIO()
    descr = npy.dtype_to_descr(np.dtype(dtype))
    npy.write_array_header_1_0(header, {"descr": descr, "fortran_order": False, "shape": shape})
    return header.getvalue()


def write_flo(file: BinaryIO, flow: NDArray[np.float32]) -> None:
    """Write optical flow, displacement to the right and down [px], shape (height, width, 2), as .flo."""
    height, width, _ = flow.shape
    file.write(_flo_header(width, height))
    file.write(np.ascontiguousarray(flow, "<f4").data)


def read_flo(path: Path, size: tuple[int, int]) -> NDArray[np.float32]:
    """Read the optical flow of a .flo file, as for `write_flo`; a ValueError unless it has this width and height."""
    width, height = size
    header, length = _flo_header(width, height), 8 * width * height
    with path.open("rb") as file:
        # One byte more than expected detects a longer file, without reading all of a forged one.
        start, data, excess = file.read(len(header)), file.read(length), file.read(1)
    if start != header or len(data) != length or excess:
        raise ValueError(f"{path}: not a flow of {width} x {height} pixels; run the scene again")
    return np.frombuffer(data, "<f4").reshape(height, width, 2)


def _flo_header(width: int, height: int) -> bytes:
    return struct.pack("<4sii", b"PIEH", width, height)
