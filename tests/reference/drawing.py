"""NumPy reference of the picture: rasterised triangle by triangle, with float64 samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.cameras.view import View
from taichi_msm.model.surface import Solid
from taichi_msm.render import uniforms
from taichi_msm.render.camera import view
from taichi_msm.scene.scene import Scene
from tests.reference.lens import undistorted
from tests.reference.shading import headlight, intersect, metal, normals, normals_at, sample, tissue

Array = NDArray[np.float64]

# From an offset to the right and down [samples] to the undistorted x and y of all samples [samples].
Samples = Callable[[float, float], tuple[Array, Array]]


def refine(values: Array, n: int) -> Array:
    """Return a grid with n bilinear values between neighbours, shape ((rows - 1) (n + 1) + 1, ..., k).

    Args:
        values: grid, shape (rows, cols, k).
        n: number of values to insert, `render.refine`.
    """
    for axis in (0, 1):
        count = values.shape[axis]
        index = np.arange((count - 1) * (n + 1) + 1) / (n + 1)
        low = np.minimum(index.astype(int), count - 2)
        share = (index - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        values = np.take(values, low, axis) * (1 - share) + np.take(values, low + 1, axis) * share
    return values


def weights(triangle: Array, x: Array, y: Array) -> Array:
    """Return perspective-correct barycentric weights of samples, shape (3, *x.shape).

    The point sum b_i (X, Y, w)_i projects to p = (x, y) if sum b_i ((X, Y)_i - p w_i) = 0, so b_i is the cross product
    of the other two such differences. Inside the triangle all are 0 or more; of an edge-on triangle they are NaN.

    Args:
        triangle: corners (X, Y, w, ...), homogeneous, shape (3, k).
        x: x of the samples, from the left.
        y: y of the samples, from the top, same shape.
    """
    dx = [corner[0] - x * corner[2] for corner in triangle]
    dy = [corner[1] - y * corner[2] for corner in triangle]
    cross = np.array([dx[i - 2] * dy[i - 1] - dx[i - 1] * dy[i - 2] for i in range(3)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(cross / cross.sum(axis=0))


def _wire_share(scene: Scene, triangle: Array, at: Samples) -> Array:
    """Return the share of the mesh lines in the colour of a triangle's samples; corners (X, Y, w, depth, u, v, ...)."""
    rows, cols = scene.sheet.points

    def mesh(x: Array, y: Array) -> Array:
        u, v = np.tensordot(triangle[:, 4:6].T, weights(triangle, x, y), 1)
        return np.array([u * (cols - 1), v * (rows - 1)])

    cell, (x, y) = mesh(*at(0, 0)), at(0, 0)
    # Derivatives at the sample: a lens bends the line to the next sample, which is taken as straight.
    right, below = (
        [middle + (ahead - behind) / 2e-3 for middle, ahead, behind in zip((x, y), at(*plus), at(*minus), strict=True)]
        for plus, minus in (((1e-3, 0), (-1e-3, 0)), ((0, 1e-3), (0, -1e-3)))
    )
    slope = np.hypot(mesh(*right) - cell, mesh(*below) - cell)
    distance = np.abs(cell - np.round(cell)) / np.maximum(slope, 1e-12)
    half = uniforms.WIRE_WIDTH / 2 * scene.render.supersample
    return np.asarray(uniforms.WIRE_OPACITY * np.clip(half + 0.5 - distance.min(axis=0), 0, 1))


class GBuffer(NamedTuple):
    """Data of the visible surface at every sample; arrays of shape (height, width) in samples."""

    depth: Array  # along the direction of view [m]; infinite in the background
    # u, v: the material point, fractions of the sheet's width and height from its upper left; NaN in the background
    u: Array
    v: Array
    wire: Array  # share of the mesh lines in the colour
    footprint: Array  # larger side of a sample on the texture, in units of uniforms.FULL_RESOLUTION_TEXELS
    front: Array  # 1 where the front of the triangle is visible, else -1
    facet: Array  # normal of the triangle's front in the world [m^2], shape (height, width, 3); NaN in the background


def rasterise(
    scene: Scene, position: Array, factor: int = 1, texels: tuple[int, int] = (1, 1), camera: View | None = None
) -> GBuffer:
    """Rasterise the sheet, without instruments: refine, project, and keep the nearest triangle of every sample.

    Args:
        scene: scene with the sheet and the render settings.
        position: positions of the mass points [m], shape (rows, cols, 3).
        factor: samples per pixel and axis.
        texels: width and height of the texture, for the footprint.
        camera: view to draw from; that of the scene at time 0 by default.

    Returns:
        The G-buffer, of `factor` times the picture's size.
    """
    rows, cols = scene.sheet.points
    width, height = (size * factor for size in scene.render.size)
    camera = camera or view(scene)
    matrix = camera.matrix * np.array([[factor], [factor], [1], [1]])
    projected = np.concatenate([position, np.ones((rows, cols, 1))], axis=-1) @ matrix.T
    u, v = np.meshgrid(np.arange(cols) / (cols - 1), np.arange(rows) / (rows - 1))
    surface = refine(np.concatenate([projected, u[..., None], v[..., None], position], axis=-1), scene.render.refine)

    @cache
    def samples(right: float, down: float) -> tuple[Array, Array]:
        y, x = np.mgrid[:height, :width] + 0.5
        x, y = undistorted(camera, (x + right) / factor, (y + down) / factor)
        return x * factor, y * factor

    background = (np.inf, np.nan, np.nan, 0.0, 0.0, 1.0, [np.nan] * 3)
    buffer = GBuffer(*(np.full((height, width, *np.shape(value)), value) for value in background))
    for triangle in triangles(surface, present(scene)):
        left, top, right, bottom = 0, 0, width - 1, height - 1
        if (triangle[:, 2] > camera.near).all():
            corner = triangle[:, :2] / triangle[:, 2:3]
            x, y = samples(0, 0)
            low, high = corner.min(axis=0) - 1, corner.max(axis=0) + 1
            near = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
            if not near.any():
                continue
            (top, bottom), (left, right) = (np.flatnonzero(near.any(axis=axis))[[0, -1]] for axis in (1, 0))
        box = np.s_[top : bottom + 1, left : right + 1]

        def at(right: float, down: float, box: tuple[slice, slice] = box) -> tuple[Array, Array]:
            x, y = samples(right, down)
            return x[box], y[box]

        x, y = at(0, 0)
        share = weights(triangle, x, y)
        w, depth, u, v = np.tensordot(triangle[:, 2:6].T, share, 1)
        nearest = (share >= -1e-12).all(axis=0) & (w > camera.near) & (depth < buffer.depth[box])
        wire = _wire_share(scene, triangle, at) if scene.render.wireframe else np.zeros_like(x)
        # From the upper left the corners go down and around: counter-clockwise where the front is visible.
        front = np.full_like(x, -np.sign(np.linalg.det(triangle[:, :3])))
        facet = np.broadcast_to(np.cross(*np.diff(triangle[:, 6:], axis=0)), (*x.shape, 3))
        layer = GBuffer(depth, u, v, wire, _footprint(triangle, at, texels), front, facet)
        for kept, new in zip(buffer, layer, strict=True):
            kept[box][nearest] = new[nearest]
    return buffer


def present(scene: Scene) -> NDArray[np.bool_]:
    """Return whether each cell is sheet, by the pixel of the mask at its middle, shape (rows - 1, cols - 1)."""
    rows, cols = (count - 1 for count in scene.sheet.points)
    cells = np.ones((rows, cols), bool)
    if (mask := scene.sheet.mask) is not None:
        picture = np.array(Image.open(mask.image).convert("L"))
        for i, j in np.ndindex(rows, cols):
            pixel = picture[int((i + 0.5) / rows * picture.shape[0]), int((j + 0.5) / cols * picture.shape[1])]
            cells[i, j] = (pixel >= 128) != mask.invert
    return cells


def triangles(surface: Array, cells: NDArray[np.bool_]) -> Iterator[Array]:
    """Yield the triangles of the cells that are sheet; each triangle has the shape (3, k).

    Args:
        surface: refined vertices, shape (rows, cols, k).
        cells: whether each cell is sheet, shape of the cells before the refinement.
    """
    n = (surface.shape[0] - 1) // cells.shape[0]
    for r, c in np.argwhere(cells.repeat(n, axis=0).repeat(n, axis=1)):
        corners = surface[r, c], surface[r + 1, c], surface[r + 1, c + 1], surface[r, c + 1]
        yield np.array(corners[:3])
        yield np.array([corners[0], *corners[2:]])


def _footprint(triangle: Array, at: Samples, texels: tuple[int, int]) -> Array:
    """Return the larger side of a sample on the texture, in units of uniforms.FULL_RESOLUTION_TEXELS.

    By finite differences over a thousandth of a sample.
    """
    step = 1e-3

    def texel(x: Array, y: Array) -> Array:
        u, v = np.tensordot(triangle[:, 4:6].T, weights(triangle, x, y), 1)
        return np.array([u * texels[0], v * texels[1]])

    right = texel(*at(step, 0)) - texel(*at(-step, 0))
    down = texel(*at(0, step)) - texel(*at(0, -step))
    return np.asarray(np.maximum(np.hypot(*right), np.hypot(*down)) / (2 * step * uniforms.FULL_RESOLUTION_TEXELS))


def draw(
    scene: Scene, position: Array, texture: NDArray[np.uint8], rods: Sequence[Solid] = (), camera: View | None = None
) -> NDArray[np.uint8]:
    """Return the picture of one frame, shape (height, width, 3).

    Args:
        scene: scene with the sheet and the render settings.
        position: positions of the mass points [m], shape (rows, cols, 3).
        texture: picture on the sheet, shape (height, width, 3).
        rods: instruments.
        camera: view to draw from; that of the scene at time 0 by default.
    """
    factor, camera = scene.render.supersample, camera or view(scene)
    buffer = rasterise(scene, position, factor, (texture.shape[1], texture.shape[0]), camera)
    sheet = np.isfinite(buffer.depth)
    u, v = np.where(sheet, buffer.u, 0), np.where(sheet, buffer.v, 0)
    normal = normals_at(normals(position, present(scene)), u, v) * buffer.front[..., None]
    if scene.render.shading == "tissue":
        lit = tissue(scene, camera, texture, normal, buffer.depth, (u, v, buffer.footprint), rods)
    else:
        lit = sample(texture, u, v)
    if scene.render.shading == "headlight":
        lit *= headlight(normal, (camera.light_view or camera).axes[2])[..., None]
    wire = buffer.wire[..., None]
    lit = lit * (1 - wire) + np.array(uniforms.WIRE_COLOUR) * wire
    colour = np.where(sheet[..., None], lit, np.array(scene.render.background, float))
    depth, outward = intersect(rods, camera, scene.render.size, factor)
    nearer = depth < buffer.depth
    colour[nearer] = metal(camera, factor, depth, outward)[nearer]
    height, width = (size // factor for size in buffer.depth.shape)
    colour = colour.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))
    return np.floor(colour + 0.5).astype(np.uint8)
