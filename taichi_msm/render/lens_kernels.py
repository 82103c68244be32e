"""Lenses that bend lines, in kernels: where a place is seen, and the bounds of what a cell or a triangle covers.

The formulas are those of camera.py, the bounds those of `lens_table.Visible`. A place is what a camera without the lens
sees there, in samples of its picture.
"""

from taichi_msm.render import uniforms as uni
from taichi_msm.render.lens_table import BEYOND
from taichi_msm.system.runtime import ti

# Numbers that are stored of a mass point: where it is seen [samples], and 1 if it is in front of the camera and within
# the radius of the lens.
BENT_NUMBERS = 3

# An angle is found from a half of a half of half of it, by its series in the tangent: the terms' divisors, the smallest
# term first.
HALVINGS = 3
SERIES = [(-1.0) ** n * (2 * n + 1) for n in reversed(range(12))]


@ti.func
def arc(tangent):
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
def bent(x, y, numbers: ti.template(), lens: ti.template()):
    """Find where a place is seen [samples], and whether it is within the radius of the lens.

    Beyond it, the nearest place within it is taken.
    """
    a = (x - numbers[uni.CENTRE_X]) * numbers[uni.SPREAD_X]
    b = (y - numbers[uni.CENTRE_Y]) * numbers[uni.SPREAD_Y]
    square = a * a + b * b
    within = square < numbers[uni.LENS_RADIUS] * numbers[uni.LENS_RADIUS]
    if not within:
        shorter = numbers[uni.LENS_RADIUS] / ti.sqrt(square)
        a, b = a * shorter, b * shorter
    k = [numbers[uni.LENS + n] for n in ti.static(range(8))]
    q = a * a + b * b
    if ti.static(lens == "fisheye"):
        r = ti.max(ti.sqrt(q), 1e-8)
        t = arc(r)
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
        numbers[uni.PICTURE_X] + numbers[uni.FOCAL_X] * a,
        numbers[uni.PICTURE_Y] + numbers[uni.FOCAL_Y] * b,
        within,
    )


@ti.func
def store_bent(at, here, numbers: ti.template(), point: ti.template(), lens: ti.template()):
    """Store at `at` where the mass point is seen whose numbers begin at `here`."""
    seen_x, seen_y, within = bent(point[here + uni.SEEN], point[here + uni.SEEN + 1], numbers, lens)
    point[at], point[at + 1] = seen_x, seen_y
    point[at + 2] = ti.cast(within and point[here + 2] > numbers[uni.NEAR], ti.f32)


@ti.func
def side(x: ti.template(), y: ti.template(), n: ti.template(), m: ti.template()):
    """Square of the distance between two corners of an outline."""
    return (x[n] - x[m]) * (x[n] - x[m]) + (y[n] - y[m]) * (y[n] - y[m])


@ti.func
def bent_bounds(
    x: ti.template(), y: ti.template(), seen_x: ti.template(), seen_y: ti.template(), within, longest,
    numbers: ti.template(),
):  # fmt: skip
    """Find bounds of all samples that show a convex outline, from its corners' places, and where these are seen.

    `within` tells whether all of them are within the radius of the lens; `longest` is the square of the longest side.

    Returns:
        Least and largest x, least and largest y [samples]; the largest are below the least where nothing is seen.
    """
    far = ti.min(numbers[uni.STRETCH] * ti.sqrt(longest), 1e6)
    if within:
        far = ti.min(far, numbers[uni.BEND] * longest)
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
        right >= numbers[box] and left <= numbers[box + 1] and bottom >= numbers[box + 2] and top <= numbers[box + 3]
    )
    return (
        ti.select(shown, low_x - far, BEYOND),
        ti.select(shown, high_x + far, -BEYOND),
        ti.select(shown, low_y - far, BEYOND),
        ti.select(shown, high_y + far, -BEYOND),
    )
