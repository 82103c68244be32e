"""glTF 2.0 export: the animated surface with its picture, the tools and the cameras in a single file.

The mesh is the surface in the first frame. Every other frame is a morph target: the differences of vertices and normals
from the mesh. In the animation, the weight of a target is 1 at its frame and 0 at the adjacent ones, with linear
interpolation. Like this package, glTF uses metres, y up, and texture coordinates from the upper left corner.

Browsers store each target in a layer of a texture, and WebGL 2 guarantees 256 layers. Runs that exceed this, or the
size limit, are reduced to keyframes, and the largest interpolation error is reported.

Source: the glTF 2.0 specification of Khronos, sections 3.7.2.2 (morph targets) and 3.11 (animations).
"""

from __future__ import annotations

import heapq
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ProgressCallback
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.glb import GL_ARRAY_BUFFER, GL_ELEMENT_ARRAY_BUFFER, BinaryChunk
from taichi_msm.exports.gltf_nodes import add_cameras, add_tools
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


@one_folder_per_run
def write(run: FinishedRun, folder: Path, progress: ProgressCallback) -> list[str]:
    """Write the animated surface of a run with its picture, tools and cameras; arguments as for `one_folder_per_run`.

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
    document["meshes"] = [mesh]
    add_tools(document, run, positions, binary)
    notes = add_cameras(document, run, binary)
    with create_file(folder / "surface.glb") as file:
        file.writelines(binary.container(document))
    if len(keys.frames) == run.frames:
        return notes
    return [
        *notes,
        f"{len(keys.frames)} of {run.frames} frames are key frames; between them no point is farther than "
        f"{keys.error:.2g} m from where it was",
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
