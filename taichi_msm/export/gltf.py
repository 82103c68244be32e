"""The surface in motion as glTF 2.0, in one file with its picture.

The mesh is that of the first frame. Every other frame is a morph target, which holds the differences of each vertex and
its normal from the mesh. An animation gives the target of a frame the weight 1 at its time and 0 at the times of the
frames beside it, linear between. Both glTF and this program use metres, y up, and texture coordinates from the upper
left.

Browsers store the targets in a texture with a layer for each, and WebGL 2 guarantees 256 layers. A run with more
frames, or with so many points that the file would be too large, is reduced to key frames, and the largest error of this
is reported.

Source: the glTF 2.0 specification of Khronos, sections 3.7.2.2 (morph targets) and 3.11 (animations).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm import __version__
from taichi_msm.export.glb import INDICES, VERTICES, Binary
from taichi_msm.export.keyframes import key_frames
from taichi_msm.export.mesh import REFINE, picture_png, unit_normals
from taichi_msm.progress import Count
from taichi_msm.render.surface import surface
from taichi_msm.results.finished_run import FinishedRun
from taichi_msm.results.whole import create

FILE = "surface.glb"

# Limits of morph targets: by number, MAX_ARRAY_TEXTURE_LAYERS of every WebGL 2; by bytes, what still loads well.
MOST_TARGETS = 256
MOST_BYTES = 1 << 28
# Bytes per vertex in a target: the differences of its position and of its normal.
VERTEX_BYTES = 2 * 3 * 4

# OpenGL's constants for filtering a picture, and for clamping it at its edge.
LINEAR, MIPMAPS, CLAMPED = 9729, 9987, 33071


def write(run: FinishedRun, folder: Path, progress: Count) -> list[str]:
    """Write the surface of a run, with its picture.

    Raises:
        FilesError: when the run has no trajectory, or it is damaged.
        SceneError: when the picture is missing.
    """
    positions, picture, binary = run.positions(), picture_png(run), Binary()
    most = max(1, min(MOST_TARGETS, MOST_BYTES // (VERTEX_BYTES * positions[0, ..., 0].size)))
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
    with create(folder / FILE) as file:
        file.writelines(binary.container({**document, "meshes": [mesh]}))
    if len(keys.frames) == run.frames:
        return []
    return [
        f"{len(keys.frames)} of {run.frames} frames are key frames; between them no point is farther than "
        f"{keys.error:.2g} m from where it was"
    ]


def _surface(position: NDArray[np.floating], has_picture: bool, binary: Binary) -> dict[str, Any]:
    """Make the triangles of the first frame, with the place of each vertex in the picture if there is one."""
    first = surface(position, REFINE)
    attributes = {
        "POSITION": binary.accessor(first.vertices.astype(np.float32), VERTICES, bounds=True),
        "NORMAL": binary.accessor(unit_normals(position).astype(np.float32), VERTICES),
    }
    if has_picture:
        attributes["TEXCOORD_0"] = binary.accessor(first.texture_coordinates.astype(np.float32), VERTICES)
    indices = first.triangles.reshape(-1).astype(np.uint32)
    return {"attributes": attributes, "indices": binary.accessor(indices, INDICES)}


def _target(first: NDArray[np.floating], position: NDArray[np.floating], binary: Binary) -> dict[str, int]:
    """Make the morph target of a frame."""
    moved = (position.astype(np.float64) - first).reshape(-1, 3).astype(np.float32)
    turned = (unit_normals(position) - unit_normals(first)).astype(np.float32)
    return {
        "POSITION": binary.accessor(moved, VERTICES, bounds=True),
        "NORMAL": binary.accessor(turned, VERTICES),
    }


def _animation(times: NDArray[np.float32], binary: Binary) -> dict[str, Any]:
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


def _texture(picture: bytes, binary: Binary) -> dict[str, Any]:
    """Add the picture to the document as a texture."""
    return {
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"name": "picture", "mimeType": "image/png", "bufferView": binary.view(picture)}],
        "samplers": [{"magFilter": LINEAR, "minFilter": MIPMAPS, "wrapS": CLAMPED, "wrapT": CLAMPED}],
    }
