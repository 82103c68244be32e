"""Lens distortion in kernels: distorted points, and bounding boxes of distorted cells and triangles.

The formulas are those of `lenses`, the bounds those of `undistortion.VisibleRegion`. Undistorted points are those
of the same camera without lens distortion [samples].
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from taichi_msm.lenses import MODELS
from taichi_msm.render import uniforms as uni
from taichi_msm.render.undistortion import INVALID_COORDINATE
from taichi_msm.system.kernel_operations import KERNEL
from taichi_msm.system.runtime import ti


@cache
def compile_lens(lens: str) -> Callable[..., Any]:
    """Wrap the formula of a lens model for kernels."""
    return ti.func(MODELS[lens].build(KERNEL))


@ti.func
def distorted_point(x, y, uniforms: ti.template(), lens: ti.template()):
    """Return the distorted x and y of a point [samples], and whether it is within the limit of the lens.

    A point beyond the limit is first moved to the limit.
    """
    a = (x - uniforms[uni.CENTRE_X]) * uniforms[uni.SPREAD_X]
    b = (y - uniforms[uni.CENTRE_Y]) * uniforms[uni.SPREAD_Y]
    squared_radius = a * a + b * b
    is_valid = squared_radius < uniforms[uni.LENS_RADIUS] * uniforms[uni.LENS_RADIUS]
    if not is_valid:
        factor = uniforms[uni.LENS_RADIUS] / ti.sqrt(squared_radius)
        a, b = a * factor, b * factor
    k = [uniforms[uni.LENS + n] for n in ti.static(range(len(MODELS[lens].coefficients)))]
    distort = ti.static(compile_lens(lens))
    distorted_a, distorted_b = distort(a, b, *k)
    return (
        uniforms[uni.PICTURE_X] + uniforms[uni.FOCAL_X] * distorted_a,
        uniforms[uni.PICTURE_Y] + uniforms[uni.FOCAL_Y] * distorted_b,
        is_valid,
    )


@ti.func
def texel_of(a, b, uniforms: ti.template(), lens: ti.template()):
    """Return the texel of points in the camera of a picture, which has this lens model, one per lane."""
    distorted_a, distorted_b = a, b
    if ti.static(lens != ""):
        # A point beyond the limit of the lens is first moved to the limit.
        factor = ti.min(uniforms[uni.PICTURE_LENS_RADIUS] / ti.sqrt(ti.max(a * a + b * b, 1e-30)), 1.0)
        k = [uniforms[uni.PICTURE_LENS + n] for n in ti.static(range(len(MODELS[lens].coefficients)))]
        distort = ti.static(compile_lens(lens))
        distorted_a, distorted_b = distort(a * factor, b * factor, *k)
    return (
        uniforms[uni.TEXEL_X] + uniforms[uni.TEXEL_FOCAL_X] * distorted_a,
        uniforms[uni.TEXEL_Y] + uniforms[uni.TEXEL_FOCAL_Y] * distorted_b,
    )


@ti.func
def squared_length(x: ti.template(), y: ti.template()):
    """Return the squared length of the longest side of a triangle or a cell, whose vertices are in row order."""
    sides = ti.static(((0, 1), (1, 2), (2, 0)) if len(x) == 3 else ((0, 1), (1, 3), (3, 2), (2, 0)))
    squares = [(x[n] - x[m]) * (x[n] - x[m]) + (y[n] - y[m]) * (y[n] - y[m]) for n, m in sides]
    return ti.max(*squares)


@ti.func
def distorted_bounds(
    x: ti.template(), y: ti.template(), distorted_x: ti.template(), distorted_y: ti.template(), is_valid,
    uniforms: ti.template(),
):  # fmt: skip
    """Return the bounding box of the samples that a triangle or a cell covers after distortion.

    `x` and `y` list its undistorted vertices; `is_valid` is whether all are within the limit of the lens. The box is
    the least and largest x, least and largest y [samples], with largest below least outside the picture.
    """
    squared = squared_length(x, y)
    margin = ti.min(uniforms[uni.STRETCH_FACTOR] * ti.sqrt(squared), 1e6)
    if is_valid:
        margin = ti.min(margin, uniforms[uni.SAGITTA_FACTOR] * squared)
    left, right, top, bottom = [uniforms[uni.VISIBLE + n] for n in ti.static(range(4))]
    is_visible = ti.max(*x) >= left and ti.min(*x) <= right and ti.max(*y) >= top and ti.min(*y) <= bottom
    return (
        ti.select(is_visible, ti.min(*distorted_x) - margin, INVALID_COORDINATE),
        ti.select(is_visible, ti.max(*distorted_x) + margin, -INVALID_COORDINATE),
        ti.select(is_visible, ti.min(*distorted_y) - margin, INVALID_COORDINATE),
        ti.select(is_visible, ti.max(*distorted_y) + margin, -INVALID_COORDINATE),
    )
