"""OpenCV's rational model.

With q = x^2 + y^2,

    x' = x R + 2 p1 x y + p2 (q + 2 x^2),    y' = y R + p1 (q + 2 y^2) + 2 p2 x y,
    R = (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3).

Source: OpenCV's documentation of calib3d, "Detailed Description".
"""

# No `from __future__ import annotations`: Taichi compiles the formula.

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from taichi_msm.arithmetic import Operations
from taichi_msm.lenses.model import MAX_RADIUS, MIN_COEFFICIENT, Coefficient, LensModel, positive_roots


class Rational(LensModel):
    """OpenCV's rational model."""

    name = "pinhole"
    meaning = "OpenCV's rational model"
    coefficients: ClassVar = {
        **dict.fromkeys(("k1", "k2"), Coefficient("radial coefficient")),
        **dict.fromkeys(("p1", "p2"), Coefficient("tangential coefficient")),
        "k3": Coefficient("radial coefficient"),
        "k4": Coefficient("radial coefficient; of the rational model in the denominator"),
        **dict.fromkeys(("k5", "k6"), Coefficient("radial coefficient in the denominator")),
    }

    def build(self, operations: Operations) -> Callable[..., Any]:
        def distort(x, y, k1, k2, p1, p2, k3, k4, k5, k6):
            q = x * x + y * y
            ratio = (1.0 + q * (k1 + q * (k2 + q * k3))) / (1.0 + q * (k4 + q * (k5 + q * k6)))
            mixed = 2.0 * x * y
            return (
                x * ratio + p1 * mixed + p2 * (q + 2.0 * x * x),
                y * ratio + p1 * (q + 2.0 * y * y) + p2 * mixed,
            )

        return distort

    def limit(self, coefficients: Sequence[float]) -> float:
        """Return the least radius with a zero of the Jacobian's determinant or of the denominator of R."""
        numerator, denominator = _factors(coefficients)
        q = Polynomial([0, 1])
        # Numerator of d(R r) / dr.
        growth = (numerator + 2 * q * numerator.deriv()) * denominator - 2 * q * numerator * denominator.deriv()
        radial = float(min([MAX_RADIUS, *np.sqrt([*positive_roots(growth), *positive_roots(denominator)])]))
        if math.hypot(*coefficients[2:4]) <= MIN_COEFFICIENT:
            return radial
        # Bracket the first fold due to tangential distortion, then refine it.
        radii = radial * np.linspace(0, 1, 4097)[:-1]
        folded_indices = np.flatnonzero(_min_determinant(coefficients, radii) <= 0)
        if not len(folded_indices):
            return radial
        from scipy.optimize import brentq

        bracket = radii[folded_indices[0] - 1], radii[folded_indices[0]]
        return float(brentq(lambda r: _min_determinant(coefficients, r), *bracket))


def _factors(coefficients: Sequence[float]) -> tuple[Polynomial, Polynomial]:
    """Return numerator and denominator of R as polynomials in q."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    return Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])


def _min_determinant(coefficients: Sequence[float], r: Any) -> Any:
    """Return the minimum of the Jacobian's determinant over all points at a radius r.

    With a = hypot(p1, p2) r, and g the derivative of R r, the determinant is

        g R - 4 a^2 + 2 a (g + 3 R) c + 16 a^2 c^2,

    where c is the cosine of the angle between the point and (p2, p1). The Jacobian is symmetric, and on the axis the
    identity, so the lens does not fold within the radius of the first zero.
    """
    r = np.maximum(r, 1e-8)  # a > 0, for the division
    numerator, denominator = _factors(coefficients)
    q = r * r
    ratio = numerator(q) / denominator(q)
    g = ratio + 2 * q * (numerator.deriv()(q) - ratio * denominator.deriv()(q)) / denominator(q)
    a = math.hypot(*coefficients[2:4]) * r
    c = np.maximum(-(g + 3 * ratio) / (16 * a), -1)
    return g * ratio - 4 * a * a + 2 * a * (g + 3 * ratio) * c + 16 * a * a * c * c
