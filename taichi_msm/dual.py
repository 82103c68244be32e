"""Dual numbers: values with their derivatives along one or more directions, for formulas in plain arithmetic."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

from taichi_msm.arithmetic import NUMPY, Operations, unchanged


@dataclass(frozen=True)
class Dual:
    """Values, shape (...), and their derivatives, shape (directions, ...) or (...); in a kernel, variables."""

    value: Any
    slope: Any
    hold: Callable[[Any], Any] = unchanged

    __array_ufunc__ = None  # NumPy arrays then defer to the operators of this class.
    _data_oriented: ClassVar[bool] = True  # The compiler then keeps variables of this class as they are.

    def _new(self, value: Any, slope: Any) -> Dual:
        return Dual(self.hold(value), self.hold(slope), self.hold)

    def __add__(self, other: Any) -> Dual:
        value, slope = _parts(other)
        return self._new(self.value + value, self.slope + slope)

    def __mul__(self, other: Any) -> Dual:
        value, slope = _parts(other)
        return self._new(self.value * value, self.slope * value + slope * self.value)

    def __sub__(self, other: Any) -> Dual:
        value, slope = _parts(other)
        return self._new(self.value - value, self.slope - slope)

    def __truediv__(self, other: Any) -> Dual:
        value, slope = _parts(other)
        ratio = self.hold(self.value / value)
        return self._new(ratio, (self.slope - slope * ratio) / value)

    def __rtruediv__(self, other: Any) -> Dual:
        ratio = self.hold(other / self.value)
        return self._new(ratio, 0 - self.slope * ratio / self.value)

    def __rsub__(self, other: Any) -> Dual:
        return self._new(other - self.value, 0 - self.slope)

    def __neg__(self) -> Dual:
        return self._new(0 - self.value, 0 - self.slope)

    def __lt__(self, other: Any) -> Any:
        return self.value < _parts(other)[0]

    def __gt__(self, other: Any) -> Any:
        return self.value > _parts(other)[0]

    __radd__, __rmul__ = __add__, __mul__


def _parts(number: Any) -> tuple[Any, Any]:
    return (number.value, number.slope) if isinstance(number, Dual) else (number, 0.0)


def dual_operations(base: Operations) -> Operations:
    """Return the operations of dual numbers over those of their values; plain numbers stay plain."""

    def lift(function: Callable[..., Any], slope: Callable[..., Any]) -> Callable[..., Any]:
        """Extend a function to dual numbers; slope(inner, value, result) is the chain rule."""

        def of_dual(number: Any) -> Any:
            if not isinstance(number, Dual):
                return function(number)
            result = number.hold(function(number.value))
            return number._new(result, slope(number.slope, number.value, result))

        return of_dual

    def choose(function: Callable[..., Any], is_first: Callable[..., Any], a: Any, b: Any) -> Any:
        """Apply a function that returns one of two numbers."""
        either = a if isinstance(a, Dual) else b
        if not isinstance(either, Dual):
            return function(a, b)
        (value, slope), (other, other_slope) = _parts(a), _parts(b)
        return either._new(function(value, other), base.where(is_first(value, other), slope, other_slope))

    return base._replace(
        wrap=unchanged,
        sqrt=lift(base.sqrt, lambda slope, _, root: slope / (2 * root)),
        log=lift(base.log, lambda slope, value, _: slope / value),
        arctan=lift(base.arctan, lambda slope, value, _: slope / (1 + value * value)),
        exp=lift(base.exp, lambda slope, _, result: slope * result),
        maximum=partial(choose, base.maximum, operator.gt),
        minimum=partial(choose, base.minimum, operator.lt),
        where=lambda condition, a, b: choose(partial(base.where, condition), lambda *_: condition, a, b),
    )


DUAL = dual_operations(NUMPY)
