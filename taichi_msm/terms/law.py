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


class LawFunctions(NamedTuple):
    """The functions of a law.

    Their arguments are k - tau and tau [N/m] as `k` and `tau`, L^2 - L0^2 and L^2 [m2] as `square_difference` and
    `square`, L0 [m] as `length`, and the parameters of the law (`law_parameters`).

    Attributes:
        pull: pull(k, tau, square_difference, square, length, *parameters), the force divided by L, without tau q [N/m].
        derivatives: derivatives(k, tau, square_difference, square, length, along, *parameters) returns s, w, and the
            derivatives of `pull` with respect to k and tau. A displacement p of an end, with along = (o + q) . p,
            changes the force by s p + w (o + q), without tau p.
        parameter_derivatives: parameter_derivatives(k, tau, square_difference, square, length, *parameters), the
            derivatives of `pull` with respect to the logarithm of the lock and to the factor.
        energy: energy(k, tau, share, *parameters) for share = (L^2 - L0^2) / L0^2, twice the energy divided by
            L0^2, without tau q^2 [N/m].
    """

    pull: Callable[..., Any]
    derivatives: Callable[..., Any]
    parameter_derivatives: Callable[..., Any]
    energy: Callable[..., Any]


class Law(ABC):
    """A law, as a frozen dataclass without coefficients."""

    parameter_count: ClassVar[int] = 0  # number of parameters of a spring

    @abstractmethod
    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        """Return the functions of the law.

        Args:
            operations: operations of NumPy or Taichi.
            tense: whether the springs have a tension at rest; otherwise `pull` ignores tau, which is 0.
        """


@dataclass(frozen=True)
class LinearLaw(Law):
    """f(e) = e."""

    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        sqrt, maximum = operations.sqrt, operations.maximum

        def pull(k, tau, square_difference, square, length):
            return k * square_difference / (square + length * sqrt(square))

        def derivatives(k, tau, square_difference, square, length, along):
            both = square + length * sqrt(square)
            # One division instead of two.
            inverse = 1 / (square * both)
            share = square_difference * square * inverse
            return k * share, k * ((1 - share) * both * inverse * along), share, 0 * share

        def parameter_derivatives(k, tau, square_difference, square, length):
            return 0 * k, 0 * k

        def energy(k, tau, share):
            # L / L0 - 1; rounding can make `share` smaller than -1.
            stretch = share / (1 + sqrt(maximum(share + 1, 0)))
            return stretch * stretch * k

        return LawFunctions(pull, derivatives, parameter_derivatives, energy)


LINEAR = LinearLaw()


class LockingFunctions(NamedTuple):
    """Functions of x = e / m and x0."""

    secant: Callable[..., Any]  # f(e) / e
    tangent: Callable[..., Any]  # f'(e)
    energy: Callable[..., Any]  # twice the integral of f, divided by m^2


def build_locking(operations: Operations) -> LockingFunctions:
    """Build the functions of the law that locks, for NumPy or Taichi."""
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
        square, unit = y * y, 1 + 0 * y
        series = square * (unit / 3 + square * (unit / 5 + square * (unit / 7 + square * (unit / 9 + square / 11))))
        excess = where(y < 0.1, series * y, log((1 + y) / (1 - y)) / 2 - y)
        slope = 1 / (1 - inner)
        beyond = x - inner
        return 2 * (square * (2 - inner) + 2 * excess) + beyond * (2 * inner * slope + beyond * (slope * slope))

    return LockingFunctions(secant, tangent, energy)


def make_stiffening(lock: float | None, factor: float) -> LockNumbers | None:
    """Return the parameters of a law that locks; None for a linear law.

    Args:
        lock: strain m of springs, or depth m of a foundation [m]; None for a linear law.
        factor: ratio of the largest stiffness to that at rest.
    """
    return None if lock is None or factor == 1 else LockNumbers(lock, factor)


def law_parameters(stiffening: LockNumbers | None, length: float) -> tuple[float, ...]:
    """Return the parameters of a law for kernels: 1 / (m L0), x0 and m; () for a linear law.

    Args:
        stiffening: lock m and factor; None for a linear law.
        length: length L0 of the springs [m]; 1 for the foundation.
    """
    if stiffening is None:
        return ()
    return 1 / (stiffening.lock * length), 1 - stiffening.factor**-0.5, stiffening.lock


@dataclass(frozen=True)
class LockingLaw(Law):
    """The law of springs that lock, with the parameters 1 / (m L0), x0 and m."""

    parameter_count: ClassVar[int] = 3

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

        def derivatives(k, tau, square_difference, square, length, along, scale, end, lock):
            root = sqrt(square)
            share = square_difference / (square + length * root)
            x = share * root * scale
            ratio = secant(x, end)
            isotropic = share * ((k + tau) * ratio - tau)
            axial = ((k + tau) * tangent(x, end) - tau - isotropic) / square * along
            return isotropic, axial, share * ratio, share * (ratio - 1)

        def parameter_derivatives(k, tau, square_difference, square, length, scale, end, lock):
            root = sqrt(square)
            share = square_difference / (square + length * root)
            x = share * root * scale
            by_lock = (k + tau) * share * (secant(x, end) - tangent(x, end))
            return by_lock, (k + tau) * maximum(share - end / (scale * root), 0)

        def energy(k, tau, share, scale, end, lock):
            stretch = share / (1 + sqrt(maximum(share + 1, 0)))
            return (k + tau) * (lock * lock) * integral(stretch / lock, end) - tau * stretch * stretch

        return LawFunctions(pull if tense else pull_untensed, derivatives, parameter_derivatives, energy)


def spring_law(stiffening: LockNumbers | None) -> Law:
    """Return `LockingLaw`, or `LINEAR` without stiffening."""
    return LINEAR if stiffening is None else LockingLaw()
