"""The picture once more: triangle by triangle, pixel by pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import style
from taichi_msm.render.camera import view
from taichi_msm.scene import Scene

Array = NDArray[np.float64]


def refine(values: Array, n: int) -> Array:
    """Insert n values between neighbours by bilinear interpolation.

    Args:
        values: values at the mass points, shape (rows, cols, k).
        n: number of new ones between two.

    Returns:
        Values at the vertices, shape ((rows - 1)(n + 1) + 1, (cols - 1)(n + 1) + 1, k).
    """
    for axis in (0, 1):
        count = values.shape[axis]
        place = np.arange((count - 1) * (n + 1) + 1) / (n + 1)
        low = np.minimum(place.astype(int), count - 2)
        share = (place - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        values = np.take(values, low, axis) * (1 - share) + np.take(values, low + 1, axis) * share
    return values


def normals(position: Array) -> Array:
    """Give unit normals from central differences, one-sided ones at the edges.

    Args:
        position: positions [m], shape (rows, cols, 3).

    Returns:
        Unit normals, toward the viewer at rest, shape (rows, cols, 3).
    """
    right = np.gradient(position, axis=1)
    up = -np.gradient(position, axis=0)
    normal = np.cross(right, up)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)


def headlight(normal: Array, u: Array, v: Array, toward: Array) -> Array:
    """Give the cosine between the direction of the light and the normal, interpolated bilinearly between mass points.

    Args:
        normal: unit normals of the mass points, shape (rows, cols, 3).
        u: 0 at the left edge to 1 at the right one, any shape.
        v: 0 at the top edge to 1 at the bottom one, the same shape.
        toward: unit vector toward the light, shape (3,).

    Returns:
        Share of the colour that is seen, 0 to 1, the shape of u.
    """
    place = [v * (normal.shape[0] - 1), u * (normal.shape[1] - 1)]
    i, j = (np.clip(np.floor(p).astype(int), 0, count - 2) for p, count in zip(place, normal.shape, strict=False))
    s, t = (place[1] - j)[..., None], (place[0] - i)[..., None]
    upper = normal[i, j] * (1 - s) + normal[i, j + 1] * s
    lower = normal[i + 1, j] * (1 - s) + normal[i + 1, j + 1] * s
    here = upper * (1 - t) + lower * t
    return np.asarray(np.abs(here @ toward) / np.maximum(np.linalg.norm(here, axis=-1), 1e-30))


def sample(texture: NDArray[np.uint8], u: Array, v: Array) -> Array:
    """Filter the texture bilinearly, clamped at its edge; texel (a, b) has its centre at ((a + 1/2)/w, (b + 1/2)/h).

    Args:
        texture: colours, shape (height, width, 3).
        u: 0 at the left edge to 1 at the right one, any shape.
        v: 0 at the top edge to 1 at the bottom one, the same shape.

    Returns:
        Colours 0 to 255, shape (*u.shape, 3).
    """
    height, width, _ = texture.shape
    x, y = u * width - 0.5, v * height - 0.5
    a, b = np.floor(x).astype(int), np.floor(y).astype(int)

    def texel(a: NDArray[np.int_], b: NDArray[np.int_]) -> Array:
        return texture[np.clip(b, 0, height - 1), np.clip(a, 0, width - 1)].astype(float)

    across, down = (x - a)[..., None], (y - b)[..., None]
    upper = texel(a, b) * (1 - across) + texel(a + 1, b) * across
    lower = texel(a, b + 1) * (1 - across) + texel(a + 1, b + 1) * across
    return upper * (1 - down) + lower * down


def weights(triangle: Array, x: Array, y: Array) -> Array:
    """Give the share of each corner in the point of a triangle that is seen at a pixel; perspective-correct.

    With p the pixel and (X, Y, w) the corners, the point sum b_i (X, Y, w)_i is at p where
    sum b_i ((X, Y)_i - p w_i) = 0, so b_i is the cross product of the other two such differences.

    Args:
        triangle: corners (X, Y, w, ...), shape (3, k).
        x: pixel, right [px], any shape.
        y: pixel, down [px], the same shape.

    Returns:
        Weights of sum 1, shape (3, *x.shape); all are 0 or more inside, NaN where the triangle is seen edge-on.
    """
    dx = [corner[0] - x * corner[2] for corner in triangle]
    dy = [corner[1] - y * corner[2] for corner in triangle]
    cross = np.array([dx[i - 2] * dy[i - 1] - dx[i - 1] * dy[i - 2] for i in range(3)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(cross / cross.sum(axis=0))


def wire_share(scene: Scene, triangle: Array, x: Array, y: Array) -> Array:
    """Give the share of the mesh lines in the colour of the pixels of a triangle.

    Args:
        scene: the scene.
        triangle: corners (X, Y, w, depth, u, v, ...), shape (3, k).
        x: pixel, right [px of the supersampled picture], any shape.
        y: pixel, down, the same shape.

    Returns:
        Share 0 to 1, the shape of x.
    """
    rows, cols = scene.sheet.points

    def mesh(x: Array, y: Array) -> Array:
        u, v = np.tensordot(triangle[:, 4:6].T, weights(triangle, x, y), 1)
        return np.array([u * (cols - 1), v * (rows - 1)])

    here = mesh(x, y)
    slope = np.hypot(mesh(x + 1, y) - here, mesh(x, y + 1) - here)
    distance = np.abs(here - np.round(here)) / np.maximum(slope, 1e-12)
    half = style.WIRE_WIDTH / 2 * scene.render.supersample
    return np.asarray(style.WIRE_OPACITY * np.clip(half + 0.5 - distance.min(axis=0), 0, 1))


def draw(scene: Scene, position: Array, texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Draw one frame: refine, project, and of every pixel keep the nearest triangle.

    Args:
        scene: the scene.
        position: positions of the mass points [m], shape (rows, cols, 3).
        texture: the picture on the sheet, shape (height, width, 3).

    Returns:
        Colours, shape (height, width, 3).
    """
    rows, cols = scene.sheet.points
    factor = scene.render.supersample
    width, height = (size * factor for size in scene.render.size)
    camera = view(scene)
    matrix = camera.matrix * np.array([[factor], [factor], [1], [1]])

    projected = np.concatenate([position, np.ones((rows, cols, 1))], axis=-1) @ matrix.T
    u, v = np.meshgrid(np.arange(cols) / (cols - 1), np.arange(rows) / (rows - 1))
    surface = refine(np.concatenate([projected, u[..., None], v[..., None]], axis=-1), scene.render.refine)
    normal = normals(position)

    colour = np.empty((height, width, 3))
    colour[:] = scene.render.background
    nearest = np.full((height, width), np.inf)
    for r, c in np.ndindex(surface.shape[0] - 1, surface.shape[1] - 1):
        corners = surface[r, c], surface[r + 1, c], surface[r + 1, c + 1], surface[r, c + 1]
        for triangle in (np.array(corners[:3]), np.array([corners[0], *corners[2:]])):
            if (triangle[:, 2] > camera.near).all():
                corner = triangle[:, :2] / triangle[:, 2:3] - 0.5
                left, top = np.maximum(np.floor(corner.min(axis=0)), 0).astype(int)
                right, bottom = np.minimum(np.ceil(corner.max(axis=0)), [width - 1, height - 1]).astype(int)
            else:
                left, top, right, bottom = 0, 0, width - 1, height - 1
            if right < left or bottom < top:
                continue
            box = np.s_[top : bottom + 1, left : right + 1]
            y, x = np.mgrid[box].astype(float) + 0.5
            share = weights(triangle, x, y)
            w, depth, u, v = np.tensordot(triangle[:, 2:].T, share, 1)
            seen = (share >= -1e-12).all(axis=0) & (w > camera.near) & (depth < nearest[box])
            nearest[box][seen] = depth[seen]
            u, v = np.where(seen, u, 0), np.where(seen, v, 0)
            lit = sample(texture, u, v)
            if scene.render.shading == "headlight":
                lit *= headlight(normal, u, v, camera.toward)[..., None]
            if scene.render.wireframe:
                wire = wire_share(scene, triangle, x, y)[..., None]
                lit = lit * (1 - wire) + np.array(style.WIRE_COLOUR) * wire
            colour[box][seen] = lit[seen]
    colour = colour.reshape(height // factor, factor, width // factor, factor, 3).mean(axis=(1, 3))
    return np.floor(colour + 0.5).astype(np.uint8)
