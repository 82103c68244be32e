"""Lenses that bend lines, in kernels: where a place is seen, and the bounds of what a cell or a triangle covers.

The formulas are those of camera.py, the bounds those of `lens_table.VisibleRegion`. A place is what a camera without the lens
sees there, in samples of its picture.
"""

from taichi_msm.render import uniforms as uni
from taichi_msm.render.lens_table import INVALID_COORDINATE
from taichi_msm.system.runtime import ti

# Numbers that are stored of a mass point: where it is seen [samples], and 1 if it is in front of the camera and within
# the radius of the lens.
DISTORTED_STRIDE = 3

# An angle is found from a half of a half of half of it, by its series in the tangent: the terms' divisors, the smallest
# term first.
HALVINGS = 3
SERIES = [(-1.0) ** n * (2 * n + 1) for n in reversed(range(12))]


@ti.func
def arctangent(tangent):
    """Give the angle, 0 to pi / 2, that has a tangent; GPUs have no such function in f64."""
    part = tangent
    for _ in ti.static(range(HALVINGS)):
        part = part / (1.0 + ti.sqrt(1.0 + part * part))
    square = part * part
    # Constants are f32, in which quotients are not exact.
    one = part * 0.0 + 1.0
    total = part * 0.0
    for divisor in ti.static(SERIES):
        total = one / divisor + square * total
    return total * part * 2.0**HALVINGS


@ti.func
def distorted_point(x, y, uniforms: ti.template(), lens: ti.template()):
    """Find where a place is seen [samples], and whether it is within the radius of the lens.

    Beyond it, the nearest place within it is taken.
    """
    a = (x - uniforms[uni.CENTRE_X]) * uniforms[uni.SPREAD_X]
    b = (y - uniforms[uni.CENTRE_Y]) * uniforms[uni.SPREAD_Y]
    square = a * a + b * b
    within = square < uniforms[uni.LENS_RADIUS] * uniforms[uni.LENS_RADIUS]
    if not within:
        shorter = uniforms[uni.LENS_RADIUS] / ti.sqrt(square)
        a, b = a * shorter, b * shorter
    k = [uniforms[uni.LENS + n] for n in ti.static(range(8))]
    q = a * a + b * b
    if ti.static(lens == "fisheye"):
        r = ti.max(ti.sqrt(q), 1e-8)
        t = arctangent(r)
        p = t * t
        ratio = t * (1.0 + p * (k[0] + p * (k[1] + p * (k[2] + p * k[3])))) / r
        a, b = a * ratio, b * ratio
    else:
        ratio = (1.0 + q * (k[0] + q * (k[1] + q * k[4]))) / (1.0 + q * (k[5] + q * (k[6] + q * k[7])))
        mixed = 2.0 * a * b
        across = a * ratio + k[2] * mixed + k[3] * (q + 2.0 * a * a)
        b = b * ratio + k[2] * (q + 2.0 * b * b) + k[3] * mixed
        a = across
    return (
        uniforms[uni.PICTURE_X] + uniforms[uni.FOCAL_X] * a,
        uniforms[uni.PICTURE_Y] + uniforms[uni.FOCAL_Y] * b,
        within,
    )


@ti.func
def store_distorted(at, here, uniforms: ti.template(), nodes: ti.template(), lens: ti.template()):
    """Store at `at` where the mass point is seen whose numbers begin at `here`."""
    seen_x, seen_y, within = distorted_point(nodes[here + uni.SCREEN], nodes[here + uni.SCREEN + 1], uniforms, lens)
    nodes[at], nodes[at + 1] = seen_x, seen_y
    nodes[at + 2] = ti.cast(within and nodes[here + 2] > uniforms[uni.NEAR], ti.f32)


@ti.func
def squared_side(x: ti.template(), y: ti.template(), n: ti.template(), m: ti.template()):
    """Square of the distance between two corners of an outline."""
    return (x[n] - x[m]) * (x[n] - x[m]) + (y[n] - y[m]) * (y[n] - y[m])


@ti.func
def distorted_bounds(
    x: ti.template(), y: ti.template(), seen_x: ti.template(), seen_y: ti.template(), within, longest,
    uniforms: ti.template(),
):  # fmt: skip
    """Find bounds of all samples that show a convex outline, from its corners' places, and where these are seen.

    `within` tells whether all of them are within the radius of the lens; `longest` is the square of the longest side.

    Returns:
        Least and largest x, least and largest y [samples]; the largest are below the least where nothing is seen.
    """
    far = ti.min(uniforms[uni.STRETCH_FACTOR] * ti.sqrt(longest), 1e6)
    if within:
        far = ti.min(far, uniforms[uni.SAGITTA_FACTOR] * longest)
    left, right = x[0], x[0]
    top, bottom = y[0], y[0]
    low_x, high_x = seen_x[0], seen_x[0]
    low_y, high_y = seen_y[0], seen_y[0]
    for n in ti.static(range(1, len(x))):
        left, right = ti.min(left, x[n]), ti.max(right, x[n])
        top, bottom = ti.min(top, y[n]), ti.max(bottom, y[n])
        low_x, high_x = ti.min(low_x, seen_x[n]), ti.max(high_x, seen_x[n])
        low_y, high_y = ti.min(low_y, seen_y[n]), ti.max(high_y, seen_y[n])
    box = uni.VISIBLE
    shown = (
        right >= uniforms[box]
        and left <= uniforms[box + 1]
        and bottom >= uniforms[box + 2]
        and top <= uniforms[box + 3]
    )
    return (
        ti.select(shown, low_x - far, INVALID_COORDINATE),
        ti.select(shown, high_x + far, -INVALID_COORDINATE),
        ti.select(shown, low_y - far, INVALID_COORDINATE),
        ti.select(shown, high_y + far, -INVALID_COORDINATE),
    )
