"""The reference for lenses: where pixels would be without distortion, by Newton's method with numerical derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.camera import View

Array = NDArray[np.float64]


def distort(camera: View, x: Array, y: Array) -> tuple[Array, Array]:
    """Distort places at depth 1, x to the right and y down, as OpenCV's documentation has it."""
    assert camera.lens is not None
    k = camera.lens.coefficients
    r = np.hypot(x, y)
    if camera.lens.model == "fisheye":
        t = np.arctan(r)
        ratio = t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8) / np.maximum(r, 1e-9)
        return x * ratio, y * ratio
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    ratio = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        x * ratio + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * ratio + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


def undistorted(camera: View, x: Array, y: Array) -> tuple[Array, Array]:
    """Find where what is seen at pixels (x, y) [px] would be seen without distortion [px]; NaN beyond the limit."""
    if camera.lens is None:
        return x, y
    seen_x, seen_y = (x - camera.centre[0]) / camera.scale[0], (y - camera.centre[1]) / camera.scale[1]
    # From the axis outward, in steps small enough for Newton's method.
    a, b = np.zeros_like(seen_x), np.zeros_like(seen_y)
    step = 1e-6
    with np.errstate(all="ignore"):
        for share in np.linspace(0.05, 1, 20):
            for _ in range(4 + 10 * int(share == 1)):
                u, v = distort(camera, a, b)
                right, below = distort(camera, a + step, b), distort(camera, a, b + step)
                a_u, a_v = (right[0] - u) / step, (right[1] - v) / step
                b_u, b_v = (below[0] - u) / step, (below[1] - v) / step
                off_u, off_v = seen_x * share - u, seen_y * share - v
                area = a_u * b_v - a_v * b_u
                a, b = a + (b_v * off_u - b_u * off_v) / area, b + (a_u * off_v - a_v * off_u) / area
        u, v = distort(camera, a, b)
        good = (np.hypot(u - seen_x, v - seen_y) < 1e-9) & (np.hypot(a, b) < camera.lens.limit)
    return (
        np.where(good, camera.centre[0] + camera.scale[0] * a, np.nan),
        np.where(good, camera.centre[1] + camera.scale[1] * b, np.nan),
    )
