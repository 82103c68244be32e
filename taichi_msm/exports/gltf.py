"""glTF 2.0 export: the animated surface with its picture, the tools and the cameras in a single file.

The mesh is the surface in the first frame. Every other frame is a morph target: the differences of vertices and normals
from the mesh. In the animation, the weight of a target is 1 at its frame and 0 at the adjacent ones, with linear
interpolation. Like this package, glTF uses metres, y up, and texture coordinates from the upper left corner.

Browsers store each target in a layer of a texture, and WebGL 2 guarantees 256 layers. A run with more frames than this,
or than the size limit permits, is reduced to keyframes, with a warning of the largest interpolation error.

A tool is a mesh of its instrument, which moves with the tip. glTF's cameras look along -z with y up, without lens
distortion, and with the principal point at the centre.

Source: the glTF 2.0 specification of Khronos, sections 3.6 (accessors), 3.7.2.2 (morph targets), 3.10 (cameras), 3.11
(animations) and 4.4 (GLB). The container is too simple to justify a dependency on pygltflib.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from taichi_msm.errors import ProgressCallback
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.inputs import EXPORT_REFINE, instrument_mesh, mass_points, picture_png, unit_normals
from taichi_msm.model.geometry import Rest
from taichi_msm.model.surface import place_instruments, refine_surface
from taichi_msm.render.camera import is_moving, view_at
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.version import __version__

# Limits of the morph targets: MAX_ARRAY_TEXTURE_LAYERS of WebGL 2, and a size that browsers load quickly.
MAX_TARGETS = 256
MAX_TARGETS_BYTES = 1 << 28

COMPONENT_TYPES = {"f": 5126, "u": 5125}  # float32, uint32
ACCESSOR_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}

# Constants of OpenGL for buffers of vertices and of vertex indices.
GL_ARRAY_BUFFER, GL_ELEMENT_ARRAY_BUFFER = 34962, 34963

# Constants of OpenGL for texture filtering and wrapping.
GL_LINEAR, GL_LINEAR_MIPMAP_LINEAR, GL_CLAMP_TO_EDGE = 9729, 9987, 33071

Array = NDArray[np.floating]
Numbers = NDArray[Any]


def _write_run(run: FinishedRun, folder: Path, progress: ProgressCallback) -> list[str]:
    positions, rest, picture = run.positions(), run.rest(), picture_png(run)
    mask = rest.mask if rest else None
    # A target has differences of positions and normals, float32.
    target_bytes = 2 * 3 * 4 * len(mass_points(positions[0], mask))
    max_targets = max(1, min(MAX_TARGETS, MAX_TARGETS_BYTES // target_bytes))
    keys = key_frames(positions, 1 + max_targets, progress)
    asset = {"version": "2.0", "generator": f"taichi_msm {__version__}"}
    nodes = [{"mesh": 0, "name": "sheet"}]
    glb = Glb({"asset": asset, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes})
    _add_sheet(glb, positions, rest, picture, run.time, keys, progress)
    _add_tools(glb, run, positions)
    notes = _add_cameras(glb, run)
    with create_file(folder / "surface.glb") as file:
        file.writelines(glb.content())
    if len(keys.frames) < run.frames:
        notes.append(
            f"{len(keys.frames)} of {run.frames} frames are keyframes; the interpolation error between them is at most "
            f"{keys.error:.2g} m"
        )
    return notes


write = one_folder_per_run(_write_run)


def _add_sheet(
    glb: Glb,
    positions: Array,
    rest: Rest | None,
    picture: bytes | None,
    time: Array,
    keys: KeyFrames,
    progress: ProgressCallback,
) -> None:
    """Add the mesh of the first frame, its material and morph targets, and their animation."""
    mask = rest.mask if rest else None
    first, normals = refine_surface(positions[0], EXPORT_REFINE, rest), unit_normals(positions[0], mask)
    attributes = glb.attributes(first.vertices, normals)
    if picture is not None:
        attributes["TEXCOORD_0"] = glb.accessor(first.texture_coordinates, GL_ARRAY_BUFFER)
    primitive: dict[str, Any] = {"attributes": attributes, "indices": glb.indices(first.triangles), "material": 0}
    targets = []
    for count, frame in enumerate(keys.frames[1:]):
        progress(count, len(keys.frames))
        displacement = mass_points(positions[frame].astype(np.float64) - positions[0], mask)
        targets.append(glb.attributes(displacement, unit_normals(positions[frame], mask) - normals))
    colour = {} if picture is None else {"baseColorTexture": {"index": 0}}
    matte = {**colour, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    glb.add("materials", {"name": "sheet", "doubleSided": True, "pbrMetallicRoughness": matte})
    if picture is not None:
        glb.add("textures", {"source": 0, "sampler": 0})
        glb.add("images", {"name": "picture", "mimeType": "image/png", "bufferView": glb.view(picture)})
        filters = {"magFilter": GL_LINEAR, "minFilter": GL_LINEAR_MIPMAP_LINEAR}
        glb.add("samplers", {**filters, "wrapS": GL_CLAMP_TO_EDGE, "wrapT": GL_CLAMP_TO_EDGE})
    mesh: dict[str, Any] = {"name": "sheet", "primitives": [primitive]}
    if targets:
        times = time[keys.frames]
        primitive["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
        mesh["extras"] = {"targetNames": [f"{time:g} s" for time in times[1:]], "error": keys.error}
        # The first frame has no target.
        glb.animate(0, "weights", times, np.eye(len(times))[:, 1:].reshape(-1))
    glb.add("meshes", mesh)


def _add_tools(glb: Glb, run: FinishedRun, positions: Array) -> None:
    """Add a mesh for every probe with an instrument, and its motion."""
    pairs = zip(positions, run.time.tolist(), strict=True)
    placed = [place_instruments(run.scene, position, time) for position, time in pairs]
    if not placed[0]:
        return
    metal = {"baseColorFactor": [0.6, 0.6, 0.62, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.5}
    material = glb.add("materials", {"name": "instrument", "pbrMetallicRoughness": metal})
    names = [f"probes.{index}" for index, probe in enumerate(run.scene.probes) if probe.instrument is not None]
    for name, *solids in zip(names, *placed, strict=True):
        vertices, normals, triangles = instrument_mesh(solids[0])
        primitive = {"attributes": glb.attributes(vertices, normals), "indices": glb.indices(triangles)}
        mesh = glb.add("meshes", {"name": name, "primitives": [{**primitive, "material": material}]})
        tips = np.array([solid.tip for solid in solids])
        _add_node(glb, {"name": name, "mesh": mesh}, {"translation": tips}, run.time)


def _add_cameras(glb: Glb, run: FinishedRun) -> list[str]:
    """Add the cameras of the scene, with their motion; return warnings about properties without equivalent in glTF."""
    notes = []
    for name in run.scene.render.all_cameras:
        times = run.time.tolist() if is_moving(run.scene, name) else [0.0]
        views = [view_at(run.scene, time, name) for time in times]
        view, title = views[0], name or "camera"
        width, height = (view.size / view.scale).tolist()
        if view.pinhole:
            field = {"yfov": 2 * math.atan(height / 2), "aspectRatio": width / height}
            optics = {"type": "perspective", "perspective": {**field, "znear": 1e-3 * view.distance}}
        else:
            field = {"xmag": width / 2, "ymag": height / 2, "znear": 0.0, "zfar": 2 * view.distance}
            optics = {"type": "orthographic", "orthographic": field}
        if view.lens is not None or not np.allclose(view.centre, view.size / 2):
            notes.append(f"{title}: lens distortion and principal point are left out, as glTF cameras have none")
        camera = glb.add("cameras", {"name": title, **optics})
        pose = {
            "translation": np.array([view.eye for view in views]),
            "rotation": Rotation.from_matrix([view.axes.T for view in views]).as_quat(),
        }
        _add_node(glb, {"name": title, "camera": camera}, pose, run.time)
    return notes


def _add_node(glb: Glb, node: dict[str, Any], pose: dict[str, Array], time: Array) -> None:
    index = glb.add("nodes", node)
    glb.document["scenes"][0]["nodes"].append(index)
    for path, values in pose.items():
        node[path] = values[0].tolist()
        if (values != values[0]).any():
            glb.animate(index, path, time, values)


class KeyFrames(NamedTuple):
    """Keyframes of a motion, which is interpolated linearly between them."""

    frames: list[int]  # indices in ascending order, including the first and the last frame
    error: float  # largest interpolation error of any mass point in any frame [m]


def key_frames(positions: Array, limit: int, progress: ProgressCallback = lambda done, total: None) -> KeyFrames:
    """Choose the keyframes of a motion: all frames if possible, otherwise at most `limit` by a greedy selection.

    The selection starts with the first and last frame, and repeatedly adds the frame with the largest interpolation
    error. The positions are those at equidistant times [m], shape (frames, rows, cols, 3).

    Source: Douglas and Peucker 1973, for all mass points, limited by the number of keyframes, not by a tolerance.
    """
    count = len(positions)
    if count <= limit:
        return KeyFrames(list(range(count)), 0.0)
    chosen = [0, count - 1]
    spans = [_worst_frame(positions, 0, count - 1)]
    while len(chosen) < limit and (worst := min(spans)).error < 0:
        progress(len(chosen), limit)
        spans.remove(worst)
        chosen.append(worst.frame)
        spans += [_worst_frame(positions, worst.first, worst.frame), _worst_frame(positions, worst.frame, worst.last)]
    return KeyFrames(sorted(chosen), -min(spans).error)


class _Span(NamedTuple):
    """Frames between two adjacent keyframes. The span with the largest error sorts first."""

    error: float  # negative of the largest interpolation error [m]
    frame: int  # the frame with this error
    first: int  # keyframe at the beginning
    last: int  # keyframe at the end


def _worst_frame(positions: Array, first: int, last: int) -> _Span:
    """Find the frame with the largest interpolation error between two keyframes."""
    start, end = positions[first].astype(np.float64), positions[last].astype(np.float64)
    worst = _Span(0.0, first, first, last)
    for frame in range(first + 1, last):
        fraction = (frame - first) / (last - first)
        error = positions[frame] - (start + fraction * (end - start))
        worst = min(worst, _Span(-float(np.linalg.norm(error, axis=-1).max()), frame, first, last))
    return worst


class Glb:
    """Content of a .glb file with a scene; `document` is the JSON document, without its buffers."""

    def __init__(self, document: dict[str, Any]) -> None:
        self.document = document
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._parts: list[bytes | memoryview] = []
        self._length = 0

    def view(self, data: bytes | memoryview, target: int | None = None) -> int:
        """Append bytes, and return the index of their view; `target` is GL_ARRAY_BUFFER or GL_ELEMENT_ARRAY_BUFFER."""
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": len(data)}
        self._views.append(view if target is None else {**view, "target": target})
        padding = _padding(len(data), b"\0")
        self._parts += [data, padding]
        self._length += len(data) + len(padding)
        return len(self._views) - 1

    def accessor(self, values: Numbers, target: int | None = None, *, bounds: bool = False) -> int:
        """Append floats, stored as float32, or integers, as uint32, shape (n,) or (n, k), k = 1 to 4.

        With `bounds`, the minimum and maximum are stored, too. Return the index of the accessor.
        """
        dtype = np.float32 if values.dtype.kind == "f" else np.uint32
        rows = np.ascontiguousarray(values, dtype).reshape(len(values), -1)
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
        """Append positions [m] and unit normals of vertices, or their differences, shape (vertices, 3).

        Return the indices of the accessors, by attribute.
        """
        return {
            "POSITION": self.accessor(positions, GL_ARRAY_BUFFER, bounds=True),
            "NORMAL": self.accessor(normals, GL_ARRAY_BUFFER),
        }

    def indices(self, triangles: Numbers) -> int:
        """Append the vertex indices of triangles, shape (triangles, 3); return the index of the accessor."""
        return self.accessor(triangles.reshape(-1), GL_ELEMENT_ARRAY_BUFFER)

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append an entry to a list of the document, such as "nodes"; return its index."""
        self.document.setdefault(kind, []).append(entry)
        return len(self.document[kind]) - 1

    def animate(self, node: int, path: str, times: Numbers, values: Numbers) -> None:
        """Append a channel of the animation, with linear interpolation between times [s], shape (n,).

        `path` is the property of the node: translation, rotation or weights. Its values are in glTF's units, shape (n,
        k), or (n * targets,) of weights.
        """
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
        """Yield the bytes of the file in parts."""
        buffers = {"accessors": self._accessors, "bufferViews": self._views, "buffers": [{"byteLength": self._length}]}
        text = json.dumps({**self.document, **buffers}, separators=(",", ":"), allow_nan=False).encode()
        text += _padding(len(text), b" ")
        yield struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + self._length)
        yield struct.pack("<I4s", len(text), b"JSON")
        yield text
        yield struct.pack("<I4s", self._length, b"BIN\0")
        yield from self._parts


def _padding(length: int, filler: bytes) -> bytes:
    """Return the bytes that pad a chunk or a buffer view to a multiple of 4 bytes."""
    return filler * (-length % 4)
