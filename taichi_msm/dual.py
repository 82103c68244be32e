"""Dual numbers: values and their derivatives, for formulas in plain arithmetic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Operations, unwrapped

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Dual:
    """Values, shape (...), and their derivatives with respect to n variables, shape (n, ...)."""

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

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.slope)

    def __lt__(self, other: Any) -> Any:
        return self.value < _parts(other)[0]

    def __gt__(self, other: Any) -> Any:
        return self.value > _parts(other)[0]

    __radd__, __rmul__ = __add__, __mul__


def _parts(number: Any) -> tuple[Any, Any]:
    return (number.value, number.slope) if isinstance(number, Dual) else (number, 0.0)


def _apply(function: Callable[[Any], Any], chain: Callable[[Any, Any, Any], Any], number: Any) -> Any:
    """Apply a function; `chain` is the chain rule, the derivatives of y = f(x) from those of x, x and y."""
    if not isinstance(number, Dual):
        return function(number)
    value = function(number.value)
    return Dual(value, chain(number.slope, number.value, value))


def _choose(
    function: Callable[[Any, Any], Any], takes_first: Callable[[Any, Any], Any], first: Any, second: Any
) -> Any:
    """Apply a function that returns one of its arguments."""
    (a, slope_a), (b, slope_b) = _parts(first), _parts(second)
    if not isinstance(first, Dual) and not isinstance(second, Dual):
        return function(a, b)
    return Dual(function(a, b), np.where(takes_first(a, b), slope_a, slope_b))


def _where(condition: Any, first: Any, second: Any) -> Any:
    return _choose(partial(np.where, condition), lambda a, b: condition, first, second)


DUAL = Operations(
    sqrt=partial(_apply, np.sqrt, lambda slope, x, y: slope / (2 * y)),
    exp=partial(_apply, np.exp, lambda slope, x, y: slope * y),
    log=partial(_apply, np.log, lambda slope, x, y: slope / x),
    arctan=partial(_apply, np.arctan, lambda slope, x, y: slope / (1 + x * x)),
    maximum=partial(_choose, np.maximum, np.greater),
    minimum=partial(_choose, np.minimum, np.less),
    where=_where,
    wrap=unwrapped,
)
