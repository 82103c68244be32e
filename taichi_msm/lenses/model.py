"""Interface of a lens model, and what NumPy and kernels share of it.

A lens maps normalised image coordinates (x, y), the intersection of a line of sight with the plane at depth 1 in
OpenCV's axes (x right, y down), to distorted ones. Its formula is plain arithmetic: NumPy calls it as it is, kernels
call it wrapped by Taichi, and with dual numbers it returns its derivatives.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Maximum valid radius of any lens.
MAX_RADIUS = math.tan(math.radians(88))

# Smaller coefficients have no effect within the maximum radius, and division by them may overflow.
MIN_COEFFICIENT = 1e-100

MAX_COEFFICIENT = 1e6


class Operations(NamedTuple):
    """Functions of NumPy or Taichi that lenses use in addition to + - * /."""

    sqrt: Callable[..., Any]
    arctan: Callable[..., Any]
    maximum: Callable[..., Any]
    wrap: Callable[[Callable[..., Any]], Callable[..., Any]]  # makes a function callable by other functions of a lens


NUMPY = Operations(np.sqrt, np.arctan, np.maximum, lambda function: function)


class Coefficient(NamedTuple):
    """A coefficient of a lens model: its meaning, for users, its range, and its default; None if it is required."""

    meaning: str
    least: float = -MAX_COEFFICIENT
    most: float = MAX_COEFFICIENT
    default: float | None = 0.0


class LensModel(ABC):
    """A lens model."""

    name: ClassVar[str]  # value of `distortion.model`, and of `model` in camera.json
    meaning: ClassVar[str]  # for users
    coefficients: ClassVar[Mapping[str, Coefficient]]  # in the order of camera.json; at most 8, the place in `uniforms`
    focal_length: ClassVar[str] = ""  # the coefficient that stands in place of fx and fy, if there is one

    @abstractmethod
    def build(self, operations: Operations) -> Callable[..., Any]:
        """Build distort(x, y, *coefficients), which returns the distorted x and y."""

    @abstractmethod
    def limit(self, coefficients: Sequence[float]) -> float:
        """Return the least radius at which the distortion folds back or has a pole, at most `MAX_RADIUS`."""

    def undistort(self, distorted: Array, coefficients: Sequence[float]) -> Array | None:
        """Invert the formula in closed form, with NaN beyond the limit; None if only Newton's method can."""
        return None

    def without_tangential(self, coefficients: Sequence[float]) -> tuple[float, ...]:
        """Return the coefficients with p1 = p2 = 0."""
        named = zip(self.coefficients, coefficients, strict=True)
        return tuple(0.0 if name in ("p1", "p2") else value for name, value in named)


def positive_roots(polynomial: Polynomial) -> list[float]:
    """Return the positive real roots of a polynomial."""
    # Leading zeros would add roots at infinity.
    roots = polynomial.trim(MIN_COEFFICIENT).roots()
    return [float(root.real) for root in roots if root.real > 0 and abs(root.imag) <= 1e-9 * abs(root)]
