"""Kernel 2: bilinear refinement, projection, rasterisation of textured triangles, shading.

A point of the surface is carried as (X, Y, w, depth), what the camera's matrix makes of it. That map is linear, so
refining the projected mass points is refining the surface, and the perspective needs no special case.

Coverage is decided in whole numbers: a vertex is snapped to 1/256 px, and a pixel whose centre is on an edge belongs
to the triangle into which an infinitely small step to the left and then down leads. So every pixel of a tessellated
surface is drawn exactly once. Depth, texture coordinates and light come from the unsnapped vertices.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm import look
from taichi_msm.camera import View, view
from taichi_msm.runtime import FieldTree, ti
from taichi_msm.scene import Scene

SUBPIXEL_BITS = 8
SUBPIXEL = 1 << SUBPIXEL_BITS

# Beyond this many pixels from the corner, or behind the camera, a vertex cannot be snapped.
SNAP_LIMIT = 1 << 21
UNSNAPPED = -(1 << 31)

# No triangle, infinitely far away.
EMPTY = (1 << 64) - 1

vec2i = ti.types.vector(2, ti.i32)
vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
mat4 = ti.types.matrix(4, 4, ti.f32)


@dataclass(frozen=True)
class Structure:
    """What the kernel is compiled for.

    Attributes:
        rows, cols: mass points.
        refine: vertices inserted between two neighbours.
        width, height: of the picture [px].
        supersample: samples of a pixel along each axis.
        texture: width, height of the texture [px].
        lit: whether there is a headlight.
        wireframe: whether the mass-point mesh is drawn.
    """

    rows: int
    cols: int
    refine: int
    width: int
    height: int
    supersample: int
    texture: tuple[int, int]
    lit: bool
    wireframe: bool

    @property
    def vertices(self) -> tuple[int, int]:
        """Rows and columns of vertices."""
        return (self.rows - 1) * (self.refine + 1) + 1, (self.cols - 1) * (self.refine + 1) + 1


def structure(scene: Scene, texture: NDArray[np.uint8]) -> Structure:
    """Find out what the scene's picture needs."""
    (rows, cols), (width, height), render = scene.sheet.points, scene.render.size, scene.render
    return Structure(
        rows=rows,
        cols=cols,
        refine=render.refine,
        width=width,
        height=height,
        supersample=render.supersample,
        texture=(texture.shape[1], texture.shape[0]),
        lit=render.shading == "headlight",
        wireframe=render.wireframe,
    )


class Drawing:
    """Draws one scene's sheet; `runtime.start` comes first.

    Args:
        scene: a checked scene.
        texture: the picture on the sheet, shape (height, width, 3).
    """

    def __init__(self, scene: Scene, texture: NDArray[np.uint8]) -> None:
        self.scene = scene
        self.structure = structure(scene, texture)
        self._fields = _Fields(self.structure)
        self._draw = _kernel(self.structure, self._fields)
        self._view = view(scene)
        self._background = ti.Vector(scene.render.background, ti.f32)
        packed = texture.astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], np.uint32)
        self._fields.texture.from_numpy(packed)

    def draw(self, position: NDArray[Any], camera: View | None = None) -> NDArray[np.uint8]:
        """Draw the sheet.

        Args:
            position: positions of the mass points [m], shape (rows, cols, 3).
            camera: another view than the scene's.

        Returns:
            Colours, shape (height, width, 3).
        """
        s, camera = self.structure, camera or self._view
        scale = np.array([[s.supersample], [s.supersample], [1], [1]])
        out = np.empty((s.height, s.width, 3), np.uint8)
        self._draw(
            np.ascontiguousarray(position, np.float32),
            mat4((camera.matrix * scale).tolist()),
            vec3(camera.toward.tolist()),
            camera.near,
            self._background,
            out,
        )
        return out

    def close(self) -> None:
        """Free the fields."""
        self._fields.close()


class _Fields(FieldTree):
    """The fields of one drawing."""

    def __init__(self, s: Structure) -> None:
        super().__init__()
        samples = s.height * s.supersample, s.width * s.supersample
        self.point = self.place(vec4.field(), s.rows, s.cols)
        self.normal: Any = self.place(vec3.field(), s.rows, s.cols) if s.lit else None
        self.vertex = self.place(vec4.field(), *s.vertices)
        self.snapped = self.place(vec2i.field(), *s.vertices)
        self.light: Any = self.place(ti.field(ti.f32), *s.vertices) if s.lit else None
        # The nearest triangle of every sample: its depth above, its number below.
        self.nearest = self.place(ti.field(ti.u64), *samples)
        self.picture = self.place(ti.types.vector(3, ti.u8).field(), s.height, s.width)
        self.texture = self.place(ti.field(ti.u32), s.texture[1], s.texture[0])
        self.allocate()


def rasteriser(fields: _Fields, width: int, height: int, visit: Callable[..., None]) -> Callable[..., None]:
    """Make the function that finds the pixels of a triangle.

    Args:
        fields: holds the vertices.
        width: of the screen [px].
        height: of the screen [px].
        visit: Taichi function of x, y, number of the triangle and its three corners; called once for every pixel.

    Returns:
        Taichi function of the number of a triangle, its three corners (row, column), and the camera's near distance.
    """
    vertex, snapped = fields.vertex, fields.snapped

    @ti.func
    def edge(p, q, x, y):
        """Twice the signed area of p, q and the sample, less what keeps an edge from being drawn twice."""
        dx = ti.cast(q[0] - p[0], ti.i64)
        dy = ti.cast(q[1] - p[1], ti.i64)
        owned = dy > 0 or (dy == 0 and dx > 0)
        return dx * (y - p[1]) - dy * (x - p[0]) - ti.cast(not owned, ti.i64)

    @ti.func
    def snapped_pixels(number, a, b, c, p, q, r):
        """Visit the pixels of the triangle p, q, r, counter-clockwise in whole numbers."""
        half = SUBPIXEL // 2
        low = ti.min(p, ti.min(q, r))
        high = ti.max(p, ti.max(q, r))
        for y in range(
            ti.max((low[1] + half - 1) >> SUBPIXEL_BITS, 0), ti.min((high[1] - half) >> SUBPIXEL_BITS, height - 1) + 1
        ):
            for x in range(
                ti.max((low[0] + half - 1) >> SUBPIXEL_BITS, 0),
                ti.min((high[0] - half) >> SUBPIXEL_BITS, width - 1) + 1,
            ):
                at_x = x * SUBPIXEL + half
                at_y = y * SUBPIXEL + half
                if edge(p, q, at_x, at_y) >= 0 and edge(q, r, at_x, at_y) >= 0 and edge(r, p, at_x, at_y) >= 0:
                    visit(x, y, number, a, b, c)

    @ti.func
    def crossing_pixels(number, a, b, c, near):
        """Visit the pixels of a triangle that reaches behind the camera or very far out; edges may be drawn twice."""
        va, vb, vc = vertex[a], vertex[b], vertex[c]
        x = vec3(va[0], vb[0], vc[0])
        y = vec3(va[1], vb[1], vc[1])
        w = vec3(va[2], vb[2], vc[2])
        outside = (
            x.max() < 0 or y.max() < 0 or w.max() <= near or (x - width * w).min() > 0 or (y - height * w).min() > 0
        )
        if not outside:
            for j in range(height):
                for i in range(width):
                    share = weights(va, vb, vc, i + 0.5, j + 0.5)
                    if share.min() >= 0 and share.dot(w) > near:
                        visit(i, j, number, a, b, c)

    @ti.func
    def rasterise(number, a, b, c, near):
        p, q, r = snapped[a], snapped[b], snapped[c]
        if p[0] == UNSNAPPED or q[0] == UNSNAPPED or r[0] == UNSNAPPED:
            crossing_pixels(number, a, b, c, near)
        else:
            area = ti.cast(q[0] - p[0], ti.i64) * (r[1] - p[1]) - ti.cast(q[1] - p[1], ti.i64) * (r[0] - p[0])
            if area != 0:
                snapped_pixels(number, a, b, c, p, ti.select(area > 0, q, r), ti.select(area > 0, r, q))

    return rasterise


@ti.func
def weights(a, b, c, x, y):
    """Share of each corner in the point of the triangle seen at (x, y); see `reference.weights`."""
    ax = a[0] - x * a[2]
    ay = a[1] - y * a[2]
    bx = b[0] - x * b[2]
    by = b[1] - y * b[2]
    cx = c[0] - x * c[2]
    cy = c[1] - y * c[2]
    share = vec3(bx * cy - cx * by, cx * ay - ax * cy, ax * by - bx * ay)
    total = share.sum()
    # Seen edge-on, a triangle has no inside.
    return ti.select(total != 0, share / total, vec3(-1))


@ti.func
def ordered(depth):
    """Map a float to a whole number of the same order."""
    bits = ti.bit_cast(depth, ti.u32)
    sign = ti.u32(1 << 31)
    return ti.select(bits >= sign, ~bits, bits | sign)


def _kernel(s: Structure, fields: _Fields) -> Callable[..., None]:
    """Compile the drawing of one structure."""
    point, normal, vertex, snapped, light = fields.point, fields.normal, fields.vertex, fields.snapped, fields.light
    nearest, picture, texture = fields.nearest, fields.picture, fields.texture
    rows, cols, parts = s.rows, s.cols, s.refine + 1
    vertex_rows, vertex_cols = s.vertices
    factor = s.supersample
    width, height = s.width * factor, s.height * factor
    texture_width, texture_height = s.texture
    lit, wireframe = s.lit, s.wireframe
    wire_colour = look.WIRE_COLOUR

    @ti.func
    def depth_test(x, y, number, a, b, c):
        va, vb, vc = vertex[a], vertex[b], vertex[c]
        share = weights(va, vb, vc, x + 0.5, y + 0.5)
        depth = share[0] * va[3] + share[1] * vb[3] + share[2] * vc[3]
        ti.atomic_min(nearest[y, x], (ti.cast(ordered(depth), ti.u64) << 32) | ti.cast(number, ti.u64))

    rasterise = rasteriser(fields, width, height, depth_test)

    @ti.func
    def corners(number):
        """Corners (row, column) of a triangle: quads in rows, each cut from its top left to its bottom right."""
        quad = ti.cast(number // 2, ti.i32)
        r = quad // (vertex_cols - 1)
        c = quad % (vertex_cols - 1)
        upper = ti.cast(number % 2, ti.i32)
        return vec2i(r, c), vec2i(r + 1, c + upper), vec2i(r + 1 - upper, c + 1)

    @ti.func
    def mesh_lines(a, b, c, va, vb, vc, x, y):
        """Share of the mesh lines in the colour of a sample; see `reference.wire_share`."""
        unit = ti.Vector([(rows - 1) / (vertex_rows - 1), (cols - 1) / (vertex_cols - 1)])
        here = mesh_place(a, b, c, weights(va, vb, vc, x, y)) * unit
        right = mesh_place(a, b, c, weights(va, vb, vc, x + 1, y)) * unit
        below = mesh_place(a, b, c, weights(va, vb, vc, x, y + 1)) * unit
        slope = ti.sqrt((right - here) ** 2 + (below - here) ** 2)
        distance = (ti.abs(here - ti.round(here)) / ti.max(slope, 1e-12)).min()
        return look.WIRE_OPACITY * ti.math.clamp(look.WIRE_WIDTH / 2 * factor + 0.5 - distance, 0.0, 1.0)

    @ti.func
    def mesh_place(a, b, c, share):
        """Row and column, in vertices, of a point of a triangle."""
        return share[0] * ti.cast(a, ti.f32) + share[1] * ti.cast(b, ti.f32) + share[2] * ti.cast(c, ti.f32)

    @ti.func
    def texel(a, b):
        packed = texture[ti.math.clamp(b, 0, texture_height - 1), ti.math.clamp(a, 0, texture_width - 1)]
        return vec3(packed & 255, (packed >> 8) & 255, (packed >> 16) & 255)

    @ti.func
    def sample(place):
        """Filter the texture at a place of the mesh, in vertices."""
        x = place[1] * (texture_width / (vertex_cols - 1)) - 0.5
        y = place[0] * (texture_height / (vertex_rows - 1)) - 0.5
        a = ti.floor(x, ti.i32)
        b = ti.floor(y, ti.i32)
        across = x - a
        down = y - b
        upper = texel(a, b) * (1 - across) + texel(a + 1, b) * across
        lower = texel(a, b + 1) * (1 - across) + texel(a + 1, b + 1) * across
        return upper * (1 - down) + lower * down

    @ti.func
    def shade(number, x, y):
        """Colour of the sample (x, y) on a triangle."""
        a, b, c = corners(number)
        va, vb, vc = vertex[a], vertex[b], vertex[c]
        share = weights(va, vb, vc, x, y)
        colour = sample(mesh_place(a, b, c, share))
        if ti.static(lit):
            colour *= share[0] * light[a] + share[1] * light[b] + share[2] * light[c]
        if ti.static(wireframe):
            wire = mesh_lines(a, b, c, va, vb, vc, x, y)
            colour += (vec3(wire_colour) - colour) * wire
        return colour

    @ti.kernel
    def draw(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3),
        matrix: mat4,
        toward: vec3,
        near: ti.f32,
        background: vec3,
        out: ti.types.ndarray(dtype=ti.u8, ndim=3),
    ):
        for i, j in point:
            point[i, j] = matrix @ vec4(position[i, j, 0], position[i, j, 1], position[i, j, 2], 1)
            if ti.static(lit):
                i0 = ti.max(i - 1, 0)
                i1 = ti.min(i + 1, rows - 1)
                j0 = ti.max(j - 1, 0)
                j1 = ti.min(j + 1, cols - 1)
                right = vec3(0)
                up = vec3(0)
                for k in ti.static(range(3)):
                    right[k] = position[i, j1, k] - position[i, j0, k]
                    up[k] = position[i0, j, k] - position[i1, j, k]
                across = right.cross(up)
                normal[i, j] = across / ti.max(across.norm(), 1e-30)

        for r, c in vertex:
            i = ti.min(r // parts, rows - 2)
            j = ti.min(c // parts, cols - 2)
            s = (r - i * parts) / parts
            t = (c - j * parts) / parts
            upper = point[i, j] * (1 - t) + point[i, j + 1] * t
            lower = point[i + 1, j] * (1 - t) + point[i + 1, j + 1] * t
            v = upper * (1 - s) + lower * s
            vertex[r, c] = v
            x = v[0] / v[2]
            y = v[1] / v[2]
            if v[2] > near and ti.abs(x) < SNAP_LIMIT and ti.abs(y) < SNAP_LIMIT:
                snapped[r, c] = vec2i(ti.round(x * SUBPIXEL, ti.i32), ti.round(y * SUBPIXEL, ti.i32))
            else:
                snapped[r, c] = vec2i(UNSNAPPED)
            if ti.static(lit):
                n = (normal[i, j] * (1 - t) + normal[i, j + 1] * t) * (1 - s) + (
                    normal[i + 1, j] * (1 - t) + normal[i + 1, j + 1] * t
                ) * s
                light[r, c] = ti.abs(n.dot(toward)) / ti.max(n.norm(), 1e-30)

        for y, x in nearest:
            nearest[y, x] = ti.u64(EMPTY)

        for r, c in ti.ndrange(vertex_rows - 1, vertex_cols - 1):
            for upper in range(2):
                number = (ti.cast(r, ti.u32) * (vertex_cols - 1) + c) * 2 + upper
                rasterise(number, vec2i(r, c), vec2i(r + 1, c + upper), vec2i(r + 1 - upper, c + 1), near)

        for y, x in picture:
            colour = vec3(0)
            for j, i in ti.ndrange(factor, factor):
                key = nearest[y * factor + j, x * factor + i]
                if key == ti.u64(EMPTY):
                    colour += background
                else:
                    number = ti.cast(key & ti.u64(0xFFFFFFFF), ti.u32)
                    colour += shade(number, x * factor + i + 0.5, y * factor + j + 0.5)
            colour = ti.floor(colour / (factor * factor) + 0.5)
            for k in ti.static(range(3)):
                picture[y, x][k] = ti.cast(colour[k], ti.u8)
                out[y, x, k] = picture[y, x][k]

    return draw
