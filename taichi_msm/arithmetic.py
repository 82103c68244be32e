"""Functions with which a formula in plain arithmetic serves NumPy, kernels and dual numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class Operations(NamedTuple):
    """Functions of NumPy, a kernel or dual numbers that formulas use in addition to + - * /."""

    sqrt: Callable[..., Any]
    log: Callable[..., Any]
    exp: Callable[..., Any]
    arctan: Callable[..., Any]
    maximum: Callable[..., Any]
    minimum: Callable[..., Any]
    where: Callable[..., Any]
    wrap: Callable[[Callable[..., Any]], Callable[..., Any]]  # makes a formula callable from another one
    hold: Callable[[Any], Any]  # keeps an intermediate result in a variable


NUMPY = Operations(
    np.sqrt, np.log, np.exp, np.arctan, np.maximum, np.minimum, np.where, lambda function: function, lambda value: value
)
