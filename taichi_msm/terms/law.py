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
"""

# No `from __future__ import annotations` here: Taichi reads the functions of a law.

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from taichi_msm.arithmetic import Operations


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
        """Build the functions of the law.

        Args:
            operations: of NumPy or Taichi.
            tense: whether any tau is not 0; otherwise `pull` ignores it.
        """


@dataclass(frozen=True)
class LinearLaw(Law):
    """f(e) = e."""

    def build(self, operations: Operations, *, tense: bool = True) -> LawFunctions:
        """Build the functions of the law; see `Law.build`."""
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
