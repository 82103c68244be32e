"""Laws of springs: force, tangent and energy by the elongation, in plain arithmetic.

A spring of stiffness k whose length L0 becomes L pulls with k L0 f(e), where e = (L - L0) / L0 and f'(0) = 1; f is its
law. NumPy calls the functions of a law as they are, and kernels call them wrapped by `KernelConfig.compile_law`.

With q = u_P - u_Q and the vector o from Q to P at rest, the force of P on its neighbour Q is k L0 f(e) (o + q) / L, and
for f(e) = e

    k (L^2 - L0^2) / (L^2 + L0 L) (o + q),    L^2 - L0^2 = q (q + 2 o)                                  (eq. 2)

This form avoids cancellation for small displacements of a large sheet.

Under a pretension each spring has the tension tau L at rest, L0 is its length at rest, and the tensions cancel at every
mass point. Without them, the force of a spring is

    (k - tau) (1 - L0 / L) (o + q) + tau q + k L0 (f(e) - e) (o + q) / L

and twice its energy is (k - tau) (L - L0)^2 + tau q^2, plus k L0^2 times twice the integral of f(e) - e.

The stiffness of tissue that locks (`lock` and `factor` in the scene) grows with the elongation, up to a factor. With
x = e / m for the lock m, and x0 = 1 - factor^(-1/2),

    f(e) = e                        for e <= 0
    f(e) = e / (1 - x)              for 0 < x <= x0, where the tangent (1 - x)^-2 reaches `factor`

and beyond x0 f is straight with the slope `factor`. A spring locks when it is stretched by m; the foundation when it is
pressed in by m, an elongation w = -u_z of length 1.
"""

# No `from __future__ import annotations` here: Taichi reads the functions of a law.

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from taichi_msm.arithmetic import Operations
from taichi_msm.model.sheet import LockNumbers
from taichi_msm.scene.sheet import Tissue

# Up to this y, atanh(y) - y is computed by its series.
MAX_SERIES_Y = 0.1


class LawFunctions(NamedTuple):
    """The functions of a law.

    In them `k` is k - tau and `tau` is tau [N/m], `square_difference` is L^2 - L0^2, `square` is L^2, `length` is L0,
    and `numbers` are those of the law.

    Attributes:
        pull: pull(k, tau, square_difference, square, length, *numbers), the force divided by L, without tau q [N/m].
        slopes: slopes(k, tau, square_difference, square, length, along, *numbers) for a displacement p of an end, with
            along = (o + q) . p. It returns s, w and the derivatives of `pull` by k and by tau. The force changes by
            s p + w (o + q), without tau p.
        by_numbers: by_numbers(k, tau, square_difference, square, length, *numbers), the derivatives of `pull` with
            respect to the logarithm of the lock and to the factor.
        energy: energy(k, tau, share, *numbers) for share = (L^2 - L0^2) / L0^2, twice the energy divided by
            L0^2, without tau q^2 [N/m].
    """

    pull: Callable[..., Any]
    slopes: Callable[..., Any]
    by_numbers: Callable[..., Any]
    energy: Callable[..., Any]


class Law(ABC):
    """A law, as a frozen dataclass without numbers."""

    number_count: ClassVar[int] = 0  # count of numbers of a spring

    @abstractmethod
    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        """Build the functions of the law for NumPy or Taichi; if not `tense`, `pull` ignores tau, because it is 0."""


@dataclass(frozen=True)
class LinearLaw(Law):
    """f(e) = e."""

    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        sqrt, maximum = operations.sqrt, operations.maximum

        def pull(k, tau, square_difference, square, length):
            return k * square_difference / (square + length * sqrt(square))

        def slopes(k, tau, square_difference, square, length, along):
            both = square + length * sqrt(square)
            # One division instead of two.
            inverse = 1 / (square * both)
            share = square_difference * square * inverse
            return k * share, k * ((1 - share) * both * inverse * along), share, 0 * share

        def by_numbers(k, tau, square_difference, square, length):
            return 0 * k, 0 * k

        def energy(k, tau, share):
            # L / L0 - 1; rounding can make `share` smaller than -1.
            stretch = share / (1 + sqrt(maximum(share + 1, 0)))
            return stretch * stretch * k

        return LawFunctions(pull, slopes, by_numbers, energy)


LINEAR = LinearLaw()


class LockingFunctions(NamedTuple):
    """Functions of x = e / m and x0."""

    secant: Callable[..., Any]  # f(e) / e
    tangent: Callable[..., Any]  # f'(e)
    energy: Callable[..., Any]  # twice the integral of f, divided by m^2


def build_locking(operations: Operations) -> LockingFunctions:
    """Build the functions of the law that locks."""
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
    """The law of springs that lock, see above; its numbers are `law_numbers`."""

    number_count: ClassVar[int] = 3

    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
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


def spring_numbers(tissue: Tissue) -> LockNumbers | None:
    """Return the numbers of the law of the springs of a tissue; None for a linear law."""
    keys = tissue.stiffening
    return None if keys is None else make_stiffening(keys.lock, keys.factor)


def spring_law(numbers: LockNumbers | None) -> Law:
    """Return the law of springs with these numbers."""
    return LINEAR if numbers is None else LockingLaw()
