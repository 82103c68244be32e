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
from taichi_msm.model.surface import Capsule, place_capsules, refine_surface
from taichi_msm.render.camera import is_moving, view_at
from taichi_msm.runs.finished import FinishedRun

Array = NDArray[np.float64]

# Segments of a capsule around its axis, and from the equator to the pole of an end.
SEGMENTS, POLE_SEGMENTS = 32, 8

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
    placed = [place_capsules(run.scene, position, time) for position, time in pairs]
    if not placed[0]:
        return
    metal = {"baseColorFactor": [0.6, 0.6, 0.62, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.5}
    document["materials"].append({"name": "instrument", "pbrMetallicRoughness": metal})
    names = [f"probes.{index}" for index, probe in enumerate(run.scene.probes) if probe.instrument is not None]
    for name, *capsules in zip(names, *placed, strict=True):
        vertices, normals, triangles = capsule_mesh(capsules[0])
        attributes = {
            "POSITION": binary.accessor(vertices.astype(np.float32), GL_ARRAY_BUFFER, bounds=True),
            "NORMAL": binary.accessor(normals.astype(np.float32), GL_ARRAY_BUFFER),
        }
        indices = binary.accessor(triangles.reshape(-1).astype(np.uint32), GL_ELEMENT_ARRAY_BUFFER)
        primitive = {"attributes": attributes, "indices": indices, "material": len(document["materials"]) - 1}
        document["meshes"].append({"name": name, "primitives": [primitive]})
        tips = np.array([capsule.tip for capsule in capsules])
        _add_node(document, {"name": name, "mesh": len(document["meshes"]) - 1}, {"translation": tips}, run, binary)


def capsule_mesh(capsule: Capsule) -> tuple[Array, Array, NDArray[np.int32]]:
    """Triangulate a capsule around the origin in place of its tip.

    Returns:
        Vertices [m] and unit normals, shape (vertices, 3); triangles, counter-clockwise from outside, shape (n, 3).
    """
    axis = capsule.axis
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    around = np.linspace(0, 2 * np.pi, SEGMENTS + 1)
    radial = np.cos(around)[:, None] * across + np.sin(around)[:, None] * np.cross(axis, across)
    # From the far pole to the pole of the tip.
    latitude = np.linspace(np.pi / 2, 0, POLE_SEGMENTS + 1)
    latitude, offset = np.concatenate([latitude, -latitude[::-1]]), np.repeat([capsule.length, 0.0], len(latitude))
    normals = np.cos(latitude)[:, None, None] * radial + np.sin(latitude)[:, None, None] * axis
    surface = refine_surface(capsule.radius * normals + offset[:, None, None] * axis, 0)
    corners = surface.vertices[surface.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    # At the poles, one triangle of each quad has no area.
    triangles: NDArray[np.int32] = surface.triangles[area > 1e-9 * area.max()]
    return surface.vertices.astype(np.float64), normals.reshape(-1, 3), triangles


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
