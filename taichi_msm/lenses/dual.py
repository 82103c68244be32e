"""Dual numbers: values and their derivatives along x and y, for the Jacobian of a lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.lenses.model import Operations

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Dual:
    """Values, shape (...), and their derivatives along x and y, shape (2, ...)."""

    value: Array
    slope: Array

    __array_ufunc__ = None  # NumPy arrays then defer to the operators of this class.

    def __add__(self, other: Any) -> Dual:
        value, slope = _parts(other)
        return Dual(self.value + value, self.slope + slope)

    def __mul__(self, other: Any) -> Dual:
        value, slope = _parts(other)
        return Dual(self.value * value, self.slope * value + slope * self.value)

    def __sub__(self, other: Any) -> Dual:
        value, slope = _parts(other)
        return Dual(self.value - value, self.slope - slope)

    def __truediv__(self, other: Any) -> Dual:
        value, slope = _parts(other)
        ratio = self.value / value
        return Dual(ratio, (self.slope - slope * ratio) / value)

    def __rtruediv__(self, other: Any) -> Dual:
        ratio = other / self.value
        return Dual(ratio, -self.slope * ratio / self.value)

    def __rsub__(self, other: Any) -> Dual:
        return Dual(other - self.value, -self.slope)

    __radd__, __rmul__ = __add__, __mul__


def _parts(number: Any) -> tuple[Any, Any]:
    return (number.value, number.slope) if isinstance(number, Dual) else (number, 0.0)


def _sqrt(number: Dual) -> Dual:
    root = np.sqrt(number.value)
    return Dual(root, number.slope / (2 * root))


def _arctan(number: Dual) -> Dual:
    return Dual(np.arctan(number.value), number.slope / (1 + number.value * number.value))


def _maximum(number: Any, least: float) -> Dual:
    value, slope = _parts(number)
    return Dual(np.maximum(value, least), np.where(value > least, slope, 0.0))


DUAL = Operations(_sqrt, _arctan, _maximum, lambda function: function)
