"""NumPy reference of the picture's colours: texture filtering, and the light on tissue and on metal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.view import View
from taichi_msm.model.surface import Solid
from taichi_msm.render import uniforms
from taichi_msm.scene.scene import Scene
from tests.reference.lens import undistorted

Array = NDArray[np.float64]


def _slope(position: Array, cells: NDArray[np.bool_]) -> Array:
    """Return the mean step to the neighbours in the same row, of sides of cells that are sheet, else 0."""
    step = np.diff(position, axis=1)
    is_side = np.pad(cells, ((1, 1), (0, 0)))
    step = np.pad(step * (is_side[1:] | is_side[:-1])[..., None], ((0, 0), (1, 1), (0, 0)))
    count = np.pad(is_side[1:] | is_side[:-1], ((0, 0), (1, 1))).astype(int)
    return np.asarray((step[:, 1:] + step[:, :-1]) / np.maximum(count[:, 1:] + count[:, :-1], 1)[..., None])


def normals(position: Array, cells: NDArray[np.bool_]) -> Array:
    """Return unit normals of mass points, toward +z at rest, shape (rows, cols, 3), from central differences.

    Args:
        position: positions of the mass points [m], shape (rows, cols, 3).
        cells: whether each cell is sheet, shape (rows - 1, cols - 1).
    """
    right = _slope(position, cells)
    up = -_slope(position.swapaxes(0, 1), cells.T).swapaxes(0, 1)
    normal = np.cross(right, up)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)


def normals_at(normal: Array, u: Array, v: Array) -> Array:
    """Return normals, bilinear between mass points and of any length, shape (*u.shape, 3).

    Args:
        normal: normals of the mass points, shape (rows, cols, 3).
        u: fraction of the sheet's width, from its left.
        v: fraction of the sheet's height, from its top, same shape.
    """
    index = [v * (normal.shape[0] - 1), u * (normal.shape[1] - 1)]
    i, j = (np.clip(np.floor(x).astype(int), 0, count - 2) for x, count in zip(index, normal.shape, strict=False))
    s, t = (index[1] - j)[..., None], (index[0] - i)[..., None]
    upper = normal[i, j] * (1 - s) + normal[i, j + 1] * s
    lower = normal[i + 1, j] * (1 - s) + normal[i + 1, j + 1] * s
    return upper * (1 - t) + lower * t


def headlight(normal: Array, toward: Array) -> Array:
    """Return the cosine between the unit vector `toward` the light and normals of any length, 0 to 1.

    Args:
        normal: normals, shape (..., 3).
        toward: unit vector toward the light, shape (3,).
    """
    return np.asarray(np.abs(normal @ toward) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-30))


def sample(texture: NDArray[np.uint8], u: Array, v: Array) -> Array:
    """Return colours of a texture, bilinear and clamped at its edge, 0 to 255, shape (*u.shape, 3).

    Args:
        texture: colours, shape (height, width, 3); texel (a, b) has its centre at ((a + 1/2)/width, (b + 1/2)/height).
        u: fraction of the width, from the left.
        v: fraction of the height, from the top, same shape.
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


def _halved(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Halve a texture: each texel is the rounded mean of 2 x 2; beyond an edge, the texels at the edge are repeated."""
    rows, cols = (np.minimum(np.arange(size + size % 2), size - 1) for size in texture.shape[:2])
    even = texture[rows][:, cols].astype(float)
    mean = (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / 4
    return np.floor(mean + 0.5).astype(np.uint8)


def minified(texture: NDArray[np.uint8], u: Array, v: Array, footprint: Array) -> tuple[Array, Array]:
    """Filter a texture trilinearly (mipmap) for samples that each cover many texels.

    Args:
        texture: colours, shape (height, width, 3).
        u: fraction of the width, as for `sample`.
        v: fraction of the height.
        footprint: larger of a sample's width and height, in units of uniforms.FULL_RESOLUTION_TEXELS, same shape.

    Returns:
        Colours, shape (*u.shape, 3), and the gradient of the grey to the right and down [grey / texel], shape
        (*u.shape, 2).
    """
    levels = [texture]
    while levels[-1].shape[:2] != (1, 1):
        levels.append(_halved(levels[-1]))
    lower = np.floor(np.log2(np.maximum(footprint, 1))).astype(int)
    share = np.clip(footprint / 2.0**lower - 1, 0, 1)[..., None]
    height, width, _ = texture.shape
    # Every level is filtered for all samples; a texel of a halved level begins where its first half does.
    colours, rises = [], []
    for n, level in enumerate(levels):
        across, down = u * width / 2**n / level.shape[1], v * height / 2**n / level.shape[0]
        colours.append(sample(level, across, down))
        rises.append(_grey_gradient(level, across, down) / 2**n)
    last = len(levels) - 1
    filtered = []
    for values in (np.array(colours), np.array(rises)):
        fine, coarse = (
            np.take_along_axis(values, np.minimum(lower + more, last)[None, ..., None], axis=0)[0] for more in (0, 1)
        )
        filtered.append(fine + (coarse - fine) * share)
    return filtered[0], filtered[1]


def _grey_gradient(texture: NDArray[np.uint8], u: Array, v: Array) -> Array:
    """Differentiate the bilinear grey of a texture to the right and down [grey / texel], shape (*u.shape, 2)."""
    height, width, _ = texture.shape
    x, y = np.clip(u * width - 0.5, 0, width - 1), np.clip(v * height - 0.5, 0, height - 1)
    a, b = np.floor(x).astype(int), np.floor(y).astype(int)
    grey = texture.mean(axis=-1)
    right, below = np.minimum(a + 1, width - 1), np.minimum(b + 1, height - 1)
    to_right = (grey[b, right] - grey[b, a]) * (1 - y + b) + (grey[below, right] - grey[below, a]) * (y - b)
    down = (grey[below, a] - grey[b, a]) * (1 - x + a) + (grey[below, right] - grey[b, right]) * (x - a)
    return np.stack([to_right, down], axis=-1)


def _unit(vector: Array) -> Array:
    """Scale vectors to length 1, shape (..., 3)."""
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-30))


def points(camera: View, factor: int, depth: Array) -> Array:
    """Return the points in space that samples show [m], shape (height, width, 3).

    Args:
        camera: view to draw from.
        factor: samples per pixel and axis.
        depth: depth along the direction of view [m], shape (height, width) in samples; infinite where there is nothing,
            and the returned values are meaningless.
    """
    right, up, toward = camera.axes
    y, x = (np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5) / factor
    x, y = undistorted(camera, x, y)
    depth = np.where(np.isfinite(depth), depth, camera.distance)
    w = (depth if camera.pinhole else np.ones_like(depth))[..., None]
    across = ((x - camera.centre[0]) / camera.scale[0])[..., None] * right
    along = ((camera.centre[1] - y) / camera.scale[1])[..., None] * up
    return np.asarray(camera.eye + (across + along) * w - depth[..., None] * toward)


def illuminate(camera: View, factor: int, depth: Array, normal: Array) -> tuple[Array, Array, Array, Array]:
    """Compute the vectors of the lighting model.

    Args:
        camera: view to draw from.
        factor: samples per pixel and axis.
        depth: as for `points` [m], shape (height, width).
        normal: normals of any length, shape (height, width, 3).

    Returns:
        Unit normals, unit vectors to the light and to the eye, shape (height, width, 3); and the light's distance from
        the middle of the main camera's picture over that from the sample, at most 4, shape (height, width).
    """
    light_view = camera.light_view or camera
    right, up, toward = light_view.axes
    point = points(camera, factor, depth)
    light = light_view.eye + light_view.distance * (uniforms.LIGHT_RIGHT * right + uniforms.LIGHT_UP * up)
    to_eye = _unit(camera.eye - point) if camera.pinhole else np.broadcast_to(camera.axes[2], point.shape)
    middle = np.linalg.norm(light - (light_view.eye - light_view.distance * toward))
    nearness = np.minimum(middle / np.linalg.norm(light - point, axis=-1), 4)
    return _unit(normal), _unit(light - point), to_eye, nearness


def highlight(normal: Array, to_light: Array, to_eye: Array) -> Array:
    """Return the highlight of Phong's model, (r . e)^(2^SHARPNESS) with the mirrored light r, 0 to 1.

    Args:
        normal: unit normals, shape (..., 3).
        to_light: unit vectors toward the light, same shape.
        to_eye: unit vectors toward the eye, same shape.
    """
    mirrored = 2 * (normal * to_light).sum(axis=-1, keepdims=True) * normal - to_light
    return np.asarray(np.clip((mirrored * to_eye).sum(axis=-1), 0, 1) ** 2**uniforms.SHARPNESS)


def tissue(
    scene: Scene,
    camera: View,
    texture: NDArray[np.uint8],
    normal: Array,
    depth: Array,
    texel: tuple[Array, Array, Array],
    rods: Sequence[Solid],
) -> Array:
    """Return the colours of wet tissue, 0 to 255, shape (height, width, 3), by the formulas of `render/shading.py`.

    Args:
        scene: scene with the light and the sheet.
        camera: view to draw from.
        texture: colours, shape (height, width, 3).
        normal: normals of any length, shape (height, width, 3).
        depth: as for `points` [m], shape (height, width).
        texel: u, v and footprint for `minified`, each of shape (height, width).
        rods: instruments, which darken the tissue around them.
    """
    light, factor = scene.render.light, scene.render.supersample
    colour, rises = minified(texture, *texel)
    # Where the relief rises, the normal tilts back, along the sheet.
    upward = light.relief / 100 * max(scene.sheet.size) / 255
    sizes = texture.shape[1] / scene.sheet.size[1], texture.shape[0] / scene.sheet.size[0]
    normal = _unit(normal)
    slope = np.concatenate([rises * upward * sizes * (1, -1), np.zeros_like(rises[..., :1])], axis=-1)
    leaning = normal - slope + (slope * normal).sum(axis=-1, keepdims=True) * normal
    facing, to_light, to_eye, nearness = illuminate(camera, factor, depth, leaning)
    wrapped = np.maximum((facing * to_light).sum(axis=-1) + uniforms.WRAP, 0) / (1 + uniforms.WRAP) * nearness
    aside = np.hypot(uniforms.LIGHT_RIGHT, uniforms.LIGHT_UP)
    wrapped /= (1 / np.hypot(1, aside) + uniforms.WRAP) / (1 + uniforms.WRAP)
    share = light.ambient + (1 - light.ambient) * wrapped
    gloss = 255 * light.gloss * highlight(facing, to_light, to_eye) * nearness
    for rod in rods:
        offset = points(camera, factor, depth) - rod.tip
        foot = np.clip(offset @ rod.axis, 0, rod.length)[..., None] * rod.axis
        ratio = np.maximum(np.linalg.norm(offset - foot, axis=-1) / rod.radius, 1)
        share, gloss = (value * (1 - uniforms.SHADE / ratio**2) for value in (share, gloss))
    y, x = (np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5) / factor
    middle = camera.size / 2
    off = np.hypot(x - middle[0], y - middle[1]) / np.hypot(*middle)
    rim = (1 - light.vignette * off**2)[..., None]
    return np.asarray(np.minimum((colour * share[..., None] + gloss[..., None]) * rim, 255))


def metal(camera: View, factor: int, depth: Array, normal: Array) -> Array:
    """Return the colours of metal in a room that is bright above and dark below, 0 to 255, shape (height, width, 3).

    Args:
        camera: view to draw from.
        factor: samples per pixel and axis.
        depth: as for `points` [m], shape (height, width).
        normal: outward normals of any length, shape (height, width, 3).
    """
    lamp = (camera.light_view or camera).distance * np.hypot(1, np.hypot(uniforms.LIGHT_RIGHT, uniforms.LIGHT_UP))
    below = np.maximum(np.where(np.isfinite(depth), depth, lamp), uniforms.METAL_NEAREST * lamp)
    facing, to_light, to_eye, _ = illuminate(camera, factor, below, normal)
    cosine = np.maximum((facing * to_light).sum(axis=-1), 0)
    mirrored = 2 * (facing * to_eye).sum(axis=-1, keepdims=True) * facing - to_eye
    bright = np.maximum(mirrored @ camera.axes[1], 0)
    share = uniforms.METAL_AMBIENT + uniforms.METAL_DIFFUSE * cosine + uniforms.METAL_MIRROR * bright**2
    gloss = 255 * uniforms.METAL_GLOSS * highlight(facing, to_light, to_eye)
    return np.asarray(np.minimum(share[..., None] * np.array(uniforms.METAL) + gloss[..., None], 255))


def intersect(rods: Sequence[Solid], camera: View, size: tuple[int, int], factor: int) -> tuple[Array, Array]:
    """Intersect the lines of sight with instruments, by search: the distance to a capsule is convex along a line.

    Args:
        rods: instruments, capsules.
        camera: view to draw from.
        size: width and height of the picture [px].
        factor: samples per pixel and axis.

    Returns:
        Depths [m], infinite where there is no instrument, shape (height, width) in samples; and outward normals of any
        length, shape (height, width, 3).
    """
    width, height = size[0] * factor, size[1] * factor
    y, x = (np.mgrid[:height, :width] + 0.5) / factor
    right, up, toward = camera.axes
    x, y = undistorted(camera, x, y)
    across, along = (x - camera.centre[0]) / camera.scale[0], (camera.centre[1] - y) / camera.scale[1]
    aside = across[..., None] * right + along[..., None] * up
    nearest, normal = np.full((height, width), np.inf), np.zeros((height, width, 3))

    def sight(depth: Array) -> Array:
        w = depth[..., None] if camera.pinhole else 1.0
        return np.asarray(camera.eye + aside * w - depth[..., None] * toward)

    for rod in rods:

        def outward(depth: Array, rod: Solid = rod) -> Array:
            point = sight(depth) - rod.tip
            foot = np.clip(point @ rod.axis, 0, rod.length)
            return np.asarray(point - foot[..., None] * rod.axis)

        ends = np.array([(camera.eye - rod.tip - n * rod.length * rod.axis) @ toward for n in (0, 1)])
        reach = rod.radius * 1.01
        low, high = np.full_like(x, ends.min() - reach), np.full_like(x, ends.max() + reach)
        first = np.copy(low)
        for _ in range(200):  # ternary search for the least distance: the interval shrinks to two thirds
            a, b = low + (high - low) / 3, high - (high - low) / 3
            left = np.linalg.norm(outward(a), axis=-1) < np.linalg.norm(outward(b), axis=-1)
            low, high = np.where(left, low, a), np.where(left, b, high)
        middle = (low + high) / 2
        met = np.linalg.norm(outward(middle), axis=-1) <= rod.radius
        low, high = first, middle
        for _ in range(60):  # bisection for the entry of the line of sight
            half = (low + high) / 2
            inside = np.linalg.norm(outward(half), axis=-1) <= rod.radius
            low, high = np.where(inside, low, half), np.where(inside, half, high)
        nearer = met & (high < nearest) & ((high if camera.pinhole else 1.0) > camera.near)
        nearest[nearer], normal[nearer] = high[nearer], outward(high)[nearer]
    return nearest, normal
