"""Scaramuzza's polynomial model of wide lenses, as OCamCalib, MATLAB's fisheyeIntrinsics and C3VD calibrate it.

A point (u, v) of the sensor [px] at distance p from the axis has the line of sight (u, v, f) and, relative to the
principal point, the pixel (c u + d v, e u + v), with

    f(p) = a0 + a2 p^2 + a3 p^3 + a4 p^4.

With r = |(x, y)|, p solves p = r f(p). In units of the focal length a0: t = p / a0, g(t) = f(p) / a0.

Source: Scaramuzza, Martinelli and Siegwart 2006; MATLAB's documentation of fisheyeIntrinsics.
"""

# No `from __future__ import annotations`: Taichi compiles the formula.

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from taichi_msm.arithmetic import NUMPY, Array, Operations
from taichi_msm.lenses.fisheye import MIN_SQUARED_RADIUS
from taichi_msm.lenses.model import MAX_RADIUS, Coefficient, LensModel, positive_roots


class Scaramuzza(LensModel):
    """Scaramuzza's polynomial model."""

    name = "scaramuzza"
    meaning = "Scaramuzza's polynomial, with a0, a2, a3, a4 and the matrix c, d, e"
    focal_length = "a0"
    coefficients: ClassVar = {
        "a0": Coefficient("focal length [px], in place of fx and fy", least=1e-3, default=None),
        "a2": Coefficient("coefficient of the squared radius [1/px]"),
        "a3": Coefficient("coefficient of the cubed radius [1/px^2]"),
        "a4": Coefficient("coefficient of the fourth power of the radius [1/px^3]"),
        "c": Coefficient("horizontal stretch", least=0.5, most=2.0, default=1.0),
        "d": Coefficient("horizontal shear", least=-0.5, most=0.5),
        "e": Coefficient("vertical shear", least=-0.5, most=0.5),
    }

    def build(self, operations: Operations) -> Callable[..., Any]:
        sqrt, maximum = operations.sqrt, operations.maximum

        def distort(x, y, a0, a2, a3, a4, c, d, e):
            b2, b3, b4 = a0 * a2, a0 * a0 * a3, a0 * a0 * a0 * a4
            r = sqrt(maximum(x * x + y * y, MIN_SQUARED_RADIUS))
            # Start at the solution for a3 = a4 = 0, or at that of a stereographic lens if it is smaller.
            t = 2.0 * r / (1.0 + sqrt(1.0 + maximum(b2 * (-4.0), 1.0) * r * r))
            # Lenses of endoscopes need 3 steps, lenses that fold back 5.
            for _ in range(5):
                # Go to the nearer root of the osculating parabola of h = t - r g; near a fold, Newton's method is slow.
                # The discriminant is 0 at the fold, and the limit of the lens just below it.
                h = t - r * (1.0 + t * t * (b2 + t * (b3 + t * b4)))
                slope = 1.0 - r * t * (2.0 * b2 + t * (3.0 * b3 + t * (4.0 * b4)))
                curvature = r * (2.0 * b2 + t * (6.0 * b3 + t * (12.0 * b4)))
                t = t - 2.0 * h / (slope + sqrt(maximum(slope * slope + 2.0 * h * curvature, 1e-7)))
            ratio = t / r
            u, v = x * ratio, y * ratio
            return c * u + d * v, e * u + v

        return distort

    def undistort(self, distorted: Array, coefficients: Sequence[float]) -> Array:
        # The inverse is (u, v) / g(t).
        a0, a2, a3, a4, c, d, e = coefficients
        x, y = np.moveaxis(distorted, -1, 0)
        u, v = np.stack([x - d * y, c * y - e * x]) / (c - d * e)
        t = np.hypot(u, v)
        radial = a0, a2, a3, a4, 1.0, 0.0, 0.0
        max_t, _ = self.build(NUMPY)(np.array(self.limit(coefficients)), 0.0, *radial)
        g = np.where(t < max_t, 1 + t * t * a0 * (a2 + t * a0 * (a3 + t * a0 * a4)), np.nan)
        return np.stack([u / g, v / g], axis=-1)

    def limit(self, coefficients: Sequence[float]) -> float:
        """Return the radius up to which r = t / g(t) increases and the iteration finds t."""
        a0, a2, a3, a4, *_ = coefficients
        t = Polynomial([0, 1])
        g = Polynomial([1, 0, a2 * a0, a3 * a0**2, a4 * a0**3])
        fold = min(positive_roots(g - t * g.deriv()), default=np.inf)
        max_t = min([fold, *positive_roots(g - t / MAX_RADIUS)])
        radial_positions = max_t * np.sin(np.linspace(0, np.pi / 2, 2048))
        radii = radial_positions / g(radial_positions)
        with np.errstate(all="ignore"):
            roots, _ = self.build(NUMPY)(radii, 0.0, a0, a2, a3, a4, 1.0, 0.0, 0.0)
        # 1e-9 is 1e-6 px at a focal length of 1000 px.
        is_wrong = ~(np.abs(roots - radial_positions) <= 1e-9)
        if is_wrong.any():
            return float(radii[max(0, np.argmax(is_wrong) - 1)])
        return MAX_RADIUS
