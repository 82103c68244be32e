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

from taichi_msm.arithmetic import Operations
from taichi_msm.model.sheet import LockNumbers
from taichi_msm.terms.law import Law, LawFunctions

# Up to this y, atanh(y) - y is computed by its series.
MAX_SERIES_Y = 0.1


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


def make_stiffening(lock: float | None, factor: float) -> LockNumbers | None:
    """Return the numbers of a law that locks; None for a linear law."""
    return None if lock is None or factor == 1 else LockNumbers(lock, factor)


def law_numbers(stiffening: LockNumbers | None, length: float) -> tuple[float, ...]:
    """Return 1 / (m L0), x0 and m for a spring of length L0 [m]; none for a linear law. For the foundation L0 is 1."""
    if stiffening is None:
        return ()
    return 1 / (stiffening.lock * length), 1 - stiffening.factor**-0.5, stiffening.lock


@dataclass(frozen=True)
class LockingLaw(Law):
    """The law of springs that lock; its numbers are `law_numbers`."""

    number_count: ClassVar[int] = 3

    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        """Build the functions of the law; see `Law.build`."""
        sqrt, maximum, minimum = operations.sqrt, operations.maximum, operations.minimum
        secant, tangent, integral = (operations.wrap(function) for function in build_locking(operations))

        def pull(k, tau, square_difference, square, length, scale, end, lock):
            # As `secant`, with one division for all. That x has an error of rounding / m does not matter here.
            root = sqrt(square)
            x = (root - length) * scale
            inner, beyond = minimum(maximum(x, 0), end), maximum(x, end)
            divisor = (1 - inner) * (1 - inner) * beyond
            return (
                square_difference
                * ((k + tau) * (beyond - inner * end) - tau * divisor)
                / ((square + length * root) * divisor)
            )

        def pull_untensed(k, tau, square_difference, square, length, scale, end, lock):
            root = sqrt(square)
            x = (root - length) * scale
            inner, beyond = minimum(maximum(x, 0), end), maximum(x, end)
            divisor = (square + length * root) * ((1 - inner) * (1 - inner) * beyond)
            return k * square_difference * (beyond - inner * end) / divisor

        def slopes(k, tau, square_difference, square, length, along, scale, end, lock):
            root = sqrt(square)
            share = square_difference / (square + length * root)
            x = share * root * scale
            ratio = secant(x, end)
            isotropic = share * ((k + tau) * ratio - tau)
            axial = ((k + tau) * tangent(x, end) - tau - isotropic) / square * along
            return isotropic, axial, share * ratio, share * (ratio - 1)

        def by_numbers(k, tau, square_difference, square, length, scale, end, lock):
            root = sqrt(square)
            share = square_difference / (square + length * root)
            x = share * root * scale
            by_lock = (k + tau) * share * (secant(x, end) - tangent(x, end))
            return by_lock, (k + tau) * maximum(share - end / (scale * root), 0)

        def energy(k, tau, share, scale, end, lock):
            stretch = share / (1 + sqrt(maximum(share + 1, 0)))
            return (k + tau) * (lock * lock) * integral(stretch / lock, end) - tau * stretch * stretch

        return LawFunctions(pull if tense else pull_untensed, slopes, by_numbers, energy)
