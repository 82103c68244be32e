"""The operations of formulas in kernels, for numbers and for vectors of lanes."""

from collections.abc import Callable
from typing import Any

from taichi_msm.arithmetic import Operations
from taichi_msm.system.runtime import ti

# The arctangent halves the angle HALVINGS times, and sums the power series of the remaining angle, whose terms have the
# divisors SERIES, smallest term first.
HALVINGS = 3
SERIES = [(-1.0) ** n * (2 * n + 1) for n in reversed(range(12))]


@ti.func
def _arctangent(tangent):
    """Return the angle of a tangent; GPUs have no arctangent in f64."""
    half_tangent = tangent
    for _ in ti.static(range(HALVINGS)):
        half_tangent = half_tangent / (1.0 + ti.sqrt(1.0 + half_tangent * half_tangent))
    square = half_tangent * half_tangent
    # 1 and 0 in the precision of the argument; a quotient of constants would be f32.
    unit = half_tangent * 0.0 + 1.0
    total = half_tangent * 0.0
    for divisor in ti.static(SERIES):
        total = unit / divisor + square * total
    return total * half_tangent * 2.0**HALVINGS


def _by_lane(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that applies `function` to every lane, as exp and log of vectors crash."""

    @ti.func
    def apply(values):
        result = values
        if ti.static(values.is_tensor()):
            for lane in ti.static(range(values.n)):
                result[lane] = function(values[lane])
        else:
            result = function(values)
        return result

    return apply


KERNEL = Operations(
    ti.sqrt, _by_lane(ti.exp), _by_lane(ti.log), _arctangent, ti.max, ti.min, ti.select, ti.func,
    hold=ti.lang.impl.expr_init,
)  # fmt: skip
