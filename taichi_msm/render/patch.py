"""A cell of the surface as the camera sees it, for one sample or a vector of them, in any precision.

A point of the surface is represented by (X, Y, w, depth), the product of the camera's matrix and the point. That map is
linear, so refining the projected mass points is the same as refining the surface, and perspective is no special case.
In a cell, with s to the right and t down, the surface between the four mass points is

    P(s, t) = A + B s + C t + D s t,    seen at sample (x, y) where    X - x w = 0,  Y - y w = 0.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from typing import Any, NamedTuple

from taichi_msm.system.runtime import ti


class Plane(NamedTuple):
    """The triangle P + R s + D t of a small quad that a sample is on; P, R and D are (X, Y, w) each."""

    p_x: Any
    p_y: Any
    p_w: Any
    r_x: Any
    r_y: Any
    r_w: Any
    d_x: Any
    d_y: Any
    d_w: Any


@ti.func
def on_triangle(x, y, plane: ti.template()):
    """Find (s, t) where the triangle is seen at (x, y)."""
    p_1 = plane.p_x - x * plane.p_w
    r_1 = plane.r_x - x * plane.r_w
    d_1 = plane.d_x - x * plane.d_w
    p_2 = plane.p_y - y * plane.p_w
    r_2 = plane.r_y - y * plane.r_w
    d_2 = plane.d_y - y * plane.d_w
    share = 1.0 / (r_1 * d_2 - r_2 * d_1)
    return (p_2 * d_1 - p_1 * d_2) * share, (p_1 * r_2 - p_2 * r_1) * share


@ti.func
def edge(p_x, p_y, q_x, q_y, x, y, side):
    """Twice the signed area of p, q and (x, y), times side, which is 1 or -1.

    The sign tells on which side of the line (x, y) is. Both cells of an edge get the same bits, but for the sign.
    """
    right, down = (q_x - p_x) * side, (q_y - p_y) * side
    return right * (y - p_y) - down * (x - p_x)


@ti.func
def turn(p_x, p_y, q_x, q_y, r_x, r_y):
    """Twice the signed area of p, q and r: above 0 if the path from p over q to r turns right in the picture."""
    return (q_x - p_x) * (r_y - q_y) - (q_y - p_y) * (r_x - q_x)


@ti.func
def seen_side(a_x, a_y, b_x, b_y, c_x, c_y, d_x, d_y):
    """Tell which side of a cell with corners a, b above c, d is seen: 1: front; -1: back; 0: both, as it is folded."""
    abd, bdc = turn(a_x, a_y, b_x, b_y, d_x, d_y), turn(b_x, b_y, d_x, d_y, c_x, c_y)
    dca, cab = turn(d_x, d_y, c_x, c_y, a_x, a_y), turn(c_x, c_y, a_x, a_y, b_x, b_y)
    least, most = ti.min(abd, bdc, dca, cab), ti.max(abd, bdc, dca, cab)
    return ti.select(least > 0, 1.0, ti.select(most < 0, -1.0, 0.0))


@ti.func
def small_quad(
    x, y, inside, parts, side, a: ti.template(), b: ti.template(), c: ti.template(), d: ti.template()
):  # fmt: skip
    """Find column and line of the small quads of a cell A + B s + C t + D s t that are seen at (x, y).

    Args:
        x: column of the samples.
        y: their row.
        inside: which of them the cell covers.
        parts: small quads along a side of the cell.
        side: 1 where its front is seen, else -1.
        a: coefficient A, (X, Y, w, ...).
        b: likewise B.
        c: likewise C.
        d: likewise D.
    """
    a_1 = a[0] - x * a[2]
    b_1 = b[0] - x * b[2]
    c_1 = c[0] - x * c[2]
    d_1 = d[0] - x * d[2]
    a_2 = a[1] - y * a[2]
    b_2 = b[1] - y * b[2]
    c_2 = c[1] - y * c[2]
    d_2 = d[1] - y * d[2]
    # Eliminating t gives bd s^2 + (ad + bc) s + ac = 0; eliminating s gives an equation with the same discriminant.
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
