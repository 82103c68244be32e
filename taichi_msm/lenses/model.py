"""Interface of a lens model.

A lens distorts normalised image coordinates: the coordinates (x, y) of a line of sight in the plane at depth 1, x right
and y down as in OpenCV. The formula is plain arithmetic: NumPy calls it unchanged, kernels call it wrapped by Taichi,
and dual numbers yield its Jacobian.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

from numpy.polynomial import Polynomial

from taichi_msm.arithmetic import Array, Operations

# Maximum valid radius of any lens: 88 degrees from the optical axis.
MAX_RADIUS = math.tan(math.radians(88))

# Coefficients below this value are treated as 0: they have no effect, and division by them may overflow.
MIN_COEFFICIENT = 1e-100

MAX_COEFFICIENT = 1e6


class Coefficient(NamedTuple):
    """A coefficient of a lens model."""

    meaning: str  # for users; with the unit, unless dimensionless
    least: float = -MAX_COEFFICIENT
    most: float = MAX_COEFFICIENT
    default: float | None = 0.0  # None if it is required


class LensModel(ABC):
    """Formula, coefficients and valid radius of a lens model."""

    name: ClassVar[str]  # value of `distortion.model`, and of `model` in camera.json
    meaning: ClassVar[str]  # for users
    coefficients: ClassVar[Mapping[str, Coefficient]]  # in the order of camera.json; `uniforms` has room for 8
    focal_length: ClassVar[str] = ""  # coefficient in place of fx and fy; empty if the model has none

    @abstractmethod
    def build(self, operations: Operations) -> Callable[..., Any]:
        """Return the formula distort(x, y, *coefficients), whose results are the distorted x and y."""

    @abstractmethod
    def limit(self, coefficients: Sequence[float]) -> float:
        """Return the valid radius: that of the first fold or pole of the distortion, at most `MAX_RADIUS`."""

    def undistort(self, distorted: Array, coefficients: Sequence[float]) -> Array | None:
        """Invert the formula in closed form.

        Args:
            distorted: distorted normalised image coordinates, shape (..., 2).
            coefficients: all coefficients, in the order of the model.

        Returns:
            Undistorted coordinates, shape (..., 2), NaN beyond the limit; None for a model without a closed form.
        """
        return None

    def without_tangential(self, coefficients: Sequence[float]) -> tuple[float, ...]:
        """Return the coefficients with p1 = p2 = 0."""
        named = zip(self.coefficients, coefficients, strict=True)
        return tuple(0.0 if name in ("p1", "p2") else value for name, value in named)


def positive_roots(polynomial: Polynomial) -> list[float]:
    """Return the positive real roots of a polynomial."""
    # A leading coefficient near 0 would add a root near infinity.
    roots = polynomial.trim(MIN_COEFFICIENT).roots()
    return [float(root.real) for root in roots if root.real > 0 and abs(root.imag) <= 1e-9 * abs(root)]
