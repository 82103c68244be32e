"""The map of a sheet: factors of its stiffness from place to place.

A map's file is read when a scene is checked, and then kept, so that a whole run has one map even if the file is changed
or removed in the meantime.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.picture import file_sha256, read_rgb
from taichi_msm.scene import StiffnessMap

Array = NDArray[np.float64]

# The number of files whose content is kept.
MOST_KEPT = 16

# By file name: the time of its last change, its SHA-256, and its grey, 0 to 255, shape (height, width).
_kept: dict[str, tuple[int, str, NDArray[np.uint8]]] = {}


def read(stiffness_map: StiffnessMap) -> None:
    """Read the file of a map, unless it has been read and not changed since.

    Raises:
        PictureError: when the file cannot be used.
    """
    image = stiffness_map.image
    changed = 0
    # If something is wrong with the file, reading it will say so.
    with suppress(OSError, ValueError):
        changed = Path(image).stat().st_mtime_ns
    if image in _kept and _kept[image][0] == changed:
        return
    found_sha256 = file_sha256(image)
    grey = np.asarray(read_rgb(image, (0, 0, 0), found_sha256).convert("L"))
    for found in (_sampled, largest, largest_mean):
        found.cache_clear()
    if len(_kept) >= MOST_KEPT:
        del _kept[next(iter(_kept))]
    _kept[image] = changed, found_sha256, grey


def sha256(stiffness_map: StiffnessMap) -> str:
    """Give the SHA-256 of the file of a map, as it was read.

    Raises:
        PictureError: when the file cannot be used.
    """
    if stiffness_map.image not in _kept:
        read(stiffness_map)
    return _kept[stiffness_map.image][1]


def factors(stiffness_map: StiffnessMap, rows: int, cols: int) -> Array:
    """Give the factors at the centres of the cells, shape (rows, cols).

    Raises:
        PictureError: when the file cannot be used.
    """
    if stiffness_map.image not in _kept:
        read(stiffness_map)
    return _sampled(stiffness_map, rows, cols)


@lru_cache(maxsize=8)
def _sampled(stiffness_map: StiffnessMap, rows: int, cols: int) -> Array:
    """Interpolate at the centres of the cells: bilinearly between the centres of texels, constant beyond them."""
    grey = _kept[stiffness_map.image][2].astype(float)
    height, width = grey.shape
    row = np.clip((np.arange(rows) + 0.5) / rows * height - 0.5, 0, height - 1)
    column = np.clip((np.arange(cols) + 0.5) / cols * width - 0.5, 0, width - 1)
    top, left = row.astype(int), column.astype(int)
    bottom, right = np.minimum(top + 1, height - 1), np.minimum(left + 1, width - 1)
    down, across = (row - top)[:, None], column - left
    above = grey[np.ix_(top, left)] * (1 - across) + grey[np.ix_(top, right)] * across
    below = grey[np.ix_(bottom, left)] * (1 - across) + grey[np.ix_(bottom, right)] * across
    black, white = stiffness_map.range
    found = black + (white - black) / 255 * (above * (1 - down) + below * down)
    found.flags.writeable = False
    return found


@lru_cache(maxsize=8)
def largest(stiffness_map: StiffnessMap, rows: int, cols: int) -> float:
    """Find the largest factor of rows x cols cells."""
    return float(factors(stiffness_map, rows, cols).max())


@lru_cache(maxsize=8)
def largest_mean(stiffness_map: StiffnessMap, rows: int, cols: int) -> float:
    """Find the largest mean of the factors of the cells around a point, for rows x cols cells."""
    found = factors(stiffness_map, rows, cols)
    around, cells = np.pad(found, 1), np.pad(np.ones_like(found), 1)

    def at_points(values: Array) -> Array:
        return values[:-1, :-1] + values[:-1, 1:] + values[1:, :-1] + values[1:, 1:]

    return float((at_points(around) / at_points(cells)).max())
