"""Where material points are seen, and whether anything is in front of them: found exactly, without a depth map.

A point is placed on the drawn surface, and projected. It is hidden if another part of the surface, or an instrument, is
nearer on the same line of sight. Bins tell which cells may be there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.bins import BOUNDS, binned
from taichi_msm.render.camera import View
from taichi_msm.render.instrument import Rod
from taichi_msm.render.labels import Flow, Sight
from taichi_msm.render.numbers import view_numbers
from taichi_msm.render.tracking_kernel import AROUND, CELL_NUMBERS, POINT_NUMBERS, judge, project, search
from taichi_msm.scene import Scene
from taichi_msm.system.launches import Launches
from taichi_msm.system.runtime import lanes, our_compilation

# Whatever is in front of a point by less than this fraction of the sheet's larger side counts as the point's own place.
TOUCHING = 1e-9

# The smallest width of a bin [px].
SMALLEST_BIN = 4


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

    Raises:
        DeviceError: when the device cut threads short.
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

    Raises:
        DeviceError: as for `find`.
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
    total = len(coordinates)
    if total == 0:
        return np.empty((0, 2), np.float32), np.empty(0, np.uint8)
    (rows, cols), (width, height) = scene.sheet.points, scene.render.size
    cells = (rows - 1) * (cols - 1)
    # If a bin is half as wide as a cell, the cells of most bins are around one mass point only.
    bin_size = max(SMALLEST_BIN, round((width * height / cells) ** 0.5 / 2))
    launches = Launches(bounded=lanes("f64") == 1)
    numbers = launches.give(view_numbers(view, scene.render, 1, scene.sheet.size, (1, 1), rods))
    point, cell = (launches.array(np.float64, n) for n in (rows * cols * POINT_NUMBERS, cells * CELL_NUMBERS))
    bounds = launches.array(np.int32, cells * BOUNDS)
    with our_compilation(optimised=False):
        project(np.ascontiguousarray(position, np.float64), numbers, rows, cols, width, height, point, cell, bounds)
    bins = binned(launches, bounds, cells, (width, height), bin_size)
    simple = launches.array(np.uint8, bins.lengths.size)
    launches.launch(judge, bins.lengths.size, cell, cols, bins.starts, bins.entries, simple, rounds=3 * AROUND)
    given = launches.give(np.ascontiguousarray(coordinates, np.float32).ravel())
    pixels, hidden = launches.array(np.float32, 2 * total), launches.array(np.uint8, total)
    # A point takes one round for a cell, and one for each of its triangles.
    rounds = 1 + 2 * (scene.render.refine + 1) ** 2
    for listed, count in launches.parts(int(bins.lengths.max()), rounds):
        launches.launch(
            search, total, listed, count, given, width if moved else 0, point, cell, rows, cols, width, height,
            bins.size, bins.across, bins.starts, bins.entries, simple, TOUCHING * max(scene.sheet.size), numbers,
            len(rods), pixels, hidden,
            rounds=count * rounds + len(rods),
        )  # fmt: skip
    launches.require_ended()
    return launches.take(pixels).reshape(-1, 2), launches.take(hidden)
