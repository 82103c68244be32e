"""Kernel 2: bilinear refinement, projection, rasterisation of textured triangles, shading.

A point of the surface is carried as (X, Y, w, depth), what the camera's matrix makes of it. That map is linear, so
refining the projected mass points is refining the surface, and the perspective needs no special case: within a cell,
the surface between four mass points, with s to the right and t down,

    P(s, t) = A + B s + C t + D s t,    seen at pixel (x, y) where    X - x w = 0,  Y - y w = 0.

No vertex is stored. A pixel inside the outline of a cell solves these two equations, which tells the small quad, its
side of the diagonal the triangle, and the triangle's own two linear equations the place on it. A cell that is folded or
reaches behind the camera is drawn triangle by triangle instead.

The picture is cut into bands of rows, each drawn by one thread, and a row into chunks of as many pixels as a vector has
lanes, on which every operation is one vector instruction; on a GPU of one pixel, and a band is a row. As in kernel 1,
vectors stay vectors down to the machine code; casts, and floor and abs of vectors, are written so that they can.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm import look
from taichi_msm.camera import View, view
from taichi_msm.runtime import ITERATIONS_PER_THREAD, Memory, lanes, our_compilation, started, ti
from taichi_msm.scene import Scene

# Rows of pixels of a band.
BAND_ROWS = 16

# Farther than anything that is drawn.
INFINITY = 3e38

# A triangle that is drawn by itself may be overstepped, so that no gap is left beside it: by so much of its side, and
# of the picture's, for which f32 has places.
OVERSTEP = 1e-5
OVERSTEP_OF_PICTURE = 2e-6

# Beyond so many samples f32 has no places for the outline of a cell that is drawn as a whole.
FARTHEST = float(1 << 16)

# What is kept of a mass point: (X, Y, w, depth), its place in the picture [samples], its unit normal.
SEEN, NORMAL, POINT_NUMBERS = 4, 6, 9

vec4 = ti.types.vector(4, ti.f32)


@dataclass(frozen=True)
class Code:
    """What the kernel is compiled for; all else is an argument.

    Attributes:
        refined: whether vertices are inserted between mass points.
        supersample: samples of a pixel along each axis.
        lit: whether there is a headlight.
        wireframe: whether the mass-point mesh is drawn.
        lanes: samples of a chunk.
    """

    refined: bool
    supersample: int
    lit: bool
    wireframe: bool
    lanes: int

    @property
    def planes(self) -> int:
        """How many arrays hold the colours: one with all channels, or, where samples are averaged, one for each."""
        return 1 if self.supersample == 1 else 3


def structure(scene: Scene) -> Code:
    """Find out what the scene's picture needs."""
    render = scene.render
    return Code(
        refined=render.refine > 0,
        supersample=render.supersample,
        lit=render.shading == "headlight",
        wireframe=render.wireframe,
        lanes=lanes("f32"),
    )


class Drawing:
    """Draws one scene's sheet; `runtime.start` comes first.

    Args:
        scene: a checked scene.
        texture: the picture on the sheet, shape (height, width, 3).
        code: another than the scene's own; for tests.
    """

    def __init__(self, scene: Scene, texture: NDArray[np.uint8], code: Code | None = None) -> None:
        self.scene = scene
        self.code = code or structure(scene)
        self._draw = _kernel(self.code)
        self._view = view(scene)
        (rows, cols), (width, height), factor = scene.sheet.points, scene.render.size, self.code.supersample
        samples = height * factor * -(-width * factor // self.code.lanes)
        self._memory = memory = Memory()
        self._point = memory.array("f32", 0, rows * cols * POINT_NUMBERS)
        # Of every row of mass points its highest and its lowest place in the picture.
        self._reach = memory.array("f32", 0, rows * 2)
        # Of every sample the depth of what is seen there, and its colour.
        self._depth = memory.array("f32", self.code.lanes, samples)
        self._colour = memory.array("f32", self.code.lanes, samples * self.code.planes)
        background = np.array([scene.render.background], np.float32)
        self._background = _packed(background) if self.code.planes == 1 else background[0]
        self._texels: Any = _packed(texture).ravel()
        self._texture_size = texture.shape[1], texture.shape[0]
        if started().arch != "cpu":
            # Kept there, or it would travel there and back with every picture.
            packed, self._texels = self._texels, ti.ndarray(ti.f32, self._texels.size)
            self._texels.from_numpy(packed)

    def draw(self, position: NDArray[Any], camera: View | None = None) -> NDArray[np.uint8]:
        """Draw the sheet.

        Args:
            position: positions of the mass points [m], shape (rows, cols, 3).
            camera: another view than the scene's.

        Returns:
            Colours, shape (height, width, 3).
        """
        camera = camera or self._view
        (rows, cols), (width, height), factor = self.scene.sheet.points, self.scene.render.size, self.code.supersample
        scale = np.array([[factor], [factor], [1], [1]])
        out = np.empty(height * width * 3, np.uint8)
        with our_compilation(optimised=False):
            self._draw(
                np.ascontiguousarray(position, np.float32),
                self._texels,
                np.ascontiguousarray(camera.matrix * scale, np.float32),
                np.ascontiguousarray(camera.toward, np.float32),
                self._background,
                camera.near,
                self.scene.render.refine + 1,
                rows,
                cols,
                width,
                height,
                *self._texture_size,
                BAND_ROWS if started().arch == "cpu" else 1,
                self._point,
                self._reach,
                self._depth,
                self._colour,
                out,
            )
        return out.reshape(height, width, 3)


def _packed(colours: NDArray[Any]) -> NDArray[np.float32]:
    """Make one number of each colour, red + 256 green + 65536 blue, for which f32 has places."""
    return colours.astype(np.float32) @ np.array([1, 1 << 8, 1 << 16], np.float32)


@cache
def _kernel(code: Code) -> Callable[..., None]:
    """Make the kernel of one code."""
    lanes, factor, lit, wireframe, planes = code.lanes, code.supersample, code.lit, code.wireframe, code.planes
    floats, integers = ti.types.vector(lanes, ti.f32), ti.types.vector(lanes, ti.i32)
    centres = [lane + 0.5 for lane in range(lanes)]

    @ti.func
    def absolute(values):
        return ti.max(values, values * (-1.0))

    @ti.func
    def whole_numbers(values):
        return integers([ti.cast(values[lane], ti.i32) for lane in ti.static(range(lanes))])

    @ti.func
    def any_of(mask):
        return ti.select(mask, floats(1), floats(0)).max() > 0.0

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
    def edge(p_x, p_y, q_x, q_y, x, y):
        """Twice the area of p, q and (x, y), of one sign on each side; the same bits for both cells of an edge."""
        return (q_x - p_x) * (y - p_y) - (q_y - p_y) * (x - p_x)

    @ti.func
    def turn(p_x, p_y, q_x, q_y, r_x, r_y):
        return (q_x - p_x) * (r_y - q_y) - (q_y - p_y) * (r_x - q_x)

    @ti.func
    def texels(texture: ti.template(), index):
        """Gather texels, packed as they are in a sample: red + 256 green + 65536 blue, which f32 has places for."""
        return floats([texture[index[lane]] for lane in ti.static(range(lanes))])

    @ti.func
    def channels(packed):
        blue = ti.floor(packed * (1.0 / 65536.0))
        rest = packed - blue * 65536.0
        green = ti.floor(rest * (1.0 / 256.0))
        return rest - green * 256.0, green, blue

    @ti.func
    def between(upper_left, upper_right, lower_left, lower_right, u, v):
        up = upper_left + (upper_right - upper_left) * u
        low = lower_left + (lower_right - lower_left) * u
        return up + (low - up) * v

    @ti.func
    def wire_share(across, down, right_across, right_down, below_across, below_down):
        """Share of the mesh lines in a sample's colour, from places on the mesh; see `reference.wire_share`."""
        to_right, to_below = right_across - across, below_across - across
        slope = ti.sqrt(to_right * to_right + to_below * to_below)
        distance = absolute(across - ti.round(across)) / ti.max(slope, 1e-12)
        to_right, to_below = right_down - down, below_down - down
        slope = ti.sqrt(to_right * to_right + to_below * to_below)
        distance = ti.min(distance, absolute(down - ti.round(down)) / ti.max(slope, 1e-12))
        reach = look.WIRE_WIDTH / 2 * factor + 0.5
        return look.WIRE_OPACITY * ti.max(ti.min(reach - distance, 1.0), 0.0)

    @ti.func
    def small_quad(x, y, inside, side, parts, a, b, c, d):
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
        ad = a_1 * d_2 - d_1 * a_2
        bc = b_1 * c_2 - c_1 * b_2
        ac = a_1 * c_2 - c_1 * a_2
        ab = a_1 * b_2 - b_1 * a_2
        bd = b_1 * d_2 - d_1 * b_2
        linear = ad + bc
        root = ti.sqrt(ti.max(linear * linear - 4.0 * bd * ac, 0.0)) * side
        s = ti.select(inside, -2.0 * ac / (linear + root), 0.0)
        t = ti.select(inside, -2.0 * ab / (ad - bc - root), 0.0)
        return (
            ti.max(ti.min(ti.floor(s * parts), parts - 1.0), 0.0),
            ti.max(ti.min(ti.floor(t * parts), parts - 1.0), 0.0),
        )

    @ti.func
    def draw_cell(
        point: ti.template(), depth: ti.template(), colour: ti.template(), texture: ti.template(),
        toward: ti.template(), i, j, top, bottom, width, height, near, count, rows, cols, texture_width, texture_height,
    ):  # fmt: skip
        """Draw what is in rows top to bottom - 1 of the cell to the right and below of mass point (i, j)."""
        corner = (i * cols + j) * POINT_NUMBERS
        corner_b, corner_c = corner + POINT_NUMBERS, corner + cols * POINT_NUMBERS
        corner_d = corner_c + POINT_NUMBERS
        a = vec4([point[corner + n] for n in ti.static(range(4))])
        right = vec4([point[corner_b + n] for n in ti.static(range(4))])
        down = vec4([point[corner_c + n] for n in ti.static(range(4))])
        far = vec4([point[corner_d + n] for n in ti.static(range(4))])
        b = right - a
        c = down - a
        d = far - right - c
        a_x, a_y = point[corner + SEEN], point[corner + SEEN + 1]
        b_x, b_y = point[corner_b + SEEN], point[corner_b + SEEN + 1]
        c_x, c_y = point[corner_c + SEEN], point[corner_c + SEEN + 1]
        d_x, d_y = point[corner_d + SEEN], point[corner_d + SEEN + 1]
        before = a[2] > near and right[2] > near and down[2] > near and far[2] > near
        abd = turn(a_x, a_y, b_x, b_y, d_x, d_y)
        bdc = turn(b_x, b_y, d_x, d_y, c_x, c_y)
        dca = turn(d_x, d_y, c_x, c_y, a_x, a_y)
        cab = turn(c_x, c_y, a_x, a_y, b_x, b_y)
        convex = ti.min(abd, bdc, dca, cab) > 0 or ti.max(abd, bdc, dca, cab) < 0
        left_end, right_end = ti.min(a_x, b_x, c_x, d_x), ti.max(a_x, b_x, c_x, d_x)
        upper_end, lower_end = ti.min(a_y, b_y, c_y, d_y), ti.max(a_y, b_y, c_y, d_y)
        whole = (
            before and convex and ti.max(-left_end, right_end) < FARTHEST and ti.max(-upper_end, lower_end) < FARTHEST
        )
        side = ti.select(abd > 0, 1.0, -1.0)
        parts = ti.cast(count, ti.f32)
        part = 1.0 / parts

        pieces = ti.select(whole, 1, 2 * count * count)
        for piece in range(pieces):
            # Of a triangle that is drawn by itself: its quad, and whether it is below the diagonal.
            quad = piece // 2
            quad_s = ti.cast(quad % count, ti.f32)
            quad_t = ti.cast(quad // count, ti.f32)
            lower = piece % 2 == 0
            low_x, high_x, low_y, high_y = 0.0, ti.cast(width, ti.f32), -INFINITY, INFINITY
            overstep = OVERSTEP
            if whole:
                low_x, high_x, low_y, high_y = left_end, right_end, upper_end, lower_end
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
                    extent = ti.max(high_x - low_x, high_y - low_y, 1e-3)
                    overstep += OVERSTEP_OF_PICTURE * (width + height) / extent
                elif one[2] <= near and two[2] <= near and three[2] <= near:
                    high_x = -1.0
            first_row = ti.cast(ti.math.clamp(ti.floor(low_y), top, bottom), ti.i32)
            end_row = ti.cast(ti.math.clamp(ti.ceil(high_y + 0.5), top, bottom), ti.i32)
            first_chunk = ti.cast(ti.math.clamp(ti.floor(low_x), 0.0, width), ti.i32) // lanes
            end_chunk = ti.cast(ti.math.clamp(ti.ceil(high_x + 0.5), 0.0, width) + (lanes - 1), ti.i32) // lanes
            chunks = (width + lanes - 1) // lanes
            for row in range(first_row, end_row):
                y = row + 0.5
                for chunk in range(first_chunk, end_chunk):
                    x = floats(centres) + ti.cast(chunk * lanes, ti.f32)
                    inside = floats(1) > 0.0
                    column, line = floats(quad_s), floats(quad_t)
                    if whole:
                        # Left and upper edges belong to a cell, right and lower ones do not.
                        inside = (
                            (edge(a_x, a_y, c_x, c_y, x, y) * side <= 0.0)
                            & (edge(b_x, b_y, d_x, d_y, x, y) * side > 0.0)
                            & (edge(a_x, a_y, b_x, b_y, x, y) * side >= 0.0)
                            & (edge(c_x, c_y, d_x, d_y, x, y) * side < 0.0)
                        )
                    if any_of(inside):
                        if ti.static(code.refined) and whole:
                            column, line = small_quad(x, y, inside, side, parts, a, b, c, d)
                        draw_samples(
                            point, depth, colour, texture, toward, row * chunks + chunk, x, y, inside, column, line,
                            whole, lower, overstep, side, near, part, a, b, c, d,
                            i, j, rows, cols, texture_width, texture_height,
                        )  # fmt: skip

    @ti.func
    def draw_samples(
        point: ti.template(), depth: ti.template(), colour: ti.template(), texture: ti.template(),
        toward: ti.template(), at, x, y, inside, column, line, whole, lower, overstep, side, near, part,
        a, b, c, d, i, j, rows, cols, texture_width, texture_height,
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
        ) * side >= 0.0
        if not whole:
            below = floats(ti.cast(lower, ti.f32)) > 0.5
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
                & (upper_limit <= 1.0 + overstep)
                & (lower_limit <= upper_limit + overstep)
                & (p_w + r_w * s + d_w * t > near)
            )
        z = p_z + r_z * s + d_z * t
        visible = inside & (z < depth[at])
        if any_of(visible):
            across = ti.select(visible, (column + s) * part, 0.0)
            along = ti.select(visible, (line + t) * part, 0.0)
            # Where the texture is, in texels, exact to a fraction of one on any sheet.
            texel_x = ti.cast(j, ti.f64) * texture_width / (cols - 1) - 0.5
            texel_y = ti.cast(i, ti.f64) * texture_height / (rows - 1) - 0.5
            first_x = ti.floor(texel_x, ti.i32)
            first_y = ti.floor(texel_y, ti.i32)
            u = ti.cast(texel_x - first_x, ti.f32) + across * (ti.cast(texture_width, ti.f32) / (cols - 1))
            v = ti.cast(texel_y - first_y, ti.f32) + along * (ti.cast(texture_height, ti.f32) / (rows - 1))
            floor_u = ti.floor(u)
            floor_v = ti.floor(v)
            left = whole_numbers(floor_u) + first_x
            upper = whole_numbers(floor_v) + first_y
            right = ti.max(ti.min(left + 1, texture_width - 1), 0)
            under = ti.max(ti.min(upper + 1, texture_height - 1), 0) * texture_width
            left = ti.max(ti.min(left, texture_width - 1), 0)
            upper = ti.max(ti.min(upper, texture_height - 1), 0) * texture_width
            red_ul, green_ul, blue_ul = channels(texels(texture, upper + left))
            red_ur, green_ur, blue_ur = channels(texels(texture, upper + right))
            red_ll, green_ll, blue_ll = channels(texels(texture, under + left))
            red_lr, green_lr, blue_lr = channels(texels(texture, under + right))
            u = u - floor_u
            v = v - floor_v
            red = between(red_ul, red_ur, red_ll, red_lr, u, v)
            green = between(green_ul, green_ur, green_ll, green_lr, u, v)
            blue = between(blue_ul, blue_ur, blue_ll, blue_lr, u, v)
            if ti.static(lit):
                normal = [floats(0) for _ in ti.static(range(3))]
                corner = (i * cols + j) * POINT_NUMBERS + NORMAL
                for n in ti.static(range(3)):
                    n_a, n_b = point[corner + n], point[corner + POINT_NUMBERS + n]
                    n_c, n_d = point[corner + cols * POINT_NUMBERS + n], point[corner + (cols + 1) * POINT_NUMBERS + n]
                    normal[n] = n_a + (n_b - n_a) * across + (n_c - n_a + (n_d - n_b - (n_c - n_a)) * across) * along
                n_x, n_y, n_z = normal[0], normal[1], normal[2]
                length = ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
                light = absolute(n_x * toward[0] + n_y * toward[1] + n_z * toward[2]) / ti.max(length, 1e-30)
                red, green, blue = red * light, green * light, blue * light
            if ti.static(wireframe):
                s_right, t_right = on_triangle(x + 1.0, y, p_x, p_y, p_w, r_x, r_y, r_w, d_x, d_y, d_w)
                s_below, t_below = on_triangle(x, y + 1.0, p_x, p_y, p_w, r_x, r_y, r_w, d_x, d_y, d_w)
                wire = wire_share(
                    across, along,
                    (column + s_right) * part, (line + t_right) * part,
                    (column + s_below) * part, (line + t_below) * part,
                )  # fmt: skip
                red += (look.WIRE_COLOUR[0] - red) * wire
                green += (look.WIRE_COLOUR[1] - green) * wire
                blue += (look.WIRE_COLOUR[2] - blue) * wire
            depth[at] = ti.select(visible, z, depth[at])
            if ti.static(planes == 1):
                packed = ti.floor(red + 0.5) + ti.floor(green + 0.5) * 256.0 + ti.floor(blue + 0.5) * 65536.0
                colour[at * planes] = ti.select(visible, packed, colour[at * planes])
            else:
                colour[at * planes] = ti.select(visible, red, colour[at * planes])
                colour[at * planes + 1] = ti.select(visible, green, colour[at * planes + 1])
                colour[at * planes + 2] = ti.select(visible, blue, colour[at * planes + 2])

    @ti.func
    def resolve(colour: ti.template(), row, width, out: ti.template()):
        """Give out the colours of a row of pixels, each the mean of its samples."""
        chunks = (width * factor + lanes - 1) // lanes
        for x in range(width):
            for n in ti.static(range(3)):
                total = 0.0
                for v, u in ti.static(ti.ndrange(factor, factor)):
                    sample = x * factor + u
                    total += colour[((row * factor + v) * chunks + sample // lanes) * planes + n][sample % lanes]
                out[(row * width + x) * 3 + n] = ti.cast(ti.cast(total / (factor * factor) + 0.5, ti.i32), ti.u8)

    @ti.func
    def unpack(colour: ti.template(), row, width, out: ti.template()):
        """Give out the colours of a row of pixels of one sample each."""
        chunks = (width + lanes - 1) // lanes
        for chunk in range(chunks):
            packed = colour[row * chunks + chunk]
            at = (row * width + chunk * lanes) * 3
            for lane in ti.static(range(lanes)):
                if chunk * lanes + lane < width:
                    bits = ti.cast(packed[lane], ti.i32)
                    for n in ti.static(range(3)):
                        out[at + 3 * lane + n] = ti.cast((bits >> (8 * n)) & 255, ti.u8)

    @ti.func
    def project(position: ti.template(), matrix: ti.template(), point: ti.template(), i, j, rows, cols):
        """Note where mass point (i, j) is seen, and its normal."""
        here = (i * cols + j) * POINT_NUMBERS
        x, y, z = position[i, j, 0], position[i, j, 1], position[i, j, 2]
        for n in ti.static(range(4)):
            point[here + n] = matrix[n, 0] * x + matrix[n, 1] * y + matrix[n, 2] * z + matrix[n, 3]
        point[here + SEEN] = point[here] / point[here + 2]
        point[here + SEEN + 1] = point[here + 1] / point[here + 2]
        if ti.static(lit):
            i0, i1 = ti.max(i - 1, 0), ti.min(i + 1, rows - 1)
            j0, j1 = ti.max(j - 1, 0), ti.min(j + 1, cols - 1)
            r_x = position[i, j1, 0] - position[i, j0, 0]
            r_y = position[i, j1, 1] - position[i, j0, 1]
            r_z = position[i, j1, 2] - position[i, j0, 2]
            u_x = position[i0, j, 0] - position[i1, j, 0]
            u_y = position[i0, j, 1] - position[i1, j, 1]
            u_z = position[i0, j, 2] - position[i1, j, 2]
            n_x = r_y * u_z - r_z * u_y
            n_y = r_z * u_x - r_x * u_z
            n_z = r_x * u_y - r_y * u_x
            length = ti.max(ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), 1e-30)
            point[here + NORMAL] = n_x / length
            point[here + NORMAL + 1] = n_y / length
            point[here + NORMAL + 2] = n_z / length

    @ti.kernel
    def draw(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3),
        texture: ti.types.ndarray(dtype=ti.f32, ndim=1),
        matrix: ti.types.ndarray(dtype=ti.f32, ndim=2),
        toward: ti.types.ndarray(dtype=ti.f32, ndim=1),
        background: ti.types.ndarray(dtype=ti.f32, ndim=1),
        near: ti.f32,
        parts: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        s_width: ti.i32,
        s_height: ti.i32,
        texture_width: ti.i32,
        texture_height: ti.i32,
        band_rows: ti.i32,
        point: ti.types.ndarray(dtype=ti.f32, ndim=1),
        reach: ti.types.ndarray(dtype=ti.f32, ndim=1),
        depth: ti.types.ndarray(dtype=floats, ndim=1),
        colour: ti.types.ndarray(dtype=floats, ndim=1),
        out: ti.types.ndarray(dtype=ti.u8, ndim=1),
    ):
        for index in range(rows * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                i = index // ITERATIONS_PER_THREAD
                low, high = INFINITY, -INFINITY
                for j in range(cols):
                    project(position, matrix, point, i, j, rows, cols)
                    here = (i * cols + j) * POINT_NUMBERS
                    if point[here + 2] > near:
                        low = ti.min(low, point[here + SEEN + 1])
                        high = ti.max(high, point[here + SEEN + 1])
                    else:
                        low, high = -INFINITY, INFINITY
                reach[2 * i] = low
                reach[2 * i + 1] = high

        for index in range((s_height + band_rows - 1) // band_rows * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                first_row = index // ITERATIONS_PER_THREAD * band_rows
                end_row = ti.min(first_row + band_rows, s_height)
                top, bottom, width = first_row * factor, end_row * factor, s_width * factor
                chunks = (width + lanes - 1) // lanes
                for at in range(top * chunks, bottom * chunks):
                    depth[at] = floats(INFINITY)
                    for n in ti.static(range(planes)):
                        colour[at * planes + n] = floats(0) + background[n]
                for i in range(rows - 1):
                    low = ti.min(reach[2 * i], reach[2 * i + 2])
                    high = ti.max(reach[2 * i + 1], reach[2 * i + 3])
                    if low < bottom and high > top:
                        for j in range(cols - 1):
                            draw_cell(
                                point, depth, colour, texture, toward, i, j, top, bottom,
                                width, s_height * factor, near, parts, rows, cols, texture_width, texture_height,
                            )  # fmt: skip
                for row in range(first_row, end_row):
                    if ti.static(factor == 1):
                        unpack(colour, row, s_width, out)
                    else:
                        resolve(colour, row, s_width, out)

    return draw
