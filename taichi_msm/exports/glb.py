"""Document and binary chunk of glTF 2.0, in their container, .glb; too simple to justify a dependency on pygltflib.

Source: the glTF 2.0 specification of Khronos, sections 3.6 (accessors) and 4.4 (GLB).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[Any]

COMPONENT_TYPES = {"f": 5126, "u": 5125}  # float32, uint32
ACCESSOR_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}

# Constants of OpenGL for buffers of vertices and of vertex indices.
GL_ARRAY_BUFFER, GL_ELEMENT_ARRAY_BUFFER = 34962, 34963


class Glb:
    """Content of a .glb file with a scene.

    Attributes:
        document: the JSON document, without its buffers.
    """

    def __init__(self, document: dict[str, Any]) -> None:
        self.document = document
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
        padding = _padding(len(data), b"\0")
        self._parts += [data, padding]
        self._length += len(data) + len(padding)
        return len(self._views) - 1

    def accessor(self, values: Numbers, target: int | None = None, *, bounds: bool = False) -> int:
        """Append numbers.

        Args:
            values: floats, stored as float32, or integers, as uint32, shape (n,) or (n, k), k = 1 to 4.
            target: as for `view`.
            bounds: whether to store the minimum and maximum.

        Returns:
            Index of the accessor.
        """
        kind = np.float32 if values.dtype.kind == "f" else np.uint32
        rows = np.ascontiguousarray(values, kind).reshape(len(values), -1)
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

    def attributes(self, positions: Numbers, normals: Numbers) -> dict[str, int]:
        """Append the vertices of a mesh, or their changes, both of shape (vertices, 3)."""
        return {
            "POSITION": self.accessor(positions, GL_ARRAY_BUFFER, bounds=True),
            "NORMAL": self.accessor(normals, GL_ARRAY_BUFFER),
        }

    def indices(self, triangles: Numbers) -> int:
        """Append the vertices of triangles, shape (triangles, 3)."""
        return self.accessor(triangles.reshape(-1), GL_ELEMENT_ARRAY_BUFFER)

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append an entry to a list of the document, such as "nodes"; return its index."""
        self.document.setdefault(kind, []).append(entry)
        return len(self.document[kind]) - 1

    def animate(self, node: int, path: str, times: Numbers, values: Numbers) -> None:
        """Append the values of a property of a node at times [s], with linear interpolation."""
        if "animations" not in self.document:
            self.add("animations", {"name": "motion", "samplers": [], "channels": []})
        (animation,) = self.document["animations"]
        sampler = {
            "input": self.accessor(times, bounds=True),
            "interpolation": "LINEAR",
            "output": self.accessor(values),
        }
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]), "target": target})
        animation["samplers"].append(sampler)

    def content(self) -> Iterator[bytes | memoryview]:
        """Yield the parts of the file."""
        buffers = {"accessors": self._accessors, "bufferViews": self._views, "buffers": [{"byteLength": self._length}]}
        text = json.dumps({**self.document, **buffers}, separators=(",", ":"), allow_nan=False).encode()
        text += _padding(len(text), b" ")
        yield struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + self._length)
        yield struct.pack("<I4s", len(text), b"JSON")
        yield text
        yield struct.pack("<I4s", self._length, b"BIN\0")
        yield from self._parts


def _padding(length: int, filler: bytes) -> bytes:
    """Return the filler that aligns a chunk or a buffer view to 4 bytes."""
    return filler * (-length % 4)
