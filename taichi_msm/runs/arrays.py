"""Arrays in .npz files: written piece by piece, and read without trusting the file's own headers.

Optical flow in Middlebury's .flo format: a magic number, width, height, two floats per pixel; little-endian.
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

# Zip files contain dates. A fixed one, the earliest possible, makes files of equal arrays equal.
EPOCH = (1980, 1, 1, 0, 0, 0)

Shape = tuple[int, ...]


class Pieces(NamedTuple):
    """An array that need not be in memory as a whole."""

    dtype: DTypeLike
    shape: Shape
    parts: Iterable[NDArray[Any]]  # its numbers in C order, in any number of pieces


def write_arrays(file: BinaryIO, arrays: Mapping[str, NDArray[Any] | Pieces]) -> None:
    """Write arrays to an uncompressed archive, by name; equal arrays give equal files."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            pieces = array if isinstance(array, Pieces) else Pieces(array.dtype, array.shape, _parts(array))
            with archive.open(zipfile.ZipInfo(f"{name}.npy", EPOCH), "w", force_zip64=True) as entry:
                entry.write(_header(pieces.dtype, pieces.shape))
                for part in pieces.parts:
                    entry.write(part.data)


def _parts(array: NDArray[Any]) -> Iterable[NDArray[Any]]:
    """Give an array without a second copy of all of it."""
    return [array] if array.flags.c_contiguous else (np.ascontiguousarray(row) for row in array)


def read_array(archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: Shape) -> NDArray[Any]:
    """Read an array that `write_arrays` wrote; raises ValueError before memory is allocated if dtype or shape differ.

    Of a damaged archive it raises whatever `zipfile` does.
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
    """Map an array that `write_arrays` wrote, after its checksum was verified.

    It may be larger than memory, but not empty. It is read-only, and the system reads it when it is accessed. Raises
    what `read_array` does.
    """
    header = _header(dtype, shape)
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        info = _entry(archive, name, dtype, shape)
        # The data follow the entry's header, its name and its extra field; the header ends with the lengths of both.
        file.seek(info.header_offset + 26)
        file.seek(sum(struct.unpack("<HH", file.read(4))), 1)
        if file.read(len(header)) != header:
            raise ValueError(name)
        mapped = np.asarray(np.memmap(file, dtype, "r", file.tell(), shape))
    if zlib.crc32(mapped.data.cast("B"), zlib.crc32(header)) != info.CRC:
        raise ValueError(name)
    return mapped


def _entry(archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: Shape) -> zipfile.ZipInfo:
    """Find an array that is stored uncompressed and has the expected size; raises ValueError if it does not."""
    info = archive.getinfo(f"{name}.npy")
    size = len(_header(dtype, shape)) + math.prod(shape) * np.dtype(dtype).itemsize
    # Compressed data might expand to any size, whatever the archive says.
    if info.compress_type != zipfile.ZIP_STORED or (info.file_size, info.compress_size) != (size, size):
        raise ValueError(name)
    return info


def _header(dtype: DTypeLike, shape: Shape) -> bytes:
    header = io.BytesIO()
    descr = npy.dtype_to_descr(np.dtype(dtype))
    npy.write_array_header_1_0(header, {"descr": descr, "fortran_order": False, "shape": shape})
    return header.getvalue()


MAGIC = b"PIEH"


def write_flo(file: BinaryIO, flow: NDArray[np.float32]) -> None:
    """Write flow to the right and down [px], shape (height, width, 2)."""
    height, width, _ = flow.shape
    file.write(_flo_header(width, height))
    file.write(np.ascontiguousarray(flow, "<f4").data)


def read_flo(path: Path, size: tuple[int, int]) -> NDArray[np.float32]:
    """Read flow as above; raises ValueError when the file has no flow of this width and height [px]."""
    width, height = size
    header, length = _flo_header(width, height), 8 * width * height
    with path.open("rb") as file:
        # Only the expected size is read, so that a wrong one in the file takes no more memory.
        start, data, rest = file.read(len(header)), file.read(length), file.read(1)
    if start != header or len(data) != length or rest:
        raise ValueError(f"not a flow of {width} x {height} pixels")
    return np.frombuffer(data, "<f4").reshape(height, width, 2)


def _flo_header(width: int, height: int) -> bytes:
    return struct.pack("<4sii", MAGIC, width, height)
