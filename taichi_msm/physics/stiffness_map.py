"""The map of a sheet: factors of its stiffness from place to place, read from the grey values of an image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.picture import file_sha256, read_rgb
from taichi_msm.scene import StiffnessMap

Array = NDArray[np.float64]


class MapImage(NamedTuple):
    """The file of a map. It is read once, so that a whole run has one map even if the file changes meanwhile.

    Attributes:
        grey: 0 to 255, shape (height, width).
        sha256: of the file.
    """

    grey: NDArray[np.uint8]
    sha256: str


def read(stiffness_map: StiffnessMap) -> MapImage:
    """Read the file of a map; PictureError: it cannot be used."""
    sha256 = file_sha256(stiffness_map.image)
    return MapImage(np.asarray(read_rgb(stiffness_map.image, (0, 0, 0), sha256).convert("L")), sha256)


def factors(stiffness_map: StiffnessMap, image: MapImage, rows: int, cols: int) -> Array:
    """Interpolate the factors at the centres of rows x cols cells: bilinearly between texels, constant beyond them."""
    grey = image.grey.astype(float)
    height, width = grey.shape
    row = np.clip((np.arange(rows) + 0.5) / rows * height - 0.5, 0, height - 1)
    column = np.clip((np.arange(cols) + 0.5) / cols * width - 0.5, 0, width - 1)
    top, left = row.astype(int), column.astype(int)
    bottom, right = np.minimum(top + 1, height - 1), np.minimum(left + 1, width - 1)
    down, across = (row - top)[:, None], column - left
    above = grey[np.ix_(top, left)] * (1 - across) + grey[np.ix_(top, right)] * across
    below = grey[np.ix_(bottom, left)] * (1 - across) + grey[np.ix_(bottom, right)] * across
    black, white = stiffness_map.range
    return black + (white - black) / 255 * (above * (1 - down) + below * down)


def largest_mean(factors: Array) -> float:
    """Find the largest mean of the factors of the cells around a point."""
    around, cells = np.pad(factors, 1), np.pad(np.ones_like(factors), 1)

    def at_points(values: Array) -> Array:
        return values[:-1, :-1] + values[:-1, 1:] + values[1:, :-1] + values[1:, 1:]

    return float((at_points(around) / at_points(cells)).max())
