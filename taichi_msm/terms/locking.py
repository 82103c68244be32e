"""The law of tissue that locks: its stiffness grows with the elongation, up to a factor. Scene: `lock` and `factor`.

With x = e / m for the lock m, and x0 = 1 - factor^(-1/2),

    f(e) = e                        for e <= 0
    f(e) = e / (1 - x)              for 0 < x <= x0, where the tangent (1 - x)^-2 reaches `factor`

and beyond x0 f is straight with the slope `factor`. A spring locks when it is stretched by m; the foundation when it is
pressed in by m, an elongation w = -u_z of length 1.
"""

# No `from __future__ import annotations` here: Taichi reads the functions of a law.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from taichi_msm.terms.law import Law, LawFunctions, Operations

# Up to this y, atanh(y) - y is computed by its series.
MAX_SERIES_Y = 0.1


class Stiffening(NamedTuple):
    """Numbers of a law that locks."""

    lock: float  # m: the strain of a spring; for a foundation a length [m]
    factor: float  # largest tangent

    def numbers(self, length: float) -> tuple[float, float]:
        """Return 1 / (m L0) and x0 for a spring of length L0, or with 1 for the foundation."""
        return 1 / (self.lock * length), 1 - self.factor**-0.5


class LockingFunctions(NamedTuple):
    """Functions of x = e / m and x0.

    Attributes:
        secant: f(e) / e.
        tangent: f'(e).
        energy: twice the integral of f, divided by m^2.
    """

    secant: Callable[..., Any]
    tangent: Callable[..., Any]
    energy: Callable[..., Any]


def build_locking(operations: Operations) -> LockingFunctions:
    """Build the functions of the law."""
    log, maximum, minimum, where = operations.log, operations.maximum, operations.minimum, operations.where

    def secant(x, end):
        inner, beyond = minimum(maximum(x, 0), end), maximum(x, end)
        return (beyond - inner * end) / ((1 - inner) * (1 - inner) * beyond)

    def tangent(x, end):
        inner = minimum(maximum(x, 0), end)
        return 1 / ((1 - inner) * (1 - inner))

    def energy(x, end):
        inner = minimum(maximum(x, 0), end)
        # -inner - log(1 - inner) = y^2 (2 - inner) + 2 (atanh(y) - y), which avoids cancellation.
        y = inner / (2 - inner)
        square, one = y * y, 1 + 0 * y
        series = square * (one / 3 + square * (one / 5 + square * (one / 7 + square * (one / 9 + square / 11))))
        excess = where(y < MAX_SERIES_Y, series * y, log((1 + y) / (1 - y)) / 2 - y)
        slope = 1 / (1 - inner)
        beyond = x - inner
        return 2 * (square * (2 - inner) + 2 * excess) + beyond * (2 * inner * slope + beyond * (slope * slope))

    return LockingFunctions(secant, tangent, energy)


@dataclass(frozen=True)
class LockingLaw(Law):
    """The law of springs that lock; its numbers are those of `Stiffening.numbers`."""

    number_count: ClassVar[int] = 2

    def build(self, operations: Operations) -> LawFunctions:
        """Build the functions of the law."""
        sqrt, maximum = operations.sqrt, operations.maximum
        secant, tangent, integral = (operations.wrap(function) for function in build_locking(operations))

        def pull(k, tau, longer, square, length, scale, end):
            root = sqrt(square)
            share = longer / (square + length * root)
            ratio = secant(share * root * scale, end)
            return share * ((k + tau) * ratio - tau)

        def slopes(k, tau, longer, square, length, along, scale, end):
            root = sqrt(square)
            share = longer / (square + length * root)
            x = share * root * scale
            ratio = secant(x, end)
            straight = share * ((k + tau) * ratio - tau)
            turned = ((k + tau) * tangent(x, end) - tau - straight) / square * along
            return straight, turned, share * ratio, share * (ratio - 1)

        def energy(k, tau, share, length, scale, end):
            stretch = share / (1 + sqrt(maximum(share + 1, 0)))
            m = 1 / (scale * length)
            return (k + tau) * (m * m) * integral(stretch / m, end) - tau * stretch * stretch

        return LawFunctions(pull, slopes, energy)
