"""Projected mass points, cells and triangles, for one sample or a vector of samples, in f32 or f64.

A projected point is (X, Y, w, depth), the product of the camera's matrix and the point. The product is linear, so the
subdivision of a projected cell is exact, also in perspective. With s to the right and t down, a cell is the surface

    P(s, t) = A + B s + C t + D s t,    and sample (x, y) shows its point with    X - x w = 0,  Y - y w = 0.

A cell is divided into sub-quads, and a sub-quad into two triangles by its diagonal from the upper left to the lower
right. The order of corners is by rows: upper left and right, lower left and right.
"""

from typing import Any, NamedTuple

from taichi_msm.render import lens_kernels
from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import INFINITY, cross
from taichi_msm.system.runtime import ti

# Layout of `nodes`: blocks of projections, normals, distorted positions, and points of a picture by a camera, each with
# its stride per mass point. In f64 (tracking.py) only the first block exists.
NODE_STRIDE = 6  # X, Y, w, depth; from SCREEN on x and y in the picture [samples]
SCREEN = 4
NORMAL_STRIDE = 3
DISTORTED_STRIDE = 3  # x and y [samples]; 1 in front of the camera and within the limit of the lens, else 0
POINT_STRIDE = NODE_STRIDE + NORMAL_STRIDE + DISTORTED_STRIDE

# Enlargement of triangles that are drawn one by one, which closes the gaps between them: a fraction of their side, and
# a fraction of the picture's side, the resolution of f32.
ENLARGEMENT = 1e-5
SCREEN_ENLARGEMENT = 2e-6

# Largest coordinate of an invertible cell's corner, a limit of f32 [samples].
MAX_COORDINATE = float(1 << 16)


class Outline(NamedTuple):
    """Projected corners of a cell, and their bounding box [samples]."""

    x: Any  # lists of the corners' columns and rows
    y: Any
    left: Any  # of the bounding box
    right: Any
    top: Any
    bottom: Any
    facing: Any  # 1 if the front is visible, -1 for the back, 0 if the cell is folded
    in_front: Any  # whether all corners are beyond the near plane, in front of the camera
    behind: Any  # whether no corner is beyond the near plane


class Patch(NamedTuple):
    """Bilinear surface of a cell: coefficients A to D, vectors (X, Y, w, depth)."""

    a: Any
    b: Any
    c: Any
    d: Any
    facing: Any  # as in `Outline`
    invertible: Any  # whether the cell is drawn by inverting the bilinear map, instead of triangle by triangle


class Triangle(NamedTuple):
    """Triangle P + R s + D t of a sub-quad: lists of X, Y, w and depth."""

    p: Any  # upper left corner
    r: Any  # side to the right
    d: Any  # side down
    below: Any  # whether it is the triangle below the diagonal, where t > s


@ti.func
def project(position: ti.template(), i, j, cols, uniforms: ti.template(), nodes: ti.template(), double: ti.template()):
    """Project a mass point, and store its X, Y, w, depth, x and y; for f64 (`double`), the sum has another order."""
    entry = (i * cols + j) * NODE_STRIDE
    x, y, z = position[i, j, 0], position[i, j, 1], position[i, j, 2]
    for n in ti.static(range(4)):
        row = uni.MATRIX + 4 * n
        if ti.static(double):
            nodes[entry + n] = uniforms[row + 3] + uniforms[row] * x + uniforms[row + 1] * y + uniforms[row + 2] * z
        else:
            nodes[entry + n] = uniforms[row] * x + uniforms[row + 1] * y + uniforms[row + 2] * z + uniforms[row + 3]
    nodes[entry + SCREEN] = nodes[entry] / nodes[entry + 2]
    nodes[entry + SCREEN + 1] = nodes[entry + 1] / nodes[entry + 2]


@ti.func
def w_at(depth, uniforms: ti.template()):
    """Return w at a depth [m]: for a pinhole camera the depth, otherwise 1."""
    return depth * uniforms[uni.PINHOLE] + (1.0 - uniforms[uni.PINHOLE])


@ti.func
def line_of_sight(x, y, uniforms: ti.template()):
    """Return the components of lines of sight to the right and up, at w = 1 [m]."""
    return (x - uniforms[uni.CENTRE_X]) * uniforms[uni.SPREAD_X], (uniforms[uni.CENTRE_Y] - y) * uniforms[uni.SPREAD_Y]


@ti.func
def point_entries(point, band: ti.template()):
    """Return the first entries of a mass point, of its normal and of its distorted position in `nodes`."""
    points = band.rows * band.cols
    return (
        point * NODE_STRIDE,
        points * NODE_STRIDE + point * NORMAL_STRIDE,
        points * (NODE_STRIDE + NORMAL_STRIDE) + point * DISTORTED_STRIDE,
    )


@ti.func
def picture_entry(point, band: ti.template()):
    """Return the first entry of a mass point in the picture's camera in `nodes`."""
    return band.rows * band.cols * POINT_STRIDE + point * band.config.picture_stride


@ti.func
def corner_entry(cell, cols):
    """Return the first entry of a cell's upper left mass point in `nodes`."""
    return (cell // (cols - 1) * cols + cell % (cols - 1)) * NODE_STRIDE


@ti.func
def corner_entries(first, cols, stride: ti.template()):
    """Return the entries of the corners of a cell from that of the upper left one, with `stride` per mass point."""
    below = first + cols * stride
    return ti.static((first, first + stride, below, below + stride))


@ti.func
def cell_outline(corner, cols, near, nodes: ti.template()):
    """Return the `Outline` of a cell."""
    corners = ti.static(corner_entries(corner, cols, NODE_STRIDE))
    x = [nodes[entry + SCREEN] for entry in corners]
    y = [nodes[entry + SCREEN + 1] for entry in corners]
    w = [nodes[entry + 2] for entry in corners]
    # Twice the signed areas of the triangles of three corners, positive if clockwise in the picture.
    turns = [
        (x[m] - x[n]) * (y[k] - y[m]) - (y[m] - y[n]) * (x[k] - x[m])
        for n, m, k in ti.static(((0, 1, 3), (1, 3, 2), (3, 2, 0), (2, 0, 1)))
    ]
    facing = ti.select(ti.min(*turns) > 0, 1.0, ti.select(ti.max(*turns) < 0, -1.0, 0.0))
    in_front = w[0] > near and w[1] > near and w[2] > near and w[3] > near
    behind = w[0] <= near and w[1] <= near and w[2] <= near and w[3] <= near
    left, right, top, bottom = ti.min(*x), ti.max(*x), ti.min(*y), ti.max(*y)
    return ti.static(Outline(x, y, left, right, top, bottom, facing, in_front, behind))


@ti.func
def is_invertible(outline: ti.template()):
    """Return whether the bilinear map of a cell can be inverted in f32."""
    return (
        outline.in_front
        and outline.facing != 0
        and ti.max(-outline.left, outline.right) < MAX_COORDINATE
        and ti.max(-outline.top, outline.bottom) < MAX_COORDINATE
    )


@ti.func
def cell_patch(corner, cols, facing, invertible, nodes: ti.template(), double: ti.template()):
    """Return the `Patch` of a cell; for f64 (`double`), the sum in D has another order."""
    corners = ti.static(corner_entries(corner, cols, NODE_STRIDE))
    a, right, down, opposite = [ti.Vector([nodes[entry + n] for n in ti.static(range(4))]) for entry in corners]
    b, c = right - a, down - a
    d = opposite - right - down + a if ti.static(double) else opposite - right - c
    return ti.static(Patch(a, b, c, d, facing, invertible))


@ti.func
def edge(p_x, p_y, q_x, q_y, x, y, facing):
    """Return twice the signed area of the triangle p, q, (x, y), times `facing`; the sign is the side of the line p q.

    Both cells at an edge compute the same bits, up to the sign.
    """
    step_x, step_y = (q_x - p_x) * facing, (q_y - p_y) * facing
    return step_x * (y - p_y) - step_y * (x - p_x)


@ti.func
def edges(x, y, facing, outline: ti.template()):
    """Return `edge` of the left, right, upper and lower edge of a cell; all are 0 or more inside the cell."""
    p, q = ti.static((outline.x, outline.y))
    return (
        edge(p[0], q[0], p[2], q[2], x, y, -facing),
        edge(p[1], q[1], p[3], q[3], x, y, facing),
        edge(p[0], q[0], p[1], q[1], x, y, facing),
        edge(p[2], q[2], p[3], q[3], x, y, -facing),
    )


@ti.func
def find_quads(x, y, inside, subdivisions, patch: ti.template()):
    """Return the column and the row of the sub-quads at samples, by inverting the bilinear map of their cell.

    Samples that are not `inside` have sub-quad (0, 0).
    """
    # The two equations are a_1 + b_1 s + c_1 t + d_1 s t = 0, and the same with 2.
    coefficients = ti.static((patch.a, patch.b, patch.c, patch.d))
    a_1, b_1, c_1, d_1 = [k[0] - x * k[2] for k in coefficients]
    a_2, b_2, c_2, d_2 = [k[1] - y * k[2] for k in coefficients]
    # Eliminating t gives bd s^2 + (ad + bc) s + ac = 0; eliminating s gives an equation with the same discriminant.
    ad = a_1 * d_2 - d_1 * a_2
    bc = b_1 * c_2 - c_1 * b_2
    ac = a_1 * c_2 - c_1 * a_2
    ab = a_1 * b_2 - b_1 * a_2
    bd = b_1 * d_2 - d_1 * b_2
    linear = ad + bc
    root = ti.sqrt(ti.max(linear * linear - 4.0 * bd * ac, 0.0)) * patch.facing
    s = ti.select(inside, -2.0 * ac / (linear + root), 0.0)
    t = ti.select(inside, -2.0 * ab / (ad - bc - root), 0.0)
    return (
        ti.max(ti.min(ti.floor(s * subdivisions), subdivisions - 1.0), 0.0),
        ti.max(ti.min(ti.floor(t * subdivisions), subdivisions - 1.0), 0.0),
    )


@ti.func
def triangle_at(x, y, quad_column, quad_row, quad_side, lower, patch: ti.template()):
    """Return the `Triangle` of a sub-quad at samples."""
    a, b, c, d = ti.static((patch.a, patch.b, patch.c, patch.d))
    s0 = quad_column * quad_side
    t0 = quad_row * quad_side
    p = [a[n] + b[n] * s0 + (c[n] + d[n] * s0) * t0 for n in ti.static(range(4))]
    # The sub-quad is P + right s + down t + twist s t; the diagonal ends at P + right + down + twist.
    right = [(b[n] + d[n] * t0) * quad_side for n in ti.static(range(4))]
    down = [(c[n] + d[n] * s0) * quad_side for n in ti.static(range(4))]
    twist = d * (quad_side * quad_side)
    end_w = p[2] + right[2] + down[2] + twist[2]
    below = (
        (p[0] - x * p[2]) * (p[1] + right[1] + down[1] + twist[1] - y * end_w)
        - (p[1] - y * p[2]) * (p[0] + right[0] + down[0] + twist[0] - x * end_w)
    ) * patch.facing >= 0.0
    if not patch.invertible:
        below = lower
    for n in ti.static(range(4)):
        right[n] = ti.select(below, right[n] + twist[n], right[n])
        down[n] = ti.select(below, down[n], down[n] + twist[n])
    return ti.static(Triangle(p, right, down, below))


@ti.func
def on_triangle(x, y, triangle: ti.template()):
    """Return the coordinates s and t of samples on a triangle."""
    # The two equations are p_1 + r_1 s + d_1 t = 0, and the same with 2.
    coefficients = ti.static((triangle.p, triangle.r, triangle.d))
    p_1, r_1, d_1 = [k[0] - x * k[2] for k in coefficients]
    p_2, r_2, d_2 = [k[1] - y * k[2] for k in coefficients]
    inverse_determinant = 1.0 / (r_1 * d_2 - r_2 * d_1)
    return (p_2 * d_1 - p_1 * d_2) * inverse_determinant, (p_1 * r_2 - p_2 * r_1) * inverse_determinant


@ti.func
def is_within(s, t, enlargement, near, triangle: ti.template()):
    """Return whether (s, t) is in an enlarged triangle and in front of the near plane."""
    larger = ti.select(triangle.below, t, s)
    smaller = ti.select(triangle.below, s, t)
    return (
        (smaller >= -enlargement)
        & (larger <= 1.0 + enlargement)
        & (smaller <= larger + enlargement)
        & (triangle.p[2] + triangle.r[2] * s + triangle.d[2] * t > near)
    )


@ti.func
def depth_at(s, t, triangle: ti.template()):
    """Return the depth of a triangle's plane [m]."""
    return triangle.p[3] + triangle.r[3] * s + triangle.d[3] * t


@ti.func
def facet(x, y, triangle: ti.template(), uniforms: ti.template()):
    """Return the normal of a triangle, on its visible side, of any length; a list in OpenCV's axes."""
    sides = [
        [
            (k[0] - k[2] * uniforms[uni.CENTRE_X]) * uniforms[uni.SPREAD_X],
            (k[1] - k[2] * uniforms[uni.CENTRE_Y]) * uniforms[uni.SPREAD_Y],
            k[3],
        ]
        for k in ti.static((triangle.r, triangle.d))
    ]
    r, d = ti.static(sides)
    normal = cross(r, d)
    right, up = line_of_sight(x, y, uniforms)
    cosine = (normal[0] * right - normal[1] * up) * uniforms[uni.PINHOLE] + normal[2]
    sign = ti.select(cosine > 0.0, -1.0, 1.0)
    return [normal[n] * sign for n in ti.static(range(3))]


@ti.func
def may_cover_rows(corner, distorted_entry, cols, top, bottom, uniforms: ti.template(), nodes: ti.template()):
    """Return whether a cell may overlap rows `top` to `bottom` of a distorted picture.

    This test is cheaper than `distorted_cell_bounds`.
    """
    distorted_corners = ti.static(corner_entries(distorted_entry, cols, DISTORTED_STRIDE))
    valid = [nodes[entry + 2] for entry in distorted_corners]
    rows = [nodes[entry + 1] for entry in distorted_corners]
    corners = ti.static(corner_entries(corner, cols, NODE_STRIDE))
    x = [nodes[entry + SCREEN] for entry in corners]
    y = [nodes[entry + SCREEN + 1] for entry in corners]
    margin = uniforms[uni.SAGITTA_FACTOR] * lens_kernels.squared_length(x, y) + 2.0
    is_partly_valid = valid[0] + valid[1] + valid[2] + valid[3] < 3.5
    return is_partly_valid or (ti.max(*rows) + margin > top and ti.min(*rows) - margin < bottom)


@ti.func
def distorted_cell_bounds(distorted_entry, cols, outline: ti.template(), uniforms: ti.template(), nodes: ti.template()):
    """Return the bounding box of a cell in a distorted picture, as `lens_kernels.distorted_bounds`."""
    corners = ti.static(corner_entries(distorted_entry, cols, DISTORTED_STRIDE))
    is_valid = nodes[corners[0] + 2] + nodes[corners[1] + 2] + nodes[corners[2] + 2] + nodes[corners[3] + 2] > 3.5
    distorted_x = [nodes[entry] for entry in corners]
    distorted_y = [nodes[entry + 1] for entry in corners]
    return lens_kernels.distorted_bounds(outline.x, outline.y, distorted_x, distorted_y, is_valid, uniforms)


@ti.func
def is_off_screen(corners: ti.template(), left, right, top, bottom):
    """Return whether a polygon of corners (X, Y, w, ...) is beyond an edge of the undistorted picture [samples].

    Parts of it may be behind the camera: the right edge x is the plane X = x w, which extends there. Beyond it, X > x w
    at all corners.
    """
    off_screen = False
    for axis, sign, edge in ti.static(((0, -1.0, left), (0, 1.0, right), (1, -1.0, top), (1, 1.0, bottom))):
        beyond = [(k[axis] - edge * k[2]) * sign for k in ti.static(corners)]
        size = ti.max(*[ti.abs(k[axis]) + ti.abs(edge * k[2]) for k in ti.static(corners)])
        # The margin exceeds the enlargement and the resolution of f32.
        off_screen = off_screen or ti.min(*beyond) > 1e-3 * size
    return off_screen


@ti.func
def triangle_bounds(
    quad_column, quad_row, lower, quad_side, near, width, height,
    patch: ti.template(), uniforms: ti.template(), lens: ti.template(),
):  # fmt: skip
    """Return the bounding box of a triangle of a sub-quad in the picture, and its enlargement.

    The box is the least and largest x, least and largest y [samples], with largest below least outside the picture.
    """
    a, b, c, d = ti.static((patch.a, patch.b, patch.c, patch.d))
    low_x, high_x, low_y, high_y = 0.0, ti.cast(width, ti.f32), -INFINITY, INFINITY
    enlargement = ENLARGEMENT
    s0, t0 = quad_column * quad_side, quad_row * quad_side
    s1, t1 = (quad_column + 1) * quad_side, (quad_row + 1) * quad_side
    p = a + b * s0 + (c + d * s0) * t0
    q = a + b * s1 + (c + d * s1) * t1
    r = a + b * s0 + (c + d * s0) * t1
    if not lower:
        r = a + b * s1 + (c + d * s1) * t0
    if p[2] > near and q[2] > near and r[2] > near:
        x = [k[0] / k[2] for k in ti.static((p, q, r))]
        y = [k[1] / k[2] for k in ti.static((p, q, r))]
        low_x, high_x, low_y, high_y = ti.min(*x), ti.max(*x), ti.min(*y), ti.max(*y)
        extent = ti.max(high_x - low_x, high_y - low_y, 1e-3)
        if ti.static(lens != ""):
            box = uni.VISIBLE
            perimeter = uniforms[box + 1] - uniforms[box] + uniforms[box + 3] - uniforms[box + 2]
            enlargement += SCREEN_ENLARGEMENT * perimeter / extent
            distorted = [lens_kernels.distorted_point(x[n], y[n], uniforms, lens) for n in ti.static(range(3))]
            low_x, high_x, low_y, high_y = lens_kernels.distorted_bounds(
                x, y, [vertex[0] for vertex in distorted], [vertex[1] for vertex in distorted],
                distorted[0][2] and distorted[1][2] and distorted[2][2], uniforms,
            )  # fmt: skip
        else:
            enlargement += SCREEN_ENLARGEMENT * (width + height) / extent
    elif p[2] <= near and q[2] <= near and r[2] <= near:
        high_x = -1.0
    else:
        left, right, top, bottom = 0.0, high_x, 0.0, ti.cast(height, ti.f32)
        if ti.static(lens != ""):
            left, right, top, bottom = [uniforms[uni.VISIBLE + n] for n in ti.static(range(4))]
        if is_off_screen([p, q, r], left, right, top, bottom):
            high_x = -1.0
    return low_x, high_x, low_y, high_y, enlargement
