"""The texture at 1/2, 1/4, ... of its size (mipmaps), so that a sample that shows many texels shows their mean."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Pyramid(NamedTuple):
    """Levels of a texture: the first has the texture's size, the last has one texel.

    Attributes:
        texels: of all levels, as `packed` makes them, one row after another.
        levels: for every level, where it begins in `texels`, its width and its height, shape (levels, 3).
    """

    texels: NDArray[np.float32]
    levels: NDArray[np.int32]


def packed(colours: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Pack each colour into one number, red + 256 green + 65536 blue, which f32 holds exactly."""
    return colours.astype(np.float32) @ np.array([1, 1 << 8, 1 << 16], np.float32)


def pyramid(texture: NDArray[np.uint8], *, minified: bool) -> Pyramid:
    """Make the levels of a texture.

    Args:
        texture: colours, shape (height, width, 3).
        minified: whether all levels are made; False makes the first alone.
    """
    level, texels, levels, first = texture, [], [], 0
    while True:
        height, width, _ = level.shape
        texels.append(packed(level).ravel())
        levels.append((first, width, height))
        first += width * height
        if not minified or width == height == 1:
            return Pyramid(np.concatenate(texels), np.array(levels, np.int32))
        level = halved(level)


def halved(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average blocks of 2 x 2 texels; where their number is odd, the last row or column counts twice."""
    height, width, _ = colours.shape
    even = np.pad(colours, ((0, height % 2), (0, width % 2), (0, 0)), "edge").astype(np.uint16)
    sums = even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
    return ((sums + 2) // 4).astype(np.uint8)
