"""Where material points are seen, and whether anything is in front of them: found exactly, without a depth map.

A point is placed on the drawn surface, and projected. It is hidden if another part of the surface, or an instrument, is
nearer on the same line of sight. Bins tell which cells may be there: squares of the picture, each with a list of the
cells whose outlines reach it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.camera import View
from taichi_msm.render.instrument import Rod
from taichi_msm.render.labels import Flow, Sight
from taichi_msm.render.numbers import view_numbers
from taichi_msm.render.tracking_kernel import CELL_NUMBERS, POINT_NUMBERS, count, fill, judge, project, search
from taichi_msm.scene import Scene
from taichi_msm.system.runtime import our_compilation

# Whatever is in front of a point by less than this fraction of the sheet's larger side counts as the point's own place.
TOUCHING = 1e-9

# The smallest width of a bin [px]. The largest number of entries in all lists, per cell and bin.
SMALLEST_BIN = 4
MOST_ENTRIES = 64


def find(
    scene: Scene,
    coordinates: NDArray[np.floating],
    position: NDArray[np.floating],
    view: View,
    rods: Sequence[Rod] = (),
) -> Sight:
    """Find material points.

    Args:
        scene: a checked scene; call `runtime.start` first.
        coordinates: fractions of the sheet's width from its left and of its height from its top, shape (n, 2).
        position: positions of the mass points [m], shape (rows, cols, 3).
        view: the camera.
        rods: the instruments.
    """
    pixels, hidden = _search(scene, coordinates, position, view, rods, moved=False)
    return Sight(pixels, hidden.view(np.bool_))


def find_flow(
    scene: Scene,
    coordinates: NDArray[np.floating],
    position: NDArray[np.floating],
    view: View,
    rods: Sequence[Rod] = (),
) -> Flow:
    """Find how far the points that the pixels of another frame show have moved in the picture.

    Args:
        scene: as for `find`.
        coordinates: as in the labels of the other frame, shape (height, width, 2); NaN where no sheet is seen.
        position: positions of the mass points now [m], shape (rows, cols, 3).
        view: the camera.
        rods: the instruments now.
    """
    shape = coordinates.shape[:2]
    moved, hidden = _search(scene, coordinates.reshape(-1, 2), position, view, rods, moved=True)
    return Flow(moved.reshape(*shape, 2), hidden.reshape(shape) * np.uint8(255))


def _search(
    scene: Scene,
    coordinates: NDArray[np.floating],
    position: NDArray[np.floating],
    view: View,
    rods: Sequence[Rod],
    *,
    moved: bool,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Find material points, or how far they are from the centres of all pixels, row by row; and which are hidden."""
    (rows, cols), (width, height) = scene.sheet.points, scene.render.size
    numbers = view_numbers(view, scene.render, 1, scene.sheet.size, (1, 1), rods)
    cells = (rows - 1) * (cols - 1)
    point, cell = np.empty(rows * cols * POINT_NUMBERS), np.empty(cells * CELL_NUMBERS)
    # If a bin is half as wide as a cell, the cells of most bins are around one mass point only.
    bin_size = max(SMALLEST_BIN, round((width * height / cells) ** 0.5 / 2))
    with our_compilation(optimised=False):
        project(np.ascontiguousarray(position, np.float64), numbers, rows, cols, point, cell)
        while True:
            across, down = -(-width // bin_size), -(-height // bin_size)
            ends = np.zeros(across * down + 1, np.int32)
            count(cell, cells, bin_size, across, down, ends)
            starts = np.cumsum(ends, dtype=np.int64)
            if starts[-1] <= MOST_ENTRIES * (cells + across * down):
                break
            bin_size *= 2
        entries = np.empty(max(1, starts[-1]), np.int32)
        fill(cell, cells, bin_size, across, down, starts[:-1].astype(np.int32), entries)
        first, simple = starts.astype(np.int32), np.empty(across * down, np.uint8)
        judge(cell, cols, across * down, first, entries, simple)
        pixels, hidden = np.empty((len(coordinates), 2), np.float32), np.empty(len(coordinates), np.uint8)
        search(
            np.ascontiguousarray(coordinates, np.float32).ravel(),
            len(coordinates),
            width if moved else 0,
            point,
            cell,
            rows,
            cols,
            width,
            height,
            bin_size,
            across,
            first,
            entries,
            simple,
            TOUCHING * max(scene.sheet.size),
            numbers,
            len(rods),
            pixels.ravel(),
            hidden,
        )
    return pixels, hidden
