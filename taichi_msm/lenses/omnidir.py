"""OpenCV's omnidirectional model, after Mei.

The line of sight is projected onto the unit sphere, then, from a point at distance xi from its centre, onto a plane:

    (u, v) = (x, y) / (1 + xi sqrt(1 + x^2 + y^2)).

The rational model with k1, k2, p1 and p2 distorts (u, v).

Source: Mei and Rives 2007; OpenCV's documentation of ccalib, "Omnidirectional Camera Calibration".
"""

# No `from __future__ import annotations`: Taichi compiles the formula.

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from taichi_msm.arithmetic import Operations
from taichi_msm.lenses.model import MAX_RADIUS, Coefficient, LensModel
from taichi_msm.lenses.rational import Rational


class Omnidir(LensModel):
    """OpenCV's omnidirectional model."""

    name = "omnidir"
    meaning = "its omnidirectional model, with xi, k1, k2, p1 and p2"
    coefficients: ClassVar = {
        "xi": Coefficient("distance of the centre of projection from that of the unit sphere", least=0.0, default=None),
        **dict.fromkeys(("k1", "k2"), Coefficient("radial coefficient")),
        **dict.fromkeys(("p1", "p2"), Coefficient("tangential coefficient")),
    }

    def build(self, operations: Operations) -> Callable[..., Any]:
        sqrt, rational = operations.sqrt, operations.wrap(Rational().build(operations))

        def distort(x, y, xi, k1, k2, p1, p2):
            w = 1.0 + xi * sqrt(1.0 + x * x + y * y)
            return rational(x / w, y / w, k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0)

        return distort

    def limit(self, coefficients: Sequence[float]) -> float:
        """Return the radius r that is mapped to the limit m of the rational model."""
        xi, k1, k2, p1, p2 = coefficients
        m = Rational().limit((k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0))
        # As r grows, the radius on the plane approaches 1 / xi.
        if m * xi >= 1:
            return MAX_RADIUS
        return min(MAX_RADIUS, m * (1 + xi * math.sqrt(1 + m * m * (1 - xi * xi))) / (1 - m * m * xi * xi))
