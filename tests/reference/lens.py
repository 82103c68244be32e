"""NumPy reference of lens distortion, inverted by Newton's method with numerical derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.view import View

Array = NDArray[np.float64]


def distort(camera: View, x: Array, y: Array) -> tuple[Array, Array]:
    """Return distorted image points at depth 1, by the formulas of OpenCV's documentation.

    Args:
        camera: camera with a lens.
        x: undistorted x at depth 1, to the right.
        y: undistorted y at depth 1, down, same shape.
    """
    assert camera.lens is not None
    k = camera.lens.coefficients
    r = np.hypot(x, y)
    if camera.lens.model == "fisheye":
        t = np.arctan(r)
        ratio = t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8) / np.maximum(r, 1e-9)
        return x * ratio, y * ratio
    if camera.lens.model == "scaramuzza":
        x, y = scaramuzza_pixel(k, x, y)  # OCamCalib
        return x / camera.scale[0], y / camera.scale[1]
    if camera.lens.model == "omnidir":
        # The ray's point on the unit sphere, projected from xi behind the centre.
        x, y, z = np.stack([x, y, np.ones_like(x)]) / np.sqrt(x**2 + y**2 + 1)
        x, y, k = x / (z + k[0]), y / (z + k[0]), (*k[1:], 0, 0, 0, 0)
        r = np.hypot(x, y)
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    ratio = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        x * ratio + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * ratio + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


def undistorted(camera: View, x: Array, y: Array) -> tuple[Array, Array]:
    """Return undistorted image points [px]; NaN beyond the lens's limit.

    Args:
        camera: view; without a lens the points are returned unchanged.
        x: distorted x [px], from the left.
        y: distorted y [px], from the top, same shape.
    """
    if camera.lens is None:
        return x, y
    if camera.lens.model == "scaramuzza":
        # This model is defined from the sensor to the ray, in closed form.
        a, b = scaramuzza_ray(camera.lens.coefficients, x - camera.centre[0], y - camera.centre[1])
        # Beyond a fold a pixel has the ray of another one.
        u, v = scaramuzza_pixel(camera.lens.coefficients, a, b)
        consistent = np.hypot(u - x + camera.centre[0], v - y + camera.centre[1]) < 1e-3
        return _within_limit(camera, a, b, consistent)
    target_x, target_y = (x - camera.centre[0]) / camera.scale[0], (y - camera.centre[1]) / camera.scale[1]
    # From the axis outward, in steps small enough for Newton's method.
    a, b = np.zeros_like(target_x), np.zeros_like(target_y)
    step = 1e-6
    with np.errstate(all="ignore"):
        for share in np.linspace(0.05, 1, 20):
            for _ in range(4 + 10 * int(share == 1)):
                u, v = distort(camera, a, b)
                right, below = distort(camera, a + step, b), distort(camera, a, b + step)
                a_u, a_v = (right[0] - u) / step, (right[1] - v) / step
                b_u, b_v = (below[0] - u) / step, (below[1] - v) / step
                off_u, off_v = target_x * share - u, target_y * share - v
                area = a_u * b_v - a_v * b_u
                a, b = a + (b_v * off_u - b_u * off_v) / area, b + (a_u * off_v - a_v * off_u) / area
        u, v = distort(camera, a, b)
        return _within_limit(camera, a, b, np.hypot(u - target_x, v - target_y) < 1e-9)


def _within_limit(camera: View, x: Array, y: Array, valid: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return pixels of points at depth 1 [px]; NaN where they are not valid or beyond the lens's limit."""
    assert camera.lens is not None
    valid = valid & (np.hypot(x, y) < camera.lens.limit)
    return (
        np.where(valid, camera.centre[0] + camera.scale[0] * x, np.nan),
        np.where(valid, camera.centre[1] + camera.scale[1] * y, np.nan),
    )


def scaramuzza_ray(coefficients: Sequence[float], x: Array, y: Array) -> tuple[Array, Array]:
    """Return the ray of a pixel at depth 1 (cam2world of OCamCalib); NaN where it points backward.

    Args:
        coefficients: a0, a2, a3, a4 of the polynomial, and c, d, e of the affine map.
        x: x from the principal point [px].
        y: y from the principal point, down [px], same shape.
    """
    a0, a2, a3, a4, c, d, e = coefficients
    u, v = np.linalg.solve(np.array([[c, d], [e, 1]]), np.stack([x, y]).reshape(2, -1)).reshape(2, *x.shape)
    p = np.hypot(u, v)
    f = a0 + a2 * p**2 + a3 * p**3 + a4 * p**4
    return u / np.where(f > 0, f, np.nan), v / np.where(f > 0, f, np.nan)


def scaramuzza_pixel(coefficients: Sequence[float], x: Array, y: Array) -> tuple[Array, Array]:
    """Return the pixel of a point at depth 1, from the principal point [px] (world2cam of OCamCalib), by bisection.

    Args:
        coefficients: a0, a2, a3, a4 of the polynomial, and c, d, e of the affine map.
        x: x at depth 1.
        y: y at depth 1, down, same shape.
    """
    a0, a2, a3, a4, c, d, e = coefficients
    r = np.hypot(x, y)
    # The first root, from the axis.
    grid = np.linspace(0, 3 * a0, 300).reshape(-1, *(1,) * r.ndim)
    first = np.argmax(grid > r * (a0 + a2 * grid**2 + a3 * grid**3 + a4 * grid**4), axis=0)
    low, high = grid.ravel()[first - 1], grid.ravel()[first]
    for _ in range(60):
        p = (low + high) / 2
        is_beyond = p > r * (a0 + a2 * p**2 + a3 * p**3 + a4 * p**4)
        low, high = np.where(is_beyond, low, p), np.where(is_beyond, p, high)
    u, v = x * low / np.maximum(r, 1e-300), y * low / np.maximum(r, 1e-300)
    return c * u + d * v, e * u + v
