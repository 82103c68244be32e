"""The kernels of tracking.py, in f64: cells and their bounds, and the search for what hides a point."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math

from taichi_msm.render.bins import BOUNDS, FIRST_X, FIRST_Y, LAST_X, LAST_Y
from taichi_msm.render.instrument_coverage import meet
from taichi_msm.render.labels import NO_FLOW
from taichi_msm.render.numbers import BOTTOM, LEFT, MATRIX, NEAR, PARTS, PINHOLE, RIGHT, ROD_NUMBERS, RODS, TOP
from taichi_msm.render.patch import Plane, edge, on_triangle, seen_side, small_quad
from taichi_msm.render.samples import INFINITY
from taichi_msm.system.launches import end_thread
from taichi_msm.system.runtime import ti

# The numbers of a mass point: (X, Y, w, depth), its place in the picture. The numbers of a cell: its bounds in the
# picture; its least depth; and its side, 0 for a cell drawn triangle by triangle, else 1 or -1 as its front or its back
# is seen.
SEEN, POINT_NUMBERS = 4, 6
MIN_X, MIN_Y, MAX_X, MAX_Y, NEAREST, SIDE, CELL_NUMBERS = range(7)

# Farther from the picture than any cell is followed [px].
FARTHEST = 1e6

# The cells around a mass point.
AROUND = 4

# The pixel of a point that is seen nowhere.
NOWHERE = math.nan

vec4 = ti.types.vector(4, ti.f64)


@ti.kernel
def project(
    position: ti.types.ndarray(dtype=ti.f64, ndim=3),
    numbers: ti.types.ndarray(dtype=ti.f64, ndim=1),
    rows: ti.i32,
    cols: ti.i32,
    width: ti.i32,
    height: ti.i32,
    point: ti.types.ndarray(dtype=ti.f64, ndim=1),
    cell: ti.types.ndarray(dtype=ti.f64, ndim=1),
    bounds: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Project the mass points, and find the outlines of the cells, and their bounds in whole pixels."""
    for index in range(rows * cols):
        i, j, here = index // cols, index % cols, index * POINT_NUMBERS
        for n in ti.static(range(4)):
            row = MATRIX + 4 * n
            value = numbers[row + 3]
            for axis in ti.static(range(3)):
                value += numbers[row + axis] * position[i, j, axis]
            point[here + n] = value
        point[here + SEEN] = point[here] / point[here + 2]
        point[here + SEEN + 1] = point[here + 1] / point[here + 2]

    for index in range((rows - 1) * (cols - 1)):
        near = numbers[NEAR]
        a = (index // (cols - 1) * cols + index % (cols - 1)) * POINT_NUMBERS
        b, c = a + POINT_NUMBERS, a + cols * POINT_NUMBERS
        d = c + POINT_NUMBERS
        a_x, a_y, b_x, b_y = point[a + SEEN], point[a + SEEN + 1], point[b + SEEN], point[b + SEEN + 1]
        c_x, c_y, d_x, d_y = point[c + SEEN], point[c + SEEN + 1], point[d + SEEN], point[d + SEEN + 1]
        here = index * CELL_NUMBERS
        cell[here + NEAREST] = ti.min(point[a + 3], point[b + 3], point[c + 3], point[d + 3])
        cell[here + SIDE] = seen_side(a_x, a_y, b_x, b_y, c_x, c_y, d_x, d_y)
        if point[a + 2] > near and point[b + 2] > near and point[c + 2] > near and point[d + 2] > near:
            cell[here + MIN_X], cell[here + MAX_X] = ti.min(a_x, b_x, c_x, d_x), ti.max(a_x, b_x, c_x, d_x)
            cell[here + MIN_Y], cell[here + MAX_Y] = ti.min(a_y, b_y, c_y, d_y), ti.max(a_y, b_y, c_y, d_y)
        elif point[a + 2] <= near and point[b + 2] <= near and point[c + 2] <= near and point[d + 2] <= near:
            cell[here + MIN_X], cell[here + MAX_X] = 1.0, -1.0
            cell[here + MIN_Y], cell[here + MAX_Y] = 1.0, -1.0
        else:
            cell[here + SIDE] = 0.0
            cell[here + MIN_X], cell[here + MAX_X] = -1e9, 1e9
            cell[here + MIN_Y], cell[here + MAX_Y] = -1e9, 1e9
        at = index * BOUNDS
        bounds[at + FIRST_X] = ti.cast(ti.floor(ti.math.clamp(cell[here + MIN_X], 0.0, FARTHEST)), ti.i32)
        bounds[at + FIRST_Y] = ti.cast(ti.floor(ti.math.clamp(cell[here + MIN_Y], 0.0, FARTHEST)), ti.i32)
        bounds[at + LAST_X] = ti.cast(ti.floor(ti.math.clamp(cell[here + MAX_X], -1.0, width - 1.0)), ti.i32)
        bounds[at + LAST_Y] = ti.cast(ti.floor(ti.math.clamp(cell[here + MAX_Y], -1.0, height - 1.0)), ti.i32)


@ti.kernel
def judge(
    first: ti.i32,
    end: ti.i32,
    ended: ti.types.ndarray(dtype=ti.i32, ndim=1),
    cell: ti.types.ndarray(dtype=ti.f64, ndim=1),
    cols: ti.i32,
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    entries: ti.types.ndarray(dtype=ti.i32, ndim=1),
    simple: ti.types.ndarray(dtype=ti.u8, ndim=1),
):
    """Mark the bins in which no two cells can be seen at the same place.

    This is so if the cells of a bin are among the four around one mass point, and these four are all drawn as a whole
    and seen from the same side: each is convex, so it lies within the angle between its two edges at the point, and
    the four angles add up to 360 degrees without overlapping.
    """
    for square in range(first, end):
        first_i, last_i, first_j, last_j = 1 << 30, -1, 1 << 30, -1
        length = starts[square + 1] - starts[square]
        for n in range(starts[square], starts[square] + ti.min(length, AROUND)):
            i, j = entries[n] // (cols - 1), entries[n] % (cols - 1)
            first_i, last_i = ti.min(first_i, i), ti.max(last_i, i)
            first_j, last_j = ti.min(first_j, j), ti.max(last_j, j)
        around_a_point = length <= AROUND and last_i - first_i <= 1 and last_j - first_j <= 1
        if around_a_point:
            sides, around = 0.0, 0.0
            # All four matter, even those that do not reach the bin.
            for i in range(first_i, last_i + 1):
                for j in range(first_j, last_j + 1):
                    sides += cell[(i * (cols - 1) + j) * CELL_NUMBERS + SIDE]
                    around += 1.0
            around_a_point = abs(sides) == around
        simple[square] = ti.cast(around_a_point, ti.u8)
        end_thread(ended)


@ti.func
def _corners(index, cols, point: ti.template()):
    """Give the coefficients A, B, C, D of a cell, each (X, Y, w, depth)."""
    at = (index // (cols - 1) * cols + index % (cols - 1)) * POINT_NUMBERS
    below = at + cols * POINT_NUMBERS
    a = vec4([point[at + n] for n in ti.static(range(4))])
    right = vec4([point[at + POINT_NUMBERS + n] for n in ti.static(range(4))])
    down = vec4([point[below + n] for n in ti.static(range(4))])
    far = vec4([point[below + POINT_NUMBERS + n] for n in ti.static(range(4))])
    return a, right - a, down - a, far - right - down + a


@ti.func
def _triangle(x, y, s0, t0, lower, part, near, a, b, c, d):
    """Find the depth at which (x, y) shows the plane of a small triangle, and whether that point is on the triangle.

    Args:
        x: place in the picture, to the right [px].
        y: likewise, down.
        s0: upper left corner of its small quad, to the right in the cell.
        t0: likewise, down.
        lower: whether it is the one below the diagonal.
        part: side of a small quad, as a fraction of the cell's.
        near: only what is farther than this is seen.
        a: coefficient A of the cell.
        b: likewise B.
        c: likewise C.
        d: likewise D.
    """
    p = a + b * s0 + (c + d * s0) * t0
    twist = d * (part * part)
    r = (b + d * t0) * part + ti.select(lower, twist, twist * 0.0)
    e = (c + d * s0) * part + ti.select(lower, twist * 0.0, twist)
    plane = ti.static(Plane(p[0], p[1], p[2], r[0], r[1], r[2], e[0], e[1], e[2]))
    s, t = on_triangle(x, y, plane)
    larger, smaller = ti.select(lower, t, s), ti.select(lower, s, t)
    inside = (smaller >= 0.0) & (larger <= 1.0) & (smaller <= larger) & (p[2] + r[2] * s + e[2] * t > near)
    return p[3] + r[3] * s + e[3] * t, inside


@ti.func
def _is_below(x, y, s0, t0, part, side, a, b, c, d):
    """Tell whether (x, y) is below the diagonal of a small quad of a cell that is drawn as a whole."""
    p = a + b * s0 + (c + d * s0) * t0
    s1, t1 = s0 + part, t0 + part
    f = a + b * s1 + (c + d * s1) * t1
    return ((p[0] - x * p[2]) * (f[1] - y * f[2]) - (p[1] - y * p[2]) * (f[0] - x * f[2])) * side >= 0.0


@ti.func
def _hides(x, y, depth, index, own, own_triangle, cols, parts, near, point: ti.template(), cell: ti.template()):
    """Tell whether a cell is seen at (x, y) at a smaller depth than `depth`.

    Args:
        x: place in the picture, to the right [px].
        y: likewise, down.
        depth: of the point [m].
        index: of the cell.
        own: the cell that the point is on.
        own_triangle: the small triangle of that cell that the point is on.
        cols: columns of mass points.
        parts: small quads along a side of a cell.
        near: only what is farther than this is seen.
        point: as `project` makes it.
        cell: likewise.
    """
    here, part = index * CELL_NUMBERS, 1.0 / parts
    side = cell[here + SIDE]
    hides = False
    # A cell that is drawn as a whole shows at most one of its points at a place of the picture.
    possible = cell[here + NEAREST] < depth and not (index == own and side != 0.0)
    if (
        possible
        and x >= cell[here + MIN_X]
        and x <= cell[here + MAX_X]
        and y >= cell[here + MIN_Y]
        and y <= cell[here + MAX_Y]
    ):
        a, b, c, d = _corners(index, cols, point)
        if side != 0.0:
            at = (index // (cols - 1) * cols + index % (cols - 1)) * POINT_NUMBERS + SEEN
            below = at + cols * POINT_NUMBERS
            a_x, a_y, b_x, b_y = point[at], point[at + 1], point[at + POINT_NUMBERS], point[at + POINT_NUMBERS + 1]
            c_x, c_y, d_x, d_y = (
                point[below], point[below + 1], point[below + POINT_NUMBERS], point[below + POINT_NUMBERS + 1]
            )  # fmt: skip
            if (
                edge(a_x, a_y, c_x, c_y, x, y, side) <= 0.0
                and edge(b_x, b_y, d_x, d_y, x, y, side) >= 0.0
                and edge(a_x, a_y, b_x, b_y, x, y, side) >= 0.0
                and edge(c_x, c_y, d_x, d_y, x, y, side) <= 0.0
            ):
                column, line = small_quad(x, y, True, parts, side, a, b, c, d)
                s0, t0 = column * part, line * part
                lower = _is_below(x, y, s0, t0, part, side, a, b, c, d)
                seen, _ = _triangle(x, y, s0, t0, lower, part, near, a, b, c, d)
                hides = seen < depth
        else:
            per_side = ti.cast(parts, ti.i32)
            for triangle in range(2 * per_side * per_side):
                if not hides and not (index == own and triangle == own_triangle):
                    quad = triangle // 2
                    s0, t0 = ti.cast(quad % per_side, ti.f64) * part, ti.cast(quad // per_side, ti.f64) * part
                    seen, inside = _triangle(x, y, s0, t0, triangle % 2 == 1, part, near, a, b, c, d)
                    hides = inside and seen < depth
    return hides


@ti.kernel
def search(
    first: ti.i32,
    end: ti.i32,
    ended: ti.types.ndarray(dtype=ti.i32, ndim=1),
    listed: ti.i32,
    count: ti.i32,
    coordinates: ti.types.ndarray(dtype=ti.f32, ndim=1),
    row: ti.i32,
    point: ti.types.ndarray(dtype=ti.f64, ndim=1),
    cell: ti.types.ndarray(dtype=ti.f64, ndim=1),
    rows: ti.i32,
    cols: ti.i32,
    width: ti.i32,
    height: ti.i32,
    bin_size: ti.i32,
    across: ti.i32,
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    entries: ti.types.ndarray(dtype=ti.i32, ndim=1),
    simple: ti.types.ndarray(dtype=ti.u8, ndim=1),
    touching: ti.f64,
    numbers: ti.types.ndarray(dtype=ti.f64, ndim=1),
    rod_count: ti.i32,
    pixels: ti.types.ndarray(dtype=ti.f32, ndim=1),
    hidden: ti.types.ndarray(dtype=ti.u8, ndim=1),
):
    """Find where material points are seen, and which are hidden by `count` cells of their lists from `listed` on.

    If `row` is 0, `pixels` gets their places [px]. Otherwise they are what the pixels of another frame showed, `row` of
    them in a row of the picture, and `pixels` gets how far each has moved from its pixel's centre [px].
    """
    for k in range(first, end):
        near, parts = numbers[NEAR], numbers[PARTS]
        u, v = coordinates[2 * k], coordinates[2 * k + 1]
        x, y, out_of_sight = ti.cast(NOWHERE, ti.f64), ti.cast(NOWHERE, ti.f64), False
        if abs(u) < 2.0:  # False for NaN
            s = ti.math.clamp(ti.cast(u, ti.f64), 0.0, 1.0) * (cols - 1)
            t = ti.math.clamp(ti.cast(v, ti.f64), 0.0, 1.0) * (rows - 1)
            j, i = ti.min(ti.cast(s, ti.i32), cols - 2), ti.min(ti.cast(t, ti.i32), rows - 2)
            s, t = s - j, t - i
            own, part = i * (cols - 1) + j, 1.0 / parts
            column, line = ti.min(ti.floor(s * parts), parts - 1.0), ti.min(ti.floor(t * parts), parts - 1.0)
            s0, t0 = column * part, line * part
            s1, t1 = s - s0, t - t0
            own_triangle = 2 * ti.cast(line * parts + column, ti.i32) + ti.cast(t1 > s1, ti.i32)
            a, b, c, d = _corners(own, cols, point)
            # In the small quad, D s t is replaced by a function that is linear on either side of the diagonal.
            p = a + b * s + c * t + d * (s0 * t0 + s1 * t0 + s0 * t1 + ti.min(s1, t1) * part)
            out_of_sight = True
            if p[2] > near:
                x, y = p[0] / p[2], p[1] / p[2]
                if x >= 0.0 and y >= 0.0 and x < width and y < height:
                    out_of_sight = False
                    depth = p[3] - touching
                    square = ti.cast(y, ti.i32) // bin_size * across + ti.cast(x, ti.i32) // bin_size
                    if simple[square] == 0:
                        begin = starts[square] + listed
                        for n in range(begin, ti.min(begin + count, starts[square + 1])):
                            if not out_of_sight:
                                out_of_sight = _hides(
                                    x, y, depth, entries[n], own, own_triangle, cols, parts, near, point, cell
                                )
                    for n in range(rod_count):
                        rod = RODS + n * ROD_NUMBERS
                        across_it = x >= numbers[rod + LEFT] and x <= numbers[rod + RIGHT]
                        if across_it and y >= numbers[rod + TOP] and y <= numbers[rod + BOTTOM]:
                            met, _, _, _ = meet(x, y, n, numbers)
                            if met < depth and met * numbers[PINHOLE] + (1.0 - numbers[PINHOLE]) > near:
                                out_of_sight = True
        if row > 0:
            seen = x > -INFINITY  # False for NaN
            x = ti.select(seen, x - ti.cast(k % row, ti.f64) - 0.5, NO_FLOW)
            y = ti.select(seen, y - ti.cast(k // row, ti.f64) - 0.5, NO_FLOW)
        pixels[2 * k] = ti.cast(x, ti.f32)
        pixels[2 * k + 1] = ti.cast(y, ti.f32)
        if listed > 0:
            out_of_sight = out_of_sight or hidden[k] > 0
        hidden[k] = ti.cast(out_of_sight, ti.u8)
        end_thread(ended)
