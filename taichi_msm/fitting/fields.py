"""The fields of a map of stiffness, and how they share out to the cells of a sheet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Fields:
    """R x R fields of a map, and the cells of a sheet, which get what `material.map_factors` gives of such a picture.

    Args:
        resolution: R.
        cells: of the sheet, rows and cols.
    """

    def __init__(self, resolution: int, cells: tuple[int, int]) -> None:
        self.resolution = resolution
        # Linear between the centres of the fields, constant beyond.
        self._down, self._across = (
            np.stack([np.interp(centres(n), centres(resolution), unit) for unit in np.eye(resolution)], axis=1)
            for n in cells
        )

    def factors(self, x: Array) -> Array:
        """Give the factors of the cells for the logs of those of the fields, shape (R^2,)."""
        return np.asarray(self._down @ np.exp(x).reshape(self.resolution, -1) @ self._across.T)

    def backward(self, x: Array, by_cell: Array) -> Array:
        """Turn the derivative of a loss by the factors of the cells into that by the logs x."""
        return np.asarray(np.exp(x) * (self._down.T @ by_cell @ self._across).ravel())

    def roughness(self) -> Array:
        """Give L, shape (R^2, R^2): x L x is the sum of the squared differences of neighbouring fields."""
        steps, one = np.diff(np.eye(self.resolution), axis=0), np.eye(self.resolution)
        line = steps.T @ steps
        return np.kron(line, one) + np.kron(one, line)


def centres(count: int) -> Array:
    """Give the centres of equal parts of a side, as fractions of it."""
    return (np.arange(count) + 0.5) / count
