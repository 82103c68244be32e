"""Checks of the arguments that a caller gives to the library."""

from __future__ import annotations

from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taichi_msm.errors import ArgumentError

if TYPE_CHECKING:
    from numpy.typing import NDArray


# More processes or threads than this are refused.
MAX_WORKERS = 1024


def as_array(values: Any, name: str) -> NDArray[Any]:
    """Turn an argument into an array; ArgumentError: it is impossible, such as for rows of different lengths."""
    # Imported here, so that a scene can be checked without importing NumPy.
    import numpy as np

    try:
        return np.asarray(values)
    except ValueError as error:
        raise ArgumentError(f"{name}: {error}; take an array") from None


def are_numbers(array: NDArray[Any], shape: tuple[int, ...]) -> bool:
    """Tell whether an array holds real numbers and has a shape."""
    return array.dtype.kind in "fiu" and array.shape == shape


def require_frame_count(frames: int) -> None:
    """Make sure that a number of frames is a whole number, 0 or more; ArgumentError: it is not."""
    if isinstance(frames, bool) or not isinstance(frames, Integral) or frames < 0:
        raise ArgumentError(f"{frames!r} frames cannot be simulated; take a whole number, 0 or more")


def require_path(path: str | Path, name: str = "directory", remedy: str = "take a path") -> None:
    """Check that an argument can be a path; ArgumentError: it cannot, with the remedy."""
    if not isinstance(path, (str, Path)) or "\0" in str(path):
        raise ArgumentError(f"{name}: {path!r}; {remedy}")
