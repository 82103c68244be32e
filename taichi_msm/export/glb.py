"""The container format of glTF, .glb: JSON, and one chunk of binary data that the JSON refers to.

It is written here because a header of 12 bytes and two chunks cost less than pygltflib and the packages it depends on.

Source: the glTF 2.0 specification of Khronos, sections 3.6 (accessors) and 4.4 (GLB).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC, VERSION = b"glTF", 2
JSON, BINARY = b"JSON", b"BIN\0"

COMPONENTS = {"f": 5126, "u": 5125}  # float32, uint32
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
# What a buffer holds: vertices, or indices of vertices.
VERTICES, INDICES = 34962, 34963

# Every part begins at a multiple of this many bytes.
ALIGNMENT = 4


class Binary:
    """The binary chunk as it grows.

    Attributes:
        views: the `bufferViews` of the document.
        accessors: its `accessors`.
    """

    def __init__(self) -> None:
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self._parts: list[bytes | memoryview] = []
        self._length = 0

    def view(self, data: bytes | memoryview, target: int | None = None) -> int:
        """Add bytes, and return the number of their view; `target` tells what they are for."""
        place = {"buffer": 0, "byteOffset": self._length, "byteLength": len(data)}
        self.views.append(place if target is None else {**place, "target": target})
        self._parts += [data, _padding(len(data), b"\0")]
        self._length += _padded(len(data))
        return len(self.views) - 1

    def accessor(self, values: NDArray[Any], target: int | None = None, *, bounds: bool = False) -> int:
        """Add numbers, and return the number of their accessor.

        Args:
            values: float32 or uint32, one number or a vector in each row.
            target: what they are for.
            bounds: whether the accessor has the minimum and the maximum of every component.
        """
        rows = np.ascontiguousarray(values).reshape(len(values), -1)
        accessor = {
            "bufferView": self.view(rows.data.cast("B"), target),
            "componentType": COMPONENTS[rows.dtype.kind],
            "count": len(rows),
            "type": KINDS[rows.shape[1]],
        }
        if bounds:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def container(self, document: dict[str, Any]) -> Iterator[bytes | memoryview]:
        """Give the parts of a file with these data and the document that refers to them."""
        own = {"accessors": self.accessors, "bufferViews": self.views, "buffers": [{"byteLength": self._length}]}
        text = json.dumps({**document, **own}, separators=(",", ":"), allow_nan=False).encode()
        text += _padding(len(text), b" ")
        yield struct.pack("<4sII", MAGIC, VERSION, 12 + 8 + len(text) + 8 + self._length)
        yield struct.pack("<I4s", len(text), JSON)
        yield text
        yield struct.pack("<I4s", self._length, BINARY)
        yield from self._parts


def _padded(length: int) -> int:
    return -(-length // ALIGNMENT) * ALIGNMENT


def _padding(length: int, filler: bytes) -> bytes:
    return filler * (_padded(length) - length)
