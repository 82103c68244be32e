"""Where the samples of a picture that a lens has bent would be without it: a table, made once for a lens and a size.

With it, and with bounds of how far cells are bent, kernel 2 covers bent pictures as it covers others.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.camera import Lens, View, border_points

if TYPE_CHECKING:
    from taichi_msm.render.config import DrawingConfig

Array = NDArray[np.float64]
Pair = tuple[float, float]

# The place of a sample that shows nothing, as it is beyond the limit of the lens.
INVALID_COORDINATE = 1e9

# A picture without the lens is at most so many times larger.
MAX_VIEW_SCALE = 4

# Rows of samples whose places are found at a time.
ROWS = 64

# Derivatives of the lens are taken at so many radii and angles, and the largest is enlarged for what lies between.
RADII, ANGLES, ENLARGED = 256, 64, 1.25
STEP = 1e-5


class VisibleRegion(NamedTuple):
    """What a picture shows of the plane at depth 1, and how the lens bends it there.

    A line of length L becomes a curve, which is at most `bend` L^2 away from the straight line between its ends, as its
    second derivatives are at most 8 `bend`; and the curve is at most 2 `stretch` L long.
    """

    radius: float  # the largest distance from the axis of view
    box: tuple[float, float, float, float]  # left, right, top and bottom without distortion [px]
    bend: float  # [1/px]
    stretch: float


def visible_region(view: View) -> VisibleRegion:
    """Find what a camera with a lens shows."""
    assert view.lens is not None
    scale, centre, size = ((float(one[0]), float(one[1])) for one in (view.scale, view.centre, view.size))
    return _visible_region(view.lens, scale, centre, size)


@lru_cache(maxsize=16)
def _visible_region(lens: Lens, scale: Pair, centre: Pair, size: Pair) -> VisibleRegion:
    place = lens.undistort((border_points(np.array(size)) - centre) / scale)
    radius = float(np.linalg.norm(place, axis=-1).max())
    if np.isnan(radius):
        radius = lens.limit
        place = np.array([[-radius, -radius], [radius, radius]])
    # Between two places of the border, a pixel apart, it may reach a little farther.
    (left, top), (right, bottom) = place.min(axis=0) * scale + centre - 1, place.max(axis=0) * scale + centre + 1
    away, turn = np.meshgrid(radius * np.linspace(0, 1, RADII), np.linspace(0, 2 * np.pi, ANGLES))
    points = np.stack([away * np.cos(turn), away * np.sin(turn)], axis=-1)
    step = STEP * radius
    change = [lens.jacobian(points + shift) - lens.jacobian(points - shift) for shift in np.eye(2) * step]
    curving = np.sqrt((np.stack(change) ** 2).sum(axis=(0, -1))).max() / (2 * step)
    growing = np.sqrt((lens.jacobian(points) ** 2).sum(axis=-1)).max()
    high, low = max(scale), min(scale)
    return VisibleRegion(
        radius * (1 + 1e-5),
        (float(left), float(right), float(top), float(bottom)),
        ENLARGED * float(curving) * high / low**2 / 8,
        ENLARGED * float(growing) * high / low / 2,
    )


def undistorted_view(view: View) -> View:
    """Give a camera without the lens, whose picture is all that is seen through it; smaller, if the lens is wide."""
    left, right, top, bottom = visible_region(view).box
    share = min(1.0, MAX_VIEW_SCALE * float(view.size.max()) / max(right - left, bottom - top))
    corner, matrix = np.array([left, top]), view.matrix.copy()
    for row in (0, 1):
        matrix[row] = (matrix[row] - corner[row] * matrix[2]) * share
    size = np.ceil(np.array([right - left, bottom - top]) * share)
    return view._replace(
        matrix=matrix, scale=view.scale * share, centre=(view.centre - corner) * share, size=size, lens=None
    )


def undistortion_map(view: View, factor: int, *, steps: bool) -> NDArray[np.float32]:
    """Give the places of all samples, `factor` a pixel along each axis, without distortion.

    Returns:
        x and y [samples], BEYOND where nothing is seen, shape (rows, columns, 2). With `steps` also their changes to
        the next sample on the right, and to that below; shape (rows, columns, 6).
    """
    assert view.lens is not None
    columns, rows = (int(side) * factor for side in view.size)
    table = np.empty((rows, columns, 6 if steps else 2), np.float32)
    for first in range(0, rows, ROWS):
        end = min(first + ROWS, rows)
        pixels = (np.stack(np.meshgrid(np.arange(columns), np.arange(first, end)), axis=-1) + 0.5) / factor
        place = view.undistort(pixels)
        seen = ~np.isnan(place[..., :1])
        table[first:end, :, :2] = np.where(seen, place * factor, INVALID_COORDINATE)
        if steps:
            slope = view.lens.jacobian((np.where(seen, place, view.centre) - view.centre) / view.scale)
            back = np.linalg.inv(slope) * view.scale[:, None] / view.scale
            table[first:end, :, 2:] = np.where(seen, np.moveaxis(back, -1, -2).reshape(*seen.shape[:2], 4), 0)
    return table


def bounds(places: NDArray[np.float32]) -> Array:
    """Give the left, right, top and bottom of places, shape (..., 2); without any, what nothing is in."""
    known = places[places[..., 0] < INVALID_COORDINATE]
    if not len(known):
        return np.array([INVALID_COORDINATE, -INVALID_COORDINATE, INVALID_COORDINATE, -INVALID_COORDINATE])
    (left, top), (right, bottom) = known.min(axis=0), known.max(axis=0)
    return np.array([left, right, top, bottom])


def tiled_map(places: NDArray[np.float32], config: DrawingConfig) -> NDArray[np.float32]:
    """Arrange places in the bands and tiles of kernel 2, with bounds; shape (bands, vectors of each, lanes)."""
    rows, columns, planes = places.shape
    height, lines = config.band_rows * config.supersample, config.band_lines
    tile_height, tile_width = config.tile_height, config.tile_width
    bands, across = -(-rows // height), -(-columns // tile_width)
    padding = (0, bands * height - rows), (0, across * tile_width - columns), (0, 0)
    cut = np.pad(places, padding, constant_values=INVALID_COORDINATE).reshape(bands, height, -1, planes)
    cut = np.pad(cut, ((0, 0), (0, lines * tile_height - height), (0, 0), (0, 0)), constant_values=INVALID_COORDINATE)
    tiles = cut.reshape(bands, lines, tile_height, across, tile_width, planes).transpose(0, 1, 3, 5, 2, 4)
    tiles = tiles.reshape(bands, lines, across, planes, config.lanes)
    # Where a tile has no place, its bounds are far away too.
    least = tiles[..., :2, :].min(axis=-1)
    most = np.where(tiles[..., :2, :] < INVALID_COORDINATE, tiles[..., :2, :], least[..., None]).max(axis=-1)
    box = np.stack([least, most], axis=-1).reshape(bands, lines, across, 1, 4)
    box = np.pad(box, ((0, 0), (0, 0), (0, 0), (0, 0), (0, config.lanes - 4)))
    return np.concatenate([tiles, box], axis=3).reshape(bands, -1, config.lanes)
