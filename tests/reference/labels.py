"""The reference for labels: every point is tested against every triangle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Solid
from taichi_msm.render.camera import view
from taichi_msm.scene.scene import Scene
from tests.reference.drawing import look, refine, triangles, weights
from tests.reference.lens import distort
from tests.reference.shading import meet

Array = NDArray[np.float64]

# Whatever is in front of a point by less than this fraction of the sheet's larger side counts as the point's own place.
TOUCHING = 1e-9


def labels(scene: Scene, position: Array, rods: Sequence[Solid] = ()) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Find at each pixel's centre the material point (NaN: none), depth [m] (0: nothing), and whether a rod is seen."""
    seen = look(scene, position)
    depth, _ = meet(rods, view(scene), scene.render.size, 1)
    nearer = depth < seen.depth
    coordinates = np.where(nearer[..., None], np.nan, np.stack([seen.u, seen.v], axis=-1))
    depth = np.minimum(depth, seen.depth)
    return coordinates, np.where(np.isfinite(depth), depth, 0), nearer


def normals(scene: Scene, position: Array, rods: Sequence[Solid] = ()) -> Array:
    """Give the unit normal of what each pixel shows at its centre, toward the camera; arguments as for `labels`.

    It is in OpenCV's axes of the camera, shape (height, width, 3); NaN where nothing is seen.
    """
    camera, seen = view(scene), look(scene, position)
    depth, outward = meet(rods, camera, scene.render.size, 1)
    normal = np.where((depth < seen.depth)[..., None], outward, seen.facet * seen.front[..., None])
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True) @ (camera.axes.T * [1, -1, -1])


def find(scene: Scene, coordinates: Array, position: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Find where material points are seen, and whether the sheet hides them or they are outside the picture.

    Coordinates are fractions of the sheet's width from its left and of its height from its top, shape (n, 2); pixels,
    shape (n, 2), are NaN behind the eye.
    """
    camera, (width, height) = view(scene), scene.render.size
    points = np.concatenate([position, np.ones((*position.shape[:2], 1))], axis=-1) @ camera.matrix.T
    surface = refine(points, scene.render.refine)
    found = between(surface, coordinates)
    with np.errstate(divide="ignore", invalid="ignore"):
        places = np.where(found[:, 2:3] > camera.near, found[:, :2] / found[:, 2:3], np.nan)
    x, y = places.T
    pixels = places
    if camera.lens is not None:
        across, along = ((places - camera.centre) / camera.scale).T
        pixels = np.stack(distort(camera, across, along), axis=-1) * camera.scale + camera.centre
        pixels[~(np.hypot(across, along) < camera.lens.limit)] = np.nan
    hidden: NDArray[np.bool_] = np.logical_not(((pixels >= 0) & (pixels < (width, height))).all(axis=1))
    limit = found[:, 3] - TOUCHING * max(scene.sheet.size)
    for triangle in triangles(surface):
        share = weights(triangle, x, y)
        w, depth = np.tensordot(triangle[:, 2:].T, share, 1)
        hidden |= (share >= 0).all(axis=0) & (w > camera.near) & (depth < limit)
    return pixels, hidden


def between(surface: Array, coordinates: Array) -> Array:
    """Interpolate what the vertices of a refined surface have, linear on each triangle, at some coordinates."""
    rows, cols = surface.shape[:2]
    # The vertex to the upper left of each point, and the point's place in the small quad of that vertex.
    across, down = coordinates[:, 0] * (cols - 1), coordinates[:, 1] * (rows - 1)
    j, i = (np.clip(p.astype(int), 0, count - 2) for p, count in ((across, cols), (down, rows)))
    s, t = (across - j)[:, None], (down - i)[:, None]
    upper = surface[i, j] * (1 - s) + surface[i, j + 1] * (s - t) + surface[i + 1, j + 1] * t
    lower = surface[i, j] * (1 - t) + surface[i + 1, j] * (t - s) + surface[i + 1, j + 1] * s
    return np.where(t > s, lower, upper)
