"""Tools and cameras of a glTF file.

A tool is a mesh of its capsule, which moves with the tip. glTF's cameras look along -z with y up, and have neither lens
distortion nor another principal point than the centre.

Source: the glTF 2.0 specification of Khronos, sections 3.10 (cameras) and 3.11 (animations).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from taichi_msm.exports.glb import GL_ARRAY_BUFFER, GL_ELEMENT_ARRAY_BUFFER, BinaryChunk
from taichi_msm.exports.inputs import instrument_mesh
from taichi_msm.model.surface import place_instruments
from taichi_msm.render.camera import is_moving, view_at
from taichi_msm.runs.finished import FinishedRun

Array = NDArray[np.float64]

# Near plane of a perspective camera, as a fraction of the distance of its target.
NEAR_RATIO = 1e-3


def add_tools(document: dict[str, Any], run: FinishedRun, positions: NDArray[np.floating], binary: BinaryChunk) -> None:
    """Add a mesh for every probe with an instrument, and its motion.

    Args:
        document: of the file; receives nodes, meshes, a material and the animation.
        run: the run.
        positions: positions of the mass points [m], shape (frames, rows, cols, 3).
        binary: receives the arrays.
    """
    pairs = zip(positions, run.time.tolist(), strict=True)
    placed = [place_instruments(run.scene, position, time) for position, time in pairs]
    if not placed[0]:
        return
    metal = {"baseColorFactor": [0.6, 0.6, 0.62, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.5}
    document["materials"].append({"name": "instrument", "pbrMetallicRoughness": metal})
    names = [f"probes.{index}" for index, probe in enumerate(run.scene.probes) if probe.instrument is not None]
    for name, *solids in zip(names, *placed, strict=True):
        vertices, normals, triangles = instrument_mesh(solids[0])
        attributes = {
            "POSITION": binary.accessor(vertices.astype(np.float32), GL_ARRAY_BUFFER, bounds=True),
            "NORMAL": binary.accessor(normals.astype(np.float32), GL_ARRAY_BUFFER),
        }
        indices = binary.accessor(triangles.reshape(-1).astype(np.uint32), GL_ELEMENT_ARRAY_BUFFER)
        primitive = {"attributes": attributes, "indices": indices, "material": len(document["materials"]) - 1}
        document["meshes"].append({"name": name, "primitives": [primitive]})
        tips = np.array([solid.tip for solid in solids])
        _add_node(document, {"name": name, "mesh": len(document["meshes"]) - 1}, {"translation": tips}, run, binary)


def add_cameras(document: dict[str, Any], run: FinishedRun, binary: BinaryChunk) -> list[str]:
    """Add the cameras of the scene, with their motion; arguments as for `add_tools`.

    Returns:
        Warnings about what glTF cannot describe.
    """
    notes = []
    document["cameras"] = []
    for name in run.scene.render.all_cameras:
        times = run.time.tolist() if is_moving(run.scene, name) else [0.0]
        views = [view_at(run.scene, time, name) for time in times]
        view, title = views[0], name or "camera"
        width, height = (view.size / view.scale).tolist()
        if view.pinhole:
            field = {"yfov": 2 * math.atan(height / 2), "aspectRatio": width / height}
            optics = {"type": "perspective", "perspective": {**field, "znear": NEAR_RATIO * view.distance}}
        else:
            field = {"xmag": width / 2, "ymag": height / 2, "znear": 0.0, "zfar": 2 * view.distance}
            optics = {"type": "orthographic", "orthographic": field}
        if view.lens is not None or not np.allclose(view.centre, view.size / 2):
            notes.append(f"{title}: without its distortion and its principal point, which a camera of glTF cannot have")
        document["cameras"].append({"name": title, **optics})
        pose = {
            "translation": np.array([view.eye for view in views]),
            "rotation": Rotation.from_matrix([view.axes.T for view in views]).as_quat(),
        }
        _add_node(document, {"name": title, "camera": len(document["cameras"]) - 1}, pose, run, binary)
    return notes


def _add_node(
    document: dict[str, Any], node: dict[str, Any], pose: dict[str, Array], run: FinishedRun, binary: BinaryChunk
) -> None:
    """Add a node, with an animation of the parts of its pose that change."""
    document["nodes"].append(node)
    document["scenes"][0]["nodes"].append(len(document["nodes"]) - 1)
    for path, values in pose.items():
        node[path] = values[0].tolist()
        if (values == values[0]).all():
            continue
        if "animations" not in document:
            document["animations"] = [{"name": "motion", "samplers": [], "channels": []}]
        (animation,) = document["animations"]
        sampler = {
            "input": binary.accessor(run.time.astype(np.float32), bounds=True),
            "interpolation": "LINEAR",
            "output": binary.accessor(values.astype(np.float32)),
        }
        target = {"node": len(document["nodes"]) - 1, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]), "target": target})
        animation["samplers"].append(sampler)
