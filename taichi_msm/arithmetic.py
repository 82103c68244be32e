"""Functions with which a formula in plain arithmetic serves NumPy, kernels (`system.kernel_operations`) and `dual`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Numbers of the model, but for those of kernels in f32.
Array = NDArray[np.float64]


class Operations(NamedTuple):
    """Functions that formulas use in addition to + - * /, of coefficients and of variables."""

    sqrt: Callable[..., Any]
    exp: Callable[..., Any]
    log: Callable[..., Any]
    arctan: Callable[..., Any]
    maximum: Callable[..., Any]
    minimum: Callable[..., Any]
    where: Callable[..., Any]
    wrap: Callable[[Callable[..., Any]], Callable[..., Any]]  # makes a formula callable from another one
    hold: Callable[[Any], Any]  # keeps an intermediate result in a variable of the kernel


def unchanged(value: Any) -> Any:
    """Return a formula or a result: `wrap` and `hold` outside kernels."""
    return value


NUMPY = Operations(np.sqrt, np.exp, np.log, np.arctan, np.maximum, np.minimum, np.where, unchanged, unchanged)
