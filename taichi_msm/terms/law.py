"""Laws of springs: force, tangent and energy as functions of the relative elongation.

A spring of stiffness k [N/m], length L and rest length L0 [m] pulls with the force k L0 f(e) [N]. Its law f, with
f'(0) = 1, is a function of the relative elongation e = (L - L0) / L0. NumPy calls the functions of a law directly, and
kernels call them after `KernelConfig.compile_law`.

With q = u_P - u_Q and the vector o from Q to P at rest, the force of P on its neighbour Q is k L0 f(e) (o + q) / L, and
for f(e) = e

    k (L^2 - L0^2) / (L^2 + L0 L) (o + q),    L^2 - L0^2 = q (q + 2 o)                                  (eq. 2)

This form avoids cancellation for small displacements of a large sheet.

Under a pretension each spring has the tension tau L0 at rest, and the rest tensions cancel at every mass point. Without
the rest tension, the force of a spring is

    (k - tau) (1 - L0 / L) (o + q) + tau q + k L0 (f(e) - e) (o + q) / L

and twice its energy is (k - tau) (L - L0)^2 + tau q^2, plus k L0^2 times twice the integral of f(e) - e.

The locking law (`lock` and `factor` in the scene) has a tangent that grows with e from 1 to `factor`. With the lock m,
x = e / m and x0 = 1 - factor^(-1/2),

    f(e) = e                        for e <= 0
    f(e) = e / (1 - x)              for 0 < x <= x0, where the tangent (1 - x)^-2 reaches `factor`

and f is linear with the slope `factor` for x > x0. The lock m is a strain for springs. For the foundation it is a depth
[m], with e = -u_z.
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
        derivatives: derivatives(k, tau, square_difference, square, length, along, *parameters), which returns s, w, and
            the derivatives of `pull` with respect to k and tau. If q changes by p, with along = (o + q) . p, the force
            changes by s p + w (o + q) + tau p.
        parameter_derivatives: parameter_derivatives(k, tau, square_difference, square, length, *parameters), the
            derivatives of `pull` with respect to the logarithm of the lock and to the factor.
        energy: energy(k, tau, square_strain, *parameters) with square_strain = (L^2 - L0^2) / L0^2, twice the energy
            divided by L0^2, without tau q^2 [N/m].
        at_length: at_length(length, *parameters), the parameters of a spring of this length from those of 1 m.
    """

    pull: Callable[..., Any]
    derivatives: Callable[..., Any]
    parameter_derivatives: Callable[..., Any]
    energy: Callable[..., Any]
    at_length: Callable[..., Any]


class Law(ABC):
    """Law of springs: a frozen dataclass without fields."""

    parameter_count: ClassVar[int] = 0  # number of parameters of a spring

    @abstractmethod
    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        """Return the functions of the law.

        Args:
            operations: operations of NumPy or Taichi.
            tense: whether the springs are under tension at rest; if not, `pull` ignores tau.
        """


@dataclass(frozen=True)
class LinearLaw(Law):
    """f(e) = e."""

    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        sqrt, maximum = operations.sqrt, operations.maximum

        def pull(k, tau, square_difference, square, length):
            return k * square_difference / (square + length * sqrt(square))

        def derivatives(k, tau, square_difference, square, length, along):
            divisor = square + length * sqrt(square)
            # One division instead of two.
            inverse = 1 / (square * divisor)
            relative = square_difference * square * inverse  # (L - L0) / L
            return k * relative, k * ((1 - relative) * divisor * inverse * along), relative, 0 * relative

        def parameter_derivatives(k, tau, square_difference, square, length):
            return 0 * k, 0 * k

        def energy(k, tau, square_strain):
            # Rounding can make `square_strain` smaller than -1.
            e = square_strain / (1 + sqrt(maximum(square_strain + 1, 0)))
            return e * e * k

        def at_length(length):
            return ()

        return LawFunctions(pull, derivatives, parameter_derivatives, energy, at_length)


LINEAR = LinearLaw()


class LockingFunctions(NamedTuple):
    """Functions of x = e / m and x0."""

    secant: Callable[..., Any]  # f(e) / e
    tangent: Callable[..., Any]  # f'(e)
    energy: Callable[..., Any]  # twice the integral of f, divided by m^2


def build_locking(operations: Operations) -> LockingFunctions:
    """Build the functions of the locking law, for NumPy or Taichi."""
    log, maximum, minimum, where = operations.log, operations.maximum, operations.minimum, operations.where

    def secant(x, x0):
        inner, beyond = minimum(maximum(x, 0), x0), maximum(x, x0)
        return (beyond - inner * x0) / ((1 - inner) * (1 - inner) * beyond)

    def tangent(x, x0):
        inner = minimum(maximum(x, 0), x0)
        return 1 / ((1 - inner) * (1 - inner))

    def energy(x, x0):
        inner = minimum(maximum(x, 0), x0)
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
    """Return the parameters of the locking law; None for a linear law.

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
    """Locking law, with the parameters 1 / (m L0), x0 and m."""

    parameter_count: ClassVar[int] = 3

    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        sqrt, maximum, minimum = operations.sqrt, operations.maximum, operations.minimum
        secant, tangent, integral = (operations.wrap(function) for function in build_locking(operations))

        def pull(k, tau, square_difference, square, length, scale, x0, lock):
            # `secant` inlined, with a single division. The rounding error of x, divided by m, is harmless here.
            root = sqrt(square)
            x = (root - length) * scale
            inner, beyond = minimum(maximum(x, 0), x0), maximum(x, x0)
            divisor = (1 - inner) * (1 - inner) * beyond
            return (
                square_difference
                * ((k + tau) * (beyond - inner * x0) - tau * divisor)
                / ((square + length * root) * divisor)
            )

        def pull_untensed(k, tau, square_difference, square, length, scale, x0, lock):
            root = sqrt(square)
            x = (root - length) * scale
            inner, beyond = minimum(maximum(x, 0), x0), maximum(x, x0)
            divisor = (square + length * root) * ((1 - inner) * (1 - inner) * beyond)
            return k * square_difference * (beyond - inner * x0) / divisor

        def derivatives(k, tau, square_difference, square, length, along, scale, x0, lock):
            root = sqrt(square)
            relative = square_difference / (square + length * root)  # (L - L0) / L
            x = relative * root * scale
            ratio = secant(x, x0)
            isotropic = relative * ((k + tau) * ratio - tau)
            axial = ((k + tau) * tangent(x, x0) - tau - isotropic) / square * along
            return isotropic, axial, relative * ratio, relative * (ratio - 1)

        def parameter_derivatives(k, tau, square_difference, square, length, scale, x0, lock):
            root = sqrt(square)
            relative = square_difference / (square + length * root)  # (L - L0) / L
            x = relative * root * scale
            by_lock = (k + tau) * relative * (secant(x, x0) - tangent(x, x0))
            return by_lock, (k + tau) * maximum(relative - x0 / (scale * root), 0)

        def energy(k, tau, square_strain, scale, x0, lock):
            e = square_strain / (1 + sqrt(maximum(square_strain + 1, 0)))
            return (k + tau) * (lock * lock) * integral(e / lock, x0) - tau * e * e

        def at_length(length, scale, x0, lock):
            return [scale / length, x0, lock]

        return LawFunctions(pull if tense else pull_untensed, derivatives, parameter_derivatives, energy, at_length)


def spring_law(stiffening: LockNumbers | None) -> Law:
    """Return the law of springs: `LINEAR` if `stiffening` is None, otherwise `LockingLaw`."""
    return LINEAR if stiffening is None else LockingLaw()
