"""Force, energy and derivatives of a spring.

A spring of stiffness k [N/m], length L and rest length L0 [m] pulls with the force k L0 f(e), where f is its law
(`taichi_msm.laws`) of the relative elongation e = (L - L0) / L0; without a law f(e) = e.

With q = u_P - u_Q and the vector o from Q to P at rest, the force of P on its neighbour Q is k L0 f(e) (o + q) / L, and
for f(e) = e

    k (L^2 - L0^2) / (L^2 + L0 L) (o + q),    L^2 - L0^2 = q (q + 2 o)                                  (eq. 2)

This form avoids cancellation for small displacements of a large sheet.

Under a pretension each spring has the tension tau L0 at rest, and the rest tensions cancel at every mass point. Without
the rest tension, the force of a spring is

    (k - tau) (1 - L0 / L) (o + q) + tau q + k L0 (f(e) - e) (o + q) / L

and twice its energy is (k - tau) (L - L0)^2 + tau q^2, plus k L0^2 times twice the integral of f(e) - e.
"""

# No `from __future__ import annotations` here: Taichi reads the functions.

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from taichi_msm.arithmetic import Operations
from taichi_msm.dual import Dual, dual_operations
from taichi_msm.laws.law import Law
from taichi_msm.terms.places import Places


class LawFunctions(NamedTuple):
    """The functions of a law for NumPy or kernels; `x` is e / m, and `shape` the list of `Law.shape`.

    `tangent` and `by_shape` compose expressions: kernels call them within ti.static.
    """

    ratio: Callable[..., Any]  # ratio(x, *shape), n and d with f(e) = e n / d
    secant: Callable[..., Any]  # secant(x, shape), f(e) / e
    tangent: Callable[..., Any]  # tangent(x, shape), f'(e)
    by_shape: Callable[..., Any]  # by_shape(x, shape), the derivatives of `secant` by the shape, a list
    integral: Callable[..., Any]  # integral(x, *shape), twice the integral of f, divided by m^2


class SpringFunctions(NamedTuple):
    """The functions of a spring for NumPy or kernels.

    Their arguments are k - tau and tau [N/m] as `k` and `tau`, L^2 - L0^2 and L^2 [m2] as `square_difference` and
    `square`, L0 [m] as `length`, and `numbers`, the list of `LawNumbers.constants`, which is empty without a law.

    Attributes:
        pull: pull(k, tau, square_difference, square, length, numbers), the force divided by L, without tau q [N/m].
        derivatives: derivatives(k, tau, square_difference, square, length, along, numbers), which returns s, w, and the
            derivatives of `pull` with respect to k, to tau, and in a list to log m and the shape. If q changes by p,
            with along = (o + q) . p, the force changes by s p + w (o + q) + tau p. Kernels call it within ti.static.
        energy: energy(k, tau, square_strain, numbers) with square_strain = (L^2 - L0^2) / L0^2, twice the energy
            divided by L0^2, without tau q^2 [N/m].
    """

    pull: Callable[..., Any]
    derivatives: Callable[..., Any]
    energy: Callable[..., Any]


def law_places(law: Law | None) -> Places:
    """Return the names of `LawNumbers.constants`; none without a law."""
    return Places(inverse_scale=1, scale=1, shape=[1] * law.shape_count) if law else Places()


def build_law(law: Law, operations: Operations) -> LawFunctions:
    """Build the functions of a law; its tangent and derivatives are those of dual numbers."""
    formulas, hold = law.build(operations), operations.hold
    ratio, dual_ratio = operations.wrap(formulas.ratio), law.build(dual_operations(operations)).ratio

    def secant(x, shape):
        numerator, denominator = ratio(x, *shape)
        return numerator / denominator

    def differentiate(x: Any, shape: Sequence[Any], direction: int) -> Dual:
        """Return `secant` as a dual number along x, direction 0, or along a number of the shape."""
        slopes = [hold((1 if n == direction else 0) + 0 * x) for n in range(1 + len(shape))]
        numbers = [Dual(*each, hold) for each in zip((x, *shape), slopes, strict=True)]
        numerator, denominator = dual_ratio(*numbers)
        quotient: Dual = numerator / denominator
        return quotient

    def tangent(x: Any, shape: Sequence[Any]) -> Any:
        along_x = differentiate(x, shape, 0)
        return along_x.value + x * along_x.slope

    def by_shape(x: Any, shape: Sequence[Any]) -> list[Any]:
        return [differentiate(x, shape, 1 + n).slope for n in range(len(shape))]

    return LawFunctions(ratio, operations.wrap(secant), tangent, by_shape, operations.wrap(formulas.integral))


def build_pull_of_squares(operations: Operations) -> Callable[..., Any]:
    """Build pull(k, square_difference, square, square_at_rest) of a linear spring: one square root, of L^2 L0^2."""
    sqrt = operations.sqrt

    def pull(k, square_difference, square, square_at_rest):
        return k * square_difference / (square + sqrt(square * square_at_rest))

    return operations.wrap(pull)


def build_spring(law: Law | None, operations: Operations, *, tense: bool = True) -> SpringFunctions:
    """Build the functions of a spring; a spring that is not `tense` ignores tau."""
    sqrt, maximum, hold = operations.sqrt, operations.maximum, operations.hold
    if law is None:

        def linear_pull(k, tau, square_difference, square, length, numbers):
            return k * square_difference / (square + length * sqrt(square))

        def linear_derivatives(k, tau, square_difference, square, length, along, numbers):
            divisor = hold(square + length * sqrt(square))
            # One division instead of two.
            inverse = hold(1 / (square * divisor))
            relative = hold(square_difference * square * inverse)  # (L - L0) / L
            return k * relative, k * ((1 - relative) * divisor * inverse * along), relative, 0 * relative, []

        def linear_energy(k, tau, square_strain, numbers):
            # Rounding can make `square_strain` smaller than -1.
            e = square_strain / (1 + sqrt(maximum(square_strain + 1, 0)))
            return e * e * k

        return SpringFunctions(operations.wrap(linear_pull), linear_derivatives, operations.wrap(linear_energy))

    ratio, secant, tangent, by_shape, integral = build_law(law, operations)

    def pull(k, tau, square_difference, square, length, numbers):
        # A single division. The rounding error of x, divided by m, is harmless here.
        root = sqrt(square)
        n, d = ratio((root - length) * numbers[0], *numbers[2:])
        return square_difference * ((k + tau) * n - tau * d) / ((square + length * root) * d)

    def untensed_pull(k, tau, square_difference, square, length, numbers):
        root = sqrt(square)
        n, d = ratio((root - length) * numbers[0], *numbers[2:])
        return k * square_difference * n / ((square + length * root) * d)

    def derivatives(k, tau, square_difference, square, length, along, numbers):
        root, shape = hold(sqrt(square)), numbers[2:]
        relative = hold(square_difference / (square + length * root))  # (L - L0) / L
        x = hold(relative * root * numbers[0])
        ratio_at_x, slope = hold(secant(x, shape)), hold(tangent(x, shape))
        isotropic = hold(relative * ((k + tau) * ratio_at_x - tau))
        axial = ((k + tau) * slope - tau - isotropic) / square * along
        by_numbers = [(k + tau) * relative * by for by in (ratio_at_x - slope, *by_shape(x, shape))]
        return isotropic, axial, relative * ratio_at_x, relative * (ratio_at_x - 1), by_numbers

    def energy(k, tau, square_strain, numbers):
        e = square_strain / (1 + sqrt(maximum(square_strain + 1, 0)))
        return (k + tau) * (numbers[1] * numbers[1]) * integral(e / numbers[1], *numbers[2:]) - tau * e * e

    return SpringFunctions(operations.wrap(pull if tense else untensed_pull), derivatives, operations.wrap(energy))
