"""Interface of a law: the force of a spring, or of the foundation, as a function of its elongation.

With the elongation e, a strain of a spring and a depth [m] of the foundation, its scale m and x = e / m, a spring of
stiffness k and rest length L0 pulls with the force k L0 f(e), where

    f(e) = e n(x) / d(x),    f'(0) = 1

The ratio of n and d lets kernels take a single division. The formulas are plain arithmetic: NumPy calls them unchanged,
kernels call them wrapped by the compiler, and dual numbers yield the tangent and the derivatives by all numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

from taichi_msm.arithmetic import Operations


class LawKey(NamedTuple):
    """A number of a law other than its scale: a key of the scene."""

    meaning: str  # for users
    expected: str  # for error messages
    least: float
    most: float
    default: float


class LawFormulas(NamedTuple):
    """Formulas of a law; `shape` are the numbers of `Law.shape`."""

    ratio: Callable[..., Any]  # ratio(x, *shape), n and d
    integral: Callable[..., Any]  # integral(x, *shape), twice the integral of f from 0, divided by m^2


class Law(ABC):
    """Law of springs and of the foundation; linear elasticity is no law."""

    scale: ClassVar[str]  # key of the scale m
    keys: ClassVar[Mapping[str, LawKey]]  # the other numbers
    shape_count: ClassVar[int] = 0  # number of results of `shape`

    @abstractmethod
    def build(self, operations: Operations) -> LawFormulas:
        """Return the formulas of the law."""

    def shape(self, *numbers: Any) -> tuple[Any, ...]:
        """Return the arguments of the formulas, for the values of `keys`, real or complex."""
        return numbers

    @abstractmethod
    def largest_slope(self, *numbers: float) -> float:
        """Return the largest tangent f'(e), for the values of `keys`; 1 if the law is linear with them."""


class LawNumbers(NamedTuple):
    """A law with its numbers."""

    law: Law
    scale: Any  # m, a strain of springs or a depth of the foundation [m]
    numbers: tuple[Any, ...]  # values of `Law.keys`

    @property
    def shape(self) -> tuple[Any, ...]:
        """Arguments of the formulas."""
        return self.law.shape(*self.numbers)

    @property
    def largest_slope(self) -> float:
        """Largest tangent f'(e)."""
        return self.law.largest_slope(*self.numbers)

    def constants(self, length: Any) -> tuple[Any, ...]:
        """Return the constants of kernels for springs of a rest length [m]: 1 / (m L0), m and the shape.

        The foundation has the length 1.
        """
        return 1 / (self.scale * length), self.scale, *self.shape
