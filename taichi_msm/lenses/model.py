"""Interface of a lens model.

A lens maps normalised image coordinates (x, y), the intersection of a line of sight with the plane at depth 1 in
OpenCV's axes (x right, y down), to distorted ones. Its formula is plain arithmetic: NumPy calls it unchanged, kernels
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
    wrap: Callable[[Callable[..., Any]], Callable[..., Any]]  # makes a function callable in the formula of a lens


NUMPY = Operations(np.sqrt, np.arctan, np.maximum, lambda function: function)


class Coefficient(NamedTuple):
    """A coefficient of a lens model."""

    meaning: str  # for users, with its unit; without one it is a pure number
    least: float = -MAX_COEFFICIENT
    most: float = MAX_COEFFICIENT
    default: float | None = 0.0  # None if it is required


class LensModel(ABC):
    """A lens model."""

    name: ClassVar[str]  # value of `distortion.model`, and of `model` in camera.json
    meaning: ClassVar[str]  # for users
    coefficients: ClassVar[Mapping[str, Coefficient]]  # in the order of camera.json; at most 8, the space in `uniforms`
    focal_length: ClassVar[str] = ""  # coefficient that replaces fx and fy; empty without one

    @abstractmethod
    def build(self, operations: Operations) -> Callable[..., Any]:
        """Build the formula distort(x, y, *coefficients), which returns the distorted x and y."""

    @abstractmethod
    def limit(self, coefficients: Sequence[float]) -> float:
        """Return the least radius at which the distortion folds back or has a pole, at most `MAX_RADIUS`."""

    def undistort(self, distorted: Array, coefficients: Sequence[float]) -> Array | None:
        """Return the inverse of the formula in closed form, or None for a model that has none.

        Args:
            distorted: distorted normalised image coordinates, shape (..., 2).
            coefficients: all coefficients, in the order of the model.

        Returns:
            Undistorted coordinates, shape (..., 2), NaN beyond the limit; None if Newton's method is necessary.
        """
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
