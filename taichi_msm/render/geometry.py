"""Points and cells of the sheet as the camera sees them, for one sample or a vector of them, in f32 or f64.

A point of the surface is represented by (X, Y, w, depth), the product of the camera's matrix and the point. That map is
linear, so refining the projected mass points is the same as refining the surface, and perspective is no special case.
In a cell, with s to the right and t down, the surface between the four mass points is

    P(s, t) = A + B s + C t + D s t,    seen at sample (x, y) where    X - x w = 0,  Y - y w = 0.

It is cut into small quads, and these into triangles along the diagonal from top left to bottom right. Corners are
listed row by row: upper left and right, lower left and right.
"""

from typing import Any, NamedTuple

from taichi_msm.render import lens_kernels
from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import INFINITY
from taichi_msm.system.runtime import ti

# The numbers of a mass point: (X, Y, w, depth), its place in the picture [samples], at SEEN.
SCREEN, NODE_STRIDE = uni.SCREEN, 6

# A triangle that is drawn by itself is enlarged a little, so that no gap is left beside it: by this fraction of its
# side, and by this fraction of the picture's, which is what f32 resolves.
ENLARGEMENT = 1e-5
SCREEN_ENLARGEMENT = 2e-6

# By this fraction of its size a triangle or a cell must be beyond an edge of the picture to be left out.
BESIDE = 1e-3

# In f32, a cell is drawn as a whole only if its outline stays within this distance [samples].
MAX_COORDINATE = float(1 << 16)


class Outline(NamedTuple):
    """A cell in the picture."""

    x: Any  # of its corners, a list
    y: Any
    left: Any  # its bounds
    right: Any
    top: Any
    bottom: Any
    facing: Any  # 1 where its front is seen, -1 where its back is, 0 if it is folded
    in_front: Any  # whether all of its corners are in front of the camera
    behind: Any  # whether none is


class Patch(NamedTuple):
    """The surface between four mass points."""

    a: Any  # coefficients, each (X, Y, w, depth)
    b: Any
    c: Any
    d: Any
    facing: Any  # as in its `Outline`
    invertible: Any  # whether it is drawn as a whole, and not triangle by triangle


class Triangle(NamedTuple):
    """The triangle P + R s + D t of a small quad that a sample is on; P, R and D are lists of X, Y, w and depth."""

    p: Any
    r: Any
    d: Any
    below: Any  # whether it is the one below the diagonal, where t > s


@ti.func
def project(position: ti.template(), i, j, cols, uniforms: ti.template(), nodes: ti.template(), double: ti.template()):
    """Store the numbers of mass point (i, j); `double` tells that they are in f64, and summed in another order."""
    here = (i * cols + j) * NODE_STRIDE
    x, y, z = position[i, j, 0], position[i, j, 1], position[i, j, 2]
    for n in ti.static(range(4)):
        row = uni.MATRIX + 4 * n
        if ti.static(double):
            nodes[here + n] = uniforms[row + 3] + uniforms[row] * x + uniforms[row + 1] * y + uniforms[row + 2] * z
        else:
            nodes[here + n] = uniforms[row] * x + uniforms[row + 1] * y + uniforms[row + 2] * z + uniforms[row + 3]
    nodes[here + SCREEN] = nodes[here] / nodes[here + 2]
    nodes[here + SCREEN + 1] = nodes[here + 1] / nodes[here + 2]


@ti.func
def w_at(depth, uniforms: ti.template()):
    """Give w of points at a depth."""
    return depth * uniforms[uni.PINHOLE] + (1.0 - uniforms[uni.PINHOLE])


@ti.func
def line_of_sight(x, y, uniforms: ti.template()):
    """Give how far points that are seen at (x, y) are to the right and above the axis of view, at w = 1 [m]."""
    return (x - uniforms[uni.CENTRE_X]) * uniforms[uni.SPREAD_X], (uniforms[uni.CENTRE_Y] - y) * uniforms[uni.SPREAD_Y]


@ti.func
def corner_entry(cell, cols):
    """Give the first number of a cell's upper left mass point."""
    return (cell // (cols - 1) * cols + cell % (cols - 1)) * NODE_STRIDE


@ti.func
def cell_outline(corner, cols, near, nodes: ti.template()):
    """Find the `Outline` of the cell whose upper left mass point has its numbers from `corner` on."""
    below = corner + cols * NODE_STRIDE
    corners = ti.static((corner, corner + NODE_STRIDE, below, below + NODE_STRIDE))
    x = [nodes[at + SCREEN] for at in corners]
    y = [nodes[at + SCREEN + 1] for at in corners]
    w = [nodes[at + 2] for at in corners]
    facing = facing_of(x, y)
    in_front = w[0] > near and w[1] > near and w[2] > near and w[3] > near
    behind = w[0] <= near and w[1] <= near and w[2] <= near and w[3] <= near
    left, right = ti.min(x[0], x[1], x[2], x[3]), ti.max(x[0], x[1], x[2], x[3])
    top, bottom = ti.min(y[0], y[1], y[2], y[3]), ti.max(y[0], y[1], y[2], y[3])
    return ti.static(Outline(x, y, left, right, top, bottom, facing, in_front, behind))


@ti.func
def is_invertible(outline: ti.template()):
    """Tell whether a cell can be drawn as a whole in f32."""
    return (
        outline.in_front
        and outline.facing != 0
        and ti.max(-outline.left, outline.right) < MAX_COORDINATE
        and ti.max(-outline.top, outline.bottom) < MAX_COORDINATE
    )


@ti.func
def cell_patch(corner, cols, facing, invertible, nodes: ti.template(), double: ti.template()):
    """Make the `Patch` of a cell; `double` tells that numbers are in f64, where D is summed in another order."""
    below = corner + cols * NODE_STRIDE
    a = ti.Vector([nodes[corner + n] for n in ti.static(range(4))])
    right = ti.Vector([nodes[corner + NODE_STRIDE + n] for n in ti.static(range(4))])
    down = ti.Vector([nodes[below + n] for n in ti.static(range(4))])
    far = ti.Vector([nodes[below + NODE_STRIDE + n] for n in ti.static(range(4))])
    b, c = right - a, down - a
    d = far - right - down + a if ti.static(double) else far - right - c
    return ti.static(Patch(a, b, c, d, facing, invertible))


@ti.func
def edge(p_x, p_y, q_x, q_y, x, y, facing):
    """Twice the signed area of p, q and (x, y), times side, which is 1 or -1.

    The sign tells on which side of the line (x, y) is. Both cells of an edge get the same bits, but for the sign.
    """
    right, down = (q_x - p_x) * facing, (q_y - p_y) * facing
    return right * (y - p_y) - down * (x - p_x)


@ti.func
def edges(x, y, facing, outline: ti.template()):
    """Give `edge` for the left, right, upper and lower edge of a cell; none is negative where the cell is seen."""
    p, q = ti.static((outline.x, outline.y))
    return (
        edge(p[0], q[0], p[2], q[2], x, y, -facing),
        edge(p[1], q[1], p[3], q[3], x, y, facing),
        edge(p[0], q[0], p[1], q[1], x, y, facing),
        edge(p[2], q[2], p[3], q[3], x, y, -facing),
    )


@ti.func
def turn(p_x, p_y, q_x, q_y, r_x, r_y):
    """Twice the signed area of p, q and r: above 0 if the path from p over q to r turns right in the picture."""
    return (q_x - p_x) * (r_y - q_y) - (q_y - p_y) * (r_x - q_x)


@ti.func
def facing_of(x: ti.template(), y: ti.template()):
    """Tell which side of a cell is seen, given its corners: 1: front; -1: back; 0: both, as it is folded."""
    turns = [
        turn(x[n], y[n], x[m], y[m], x[k], y[k]) for n, m, k in ti.static(((0, 1, 3), (1, 3, 2), (3, 2, 0), (2, 0, 1)))
    ]
    least, most = ti.min(turns[0], turns[1], turns[2], turns[3]), ti.max(turns[0], turns[1], turns[2], turns[3])
    return ti.select(least > 0, 1.0, ti.select(most < 0, -1.0, 0.0))


@ti.func
def find_quads(x, y, inside, parts, patch: ti.template()):
    """Find column and line of the small quads of a patch that are seen at (x, y).

    `inside` are those that it covers; `parts` is the number of small quads along its side.
    """
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
        ti.max(ti.min(ti.floor(s * parts), parts - 1.0), 0.0),
        ti.max(ti.min(ti.floor(t * parts), parts - 1.0), 0.0),
    )


@ti.func
def triangle_at(x, y, column, line, part, lower, patch: ti.template()):
    """Find the `Triangle` of a small quad that (x, y) is on; in a patch that is not whole, the `lower` or upper one.

    The small quad is in this column and line of the cell, and `part` is its side as a fraction of the cell's.
    """
    a, b, c, d = ti.static((patch.a, patch.b, patch.c, patch.d))
    s0 = column * part
    t0 = line * part
    p = [a[n] + b[n] * s0 + (c[n] + d[n] * s0) * t0 for n in ti.static(range(4))]
    # The small quad: P + R s + Q t + twist s t.
    r = [(b[n] + d[n] * t0) * part for n in ti.static(range(4))]
    q = [(c[n] + d[n] * s0) * part for n in ti.static(range(4))]
    twist = d * (part * part)
    f_w = p[2] + r[2] + q[2] + twist[2]
    below = (
        (p[0] - x * p[2]) * (p[1] + r[1] + q[1] + twist[1] - y * f_w)
        - (p[1] - y * p[2]) * (p[0] + r[0] + q[0] + twist[0] - x * f_w)
    ) * patch.facing >= 0.0
    if not patch.invertible:
        below = lower
    for n in ti.static(range(4)):
        r[n] = ti.select(below, r[n] + twist[n], r[n])
        q[n] = ti.select(below, q[n], q[n] + twist[n])
    return ti.static(Triangle(p, r, q, below))


@ti.func
def on_triangle(x, y, triangle: ti.template()):
    """Find (s, t) where the triangle is seen at (x, y)."""
    coefficients = ti.static((triangle.p, triangle.r, triangle.d))
    p_1, r_1, d_1 = [k[0] - x * k[2] for k in coefficients]
    p_2, r_2, d_2 = [k[1] - y * k[2] for k in coefficients]
    share = 1.0 / (r_1 * d_2 - r_2 * d_1)
    return (p_2 * d_1 - p_1 * d_2) * share, (p_1 * r_2 - p_2 * r_1) * share


@ti.func
def is_within(s, t, enlargement, near, triangle: ti.template()):
    """Tell whether (s, t) is in a triangle that is enlarged by a fraction of its side, and in front of the camera."""
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
    """Give the depth of a triangle's plane at (s, t)."""
    return triangle.p[3] + triangle.r[3] * s + triangle.d[3] * t


@ti.func
def facet(x, y, triangle: ti.template(), uniforms: ti.template()):
    """Give the normal of a triangle on the side that is seen at (x, y), of any length, in OpenCV's axes, a list."""
    sides = [
        [
            (k[0] - k[2] * uniforms[uni.CENTRE_X]) * uniforms[uni.SPREAD_X],
            (k[1] - k[2] * uniforms[uni.CENTRE_Y]) * uniforms[uni.SPREAD_Y],
            k[3],
        ]
        for k in ti.static((triangle.r, triangle.d))
    ]
    r, d = ti.static(sides)
    normal = [r[1] * d[2] - r[2] * d[1], r[2] * d[0] - r[0] * d[2], r[0] * d[1] - r[1] * d[0]]
    right, up = line_of_sight(x, y, uniforms)
    along = (normal[0] * right - normal[1] * up) * uniforms[uni.PINHOLE] + normal[2]
    toward = ti.select(along > 0.0, -1.0, 1.0)
    return [normal[n] * toward for n in ti.static(range(3))]


@ti.func
def may_cover_rows(corner, at, cols, top, bottom, uniforms: ti.template(), nodes: ti.template()):
    """Tell whether a cell may be seen between two rows of a picture that a lens has bent: what saves `distorted_cell_bounds`.

    The numbers of its upper left mass point begin at `corner`, and what `store_distorted` stored of it at `at`.
    """
    below, under = corner + cols * NODE_STRIDE, at + cols * lens_kernels.DISTORTED_STRIDE
    bent_corners = ti.static((at, at + lens_kernels.DISTORTED_STRIDE, under, under + lens_kernels.DISTORTED_STRIDE))
    within = [nodes[here + 2] for here in bent_corners]
    seen = [nodes[here + 1] for here in bent_corners]
    corners = ti.static((corner, corner + NODE_STRIDE, below, below + NODE_STRIDE))
    x = [nodes[here + SCREEN] for here in corners]
    y = [nodes[here + SCREEN + 1] for here in corners]
    longest = ti.max(
        lens_kernels.squared_side(x, y, 0, 1),
        lens_kernels.squared_side(x, y, 1, 3),
        lens_kernels.squared_side(x, y, 3, 2),
        lens_kernels.squared_side(x, y, 2, 0),
    )
    far = uniforms[uni.SAGITTA_FACTOR] * longest + 2.0
    lowest, highest = ti.max(seen[0], seen[1], seen[2], seen[3]), ti.min(seen[0], seen[1], seen[2], seen[3])
    partly = within[0] + within[1] + within[2] + within[3] < 3.5
    return partly or (lowest + far > top and highest - far < bottom)


@ti.func
def distorted_cell_bounds(at, cols, outline: ti.template(), uniforms: ti.template(), nodes: ti.template()):
    """Find the bounds of a cell in a picture that a lens has bent.

    What `store_distorted` stored of its upper left mass point is at `at`, in a sheet of so many columns.
    """
    below = at + cols * lens_kernels.DISTORTED_STRIDE
    corners = ti.static((at, at + lens_kernels.DISTORTED_STRIDE, below, below + lens_kernels.DISTORTED_STRIDE))
    x, y = ti.static((outline.x, outline.y))
    longest = ti.max(
        lens_kernels.squared_side(x, y, 0, 1),
        lens_kernels.squared_side(x, y, 1, 3),
        lens_kernels.squared_side(x, y, 3, 2),
        lens_kernels.squared_side(x, y, 2, 0),
    )
    within = nodes[corners[0] + 2] + nodes[corners[1] + 2] + nodes[corners[2] + 2] + nodes[corners[3] + 2] > 3.5
    seen_x = [nodes[here] for here in corners]
    seen_y = [nodes[here + 1] for here in corners]
    return lens_kernels.distorted_bounds(x, y, seen_x, seen_y, within, longest, uniforms)


@ti.func
def is_off_screen(corners: ti.template(), left, right, top, bottom):
    """Tell whether all between corners, some of which may be behind the camera, is beyond an edge of the picture.

    X = x w is a plane for each edge x, behind the camera too; a point beyond it has a larger X, or a smaller one.
    """
    beside = False
    for axis, way, edge in ti.static(((0, -1.0, left), (0, 1.0, right), (1, -1.0, top), (1, 1.0, bottom))):
        beyond = [(k[axis] - edge * k[2]) * way for k in ti.static(corners)]
        size = ti.max(*[ti.abs(k[axis]) + ti.abs(edge * k[2]) for k in ti.static(corners)])
        # By more than it is enlarged, and than f32 can tell.
        beside = beside or ti.min(*beyond) > BESIDE * size
    return beside


@ti.func
def triangle_bounds(
    column, line, lower, part, near, width, height,
    patch: ti.template(), uniforms: ti.template(), lens: ti.template(),
):  # fmt: skip
    """Find the bounds of a small triangle in a picture of this width and height; other arguments as for `triangle_at`.

    `lens` is the model of the camera's lens, empty if it bends no lines.

    Returns:
        Least and largest x, least and largest y; and by what fraction of its side it is enlarged.
    """
    a, b, c, d = ti.static((patch.a, patch.b, patch.c, patch.d))
    low_x, high_x, low_y, high_y = 0.0, ti.cast(width, ti.f32), -INFINITY, INFINITY
    enlargement = ENLARGEMENT
    s0, t0 = column * part, line * part
    s1, t1 = (column + 1) * part, (line + 1) * part
    p = a + b * s0 + (c + d * s0) * t0
    q = a + b * s1 + (c + d * s1) * t1
    r = a + b * s0 + (c + d * s0) * t1
    if not lower:
        r = a + b * s1 + (c + d * s1) * t0
    if p[2] > near and q[2] > near and r[2] > near:
        low_x = ti.min(p[0] / p[2], q[0] / q[2], r[0] / r[2])
        high_x = ti.max(p[0] / p[2], q[0] / q[2], r[0] / r[2])
        low_y = ti.min(p[1] / p[2], q[1] / q[2], r[1] / r[2])
        high_y = ti.max(p[1] / p[2], q[1] / q[2], r[1] / r[2])
        extent = ti.max(high_x - low_x, high_y - low_y, 1e-3)
        if ti.static(lens != ""):
            box = uni.VISIBLE
            around = uniforms[box + 1] - uniforms[box] + uniforms[box + 3] - uniforms[box + 2]
            enlargement += SCREEN_ENLARGEMENT * around / extent
            x = [k[0] / k[2] for k in ti.static((p, q, r))]
            y = [k[1] / k[2] for k in ti.static((p, q, r))]
            longest = ti.max(
                lens_kernels.squared_side(x, y, 0, 1), lens_kernels.facing(x, y, 1, 2), lens_kernels.facing(x, y, 2, 0)
            )
            seen = [lens_kernels.bent(x[n], y[n], uniforms, lens) for n in ti.static(range(3))]
            low_x, high_x, low_y, high_y = lens_kernels.distorted_bounds(
                x, y, [one[0] for one in seen], [one[1] for one in seen], seen[0][2] and seen[1][2] and seen[2][2],
                longest, uniforms,
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
