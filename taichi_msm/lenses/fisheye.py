"""OpenCV's fisheye model.

With r = |(x, y)| and t = atan(r),

    (x', y') = (x, y) t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r.

Source: OpenCV's documentation of calib3d, "Fisheye camera model".
"""

# No `from __future__ import annotations`: Taichi compiles the formula.

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from numpy.polynomial import Polynomial

from taichi_msm.arithmetic import Operations
from taichi_msm.lenses.model import MAX_RADIUS, Coefficient, LensModel, positive_roots

# Squared radius below which t / r rounds to 1.
MIN_SQUARED_RADIUS = 1e-16


class Fisheye(LensModel):
    """OpenCV's fisheye model."""

    name = "fisheye"
    meaning = "its fisheye model, with k1 to k4"
    coefficients: ClassVar = dict.fromkeys(("k1", "k2", "k3", "k4"), Coefficient("radial coefficient"))

    def build(self, operations: Operations) -> Callable[..., Any]:
        sqrt, arctan, maximum = operations.sqrt, operations.arctan, operations.maximum

        def distort(x, y, k1, k2, k3, k4):
            r = sqrt(maximum(x * x + y * y, MIN_SQUARED_RADIUS))
            t = arctan(r)
            p = t * t
            ratio = t * (1.0 + p * (k1 + p * (k2 + p * (k3 + p * k4)))) / r
            return x * ratio, y * ratio

        return distort

    def limit(self, coefficients: Sequence[float]) -> float:
        """Return the radius of the first maximum of the distorted radius, at most `MAX_RADIUS`."""
        k1, k2, k3, k4 = coefficients
        fold_angles = positive_roots(Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4]).deriv())
        return min(MAX_RADIUS, math.tan(min([*fold_angles, math.radians(88)])))
