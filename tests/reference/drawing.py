"""The reference for the picture, drawn triangle by triangle and pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Solid
from taichi_msm.render import uniforms
from taichi_msm.render.camera import View, view
from taichi_msm.scene.scene import Scene
from tests.reference.lens import undistorted
from tests.reference.shading import headlight, meet, metal, normals, normals_at, sample, tissue

Array = NDArray[np.float64]
Sampled = Callable[[float, float], tuple[Array, Array]]


def refine(values: Array, n: int) -> Array:
    """Insert n values between neighbours by bilinear interpolation; the last axis of the array is of one place."""
    for axis in (0, 1):
        count = values.shape[axis]
        place = np.arange((count - 1) * (n + 1) + 1) / (n + 1)
        low = np.minimum(place.astype(int), count - 2)
        share = (place - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        values = np.take(values, low, axis) * (1 - share) + np.take(values, low + 1, axis) * share
    return values


def weights(triangle: Array, x: Array, y: Array) -> Array:
    """Give the barycentric weights of the point of a triangle that is seen at a pixel, corrected for perspective.

    With p the pixel and (X, Y, w, ...) the corners, shape (3, k), the point sum b_i (X, Y, w)_i is seen at p if
    sum b_i ((X, Y)_i - p w_i) = 0, so b_i is the cross product of the other two such differences. Inside, all are 0 or
    more; where the triangle is seen edge-on, they are NaN. Shape (3, *x.shape).
    """
    dx = [corner[0] - x * corner[2] for corner in triangle]
    dy = [corner[1] - y * corner[2] for corner in triangle]
    cross = np.array([dx[i - 2] * dy[i - 1] - dx[i - 1] * dy[i - 2] for i in range(3)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(cross / cross.sum(axis=0))


def wire_share(scene: Scene, triangle: Array, at: Sampled) -> Array:
    """Give the share of the mesh lines in the colour of a triangle's pixels; corners (X, Y, w, depth, u, v, ...)."""
    rows, cols = scene.sheet.points

    def mesh(x: Array, y: Array) -> Array:
        u, v = np.tensordot(triangle[:, 4:6].T, weights(triangle, x, y), 1)
        return np.array([u * (cols - 1), v * (rows - 1)])

    here, (x, y) = mesh(*at(0, 0)), at(0, 0)
    # A lens bends the way to the next pixel, which is taken as straight.
    right, below = (
        [middle + (far - near) / 2e-3 for middle, far, near in zip((x, y), at(*way), at(*back), strict=True)]
        for way, back in (((1e-3, 0), (-1e-3, 0)), ((0, 1e-3), (0, -1e-3)))
    )
    slope = np.hypot(mesh(*right) - here, mesh(*below) - here)
    distance = np.abs(here - np.round(here)) / np.maximum(slope, 1e-12)
    half = uniforms.WIRE_WIDTH / 2 * scene.render.supersample
    return np.asarray(uniforms.WIRE_OPACITY * np.clip(half + 0.5 - distance.min(axis=0), 0, 1))


class Seen(NamedTuple):
    """What the samples of a picture show; each array has the shape (height, width), counted in samples."""

    depth: Array  # along the direction of view [m]; infinite where nothing is
    # u, v: the material point, fractions of the sheet's width and height from its upper left; NaN where none is
    u: Array
    v: Array
    wire: Array  # share of the mesh lines in the colour
    footprint: Array  # larger side of a sample on the texture, in units of uniforms.FULL_RESOLUTION_TEXELS
    front: Array  # 1 where the front of the triangle is seen, else -1
    facet: Array  # normal of the triangle's front in the world [m^2], shape (height, width, 3); NaN where none is


def look(
    scene: Scene, position: Array, factor: int = 1, texels: tuple[int, int] = (1, 1), camera: View | None = None
) -> Seen:
    """Find what every sample shows, `factor` a pixel and axis: refine, project, and keep the nearest triangle."""
    rows, cols = scene.sheet.points
    width, height = (size * factor for size in scene.render.size)
    camera = camera or view(scene)
    matrix = camera.matrix * np.array([[factor], [factor], [1], [1]])
    projected = np.concatenate([position, np.ones((rows, cols, 1))], axis=-1) @ matrix.T
    u, v = np.meshgrid(np.arange(cols) / (cols - 1), np.arange(rows) / (rows - 1))
    surface = refine(np.concatenate([projected, u[..., None], v[..., None], position], axis=-1), scene.render.refine)

    @cache
    def places(right: float, down: float) -> tuple[Array, Array]:
        y, x = np.mgrid[:height, :width] + 0.5
        x, y = undistorted(camera, (x + right) / factor, (y + down) / factor)
        return x * factor, y * factor

    nothing = (np.inf, np.nan, np.nan, 0.0, 0.0, 1.0, [np.nan] * 3)
    seen = Seen(*(np.full((height, width, *np.shape(value)), value) for value in nothing))
    for triangle in triangles(surface):
        left, top, right, bottom = 0, 0, width - 1, height - 1
        if (triangle[:, 2] > camera.near).all():
            corner = triangle[:, :2] / triangle[:, 2:3]
            x, y = places(0, 0)
            low, high = corner.min(axis=0) - 1, corner.max(axis=0) + 1
            near = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
            if not near.any():
                continue
            (top, bottom), (left, right) = (np.flatnonzero(near.any(axis=axis))[[0, -1]] for axis in (1, 0))
        box = np.s_[top : bottom + 1, left : right + 1]

        def at(right: float, down: float, box: tuple[slice, slice] = box) -> tuple[Array, Array]:
            x, y = places(right, down)
            return x[box], y[box]

        x, y = at(0, 0)
        share = weights(triangle, x, y)
        w, depth, u, v = np.tensordot(triangle[:, 2:6].T, share, 1)
        here = (share >= -1e-12).all(axis=0) & (w > camera.near) & (depth < seen.depth[box])
        wire = wire_share(scene, triangle, at) if scene.render.wireframe else np.zeros_like(x)
        # From the upper left the corners go down and around: counter-clockwise where the front is seen.
        front = np.full_like(x, -np.sign(np.linalg.det(triangle[:, :3])))
        facet = np.broadcast_to(np.cross(*np.diff(triangle[:, 6:], axis=0)), (*x.shape, 3))
        found = Seen(depth, u, v, wire, footprint(triangle, at, texels), front, facet)
        for kept, new in zip(seen, found, strict=True):
            kept[box][here] = new[here]
    return seen


def triangles(surface: Array) -> Iterator[Array]:
    """List the triangles of refined vertices, shape (rows, cols, k); each triangle has the shape (3, k)."""
    for r, c in np.ndindex(surface.shape[0] - 1, surface.shape[1] - 1):
        corners = surface[r, c], surface[r + 1, c], surface[r + 1, c + 1], surface[r, c + 1]
        yield np.array(corners[:3])
        yield np.array([corners[0], *corners[2:]])


def footprint(triangle: Array, at: Sampled, texels: tuple[int, int]) -> Array:
    """Give the larger of a sample's width and height on the texture, in units of uniforms.FULL_RESOLUTION_TEXELS.

    It is found by finite differences over a thousandth of a sample; corners as for `wire_share`.
    """
    step = 1e-3

    def place(x: Array, y: Array) -> Array:
        u, v = np.tensordot(triangle[:, 4:6].T, weights(triangle, x, y), 1)
        return np.array([u * texels[0], v * texels[1]])

    right = place(*at(step, 0)) - place(*at(-step, 0))
    down = place(*at(0, step)) - place(*at(0, -step))
    return np.asarray(np.maximum(np.hypot(*right), np.hypot(*down)) / (2 * step * uniforms.FULL_RESOLUTION_TEXELS))


def draw(
    scene: Scene, position: Array, texture: NDArray[np.uint8], rods: Sequence[Solid] = (), camera: View | None = None
) -> NDArray[np.uint8]:
    """Draw one frame of positions, shape (rows, cols, 3), a picture, shape (height, width, 3), and instruments."""
    factor, camera = scene.render.supersample, camera or view(scene)
    seen = look(scene, position, factor, (texture.shape[1], texture.shape[0]), camera)
    sheet = np.isfinite(seen.depth)
    u, v = np.where(sheet, seen.u, 0), np.where(sheet, seen.v, 0)
    normal = normals_at(normals(position), u, v) * seen.front[..., None]
    if scene.render.shading == "tissue":
        lit = tissue(scene, camera, texture, normal, seen.depth, (u, v, seen.footprint), rods)
    else:
        lit = sample(texture, u, v)
    if scene.render.shading == "headlight":
        lit *= headlight(normal, (camera.light_view or camera).axes[2])[..., None]
    wire = seen.wire[..., None]
    lit = lit * (1 - wire) + np.array(uniforms.WIRE_COLOUR) * wire
    colour = np.where(sheet[..., None], lit, np.array(scene.render.background, float))
    depth, outward = meet(rods, camera, scene.render.size, factor)
    nearer = depth < seen.depth
    colour[nearer] = metal(camera, factor, depth, outward)[nearer]
    height, width = (size // factor for size in seen.depth.shape)
    colour = colour.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))
    return np.floor(colour + 0.5).astype(np.uint8)
