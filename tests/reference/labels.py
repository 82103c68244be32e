"""NumPy reference of ground-truth labels: every point is tested against every triangle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Solid
from taichi_msm.render.camera import view
from taichi_msm.scene.scene import Scene
from tests.reference.drawing import present, rasterise, refine, triangles, weights
from tests.reference.lens import distort
from tests.reference.shading import intersect
from tests.reference.surface import rest_positions

Array = NDArray[np.float64]

# A surface in front of a point by less than this fraction of the sheet's largest side does not hide it.
TOUCHING = 1e-9


def labels(scene: Scene, position: Array, rods: Sequence[Solid] = ()) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Compute material coordinates, depth and the instrument mask at pixel centres.

    Args:
        scene: scene with the sheet and the render settings.
        position: positions of the mass points [m], shape (rows, cols, 3).
        rods: instruments.

    Returns:
        Coordinates on the sheet, fractions of its width and height, NaN elsewhere, shape (height, width, 2); depth [m],
        0 in the background, shape (height, width); and the mask of the instruments, same shape.
    """
    sheet = rasterise(scene, position)
    depth, _ = intersect(rods, view(scene), scene.render.size, 1)
    nearer = depth < sheet.depth
    coordinates = np.where(nearer[..., None], np.nan, np.stack([sheet.u, sheet.v], axis=-1))
    depth = np.minimum(depth, sheet.depth)
    return coordinates, np.where(np.isfinite(depth), depth, 0), nearer


def normals(scene: Scene, position: Array, rods: Sequence[Solid] = ()) -> Array:
    """Return unit normals at pixel centres, toward the camera, shape (height, width, 3); NaN in the background.

    In OpenCV's camera axes: x right, y down, z forward.

    Args:
        scene: scene with the sheet and the render settings.
        position: positions of the mass points [m], shape (rows, cols, 3).
        rods: instruments.
    """
    camera, sheet = view(scene), rasterise(scene, position)
    depth, outward = intersect(rods, camera, scene.render.size, 1)
    normal = np.where((depth < sheet.depth)[..., None], outward, sheet.facet * sheet.front[..., None])
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True) @ (camera.axes.T * [1, -1, -1])


def project(scene: Scene, coordinates: Array, position: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Project material points, and test them for occlusion by the sheet.

    Args:
        scene: scene with the sheet and the render settings.
        coordinates: fractions of the sheet's width from its left and of its height from its top, shape (n, 2).
        position: positions of the mass points [m], shape (rows, cols, 3).

    Returns:
        Pixels, NaN behind the eye, shape (n, 2); and whether each point is hidden or outside the picture, shape (n,).
    """
    camera, (width, height) = view(scene), scene.render.size
    points = np.concatenate([position, np.ones((*position.shape[:2], 1))], axis=-1) @ camera.matrix.T
    surface = refine(points, scene.render.refine)
    projected = interpolate(surface, coordinates)
    with np.errstate(divide="ignore", invalid="ignore"):
        undistorted = np.where(projected[:, 2:3] > camera.near, projected[:, :2] / projected[:, 2:3], np.nan)
    x, y = undistorted.T
    pixels = undistorted
    if camera.lens is not None:
        across, along = ((undistorted - camera.centre) / camera.scale).T
        pixels = np.stack(distort(camera, across, along), axis=-1) * camera.scale + camera.centre
        pixels[~(np.hypot(across, along) < camera.lens.limit)] = np.nan
    hidden: NDArray[np.bool_] = np.logical_not(((pixels >= 0) & (pixels < (width, height))).all(axis=1))
    rest = rest_positions(scene.sheet.surface, scene.sheet.points, scene.sheet.size)
    limit = projected[:, 3] - TOUCHING * float(np.ptp(rest, axis=(0, 1)).max())
    for triangle in triangles(surface, present(scene)):
        share = weights(triangle, x, y)
        w, depth = np.tensordot(triangle[:, 2:].T, share, 1)
        hidden |= (share >= 0).all(axis=0) & (w > camera.near) & (depth < limit)
    return pixels, hidden


def interpolate(surface: Array, coordinates: Array) -> Array:
    """Return values on the surface, linear on each triangle, shape (n, k).

    Args:
        surface: values of the refined vertices, shape (rows, cols, k).
        coordinates: fractions of the sheet's width and height, shape (n, 2).
    """
    rows, cols = surface.shape[:2]
    # The vertex to the upper left of each point, and the point's fractions within that vertex's quad.
    across, down = coordinates[:, 0] * (cols - 1), coordinates[:, 1] * (rows - 1)
    j, i = (np.clip(p.astype(int), 0, count - 2) for p, count in ((across, cols), (down, rows)))
    s, t = (across - j)[:, None], (down - i)[:, None]
    upper = surface[i, j] * (1 - s) + surface[i, j + 1] * (s - t) + surface[i + 1, j + 1] * t
    lower = surface[i, j] * (1 - t) + surface[i + 1, j] * (t - s) + surface[i + 1, j + 1] * s
    return np.where(t > s, lower, upper)
