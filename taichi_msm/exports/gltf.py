"""glTF 2.0 export: the animated surface and its picture in a single file.

The mesh is the surface in the first frame. Every other frame is a morph target: the differences of vertices and normals
from the mesh. In the animation, the weight of a target is 1 at its frame and 0 at the adjacent ones, with linear
interpolation. Like this package, glTF uses metres, y up, and texture coordinates from the upper left corner.

Browsers store each target in a layer of a texture, and WebGL 2 guarantees 256 layers. Runs that exceed this, or the
size limit, are reduced to keyframes, and the largest interpolation error is reported.

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

from taichi_msm.errors import ProgressCallback
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.inputs import EXPORT_REFINE, picture_png, unit_normals
from taichi_msm.model.surface import refine_surface
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.version import __version__

# Limits of the morph targets: MAX_ARRAY_TEXTURE_LAYERS of WebGL 2, and a size that browsers load quickly.
MAX_TARGETS = 256
MAX_TARGETS_BYTES = 1 << 28
TARGET_VERTEX_BYTES = 2 * 3 * 4  # differences of position and normal, float32

# Constants of OpenGL for texture filtering and wrapping.
GL_LINEAR, GL_LINEAR_MIPMAP_LINEAR, GL_CLAMP_TO_EDGE = 9729, 9987, 33071

COMPONENT_TYPES = {"f": 5126, "u": 5125}  # float32, uint32
ACCESSOR_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}

# Constants of OpenGL for buffers of vertices and of vertex indices.
GL_ARRAY_BUFFER, GL_ELEMENT_ARRAY_BUFFER = 34962, 34963

# Alignment of chunks and buffer views.
ALIGNMENT_BYTES = 4


@one_folder_per_run
def write(run: FinishedRun, folder: Path, progress: ProgressCallback) -> list[str]:
    """Write the animated surface of a run with its picture; arguments as for `one_folder_per_run`.

    Raises:
        FilesError: as for `FinishedRun.positions`.
        SceneError: as for `picture_png`.
    """
    positions, picture, binary = run.positions(), picture_png(run), BinaryChunk()
    max_targets = max(1, min(MAX_TARGETS, MAX_TARGETS_BYTES // (TARGET_VERTEX_BYTES * positions[0, ..., 0].size)))
    keys = key_frames(positions, 1 + max_targets, progress)
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
    with create_file(folder / "surface.glb") as file:
        file.writelines(binary.container({**document, "meshes": [mesh]}))
    if len(keys.frames) == run.frames:
        return []
    return [
        f"{len(keys.frames)} of {run.frames} frames are key frames; between them no point is farther than "
        f"{keys.error:.2g} m from where it was"
    ]


def _surface(position: NDArray[np.floating], has_picture: bool, binary: BinaryChunk) -> dict[str, Any]:
    """Build the mesh of the first frame, with texture coordinates if there is a picture."""
    first = refine_surface(position, EXPORT_REFINE)
    attributes = {
        "POSITION": binary.accessor(first.vertices.astype(np.float32), GL_ARRAY_BUFFER, bounds=True),
        "NORMAL": binary.accessor(unit_normals(position).astype(np.float32), GL_ARRAY_BUFFER),
    }
    if has_picture:
        attributes["TEXCOORD_0"] = binary.accessor(first.texture_coordinates.astype(np.float32), GL_ARRAY_BUFFER)
    indices = first.triangles.reshape(-1).astype(np.uint32)
    return {"attributes": attributes, "indices": binary.accessor(indices, GL_ELEMENT_ARRAY_BUFFER)}


def _target(first: NDArray[np.floating], position: NDArray[np.floating], binary: BinaryChunk) -> dict[str, int]:
    displacement = (position.astype(np.float64) - first).reshape(-1, 3).astype(np.float32)
    normal_change = (unit_normals(position) - unit_normals(first)).astype(np.float32)
    return {
        "POSITION": binary.accessor(displacement, GL_ARRAY_BUFFER, bounds=True),
        "NORMAL": binary.accessor(normal_change, GL_ARRAY_BUFFER),
    }


def _animation(times: NDArray[np.float32], binary: BinaryChunk) -> dict[str, Any]:
    # The first frame has no target.
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
    """Build a matte material."""
    colour = {"baseColorTexture": {"index": 0}} if has_picture else {}
    rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": "sheet", "doubleSided": True, "pbrMetallicRoughness": {**colour, **rough}}


def _texture(picture: bytes, binary: BinaryChunk) -> dict[str, Any]:
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
    """Keyframes of a motion, which is interpolated linearly between them."""

    frames: list[int]  # indices in ascending order, including the first and the last frame
    error: float  # largest interpolation error of any mass point in any frame [m]


def key_frames(
    position: NDArray[np.floating], limit: int, progress: ProgressCallback = lambda done, total: None
) -> KeyFrames:
    """Choose the keyframes of a motion: all frames if possible, otherwise by a greedy selection.

    The selection starts with the first and last frame, and repeatedly adds the frame with the largest interpolation
    error.

    Args:
        position: positions at equidistant times [m], shape (frames, rows, cols, 3).
        limit: maximum number of keyframes, 2 or more.
        progress: called with the chosen and the maximum number of keyframes.

    Source: Douglas and Peucker 1973, applied to all mass points at once, with a number instead of a tolerance.
    """
    count = len(position)
    if count <= limit:
        return KeyFrames(list(range(count)), 0.0)
    chosen = [0, count - 1]
    spans = [_worst_frame(position, 0, count - 1)]
    while len(chosen) < limit and -spans[0].error > 0:
        progress(len(chosen), limit)
        span = heapq.heappop(spans)
        chosen.append(span.frame)
        heapq.heappush(spans, _worst_frame(position, span.first, span.frame))
        heapq.heappush(spans, _worst_frame(position, span.frame, span.last))
    return KeyFrames(sorted(chosen), -spans[0].error)


class _Span(NamedTuple):
    """Frames between two adjacent keyframes. The span with the largest error sorts first."""

    error: float  # negative of the largest interpolation error [m]
    frame: int  # the frame with this error
    first: int  # keyframe at the beginning
    last: int  # keyframe at the end


def _worst_frame(position: NDArray[np.floating], first: int, last: int) -> _Span:
    """Find the frame with the largest interpolation error between two keyframes."""
    start, end = position[first].astype(np.float64), position[last].astype(np.float64)
    worst = _Span(0.0, first, first, last)
    for frame in range(first + 1, last):
        fraction = (frame - first) / (last - first)
        error = position[frame] - (start + fraction * (end - start))
        worst = min(worst, _Span(-float(np.linalg.norm(error, axis=-1).max()), frame, first, last))
    return worst


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
            values: float32 or uint32, shape (n,) or (n, k), k = 1 to 3.
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
