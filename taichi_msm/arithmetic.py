"""Functions with which a formula in plain arithmetic serves both NumPy and kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class Operations(NamedTuple):
    """Functions of NumPy or Taichi that laws and shapes use in addition to + - * /."""

    sqrt: Callable[..., Any]
    log: Callable[..., Any]
    maximum: Callable[..., Any]
    minimum: Callable[..., Any]
    where: Callable[..., Any]
    wrap: Callable[[Callable[..., Any]], Callable[..., Any]]  # makes a formula callable from another one


NUMPY = Operations(np.sqrt, np.log, np.maximum, np.minimum, np.where, lambda function: function)
