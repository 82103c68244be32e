"""Binary chunk and container of glTF 2.0, .glb.

Source: the glTF 2.0 specification of Khronos, sections 3.6 (accessors) and 4.4 (GLB).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

COMPONENT_TYPES = {"f": 5126, "u": 5125}  # float32, uint32
ACCESSOR_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}

# Constants of OpenGL for buffers of vertices and of vertex indices.
GL_ARRAY_BUFFER, GL_ELEMENT_ARRAY_BUFFER = 34962, 34963

# Alignment of chunks and buffer views.
ALIGNMENT_BYTES = 4


class BinaryChunk:
    """Binary chunk of a .glb file.

    The container, a header of 12 bytes and two chunks, is too simple to justify a dependency on pygltflib.
    """

    def __init__(self) -> None:
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._parts: list[bytes | memoryview] = []
        self._length = 0

    def view(self, data: bytes | memoryview, target: int | None = None) -> int:
        """Append bytes.

        Args:
            data: content of the view.
            target: GL_ARRAY_BUFFER or GL_ELEMENT_ARRAY_BUFFER; None for other data.

        Returns:
            Index of the buffer view.
        """
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": len(data)}
        self._views.append(view if target is None else {**view, "target": target})
        self._parts += [data, _padding(len(data), b"\0")]
        self._length += _aligned_length(len(data))
        return len(self._views) - 1

    def accessor(self, values: NDArray[Any], target: int | None = None, *, bounds: bool = False) -> int:
        """Append numbers.

        Args:
            values: float32 or uint32, shape (n,) or (n, k), k = 1 to 4.
            target: as for `view`.
            bounds: whether to store the minimum and maximum.

        Returns:
            Index of the accessor.
        """
        rows = np.ascontiguousarray(values).reshape(len(values), -1)
        accessor = {
            "bufferView": self.view(rows.data.cast("B"), target),
            "componentType": COMPONENT_TYPES[rows.dtype.kind],
            "count": len(rows),
            "type": ACCESSOR_TYPES[rows.shape[1]],
        }
        if bounds:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def container(self, document: dict[str, Any]) -> Iterator[bytes | memoryview]:
        """Yield the content of a .glb file with this chunk and a JSON document that refers to it."""
        buffers = {"accessors": self._accessors, "bufferViews": self._views, "buffers": [{"byteLength": self._length}]}
        text = json.dumps({**document, **buffers}, separators=(",", ":"), allow_nan=False).encode()
        text += _padding(len(text), b" ")
        yield struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + self._length)
        yield struct.pack("<I4s", len(text), b"JSON")
        yield text
        yield struct.pack("<I4s", self._length, b"BIN\0")
        yield from self._parts


def _aligned_length(length: int) -> int:
    return -(-length // ALIGNMENT_BYTES) * ALIGNMENT_BYTES


def _padding(length: int, filler: bytes) -> bytes:
    return filler * (_aligned_length(length) - length)
