"""The surface in motion as glTF 2.0, in one file with its picture.

The mesh is that of the first frame. Every other frame is a morph target, which holds the differences of each vertex and
its normal from the mesh. An animation gives the target of a frame the weight 1 at its time and 0 at the times of the
frames beside it, linear between. Both glTF and this program use metres, y up, and texture coordinates from the upper
left.

Browsers store the targets in a texture with a layer for each, and WebGL 2 guarantees 256 layers. A run with more
frames, or with so many points that the file would be too large, is reduced to key frames, and the largest error of this
is reported.

Source: the glTF 2.0 specification of Khronos, sections 3.6 (accessors), 3.7.2.2 (morph targets), 3.11 (animations) and
4.4 (GLB).
"""

from __future__ import annotations

import heapq
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Count
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.inputs import EXPORT_REFINE, picture_png, unit_normals
from taichi_msm.model.surface import surface
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.version import __version__

FILE = "surface.glb"

# Limits of morph targets: by number, MAX_ARRAY_TEXTURE_LAYERS of every WebGL 2; by bytes, what still loads well.
MAX_TARGETS = 256
MAX_TARGETS_BYTES = 1 << 28
# Bytes per vertex in a target: the differences of its position and of its normal.
TARGET_VERTEX_BYTES = 2 * 3 * 4

# OpenGL's constants for filtering a picture, and for clamping it at its edge.
GL_LINEAR, GL_LINEAR_MIPMAP_LINEAR, GL_CLAMP_TO_EDGE = 9729, 9987, 33071

MAGIC, VERSION = b"glTF", 2
JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"

COMPONENT_TYPES = {"f": 5126, "u": 5125}  # float32, uint32
ACCESSOR_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
# What a buffer holds: vertices, or indices of vertices.
GL_ARRAY_BUFFER, GL_ELEMENT_ARRAY_BUFFER = 34962, 34963

# Every part begins at a multiple of this many bytes.
ALIGNMENT_BYTES = 4


@one_folder_per_run
def write(run: FinishedRun, folder: Path, progress: Count) -> list[str]:
    """Write the surface of a run, with its picture; raises what `FinishedRun.positions` and `picture_png` do."""
    positions, picture, binary = run.positions(), picture_png(run), BinaryChunk()
    most = max(1, min(MAX_TARGETS, MAX_TARGETS_BYTES // (TARGET_VERTEX_BYTES * positions[0, ..., 0].size)))
    keys = key_frames(positions, 1 + most, progress)
    primitive = _surface(positions[0], picture is not None, binary)
    targets = []
    for count, frame in enumerate(keys.frames[1:]):
        progress(count, len(keys.frames))
        targets.append(_target(positions[0], positions[frame], binary))
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"taichi_msm {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "sheet"}],
        "materials": [_material(picture is not None)],
        **(_texture(picture, binary) if picture is not None else {}),
    }
    mesh: dict[str, Any] = {"name": "sheet", "primitives": [{**primitive, "material": 0}]}
    if targets:
        times = run.time[keys.frames]
        mesh["primitives"][0]["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
        mesh["extras"] = {"targetNames": [f"{time:g} s" for time in times[1:]], "error": keys.error}
        document["animations"] = [_animation(times.astype(np.float32), binary)]
    with create_file(folder / FILE) as file:
        file.writelines(binary.container({**document, "meshes": [mesh]}))
    if len(keys.frames) == run.frames:
        return []
    return [
        f"{len(keys.frames)} of {run.frames} frames are key frames; between them no point is farther than "
        f"{keys.error:.2g} m from where it was"
    ]


def _surface(position: NDArray[np.floating], has_picture: bool, binary: BinaryChunk) -> dict[str, Any]:
    """Make the triangles of the first frame, with the place of each vertex in the picture if there is one."""
    first = surface(position, EXPORT_REFINE)
    attributes = {
        "POSITION": binary.accessor(first.vertices.astype(np.float32), GL_ARRAY_BUFFER, bounds=True),
        "NORMAL": binary.accessor(unit_normals(position).astype(np.float32), GL_ARRAY_BUFFER),
    }
    if has_picture:
        attributes["TEXCOORD_0"] = binary.accessor(first.texture_coordinates.astype(np.float32), GL_ARRAY_BUFFER)
    indices = first.triangles.reshape(-1).astype(np.uint32)
    return {"attributes": attributes, "indices": binary.accessor(indices, GL_ELEMENT_ARRAY_BUFFER)}


def _target(first: NDArray[np.floating], position: NDArray[np.floating], binary: BinaryChunk) -> dict[str, int]:
    """Make the morph target of a frame."""
    moved = (position.astype(np.float64) - first).reshape(-1, 3).astype(np.float32)
    turned = (unit_normals(position) - unit_normals(first)).astype(np.float32)
    return {
        "POSITION": binary.accessor(moved, GL_ARRAY_BUFFER, bounds=True),
        "NORMAL": binary.accessor(turned, GL_ARRAY_BUFFER),
    }


def _animation(times: NDArray[np.float32], binary: BinaryChunk) -> dict[str, Any]:
    """Make the weights of all targets at all key frames: each is 1 at its own frame; the first frame has no target."""
    weights = np.eye(len(times), dtype=np.float32)[:, 1:].reshape(-1)
    sampler = {
        "input": binary.accessor(times, bounds=True),
        "interpolation": "LINEAR",
        "output": binary.accessor(weights),
    }
    return {
        "name": "motion",
        "samplers": [sampler],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
    }


def _material(has_picture: bool) -> dict[str, Any]:
    """Make a rough material, so that light shows the shape of the surface."""
    colour = {"baseColorTexture": {"index": 0}} if has_picture else {}
    rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": "sheet", "doubleSided": True, "pbrMetallicRoughness": {**colour, **rough}}


def _texture(picture: bytes, binary: BinaryChunk) -> dict[str, Any]:
    """Add the picture to the document as a texture."""
    return {
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"name": "picture", "mimeType": "image/png", "bufferView": binary.view(picture)}],
        "samplers": [
            {
                "magFilter": GL_LINEAR,
                "minFilter": GL_LINEAR_MIPMAP_LINEAR,
                "wrapS": GL_CLAMP_TO_EDGE,
                "wrapT": GL_CLAMP_TO_EDGE,
            }
        ],
    }


class KeyFrames(NamedTuple):
    """Key frames of a motion: between two of them every point moves in a straight line at constant speed."""

    frames: list[int]  # their numbers, in order; the first and the last frame are among them
    error: float  # the largest distance between a point in any frame and where the key frames beside it place it [m]


def key_frames(position: NDArray[np.floating], most: int, progress: Count = lambda done, total: None) -> KeyFrames:
    """Choose the key frames of a motion: all frames, unless they are too many.

    If they are, the first and the last frame are key frames to begin with. Then the frame that the key frames represent
    worst becomes a key frame too, up to `most`, 2 or more. So key frames are close together where the motion is sudden.
    Positions [m] are at equal distances in time, shape (frames, rows, cols, 3).

    Source: Douglas and Peucker 1973, for all points together and with a given number instead of a tolerance.
    """
    count = len(position)
    if count <= most:
        return KeyFrames(list(range(count)), 0.0)
    chosen = [0, count - 1]
    spans = [_worst_frame(position, 0, count - 1)]
    while len(chosen) < most and -spans[0].error > 0:
        progress(len(chosen), most)
        span = heapq.heappop(spans)
        chosen.append(span.frame)
        heapq.heappush(spans, _worst_frame(position, span.first, span.frame))
        heapq.heappush(spans, _worst_frame(position, span.frame, span.last))
    return KeyFrames(sorted(chosen), -spans[0].error)


class _Span(NamedTuple):
    """The frames from one key frame to the next; the span with the largest error sorts first."""

    error: float  # minus the largest distance between a point in any frame and where the key frames place it [m]
    frame: int  # the frame with this error
    first: int  # the key frames
    last: int


def _worst_frame(position: NDArray[np.floating], first: int, last: int) -> _Span:
    """Find the frame between two key frames that is farthest from the straight line between them."""
    start, end = position[first].astype(np.float64), position[last].astype(np.float64)
    worst = _Span(0.0, first, first, last)
    for frame in range(first + 1, last):
        share = (frame - first) / (last - first)
        apart = position[frame] - (start + share * (end - start))
        worst = min(worst, _Span(-float(np.linalg.norm(apart, axis=-1).max()), frame, first, last))
    return worst


class BinaryChunk:
    """The binary chunk of a .glb file as it grows: its container has JSON, and this chunk that the JSON refers to.

    It is written here because a header of 12 bytes and two chunks cost less than pygltflib and what that depends on.
    """

    def __init__(self) -> None:
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._parts: list[bytes | memoryview] = []
        self._length = 0

    def view(self, data: bytes | memoryview, target: int | None = None) -> int:
        """Add bytes, and return the number of their view; `target` tells what they are for."""
        place = {"buffer": 0, "byteOffset": self._length, "byteLength": len(data)}
        self._views.append(place if target is None else {**place, "target": target})
        self._parts += [data, _padding(len(data), b"\0")]
        self._length += _aligned_length(len(data))
        return len(self._views) - 1

    def accessor(self, values: NDArray[Any], target: int | None = None, *, bounds: bool = False) -> int:
        """Add numbers, and return the number of their accessor, which has their `bounds` if asked for.

        They are float32 or uint32, one number or a vector in each row; `target` tells what they are for.
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
        """Give the parts of a file with these data and the document that refers to them."""
        own = {"accessors": self._accessors, "bufferViews": self._views, "buffers": [{"byteLength": self._length}]}
        text = json.dumps({**document, **own}, separators=(",", ":"), allow_nan=False).encode()
        text += _padding(len(text), b" ")
        yield struct.pack("<4sII", MAGIC, VERSION, 12 + 8 + len(text) + 8 + self._length)
        yield struct.pack("<I4s", len(text), JSON_CHUNK)
        yield text
        yield struct.pack("<I4s", self._length, BINARY_CHUNK)
        yield from self._parts


def _aligned_length(length: int) -> int:
    return -(-length // ALIGNMENT_BYTES) * ALIGNMENT_BYTES


def _padding(length: int, filler: bytes) -> bytes:
    return filler * (_aligned_length(length) - length)
