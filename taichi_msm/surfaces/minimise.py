"""Minimisation by L-BFGS, with an approximate inverse Hessian to begin from, over a domain with an end.

SciPy's takes neither: its line search expects finite values, and its first Hessian is a multiple of the identity. With
that one, an even grid of 101 x 101 mass points takes 360 to 1000 iterations, in place of 25 to 54.

Source: Nocedal, Wright: Numerical Optimization, 2nd ed., algorithms 3.1 and 7.4.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from taichi_msm.arithmetic import Array

# Number of steps that the Hessian is estimated from.
MEMORY = 20

# Share of the linear decrease that a step needs, and the least step [full steps].
SUFFICIENT_DECREASE, MIN_STEP = 1e-4, 1e-10


def minimise(
    objective: Callable[[Array], tuple[float, Array]],
    start: Array,
    inverse_hessian: Callable[[Array], Array],
    tolerance: float,
    max_iterations: int,
    progress: Callable[[int], None],
) -> Array:
    """Return where an objective is smallest, from `start`; `objective` gives its value and gradient.

    The value is infinite outside the domain. Ends where the quadratic model has at most `tolerance` of the value left.
    """
    place, (value, slope) = start, objective(start)
    steps: deque[tuple[Array, Array, float]] = deque(maxlen=MEMORY)
    for iteration in range(max_iterations):
        progress(iteration)
        direction = -_apply_inverse_hessian(slope, steps, inverse_hessian)
        decrease = -float((slope * direction).sum())
        if decrease / 2 <= tolerance * abs(value):
            break
        size = 1.0
        while True:
            next_place = place + size * direction
            next_value, next_slope = objective(next_place)
            if next_value <= value - SUFFICIENT_DECREASE * size * decrease:
                break
            size /= 2
            if size < MIN_STEP:  # The value has no more digits.
                return place
        moved, change = next_place - place, next_slope - slope
        curvature = float((moved * change).sum())
        if curvature > 0:
            steps.append((moved, change, curvature))
        place, value, slope = next_place, next_value, next_slope
    return place


def _apply_inverse_hessian(
    slope: Array, steps: deque[tuple[Array, Array, float]], inverse_hessian: Callable[[Array], Array]
) -> Array:
    """Return the product of the estimated inverse Hessian and a gradient, by the two-loop recursion."""
    shares = []
    for moved, change, curvature in reversed(steps):
        shares.append(float((moved * slope).sum()) / curvature)
        slope = slope - shares[-1] * change
    result = inverse_hessian(slope)
    if steps:
        _, change, curvature = steps[-1]
        result = result * (curvature / float((change * inverse_hessian(change)).sum()))
    for moved, change, curvature in steps:
        result = result + (shares.pop() - float((change * result).sum()) / curvature) * moved
    return result
