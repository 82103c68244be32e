"""Where material points are seen, and whether anything is in front of them: found in f64, without a depth map.

A point is placed on the drawn surface, and projected. It is hidden if another part of the surface, or an instrument, is
nearer on the same line of sight. Bins tell which cells may be there.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Rod
from taichi_msm.render import geometry, lens_kernels
from taichi_msm.render import uniforms as uni
from taichi_msm.render.bins import BOUNDS, binned, store_bounds
from taichi_msm.render.camera import View
from taichi_msm.render.config import INFINITY, Bytes, Doubles, Floats, Integers
from taichi_msm.render.coverage import meet
from taichi_msm.render.geometry import POINT_NUMBERS
from taichi_msm.render.labels import NO_FLOW, Flow, Sight
from taichi_msm.render.lens_table import window
from taichi_msm.scene.scene import Scene
from taichi_msm.system.launches import Launches, end_thread
from taichi_msm.system.runtime import compilation_options, lanes, ti

Array = NDArray[np.floating]

# The smallest width of a bin [px].
SMALLEST_BIN = 4

# The numbers of a cell: its bounds in the picture; its least depth; and its side, 0 for a cell drawn triangle by
# triangle, else 1 or -1 as its front or its back is seen.
MIN_X, MAX_X, MIN_Y, MAX_Y, NEAREST, SIDE, CELL_NUMBERS = range(7)

# The bounds of a cell that may be anywhere [px].
ANYWHERE = 1e9

# The cells around a mass point.
AROUND = 4

# The pixel of a point that is seen nowhere.
NOWHERE = math.nan


def find(scene: Scene, coordinates: Array, position: Array, view: View, rods: Sequence[Rod] = ()) -> Sight:
    """Find material points by their coordinates on the sheet, as in `Labels`, shape (n, 2).

    The mass points are at `position` [m], shape (rows, cols, 3). Raises a DeviceError when threads were cut short.
    """
    pixels, hidden = _search(scene, coordinates, position, view, rods, moved=False)
    return Sight(pixels, hidden.view(np.bool_))


def find_flow(scene: Scene, coordinates: Array, position: Array, view: View, rods: Sequence[Rod] = ()) -> Flow:
    """Find how far the points that the pixels of another frame show have moved in the picture; else as `find`.

    `coordinates` are those in the labels of the other frame, shape (height, width, 2); NaN where no sheet is seen.
    """
    shape = coordinates.shape[:2]
    moved, hidden = _search(scene, coordinates.reshape(-1, 2), position, view, rods, moved=True)
    return Flow(moved.reshape(*shape, 2), hidden.reshape(shape) * np.uint8(255))


def _search(
    scene: Scene, coordinates: Array, position: Array, view: View, rods: Sequence[Rod], *, moved: bool
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Find material points, or how far they are from the centres of all pixels, row by row; and which are hidden."""
    total = len(coordinates)
    if total == 0:
        return np.empty((0, 2), np.float32), np.empty(0, np.uint8)
    rows, cols = scene.sheet.points
    cells = (rows - 1) * (cols - 1)
    # What hides what is found without the lens.
    straight = view if view.lens is None else window(view)
    width, height = (int(side) for side in straight.size)
    # If a bin is half as wide as a cell, the cells of most bins are around one mass point only.
    bin_size = max(SMALLEST_BIN, round((width * height / cells) ** 0.5 / 2))
    launches = Launches(bounded=lanes("f64") == 1)
    told = uni.view_numbers(straight, scene.render, 1, scene.sheet.size, (1, 1), rods)
    if view.lens is not None:
        uni.tell_lens(told, view, 1, view.lens.limit)
    numbers = launches.upload(told)
    sizes = uni.sizes_of(scene, np.empty((0, 3), np.int32))
    sizes[[uni.ROD_COUNT, uni.WIDTH, uni.HEIGHT]] = len(rods), width, height
    point, cell = (launches.array(np.float64, n) for n in (rows * cols * POINT_NUMBERS, cells * CELL_NUMBERS))
    bounds = launches.array(np.int32, cells * BOUNDS)
    with compilation_options(optimised=False):
        _outline(np.ascontiguousarray(position, np.float64), numbers, launches.upload(sizes), point, cell, bounds)
    bins = binned(launches, bounds, cells, (width, height), bin_size)
    sizes[[uni.BIN_SIZE, uni.BINS_ACROSS, uni.WIDTH, uni.HEIGHT]] = bins.size, bins.across, *scene.render.size
    simple = launches.array(np.uint8, bins.lengths.size)
    launches.launch(_judge, bins.lengths.size, cell, cols, bins.starts, bins.entries, simple, rounds=3 * AROUND)
    pixels, hidden = launches.array(np.float32, 2 * total), launches.array(np.uint8, total)
    arguments = (
        launches.upload(np.ascontiguousarray(coordinates, np.float32).ravel()),
        int(moved), numbers, launches.upload(sizes), point, cell, bins.starts, bins.entries, simple, pixels, hidden,
    )  # fmt: skip
    # A point takes one round for a cell, and one for each of its triangles.
    rounds = 1 + 2 * (scene.render.refine + 1) ** 2
    for listed, count in launches.chunks(int(bins.lengths.max()), rounds):
        launches.launch(_finding(view.model), total, listed, count, *arguments, rounds=count * rounds + len(rods))
    launches.require_completion()
    return launches.download(pixels).reshape(-1, 2), launches.download(hidden)


@ti.kernel
def _outline(
    position: ti.types.ndarray(dtype=ti.f64, ndim=3), numbers: Doubles, sizes: Integers, point: Doubles, cell: Doubles,
    bounds: Integers,
):  # fmt: skip
    """Project the mass points, and find the outlines of the cells, and their bounds in whole pixels."""
    for index in range(sizes[uni.ROWS] * sizes[uni.COLS]):
        cols = sizes[uni.COLS]
        geometry.project(position, index // cols, index % cols, cols, numbers, point, True)

    for index in range((sizes[uni.ROWS] - 1) * (sizes[uni.COLS] - 1)):
        cols, here = sizes[uni.COLS], index * CELL_NUMBERS
        corner = geometry.corner_of(index, cols)
        below = corner + cols * POINT_NUMBERS
        outline = ti.static(geometry.outlined(corner, cols, numbers[uni.NEAR], point))
        left, right, top, bottom, side = outline.left, outline.right, outline.top, outline.bottom, outline.side
        corners = [
            [point[at + n] for n in ti.static(range(3))]
            for at in ti.static((corner, corner + POINT_NUMBERS, below, below + POINT_NUMBERS))
        ]
        if outline.behind:
            left, right, top, bottom = 1.0, -1.0, 1.0, -1.0
        elif not outline.in_front:
            left, right, top, bottom, side = -ANYWHERE, ANYWHERE, -ANYWHERE, ANYWHERE, 0.0
            width, height = ti.cast(sizes[uni.WIDTH], ti.f64), ti.cast(sizes[uni.HEIGHT], ti.f64)
            if geometry.is_beside(corners, 0.0, width, 0.0, height):
                left, right = 1.0, -1.0
        cell[here + MIN_X], cell[here + MAX_X], cell[here + MIN_Y], cell[here + MAX_Y] = left, right, top, bottom
        cell[here + NEAREST] = ti.min(
            point[corner + 3], point[corner + POINT_NUMBERS + 3], point[below + 3], point[below + POINT_NUMBERS + 3]
        )
        cell[here + SIDE] = side
        store_bounds(index, left, right, top, bottom, sizes[uni.WIDTH], sizes[uni.HEIGHT], bounds)


@ti.kernel
def _judge(
    first: ti.i32, end: ti.i32, ended: Integers, cell: Doubles, cols: ti.i32, starts: Integers, entries: Integers,
    simple: Bytes,
):  # fmt: skip
    """Mark the bins in which no two cells can be seen at the same place.

    This is so if the cells of a bin are among the four around one mass point, and these four are all drawn as a whole
    and seen from the same side: each is convex, so it lies within the angle between its two edges at the point, and
    the four angles add up to 360 degrees without overlapping.
    """
    for square in range(first, end):
        first_i, last_i, first_j, last_j = 1 << 30, -1, 1 << 30, -1
        length = starts[square + 1] - starts[square]
        for n in range(starts[square], starts[square] + ti.min(length, AROUND)):
            i, j = entries[n] // (cols - 1), entries[n] % (cols - 1)
            first_i, last_i = ti.min(first_i, i), ti.max(last_i, i)
            first_j, last_j = ti.min(first_j, j), ti.max(last_j, j)
        around_a_point = length <= AROUND and last_i - first_i <= 1 and last_j - first_j <= 1
        if around_a_point:
            sides, around = 0.0, 0.0
            # All four matter, even those that do not reach the bin.
            for i in range(first_i, last_i + 1):
                for j in range(first_j, last_j + 1):
                    sides += cell[(i * (cols - 1) + j) * CELL_NUMBERS + SIDE]
                    around += 1.0
            around_a_point = abs(sides) == around
        simple[square] = ti.cast(around_a_point, ti.u8)
        end_thread(ended)


@ti.func
def _depth(x, y, column, line, part, lower, near, patch: ti.template()):
    """Find the depth at which (x, y) shows a small quad of a cell, or INFINITY.

    Of a cell that is not whole this is the depth of the triangle below the diagonal, if `lower`, or above.
    """
    triangle = ti.static(geometry.triangle_at(x, y, column, line, part, lower, patch))
    s, t = geometry.on_triangle(x, y, triangle)
    depth = geometry.depth_at(s, t, triangle)
    return ti.select(patch.whole | geometry.is_within(s, t, 0.0, near, triangle), depth, INFINITY)


@ti.func
def _hides(x, y, depth, index, own, own_triangle, cols, parts, near, point: ti.template(), cell: ti.template()):
    """Tell whether a cell is seen at (x, y) at a smaller depth than `depth`.

    `depth` is that of a point that is on the cell `own`, there on the small triangle `own_triangle`.
    """
    here, part = index * CELL_NUMBERS, 1.0 / parts
    side = cell[here + SIDE]
    whole = side != 0.0
    hides = False
    # A cell that is drawn as a whole shows at most one of its points at a place of the picture.
    possible = cell[here + NEAREST] < depth and not (index == own and whole)
    if (
        possible
        and x >= cell[here + MIN_X]
        and x <= cell[here + MAX_X]
        and y >= cell[here + MIN_Y]
        and y <= cell[here + MAX_Y]
    ):
        corner = geometry.corner_of(index, cols)
        patch = ti.static(geometry.patch_of(corner, cols, side, whole, point, True))
        if whole:
            outline = ti.static(geometry.outlined(corner, cols, near, point))
            of_left, of_right, of_top, of_bottom = geometry.edges(x, y, side, outline)
            if of_left >= 0.0 and of_right >= 0.0 and of_top >= 0.0 and of_bottom >= 0.0:
                column, line = geometry.small_quad(x, y, True, parts, patch)
                hides = _depth(x, y, column, line, part, False, near, patch) < depth
        else:
            per_side = ti.cast(parts, ti.i32)
            for triangle in range(2 * per_side * per_side):
                if not hides and not (index == own and triangle == own_triangle):
                    quad = triangle // 2
                    column, line = ti.cast(quad % per_side, ti.f64), ti.cast(quad // per_side, ti.f64)
                    hides = _depth(x, y, column, line, part, triangle % 2 == 1, near, patch) < depth
    return hides


@ti.func
def _is_behind_rod(x, y, depth, numbers: ti.template(), sizes: ti.template()):
    """Tell whether an instrument is seen at (x, y) at a smaller depth than `depth`."""
    hides = False
    for n in range(sizes[uni.ROD_COUNT]):
        rod = uni.RODS + n * uni.ROD_NUMBERS
        across_it = x >= numbers[rod + uni.LEFT] and x <= numbers[rod + uni.RIGHT]
        if across_it and y >= numbers[rod + uni.TOP] and y <= numbers[rod + uni.BOTTOM]:
            met, _, _, _ = meet(x, y, n, numbers)
            if met < depth and geometry.w_at(met, numbers) > numbers[uni.NEAR]:
                hides = True
    return hides


@cache
def _finding(lens: str) -> Callable[..., None]:
    """Make the kernel that finds points, for a model of the lens, empty if it bends no lines."""

    @ti.kernel
    def find_points(
        first: ti.i32, end: ti.i32, ended: Integers, listed: ti.i32, count: ti.i32, coordinates: Floats, moved: ti.i32,
        numbers: Doubles, sizes: Integers, point: Doubles, cell: Doubles, starts: Integers, entries: Integers,
        simple: Bytes, pixels: Floats, hidden: Bytes,
    ):  # fmt: skip
        """Find where material points are seen, and which are hidden by `count` cells of their lists from `listed` on.

        If `moved` is 0, `pixels` gets their places [px]. Otherwise they are what the pixels of another frame showed,
        and `pixels` gets how far each has moved from its pixel's centre [px].
        """
        for k in range(first, end):
            rows, cols, width, height = sizes[uni.ROWS], sizes[uni.COLS], sizes[uni.WIDTH], sizes[uni.HEIGHT]
            near, parts = numbers[uni.NEAR], numbers[uni.PARTS]
            u, v = coordinates[2 * k], coordinates[2 * k + 1]
            x, y, out_of_sight = ti.cast(NOWHERE, ti.f64), ti.cast(NOWHERE, ti.f64), False
            if abs(u) < 2.0:  # False for NaN
                s = ti.math.clamp(ti.cast(u, ti.f64), 0.0, 1.0) * (cols - 1)
                t = ti.math.clamp(ti.cast(v, ti.f64), 0.0, 1.0) * (rows - 1)
                j, i = ti.min(ti.cast(s, ti.i32), cols - 2), ti.min(ti.cast(t, ti.i32), rows - 2)
                s, t = s - j, t - i
                own, part = i * (cols - 1) + j, 1.0 / parts
                column, line = ti.min(ti.floor(s * parts), parts - 1.0), ti.min(ti.floor(t * parts), parts - 1.0)
                s0, t0 = column * part, line * part
                s1, t1 = s - s0, t - t0
                own_triangle = 2 * ti.cast(line * parts + column, ti.i32) + ti.cast(t1 > s1, ti.i32)
                patch = ti.static(geometry.patch_of(geometry.corner_of(own, cols), cols, 0.0, True, point, True))
                # In the small quad, D s t is replaced by a function that is linear on either side of the diagonal.
                twist = s0 * t0 + s1 * t0 + s0 * t1 + ti.min(s1, t1) * part
                p = patch.a + patch.b * s + patch.c * t + patch.d * twist
                out_of_sight = True
                if p[2] > near:
                    x, y = p[0] / p[2], p[1] / p[2]
                    place_x, place_y, within = x, y, True
                    if ti.static(lens != ""):
                        x, y, within = lens_kernels.bent(place_x, place_y, numbers, lens)
                    if within and x >= 0.0 and y >= 0.0 and x < width and y < height:
                        out_of_sight = False
                        depth = p[3] - numbers[uni.TOUCHING]
                        square = ti.cast(place_y, ti.i32) // sizes[uni.BIN_SIZE] * sizes[uni.BINS_ACROSS]
                        square += ti.cast(place_x, ti.i32) // sizes[uni.BIN_SIZE]
                        if simple[square] == 0:
                            begin = starts[square] + listed
                            for n in range(begin, ti.min(begin + count, starts[square + 1])):
                                if not out_of_sight:
                                    out_of_sight = _hides(
                                        place_x,
                                        place_y,
                                        depth,
                                        entries[n],
                                        own,
                                        own_triangle,
                                        cols,
                                        parts,
                                        near,
                                        point,
                                        cell,
                                    )
                        out_of_sight = out_of_sight or _is_behind_rod(place_x, place_y, depth, numbers, sizes)
                    if not within:
                        x, y = ti.cast(NOWHERE, ti.f64), ti.cast(NOWHERE, ti.f64)
            if moved > 0:
                seen = x > -INFINITY  # False for NaN
                x = ti.select(seen, x - ti.cast(k % width, ti.f64) - 0.5, NO_FLOW)
                y = ti.select(seen, y - ti.cast(k // width, ti.f64) - 0.5, NO_FLOW)
            pixels[2 * k] = ti.cast(x, ti.f32)
            pixels[2 * k + 1] = ti.cast(y, ti.f32)
            if listed > 0:
                out_of_sight = out_of_sight or hidden[k] > 0
            hidden[k] = ti.cast(out_of_sight, ti.u8)
            end_thread(ended)

    return find_points
