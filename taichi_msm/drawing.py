"""Kernel 2: bilinear refinement, projection, rasterisation of textured triangles, shading.

A point of the surface is carried as (X, Y, w, depth), what the camera's matrix makes of it. That map is linear, so
refining the projected mass points is refining the surface, and the perspective needs no special case: within a cell,
the surface between four mass points, with s to the right and t down,

    P(s, t) = A + B s + C t + D s t,    seen at pixel (x, y) where    X - x w = 0,  Y - y w = 0.

No vertex is stored. A pixel inside the outline of a cell solves these two equations, which tells the small quad, its
side of the diagonal the triangle, and the triangle's own two linear equations the place on it. A cell that is folded or
reaches behind the camera is drawn triangle by triangle instead.

The picture is cut into bands of rows, each drawn by one thread, and a row into chunks of as many pixels as a vector has
lanes, on which every operation is one vector instruction; on a GPU of one pixel, and a band is a row.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm import look
from taichi_msm.camera import View, view
from taichi_msm.runtime import ITERATIONS_PER_THREAD, FieldTree, quick_compilation, started, ti
from taichi_msm.scene import Scene

# Pixels of a chunk, and rows of pixels of a band.
LANES = 8
BAND_ROWS = 16

# Farther than anything that is drawn.
INFINITY = 3e38

# A triangle that is drawn by itself may be overstepped, so that no gap is left beside it: by so much of its side, and
# of the picture's, for which f32 has places.
OVERSTEP = 1e-5
OVERSTEP_OF_PICTURE = 2e-6

# Beyond so many samples f32 has no places for the outline of a cell that is drawn as a whole.
FARTHEST = float(1 << 16)

vec2 = ti.types.vector(2, ti.f32)
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
        lanes: samples of a chunk.
        band_rows: rows of pixels of a band.
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
    lanes: int
    band_rows: int

    @property
    def channel_bits(self) -> int:
        """Bits of one channel of a sample's colour: where samples are averaged fractions of a grey level count."""
        return 8 if self.supersample == 1 else 20

    @property
    def levels(self) -> int:
        """What grey levels of samples are multiplied by to fill these bits."""
        return 1 << (self.channel_bits - 8)


def structure(scene: Scene, texture: NDArray[np.uint8]) -> Structure:
    """Find out what the scene's picture needs."""
    (rows, cols), (width, height), render = scene.sheet.points, scene.render.size, scene.render
    on_cpu = started().arch == "cpu"
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
        lanes=LANES if on_cpu else 1,
        band_rows=BAND_ROWS if on_cpu else 1,
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
        levels = [level * self.structure.levels for level in scene.render.background]
        self._background = sum(level << (self.structure.channel_bits * n) for n, level in enumerate(levels))
        self._texels: Any = (texture.astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], np.uint32)).ravel()
        if started().arch != "cpu":
            # Kept there, or it would travel there and back with every picture.
            packed, self._texels = self._texels, ti.ndarray(ti.u32, self._texels.size)
            self._texels.from_numpy(packed)

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
        out = np.empty(s.height * s.width * 3, np.uint8)
        with quick_compilation():
            self._draw(
                np.ascontiguousarray(position, np.float32),
                self._texels,
                mat4((camera.matrix * scale).tolist()),
                vec3(camera.toward.tolist()),
                camera.near,
                self._background,
                out,
            )
        return out.reshape(s.height, s.width, 3)

    def close(self) -> None:
        """Free the fields."""
        self._fields.close()


class _Fields(FieldTree):
    """The fields of one drawing."""

    def __init__(self, s: Structure) -> None:
        super().__init__()
        samples = s.height * s.supersample, -(-s.width * s.supersample // s.lanes)
        # Of the mass points: (X, Y, w, depth), the place in the picture [samples], the unit normal.
        self.point = self.place(vec4.field(), s.rows, s.cols)
        self.seen_at = self.place(vec2.field(), s.rows, s.cols)
        self.normal: Any = self.place(vec3.field(), s.rows, s.cols) if s.lit else None
        # Of every row of mass points its highest and its lowest place in the picture.
        self.reach = self.place(vec2.field(), s.rows)
        # Of every sample the depth of what is seen there, and its colour.
        self.depth = self.place(ti.Vector.field(s.lanes, ti.f32), *samples)
        self.colour = self.place(ti.Vector.field(s.lanes, ti.u32 if s.supersample == 1 else ti.u64), *samples)
        self.allocate()


def _kernel(s: Structure, fields: _Fields) -> Callable[..., None]:
    """Compile the drawing of one structure."""
    point, seen_at, normal, reach = fields.point, fields.seen_at, fields.normal, fields.reach
    depth, colour = fields.depth, fields.colour
    rows, cols, parts, lanes, factor = s.rows, s.cols, s.refine + 1, s.lanes, s.supersample
    s_width, s_height = s.width, s.height
    width, height = s_width * factor, s_height * factor
    chunks = -(-width // lanes)
    bands = -(-s.height // s.band_rows)
    band_rows = s.band_rows
    texture_width, texture_height = s.texture
    lit, wireframe = s.lit, s.wireframe
    part = 1 / parts
    levels, channel_bits = s.levels, s.channel_bits
    word = ti.u32 if factor == 1 else ti.u64
    weight = factor * factor * levels
    centres = [lane + 0.5 for lane in range(lanes)]
    several = ti.types.vector(lanes, ti.f32)

    @ti.func
    def on_triangle(x, y, p_x, p_y, p_w, r_x, r_y, r_w, d_x, d_y, d_w):
        """Find (s, t) where the triangle P + R s + D t, each (X, Y, w), is seen at (x, y)."""
        p_1 = p_x - x * p_w
        r_1 = r_x - x * r_w
        d_1 = d_x - x * d_w
        p_2 = p_y - y * p_w
        r_2 = r_y - y * r_w
        d_2 = d_y - y * d_w
        share = 1.0 / (r_1 * d_2 - r_2 * d_1)
        return (p_2 * d_1 - p_1 * d_2) * share, (p_1 * r_2 - p_2 * r_1) * share

    @ti.func
    def edge(p, q, x, y):
        """Twice the area of p, q and (x, y), of one sign on each side; the same bits for both cells of an edge."""
        return (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])

    @ti.func
    def turn(p, q, r):
        return (q[0] - p[0]) * (r[1] - q[1]) - (q[1] - p[1]) * (r[0] - q[0])

    @ti.func
    def texels(texture: ti.template(), index):
        found = ti.Vector.zero(ti.u32, lanes)
        for lane in ti.static(range(lanes)):
            found[lane] = texture[index[lane]]
        return found

    @ti.func
    def channel(packed, k: ti.template()):
        # Not shifted: Taichi's debug mode cannot compile the shift of a vector. The machine code is the same.
        return ti.cast(ti.cast((packed // (1 << (8 * k))) & 255, ti.i32), ti.f32)

    @ti.func
    def wire_share(across, down, right_across, right_down, below_across, below_down):
        """Share of the mesh lines in a sample's colour, from places on the mesh; see `reference.wire_share`."""
        slope = ti.sqrt((right_across - across) ** 2 + (below_across - across) ** 2)
        distance = ti.abs(across - ti.round(across)) / ti.max(slope, 1e-12)
        slope = ti.sqrt((right_down - down) ** 2 + (below_down - down) ** 2)
        distance = ti.min(distance, ti.abs(down - ti.round(down)) / ti.max(slope, 1e-12))
        return look.WIRE_OPACITY * ti.math.clamp(look.WIRE_WIDTH / 2 * factor + 0.5 - distance, 0.0, 1.0)

    @ti.func
    def small_quad(x, y, inside, side, a, b, c, d):
        """Find column and line of the small quads of the cell A, B, C, D that are seen at (x, y)."""
        a_1 = a[0] - x * a[2]
        b_1 = b[0] - x * b[2]
        c_1 = c[0] - x * c[2]
        d_1 = d[0] - x * d[2]
        a_2 = a[1] - y * a[2]
        b_2 = b[1] - y * b[2]
        c_2 = c[1] - y * c[2]
        d_2 = d[1] - y * d[2]
        # Without t the two equations are bd s^2 + (ad + bc) s + ac = 0; without s they have the same discriminant.
        ad = a_1 * d_2 - a_2 * d_1
        bc = b_1 * c_2 - b_2 * c_1
        ac = a_1 * c_2 - a_2 * c_1
        ab = a_1 * b_2 - a_2 * b_1
        bd = b_1 * d_2 - b_2 * d_1
        linear = ad + bc
        root = ti.sqrt(ti.max(linear * linear - 4 * bd * ac, 0.0)) * side
        s = ti.select(inside, -2 * ac / (linear + root), 0.0)
        t = ti.select(inside, -2 * ab / (ad - bc - root), 0.0)
        return (
            ti.math.clamp(ti.floor(s * parts), 0.0, parts - 1),
            ti.math.clamp(ti.floor(t * parts), 0.0, parts - 1),
        )

    @ti.func
    def draw_cell(i, j, top, bottom, near, toward, texture: ti.template()):
        """Draw what is in rows top to bottom - 1 of the cell to the right and below of mass point (i, j)."""
        a, right, down, far = point[i, j], point[i, j + 1], point[i + 1, j], point[i + 1, j + 1]
        b = right - a
        c = down - a
        d = far - right - c
        seen_a, seen_b, seen_c, seen_d = seen_at[i, j], seen_at[i, j + 1], seen_at[i + 1, j], seen_at[i + 1, j + 1]
        before = a[2] > near and right[2] > near and down[2] > near and far[2] > near
        turns = vec4(
            turn(seen_a, seen_b, seen_d),
            turn(seen_b, seen_d, seen_c),
            turn(seen_d, seen_c, seen_a),
            turn(seen_c, seen_a, seen_b),
        )
        farthest = ti.max(ti.abs(seen_a).max(), ti.abs(seen_b).max(), ti.abs(seen_c).max(), ti.abs(seen_d).max())
        whole = before and farthest < FARTHEST and (turns.min() > 0 or turns.max() < 0)
        side = ti.select(turns[0] > 0, 1.0, -1.0)

        # Where the texture is, in texels, exact to a fraction of one on any sheet.
        texel_x = ti.cast(j, ti.f64) * texture_width / (cols - 1) - 0.5
        texel_y = ti.cast(i, ti.f64) * texture_height / (rows - 1) - 0.5
        first_x = ti.floor(texel_x, ti.i32)
        first_y = ti.floor(texel_y, ti.i32)
        begin_x = ti.cast(texel_x - first_x, ti.f32)
        begin_y = ti.cast(texel_y - first_y, ti.f32)

        pieces = ti.select(whole, 1, 2 * parts * parts)
        for piece in range(pieces):
            # Of a triangle that is drawn by itself: its quad, and whether it is below the diagonal.
            quad = piece // 2
            quad_s = ti.cast(quad % parts, ti.f32)
            quad_t = ti.cast(quad // parts, ti.f32)
            lower = piece % 2 == 0
            low_x, high_x, low_y, high_y = 0.0, ti.cast(width, ti.f32), -INFINITY, INFINITY
            overstep = OVERSTEP
            if whole:
                low_x = ti.min(seen_a[0], seen_b[0], seen_c[0], seen_d[0])
                high_x = ti.max(seen_a[0], seen_b[0], seen_c[0], seen_d[0])
                low_y = ti.min(seen_a[1], seen_b[1], seen_c[1], seen_d[1])
                high_y = ti.max(seen_a[1], seen_b[1], seen_c[1], seen_d[1])
            else:
                s0, t0 = quad_s / parts, quad_t / parts
                s1, t1 = (quad_s + 1) / parts, (quad_t + 1) * part
                one = a + b * s0 + (c + d * s0) * t0
                two = a + b * s1 + (c + d * s1) * t1
                three = a + b * s0 + (c + d * s0) * t1
                if not lower:
                    three = a + b * s1 + (c + d * s1) * t0
                if one[2] > near and two[2] > near and three[2] > near:
                    low_x = ti.min(one[0] / one[2], two[0] / two[2], three[0] / three[2])
                    high_x = ti.max(one[0] / one[2], two[0] / two[2], three[0] / three[2])
                    low_y = ti.min(one[1] / one[2], two[1] / two[2], three[1] / three[2])
                    high_y = ti.max(one[1] / one[2], two[1] / two[2], three[1] / three[2])
                    overstep += OVERSTEP_OF_PICTURE * (width + height) / ti.max(high_x - low_x, high_y - low_y, 1e-3)
                elif one[2] <= near and two[2] <= near and three[2] <= near:
                    high_x = -1.0
            first_row = ti.cast(ti.math.clamp(ti.floor(low_y), top, bottom), ti.i32)
            end_row = ti.cast(ti.math.clamp(ti.ceil(high_y + 0.5), top, bottom), ti.i32)
            first_chunk = ti.cast(ti.math.clamp(ti.floor(low_x), 0.0, width), ti.i32) // lanes
            end_chunk = ti.cast(ti.math.clamp(ti.ceil(high_x + 0.5), 0.0, width) + (lanes - 1), ti.i32) // lanes
            for row in range(first_row, end_row):
                y = row + 0.5
                for chunk in range(first_chunk, end_chunk):
                    x = ti.cast(chunk * lanes, ti.f32) + several(centres)
                    inside = several(0.0) == 0.0
                    column = several(quad_s)
                    line = several(quad_t)
                    if whole:
                        # Left and upper edges belong to a cell, right and lower ones do not.
                        inside = (
                            (edge(seen_a, seen_c, x, y) * side <= 0)
                            & (edge(seen_b, seen_d, x, y) * side > 0)
                            & (edge(seen_a, seen_b, x, y) * side >= 0)
                            & (edge(seen_c, seen_d, x, y) * side < 0)
                        )
                        if ti.static(parts > 1):
                            column, line = small_quad(x, y, inside, side, a, b, c, d)
                    draw_samples(
                        row, chunk, x, y, inside, column, line, whole, lower, overstep, side, near, a, b, c, d,
                        i, j, first_x, first_y, begin_x, begin_y, toward, texture,
                    )  # fmt: skip

    @ti.func
    def draw_samples(
        row, chunk, x, y, inside, column, line, whole, lower, overstep, side, near, a, b, c, d,
        i, j, first_x, first_y, begin_x, begin_y, toward, texture: ti.template(),
    ):  # fmt: skip
        """Draw a chunk of samples of the cell A, B, C, D, in its small quads."""
        # The small quad: P = A + B s + C t + D s t again.
        s0 = column * part
        t0 = line * part
        p_x = a[0] + b[0] * s0 + (c[0] + d[0] * s0) * t0
        p_y = a[1] + b[1] * s0 + (c[1] + d[1] * s0) * t0
        p_w = a[2] + b[2] * s0 + (c[2] + d[2] * s0) * t0
        p_z = a[3] + b[3] * s0 + (c[3] + d[3] * s0) * t0
        r_x = (b[0] + d[0] * t0) * part
        r_y = (b[1] + d[1] * t0) * part
        r_w = (b[2] + d[2] * t0) * part
        r_z = (b[3] + d[3] * t0) * part
        d_x = (c[0] + d[0] * s0) * part
        d_y = (c[1] + d[1] * s0) * part
        d_w = (c[2] + d[2] * s0) * part
        d_z = (c[3] + d[3] * s0) * part
        twist = d * (part * part)
        # Its triangles share the diagonal from P to F; the lower one has t > s.
        f_w = p_w + r_w + d_w + twist[2]
        below = (
            (p_x - x * p_w) * (p_y + r_y + d_y + twist[1] - y * f_w)
            - (p_y - y * p_w) * (p_x + r_x + d_x + twist[0] - x * f_w)
        ) * side >= 0
        if not whole:
            below = (several(0.0) == 0.0) == lower
        r_x += ti.select(below, twist[0], 0.0)
        r_y += ti.select(below, twist[1], 0.0)
        r_w += ti.select(below, twist[2], 0.0)
        r_z += ti.select(below, twist[3], 0.0)
        d_x += ti.select(below, 0.0, twist[0])
        d_y += ti.select(below, 0.0, twist[1])
        d_w += ti.select(below, 0.0, twist[2])
        d_z += ti.select(below, 0.0, twist[3])
        s, t = on_triangle(x, y, p_x, p_y, p_w, r_x, r_y, r_w, d_x, d_y, d_w)
        if not whole:
            upper_limit = ti.select(below, t, s)
            lower_limit = ti.select(below, s, t)
            inside = (
                (lower_limit >= -overstep)
                & (upper_limit <= 1 + overstep)
                & (lower_limit <= upper_limit + overstep)
                & (p_w + r_w * s + d_w * t > near)
            )
        z = p_z + r_z * s + d_z * t
        visible = inside & (z < depth[row, chunk])
        if any_of(visible):
            across = ti.select(visible, (column + s) * part, 0.0)
            along = ti.select(visible, (line + t) * part, 0.0)
            u = begin_x + across * (texture_width / (cols - 1))
            v = begin_y + along * (texture_height / (rows - 1))
            floor_u = ti.floor(u)
            floor_v = ti.floor(v)
            left = ti.math.clamp(ti.cast(floor_u, ti.i32) + first_x, 0, texture_width - 1)
            right = ti.math.clamp(ti.cast(floor_u, ti.i32) + (first_x + 1), 0, texture_width - 1)
            upper = ti.math.clamp(ti.cast(floor_v, ti.i32) + first_y, 0, texture_height - 1) * texture_width
            under = ti.math.clamp(ti.cast(floor_v, ti.i32) + (first_y + 1), 0, texture_height - 1) * texture_width
            upper_left = texels(texture, upper + left)
            upper_right = texels(texture, upper + right)
            lower_left = texels(texture, under + left)
            lower_right = texels(texture, under + right)
            u -= floor_u
            v -= floor_v
            light = several(1.0)
            if ti.static(lit):
                n_a, n_b, n_c = normal[i, j], normal[i, j + 1] - normal[i, j], normal[i + 1, j] - normal[i, j]
                n_d = normal[i + 1, j + 1] - normal[i, j + 1] - n_c
                n_x = n_a[0] + n_b[0] * across + (n_c[0] + n_d[0] * across) * along
                n_y = n_a[1] + n_b[1] * across + (n_c[1] + n_d[1] * across) * along
                n_z = n_a[2] + n_b[2] * across + (n_c[2] + n_d[2] * across) * along
                length = ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
                light = ti.abs(n_x * toward[0] + n_y * toward[1] + n_z * toward[2]) / ti.max(length, 1e-30)
            wire = several(0.0)
            if ti.static(wireframe):
                s_right, t_right = on_triangle(x + 1, y, p_x, p_y, p_w, r_x, r_y, r_w, d_x, d_y, d_w)
                s_below, t_below = on_triangle(x, y + 1, p_x, p_y, p_w, r_x, r_y, r_w, d_x, d_y, d_w)
                wire = wire_share(
                    across, along,
                    (column + s_right) * part, (line + t_right) * part,
                    (column + s_below) * part, (line + t_below) * part,
                )  # fmt: skip
            bits = ti.Vector.zero(word, lanes)
            for n in ti.static(range(3)):
                up = channel(upper_left, n)
                up += (channel(upper_right, n) - up) * u
                low = channel(lower_left, n)
                low += (channel(lower_right, n) - low) * u
                grey = (up + (low - up) * v) * light
                if ti.static(wireframe):
                    grey += (look.WIRE_COLOUR[n] - grey) * wire
                bits |= ti.cast(ti.cast(grey * levels + 0.5, ti.i32), word) * word(1 << (channel_bits * n))
            depth[row, chunk] = ti.select(visible, z, depth[row, chunk])
            colour[row, chunk] = ti.select(visible, bits, colour[row, chunk])

    @ti.func
    def any_of(condition):
        return ti.cast(condition, ti.i32).sum() != 0

    @ti.func
    def resolve(row, out: ti.template()):
        """Give out the colours of a row of pixels, each the mean of its samples."""
        for x in range(s_width):
            total = ti.Vector.zero(ti.u32, 3)
            for v, u in ti.static(ti.ndrange(factor, factor)):
                sample = x * factor + u
                bits = colour[row * factor + v, sample // lanes][sample % lanes]
                for n in ti.static(range(3)):
                    total[n] += ti.cast((bits >> (channel_bits * n)) & ((1 << channel_bits) - 1), ti.u32)
            at = (row * s_width + x) * 3
            for n in ti.static(range(3)):
                out[at + n] = ti.cast((2 * total[n] + weight) // (2 * weight), ti.u8)

    @ti.func
    def unpack(row, out: ti.template()):
        """Give out the colours of a row of pixels of one sample each."""
        for chunk in range(chunks):
            bits = colour[row, chunk]
            at = (row * s_width + chunk * lanes) * 3
            for lane in ti.static(range(lanes)):
                if s_width % lanes == 0 or chunk * lanes + lane < s_width:
                    for n in ti.static(range(3)):
                        out[at + 3 * lane + n] = ti.cast((bits[lane] >> (channel_bits * n)) & 255, ti.u8)

    @ti.kernel
    def draw(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3),
        texture: ti.types.ndarray(dtype=ti.u32, ndim=1),
        matrix: mat4,
        toward: vec3,
        near: ti.f32,
        background: word,
        out: ti.types.ndarray(dtype=ti.u8, ndim=1),
    ):
        for index in range(rows * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                i = index // ITERATIONS_PER_THREAD
                low, high = INFINITY, -INFINITY
                for j in range(cols):
                    p = matrix @ vec4(position[i, j, 0], position[i, j, 1], position[i, j, 2], 1)
                    point[i, j] = p
                    seen_at[i, j] = vec2(p[0] / p[2], p[1] / p[2])
                    if p[2] > near:
                        low = ti.min(low, p[1] / p[2])
                        high = ti.max(high, p[1] / p[2])
                    else:
                        low, high = -INFINITY, INFINITY
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
                reach[i] = vec2(low, high)

        for index in range(bands * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                first_row = index // ITERATIONS_PER_THREAD * band_rows
                end_row = ti.min(first_row + band_rows, s_height)
                top, bottom = first_row * factor, end_row * factor
                for row in range(top, bottom):
                    for chunk in range(chunks):
                        depth[row, chunk] = several(INFINITY)
                        colour[row, chunk] = ti.Vector.zero(word, lanes) + background
                for i in range(rows - 1):
                    low = ti.min(reach[i][0], reach[i + 1][0])
                    high = ti.max(reach[i][1], reach[i + 1][1])
                    if low < bottom and high > top:
                        for j in range(cols - 1):
                            draw_cell(i, j, top, bottom, near, toward, texture)
                for row in range(first_row, end_row):
                    if ti.static(factor == 1):
                        unpack(row, out)
                    else:
                        resolve(row, out)

    return draw
