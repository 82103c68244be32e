"""Locking: the tangent grows with the elongation from 1 to `factor`, and then stays.

With x0 = 1 - factor^(-1/2)

    f(e) = e                        for e <= 0
    f(e) = e / (1 - x)              for 0 < x <= x0, where the tangent (1 - x)^-2 reaches `factor`

and f is linear with the slope `factor` for x > x0.
"""

from __future__ import annotations

from typing import Any, ClassVar

from taichi_msm.arithmetic import Operations
from taichi_msm.laws.law import Law, LawFormulas, LawKey


class Locking(Law):
    """Law of `lock` and `factor`."""

    scale: ClassVar[str] = "lock"
    keys: ClassVar[dict[str, LawKey]] = {
        "factor": LawKey("largest stiffness, relative to that at rest", "a number from 1 to 1000", 1.0, 1000.0, 10.0)
    }
    shape_count: ClassVar[int] = 1

    def shape(self, *numbers: Any) -> tuple[Any, ...]:
        return (1 - numbers[0] ** -0.5,)

    def largest_slope(self, *numbers: float) -> float:
        return numbers[0]

    def build(self, operations: Operations) -> LawFormulas:
        log, maximum, minimum, where = operations.log, operations.maximum, operations.minimum, operations.where

        def ratio(x, x0):
            inner, beyond = minimum(maximum(x, 0), x0), maximum(x, x0)
            return beyond - inner * x0, (1 - inner) * (1 - inner) * beyond

        def integral(x, x0):
            inner = minimum(maximum(x, 0), x0)
            # -inner - log(1 - inner) = y^2 (2 - inner) + 2 (atanh(y) - y), which avoids cancellation.
            y = inner / (2 - inner)
            square, unit = y * y, 1 + 0 * y
            series = square * (unit / 3 + square * (unit / 5 + square * (unit / 7 + square * (unit / 9 + square / 11))))
            excess = where(y < 0.1, series * y, log((1 + y) / (1 - y)) / 2 - y)
            slope = 1 / (1 - inner)
            beyond = x - inner
            return 2 * (square * (2 - inner) + 2 * excess) + beyond * (2 * inner * slope + beyond * (slope * slope))

        return LawFormulas(ratio, integral)
